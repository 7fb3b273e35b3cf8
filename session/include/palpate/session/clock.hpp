// Clocks a loop can live by: the computer's, and one that only moves when told.
#pragma once
#include <time.h>

#include <cstdint>

namespace palpate {

/// What a loop waits and measures by.
class Clock {
 public:
  virtual ~Clock() = default;
  /// Now [ns]; never runs backwards.
  [[nodiscard]] virtual std::int64_t now() noexcept = 0;
  /// Processor time of the calling thread [ns].
  [[nodiscard]] virtual std::int64_t thread_time() noexcept = 0;
  /// Returns when now() >= time [ns]; at once if it is already.
  virtual void sleep_until(std::int64_t time) noexcept = 0;
};

/// CLOCK_MONOTONIC.
class MonotonicClock final : public Clock {
 public:
  [[nodiscard]] std::int64_t now() noexcept override { return read(CLOCK_MONOTONIC); }
  [[nodiscard]] std::int64_t thread_time() noexcept override { return read(CLOCK_THREAD_CPUTIME_ID); }
  void sleep_until(std::int64_t time) noexcept override {
    const timespec t{static_cast<time_t>(time / 1'000'000'000), static_cast<long>(time % 1'000'000'000)};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, nullptr) != 0) {
    }
  }

 private:
  static std::int64_t read(clockid_t id) noexcept {
    timespec t;
    clock_gettime(id, &t);
    return std::int64_t{t.tv_sec} * 1'000'000'000 + t.tv_nsec;
  }
};

/// Simulated time: waiting moves it on, nothing else takes time. A loop that lives by it gives the same run on any computer.
class SteppedClock : public Clock {
 public:
  [[nodiscard]] std::int64_t now() noexcept override { return now_; }
  [[nodiscard]] std::int64_t thread_time() noexcept override { return now_; }
  void sleep_until(std::int64_t time) noexcept override { now_ = now_ < time ? time : now_; }
  void advance(std::int64_t ns) noexcept { now_ += ns; }

 private:
  std::int64_t now_ = 0;
};

}  // namespace palpate
