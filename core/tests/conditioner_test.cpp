// Conditioner: units, velocity, and every reason to refuse or to mistrust a sample.
#include "palpate/conditioner.hpp"

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
constexpr std::int64_t ms = 1000000;

constexpr int n = 3;
const JointVector gain{2.0, -0.5, 1.0};

RawSample at(double milliseconds, bool has_velocity = false) {
  RawSample raw;
  raw.time_ns = static_cast<std::int64_t>(milliseconds * static_cast<double>(ms));
  const double t = 1e-3 * milliseconds;
  raw.position = {t, 1.0 - 2.0 * t, 0.5 * t * t};
  raw.velocity = {10.0, 20.0, 30.0};
  raw.effort = {1.0, 4.0, -3.0};
  raw.has_velocity = has_velocity;
  return raw;
}

void expect_same(const JointSample& a, const JointSample& b) {
  EXPECT_EQ(a.time_ns, b.time_ns);
  EXPECT_EQ(a.dt, b.dt);
  EXPECT_EQ(a.q, b.q);
  EXPECT_EQ(a.dq, b.dq);
  EXPECT_EQ(a.tau, b.tau);
  EXPECT_EQ(a.model_torque, b.model_torque);
  EXPECT_EQ(a.has_model_torque, b.has_model_torque);
  EXPECT_EQ(a.velocity_measured, b.velocity_measured);
  EXPECT_EQ(a.status, b.status);
}

TEST(Conditioner, ConvertsEffortAndUsesTheDriversVelocity) {
  Conditioner c(n, gain);
  const JointSample first = c.step(at(10, true));
  EXPECT_EQ(first.status, Status::ok);
  EXPECT_EQ(first.dt, 0.0);
  EXPECT_EQ(first.tau, (JointVector{2.0, -2.0, -3.0}));
  EXPECT_EQ(first.dq, (JointVector{10.0, 20.0, 30.0}));
  const JointSample second = c.step(at(14, true));
  EXPECT_EQ(second.time_ns, 14 * ms);
  EXPECT_EQ(second.dt, 0.004);
  EXPECT_EQ(second.status, Status::ok);
}

TEST(Conditioner, WarmsUntilThereIsAVelocity) {
  Conditioner c(n, gain);
  const JointSample first = c.step(at(10));
  EXPECT_EQ(first.status, Status::warming);
  EXPECT_EQ(first.dq, JointVector{});
  EXPECT_EQ(first.q, at(10).position);
  const JointSample second = c.step(at(14));
  EXPECT_EQ(second.status, Status::ok);
  EXPECT_NEAR(second.dq[0], 1.0, 1e-12);
  EXPECT_NEAR(second.dq[1], -2.0, 1e-12);

  Conditioner five(n, gain, {.differentiator = {.points = 5}});
  for (int k = 0; k < 8; ++k) EXPECT_EQ(five.step(at(4 * k)).status, k < 4 ? Status::warming : Status::ok);
}

TEST(Conditioner, DifferentiatesOnRequestEvenIfTheDriverHasAVelocity) {
  Conditioner c(n, gain, {.velocity = VelocitySource::differentiate});
  RawSample raw = at(0, true);
  raw.velocity[0] = nan;  // not read
  EXPECT_EQ(c.step(raw).status, Status::warming);
  EXPECT_NEAR(c.step(at(4, true)).dq[1], -2.0, 1e-12);
}

TEST(Conditioner, ADriverThatLosesItsVelocityIsDifferentiatedAtOnce) {
  Conditioner c(n, gain);
  c.step(at(0, true));
  c.step(at(4, true));
  const JointSample s = c.step(at(8));
  EXPECT_EQ(s.status, Status::ok);
  EXPECT_NEAR(s.dq[0], 1.0, 1e-12);
}

TEST(Conditioner, GapIsSaidOnceAndVelocityIsTheMeanOverIt) {
  Conditioner c(n, gain, {.differentiator = {.points = 3, .time_constant = 0.02}});
  for (int k = 0; k < 5; ++k) c.step(at(4 * k));
  EXPECT_EQ(c.step(at(116)).status, Status::ok);  // exactly max_gap is no gap
  const JointSample s = c.step(at(316));
  EXPECT_EQ(s.status, Status::gap);
  EXPECT_DOUBLE_EQ(s.dt, 0.2);
  EXPECT_NEAR(s.dq[0], 1.0, 1e-12);
  EXPECT_NEAR(s.dq[2], 0.5 * (0.316 + 0.116), 1e-12);
  EXPECT_EQ(c.step(at(320)).status, Status::warming);  // three points again
  EXPECT_EQ(c.step(at(324)).status, Status::ok);

  Conditioner measured(n, gain);
  measured.step(at(0, true));
  const JointSample m = measured.step(at(500, true));
  EXPECT_EQ(m.status, Status::gap);
  EXPECT_EQ(m.dq[0], 10.0);
  EXPECT_EQ(measured.step(at(504, true)).status, Status::ok);
}

TEST(Conditioner, SaysHowTheVelocityWasHadAndHowItsNoiseGrows) {
  Conditioner c(n, gain);
  EXPECT_EQ(c.velocity_noise_gain(), 0.0);
  EXPECT_TRUE(c.step(at(0, true)).velocity_measured);
  EXPECT_EQ(c.velocity_noise_gain(), 0.0);
  EXPECT_FALSE(c.step(at(4)).velocity_measured);
  EXPECT_DOUBLE_EQ(c.velocity_noise_gain(), std::sqrt(2.0) / 0.004);
  c.step(at(504));  // the mean over the gap
  EXPECT_DOUBLE_EQ(c.velocity_noise_gain(), std::sqrt(2.0) / 0.5);
  c.step(at(500));  // refused: as it was
  EXPECT_DOUBLE_EQ(c.velocity_noise_gain(), std::sqrt(2.0) / 0.5);
  c.reset();
  EXPECT_EQ(c.velocity_noise_gain(), 0.0);
}

TEST(Conditioner, TimeThatDoesNotIncreaseIsNotUsed) {
  Conditioner c(n, gain), reference(n, gain);
  for (double t : {0.0, 4.0}) reference.step(at(t)), c.step(at(t));
  for (double t : {4.0, 3.0, -100.0}) {
    RawSample raw = at(t);
    raw.position[0] = 77.0;
    const JointSample s = c.step(raw);
    EXPECT_EQ(s.status, Status::time_error);
    EXPECT_EQ(s.dt, 0.0);
    EXPECT_EQ(s.time_ns, raw.time_ns);
    EXPECT_EQ(s.q, at(4).position);  // the last accepted one
  }
  expect_same(c.step(at(9)), reference.step(at(9)));
}

TEST(Conditioner, EveryAbsurdNumberIsRefusedAndChangesNothing) {
  struct Fault {
    const char* what;
    void (*spoil)(RawSample&);
  };
  const std::vector<Fault> faults{
      {"NaN position", [](RawSample& r) { r.position[1] = nan; }},
      {"infinite position", [](RawSample& r) { r.position[0] = -inf; }},
      {"absurd position", [](RawSample& r) { r.position[2] = 1.1e6; }},
      {"NaN effort", [](RawSample& r) { r.effort[2] = nan; }},
      {"infinite effort", [](RawSample& r) { r.effort[0] = inf; }},
      {"absurd torque", [](RawSample& r) { r.effort[0] = -0.6e6; }},  // times gain 2
      {"NaN velocity", [](RawSample& r) { r.has_velocity = true, r.velocity[0] = nan; }},
      {"absurd velocity", [](RawSample& r) { r.has_velocity = true, r.velocity[1] = -1.1e4; }},
      {"jump", [](RawSample& r) { r.position[0] += 50.0; }},  // 50 rad in 4 ms
  };
  for (const Fault& fault : faults) {
    SCOPED_TRACE(fault.what);
    Conditioner c(n, gain), reference(n, gain);
    for (double t : {0.0, 4.0}) reference.step(at(t)), c.step(at(t));
    RawSample raw = at(8);
    fault.spoil(raw);
    const JointSample s = c.step(raw);
    EXPECT_EQ(s.status, Status::non_finite);
    EXPECT_EQ(s.q, at(4).position);
    EXPECT_EQ(s.dt, 0.0);
    expect_same(c.step(at(12)), reference.step(at(12)));
  }
}

TEST(Conditioner, AnAbsurdNumberBeyondTheLastJointIsNotRead) {
  Conditioner c(n, gain);
  RawSample raw = at(0, true);
  raw.position[n] = raw.velocity[n] = raw.effort[n] = nan;
  const JointSample s = c.step(raw);
  EXPECT_EQ(s.status, Status::ok);
  for (std::size_t j = n; j < max_joints; ++j) EXPECT_TRUE(s.q[j] == 0.0 && s.dq[j] == 0.0 && s.tau[j] == 0.0);
}

TEST(Conditioner, AJumpThatStaysIsAcceptedOnceItIsSlowEnough) {
  Conditioner c(n, gain);
  c.step(at(0));
  int refused = 0;
  for (int k = 1; k < 20; ++k) {  // the encoder was set to another zero: 100 rad in less than 10 ms is a jump
    RawSample raw = at(4 * k);
    raw.position[0] += 100.0;
    refused += c.step(raw).status == Status::non_finite;
  }
  EXPECT_EQ(refused, 2);
}

TEST(Conditioner, FirstSampleBadSaysSoAndTheNextGoodOneStarts) {
  Conditioner c(n, gain);
  RawSample raw = at(0);
  raw.effort[0] = nan;
  EXPECT_EQ(c.step(raw).status, Status::non_finite);
  EXPECT_EQ(c.step(at(-5)).status, Status::warming);
}

TEST(Conditioner, ModelTorqueIsPassedOnOrDroppedAlone) {
  Conditioner c(n, gain);
  RawSample raw = at(0, true);
  raw.has_model_torque = true;
  raw.model_torque = {5.0, 6.0, 7.0, 8.0};
  const JointSample s = c.step(raw);
  EXPECT_TRUE(s.has_model_torque);
  EXPECT_EQ(s.model_torque, (JointVector{5.0, 6.0, 7.0}));  // already [N m]; nothing beyond joint n
  raw.time_ns = 4 * ms;
  raw.model_torque[1] = nan;
  const JointSample bad = c.step(raw);
  EXPECT_FALSE(bad.has_model_torque);
  EXPECT_EQ(bad.status, Status::ok);
}

TEST(Conditioner, AClockSetBackStartsANewTimeBase) {
  Conditioner c(n, gain, {.clock_restart = 5});
  c.step(at(10000));
  c.step(at(10004));
  for (int k = 0; k < 4; ++k) EXPECT_EQ(c.step(at(4 * k)).status, Status::time_error);
  const JointSample s = c.step(at(16));
  EXPECT_EQ(s.status, Status::gap);
  EXPECT_EQ(s.dt, 0.0);
  EXPECT_NEAR(s.dq[0], 1.0, 1e-9);  // the last velocity, since the length of the gap is unknown
  EXPECT_EQ(s.q, at(16).position);
  EXPECT_EQ(c.step(at(20)).status, Status::ok);
}

TEST(Conditioner, LateSamplesAmongGoodOnesAreNoNewTimeBase) {
  Conditioner c(n, gain, {.clock_restart = 5});
  for (int round = 1; round < 10; ++round) {
    EXPECT_NE(c.step(at(100 * round)).status, Status::time_error);
    for (int k = 0; k < 4; ++k) EXPECT_EQ(c.step(at(10 * round + k)).status, Status::time_error);
  }
}

TEST(Conditioner, AClockThatStandsStillIsRefusedForEver) {
  Conditioner c(n, gain, {.clock_restart = 5});
  c.step(at(10));
  for (int k = 0; k < 100; ++k) EXPECT_EQ(c.step(at(10)).status, Status::time_error);
  for (int k = 0; k < 100; ++k) EXPECT_EQ(c.step(at(k % 2)).status, Status::time_error);
}

TEST(Conditioner, OneStampFarAheadIsSurvived) {
  Conditioner c(n, gain);
  c.step(at(0));
  RawSample ahead = at(2);
  ahead.time_ns += 1000000000 * ms;
  EXPECT_EQ(c.step(ahead).status, Status::gap);
  int lost = 0;
  JointSample s;
  for (int k = 1; k < 50; ++k) {
    s = c.step(at(4 * k));
    lost += s.status == Status::time_error;
  }
  EXPECT_EQ(lost, 9);
  EXPECT_EQ(s.status, Status::ok);
}

TEST(Conditioner, ChunkedRunIsWholeRunAndResetIsNew) {
  std::mt19937 random(7);
  std::vector<RawSample> log;
  for (int k = 0; k < 500; ++k) {
    RawSample raw = at(4 * k + static_cast<double>(random() % 6), random() % 2 == 0);
    if (random() % 20 == 0) raw.position[random() % n] = nan;
    if (random() % 50 == 0) raw.time_ns += 200 * ms;
    log.push_back(raw);
  }
  const ConditionerConfig config{.differentiator = {.points = 4, .time_constant = 0.01}};
  Conditioner whole(n, gain, config), chunk(n, gain, config);
  for (int k = 0; k < 100; ++k) chunk.step(log[static_cast<std::size_t>(400 + k)]);
  chunk.reset();
  for (std::size_t k = 0; k < log.size(); ++k) {
    if (k % 60 == 0) chunk = Conditioner(chunk);
    expect_same(chunk.step(log[k]), whole.step(log[k]));
  }
}

TEST(Conditioner, RandomGarbageNeverComesOutAsAGoodNumber) {
  std::mt19937 random(11);
  const std::array<double, 8> junk{nan, inf, -inf, 1e300, -1e300, 1e-310, 0.0, 3.0};
  Conditioner c(n, gain);
  std::int64_t accepted = 0;
  for (int k = 0; k < 20000; ++k) {
    RawSample raw;
    raw.time_ns = random() % 50 == 0 ? static_cast<std::int64_t>((std::uint64_t{random()} << 32) ^ random()) : k * ms;
    raw.has_velocity = random() % 2 == 0;
    raw.has_model_torque = random() % 2 == 0;
    for (std::size_t j = 0; j < n; ++j) {
      const auto pick = [&] { return random() % 8 == 0 ? junk[random() % junk.size()] : 1e-6 * static_cast<double>(random() % 1000); };
      raw.position[j] = pick(), raw.velocity[j] = pick(), raw.effort[j] = pick(), raw.model_torque[j] = pick();
    }
    const JointSample s = c.step(raw);
    ASSERT_TRUE(std::isfinite(s.dt) && s.dt >= 0.0);
    for (std::size_t j = 0; j < max_joints; ++j) {
      ASSERT_LE(std::abs(s.q[j]), 1e6);
      ASSERT_LE(std::abs(s.dq[j]), 1e4 * (1 + 1e-12));
      ASSERT_LE(std::abs(s.tau[j]), 1e6);
      ASSERT_TRUE(std::isfinite(s.model_torque[j]));
    }
    accepted += s.status == Status::ok;
  }
  EXPECT_GT(accepted, 0);
}

TEST(Conditioner, AllocatesNothing) {
  Conditioner c(n, gain, {.differentiator = {.points = 8, .time_constant = 0.01}});
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) c.step(at(k % 7 == 0 ? 0 : 4 * k));
  EXPECT_EQ(counter.count(), 0u);
}

TEST(Conditioner, ConstructorNamesWhatIsWrong) {
  const auto message = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([] { Conditioner(0, gain); }), "Conditioner n = 0: expected an integer from 1 to 16");
  EXPECT_EQ(message([] { Conditioner(4, gain); }), "Conditioner effort_gain[3] [N m per unit] = 0: expected a finite number other than 0");
  EXPECT_EQ(message([] { Conditioner(n, gain, {.max_gap = nan}); }), "ConditionerConfig max_gap [s] = nan: expected a finite number > 0");
  EXPECT_EQ(message([] { Conditioner(n, gain, {.clock_restart = 1}); }),
            "ConditionerConfig clock_restart [samples] = 1: expected an integer from 2 to 1000000");
}

}  // namespace
