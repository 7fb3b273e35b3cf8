// The Cartesian controllers: bounds that hold for any input, the goal, the surface, the push, and the published errors.
#include "palpate/control/cartesian_impedance.hpp"
#include "palpate/control/cartesian_velocity.hpp"

#include <gtest/gtest.h>

#include <functional>
#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::Plant;
using palpate_test::Random;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();
constexpr double h = 0.004;
const double pi = std::numbers::pi;

/// Seven joints like the KUKA LBR iiwa 7: axes and lengths of its data sheet, links as cylinders.
Arm redundant_arm() {
  ArmDescription d;
  d.n = 7;
  const double z[7] = {0.15, 0.19, 0.21, 0.19, 0.21, 0.19, 0.08}, mass[7] = {3.4, 4.0, 3.4, 4.0, 1.5, 2.4, 0.5};
  const double axis[7] = {0, 1, 0, -1, 0, 1, 0}, upper[7] = {2.96, 2.09, 2.96, 2.09, 2.96, 2.09, 3.05};
  for (std::size_t j = 0; j < 7; ++j) {
    auto& J = d.joints[j];
    J.T_parent_joint.p = {0, 0, z[j]};
    J.axis = {0, axis[j], axis[j] == 0.0 ? 1.0 : 0.0};
    J.mass = mass[j];
    J.com = {0, 0.02, 0.08};
    const double m = mass[j];
    J.inertia = {0.008 * m, 0, 0, 0.008 * m, 0, 0.003 * m};
    J.lower = -upper[j];
    J.upper = upper[j];
  }
  d.T_last_tip.p = {0, 0, 0.05};
  d.grasp = {0, 0, 0.08};
  return Arm(d);
}
const JointVector bent{-0.43, 0.36, 0.31, -1.48, 0.68, 1.49, 0.2};

std::array<double, 9> rows(const Mat3<double>& R) { return {R.cx.x, R.cy.x, R.cz.x, R.cx.y, R.cy.y, R.cz.y, R.cx.z, R.cy.z, R.cz.z}; }
std::array<double, 3> three(const Vec3<double>& a) { return {a.x, a.y, a.z}; }
double norm(const std::array<double, 3>& a) { return std::sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]); }

/// exp([phi]x), Rodrigues.
Mat3<double> rotation(const Vec3<double>& phi) {
  const double angle = std::sqrt(dot(phi, phi));
  if (angle == 0.0) return identity3;
  const Vec3<double> k = (1.0 / angle) * phi;
  const auto turn = [&](const Vec3<double>& a) { return std::cos(angle) * a + std::sin(angle) * cross(k, a) + ((1.0 - std::cos(angle)) * dot(k, a)) * k; };
  return {turn({1, 0, 0}), turn({0, 1, 0}), turn({0, 0, 1})};
}

TEST(RotationVector, UndoesTheExponentialAtEveryAngle) {
  Random r(1);
  for (double angle : {0.0, 1e-12, 1e-6, 0.3, 1.5, 3.0, pi - 1e-6, pi - 1e-9, pi}) {
    for (int k = 0; k < 50; ++k) {
      Vec3<double> a{r.normal(), r.normal(), r.normal()};
      a = (angle / std::sqrt(dot(a, a))) * a;
      const Vec3<double> phi = rotation_vector(rotation(a));
      EXPECT_LE(std::sqrt(dot(phi, phi)), pi * (1.0 + 1e-15));
      const Vec3<double> d = phi - a, e = phi + a;  // at pi both signs are right
      EXPECT_LT(std::sqrt(std::min(dot(d, d), angle >= pi ? dot(e, e) : inf)), 1e-7) << angle;
    }
  }
}

TEST(Bounded, KeepsTheDirectionAndNeverExceedsTheBound) {
  Random r(2);
  for (int k = 0; k < 2000; ++k) {
    const double scale = std::pow(10.0, r(-3, 300)), bound = std::pow(10.0, r(-3, 3));
    const Vec3<double> a{scale * r.normal(), scale * r.normal(), scale * r.normal()}, b = bounded(a, bound);
    EXPECT_LE(std::sqrt(dot(b, b)), bound);
    EXPECT_GE(b.x * a.x, 0.0);
    if (scale < 1e100) {
      const Vec3<double> c = cross(a, b);
      EXPECT_LE(std::sqrt(dot(c, c)), 1e-12 * std::sqrt(dot(a, a)) * bound + 1e-300);
    }
  }
  for (double junk : {nan, inf, -inf}) EXPECT_EQ(dot(bounded({junk, 1.0, 0.0}, 5.0), bounded({junk, 1.0, 0.0}, 5.0)), 0.0);
}

TEST(NullSpacePosture, MovesNoTool) {
  const Arm arm = redundant_arm();
  Random r(3);
  const NullSpacePosture posture(arm);
  for (int k = 0; k < 50; ++k) {
    JointVector q{}, dq{};
    for (std::size_t j = 0; j < 7; ++j) q[j] = bent[j] + r(-0.5, 0.5), dq[j] = r(-1, 1);
    const ToolState tool(arm, q, dq);
    const TaskDynamics dynamics(arm, tool, q, {});
    const JointVector tau = posture.torque(tool, dynamics, q, dq);
    const JointVector ddq = Cholesky<double>(mass_matrix<double>(arm, q), 7).solve(tau);
    Vec3<double> a{}, w{};
    double size = 0.0;
    for (std::size_t j = 0; j < 7; ++j) a = a + ddq[j] * tool.Jv[j], w = w + ddq[j] * tool.Jw[j], size += std::abs(ddq[j]);
    EXPECT_GT(size, 1e-3);
    EXPECT_LT(std::sqrt(dot(a, a) + dot(w, w)), 1e-9 * size);
  }
}

double worth(const Arm& arm, const JointVector& q, double limits) {
  const ToolState t(arm, q, {});
  JointMatrix A{};
  for (std::size_t j = 0; j < 7; ++j) {
    const double J[6] = {t.Jv[j].x, t.Jv[j].y, t.Jv[j].z, t.Jw[j].x, t.Jw[j].y, t.Jw[j].z};
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 6; ++c) A(r, c) += J[r] * J[c];
  }
  double log_det = 0.0;  // by elimination
  for (int k = 0; k < 6; ++k) {
    log_det += std::log(A(k, k));
    for (int i = k + 1; i < 6; ++i)
      for (int c = 5; c >= k; --c) A(i, c) -= A(i, k) / A(k, k) * A(k, c);
  }
  double H = 0.5 * log_det;
  for (int j = 0; j < 7; ++j) {
    const double half = 0.5 * (arm.joint(j).upper - arm.joint(j).lower), x = (q[at(j)] - arm.joint(j).lower) / half - 1.0;
    H -= limits * x * x / (1.0 - x * x);
  }
  return H;
}

TEST(NullSpacePosture, TheGradientIsThatOfItsWorth) {
  const Arm arm = redundant_arm();
  const PostureConfig config{.limits = 0.2};
  const NullSpacePosture posture(arm, config);
  Random r(4);
  for (int k = 0; k < 20; ++k) {
    JointVector q{};
    for (std::size_t j = 0; j < 7; ++j) q[j] = bent[j] + r(-0.4, 0.4);
    const JointVector g = posture.gradient(ToolState(arm, q, {}), q);
    for (std::size_t j = 0; j < 7; ++j) {
      JointVector up = q, down = q;
      up[j] += 1e-6, down[j] -= 1e-6;
      EXPECT_NEAR(g[j], (worth(arm, up, 0.2) - worth(arm, down, 0.2)) / 2e-6, 1e-5 * (1.0 + std::abs(g[j])));
    }
  }
}

TEST(NullSpacePosture, AnArmWithoutSpareJointsGetsNothing) {
  Random r(5);
  const Arm arm = palpate_test::random_arm(r, 6);
  const JointVector q{0.1, 0.2, 0.3, 0.1, 0.2, 0.3};
  const ToolState tool(arm, q, q);
  EXPECT_EQ(NullSpacePosture(arm).torque(tool, TaskDynamics(arm, tool, q, {}), q, q), JointVector{});
}

CartesianTarget here(const Arm& arm, const JointVector& q) {
  const ToolState tool(arm, q, {});
  CartesianTarget t;
  t.position = three(tool.x);
  t.orientation = rows(tool.R);
  return t;
}

TEST(CartesianVelocity, NoInputWhateverLiftsTheWrenchAboveItsBounds) {
  const Arm arm = redundant_arm();
  Random r(6);
  const auto junk = [&](double usual) {
    const double pick = r(0, 1);
    return pick < 0.02 ? nan : pick < 0.03 ? inf : pick < 0.04 ? -inf : pick < 0.06 ? r(-1e300, 1e300) : usual * r.normal();
  };
  for (const VelocityAxes axes : {VelocityAxes::heading, VelocityAxes::per_axis}) {
    CartesianVelocityConfig config;
    config.axes = axes;
    config.abag.delta_b = config.abag.delta_g = config.abag_turning.delta_g = 0.5;  // at its bounds in no time
    CartesianVelocity controller(arm, h, config);
    const ToolState start(arm, bent, {});
    for (int k = 0; k < 20000; ++k) {
      CartesianTarget t;
      JointVector q{}, dq{};
      for (std::size_t j = 0; j < 7; ++j) q[j] = bent[j] + (r(0, 1) < 0.02 ? junk(1.0) : 0.1 * r.normal()), dq[j] = r(0, 1) < 0.02 ? junk(10) : r.normal();
      for (std::size_t i = 0; i < 3; ++i) t.position[i] = three(start.x)[i] + (r(0, 1) < 0.02 ? junk(1e3) : 0.1 * r.normal()), t.velocity[i] = r(0, 1) < 0.01 ? junk(1) : 0.0;
      t.orientation = rows(rotation({r.normal(), r.normal(), r.normal()}));
      t.speed = r(0, 1) < 0.02 ? junk(1) : 0.1;
      t.normal_force = r(0, 1) < 0.5 ? 0.0 : r(0, 1) < 0.05 ? junk(10) : 3.0;
      Wrench w;
      w.status = r(0, 1) < 0.8 ? Status::ok : Status::held;
      w.force = {junk(5), junk(5), junk(5)};
      const CartesianCommand c = controller.step(t, q, dq, w);
      EXPECT_LE(norm(c.force), config.max_force);
      EXPECT_LE(norm(c.torque), config.max_torque);
      for (double x : c.joints.torque) EXPECT_TRUE(std::isfinite(x));
    }
  }
}

TEST(CartesianVelocity, ThreeAxesAtTheirBoundLetSqrt3OfItPassAsPublished) {
  const Arm arm = redundant_arm();
  CartesianVelocityConfig published = CartesianVelocityConfig::published(VelocityAxes::per_axis), corrected = published;
  corrected.errata = {};
  double most[2] = {};
  for (int form = 0; form < 2; ++form) {
    CartesianVelocity controller(arm, 0.008, form == 0 ? published : corrected);
    CartesianTarget t = here(arm, bent);
    for (double& x : t.position) x += 0.3;
    for (int k = 0; k < 2000; ++k) most[form] = std::max(most[form], norm(controller.step(t, bent, {}).force));  // held fast
  }
  EXPECT_NEAR(most[0], std::sqrt(3.0) * 5.0, 1e-9);
  EXPECT_NEAR(most[1], 5.0, 1e-9);
}

TEST(CartesianVelocity, AWrenchTurnedTwiceActsElsewhere) {
  const Arm arm = redundant_arm();
  CartesianVelocityConfig wrong;
  wrong.errata.turned_twice = true;
  CartesianVelocity a(arm, h), b(arm, h, wrong);
  CartesianTarget t = here(arm, bent);
  t.position[0] += 0.3;
  CartesianCommand x, y;
  for (int k = 0; k < 50; ++k) x = a.step(t, bent, {}), y = b.step(t, bent, {});
  const ToolState tool(arm, bent, {});
  const Vec3<double> F = Arm::to_vec(x.force), RRF = tool.R * (tool.R * F);
  JointVector difference{};
  tool.add_wrench(RRF - F, {}, 7, difference);
  for (std::size_t j = 0; j < 7; ++j) EXPECT_NEAR(y.joints.torque[j] - x.joints.torque[j], difference[j], 1e-9);
}

struct Course {
  double distance, longest_torque, turned, largest_force;
};
Course travel(const Arm& arm, const CartesianVelocityConfig& config, const Vec3<double>& way, double seconds, double period) {
  Plant plant{&arm, bent};
  CartesianVelocity controller(arm, period, config);
  CartesianTarget t = here(arm, bent);
  for (std::size_t i = 0; i < 3; ++i) t.position[i] += three(way)[i];
  Course out{};
  for (int k = 0; k < static_cast<int>(seconds / period); ++k) {
    const CartesianCommand c = controller.step(t, plant.q, plant.dq);
    out.largest_force = std::max(out.largest_force, norm(c.force));
    out.longest_torque = std::max(out.longest_torque, norm(c.torque));
    plant.advance(c.joints.torque, period, 0.004);
  }
  const ToolState end(arm, plant.q, plant.dq);
  const Vec3<double> d = Arm::to_vec(t.position) - end.x, phi = rotation_vector(Arm::to_mat(t.orientation) * transpose(end.R));
  out.distance = std::sqrt(dot(d, d));
  out.turned = std::sqrt(dot(phi, phi));
  return out;
}

TEST(CartesianVelocity, StopsWithinTwoMillimetresOfTheGoal) {
  const Arm arm = redundant_arm();
  for (double period : {0.001, 0.004, 0.008})
    for (const Vec3<double>& way : {Vec3<double>{0.1, -0.15, -0.1}, Vec3<double>{-0.1, 0.1, 0.05}, Vec3<double>{0.0, 0.0, -0.01}}) {
      const Course c = travel(arm, {}, way, 12.0, period);
      EXPECT_LT(c.distance, 0.002) << period;
      EXPECT_LT(c.turned, 0.02) << period;
      EXPECT_LE(c.largest_force, 5.0);
    }
}

TEST(CartesianVelocity, ThePublishedHeadingControllerDoesNotStop) {
  const Arm arm = redundant_arm();
  EXPECT_GT(travel(arm, CartesianVelocityConfig::published(VelocityAxes::heading), {0.1, -0.15, -0.1}, 30.0, 0.008).distance, 0.02);
}

TEST(CartesianVelocity, TurnsTheToolWherePointed) {
  const Arm arm = redundant_arm();
  Plant plant{&arm, bent};
  CartesianVelocity controller(arm, h);
  CartesianTarget t = here(arm, bent);
  t.orientation = rows(rotation({0.2, -0.3, 0.25}) * Arm::to_mat(t.orientation));
  for (int k = 0; k < 2000; ++k) plant.advance(controller.step(t, plant.q, plant.dq).joints.torque, h, h);
  const ToolState end(arm, plant.q, plant.dq);
  const Vec3<double> phi = rotation_vector(Arm::to_mat(t.orientation) * transpose(end.R));
  EXPECT_LT(std::sqrt(dot(phi, phi)), 0.005);
}

/// Felt on a board at z0: spring, damper and friction at the tool point; `push` [N] beside it.
struct Board {
  const Arm& arm;
  Plant plant;
  double z0, stiffness = 3000.0, damping = 50.0, friction = 0.3;
  Vec3<double> contact{};

  void advance(const JointVector& tau, const Vec3<double>& push) {
    for (int i = 0; i < 8; ++i) {
      const ToolState t(arm, plant.q, plant.dq);
      const double depth = z0 - t.x.z, N = depth > 0.0 ? std::max(0.0, stiffness * depth - damping * t.v.z) : 0.0;
      const double slip = std::max(0.002, std::hypot(t.v.x, t.v.y));
      contact = {-friction * N * t.v.x / slip, -friction * N * t.v.y / slip, N};
      plant.push = {};
      t.add_wrench(contact + push, {}, 7, plant.push);
      plant.advance(tau, h / 8, h / 8);
    }
  }
};
/// Wipes back and forth; `each(t, command, board, force)` sees every step, `push(t)` pushes.
void wipe(double speed, double force, double seconds, const std::function<Vec3<double>(double)>& push,
          const std::function<void(double, const CartesianCommand&, const Board&)>& each) {
  const Arm arm = redundant_arm();
  JointVector q{-0.25, 0.66, -0.03, -1.53, 0.02, 0.95, -0.28};
  const ToolState start(arm, q, {});
  Board board{arm, {&arm, q}, start.x.z - 0.01};
  CartesianVelocity controller(arm, h);
  CartesianTarget t = here(arm, q);
  t.normal_force = force;
  t.speed = 0.25;
  Vec3<double> felt{}, pushed{};
  for (int k = 0; k < static_cast<int>(seconds / h); ++k) {
    const double time = k * h, phase = std::max(0.0, time - 2.0), w = 4.0;  // 2 s to come down
    t.velocity = {0.0, phase > 0.0 ? speed * std::sin(w * phase / 2) : 0.0, 0.0};
    t.position[1] = three(start.x)[1] + speed * 2 / w * (1.0 - std::cos(w * phase / 2));
    felt = felt + 0.25 * (board.contact + pushed - felt);  // an estimate is late
    Wrench external;
    external.status = Status::ok;
    external.force = three(felt);
    const CartesianCommand c = controller.step(t, board.plant.q, board.plant.dq, external);
    pushed = push(time);
    board.advance(c.joints.torque, pushed);
    each(time, c, board);
  }
}

TEST(CartesianVelocity, PressesWithinHalfANewtonWhileItWipes) {
  for (const auto& [speed, tolerance] : {std::pair{0.1, 0.5}, {0.25, 1.0}}) {
    int inside = 0, count = 0;
    double most = 0.0;
    wipe(speed, 2.5, 10.0, [](double) { return Vec3<double>{}; }, [&](double time, const CartesianCommand& c, const Board& b) {
      EXPECT_LE(norm(c.force), 5.0);
      most = std::max(most, b.contact.z);
      if (time > 2.0) inside += std::abs(b.contact.z - 2.5) <= tolerance, ++count;
    });
    EXPECT_GE(inside, 0.95 * count) << speed;
    EXPECT_LE(most, 6.0);
  }
}

TEST(CartesianVelocity, YieldsToAPushInsteadOfPushingBack) {
  for (const Vec3<double>& push : {Vec3<double>{30, 0, 0}, Vec3<double>{0, -30, 0}, Vec3<double>{0, 0, 30}}) {
    double along = 0.0, during = 0.0, fastest = 0.0, after = 0.0;
    bool yielded = false, resumed = false;
    wipe(0.1, 2.5, 12.0, [&](double time) { return time >= 4.0 && time < 4.5 ? push : Vec3<double>{}; },
         [&](double time, const CartesianCommand& c, const Board& b) {
           EXPECT_LE(norm(c.force), 5.0);
           if (time >= 4.05 && time < 4.5) {
             during = std::max(during, norm(c.force));
             yielded = yielded || c.yielding;
             along += h * dot(Arm::to_vec(c.velocity), push) / 30.0;
           }
           if (time > 4.0) fastest = std::max(fastest, norm(c.velocity));
           if (time > 4.5) after = std::max(after, b.contact.z);
           resumed = time > 11.0 && !c.yielding;
         });
    EXPECT_TRUE(yielded);
    EXPECT_EQ(during, 0.0);   // nothing is commanded against the push
    EXPECT_GT(along, 0.05);   // it gives way
    EXPECT_LT(fastest, 1.0);  // and is not thrown
    EXPECT_LE(after, 6.0);
    EXPECT_TRUE(resumed);
  }
}

TEST(CartesianVelocity, ATorqueChannelLostWhilePressingStopsWithinAStep) {
  const Arm arm = redundant_arm();
  CartesianVelocity controller(arm, h);
  CartesianTarget t = here(arm, bent);
  t.normal_force = 3.0;
  t.position[0] += 0.1;
  Wrench w;
  w.status = Status::ok;
  CartesianCommand c = controller.step(t, bent, {}, w);
  EXPECT_EQ(c.joints.status, Status::ok);
  EXPECT_GT(norm(c.force), 1.0);
  for (Status lost : {Status::non_finite, Status::held, Status::warming, Status::gap}) {
    w.status = lost;
    c = controller.step(t, bent, {}, w);
    EXPECT_EQ(c.joints.status, Status::held);
    EXPECT_EQ(norm(c.force), 0.0);
  }
  t.normal_force = 0.0;  // free motion needs no force
  EXPECT_EQ(controller.step(t, bent, {}, w).joints.status, Status::ok);
}

TEST(CartesianVelocity, WithoutAStateTheArmFloats) {
  const Arm arm = redundant_arm();
  CartesianVelocity controller(arm, h);
  CartesianTarget t = here(arm, bent);
  t.position[0] += 0.1;
  const JointVector gravity = gravity_torque<double>(arm, bent);
  for (int k = 0; k < 100; ++k) (void)controller.step(t, bent, {});
  JointVector bad = bent;
  bad[3] = nan;
  EXPECT_EQ(controller.step(t, bad, {}).joints.torque, gravity);
  EXPECT_EQ(controller.step(t, bent, bad).joints.torque, gravity);
  t.orientation[0] = 2.0;  // no rotation
  const CartesianCommand c = controller.step(t, bent, {});
  EXPECT_EQ(c.joints.status, Status::non_finite);
  EXPECT_EQ(norm(c.force), 0.0);
  EXPECT_EQ(controller.abag(0).b, 0.0);  // nothing learnt before pushes on afterwards
}

TEST(CartesianVelocity, ChunkedRunIsWholeRunResetIsNewAndNothingIsAllocated) {
  const Arm arm = redundant_arm();
  CartesianVelocity whole(arm, h), chunk(arm, h);
  CartesianTarget t = here(arm, bent);
  t.position[1] += 0.1;
  Wrench w;
  w.status = Status::ok;
  w.force = {0.0, 0.0, 20.0};
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 50; ++k) (void)chunk.step(t, bent, bent, w);
  chunk.reset();
  for (int k = 0; k < 200; ++k) {
    t.normal_force = k % 50 < 25 ? 0.0 : 2.0;
    w.force = {0.0, 0.0, k % 70 == 0 ? 30.0 : 2.0};
    if (k == 100) chunk = CartesianVelocity(chunk);
    EXPECT_EQ(whole.step(t, bent, {}, w).joints.torque, chunk.step(t, bent, {}, w).joints.torque);
  }
  EXPECT_EQ(counter.count(), 0u);
}

TEST(CartesianImpedance, HoldsItsPoseAndPushesWithoutBound) {
  const Arm arm = redundant_arm();
  Plant plant{&arm, bent};
  CartesianImpedance controller(arm);
  CartesianTarget t = here(arm, bent);
  t.position[0] += 0.05;
  const auto first = controller.step(t.position, t.orientation, {}, plant.q, plant.dq);
  EXPECT_NEAR(first.force[0], 25.0, 1e-9);
  for (int k = 0; k < 1500; ++k) plant.advance(controller.step(t.position, t.orientation, {}, plant.q, plant.dq).joints.torque, h, h);
  const Vec3<double> d = Arm::to_vec(t.position) - ToolState(arm, plant.q, plant.dq).x;
  EXPECT_LT(std::sqrt(dot(d, d)), 1e-4);
  t.position[2] -= 0.5;
  EXPECT_GT(norm(controller.step(t.position, t.orientation, {}, plant.q, plant.dq).force), 200.0);
  EXPECT_EQ(controller.step({nan, 0, 0}, t.orientation, {}, plant.q, plant.dq).joints.status, Status::non_finite);
}

TEST(Cartesian, ConstructorsNameWhatIsWrong) {
  const Arm arm = redundant_arm();
  const auto message = [](const std::function<void()>& make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([&] { CartesianVelocity(arm, 0.0); }), "CartesianVelocity period [s] = 0: expected a finite number > 0");
  EXPECT_EQ(message([&] { CartesianVelocity(arm, h, {.max_force = nan}); }), "CartesianVelocityConfig max_force [N] = nan: expected a finite number > 0");
  EXPECT_EQ(message([&] { CartesianImpedance(arm, {.stiffness = {1, -1, 1}}); }),
            "CartesianImpedanceConfig stiffness[1] [N/m] = -1: expected a finite number >= 0");
}

}  // namespace
