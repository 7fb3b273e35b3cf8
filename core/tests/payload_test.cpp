// The load from the external torque: the published joint formula, and the recursive regression.
#include "palpate/payload.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::independent;
using palpate_test::Random;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

/// A pendulum of two level joints, hanging at q = 0: upper link 0.3 m, load 0.205 m below the second joint.
ArmDescription pendulum() {
  ArmDescription d;
  d.n = 2;
  for (int j = 0; j < 2; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.axis = {0, 1, 0};
    J.mass = 0.2;
    J.com = {0, 0, -0.1};
    J.inertia = {1e-3, 0, 0, 1e-3, 0, 1e-3};
  }
  d.joints[1].T_parent_joint.p = {0, 0, -0.3};
  d.grasp = {0, 0, -0.205};
  return d;
}
ExternalTorque torque(const JointVector& tau, double std = 0.01, Status status = Status::ok) {
  ExternalTorque out;
  out.torque = tau;
  out.std.fill(std);
  out.noise.fill(std);
  out.status = status;
  return out;
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
void expect_same(const Payload& a, const Payload& b) {
  EXPECT_EQ(a.mass, b.mass);
  EXPECT_EQ(a.mass_std, b.mass_std);
  EXPECT_EQ(a.first_moment, b.first_moment);
  EXPECT_EQ(a.first_moment_std, b.first_moment_std);
  EXPECT_EQ(a.status, b.status);
}

// ---- joint formula ----

TEST(JointFormula, IsThePublishedFormula) {  // m = -tau/(g l4 sin theta)
  const Arm arm(pendulum());
  const double l4 = 0.21, g = 9.80665;
  JointFormula formula(arm, {.joint = 1, .lever = l4, .gravity = g});
  for (double theta : {0.3, 1.2, -0.8, 2.5}) {
    const Payload seen = formula.step({0.0, theta}, {}, torque({9.0, -0.4}));
    EXPECT_NEAR(seen.mass, 0.4 / (g * l4 * std::sin(theta)), 1e-12);
    EXPECT_NEAR(seen.mass_std, 0.01 / (g * l4 * std::abs(std::sin(theta))), 1e-12);
    EXPECT_EQ(seen.status, Status::ok);
  }
}

TEST(JointFormula, FindsTheMassThatCausesTheTorqueInAnyMount) {
  Random r(1);
  int found = 0;
  for (int trial = 0; trial < 100; ++trial) {
    const Arm arm = palpate_test::random_arm(r, 6);
    JointVector q{};
    for (int j = 0; j < 6; ++j) q[at(j)] = r(-3, 3);
    const double mass = r(0.1, 3.0);
    JointFormula formula(arm);
    const Payload seen = formula.step(q, {}, torque(palpate_test::weight_torque(arm, q, mass)));
    if (seen.status == Status::singular) continue;
    EXPECT_NEAR(seen.mass, mass, 1e-10);
    ++found;
  }
  EXPECT_GT(found, 95);
}

TEST(JointFormula, IsSingularWhereTheLoadHangsBelowTheAxis) {
  const Arm arm(pendulum());
  JointFormula formula(arm, {.joint = 1});
  EXPECT_EQ(formula.step({}, {}, torque({})).status, Status::singular);
  EXPECT_EQ(formula.step({0.0, 0.201}, {}, torque({})).status, Status::singular);  // sin = 0.1997
  const Payload good = formula.step({0.0, 0.202}, {}, torque({0.0, -0.2}));        // 0.2006
  EXPECT_EQ(good.status, Status::ok);
  const Payload back = formula.step({}, {}, torque({0.0, -0.7}));
  EXPECT_EQ(back.status, Status::singular);
  EXPECT_EQ(back.mass, good.mass);
  EXPECT_EQ(formula.step({3.14159265, 0.0}, {}, torque({})).status, Status::singular);  // standing above it
}

TEST(JointFormula, IsHeldInMotion) {
  const Arm arm(pendulum());
  JointFormula formula(arm);
  const JointVector q{0.0, 1.0};
  EXPECT_EQ(formula.step(q, {0.4, 0.31}, torque({0.0, -0.4})).status, Status::warming);  // 0.506 rad/s: nothing yet to hold
  const Payload good = formula.step(q, {0.4, 0.29}, torque({0.0, -0.4}));
  EXPECT_EQ(good.status, Status::ok);
  const Payload moving = formula.step(q, {0.4, 0.31}, torque({0.0, -0.8}));
  EXPECT_EQ(moving.status, Status::held);
  EXPECT_EQ(moving.mass, good.mass);
  EXPECT_EQ(formula.step(q, {nan, 0.0}, torque({0.0, -0.8})).status, Status::held);
}

TEST(JointFormula, UsesTheJointAskedForOrTheLastThatFeelsTheLoad) {
  const Arm arm(pendulum());
  const JointVector q{1.0, 0.5};
  const JointVector weight = palpate_test::weight_torque(arm, q, 0.25);
  EXPECT_NEAR(JointFormula(arm, {.joint = 0}).step(q, {}, torque({weight[0], 99.0})).mass, 0.25, 1e-12);
  EXPECT_NEAR(JointFormula(arm, {.joint = 1}).step(q, {}, torque({99.0, weight[1]})).mass, 0.25, 1e-12);
  EXPECT_NEAR(JointFormula(arm).step(q, {}, torque({99.0, weight[1]})).mass, 0.25, 1e-12);
  const JointVector level{1.0, -1.0};  // the second link hangs: only the first joint feels it
  const JointVector w = palpate_test::weight_torque(arm, level, 0.25);
  EXPECT_NEAR(JointFormula(arm).step(level, {}, torque(w)).mass, 0.25, 1e-12);
  EXPECT_EQ(JointFormula(arm, {.joint = 1}).step(level, {}, torque(w)).status, Status::singular);
}

TEST(JointFormula, APrismaticJointWeighsWithItsForce) {
  ArmDescription d = pendulum();
  d.n = 1;
  d.joints[0].prismatic = true;
  d.joints[0].axis = {0, 0, 1};
  const Arm arm(d);
  EXPECT_NEAR(JointFormula(arm).step({}, {}, torque({-2.0 * 9.81})).mass, 2.0, 1e-12);
}

TEST(JointFormula, PassesOnHowFarTheTorqueMayBeTrusted) {
  const Arm arm(pendulum());
  const JointVector q{0.0, 1.0};
  for (Status status : {Status::held, Status::gap, Status::non_finite}) {
    JointFormula formula(arm);
    const Payload good = formula.step(q, {}, torque({0.0, -0.4}));
    const Payload seen = formula.step(q, {}, torque({0.0, -0.9}, 0.01, status));
    EXPECT_EQ(seen.status, status);
    EXPECT_EQ(seen.mass, good.mass);
  }
  JointFormula formula(arm);
  EXPECT_EQ(formula.step(q, {}, torque({0.0, -0.4}, 0.01, Status::warming)).status, Status::warming);
  EXPECT_EQ(formula.step(q, {}, torque({0.0, -0.4}, 0.01, Status::saturated)).status, Status::saturated);
  EXPECT_EQ(formula.step(q, {}, torque({0.0, -0.4}, 5.0)).status, Status::warming);  // 2.9 kg: no use as a weight
}

TEST(JointFormula, NegativeMassIsReportedAsItIs) {  // the bias of a torque has either sign
  const Arm arm(pendulum());
  EXPECT_NEAR(JointFormula(arm).step({0.0, 1.0}, {}, torque({0.0, 0.02})).mass, -0.02 / (9.81 * 0.205 * std::sin(1.0)), 1e-12);
}

TEST(JointFormula, ConstructorNamesTheOption) {
  const Arm arm(pendulum());
  EXPECT_NE(refusal([&] { JointFormula f(arm, {.joint = 2}); }).find("JointFormulaConfig joint = 2: expected an integer from -1 to 1"),
            std::string::npos);
  for (double junk : {-1.0, 0.0, inf}) {
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.lever = junk}); }).find("JointFormulaConfig lever"), std::string::npos);
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.gravity = junk}); }).find("JointFormulaConfig gravity"), std::string::npos);
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.sin_threshold = junk}); }).find("JointFormulaConfig sin_threshold"), std::string::npos);
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.speed_threshold = junk}); }).find("JointFormulaConfig speed_threshold"),
              std::string::npos);
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.ok_relative = junk}); }).find("JointFormulaConfig ok_relative"), std::string::npos);
    EXPECT_NE(refusal([&] { JointFormula f(arm, {.ok_absolute = junk}); }).find("JointFormulaConfig ok_absolute"), std::string::npos);
  }
  ArmDescription d = pendulum();
  d.gravity = {0, 0, 0};
  EXPECT_NE(refusal([&] {
              const Arm orbit(d);
              JointFormula f(orbit);
            }).find("gravity is zero"),
            std::string::npos);
}

// ---- regression ----

/// A sample of an arm at rest, or in motion with the acceleration given by its velocities.
JointSample at_rest(const JointVector& q, int k) {
  JointSample s;
  s.time_ns = 4'000'000ll * k;
  s.dt = k > 0 ? 0.004 : 0.0;
  s.q = q;
  s.velocity_measured = true;
  s.status = Status::ok;
  return s;
}

TEST(Regression, RecoversMassAndOffsetFromExactTorques) {
  Random r(2);
  for (int trial = 0; trial < 5; ++trial) {
    const Arm arm = palpate_test::random_arm(r, 6);
    const double mass = r(0.2, 3.0);
    const Vec3<double> delta{r(-0.05, 0.05), r(-0.05, 0.05), r(-0.05, 0.05)};  // tip axes
    for (bool offset : {false, true}) {
      Regression regression(arm, {.first_moment = offset, .settling_time = 0.0});
      Payload seen;
      for (int k = 0; k < 60; ++k) {
        JointVector q{};
        for (int j = 0; j < 6; ++j) q[at(j)] = r(-3, 3);
        const Pose<double> P = forward_kinematics<double>(arm, q);
        const Vec3<double> c = arm.p_last_grasp() + arm.R_last_tip() * (offset ? delta : Vec3<double>{});
        JointVector tau{};
        for (int j = 0; j < 6; ++j) tau[at(j)] = dot(jacobian_column(arm, P, j, P.p + P.R * c), mass * arm.gravity());
        JointSample s = at_rest(q, k);
        s.status = Status::ok;
        s.dt = 0.0;  // poses of their own, no motion between them
        seen = regression.step(s, torque(tau, 1e-4));
      }
      EXPECT_EQ(seen.status, Status::ok);
      EXPECT_NEAR(seen.mass, mass, 1e-6 * mass);
      if (!offset) continue;
      EXPECT_NEAR(seen.first_moment[0], mass * delta.x, 1e-5);
      EXPECT_NEAR(seen.first_moment[1], mass * delta.y, 1e-5);
      EXPECT_NEAR(seen.first_moment[2], mass * delta.z, 1e-5);
      for (double std : seen.first_moment_std) EXPECT_LT(std, 1e-3);
    }
  }
}

TEST(Regression, CountsTheLoadsInertiaInMotion) {
  const Arm arm(pendulum());
  const double mass = 0.8, w = 6.0, A = 0.5, h = 0.001;
  Regression regression(arm, {.acceleration_time = 0.0});
  double worst = 0.0;
  for (int k = 0; k < 3000; ++k) {
    const double t = h * k;
    JointSample s = at_rest({1.2 + A * std::sin(w * t), 0.4 - A * std::sin(w * t)}, k);
    s.dt = k > 0 ? h : 0.0;
    s.dq = {A * w * std::cos(w * t), -A * w * std::cos(w * t)};
    const JointVector ddq{-A * w * w * std::sin(w * t), A * w * w * std::sin(w * t)};
    const JointVector with = inverse_dynamics<double>(arm, s.q, s.dq, ddq, palpate_test::point_load(arm, mass));
    const JointVector bare = inverse_dynamics<double>(arm, s.q, s.dq, ddq);
    const Payload seen = regression.step(s, torque({bare[0] - with[0], bare[1] - with[1]}, 0.05));
    if (k > 500) worst = std::max(worst, std::abs(seen.mass - mass));
  }
  EXPECT_LT(worst, 0.01 * mass);  // the weight alone would be wrong by the acceleration, A w^2 = 18 rad/s^2
}

TEST(Regression, IsAsLateAsTheObserverBeforeIt) {
  const Arm arm(pendulum());
  const double mass = 0.8, lag = 0.1, h = 0.004;
  double error[2] = {};
  for (int matched = 0; matched < 2; ++matched) {
    Regression regression(arm, {.lag = matched ? lag : 0.0, .acceleration_time = 0.0});
    JointVector late{};
    for (int k = 0; k < 1500; ++k) {
      JointSample s = at_rest({0.0, 1.3 * std::sin(2.0 * h * k)}, k);
      s.dq = {0.0, 2.6 * std::cos(2.0 * h * k)};
      const JointVector ddq{0.0, -5.2 * std::sin(2.0 * h * k)};
      const JointVector with = inverse_dynamics<double>(arm, s.q, s.dq, ddq, palpate_test::point_load(arm, mass));
      const JointVector bare = inverse_dynamics<double>(arm, s.q, s.dq, ddq);
      const double a = k > 0 ? -std::expm1(-h / lag) : 1.0;
      for (std::size_t j = 0; j < 2; ++j) late[j] += a * (bare[j] - with[j] - late[j]);
      const Payload seen = regression.step(s, torque(late, 0.05));
      if (k > 400) error[matched] = std::max(error[matched], std::abs(seen.mass - mass));
    }
  }
  EXPECT_LT(error[1], 0.01 * mass);
  EXPECT_GT(error[0], 3.0 * error[1]);
}

TEST(Regression, AtRestStictionKeepsTheIntervalWideAndItCovers) {
  ArmDescription d = pendulum();
  for (int j = 0; j < 2; ++j) d.joints[at(j)].friction = {.coulomb = 0.3};
  const Arm arm(d);
  const JointVector q{0.8, 0.5};
  const double mass = 0.5;
  const JointVector weight = palpate_test::weight_torque(arm, q, mass);
  int inside = 0;
  constexpr int runs = 200;
  for (std::uint64_t seed = 1; seed <= runs; ++seed) {
    Random r = independent(seed);
    Regression regression(arm);
    // what the joints stick with: any torque within +-F_c, the same for the whole run
    const JointVector stuck{r(-0.3, 0.3), r(-0.3, 0.3)};
    Payload seen;
    for (int k = 0; k < 500; ++k)
      seen = regression.step(at_rest(q, k),
                             torque({weight[0] + stuck[0] + 0.02 * r.normal(), weight[1] + stuck[1] + 0.02 * r.normal()}, 0.02));
    inside += std::abs(seen.mass - mass) <= 1.96 * seen.mass_std;
    EXPECT_GT(seen.mass_std, 0.02);  // 0.3/sqrt(3) N m over levers of 0.4 and 0.2 m: no average of one error helps
  }
  EXPECT_GE(inside, 0.9 * runs);
}

TEST(Regression, AnUncertainDriveGainIsOneErrorForAllTime) {
  ArmDescription d = pendulum();
  for (int j = 0; j < 2; ++j) d.joints[at(j)].torque_gain_std = 0.05;
  const Arm arm(d);
  const JointVector q{0.8, 0.5};
  const Arm exact(pendulum());
  Regression regression(arm), sure(exact);
  Payload seen, confident;
  for (int k = 0; k < 2000; ++k) {
    JointSample s = at_rest(q, k);
    s.tau = gravity_torque<double>(arm, q, palpate_test::point_load(arm, 0.5));
    const ExternalTorque tau = torque(palpate_test::weight_torque(arm, q, 0.5), 0.02);
    seen = regression.step(s, tau);
    confident = sure.step(s, tau);
  }
  EXPECT_GT(seen.mass_std, 10.0 * confident.mass_std);
  EXPECT_GT(seen.mass_std, 0.5 * 0.05 * 0.5);  // about a twentieth of the load and of the arm
}

TEST(Regression, ItsIntervalCoversUnderWhiteNoise) {
  const Arm arm(pendulum());
  const JointVector q{0.8, 0.5};
  const JointVector weight = palpate_test::weight_torque(arm, q, 0.5);
  int inside = 0;
  double squares = 0.0;
  constexpr int runs = 400;
  for (std::uint64_t seed = 1; seed <= runs; ++seed) {
    Random r = independent(seed);
    Regression regression(arm, {.settling_time = 0.0});
    Payload seen;
    for (int k = 0; k < 50; ++k)
      seen = regression.step(at_rest(q, k), torque({weight[0] + 0.1 * r.normal(), weight[1] + 0.1 * r.normal()}, 0.1));
    const double error = (seen.mass - 0.5) / seen.mass_std;
    inside += std::abs(error) <= 1.96;
    squares += error * error;
  }
  EXPECT_NEAR(inside, 0.95 * runs, 3.3 * std::sqrt(0.05 * 0.95 * runs));
  EXPECT_NEAR(squares / runs, 1.0, 3.3 * std::sqrt(2.0 / runs));
}

TEST(Regression, UnusableSamplesChangeNothing) {
  const Arm arm(pendulum());
  const JointVector q{0.8, 0.5};
  const JointVector weight = palpate_test::weight_torque(arm, q, 0.5);
  Regression clean(arm, {.first_moment = true}), dirty = clean;
  for (int k = 0; k < 100; ++k) {
    const Payload before = dirty.step(at_rest(q, k), torque(weight));
    expect_same(before, clean.step(at_rest(q, k), torque(weight)));
    for (Status status : {Status::non_finite, Status::time_error}) {
      JointSample bad = at_rest(q, k);
      bad.q[0] = bad.dq[1] = bad.tau[0] = nan;
      bad.status = status;
      bad.dt = 0.0;
      const Payload seen = dirty.step(bad, torque({nan, inf}, nan, Status::held));
      EXPECT_NE(seen.status, Status::ok);
      EXPECT_EQ(seen.mass, before.mass);
    }
  }
}

TEST(Regression, WarmsUntilTheMassIsKnownAndPassesStatusesOn) {
  const Arm arm(pendulum());
  const JointVector q{0.8, 0.5};
  const JointVector weight = palpate_test::weight_torque(arm, q, 0.5);
  Regression regression(arm, {.settling_time = 0.0});
  EXPECT_EQ(regression.step(at_rest(q, 0), torque(weight, 1.0)).status, Status::warming);
  EXPECT_EQ(regression.step(at_rest(q, 1), torque(weight, 0.01, Status::warming)).status, Status::warming);
  EXPECT_EQ(regression.step(at_rest(q, 2), torque(weight, 0.01, Status::gap)).status, Status::gap);
  EXPECT_EQ(regression.step(at_rest(q, 3), torque(weight, 0.01, Status::saturated)).status, Status::saturated);
  EXPECT_EQ(regression.step(at_rest(q, 4), torque(weight, 0.01)).status, Status::ok);
}

TEST(Regression, ResetIsNewAndAChunkedRunIsTheWholeRun) {
  const Arm arm(pendulum());
  Random r(7);
  Regression whole(arm, {.first_moment = true}), used = whole;
  for (int k = 0; k < 50; ++k) (void)used.step(at_rest({r(-1, 1), r(-1, 1)}, k), torque({r(-1, 1), r(-1, 1)}));
  used.reset();
  for (int k = 0; k < 100; ++k) {
    const JointSample s = at_rest({r(-1, 1), r(-1, 1)}, k);
    const ExternalTorque tau = torque({r(-1, 1), r(-1, 1)});
    if (k % 13 == 0) used = Regression(used);
    expect_same(used.step(s, tau), whole.step(s, tau));
  }
}

TEST(Regression, ConstructorNamesTheOption) {
  const Arm arm(pendulum());
  const auto names = [&](const char* option, auto make) {
    for (double junk : {-1.0, nan, inf}) {
      const std::string message = refusal([&] { make(junk); });
      EXPECT_NE(message.find(option), std::string::npos) << option << " = " << junk << ": " << message;
    }
  };
  names("RegressionConfig mass_prior_std", [&](double x) { Regression(arm, {.mass_prior_std = x}); });
  names("RegressionConfig offset_prior_std", [&](double x) { Regression(arm, {.offset_prior_std = x}); });
  names("RegressionConfig lag", [&](double x) { Regression(arm, {.lag = std::isnan(x) ? -2.0 : x}); });  // NaN: none known
  names("RegressionConfig acceleration_time", [&](double x) { Regression(arm, {.acceleration_time = x}); });
  names("RegressionConfig friction_fraction", [&](double x) { Regression(arm, {.friction_fraction = x}); });
  names("RegressionConfig settling_time", [&](double x) { Regression(arm, {.settling_time = x}); });
  names("RegressionConfig bias_time", [&](double x) { Regression(arm, {.bias_time = x}); });
  names("RegressionConfig ok_relative", [&](double x) { Regression(arm, {.ok_relative = x}); });
  names("RegressionConfig ok_absolute", [&](double x) { Regression(arm, {.ok_absolute = x}); });
}

TEST(Payload, AllocatesNothing) {
  const Arm arm(pendulum());
  JointFormula formula(arm);
  Regression regression(arm, {.first_moment = true});
  static_assert(noexcept(formula.step({}, {}, {})) && noexcept(regression.step({}, {})));
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 50; ++k) {
    const JointVector q{0.01 * k, 0.5};
    (void)formula.step(q, {}, torque({-1.0, -0.5}));
    (void)regression.step(at_rest(q, k), torque({-1.0, -0.5}));
  }
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
