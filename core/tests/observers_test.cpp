// What each disturbance observer promises beyond the common laws (laws_test.cpp): its dynamics in closed form, its limits,
// its options, and that the standard deviation it reports is honest.
#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "palpate/conditioner.hpp"
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/observers/inverse_dynamics.hpp"
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/momentum_super_twisting.hpp"
#include "palpate/observers/published_kalman.hpp"
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

/// One link of inertia I about an upright axis, which gravity does not turn: I q'' = tau - tau_f + tau_ext.
ArmDescription turntable(double inertia, const Friction& friction = {}) {
  ArmDescription d;
  d.n = 1;
  d.joints[0].mass = 1.0;
  d.joints[0].inertia = {inertia, 0.0, 0.0, inertia, 0.0, inertia};
  d.joints[0].friction = friction;
  return d;
}
ArmDescription description(int n, std::uint64_t seed = 5) {
  Random r(seed);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) d.joints[at(j)].rotor_inertia = 0.1;
  return d;
}
/// The turntable in uniform acceleration: what moves it is tau + push.
JointSample accelerated(double t, double dt, double inertia, double tau, double push) {
  JointSample s;
  s.time_ns = std::llround(1e9 * t);
  s.dt = dt;
  s.dq[0] = (tau + push) / inertia * t;
  s.q[0] = 0.5 * s.dq[0] * t;
  s.tau[0] = tau;
  s.velocity_measured = true;
  s.status = Status::ok;
  return s;
}
template <class Make>
std::string refusal(Make make) {
  try {
    make();
  } catch (const std::invalid_argument& e) {
    return e.what();
  }
  return "nothing thrown";
}

// ---- momentum ----

TEST(Momentum, IsExactlyAFirstOrderLagForAnySampleTimes) {
  const double I = 0.3, push = 2.0, K = 20.0;
  const Arm arm(turntable(I));
  MomentumObserver observer(arm, {.bandwidth = K});
  Random r(1);
  double t = 0.0;
  (void)observer.step(accelerated(0.0, 0.0, I, 0.7, push));
  for (int k = 0; k < 200; ++k) {
    const double dt = r(0.0005, 0.02);
    t += dt;
    EXPECT_NEAR(observer.step(accelerated(t, dt, I, 0.7, push)).torque[0], push * (1.0 - std::exp(-K * t)), 1e-10);
  }
}

TEST(Momentum, SaysOkAfterThreeTimeConstants) {
  const Arm arm(turntable(0.3));
  MomentumObserver observer(arm, {.bandwidth = 10.0});
  for (int k = 0; k < 100; ++k)
    EXPECT_EQ(observer.step(accelerated(0.01 * k, k > 0 ? 0.01 : 0.0, 0.3, 0.0, 1.0)).status, k < 30 ? Status::warming : Status::ok) << k;
}

TEST(Momentum, ItsStandardDeviationFollowsTheVelocitysNoise) {  // also while the arm stands
  const Arm arm(turntable(0.3));
  for (int observer_kind = 0; observer_kind < 3; ++observer_kind) {
    MomentumObserver momentum(arm);
    MomentumSuperTwisting twisting(arm);
    InverseDynamicsObserver inverse(arm);
    double first = 0.0;
    for (int k = 0; k < 100; ++k) {
      JointSample s = accelerated(0.004 * k, k > 0 ? 0.004 : 0.0, 0.3, 0.0, 0.0);
      s.dq_std[0] = k < 50 ? 1e-3 : 1e-2;  // as when the driver's velocity fails and differences take its place
      const double std = observer_kind == 0   ? momentum.step(s).std[0]
                         : observer_kind == 1 ? twisting.step(s).std[0]
                                              : inverse.step(s).std[0];
      if (k == 49) first = std;
      if (k == 99) EXPECT_NEAR(std / first, observer_kind == 1 ? std::sqrt(10.0) : 10.0, 1e-6) << observer_kind;
    }
  }
}

// ---- super-twisting ----

TEST(SuperTwisting, ConvergesInFiniteTimeAndExactly) {
  const double I = 0.3, push = 2.0;
  const Arm arm(turntable(I));
  MomentumSuperTwisting observer(arm, {.max_rate = 40.0});
  double worst = 0.0;
  for (int k = 0; k < 500; ++k) {
    const ExternalTorque seen = observer.step(accelerated(0.004 * k, k > 0 ? 0.004 : 0.0, I, -0.4, push));
    if (k >= 150) worst = std::max(worst, std::abs(seen.torque[0] - push));
  }
  EXPECT_LT(worst, 1e-9);
}

TEST(SuperTwisting, FollowsARampWithoutLag) {
  const double I = 0.3, rate = 15.0, h = 0.004;  // [N m/s]
  const Arm arm(turntable(I));
  MomentumSuperTwisting twisting(arm, {.max_rate = 20.0});
  MomentumObserver momentum(arm, {.bandwidth = 30.0});
  for (int k = 0; k < 500; ++k) {
    const double t = h * k;
    JointSample s = accelerated(t, k > 0 ? h : 0.0, I, 0.0, 0.0);
    s.dq[0] = 0.5 * rate * t * t / I;
    s.q[0] = rate * t * t * t / (6.0 * I);
    const double seen = twisting.step(s).torque[0], late = momentum.step(s).torque[0];
    if (k < 250) continue;
    EXPECT_NEAR(seen, rate * t, rate * h);              // within one sample
    EXPECT_NEAR(late, rate * (t - 1.0 / 30.0), rate * h);  // one time constant late
  }
}

TEST(SuperTwisting, ItsGainDoesNotDependOnTheArm) {
  const Arm a(turntable(1e-4)), b(turntable(100.0));
  MomentumSuperTwisting light(a), heavy(b);
  for (int k = 0; k < 200; ++k) {
    const double dt = k > 0 ? 0.004 : 0.0;
    EXPECT_NEAR(light.step(accelerated(0.004 * k, dt, 1e-4, 0.2, 1.0)).torque[0],
                heavy.step(accelerated(0.004 * k, dt, 100.0, 0.2, 1.0)).torque[0], 1e-9);
  }
}

TEST(SuperTwisting, IsNeverConfidentlyWrongWhileATorqueOutrunsIt) {
  const double I = 0.3, push = 10.0, L = 20.0;  // a step: z needs half a second
  const Arm arm(turntable(I));
  MomentumSuperTwisting observer(arm, {.max_rate = L});
  bool saturated = false;
  ExternalTorque seen;
  for (int k = 0; k < 750; ++k) {
    const double t = 0.004 * k;
    JointSample s = accelerated(t, k > 0 ? 0.004 : 0.0, I, 0.0, 0.0);
    const double since = std::max(0.0, t - 1.0);
    s.dq[0] = push / I * since;
    s.q[0] = 0.5 * s.dq[0] * since;
    seen = observer.step(s);
    saturated = saturated || seen.status == Status::saturated;
    if (seen.status == Status::ok && (since == 0.0 || since > 0.1))  // any observer needs a moment
      ASSERT_NEAR(seen.torque[0], since > 0.0 ? push : 0.0, 0.1 * push + 3.0 * seen.std[0]) << t;
  }
  EXPECT_TRUE(saturated);
  EXPECT_EQ(seen.status, Status::ok);
  EXPECT_NEAR(seen.torque[0], push, 1e-6);
}

TEST(SuperTwisting, IsSaturatedWhileTheTorqueRisesTooFast) {
  const double I = 0.3, rate = 50.0, h = 0.004;
  const Arm arm(turntable(I));
  MomentumSuperTwisting observer(arm, {.max_rate = 20.0});
  for (int k = 0; k < 300; ++k) {
    const double t = h * k;
    JointSample s = accelerated(t, k > 0 ? h : 0.0, I, 0.0, 0.0);
    s.dq[0] = 0.5 * rate * t * t / I;
    s.q[0] = rate * t * t * t / (6.0 * I);
    const ExternalTorque seen = observer.step(s);
    if (t > 0.3) EXPECT_EQ(seen.status, Status::saturated) << t;
    EXPECT_LE(seen.torque[0], 1.1 * 20.0 * t + 1e-9);  // alpha
  }
}

// ---- inverse dynamics and model residual ----

TEST(InverseDynamics, UniformAccelerationIsSeenExactly) {
  const double I = 0.3;
  const Arm arm(turntable(I));
  InverseDynamicsObserver observer(arm);
  ExternalTorque seen;
  for (int k = 0; k < 100; ++k) seen = observer.step(accelerated(0.004 * k, k > 0 ? 0.004 : 0.0, I, 0.5, 1.5));
  EXPECT_NEAR(seen.torque[0], 1.5, 1e-9);
  EXPECT_EQ(seen.status, Status::ok);
}

TEST(ModelResidual, NeedsNoMasses) {
  ArmDescription d;
  d.n = 2;  // kinematics alone
  const Arm arm(d);
  ModelResidualObserver observer(arm);
  JointSample s;
  s.status = Status::ok;
  s.tau = {3.0, -1.0};
  s.model_torque = {5.0, -1.5};
  s.has_model_torque = true;
  ExternalTorque seen;
  for (int k = 0; k < 200; ++k) seen = observer.step(s), s.dt = 0.004;
  EXPECT_EQ(seen.status, Status::ok);
  EXPECT_NEAR(seen.torque[0], 2.0, 1e-12);
  EXPECT_NEAR(seen.torque[1], -0.5, 1e-12);
  s.has_model_torque = false;
  s.model_torque = {nan, nan};
  EXPECT_EQ(observer.step(s).status, Status::held);
  EXPECT_EQ(observer.step(s).torque, seen.torque);
}

TEST(ModelResidual, WithoutAModelTorqueItIsHeldFromTheStart) {
  const Arm arm(turntable(0.3));
  ModelResidualObserver observer(arm);
  JointSample s;
  s.status = Status::ok;
  for (int k = 0; k < 200; ++k) EXPECT_EQ(observer.step(s).status, Status::held), s.dt = 0.004;
}

// ---- sliding mode ----

/// The turntable held against a push by a stiff hand: at rest, and tau + push = 0.
JointSample held_still(int k, double push, double dt = 0.004) {
  JointSample s;
  s.time_ns = std::llround(1e9 * dt * k);
  s.dt = k > 0 ? dt : 0.0;
  s.tau[0] = -push;
  s.velocity_measured = true;
  s.status = Status::ok;
  return s;
}

TEST(SlidingMode, IsSaturatedWhereAlphaIsTooSmall) {  // 1 N m on 0.01 kg m^2: 100 rad/s^2, against 4.2
  const Arm light(turntable(0.01)), heavy(turntable(1.0));
  for (Solver solver : {Solver::euler, Solver::rk4, Solver::dormand_prince})
    for (double gamma : {1e-4, 0.0}) {
      SlidingModeObserver small(light, {.gamma = gamma, .cutoff = 10.0, .solver = solver});
      SlidingModeObserver large(light, {.lambda = 40.0, .alpha = 250.0, .gamma = gamma, .cutoff = 10.0, .solver = solver, .substeps = 8});
      SlidingModeObserver enough(heavy, {.gamma = gamma, .cutoff = 10.0, .solver = solver});
      ExternalTorque a, b, c;
      double most = 0.0;
      for (int k = 0; k < 750; ++k) {
        a = small.step(held_still(k, 1.0)), b = large.step(held_still(k, 1.0)), c = enough.step(held_still(k, 1.0));
        most = std::max(most, std::abs(a.torque[0]));
      }
      EXPECT_LE(most, 1.2 * 4.2 * 0.01);  // alpha M is all it can say, and the low-pass overshoots
      EXPECT_EQ(a.status, Status::saturated);
      EXPECT_EQ(b.status, Status::ok);
      EXPECT_NEAR(b.torque[0], 1.0, 0.03);
      EXPECT_EQ(c.status, Status::ok);
      EXPECT_NEAR(c.torque[0], 1.0, 0.03);
      for (int k = 750; k < 1500; ++k) a = small.step(held_still(k, 0.02));  // now it is enough
      EXPECT_EQ(a.status, Status::ok);
      EXPECT_NEAR(a.torque[0], 0.02, 0.01);
    }
}

TEST(SlidingMode, ItsSolversAgreeWhereTheyResolveTheSign) {
  const Arm arm(description(3));
  Scene scene{.seconds = 1.0, .swing = 0.1};
  scene.events = [](double, Plant& plant) { plant.push[1] = 3.0; };
  const Recording data = simulate(arm, scene);
  std::array<ExternalTorque, 3> seen;
  std::size_t i = 0;
  for (Solver solver : {Solver::euler, Solver::rk4, Solver::dormand_prince}) {
    SlidingModeObserver observer(arm, {.lambda = 25.0, .alpha = 80.0, .gamma = 1e-3, .cutoff = 10.0, .solver = solver, .substeps = 40});
    for (const JointSample& s : data.samples) seen[i] = observer.step(s);
    ++i;
  }
  for (std::size_t j = 0; j < 3; ++j) {
    EXPECT_NEAR(seen[0].torque[j], seen[2].torque[j], 0.02);
    EXPECT_NEAR(seen[1].torque[j], seen[2].torque[j], 1e-4);
  }
}

TEST(SlidingMode, WithoutFrictionItBlamesFrictionOnTheWorld) {  // as published: right at rest only
  const Arm arm(turntable(0.3, {.viscous = 2.0}));
  for (bool friction : {true, false}) {
    SlidingModeObserver observer(arm, {.lambda = 20.0, .alpha = 40.0, .friction = friction, .cutoff = 10.0});
    ExternalTorque seen;
    for (int k = 0; k < 500; ++k) {  // driven at 1.5 rad/s
      JointSample s = held_still(k, 0.0);
      s.dq[0] = 1.5;
      s.q[0] = 1.5 * 0.004 * k;
      s.tau[0] = 3.0;
      seen = observer.step(s);
    }
    EXPECT_NEAR(seen.torque[0], friction ? 0.0 : -3.0, 0.2);
  }
}

TEST(SlidingMode, ImplicitFrictionIsStableOnALightLink) {
  // F_c/v_0 I^-1 = 1e5 1/s: an explicit step of 4 ms would be 400 times too long. Stribeck: its slope is negative in places.
  for (const Friction& friction :
       {Friction{.coulomb = 1.0, .viscous = 0.1}, Friction{.coulomb = 1.0, .static_ = 2.0, .stribeck_velocity = 0.05}}) {
    const Arm arm(turntable(1e-3, friction));
    SlidingModeObserver observer(arm, {.lambda = 80.0, .alpha = 800.0, .cutoff = 10.0, .solver = Solver::euler});
    ExternalTorque seen;
    for (int k = 0; k < 500; ++k) {
      JointSample s = held_still(k, 0.0);
      s.dq[0] = 0.1 * std::sin(0.02 * k);
      s.q[0] = 0.1 * 0.2 * (1.0 - std::cos(0.02 * k));
      s.tau[0] = friction.torque(s.dq[0]);
      seen = observer.step(s);
      ASSERT_TRUE(std::isfinite(seen.torque[0]) && std::isfinite(seen.std[0]));
      ASSERT_LT(std::abs(observer.velocities()[0]), 10.0) << k;
    }
    EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
    EXPECT_NEAR(seen.torque[0], 0.0, 2.0);  // within the friction it chatters through
  }
}

TEST(SlidingMode, ALostStateIsSetBackAndSaidSo) {
  const Arm arm(turntable(0.01));
  SlidingModeObserver observer(arm, {.cutoff = 10.0});
  for (int k = 0; k < 300; ++k) (void)observer.step(held_still(k, 0.0));
  JointSample far = held_still(300, 0.0);
  far.q[0] = 2.0;  // an encoder that lost counts
  const ExternalTorque seen = observer.step(far);
  EXPECT_EQ(seen.status, Status::saturated);
  EXPECT_EQ(observer.positions()[0], 2.0);
}

// ---- extended Kalman ----

TEST(ExtendedKalman, WithoutDisturbanceItSmoothsAndClaimsNothing) {
  ArmDescription d = description(2);
  for (JointDescription& J : d.joints) J.position_std = 1e-3, J.torque_std = 0.05;
  const Arm arm(d);
  const Recording data = simulate(arm, {});
  ExtendedKalman filter(arm, {.disturbance = false});
  Random r(1);
  double squares = 0.0, raw_squares = 0.0;
  for (std::size_t k = 0; k < data.samples.size(); ++k) {
    JointSample s = data.samples[k];
    s.velocity_measured = false;
    for (int j = 0; j < 2; ++j) s.q[at(j)] += 1e-3 * r.normal(), s.tau[at(j)] += 0.05 * r.normal();
    const ExternalTorque seen = filter.step(s);
    EXPECT_EQ(seen.status, Status::held);
    EXPECT_EQ(seen.torque, JointVector{});
    if (k < 250) continue;
    for (int j = 0; j < 2; ++j) {
      squares += std::pow(filter.positions()[at(j)] - data.samples[k].q[at(j)], 2);
      raw_squares += std::pow(s.q[at(j)] - data.samples[k].q[at(j)], 2);
      EXPECT_NEAR(filter.velocities()[at(j)], data.samples[k].dq[at(j)], 0.02);
    }
  }
  EXPECT_LT(squares, 0.1 * raw_squares);
}

TEST(ExtendedKalman, AMeasuredVelocityHelps) {
  for (double velocity_std : {nan, 1e-3}) {
    ArmDescription d = turntable(0.3);
    d.joints[0].position_std = 1e-3;
    d.joints[0].torque_std = 0.1;
    d.joints[0].velocity_std = velocity_std;
    const Arm arm(d);
    ExtendedKalman filter(arm);
    ExternalTorque seen;
    for (int k = 0; k < 250; ++k) seen = filter.step(held_still(k, 0.0));
    if (std::isnan(velocity_std)) EXPECT_GT(seen.std[0], 0.8);
    else EXPECT_LT(seen.std[0], 0.5);
  }
}

// ---- the published filter ----

TEST(PublishedKalman, SettlesOnItsOwnRiccatiEquationWithTheBiasItsAuthorsMet) {
  // at rest against an unseen push: x2' = 0 = -push/I + K2 y, x1' = 0 = x2 + K1 y
  const double I = 0.4, push = 0.8;
  const PublishedKalmanConfig c{};
  const Arm arm(turntable(I, {.coulomb = 9.0, .viscous = 9.0}));  // friction is not in f
  PublishedKalman filter(arm, c);
  for (int k = 0; k < 20000; ++k) filter.step(held_still(k, push));
  double a = c.P0, b = 0.0, p = c.P0;  // P' = F P + P F^T - P H^T R^-1 H P + Q, F = (0 1; dt dt)
  for (int k = 0; k < 4000000; ++k) {
    const double h = 2e-5, da = 2 * b - a * a / c.R + c.Q, db = p + c.delta_t * (a + b) - a * b / c.R,
                 dp = 2 * c.delta_t * (b + p) - b * b / c.R + c.Q;
    a += h * da, b += h * db, p += h * dp;
  }
  const double K1 = a / c.R, K2 = b / c.R, y = push / (I * K2);
  EXPECT_NEAR(filter.positions()[0], -y, 1e-4 * y);
  EXPECT_NEAR(filter.velocities()[0], -K1 * y, 1e-4 * K1 * y);
}

TEST(PublishedKalman, RefusedSamplesChangeNothingAndResetIsNew) {
  const Arm arm(turntable(0.4));
  PublishedKalman clean(arm), dirty(arm);
  for (int k = 0; k < 100; ++k) {
    JointSample bad = held_still(k, 1.0);
    bad.q[0] = bad.tau[0] = nan;
    bad.status = k % 2 ? Status::non_finite : Status::time_error;
    dirty.step(bad);
    clean.step(held_still(k, 1.0));
    dirty.step(held_still(k, 1.0));
    EXPECT_EQ(clean.positions(), dirty.positions());
    EXPECT_EQ(clean.velocities(), dirty.velocities());
  }
  dirty.reset();
  EXPECT_EQ(dirty.positions(), JointVector{});
}

// ---- standard deviations ----

struct Noise {
  double position = 1e-4, torque = 0.1;  // [rad, N m]
};

/// The observer's estimates at the end of many runs of a noisy arm at rest, no push: share within 1.96 of its own std.
template <class Make>
double coverage(const Arm& arm, const JointVector& q, const Noise& noise, double jitter, Make make) {
  int inside = 0, all = 0;
  const JointVector g = gravity_torque<double>(arm, q);
  JointVector gain{};
  gain.fill(1.0);
  for (std::uint64_t seed = 1; seed <= 150; ++seed) {
    Random r = palpate_test::independent(seed);
    auto observer = make(arm);
    Conditioner conditioner(arm.n(), gain);
    ExternalTorque seen;
    for (int k = 0; k < 150; ++k) {
      RawSample raw;
      raw.time_ns = std::llround(4e6 * (k + jitter * r(-0.5, 0.5)));
      for (int j = 0; j < arm.n(); ++j) {
        raw.position[at(j)] = q[at(j)] + noise.position * r.normal();
        raw.effort[at(j)] = g[at(j)] + noise.torque * r.normal();
      }
      JointSample s = conditioner.step(raw);
      for (int j = 0; j < arm.n(); ++j) s.dq_std[at(j)] = conditioner.velocity_noise_gain() * std::sqrt(arm.position_variance(j));
      seen = observer.step(s);
    }
    EXPECT_EQ(seen.status, Status::ok);
    for (int j = 0; j < arm.n(); ++j) {
      ++all;
      inside += std::abs(seen.torque[at(j)]) <= 1.96 * seen.std[at(j)];
    }
  }
  return static_cast<double>(inside) / all;
}

TEST(StandardDeviation, CoversAtRest) {
  const Noise noise;
  ArmDescription d = description(3);
  for (JointDescription& J : d.joints) J.position_std = noise.position, J.torque_std = noise.torque;
  const Arm arm(d);
  const JointVector q{0.3, -0.4, 0.5};
  for (double jitter : {0.0, 0.6}) {
    const double momentum = coverage(arm, q, noise, jitter, [](const Arm& a) { return MomentumObserver(a); });
    const double kalman = coverage(arm, q, noise, jitter, [](const Arm& a) { return ExtendedKalman(a); });
    const double inverse = coverage(arm, q, noise, jitter, [](const Arm& a) { return InverseDynamicsObserver(a); });
    const double twisting = coverage(arm, q, noise, jitter, [](const Arm& a) { return MomentumSuperTwisting(a); });
    std::printf(
        "coverage of 95 %% at rest, jitter %.1f: momentum %.1f %%, extended Kalman %.1f %%, inverse dynamics %.1f %%, super-twisting %.1f "
        "%%\n",
        jitter, 100 * momentum, 100 * kalman, 100 * inverse, 100 * twisting);
    EXPECT_GE(momentum, 0.85);
    EXPECT_GE(kalman, 0.85);
    EXPECT_GE(inverse, 0.85);
    EXPECT_GE(twisting, 0.85);
  }
}

TEST(StandardDeviation, ExtendedKalmanIsConsistentWithItsOwnModel) {
  // The external torque is the filter's own random walk, the drives' noise its own: the normalised squared error of
  // (q, q', tau_ext) is then chi-square with 3 n degrees of freedom.
  constexpr int n = 2, runs = 120;
  const ExtendedKalmanConfig config{.disturbance_rate = 5.0, .disturbance_prior_std = 3.0, .velocity_prior_std = 0.3};
  ArmDescription d = description(n);
  for (JointDescription& J : d.joints) J.position_std = 2e-4, J.torque_std = 0.2, J.friction = {.viscous = 0.4};
  const Arm arm(d);
  double sum = 0.0, sum_early = 0.0;
  for (std::uint64_t seed = 1; seed <= runs; ++seed) {
    Random r = palpate_test::independent(seed);
    const double h = 0.004;
    Plant plant{&arm, {0.3, -0.4}};
    for (std::size_t j = 0; j < n; ++j) plant.dq[j] = 0.3 * r.normal(), plant.push[j] = 3.0 * r.normal();
    ExtendedKalman filter(arm, config);
    for (int k = 0; k < 300; ++k) {
      JointSample s;
      s.status = Status::ok;
      s.dt = k > 0 ? h : 0.0;
      if (k > 0) {
        const JointVector tau = palpate_test::control(arm, plant, {.q0 = {0.3, -0.4}}, h * k);
        JointVector applied = tau;
        for (std::size_t j = 0; j < n; ++j) applied[j] += 0.2 * r.normal();
        plant.advance(applied, h, 0.002);
        s.tau = tau;
        for (std::size_t j = 0; j < n; ++j) plant.push[j] += config.disturbance_rate * std::sqrt(h) * r.normal();
      }
      for (std::size_t j = 0; j < n; ++j) s.q[j] = plant.q[j] + 2e-4 * r.normal();
      (void)filter.step(s);
      if (k != 20 && k != 299) continue;
      constexpr int dim = 3 * n;
      JointMatrix P{};
      JointVector e{};
      for (int a = 0; a < dim; ++a) {
        for (int b = 0; b < dim; ++b) P(a, b) = filter.filter().covariance(a, b);
        const int j = a % n;
        const double truth = a < n ? plant.q[at(j)] : a < 2 * n ? plant.dq[at(j)] : plant.push[at(j)];
        e[at(a)] = truth - (a < n ? filter.positions()[at(j)] : a < 2 * n ? filter.velocities()[at(j)] : filter.filter().parameter(j));
      }
      const Cholesky<double> factor(P, dim);
      ASSERT_TRUE(factor.positive());
      const JointVector x = factor.solve(e);
      double nees = 0.0;
      for (std::size_t a = 0; a < dim; ++a) nees += e[a] * x[a];
      (k == 299 ? sum : sum_early) += nees;
    }
  }
  const double mean = sum / runs, early = sum_early / runs, spread = 3.3 * std::sqrt(2.0 * 3 * n / runs);  // 99.9 %
  std::printf("normalised squared error of (q, q', tau_ext): %.2f after 0.08 s, %.2f after 1.2 s, expected %d +- %.2f\n", early, mean,
              3 * n, spread);
  EXPECT_NEAR(mean, 3 * n, spread);
  EXPECT_NEAR(early, 3 * n, spread);
}

// ---- refusals ----

TEST(Constructors, NeedMasses) {
  ArmDescription d;
  d.n = 1;
  const Arm arm(d);
  EXPECT_EQ(refusal([&] { InverseDynamicsObserver o(arm); }), "InverseDynamicsObserver: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { SlidingModeObserver o(arm); }), "SlidingModeObserver: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { MomentumObserver o(arm); }), "MomentumObserver: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { MomentumSuperTwisting o(arm); }), "MomentumSuperTwisting: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { ExtendedKalman o(arm); }), "ExtendedKalman: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { PublishedKalman o(arm); }), "PublishedKalman: the arm has no masses; give inertials");
}

TEST(Constructors, NameTheOption) {
  const Arm arm(turntable(0.3));
  const auto names = [&](const char* option, auto make) {
    for (double junk : {-1.0, nan, std::numeric_limits<double>::infinity()}) {
      const std::string message = refusal([&] { make(junk); });
      EXPECT_NE(message.find(option), std::string::npos) << option << " = " << junk << ": " << message;
    }
  };
  names("InverseDynamicsConfig cutoff", [&](double x) { InverseDynamicsObserver(arm, {.cutoff = x}); });
  names("InverseDynamicsConfig friction_fraction", [&](double x) { InverseDynamicsObserver(arm, {.friction_fraction = x}); });
  names("ModelResidualConfig cutoff", [&](double x) { ModelResidualObserver(arm, {.cutoff = x}); });
  names("ModelResidualConfig friction_fraction", [&](double x) { ModelResidualObserver(arm, {.friction_fraction = x}); });
  names("SlidingModeConfig lambda", [&](double x) { SlidingModeObserver(arm, {.lambda = x}); });
  names("SlidingModeConfig alpha", [&](double x) { SlidingModeObserver(arm, {.alpha = x}); });
  names("SlidingModeConfig gamma", [&](double x) { SlidingModeObserver(arm, {.gamma = x}); });
  names("cutoff", [&](double x) { SlidingModeObserver(arm, {.cutoff = x}); });
  names("order", [&](double) { SlidingModeObserver(arm, {.order = 9}); });
  names("SlidingModeConfig substeps", [&](double) { SlidingModeObserver(arm, {.substeps = 65}); });
  names("SlidingModeConfig friction_fraction", [&](double x) { SlidingModeObserver(arm, {.friction_fraction = x}); });
  names("MomentumConfig bandwidth", [&](double x) { MomentumObserver(arm, {.bandwidth = x}); });
  names("MomentumConfig friction_fraction", [&](double x) { MomentumObserver(arm, {.friction_fraction = x}); });
  names("SuperTwistingConfig max_rate", [&](double x) { MomentumSuperTwisting(arm, {.max_rate = x}); });
  names("SuperTwistingConfig gain", [&](double x) { MomentumSuperTwisting(arm, {.gain = x}); });
  names("SuperTwistingConfig friction_fraction", [&](double x) { MomentumSuperTwisting(arm, {.friction_fraction = x}); });
  names("ExtendedKalmanConfig disturbance_rate", [&](double x) { ExtendedKalman(arm, {.disturbance_rate = x}); });
  names("ExtendedKalmanConfig disturbance_prior_std", [&](double x) { ExtendedKalman(arm, {.disturbance_prior_std = x}); });
  names("ExtendedKalmanConfig velocity_prior_std", [&](double x) { ExtendedKalman(arm, {.velocity_prior_std = x}); });
  names("ExtendedKalmanConfig model_torque_std", [&](double x) { ExtendedKalman(arm, {.model_torque_std = x}); });
  names("ExtendedKalmanConfig friction_fraction", [&](double x) { ExtendedKalman(arm, {.friction_fraction = x}); });
  names("ExtendedKalmanConfig max_step", [&](double x) { ExtendedKalman(arm, {.max_step = x}); });
  names("PublishedKalmanConfig Q", [&](double x) { PublishedKalman(arm, {.Q = x}); });
  names("PublishedKalmanConfig R", [&](double x) { PublishedKalman(arm, {.R = x}); });
  names("PublishedKalmanConfig P0", [&](double x) { PublishedKalman(arm, {.P0 = x}); });
  names("PublishedKalmanConfig delta_t", [&](double x) { PublishedKalman(arm, {.delta_t = x}); });
}

}  // namespace
