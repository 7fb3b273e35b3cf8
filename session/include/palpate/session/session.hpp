// Session: a thread of its own for a ControlLoop, and a stop that does not depend on anybody else being well.
#pragma once
#include <atomic>
#include <memory>
#include <thread>
#include <utility>

#include "palpate/session/loop.hpp"
#include "palpate/session/realtime.hpp"

namespace palpate {

/// One thread owns the tick: read, estimate, control, limit, write, record (see ControlLoop, which says who may call what).
///
/// stop(), also by the destructor: the loop's thread is asked to stop the arm, which it does at its next tick, and is
/// waited for. If it has not left after `grace` seconds it is stuck in the driver: then the driver's stop() is called
/// from here, and the thread is left behind with all it needs.
class Session {
 public:
  /// grace [s], > 0.
  Session(std::shared_ptr<ControlLoop> loop, const RealtimeConfig& realtime = {}, double grace = 2.0)
      : shared_(std::make_shared<Shared>(std::move(loop))), realtime_(realtime), grace_(check::positive("Session grace [s]", grace)) {}
  Session(const Session&) = delete;
  Session& operator=(const Session&) = delete;
  ~Session() { stop(); }

  /// Starts the thread; returns when it knows what the operating system grants. Throws std::logic_error if it was started before,
  /// std::system_error if there can be no thread.
  const RealtimeReport& start() {
    if (started_) throw std::logic_error("Session: start() works once");
    started_ = true;
    thread_ = std::thread([shared = shared_, realtime = realtime_] {
      shared->report = enter_realtime(realtime);
      shared->ready.store(true, std::memory_order_release);
      shared->ready.notify_all();
      shared->loop->begin();
      while (shared->loop->tick()) {
      }
      shared->left.store(true, std::memory_order_release);
    });
    shared_->ready.wait(false, std::memory_order_acquire);
    return shared_->report;
  }

  /// Stops the arm and ends the thread. Again is harmless; from any thread but the loop's, one at a time.
  void stop() noexcept {
    shared_->loop->stop();
    if (!started_) shared_->loop->tick();  // by the caller's hand, as every tick of a loop that has no thread
    if (!thread_.joinable()) return;
    MonotonicClock clock;
    const std::int64_t end = clock.now() + static_cast<std::int64_t>(1e9 * grace_);
    while (!left() && clock.now() < end) clock.sleep_until(clock.now() + 1'000'000);
    if (left()) {
      thread_.join();
    } else {
      shared_->loop->give_up();
      thread_.detach();
    }
  }

  /// The thread has left the loop: nothing more comes, and black_box() may be read.
  [[nodiscard]] bool left() const noexcept { return shared_->left.load(std::memory_order_acquire); }
  [[nodiscard]] ControlLoop& loop() noexcept { return *shared_->loop; }
  [[nodiscard]] const ControlLoop& loop() const noexcept { return *shared_->loop; }
  /// What the operating system granted; once started.
  [[nodiscard]] const RealtimeReport& realtime() const noexcept { return shared_->report; }

 private:
  struct Shared {  // outlives the session where the thread does
    explicit Shared(std::shared_ptr<ControlLoop> l) : loop(std::move(l)) {}
    std::shared_ptr<ControlLoop> loop;
    RealtimeReport report;
    std::atomic<bool> ready{false}, left{false};
  };

  std::shared_ptr<Shared> shared_;
  RealtimeConfig realtime_;
  double grace_;
  std::thread thread_;
  bool started_ = false;
};

}  // namespace palpate
