// SafetyLimiter: bounds that hold for any input whatever, limits that hold a simulated joint, faults that end softly.
#include "palpate/control/limiter.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <random>
#include <string>
#include <vector>

#include "no_alloc.hpp"

using namespace palpate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();
constexpr int n = 3;

LimiterConfig config() {
  LimiterConfig c;
  c.torque = {10.0, 20.0, 5.0};
  c.torque_rate = {500.0, inf, 100.0};
  c.lower = {-1.0, -inf, -2.0};
  c.upper = {1.0, inf, 2.0};
  c.velocity = {2.0, 1.5, inf};
  c.approach = {5.0, 5.0, 5.0};
  c.damping = {10.0, 20.0, 4.0};
  return c;
}
/// One joint without any limit but the torque's.
LimiterConfig only_torque(double torque) {
  LimiterConfig c;
  c.torque[0] = torque;
  c.torque_rate[0] = c.upper[0] = c.velocity[0] = inf;
  c.lower[0] = -inf;
  c.approach[0] = c.damping[0] = 1.0;
  return c;
}
JointCommand torques(const JointVector& u) {
  JointCommand c;
  c.torque = u;
  return c;
}

TEST(SafetyLimiter, AHarmlessCommandPassesUntouched) {
  SafetyLimiter l(n, config());
  JointCommand in = torques({1.0, -2.0, 0.3});
  in.time_ns = 77;
  in.status = Status::held;
  const LimitedCommand out = l.step(in, {0.1, 5.0, 0.0}, {0.1, -0.1, 0.0}, {0.5, -1.0, 0.0}, 0.004);
  EXPECT_EQ(out.command.torque, in.torque);
  EXPECT_EQ(out.command.time_ns, 77);
  EXPECT_EQ(out.command.status, Status::held);
  EXPECT_EQ(out.limited, limited_none);
}

TEST(SafetyLimiter, ZeroInZeroOut) {
  SafetyLimiter l(n, config());
  EXPECT_EQ(l.step({}, {}, {}, {}, 0.004).command.torque, JointVector{});
}

TEST(SafetyLimiter, SaysWhichLimitActedOnWhichJoint) {
  SafetyLimiter l(n, config());
  l.reset({4.9, 0.0, 0.0});
  const LimitedCommand out = l.step(torques({9.0, 25.0, 0.1}), {0.9, 0.0, 0.0}, {0.0, -3.0, 0.0}, {}, 0.01);
  EXPECT_EQ(out.by_joint[0], limited_position);  // 0.1 rad before its limit: D k 0.1 = 5 N m of push left
  EXPECT_NEAR(out.command.torque[0], 5.0, 1e-12);
  EXPECT_EQ(out.by_joint[1], limited_torque | limited_velocity);  // already too fast: braked with D (3 - 1.5) = 30
  EXPECT_EQ(out.command.torque[1], 20.0);
  EXPECT_EQ(out.by_joint[2], limited_none);
  EXPECT_EQ(out.limited, limited_position | limited_torque | limited_velocity);
  EXPECT_EQ(out.command.status, Status::saturated);
  for (std::size_t j = n; j < max_joints; ++j) EXPECT_TRUE(out.command.torque[j] == 0.0 && out.by_joint[j] == 0);
}

TEST(SafetyLimiter, RateCountsFromTheTorqueTheDrivesHave) {
  SafetyLimiter l(n, config());
  EXPECT_DOUBLE_EQ(l.step(torques({9.0}), {}, {}, {}, 0.004).command.torque[0], 2.0);
  const LimitedCommand second = l.step(torques({9.0}), {}, {}, {}, 0.004);
  EXPECT_DOUBLE_EQ(second.command.torque[0], 4.0);
  EXPECT_EQ(second.by_joint[0], limited_rate);
  l.reset({8.0, 0.0, -99.0});
  const LimitedCommand after = l.step(torques({-9.0, 0.0, -5.0}), {}, {}, {}, 0.004);
  EXPECT_DOUBLE_EQ(after.command.torque[0], 6.0);
  EXPECT_EQ(after.command.torque[2], -5.0);
  l.reset({nan});
  EXPECT_DOUBLE_EQ(l.step(torques({9.0}), {}, {}, {}, 0.004).command.torque[0], 2.0);
  l.reset();
  EXPECT_DOUBLE_EQ(l.step(torques({-9.0}), {}, {}, {}, 3600.0).command.torque[0], -9.0);  // max_dt 0.1 s: room for 50 N m
  SafetyLimiter slow(n, config());
  EXPECT_DOUBLE_EQ(slow.step(torques({0.0, 0.0, 5.0}), {}, {}, {}, 3600.0).command.torque[2], 5.0);
  LimiterConfig tight = config();
  tight.max_dt = 0.01;
  EXPECT_DOUBLE_EQ(SafetyLimiter(n, tight).step(torques({0.0, 0.0, 5.0}), {}, {}, {}, 3600.0).command.torque[2], 1.0);
}

TEST(SafetyLimiter, ABadTimeStepFreezesRateLimitedTorques) {
  for (double dt : {0.0, -0.1, nan, inf}) {
    SafetyLimiter l(n, config());
    l.reset({3.0, 3.0, 3.0});
    const LimitedCommand out = l.step(torques({4.0, 4.0, 3.0}), {}, {}, {}, dt);
    EXPECT_EQ(out.command.status, Status::time_error);
    EXPECT_EQ(out.command.torque, (JointVector{3.0, 4.0, 3.0}));
    EXPECT_EQ(out.limited, limited_time | limited_rate);
    EXPECT_EQ(out.by_joint[1], limited_time);
  }
}

TEST(SafetyLimiter, PushTowardsALimitFadesAndHoldingTheArmDoesNot) {
  LimiterConfig c = config();
  c.torque_rate.fill(inf);
  SafetyLimiter l(n, c);
  double last = inf;
  for (double q = 0.5; q < 1.4; q += 0.01) {
    const double push = l.step(torques({8.0}), {q}, {}, {3.0}, 0.004).command.torque[0] - 3.0;  // gravity needs 3 N m
    EXPECT_LE(push, last);
    last = push;
    if (q < 1.0) {
      EXPECT_NEAR(push, std::min(5.0, 50.0 * (1.0 - q)), 1e-9);
    } else {
      EXPECT_LE(push, 1e-9);  // beyond the limit it is led back
    }
    EXPECT_EQ(l.step(torques({3.0}), {std::min(q, 1.0)}, {}, {3.0}, 0.004).limited, limited_none);
    if (q < 1.0) {
      EXPECT_EQ(l.step(torques({-9.0}), {q}, {}, {3.0}, 0.004).limited, limited_none);  // away: free
    }
  }
}

/// A joint of 0.1 kg m^2 under the worst a controller can do, 1 kHz.
struct Worst {
  double highest_q = -inf, lowest_q = inf, highest_speed = 0.0, last_speed = 0.0;
};
template <class Controller>
Worst simulate(LimiterConfig c, double q0, double dq0, double load, Controller&& controller) {
  SafetyLimiter l(1, c);
  Worst w;
  JointVector q{q0}, dq{dq0};
  const double dt = 0.001, inertia = 0.1;
  for (int k = 0; k < 20000; ++k) {
    const double u = l.step(torques({controller(k)}), q, dq, {load}, dt).command.torque[0];
    dq[0] += dt * (u - load) / inertia;
    q[0] += dt * dq[0];
    w.highest_q = std::max(w.highest_q, q[0]);
    w.lowest_q = std::min(w.lowest_q, q[0]);
    w.highest_speed = std::max(w.highest_speed, std::abs(dq[0]));
    w.last_speed = std::abs(dq[0]);
  }
  return w;
}

TEST(SafetyLimiter, AMadControllerCannotPassThePositionLimits) {
  for (double load : {-3.0, 0.0, 3.0}) {
    const Worst up = simulate(config(), 0.0, 0.0, load, [](int) { return 1e9; });
    EXPECT_LT(up.highest_q, 1.001);
    EXPECT_GT(up.highest_q, 0.95);
    EXPECT_LT(up.last_speed, 1e-6);
    const Worst down = simulate(config(), 0.0, 0.0, load, [](int) { return -1e9; });
    EXPECT_GT(down.lowest_q, -1.001);
    EXPECT_LT(down.last_speed, 1e-6);
    std::mt19937 random(5);
    const Worst noise =
        simulate(config(), 0.0, 0.0, load, [&](int k) { return k % 500 < 250 ? 1e3 : -static_cast<double>(random() % 1000); });
    EXPECT_LT(noise.highest_q, 1.001);
    EXPECT_GT(noise.lowest_q, -1.001);
  }
}

TEST(SafetyLimiter, SpeedStaysAtTheVelocityLimit) {
  LimiterConfig c = config();
  c.lower[0] = -inf;
  c.upper[0] = inf;
  const Worst w = simulate(c, 0.0, 0.0, 0.0, [](int) { return 1e9; });
  EXPECT_LT(w.highest_speed, 2.001);
  EXPECT_NEAR(w.last_speed, 2.0, 1e-6);
  EXPECT_NEAR(simulate(c, 0.0, 6.0, 2.0, [](int) { return 0.0; }).last_speed, 2.0, 1e-6);  // thrown in too fast, sliding on
}

TEST(SafetyLimiter, BeyondALimitItIsLedBackSlowly) {
  const Worst w = simulate(config(), 1.5, 0.0, 0.0, [](int) { return 1e9; });
  EXPECT_LT(w.highest_speed, 2.001);
  EXPECT_NEAR(w.lowest_q, 1.0, 1e-3);
}

TEST(SafetyLimiter, ABadCommandFadesToGravityAndDamping) {
  LimiterConfig c = only_torque(10.0);
  c.damping[0] = 2.0;
  SafetyLimiter l(1, c);
  (void)l.step(torques({8.0}), {}, {}, {3.0}, 0.01);
  for (int k = 1; k <= 200; ++k) {
    const LimitedCommand out = l.step(torques({nan}), {0.5}, {0.25}, {3.0}, 0.01);
    EXPECT_EQ(out.command.status, Status::non_finite);
    EXPECT_EQ(out.limited, limited_fault);
    EXPECT_NEAR(out.command.torque[0], 3.0 + 5.0 * std::exp(-0.01 * k / 0.1) - 2.0 * 0.25, 1e-12);
  }
  EXPECT_EQ(l.step(torques({1.0}), {}, {}, {3.0}, 0.01).command.status, Status::ok);  // and takes up again
}

TEST(SafetyLimiter, WithoutMeasurementsTheCommandFadesToZero) {
  LimiterConfig c = only_torque(10.0);
  c.upper[0] = 1.0;
  for (double missing : {nan, inf}) {  // an infinite position is no reason to brake at its limit
    SafetyLimiter l(1, c);
    l.reset({8.0});
    for (int k = 1; k <= 300; ++k)
      EXPECT_NEAR(l.step(torques({5.0}), {missing}, {0.0}, {nan}, 0.01).command.torque[0], 8.0 * std::exp(-0.1 * k), 1e-12);
    l.reset({8.0});
    EXPECT_NEAR(l.step(torques({5.0}), {0.0}, {missing}, {nan}, 0.01).command.torque[0], 8.0 * std::exp(-0.1), 1e-12);
  }
}

TEST(SafetyLimiter, OneBadJointStopsThePushOfAll) {
  SafetyLimiter l(n, config());
  l.reset({2.0, 2.0, 2.0});
  JointVector u{9.0, nan, 4.0};
  LimitedCommand out;
  for (int k = 0; k < 200; ++k) out = l.step(torques(u), {}, {}, {1.0, -1.0, 0.0}, 0.01);
  EXPECT_NEAR(out.command.torque[0], 1.0, 1e-6);
  EXPECT_NEAR(out.command.torque[1], -1.0, 1e-6);
  EXPECT_NEAR(out.command.torque[2], 0.0, 1e-6);
  EXPECT_EQ(out.by_joint[2], limited_fault);
}

TEST(SafetyLimiter, StatusOfTheControllerIsNotHidden) {
  SafetyLimiter l(n, config());
  JointCommand in = torques({1.0});
  in.status = Status::non_finite;  // as PdGravity says when it falls back on the feed-forward
  const LimitedCommand out = l.step(in, {}, {}, {}, 0.01);
  EXPECT_EQ(out.command.status, Status::non_finite);
  EXPECT_EQ(out.command.torque[0], 1.0);
  in.torque[0] = 99.0;
  EXPECT_EQ(l.step(in, {}, {}, {}, 0.01).command.status, Status::non_finite);  // worse than saturated
}

TEST(SafetyLimiter, NoInputWhateverBreaksTheBounds) {
  std::mt19937_64 random(13);
  const std::array<double, 14> nasty{nan, inf, -inf, 0.0, -0.0, 1e308, -1e308, 1e-310, 1.0, -1.0, 1e9, -1e9, 1e154, -1e154};
  std::uniform_real_distribution<double> ordinary(-30.0, 30.0);
  for (int round = 0; round < 40; ++round) {
    LimiterConfig c = config();
    if (round % 4 == 1) c.torque_rate.fill(inf);
    if (round % 4 == 2) c.velocity.fill(inf), c.damping.fill(1e300), c.approach.fill(1e300);
    if (round % 4 == 3) c.torque.fill(1e300), c.torque_rate.fill(1e300), c.lower.fill(-1e300), c.upper.fill(1e300);
    SafetyLimiter l(n, c);
    JointVector last{};
    for (int k = 0; k < 5000; ++k) {
      const double share = k % 3 == 0 ? 0.0 : 0.2;
      const auto pick = [&] {
        return std::uniform_real_distribution<double>(0, 1)(random) < share ? nasty[random() % nasty.size()] : ordinary(random);
      };
      JointVector u{}, q{}, dq{}, g{};
      for (std::size_t j = 0; j < n; ++j) u[j] = pick(), q[j] = pick(), dq[j] = pick(), g[j] = pick();
      const double dt = random() % 4 == 0 ? nasty[random() % nasty.size()] : 0.001 * static_cast<double>(random() % 20);
      const LimitedCommand out = l.step(torques(u), q, dq, g, dt);
      const double h = dt > 0.0 && std::isfinite(dt) ? std::min(dt, c.max_dt) : 0.0;
      for (std::size_t j = 0; j < n; ++j) {
        const double sent = out.command.torque[j];
        ASSERT_LE(std::abs(sent), c.torque[j]);  // a NaN fails too
        if (!std::isinf(c.torque_rate[j])) {
          ASSERT_LE(std::abs(sent - last[j]), c.torque_rate[j] * h + 1e-15 * c.torque[j]);
        }
        const bool told = sent == u[j] || out.by_joint[j] != limited_none;
        ASSERT_TRUE(told) << "changed a command without saying so";
      }
      last = out.command.torque;
    }
  }
}

TEST(SafetyLimiter, ChunkedRunIsWholeRunAndResetIsNew) {
  std::mt19937_64 random(17);
  std::uniform_real_distribution<double> pick(-20.0, 20.0);
  SafetyLimiter whole(n, config()), chunk(n, config());
  for (int k = 0; k < 50; ++k) (void)chunk.step(torques({pick(random), k % 5 ? 1.0 : nan}), {}, {}, {}, 0.01);
  chunk.reset();
  for (int k = 0; k < 300; ++k) {
    const JointVector u{pick(random), pick(random), k % 11 == 0 ? nan : pick(random)};
    const JointVector q{0.05 * pick(random)}, dq{0.1 * pick(random), pick(random)};
    if (k % 70 == 0) chunk = SafetyLimiter(chunk);
    const LimitedCommand a = whole.step(torques(u), q, dq, {1.0}, 0.004), b = chunk.step(torques(u), q, dq, {1.0}, 0.004);
    EXPECT_EQ(a.command.torque, b.command.torque);
    EXPECT_EQ(a.by_joint, b.by_joint);
    EXPECT_EQ(a.command.status, b.command.status);
  }
}

TEST(SafetyLimiter, AllocatesNothing) {
  SafetyLimiter l(n, config());
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) (void)l.step(torques({k % 3 == 0 ? nan : 50.0}), {}, {}, {}, 0.004);
  EXPECT_EQ(counter.count(), 0u);
}

TEST(SafetyLimiter, ConstructorNamesWhatIsWrong) {
  const auto message = [](auto change) -> std::string {
    LimiterConfig c = config();
    change(c);
    try {
      SafetyLimiter(n, c);
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([](LimiterConfig& c) { c.torque[1] = inf; }), "LimiterConfig torque[1] [N m] = inf: expected a finite number > 0");
  EXPECT_EQ(message([](LimiterConfig& c) { c.torque_rate[2] = 0.0; }),
            "LimiterConfig torque_rate[2] [N m/s] = 0: expected a number > 0, or infinity for no limit");
  EXPECT_EQ(message([](LimiterConfig& c) { c.lower[0] = 1.0; }), "LimiterConfig lower[0] [rad] = 1: expected less than upper, 1.000000");
  EXPECT_EQ(message([](LimiterConfig& c) { c.lower[0] = nan; }), "LimiterConfig lower[0] [rad] = nan: expected less than upper, 1.000000");
  EXPECT_EQ(message([](LimiterConfig& c) { c.velocity[0] = nan; }),
            "LimiterConfig velocity[0] [rad/s] = nan: expected a number > 0, or infinity for no limit");
  EXPECT_EQ(message([](LimiterConfig& c) { c.damping[0] = 0.0; }),
            "LimiterConfig damping[0] [N m s/rad] = 0: expected a finite number > 0");
  EXPECT_EQ(message([](LimiterConfig& c) { c.approach[0] = inf; }), "LimiterConfig approach[0] [1/s] = inf: expected a finite number > 0");
  EXPECT_EQ(message([](LimiterConfig& c) { c.fault_decay = 0.0; }), "LimiterConfig fault_decay [s] = 0: expected a finite number > 0");
}

}  // namespace
