// PD about the torque the arm needs: where the feed-forward comes from, and what knowing the load is worth.
#include "palpate/control/feedforward_pd.hpp"

#include <gtest/gtest.h>

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
constexpr int n = 4;

Arm make_arm() {
  Random r = palpate_test::independent(21);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    d.joints[at(j)].rotor_inertia = 0.1;
    d.joints[at(j)].friction = {.viscous = 0.6};
  }
  return Arm(d);
}
PdGains gains(double kp = 200.0, double kd = 40.0, double limit = inf) {
  PdGains g;
  for (int j = 0; j < n; ++j) g.kp[at(j)] = kp, g.kd[at(j)] = kd, g.limit[at(j)] = limit;
  return g;
}
const JointVector q{0.3, -0.4, 0.6, 0.1}, dq{0.2, -0.1, 0.3, 0.4};
Setpoint wanted() { return {{0.5, -0.2, 0.4, 0.3}, {0.1, 0.2, -0.3, 0.2}, {1.0, -2.0, 0.5, 0.3}}; }

TEST(FeedforwardPd, IsFeedbackAboutTheChosenFeedForward) {
  const Arm arm = make_arm();
  const Inertia<double> load = palpate_test::point_load(arm, 1.2);
  const Setpoint s = wanted();
  const JointVector moving = inverse_dynamics<double>(arm, s.q, s.dq, s.ddq, load), friction = arm.friction_torque(s.dq);
  for (Feedforward f : {Feedforward::reference_gravity, Feedforward::gravity, Feedforward::inverse_dynamics}) {
    FeedforwardPd pd(arm, gains(), f);
    const JointCommand u = pd.step(s, q, dq, load, 77);
    EXPECT_EQ(u.status, Status::ok);
    EXPECT_EQ(u.time_ns, 77);
    for (int j = 0; j < n; ++j) {
      const double g = f == Feedforward::reference_gravity ? gravity_torque<double>(arm, s.q)[at(j)]  // bare arm, at the goal
                       : f == Feedforward::gravity         ? gravity_torque<double>(arm, q, load)[at(j)]
                                                           : moving[at(j)] + friction[at(j)];
      EXPECT_NEAR(u.torque[at(j)], g + 200.0 * (s.q[at(j)] - q[at(j)]) + 40.0 * (s.dq[at(j)] - dq[at(j)]), 1e-10);
    }
  }
}

/// Error at the end of three seconds at the goal, largest joint [rad].
double standing_error(const Arm& arm, Feedforward f, bool knows, double mass) {
  const Setpoint goal{wanted().q, {}, {}};
  Plant plant{&arm, q};
  plant.load = palpate_test::point_load(arm, mass);
  FeedforwardPd pd(arm, gains(), f);
  for (int k = 0; k < 750; ++k) {
    const JointCommand u = pd.step(goal, plant.q, plant.dq, knows ? plant.load : Inertia<double>{}, 4'000'000ll * k);
    plant.advance(u.torque, 0.004, 0.002);
  }
  double worst = 0.0;
  for (int j = 0; j < n; ++j) worst = std::max(worst, std::abs(plant.q[at(j)] - goal.q[at(j)]));
  return worst;
}

TEST(FeedforwardPd, KnowingTheLoadItReachesTheGoal) {
  const Arm arm = make_arm();
  const double mass = 2.0;
  EXPECT_LT(standing_error(arm, Feedforward::gravity, true, mass), 1e-3);
  EXPECT_LT(standing_error(arm, Feedforward::inverse_dynamics, true, mass), 1e-3);
  EXPECT_LT(standing_error(arm, Feedforward::reference_gravity, true, 0.0), 1e-3);
  // else it stops the object's torque over K_p short
  double torque = 0.0;
  for (double tau : palpate_test::weight_torque(arm, wanted().q, mass)) torque = std::max(torque, std::abs(tau));
  for (Feedforward f : {Feedforward::reference_gravity, Feedforward::gravity, Feedforward::inverse_dynamics})
    EXPECT_NEAR(standing_error(arm, f, f == Feedforward::reference_gravity, mass), torque / 200.0, 0.3 * torque / 200.0);
}

TEST(FeedforwardPd, InverseDynamicsFollowsAPlannedMotion) {
  const Arm arm = make_arm();
  double error[2] = {};
  for (int planned = 0; planned < 2; ++planned) {
    Plant plant{&arm, JointVector{}};
    plant.load = palpate_test::point_load(arm, 1.0);
    FeedforwardPd pd(arm, gains(), planned ? Feedforward::inverse_dynamics : Feedforward::gravity);
    for (int k = 0; k < 1000; ++k) {
      const double t = 0.002 * k;
      Setpoint s;
      for (int j = 0; j < n; ++j) {
        const double w = 2.0 + j, A = 0.3;
        s.q[at(j)] = A * (1 - std::cos(w * t)), s.dq[at(j)] = A * w * std::sin(w * t), s.ddq[at(j)] = A * w * w * std::cos(w * t);
        error[planned] = std::max(error[planned], std::abs(plant.q[at(j)] - s.q[at(j)]));
      }
      plant.advance(pd.step(s, plant.q, plant.dq, plant.load, 0).torque, 0.002, 0.002);
    }
  }
  EXPECT_LT(error[1], 0.005);
  EXPECT_GT(error[0], 10.0 * error[1]);
}

TEST(FeedforwardPd, SaturatesAndSaysSo) {
  const Arm arm = make_arm();
  FeedforwardPd pd(arm, gains(200.0, 40.0, 2.5), Feedforward::gravity);
  Setpoint far = wanted();
  far.q[0] = 1e4;
  const JointCommand u = pd.step(far, q, dq, {}, 0);
  EXPECT_EQ(u.status, Status::saturated);
  EXPECT_EQ(u.torque[0], 2.5);
  for (double tau : u.torque) EXPECT_LE(std::abs(tau), 2.5);
}

TEST(FeedforwardPd, NonsenseNeverReachesTheDrives) {
  const Arm arm = make_arm();
  for (Feedforward f : {Feedforward::reference_gravity, Feedforward::gravity, Feedforward::inverse_dynamics}) {
    FeedforwardPd pd(arm, gains(200.0, 40.0, 50.0), f);
    const JointCommand good = pd.step(wanted(), q, dq, {}, 0);
    EXPECT_EQ(good.status == Status::ok || good.status == Status::saturated, true);
    for (double junk : {nan, inf, -inf, 1e300}) {
      for (int what = 0; what < 6; ++what) {
        Setpoint s = wanted();
        JointVector x = q, v = dq;
        Inertia<double> load{};
        if (what == 0) s.q[1] = junk;
        if (what == 1) s.dq[1] = junk;
        if (what == 2) s.ddq[1] = junk;
        if (what == 3) x[1] = junk;
        if (what == 4) v[1] = junk;
        if (what == 5) load.m = junk;
        for (double tau : pd.step(s, x, v, load, 0).torque) EXPECT_LE(std::abs(tau), 50.0) << junk << ' ' << what;  // false for a NaN
      }
    }
    EXPECT_EQ(pd.step(wanted(), q, dq, {}, 0).torque, good.torque);
  }
}

TEST(FeedforwardPd, ResetIsNewAndItAllocatesNothing) {
  const Arm arm = make_arm();
  FeedforwardPd fresh(arm, gains(), Feedforward::inverse_dynamics), used = fresh;
  static_assert(noexcept(fresh.step({}, {}, {}, {}, 0)));
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 20; ++k) (void)used.step(wanted(), q, dq, palpate_test::point_load(arm, 0.1 * k), k);
  EXPECT_EQ(counter.count(), 0u);
  used.reset();
  EXPECT_EQ(used.step(wanted(), {nan}, dq, {}, 0).torque, fresh.step(wanted(), {nan}, dq, {}, 0).torque);
}

TEST(FeedforwardPd, ConstructorNamesWhatIsWrong) {
  const Arm arm = make_arm();
  const auto refusal = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  ArmDescription d;
  d.n = 1;
  EXPECT_EQ(refusal([&] {
              const Arm bare(d);
              FeedforwardPd pd(bare, gains(), Feedforward::gravity);
            }),
            "FeedforwardPd: the arm has no masses; give inertials");
  EXPECT_EQ(refusal([&] { FeedforwardPd pd(arm, gains(-1.0), Feedforward::gravity); }),
            "PdGains kp[0] [N m/rad] = -1: expected a finite number >= 0");
}

}  // namespace
