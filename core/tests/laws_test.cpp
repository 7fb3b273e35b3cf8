// The laws that every disturbance observer obeys, whatever its kind. What only one of them promises: observers_test.cpp.
#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "palpate/conditioner.hpp"
#include "palpate/observers/disturbance_kalman.hpp"
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/observers/inverse_dynamics.hpp"
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/momentum_super_twisting.hpp"
#include "palpate/observers/sliding_mode.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::Plant;
using palpate_test::Random;
using palpate_test::Recording;
using palpate_test::Scene;
using palpate_test::simulate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

/// What an observer must be prepared for: some have gains that depend on it.
struct Task {
  JointVector q0{};    // about where [rad]
  JointVector push{};  // about the largest tau_ext [N m]
};
JointVector only(int joint, double push) {
  JointVector tau{};
  tau[at(joint)] = push;
  return tau;
}
double largest(const JointVector& x) {
  double most = 0.0;
  for (double a : x) most = std::max(most, std::abs(a));
  return most;
}

// One per observer: how it is made; how it is moved; how near the truth it must come, as a part of the largest torque plus a
// part of Coulomb friction.
struct InverseDynamicsCase {
  using Observer = InverseDynamicsObserver;
  static Observer make(const Arm& arm, const Task&) { return Observer(arm); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};
struct ModelResidualCase {
  using Observer = ModelResidualObserver;
  static Observer make(const Arm& arm, const Task&) { return Observer(arm); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};
/// Its M(q) LPF(..) is late in motion, and its velocity chatters by about alpha dt, which blurs Coulomb friction near rest.
template <Solver solver, bool smooth>
struct SlidingModeCase {
  using Observer = SlidingModeObserver;
  static Observer make(const Arm& arm, const Task& task) {
    const double alpha = 2.5 * std::max(1.0, largest(Cholesky<double>(mass_matrix<double>(arm, task.q0), arm.n()).solve(task.push)));
    SlidingModeConfig c{.lambda = 3.0 * std::sqrt(alpha), .alpha = alpha, .cutoff = 15.0, .solver = solver};
    if (!smooth) c.gamma = 0.0, c.substeps = 8;
    return Observer(arm, c);
  }
  static constexpr double swing = 0.05, accuracy = smooth ? 0.06 : 0.12, blur = 1.0;
};
struct MomentumCase {
  using Observer = MomentumObserver;
  static Observer make(const Arm& arm, const Task&) { return Observer(arm); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};
struct SuperTwistingCase {
  using Observer = MomentumSuperTwisting;
  static Observer make(const Arm& arm, const Task& task) { return Observer(arm, {.max_rate = 50.0 * std::max(1.0, largest(task.push))}); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};
struct DisturbanceKalmanCase {
  using Observer = DisturbanceKalman;
  static Observer make(const Arm& arm, const Task&) { return Observer(arm); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};
struct ExtendedKalmanCase {
  using Observer = ExtendedKalman;
  static Observer make(const Arm& arm, const Task&) { return Observer(arm); }
  static constexpr double swing = 0.3, accuracy = 1e-3, blur = 0.0;
};

using Cases =
    ::testing::Types<InverseDynamicsCase, ModelResidualCase, SlidingModeCase<Solver::euler, true>, SlidingModeCase<Solver::rk4, true>,
                     SlidingModeCase<Solver::dormand_prince, true>, SlidingModeCase<Solver::euler, false>,
                     SlidingModeCase<Solver::rk4, false>, SlidingModeCase<Solver::dormand_prince, false>, MomentumCase, SuperTwistingCase,
                     DisturbanceKalmanCase, ExtendedKalmanCase>;

constexpr double coulomb = 0.3;  // [N m]

/// A physical arm with friction and fine sensors. Joint 5 of the random arms is prismatic.
ArmDescription description(int n, std::uint64_t seed = 3) {
  Random r(seed);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.rotor_inertia = 0.1;
    J.friction = {.coulomb = coulomb, .viscous = 0.5, .offset = 0.1, .sign_velocity = 0.05};
    J.position_std = 1e-6;
    J.torque_std = 1e-3;
  }
  return d;
}
JointVector pose(int n) {
  JointVector q{};
  for (int j = 0; j < n; ++j) q[at(j)] = 0.4 - 0.3 * (j % 3);
  return q;
}

template <class Observer>
ExternalTorque feed(Observer& observer, const std::vector<JointSample>& samples) {
  ExternalTorque out;
  for (const JointSample& s : samples) out = observer.step(s);
  return out;
}
void expect_same(const ExternalTorque& a, const ExternalTorque& b) {
  EXPECT_EQ(a.torque, b.torque);
  EXPECT_EQ(a.std, b.std);
  EXPECT_EQ(a.status, b.status);
}

template <class Case>
class Laws : public ::testing::Test {
 protected:
  static double tolerance(double push) { return Case::accuracy * push + Case::blur * coulomb; }

  /// A constant push on every joint in turn while the arm swings, forward and backward; the last third of the run is judged.
  static void expect_push_recovered(const Arm& arm, Scene scene = {}) {
    const double push = 5.0;
    const int n = arm.n();
    scene.q0 = pose(n);
    scene.swing = Case::swing;
    for (int joint = 0; joint < n; ++joint) {
      const JointVector truth = only(joint, joint % 2 ? -push : push);
      SCOPED_TRACE("push on joint " + std::to_string(joint + 1));
      scene.events = [&](double, Plant& plant) { plant.push = truth; };
      const Recording data = simulate(arm, scene);
      auto observer = Case::make(arm, {scene.q0, truth});
      double worst = 0.0;
      for (std::size_t k = 0; k < data.samples.size(); ++k) {
        const ExternalTorque seen = observer.step(data.samples[k]);
        if (3 * k < 2 * data.samples.size()) continue;
        ASSERT_EQ(seen.status, Status::ok) << name(seen.status) << " at sample " << k;
        ASSERT_GT(seen.torque[at(joint)] * truth[at(joint)], 0.0) << "a push forward is positive";
        for (int j = 0; j < n; ++j) worst = std::max(worst, std::abs(seen.torque[at(j)] - truth[at(j)]));
      }
      EXPECT_LT(worst, tolerance(push));
    }
  }
};
TYPED_TEST_SUITE(Laws, Cases);

TYPED_TEST(Laws, IsADisturbanceObserver) {
  using Observer = typename TypeParam::Observer;
  static_assert(DisturbanceObserver<Observer>);
  static_assert(noexcept(std::declval<Observer&>().step(std::declval<const JointSample&>())));
  static_assert(std::is_copy_constructible_v<Observer> && std::is_copy_assignable_v<Observer>);
}

TYPED_TEST(Laws, NothingInNothingOut) {  // at rest, held by the gravity torque
  const Arm arm(description(4));
  const Scene scene{.swing = 0.0, .q0 = pose(4)};
  auto observer = TypeParam::make(arm, {scene.q0, {}});
  double worst = 0.0;
  for (const JointSample& s : simulate(arm, scene).samples) worst = std::max(worst, largest(observer.step(s).torque));
  EXPECT_LE(worst, 1e-9);
}

TYPED_TEST(Laws, AConstantPushIsRecovered) { this->expect_push_recovered(Arm(description(4))); }

TYPED_TEST(Laws, OneJointIsEnough) { this->expect_push_recovered(Arm(description(1))); }

TYPED_TEST(Laws, APrismaticJointIsAJoint) {
  ArmDescription d = description(3);
  d.joints[1].prismatic = true;
  this->expect_push_recovered(Arm(d));
}

TYPED_TEST(Laws, AnyMount) {  // upright, hanging, tilted, in orbit
  for (const std::array<double, 3>& gravity : {std::array{0.0, 0.0, -9.81}, {0.0, 0.0, 9.81}, {-6.0, 3.0, -7.0}, {0.0, 0.0, 0.0}}) {
    ArmDescription d = description(3);
    d.gravity = gravity;
    this->expect_push_recovered(Arm(d));
  }
}

TYPED_TEST(Laws, AnySampleRate) {
  for (const Scene& scene : {Scene{.rate = 100.0}, {.rate = 1000.0}, {.rate = 250.0, .jitter = 0.6}}) {
    SCOPED_TRACE(std::to_string(scene.rate) + " Hz, jitter " + std::to_string(scene.jitter));
    this->expect_push_recovered(Arm(description(2)), scene);
  }
}

TYPED_TEST(Laws, SixteenJoints) {
  ArmDescription d = description(16);
  for (JointDescription& J : d.joints) {  // a snake, not a crane
    for (double& x : J.T_parent_joint.p) x *= 0.2;
    J.mass *= 0.2;
    for (double& x : J.inertia) x *= 0.2;
  }
  const Arm arm(d);
  Scene scene{.swing = 0.0, .q0 = pose(16)};
  JointVector push{};
  for (int j = 0; j < 16; ++j) push[at(j)] = j % 2 ? -3.0 : 3.0;
  scene.events = [&](double, Plant& plant) { plant.push = push; };
  const Recording data = simulate(arm, scene);
  auto observer = TypeParam::make(arm, {scene.q0, push});
  const ExternalTorque seen = feed(observer, data.samples);
  EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
  for (int j = 0; j < 16; ++j) EXPECT_NEAR(seen.torque[at(j)], push[at(j)], 2.0 * this->tolerance(5.0)) << j;
}

TYPED_TEST(Laws, AHeldMassIsItsWeightAtTheGraspPoint) {
  for (const std::array<double, 3>& gravity : {std::array{0.0, 0.0, -9.81}, {0.0, 0.0, 9.81}, {-6.0, 3.0, -7.0}}) {
    ArmDescription d = description(4);
    d.gravity = gravity;
    const Arm arm(d);
    Scene scene{.seconds = 3.0, .swing = 0.0, .q0 = pose(4)};
    const double mass = 1.5;
    scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, mass); };
    const Recording data = simulate(arm, scene);
    const JointVector weight = palpate_test::weight_torque(arm, data.samples.back().q, mass);
    auto observer = TypeParam::make(arm, {scene.q0, weight});
    const ExternalTorque seen = feed(observer, data.samples);
    EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
    for (int j = 0; j < 4; ++j) EXPECT_NEAR(seen.torque[at(j)], weight[at(j)], this->tolerance(largest(weight))) << j;
  }
}

TYPED_TEST(Laws, ARunInPiecesIsTheWholeRun) {
  const Arm arm(description(4));
  Scene scene{.seconds = 1.0, .jitter = 0.3, .swing = TypeParam::swing, .q0 = pose(4)};
  scene.events = [&](double t, Plant& plant) { plant.push[1] = t > 0.5 ? 4.0 : 0.0; };
  const Recording data = simulate(arm, scene);
  auto whole = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  auto piece = whole;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    if (k % 37 == 0) {
      auto next = piece;  // handed over
      piece = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
      piece = next;
    }
    expect_same(piece.step(data.samples[k]), whole.step(data.samples[k]));
  }
}

TYPED_TEST(Laws, ResetIsNew) {
  const Arm arm(description(4));
  Scene scene{.seconds = 1.0, .swing = TypeParam::swing, .q0 = pose(4)};
  scene.events = [&](double, Plant& plant) { plant.push[1] = 4.0; };
  const Recording data = simulate(arm, scene);
  auto fresh = TypeParam::make(arm, {scene.q0, only(1, 5.0)}), used = fresh;
  (void)feed(used, data.samples);
  used.reset();
  for (const JointSample& s : data.samples) expect_same(used.step(s), fresh.step(s));
}

TYPED_TEST(Laws, WarmsFirstAndIsNeverFarFromTheTruthOnceItSaysOk) {
  const Arm arm(description(4));
  Scene scene{.seconds = 3.0, .swing = TypeParam::swing, .q0 = pose(4)};
  const JointVector push{6.0, -5.0, 4.0, -6.0};
  scene.events = [&](double, Plant& plant) { plant.push = push; };
  const Recording data = simulate(arm, scene);
  auto observer = TypeParam::make(arm, {scene.q0, push});
  bool been_ok = false;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    const ExternalTorque seen = observer.step(data.samples[k]);
    if (k == 0) EXPECT_EQ(seen.status, Status::warming);
    been_ok = been_ok || seen.status == Status::ok;
    if (seen.status == Status::ok)
      for (int j = 0; j < 4; ++j) ASSERT_NEAR(seen.torque[at(j)], push[at(j)], 0.1 * 6.0 + 3.0 * seen.std[at(j)]) << "sample " << k;
    else EXPECT_FALSE(been_ok) << name(seen.status) << " at sample " << k;
  }
  EXPECT_TRUE(been_ok);
}

TYPED_TEST(Laws, ARefusedSampleIsHeldAndChangesNothing) {
  const Arm arm(description(4));
  Scene scene{.seconds = 1.2, .swing = TypeParam::swing, .q0 = pose(4)};
  scene.events = [&](double, Plant& plant) { plant.push[1] = 4.0; };
  const Recording data = simulate(arm, scene);
  auto clean = TypeParam::make(arm, {scene.q0, only(1, 5.0)}), dirty = clean;
  ExternalTorque last;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    for (Status why : {Status::non_finite, Status::time_error})
      if (k % 7 == 3) {
        JointSample bad = data.samples[k];
        bad.status = why;
        bad.dt = 0.0;
        for (double junk : {nan, inf, -1e300}) {
          bad.q[2] = bad.dq[0] = bad.tau[1] = bad.model_torque[3] = junk;
          const ExternalTorque held = dirty.step(bad);
          EXPECT_EQ(held.status, Status::held);
          EXPECT_EQ(held.torque, last.torque);
        }
      }
    last = dirty.step(data.samples[k]);
    expect_same(last, clean.step(data.samples[k]));
  }
  EXPECT_EQ(last.status, Status::ok);
}

TYPED_TEST(Laws, ARefusedFirstSampleIsHeldToo) {
  const Arm arm(description(4));
  auto observer = TypeParam::make(arm, {pose(4), only(1, 5.0)});
  JointSample bad;
  bad.status = Status::non_finite;
  bad.q.fill(nan);
  const ExternalTorque held = observer.step(bad);
  EXPECT_EQ(held.status, Status::held);
  EXPECT_EQ(held.torque, JointVector{});
}

TYPED_TEST(Laws, AfterAGapItIsRightOrSaysNotYet) {
  const Arm arm(description(3));
  Scene scene{.seconds = 4.0, .swing = TypeParam::swing, .q0 = pose(3)};
  scene.events = [&](double t, Plant& plant) { plant.push[1] = t < 1.5 ? 5.0 : -5.0; };  // it changes in the gap
  const Recording data = simulate(arm, scene);
  auto observer = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  std::int64_t before = 0;
  ExternalTorque seen;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    JointSample s = data.samples[k];
    const double t = static_cast<double>(s.time_ns) / 1e9;
    if (t > 1.3 && t < 1.8) continue;
    s.dt = k == 0 ? 0.0 : static_cast<double>(s.time_ns - before) / 1e9;
    s.status = s.dt > 0.1 ? Status::gap : Status::ok;
    before = s.time_ns;
    seen = observer.step(s);
    if (s.status == Status::gap) EXPECT_EQ(seen.status, Status::gap);
    if (t > 1.75 && seen.status == Status::ok)
      for (int j = 0; j < 3; ++j)
        ASSERT_NEAR(seen.torque[at(j)], data.push[k][at(j)], 0.1 * 5.0 + 3.0 * seen.std[at(j)]) << "joint " << j + 1 << ", t = " << t;
  }
  EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
  EXPECT_NEAR(seen.torque[1], -5.0, this->tolerance(5.0));
}

/// What a conditioner makes of positions and torques alone.
std::vector<JointSample> without_velocity(const Arm& arm, const std::vector<RawSample>& raw) {
  JointVector gain{};
  gain.fill(1.0);
  Conditioner conditioner(arm.n(), gain);
  std::vector<JointSample> out;
  for (RawSample sample : raw) {
    sample.has_velocity = false;
    JointSample s = conditioner.step(sample);
    for (int j = 0; j < arm.n(); ++j) s.dq_std[at(j)] = conditioner.velocity_noise_gain() * std::sqrt(arm.position_variance(j));
    out.push_back(s);
  }
  return out;
}

TYPED_TEST(Laws, PositionsAloneWillDo) {
  const Arm arm(description(4));
  Scene scene{.swing = TypeParam::swing, .q0 = pose(4)};
  const JointVector push = only(1, 5.0);
  scene.events = [&](double, Plant& plant) { plant.push = push; };
  auto observer = TypeParam::make(arm, {scene.q0, push});
  const ExternalTorque seen = feed(observer, without_velocity(arm, simulate(arm, scene).raw));
  EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
  for (int j = 0; j < 4; ++j) EXPECT_NEAR(seen.torque[at(j)], push[at(j)], 0.05 * 5.0 + this->tolerance(5.0)) << j;
}

TYPED_TEST(Laws, WithPositionsAloneAStartOrAGapInMotionIsNoPush) {  // there the velocity of the first sample is not known
  const Arm arm(description(4));
  Scene scene{.seconds = 4.0, .swing = 4.0 * TypeParam::swing, .q0 = pose(4)};
  std::vector<RawSample> raw = simulate(arm, scene).raw;
  std::erase_if(raw,
                [](const RawSample& r) { return r.time_ns < 500'000'000 || (r.time_ns > 2'000'000'000 && r.time_ns < 2'300'000'000); });
  auto observer = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  ExternalTorque seen;
  for (const JointSample& s : without_velocity(arm, raw)) {
    seen = observer.step(s);
    if (seen.status == Status::ok)
      for (int j = 0; j < 4; ++j)
        ASSERT_NEAR(seen.torque[at(j)], 0.0, 0.05 * 5.0 + this->tolerance(5.0) + 3.0 * seen.std[at(j)])
            << "joint " << j + 1 << ", t = " << static_cast<double>(s.time_ns) / 1e9;
  }
  EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
}

TYPED_TEST(Laws, ANewTimeBaseIsAGapOfUnknownLength) {
  const Arm arm(description(3));
  Scene scene{.seconds = 2.5, .swing = TypeParam::swing, .q0 = pose(3)};
  scene.events = [&](double, Plant& plant) { plant.push[1] = 5.0; };
  const Recording data = simulate(arm, scene);
  auto observer = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  ExternalTorque seen;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    JointSample s = data.samples[k];
    if (k == 300) s.dt = 0.0, s.status = Status::gap;  // what the conditioner makes of a clock set back
    seen = observer.step(s);
    if (k == 300) EXPECT_EQ(seen.status, Status::gap);
  }
  EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
  EXPECT_NEAR(seen.torque[1], 5.0, this->tolerance(5.0));
}

TYPED_TEST(Laws, AllocatesNothing) {
  const Arm arm(description(7));
  Scene scene{.seconds = 0.5, .swing = TypeParam::swing, .q0 = pose(7)};
  Recording data = simulate(arm, scene);
  for (std::size_t k = 20; k < data.samples.size(); k += 20) data.samples[k].status = k % 40 ? Status::gap : Status::non_finite;
  auto observer = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  palpate::test::AllocationCounter counter;
  (void)feed(observer, data.samples);
  EXPECT_EQ(counter.count(), 0u);
}

TYPED_TEST(Laws, UnusedEntriesStayZero) {
  const Arm arm(description(3));
  Scene scene{.seconds = 0.3, .swing = TypeParam::swing, .q0 = pose(3)};
  scene.events = [&](double, Plant& plant) { plant.push[1] = 4.0; };
  auto observer = TypeParam::make(arm, {scene.q0, only(1, 5.0)});
  const ExternalTorque seen = feed(observer, simulate(arm, scene).samples);
  for (std::size_t j = 3; j < max_joints; ++j) {
    EXPECT_EQ(seen.torque[j], 0.0);
    EXPECT_EQ(seen.std[j], 0.0);
  }
}

}  // namespace
