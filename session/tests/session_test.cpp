// Session: a thread around the loop that can always be ended. Waits for conditions; judges no time.
#include "palpate/session/session.hpp"

#include <gtest/gtest.h>

#include <atomic>
#include <memory>
#include <stdexcept>
#include <thread>
#include <vector>

#include "bench.hpp"

using namespace palpate;
using namespace palpate_test;

namespace {

constexpr RealtimeConfig plain{.priority = 0, .lock_memory = false};

/// Stands in the way of read() until told.
class StuckDriver final : public Driver {
 public:
  std::atomic<bool> released{false}, reading{false};
  std::atomic<int> stops{0};
  int joints() const noexcept override { return 2; }
  std::int64_t period_ns() const noexcept override { return 1'000'000; }
  bool paced() const noexcept override { return true; }
  bool enable() noexcept override { return true; }
  Reading read(RawSample&) noexcept override {
    reading.store(true);
    reading.notify_all();
    released.wait(false);
    return Reading::none;
  }
  bool write(const JointVector&, JointVector&) noexcept override { return true; }
  void stop() noexcept override { ++stops; }
  const char* complaint() const noexcept override { return ""; }
};

TEST(Session, AThreadInSimulatedTimeGivesTheRunOfTicksByHand) {
  const auto arm = two_links();
  constexpr int ticks = 400;
  const auto run = [&](bool threaded) {
    LoopConfig config = small();
    config.records = 2 * ticks;  // the newest are dropped, not the first
    auto driver = std::make_shared<SimulatedArm>(arm, SimulatedArmConfig{});
    auto loop = make_loop(arm, driver, config, std::make_shared<SteppedClock>());
    Request request;
    request.enabled = true;
    request.goal = 1;
    request.position = {0.5, 0.2};
    request.duration = 0.3;
    loop->request(request);
    std::vector<JointVector> sent;
    Record r;
    if (threaded) {
      Session session(loop, plain);
      session.start();
      while (sent.size() < ticks)
        if (loop->take(r)) sent.push_back(r.sent);
    } else {
      loop->begin();
      while (sent.size() < ticks) loop->tick(), loop->take(r), sent.push_back(r.sent);
    }
    return sent;
  };
  const auto a = run(true), b = run(false);
  EXPECT_EQ(a, b);
}

TEST(Session, TheDestructorStopsTheArm) {
  auto arm = two_links();
  auto driver = std::make_shared<ScriptedDriver>(2, 1'000'000);
  auto loop = make_loop(arm, driver, small(), std::make_shared<MonotonicClock>());
  Request request;
  request.enabled = true;
  loop->request(request);
  {
    Session session(loop, plain);
    session.start();
    while (loop->mode() != Mode::enabled) std::this_thread::yield();
  }
  EXPECT_EQ(loop->mode(), Mode::stopped);
  EXPECT_EQ(driver->stops, 1);
}

TEST(Session, NeverStartedItStillLeavesTheArmStopped) {
  auto driver = std::make_shared<ScriptedDriver>(2, 1'000'000);
  {
    Session session(make_loop(two_links(), driver, small(), std::make_shared<MonotonicClock>()), plain);
    session.stop();
  }
  EXPECT_GE(driver->stops, 1);
}

TEST(Session, ADriverThatNeverReturnsIsStoppedFromOutside) {
  auto driver = std::make_shared<StuckDriver>();
  {
    Session session(make_loop(two_links(), driver, small(), std::make_shared<MonotonicClock>()), plain, 0.01);
    session.start();
    driver->reading.wait(false);
    session.stop();
    EXPECT_FALSE(session.left());
    EXPECT_EQ(driver->stops, 1);
  }
  driver->released.store(true);  // the thread that was left behind goes its way
  driver->released.notify_all();
  while (driver.use_count() > 1) std::this_thread::yield();
  EXPECT_EQ(driver->stops, 2);
}

TEST(Session, StartsOnce) {
  Session session(make_loop(two_links(), std::make_shared<ScriptedDriver>(2, 1'000'000), small(), std::make_shared<MonotonicClock>()), plain);
  const RealtimeReport& report = session.start();
  EXPECT_FALSE(report.fifo || report.locked || report.pinned);
  EXPECT_EQ(report.complaint, "");
  EXPECT_THROW(session.start(), std::logic_error);
}

TEST(Session, WhatTheSystemRefusesIsSaid) {
  Session session(make_loop(two_links(), std::make_shared<ScriptedDriver>(2, 1'000'000), small(), std::make_shared<MonotonicClock>()),
                  {.priority = 1000, .lock_memory = false, .processor = 100000});
  const RealtimeReport& report = session.start();
  EXPECT_FALSE(report.fifo);
  EXPECT_FALSE(report.pinned);
  EXPECT_NE(report.complaint.find("SCHED_FIFO"), std::string::npos);
  EXPECT_NE(report.complaint.find("processor"), std::string::npos);
}

}  // namespace
