// The shared Kalman filter: its step against closed forms, its F against differences, its covariance over long runs.
#include "palpate/kalman.hpp"

#include <gtest/gtest.h>

#include "no_alloc.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::Random;

namespace {

constexpr int parameters = 4 + 2 * max_joints;
using Filter = JointKalman<parameters>;
using State = std::array<double, Filter::max_dim>;

ArmDescription turntable(double inertia, const Friction& friction) {
  ArmDescription d;
  d.n = 1;
  d.joints[0].mass = 1.0;
  d.joints[0].inertia = {inertia, 0.0, 0.0, inertia, 0.0, inertia};
  d.joints[0].friction = friction;
  return d;
}

/// Bodies that unit parameters stand for: mass at the grasp point, and its first moment along each tip axis.
std::array<Inertia<double>, 4> unit_loads(const Arm& arm) {
  const Vec3<double> c = arm.p_last_grasp();
  const Mat3<double> R = arm.R_last_tip();
  const std::array<Vec3<double>, 3> axes{R.cx, R.cy, R.cz};
  std::array<Inertia<double>, 4> out{about_origin(1.0, c, Sym3<double>{})};
  for (std::size_t k = 0; k < 3; ++k) out[k + 1] = {0.0, axes[k], parallel_axis(axes[k], c)};
  return out;
}

/// A filter with every kind of parameter, and what its predictions need.
struct Rig {
  explicit Rig(const Arm& a, int number_of_loads = 4, bool torques = true, bool encoders = true)
      : arm(a), loads(number_of_loads), units(unit_loads(a)), filter(a.n(), number_of_loads, torques, encoders) {
    decay.fill(1.0);
  }
  int dim() const { return filter.dim(); }
  State state() const {
    State x{};
    for (int i = 0; i < dim(); ++i)
      x[at(i)] = i < arm.n() ? filter.q(i) : i < 2 * arm.n() ? filter.dq(i - arm.n()) : filter.parameter(i - 2 * arm.n());
    return x;
  }
  void predict(double h, const JointVector& tau) {
    Inertia<double> load{};
    for (int k = 0; k < loads; ++k) load = load + filter.parameter(k) * units[at(k)];
    const Inertia<double> real = load.m > 0.0 ? load : Inertia<double>{};  // no body has negative mass
    filter.predict(arm, {tau, torque_variance, real, load + (-1.0) * real, decay}, h, [&](const BaseFrame& chain, double* D, int stride) {
      for (int p = 0; p < loads; ++p) {
        const JointVector column = chain.body_torque(arm.n() - 1, moved(chain.pose().R, chain.pose().p, units[at(p)]));
        for (int i = 0; i < arm.n(); ++i) D[i * stride + p] = column[at(i)];
      }
    });
  }
  JointMatrix correlation() const {  // of the dynamic states; the diagonal is 1
    JointMatrix C{};
    for (int r = 0; r < dim(); ++r)
      for (int c = 0; c < dim(); ++c) C(r, c) = filter.covariance(r, c) / std::sqrt(filter.variance(r) * filter.variance(c));
    return C;
  }

  const Arm& arm;
  int loads;
  std::array<Inertia<double>, 4> units;
  Filter filter;
  Filter::Parameters decay{};
  JointVector torque_variance{};
};

Arm random_arm(Random& r, int n, const Friction& friction) {
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    d.joints[at(j)].friction = friction;
    d.joints[at(j)].position_resolution = 1e-3;
    d.joints[at(j)].position_std = 1e-4;
  }
  return Arm(d);
}

/// Largest difference between propagate() and central differences of predict(), relative to the largest entry of its row.
double worst_derivative(const Arm& arm, Random& r, double h) {
  const int n = arm.n();
  Rig rig(arm);
  JointVector tau{};
  for (int i = 0; i < n; ++i) {
    rig.filter.set(i, r(-3, 3), 0.0);  // no variance: it blurs friction near rest
    rig.filter.set(n + i, r(0.5, 2) * (r(-1, 1) > 0 ? 1 : -1), 0.0);
    rig.filter.set_parameter(4 + i, r(-1, 1), 0.0);
    rig.filter.set_parameter(4 + n + i, r(-1e-3, 1e-3), 0.0);
    tau[at(i)] = r(-10, 10);
  }
  rig.filter.set_parameter(0, r(0.5, 2), 0.0);
  for (int k = 1; k < 4; ++k) rig.filter.set_parameter(k, r(-0.1, 0.1), 0.0);
  for (int k = 0; k < 4 + n; ++k) rig.decay[at(k)] = r(0.9, 1.0);
  const State x = rig.state();
  Rig base = rig;
  base.predict(h, tau);
  double worst = 0.0;
  std::vector<State> exact, difference;
  for (int c = 0; c < rig.dim() - n; ++c) {  // the encoder errors' decay depends on the motion by intention
    const double eps = 1e-5;
    State e{};
    e[at(c)] = 1.0;
    base.filter.propagate(e);
    Rig up = rig, down = rig;
    up.filter.set(c, x[at(c)] + eps, 0.0);
    down.filter.set(c, x[at(c)] - eps, 0.0);
    up.predict(h, tau);
    down.predict(h, tau);
    State d = up.state();
    for (int i = 0; i < rig.dim(); ++i) d[at(i)] = (d[at(i)] - down.state()[at(i)]) / (2 * eps);
    exact.push_back(e);
    difference.push_back(d);
  }
  for (int i = 0; i < rig.dim() - n; ++i) {
    double scale = 0.0, error = 0.0;
    for (std::size_t c = 0; c < exact.size(); ++c) {
      scale = std::max(scale, std::abs(difference[c][at(i)]));
      error = std::max(error, std::abs(difference[c][at(i)] - exact[c][at(i)]));
    }
    worst = std::max(worst, error / scale);
  }
  return worst;
}

TEST(JointKalman, ItsFIsTheDerivativeOfItsStep) {
  // F - 1 is of order h. What F may leave out (the derivative of the weight Theta, of a midpoint velocity) is of order h^2:
  // a step a tenth as long must then be at least thirty times as exact.
  const auto compare = [](const char* what, const Friction& friction) {
    double coarse = 0.0, fine = 0.0;
    for (std::uint64_t seed = 1; seed <= 4; ++seed)
      for (int n : {1, 3, 7}) {
        Random a = palpate_test::independent(seed), b = a;
        const Arm arm = random_arm(a, n, friction);
        (void)random_arm(b, n, friction);
        coarse = std::max(coarse, worst_derivative(arm, a, 4e-3));
        fine = std::max(fine, worst_derivative(arm, b, 4e-4));
      }
    std::printf("F against differences, %s: %.1e at 4 ms, %.1e at 0.4 ms\n", what, coarse, fine);
    EXPECT_LT(coarse, 5e-3) << what;
    EXPECT_LT(fine, std::max(1e-7, coarse / 30.0)) << what;
  };
  compare("no friction", {});
  compare("viscous friction", {.viscous = 2.0});
  compare("Coulomb friction in motion", {.coulomb = 1.0, .viscous = 0.5});
}

TEST(JointKalman, StepsConvergeToTheMotion) {  // first order in Coriolis torque, which is taken at the start of the step
  Random r(2);
  const Arm arm = random_arm(r, 3, {});
  std::array<double, 3> error{};
  const JointVector q{0.3, -0.2, 0.5}, dq{0.8, -1.0, 0.4}, tau{2.0, -1.0, 0.5};
  palpate_test::Plant truth{&arm, q, dq};
  truth.advance(tau, 0.2, 1e-4);
  for (std::size_t k = 0; k < 3; ++k) {
    const int steps = 20 << k;
    Rig rig(arm, 0, false, false);
    for (int i = 0; i < 3; ++i) rig.filter.set(i, q[at(i)], 0.0), rig.filter.set(3 + i, dq[at(i)], 0.0);
    for (int s = 0; s < steps; ++s) rig.predict(0.2 / steps, tau);
    for (int i = 0; i < 3; ++i) error[k] = std::max(error[k], std::abs(rig.filter.q(i) - truth.q[at(i)]));
  }
  std::printf("position error after 0.2 s of free fall in steps of 10, 5, 2.5 ms: %.2e %.2e %.2e rad\n", error[0], error[1], error[2]);
  EXPECT_LT(error[2], 3e-3);
  EXPECT_GT(error[0] / error[1], 1.8);
  EXPECT_GT(error[1] / error[2], 1.8);
}

TEST(JointKalman, TheFrictionWeightIntegratesOneJointExactly) {
  // I q'' + B q' = tau:  q' = v + (q'_0 - v) e^{-Bt/I},  v = tau/B
  const double h = 0.004, v0 = 1.3, tau = 0.7;
  for (double time_constant : {27e-6, 100e-6, 1e-3, 4e-3, 0.05, 0.3, 0.4, 0.41, 1.0, 10.0}) {
    const double I = 0.02, B = I / time_constant;
    const Arm arm(turntable(I, {.viscous = B}));
    Rig rig(arm, 0, false, false);
    rig.filter.set(0, 0.2, 0.0);
    rig.filter.set(1, v0, 0.0);
    double q = 0.2, dq = v0;
    for (int k = 0; k < 50; ++k) {
      rig.predict(h, {tau});
      const double v = tau / B, decay = std::exp(-h / time_constant);
      q += h * v + (dq - v) * time_constant * -std::expm1(-h / time_constant);
      dq = v + (dq - v) * decay;
      ASSERT_NEAR(rig.filter.dq(0), dq, 1e-11 * v0) << time_constant << " s, step " << k;
      ASSERT_NEAR(rig.filter.q(0), q, 1e-11) << time_constant << " s, step " << k;
    }
  }
}

TEST(JointKalman, FrictionThatGrowsAsTheJointSlowsDoesNoHarm) {
  // Stribeck: d tau_f / d q' < 0 above v_s/sqrt(2). Linearised, a light joint would run away within the step;
  // in truth no further than to where viscous friction takes over: (0.8 - 0.3)/0.05 = 10 rad/s.
  for (double inertia : {1e-4, 3e-3, 0.1}) {
    const Friction friction{.coulomb = 0.3, .viscous = 0.05, .static_ = 0.8, .stribeck_velocity = 0.05};
    const Arm arm(turntable(inertia, friction));
    for (double dq : {0.02, 0.035, 0.05, 0.08, -0.05}) {
      Rig rig(arm, 0, false, false);
      rig.torque_variance[0] = 0.01;
      rig.filter.set(0, 0.0, 1e-6);
      rig.filter.set(1, dq, 0.0);
      rig.predict(0.004, {friction.torque(dq)});  // in equilibrium
      EXPECT_NEAR(rig.filter.dq(0), dq, 1e-9) << inertia << " kg m^2, " << dq << " rad/s";
      for (double surplus : {0.05, -0.05}) {  // a torque moves the joint where it pushes
        Rig pushed(arm, 0, false, false);
        pushed.filter.set(1, dq, 0.0);
        pushed.predict(0.004, {friction.torque(dq) + surplus});
        EXPECT_GT((pushed.filter.dq(0) - dq) * surplus, 0.0) << inertia << " kg m^2, " << dq << " rad/s";
      }
      EXPECT_TRUE(rig.filter.healthy()) << inertia << " kg m^2, " << dq << " rad/s";
      for (int k = 0; k < 250; ++k) {
        rig.predict(0.004, {friction.torque(dq)});
        (void)rig.filter.measure(0, -1, dq * 0.004 * (k + 2), 1e-8);
        ASSERT_TRUE(rig.filter.healthy()) << inertia << " kg m^2, " << dq << " rad/s, step " << k;
        ASSERT_LT(std::abs(rig.filter.dq(0)), 12.0) << inertia << " kg m^2, " << dq << " rad/s, step " << k;
      }
    }
  }
}

TEST(JointKalman, CovarianceStaysSymmetricAndPositive) {
  // 1e5 steps of a three-joint arm with one light link behind heavy friction, in random motion, of random length.
  Random r(3);
  ArmDescription d = palpate_test::random_description(r, 3);
  for (int j = 0; j < 3; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.friction = {.coulomb = 1.0, .viscous = 0.5, .sign_velocity = 1e-2};
    J.position_resolution = 1e-3;
    J.position_std = 1e-4;
  }
  d.joints[2].mass = 0.05;
  d.joints[2].com = {};
  d.joints[2].inertia = {1e-5, 0.0, 0.0, 1e-5, 0.0, 1e-5};
  d.joints[2].rotor_inertia = 0.0;
  d.joints[2].friction.coulomb = 2.0;  // 2/1e-2/1e-5: settles in 50 ns
  d.grasp = {};
  const Arm arm(d);
  Rig rig(arm, 1);
  rig.torque_variance = {0.01, 0.01, 0.01};
  for (int i = 0; i < 3; ++i) rig.decay[at(1 + i)] = 0.999;
  JointSample s;
  s.status = Status::ok;
  rig.filter.start(arm, s, 1.0);
  rig.filter.set_parameter(0, 0.0, 1.0);
  for (int i = 0; i < 3; ++i) rig.filter.set_parameter(1 + i, 0.0, 0.3);
  JointVector tau{};
  double smallest = 1.0;
  for (int k = 0; k < 100000; ++k) {
    if (k % 50 == 0)
      for (int i = 0; i < 3; ++i) tau[at(i)] = r(-5, 5);
    const JointVector g = gravity_torque<double>(arm, rig.filter.positions());
    JointVector applied{};
    for (int i = 0; i < 3; ++i) applied[at(i)] = g[at(i)] + tau[at(i)];
    rig.predict(r(1e-4, 0.02), applied);
    for (int i = 0; i < 3; ++i) rig.filter.add_parameter_variance(1 + i, 0.002 * 0.3);
    rig.filter.add_parameter_variance(0, 1e-6);
    for (int i = 0; i < 3; ++i) s.q[at(i)] = rig.filter.q(i) + 3e-4 * r.normal();
    rig.filter.measure_joints(arm, s, [](int, int, const auto&) {});
    ASSERT_TRUE(rig.filter.healthy()) << k;
    for (int a = 0; a < rig.dim(); ++a)
      for (int b = 0; b < a; ++b)
        ASSERT_NEAR(rig.filter.covariance(a, b), rig.filter.covariance(b, a),
                    1e-8 * std::sqrt(rig.filter.variance(a) * rig.filter.variance(b)))
            << k;
    if (k % 10 == 0) {
      JointMatrix C = rig.correlation();
      for (int a = 0; a < rig.dim(); ++a) {
        for (int b = 0; b < rig.dim(); ++b) ASSERT_LE(std::abs(C(a, b)), 1.0 + 1e-9) << k;
        C(a, a) += 1e-9;
      }
      ASSERT_TRUE(Cholesky<double>(C, rig.dim()).positive()) << k;
      smallest = std::min(smallest, rig.filter.variance(0));
    }
  }
  EXPECT_GT(smallest, 0.0);
}

TEST(JointKalman, ARoundedPositionIsNeverKnownBetterThanTheRounding) {
  const double count = 2e-3, floor = count / std::sqrt(12.0);
  ArmDescription d = turntable(0.3, {.viscous = 0.5});
  d.joints[0].position_resolution = count;
  d.joints[0].position_std = 1e-4;
  const Arm arm(d);
  for (bool encoders : {true, false}) {
    Rig rig(arm, 0, false, encoders);
    rig.torque_variance[0] = 1e-4;
    JointSample s;
    s.status = Status::ok;
    rig.filter.start(arm, s, 1.0);
    for (int k = 0; k < 20000; ++k) {
      rig.predict(0.004, {});
      rig.filter.measure_joints(arm, s, [](int, int, const auto&) {});
      if (encoders) ASSERT_GT(std::sqrt(rig.filter.variance(0)), 0.98 * floor) << k;
    }
    if (!encoders) EXPECT_LT(std::sqrt(rig.filter.variance(0)), 0.5 * floor);  // what white noise of that size would allow
  }
}

TEST(JointKalman, CountingThroughManyCountsAveragesTheRounding) {
  const double count = 2e-3;
  ArmDescription d = turntable(0.3, {.viscous = 0.5});
  d.joints[0].position_resolution = count;
  d.joints[0].position_std = 1e-6;
  const Arm arm(d);
  Rig rig(arm, 0, false, true);
  rig.torque_variance[0] = 1e-6;
  JointSample s;
  s.status = Status::ok;
  rig.filter.start(arm, s, 1.0);
  double squares = 0.0, claimed = 0.0;
  int steps = 0;
  for (int k = 1; k < 5000; ++k) {  // 0.4 rad/s against its friction
    rig.predict(0.004, {0.2});
    const double q = 0.4 * 0.004 * k + 7.7e-4;
    s.q[0] = count * std::round(q / count);
    rig.filter.measure_joints(arm, s, [](int, int, const auto&) {});
    if (k < 500) continue;
    squares += std::pow(rig.filter.q(0) - q, 2);
    claimed += rig.filter.variance(0);
    ++steps;
  }
  EXPECT_LT(std::sqrt(squares / steps), 0.3 * count / std::sqrt(12.0));
  EXPECT_GT(claimed, 0.5 * squares);
}

TEST(JointKalman, AMeasurementIsTheTextbookUpdate) {
  Random r(4);
  const Arm arm = random_arm(r, 2, {});
  Rig rig(arm, 0, true, false);
  JointSample s;
  s.status = Status::ok;
  rig.torque_variance = {0.1, 0.1};
  rig.filter.start(arm, s, 1.0);
  for (int i = 0; i < 2; ++i) rig.filter.set_parameter(i, 0.0, 4.0);
  for (int k = 0; k < 5; ++k) rig.predict(0.01, {1.0, -1.0});
  const Rig before = rig;
  const double z = 0.01, R = 1e-6;
  const auto seen = rig.filter.measure(1, -1, z, R);
  EXPECT_EQ(seen.y, z - before.filter.q(1));
  EXPECT_NEAR(seen.s, before.filter.variance(1) + R, 1e-18);
  for (int a = 0; a < rig.dim(); ++a) {
    const double K = before.filter.covariance(a, 1) / seen.s;
    EXPECT_NEAR(rig.state()[at(a)], before.state()[at(a)] + K * seen.y, 1e-15);
    for (int b = 0; b < rig.dim(); ++b)
      EXPECT_NEAR(rig.filter.covariance(a, b), before.filter.covariance(a, b) - K * before.filter.covariance(1, b), 1e-14);
  }
}

TEST(JointKalman, AnInnovationIsThatOfTheMeasurementToCome) {
  for (bool encoders : {true, false}) {
    ArmDescription d = turntable(0.3, {});
    d.joints[0].position_resolution = 2e-3;
    d.joints[0].position_std = 1e-4;
    const Arm arm(d);
    Rig rig(arm, 0, true, encoders);
    rig.torque_variance = {0.1};
    JointSample s;
    s.status = Status::ok;
    rig.filter.start(arm, s, 1.0);
    for (int k = 0; k < 5; ++k) {
      rig.predict(0.004, {1.0});
      s.q[0] = 2e-3 * k;
      const Filter::Innovation foretold = rig.filter.innovation(arm, s, 0);
      rig.filter.measure_joints(arm, s, [&](int, int, const auto& update) {
        EXPECT_DOUBLE_EQ(update.y, foretold.y);
        EXPECT_NEAR(update.s, foretold.s, 1e-12 * foretold.s);
      });
    }
  }
}

TEST(JointKalman, AMeasuredVelocityIsUsedWhereItsStdIsDeclared) {
  ArmDescription d = turntable(0.3, {});
  d.joints[0].position_std = 1e-3;
  for (bool declared : {true, false}) {
    d.joints[0].velocity_std = declared ? 1e-3 : std::numeric_limits<double>::quiet_NaN();
    const Arm arm(d);
    Rig rig(arm, 0, false, false);
    JointSample s;
    s.status = Status::ok;
    s.velocity_measured = true;
    s.dq[0] = 0.5;
    rig.filter.start(arm, s, 1.0);
    EXPECT_EQ(rig.filter.dq(0), declared ? 0.5 : 0.0);
    EXPECT_EQ(rig.filter.variance(1), declared ? 1e-6 : 1.0);
    int measured = 0;
    rig.filter.measure_joints(arm, s, [&](int, int, const auto&) { ++measured; });
    EXPECT_EQ(measured, declared ? 2 : 1);
  }
}

TEST(JointKalman, AllocatesNothing) {
  Random r(5);
  const Arm arm = random_arm(r, 7, {.coulomb = 0.5});
  Rig rig(arm);
  JointSample s;
  s.status = Status::ok;
  palpate::test::AllocationCounter counter;
  rig.filter.start(arm, s, 1.0);
  for (int k = 0; k < 10; ++k) {
    rig.predict(0.004, {});
    rig.filter.measure_joints(arm, s, [](int, int, const auto&) {});
  }
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
