// ControlLoop in simulated time: what is estimated, sent, recorded, counted, and every way in which it ends.
#include "palpate/session/loop.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "bench.hpp"
#include "no_alloc.hpp"

using namespace palpate;
using namespace palpate_test;

namespace {

constexpr std::int64_t ms = 1'000'000;

struct Simulation {
  std::shared_ptr<const Arm> arm = two_links();
  std::shared_ptr<SteppedClock> clock = std::make_shared<SteppedClock>();
  std::shared_ptr<SimulatedArm> driver;
  std::shared_ptr<ControlLoop> loop;
  Request request{};
  explicit Simulation(LoopConfig config = small(), SimulatedArmConfig world = {}) {
    driver = std::make_shared<SimulatedArm>(arm, world);
    loop = make_loop(arm, driver, config, clock);
    loop->begin();
  }
  /// Records of so many ticks.
  std::vector<Record> run(int ticks) {
    std::vector<Record> out;
    Record r;
    for (int i = 0; i < ticks && loop->tick(); ++i)
      while (loop->take(r)) out.push_back(r);
    return out;
  }
  void enable() { request.enabled = true, loop->request(request); }
  void go(double a, double b, double seconds) {
    request.position = {a, b};
    request.duration = seconds;
    ++request.goal;
    loop->request(request);
  }
};

struct Script {
  std::shared_ptr<const Arm> arm = two_links();
  std::shared_ptr<SteppedClock> clock = std::make_shared<SteppedClock>();
  std::shared_ptr<ScriptedDriver> driver;
  std::shared_ptr<ControlLoop> loop;
  explicit Script(LoopConfig config = small(), bool paced = false) : driver(std::make_shared<ScriptedDriver>(2, ms, paced)) {
    loop = make_loop(arm, driver, config, clock);
    loop->begin();
  }
  void enable() {
    Request r;
    r.enabled = true;
    loop->request(r);
    for (int i = 0; i < 10 && loop->mode() != Mode::enabled; ++i) ASSERT_TRUE(loop->tick());
    ASSERT_EQ(loop->mode(), Mode::enabled);
  }
  int run(int most) {
    int ticks = 0;
    while (ticks < most && loop->tick()) ++ticks;
    return ticks;
  }
};

bool same(const Record& a, const Record& b) {
  return a.tick == b.tick && a.mode == b.mode && a.commanded == b.commanded && a.raw.position == b.raw.position && a.raw.effort == b.raw.effort &&
         a.touch.q == b.touch.q && a.touch.external.torque == b.touch.external.torque && a.touch.payload.mass == b.touch.payload.mass &&
         a.touch.payload.mass_std == b.touch.payload.mass_std && a.sent == b.sent && a.setpoint.q == b.setpoint.q;
}

TEST(ControlLoop, WatchesUntilItIsAskedToMoveThenMovesAndWeighs) {
  Simulation s;
  SimulatedWorld world;
  world.load = point_mass(*s.arm, 0.5);
  s.driver->set_world(world);
  for (const Record& r : s.run(20)) EXPECT_FALSE(r.commanded);
  s.enable();
  s.run(2);
  EXPECT_EQ(s.loop->mode(), Mode::enabled);
  EXPECT_EQ(s.loop->switched(), 1u);
  s.go(0.4, -0.7, 1.0);
  const std::vector<Record> moved = s.run(3000);
  ASSERT_FALSE(moved.empty());
  for (const Record& r : moved) EXPECT_TRUE(r.commanded);
  const Record& last = moved.back();
  EXPECT_NEAR(s.driver->truth().q[0], 0.4, 0.02);
  EXPECT_NEAR(s.driver->truth().q[1], -0.7, 0.02);
  EXPECT_EQ(last.setpoint.q[0], 0.4);
  ASSERT_EQ(last.touch.payload.status, Status::ok);
  EXPECT_NEAR(last.touch.payload.mass, 0.5, 3.0 * last.touch.payload.mass_std);
  EXPECT_NEAR(last.touch.payload.mass, 0.5, 0.02);
}

TEST(ControlLoop, TheSameRunGivesTheSameBits) {
  Simulation a, b;
  for (Simulation* s : {&a, &b}) s->run(5), s->enable(), s->run(2), s->go(0.3, 0.3, 0.5);
  const auto x = a.run(800), y = b.run(800);
  ASSERT_EQ(x.size(), y.size());
  for (std::size_t i = 0; i < x.size(); ++i) ASSERT_TRUE(same(x[i], y[i])) << i;
}

TEST(ControlLoop, WhatItEstimatesIsWhatThePipelineSaysOfTheRecordedSamples) {
  LoopConfig config = small();
  config.pipeline.observer = MomentumConfig{};
  config.pipeline.wrench = WrenchConfig{};
  Simulation s(config);
  Pipeline again(s.arm, config.pipeline);
  Record r;
  s.enable(), s.go(0.3, 0.3, 0.5);
  for (int i = 0; i < 500; ++i) {
    ASSERT_TRUE(s.loop->tick());
    ASSERT_TRUE(s.loop->take(r));
    const Touch touch = again.step(r.raw);
    EXPECT_EQ(touch.payload.mass, r.touch.payload.mass);
    EXPECT_EQ(touch.wrench.force, r.touch.wrench.force);
    EXPECT_EQ(touch.external.std, r.touch.external.std);
  }
}

TEST(ControlLoop, AGoalInMotionIsTakenUpWithoutAJump) {
  Simulation s;
  s.run(5), s.enable(), s.run(2);
  s.go(1.0, 0.0, 1.0);
  std::vector<Record> all = s.run(500);
  s.go(-0.5, 0.5, 1.0);
  for (const Record& r : s.run(1200)) all.push_back(r);
  for (std::size_t i = 1; i < all.size(); ++i)
    for (std::size_t j = 0; j < 2; ++j) {
      EXPECT_LT(std::abs(all[i].setpoint.q[j] - all[i - 1].setpoint.q[j]), 4e-3);  // 4 rad/s at 1 kHz
      EXPECT_LT(std::abs(all[i].setpoint.dq[j] - all[i - 1].setpoint.dq[j]), 4e-2);
    }
  EXPECT_EQ(all.back().setpoint.q[0], -0.5);
}

TEST(ControlLoop, AllocatesNothingInATick) {
  LoopConfig config = small();
  config.pipeline.observer = DisturbanceKalmanConfig{};
  config.pipeline.wrench = WrenchConfig{};
  config.pipeline.contact = ContactConfig{};
  config.allocations = &palpate::test::allocations;
  Simulation s(config);
  Record r;
  palpate::test::AllocationCounter counter;
  for (int i = 0; i < 400; ++i) {
    if (i == 5) s.enable();
    if (i == 10) s.go(0.5, 0.5, 0.2);
    if (i == 300) ++s.request.tare, s.loop->request(s.request);
    s.loop->tick();
    if (i % 3 == 0) s.loop->take(r);
  }
  s.loop->stop();
  s.loop->tick();
  EXPECT_EQ(counter.count(), 0u);
  EXPECT_EQ(s.loop->statistics().allocations.load(), 0u);
  EXPECT_EQ(s.loop->mode(), Mode::stopped);
}

TEST(ControlLoop, StoppedItCommandsZeroAndIsOver) {
  Simulation s;
  s.run(5), s.enable(), s.run(50);
  s.loop->stop();
  EXPECT_FALSE(s.loop->tick());
  EXPECT_FALSE(s.loop->tick());
  EXPECT_EQ(s.loop->mode(), Mode::stopped);
  EXPECT_STREQ(s.loop->fault(), "");
  RawSample raw;
  ASSERT_EQ(s.driver->read(raw), Reading::sample);
  ASSERT_EQ(s.driver->read(raw), Reading::sample);
  EXPECT_LT(std::abs(raw.effort[0]), 0.2);  // noise alone
}

TEST(ControlLoop, DrivesOffAndOnAgainHoldsWhereTheArmIsThen) {
  Simulation s;
  s.run(5), s.enable(), s.run(2), s.go(0.5, 0.0, 0.3), s.run(400);
  s.request.enabled = false;
  s.loop->request(s.request);
  s.run(300);  // it sinks
  EXPECT_EQ(s.loop->mode(), Mode::watching);
  s.enable();
  const std::vector<Record> on = s.run(50);
  const auto first = std::find_if(on.begin(), on.end(), [](const Record& r) { return r.commanded; });
  ASSERT_NE(first, on.end());
  EXPECT_NEAR(first->setpoint.q[0], first->touch.q[0], 0.05);
  EXPECT_EQ(on.back().setpoint.q[0], first->setpoint.q[0]);
}

TEST(ControlLoop, TareIsTakenOnceTheMassIsKnown) {
  Simulation s;
  SimulatedWorld world;
  world.load = point_mass(*s.arm, 0.5);
  s.driver->set_world(world);
  ++s.request.tare;
  s.enable();
  const std::vector<Record> all = s.run(3000);
  EXPECT_EQ(all.front().tares, 0u);
  const auto taken = std::find_if(all.begin(), all.end(), [](const Record& r) { return r.tares == 1; });
  ASSERT_NE(taken, all.end());
  EXPECT_EQ(taken->touch.payload.status, Status::ok);
  EXPECT_EQ(taken->tare, taken->touch.payload.mass);
  EXPECT_GT(taken->tare_std, 0.0);
  EXPECT_EQ(all.back().tare, taken->tare);
}

TEST(ControlLoop, GainsThatAreNoneAreIgnored) {
  Simulation a, b;
  for (Simulation* s : {&a, &b}) s->run(5), s->enable(), s->run(2), s->go(0.3, 0.3, 0.5);
  b.request.kp = {std::nan(""), 1.0};
  b.request.kd = {1.0, -1.0};
  ++b.request.gains;
  b.loop->request(b.request);
  const auto x = a.run(300), y = b.run(300);
  EXPECT_TRUE(same(x.back(), y.back()));
  b.request.kp = {10.0, 10.0};
  b.request.kd = {1.0, 1.0};
  ++b.request.gains;
  b.loop->request(b.request);
  EXPECT_FALSE(same(a.run(50).back(), b.run(50).back()));
}

// --- what goes wrong ---------------------------------------------------------------------------------------------------

TEST(ControlLoop, MissingSamplesAreToleratedForAsLongAsItIsPatient) {
  LoopConfig config = small();
  config.patience = 0.01;
  Script s(config);
  s.driver->on_read = [](int i, RawSample&) { return i % 5 == 4 ? Reading::none : Reading::sample; };
  s.enable();
  EXPECT_EQ(s.run(200), 200);
  EXPECT_GT(s.loop->statistics().missing.load(), 30u);
  const int written = s.driver->writes, from = s.driver->reads;
  s.driver->on_read = [](int, RawSample&) { return Reading::none; };
  EXPECT_EQ(s.run(200), 10);
  EXPECT_EQ(s.loop->mode(), Mode::fault);
  EXPECT_TRUE(std::strstr(s.loop->fault(), "no usable sample for 0.01")) << s.loop->fault();
  EXPECT_EQ(s.driver->writes, written) << "a command without a sample of its own";
  EXPECT_EQ(s.driver->reads, from + 11);
  EXPECT_EQ(s.driver->stops, 1);
}

TEST(ControlLoop, SamplesThatAreRefusedAreFollowedByNoCommand) {
  LoopConfig config = small();
  config.patience = 0.02;
  Script s(config);
  s.enable();
  s.run(10);
  const int written = s.driver->writes;
  s.driver->on_read = [](int, RawSample& raw) {
    raw.position[0] = std::numeric_limits<double>::quiet_NaN();
    return Reading::sample;
  };
  s.run(1000);
  EXPECT_EQ(s.loop->mode(), Mode::fault);
  EXPECT_EQ(s.driver->writes, written);
  EXPECT_EQ(s.loop->statistics().refused.load(), 21u);
}

TEST(ControlLoop, WatchingItMayWaitForSamplesForEver) {
  Script s;
  s.driver->on_read = [](int, RawSample&) { return Reading::none; };
  EXPECT_EQ(s.run(5000), 5000);
  Request r;
  r.enabled = true;
  s.loop->request(r);
  EXPECT_EQ(s.run(500), 500);
  EXPECT_EQ(s.driver->enables, 0) << "drives switched on blindly";
}

TEST(ControlLoop, ADriverThatFailsEndsItWithTheDriversWords) {
  for (const int verb : {0, 1, 2}) {
    Script s;
    if (verb == 2) s.driver->willing = false;
    if (verb < 2) s.enable();
    if (verb == 0) s.driver->on_read = [](int, RawSample&) { return Reading::fault; };
    if (verb == 1) s.driver->on_write = [] { return false; };
    Request r;
    r.enabled = true;
    s.loop->request(r);
    s.run(100);
    EXPECT_EQ(s.loop->mode(), Mode::fault) << verb;
    EXPECT_STREQ(s.loop->fault(), "the scripted arm says no");
    EXPECT_EQ(s.driver->stops, 1);
  }
}

TEST(ControlLoop, WithoutAControllerItOnlyWatches) {
  auto driver = std::make_shared<ScriptedDriver>(2, ms);
  ControlLoop loop(two_links(), driver, nullptr, SafetyLimiter(2, LimiterConfig::of(*two_links())), small(), std::make_shared<SteppedClock>());
  loop.begin();
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(loop.tick());
  Request r;
  r.enabled = true;
  loop.request(r);
  EXPECT_FALSE(loop.tick());
  EXPECT_EQ(driver->enables, 0);
  EXPECT_STREQ(loop.fault(), "the session has no controller: it only watches");
}

TEST(ControlLoop, TheEndOfARecordingIsNoFault) {
  Script s;
  s.driver->on_read = [](int i, RawSample&) { return i < 7 ? Reading::sample : Reading::finished; };
  EXPECT_EQ(s.run(100), 7);
  EXPECT_EQ(s.loop->mode(), Mode::stopped);
}

TEST(ControlLoop, AnOwnerThatShowsNoLifeLosesTheArm) {
  LoopConfig config = small();
  config.lease = 0.05;
  Script s(config);
  EXPECT_EQ(s.run(500), 500) << "watching costs nothing";
  s.enable();
  for (int i = 0; i < 20; ++i) {
    s.loop->renew();
    EXPECT_EQ(s.run(40), 40);
  }
  EXPECT_LE(s.run(500), 60);
  EXPECT_EQ(s.loop->mode(), Mode::fault);
  EXPECT_TRUE(std::strstr(s.loop->fault(), "no life for 0.05")) << s.loop->fault();
  EXPECT_EQ(s.driver->stops, 1);
}

TEST(ControlLoop, LostTicksAreCountedOnTheRightAccountAndNotMadeUpFor) {
  struct Slow final : Controller {  // computes for 2.5 ms, once
    SteppedClock* clock;
    int steps = 0;
    explicit Slow(SteppedClock* c) : clock(c) {}
    void start(const Touch&) noexcept override {}
    void ask(const Request&) noexcept override {}
    Wanted step(const Touch&, double, const Inertia<double>&) noexcept override {
      if (++steps == 10) clock->advance(5 * ms / 2);
      return {};
    }
  };
  auto arm = two_links();
  auto clock = std::make_shared<SteppedClock>();
  auto driver = std::make_shared<ScriptedDriver>(2, ms);
  ControlLoop loop(arm, driver, std::make_unique<Slow>(clock.get()), SafetyLimiter(2, LimiterConfig::of(*arm)), small(), clock);
  Request r;
  r.enabled = true;
  loop.request(r);
  loop.begin();
  driver->on_read = [&](int i, RawSample&) {
    if (i == 50) clock->advance(7 * ms / 2);  // the driver takes 3.5 ms, once
    return Reading::sample;
  };
  for (int i = 0; i < 100; ++i) ASSERT_TRUE(loop.tick());
  EXPECT_EQ(loop.statistics().lost().own, 1u);     // 2.5 periods: the next tick begins half a period late, the one between is lost
  EXPECT_EQ(loop.statistics().lost().driver, 2u);
  EXPECT_EQ(loop.statistics().lost().system, 0u);
  clock->advance(4 * ms);  // nobody's fault
  ASSERT_TRUE(loop.tick());
  EXPECT_EQ(loop.statistics().lost().system, 3u);
  EXPECT_EQ(loop.statistics().own.worst(), 5 * ms / 2);
  EXPECT_EQ(loop.statistics().driver.worst(), 7 * ms / 2);
  EXPECT_EQ(loop.statistics().ticks.load(), 101u);
  Record last;
  loop.read_state(last);
  EXPECT_EQ(last.tick, 100u + 6u);  // the number of a tick tells the time
}

TEST(ControlLoop, APacedDriverSetsTheTime) {
  Script s(small(), true);
  s.driver->on_read = [&](int i, RawSample&) {
    s.clock->advance(i == 20 ? 4 * ms : ms);
    return Reading::sample;
  };
  s.enable();
  s.run(60);
  EXPECT_EQ(s.loop->statistics().lost().driver, 3u);
  EXPECT_EQ(s.loop->statistics().lost().own, 0u);
  EXPECT_EQ(s.loop->statistics().lost().system, 0u);
}

TEST(ControlLoop, WhatTheOwnerDoesNotTakeIsCountedAndTheNewestIsInTheBlackBox) {
  Script s;
  s.run(100);
  EXPECT_EQ(s.loop->dropped(), 36u);
  EXPECT_TRUE(s.loop->black_box().empty()) << "somebody still writes";
  Record state;
  EXPECT_TRUE(s.loop->read_state(state));
  EXPECT_FALSE(s.loop->read_state(state));
  EXPECT_EQ(state.tick, 99u);
  s.loop->stop();
  s.loop->tick();
  const std::vector<Record> box = s.loop->black_box();
  ASSERT_EQ(box.size(), 16u);
  for (std::size_t i = 0; i < box.size(); ++i) EXPECT_EQ(box[i].tick, 84 + i);
}

TEST(ControlLoop, ARecordPassesItsShortFormWholeAndNoLongerThanTheArmNeeds) {
  const std::size_t little = RecordFormat(7, false, false).bytes(), all = RecordFormat(max_joints, true, true).bytes();
  EXPECT_LT(3 * little, 2 * sizeof(Record));
  EXPECT_LE(all, sizeof(Record));
  Record r;
  double x = 0.0;
  for (JointVector* v : {&r.raw.position, &r.raw.velocity, &r.raw.effort, &r.raw.model_torque, &r.touch.q, &r.touch.dq, &r.touch.external.torque, &r.touch.external.std,
                         &r.touch.external.noise, &r.touch.contact.torque, &r.touch.contact.std, &r.touch.contact.level, &r.setpoint.q, &r.setpoint.dq, &r.setpoint.ddq,
                         &r.wanted, &r.sent})
    for (double& value : *v) value = ++x;
  r.tick = 7, r.mode = Mode::enabled, r.control = Status::saturated, r.limited = 3, r.tare = 0.1, r.tare_std = 0.2, r.tares = 5;
  r.late_ns = 11, r.read_ns = 12, r.step_ns = 13, r.write_ns = 14;
  r.raw.time_ns = r.touch.time_ns = 99;
  r.touch.status = r.touch.external.status = r.touch.wrench.status = r.touch.contact.status = Status::ok;
  r.touch.payload.mass = 0.25, r.touch.wrench.force = {1, 2, 3}, r.touch.contact.link = 2, r.touch.contact.active = true;
  std::array<std::byte, sizeof(Record)> packed{};
  const auto same_bits = [](const auto& a, const auto& b) { return std::memcmp(&a, &b, sizeof a) == 0; };
  for (const bool flags : {false, true}) {
    r.raw.has_velocity = r.raw.has_model_torque = r.commanded = flags;
    for (const bool more : {false, true}) {
      const RecordFormat format(max_joints, more, more);
      EXPECT_LE(format.pack(r, packed.data()), format.bytes());
      Record out;
      out.raw.velocity.fill(-1.0);
      format.unpack(packed.data(), out);
      EXPECT_TRUE(same(r, out) || !flags);
      EXPECT_EQ(out.raw.time_ns, 99);
      EXPECT_EQ(out.raw.position, r.raw.position);
      EXPECT_EQ(out.raw.velocity, flags ? r.raw.velocity : JointVector{});
      EXPECT_EQ(out.raw.model_torque, flags ? r.raw.model_torque : JointVector{});
      EXPECT_EQ(out.sent, flags ? r.sent : JointVector{});
      EXPECT_EQ(out.wanted, flags ? r.wanted : JointVector{});
      EXPECT_TRUE(same_bits(out.setpoint, flags ? r.setpoint : Setpoint{}));
      EXPECT_EQ(out.touch.external.std, r.touch.external.std);
      EXPECT_EQ(out.touch.external.noise, r.touch.external.noise);
      EXPECT_TRUE(same_bits(out.touch.payload, r.touch.payload));
      EXPECT_EQ(out.touch.wrench.status, Status::ok);
      EXPECT_EQ(out.touch.contact.status, Status::ok);
      EXPECT_EQ(out.touch.wrench.force, more ? r.touch.wrench.force : Wrench{}.force);
      EXPECT_EQ(out.touch.contact.link, more ? 2 : -1);
      EXPECT_EQ(out.touch.contact.level, more ? r.touch.contact.level : JointVector{});
      EXPECT_EQ(out.tick, 7u);
      EXPECT_EQ(out.tares, 5u);
      EXPECT_EQ(out.tare_std, 0.2);
      EXPECT_EQ(out.write_ns, 14);
      EXPECT_EQ(out.limited, 3);
    }
  }
}

TEST(ControlLoop, WhatDoesNotFitIsRefused) {
  auto clock = std::make_shared<SteppedClock>();
  EXPECT_THROW(make_loop(two_links(), std::make_shared<ScriptedDriver>(3, ms), small(), clock), std::invalid_argument);
  EXPECT_THROW(make_loop(two_links(), std::make_shared<ScriptedDriver>(2, 0), small(), clock), std::invalid_argument);
  LoopConfig config = small();
  config.patience = 0.0;
  EXPECT_THROW(make_loop(two_links(), std::make_shared<ScriptedDriver>(2, ms), config, clock), std::invalid_argument);
  config = small();
  config.lease = std::nan("");
  EXPECT_THROW(make_loop(two_links(), std::make_shared<ScriptedDriver>(2, ms), config, clock), std::invalid_argument);
}

}  // namespace
