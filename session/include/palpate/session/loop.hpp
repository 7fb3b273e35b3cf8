// ControlLoop: one tick after the other, by whoever's thread it is: read, estimate, control, limit, write, record.
#pragma once
#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "palpate/control/limiter.hpp"
#include "palpate/pipeline.hpp"
#include "palpate/session/clock.hpp"
#include "palpate/session/controller.hpp"
#include "palpate/session/driver.hpp"
#include "palpate/session/histogram.hpp"
#include "palpate/session/latest.hpp"
#include "palpate/session/record.hpp"
#include "palpate/session/ring.hpp"

namespace palpate {

struct LoopConfig {
  PipelineConfig pipeline{};
  double patience = 0.1;          ///< longest time without a usable sample while enabled [s], > 0; beyond: fault
  double lease = 0.0;             ///< longest time without renew() while enabled [s]; 0: the owner need not show life
  std::size_t records = 8192;     ///< capacity of the ring to the owner
  std::size_t black_box = 4096;   ///< the newest so many records are kept for black_box(); 0: none
  std::size_t (*allocations)() noexcept = nullptr;  ///< heap allocations of the calling thread so far, for proofs; nullptr: not counted
};

/// Ticks that never began because the one before was not over or the thread was not woken in time, by who is to blame.
struct LostTicks {
  std::uint64_t own = 0;     ///< the loop's own computing and recording
  std::uint64_t driver = 0;  ///< read() or write() of the driver
  std::uint64_t system = 0;  ///< woken late, or the processor was taken away
};

/// Counted from the start; any thread reads.
struct LoopStatistics {
  Histogram own;     ///< time a tick spent in the loop's own work: estimate, control, limit, record [ns]
  Histogram own_processor;  ///< processor time of the thread for that and write(): without what was taken away [ns]
  Histogram driver;  ///< time in read() and write(); waiting for the period included if the driver is paced [ns]
  Histogram late;    ///< how late ticks began [ns]
  std::atomic<std::uint64_t> ticks{0}, samples{0};
  std::atomic<std::uint64_t> missing{0};  ///< ticks without a sample
  std::atomic<std::uint64_t> refused{0};  ///< samples the conditioner refused: not finite, absurd, or of a wrong time
  std::atomic<std::uint64_t> lost_own{0}, lost_driver{0}, lost_system{0};  ///< see LostTicks
  std::atomic<std::uint64_t> allocations{0};  ///< heap allocations of the loop's own work
  [[nodiscard]] LostTicks lost() const noexcept { return {lost_own.load(), lost_driver.load(), lost_system.load()}; }
};

/// The loop of a session without a thread of its own. tick() is called by one thread; request(), renew(), read_state(),
/// take() by one other, the owner; stop() and everything const by any.
///
/// A tick waits for its time (unless the driver does), reads, steps the pipeline, and, while enabled, controller and
/// safety limiter, writes, and leaves a Record in the ring, in the newest state and in the black box. It allocates, locks
/// and throws nothing itself. A tick that could not begin in its time is lost and counted, never made up for: the
/// next one begins at its own.
///
/// A sample that did not come, or that the conditioner refuses, is followed by no command; the drives go on with the last
/// one, up to `patience` seconds. Beyond that, when the driver fails, or when the owner shows no sign of life for
/// `lease` seconds, the loop calls the driver's stop() and is over: mode() says fault, fault() why.
class ControlLoop {
 public:
  /// controller: nullptr for a session that only watches; switching on is then a fault.
  /// Throws std::invalid_argument: something does not fit together.
  ControlLoop(std::shared_ptr<const Arm> arm, std::shared_ptr<Driver> driver, std::unique_ptr<Controller> controller, const SafetyLimiter& limiter,
              const LoopConfig& config, std::shared_ptr<Clock> clock)
      : arm_(std::move(arm)),
        driver_(std::move(driver)),
        controller_(std::move(controller)),
        clock_(std::move(clock)),
        config_(config),
        pipeline_(arm_, config.pipeline),
        limiter_(limiter),
        format_(arm_->n(), config.pipeline.wrench.has_value(), config.pipeline.contact.has_value()),
        ring_(std::max(config.records, config.black_box), format_.bytes()),
        spilled_(config.black_box),
        period_(driver_->period_ns()),
        patience_(nanoseconds(check::positive("LoopConfig patience [s]", config.patience))),
        lease_(nanoseconds(check::not_negative("LoopConfig lease [s]", config.lease))) {
    if (driver_->joints() != arm_->n())
      throw std::invalid_argument("ControlLoop: the driver has " + std::to_string(driver_->joints()) + " joints, the arm " + std::to_string(arm_->n()));
    if (period_ <= 0) throw std::invalid_argument("ControlLoop: the driver's period must be > 0 ns");
  }

  /// Begin now: the first tick is due at once. By the thread that will tick.
  void begin() noexcept {
    due_ = clock_->now();
    heard_ = good_ = end_ = due_;
    if (driver_->paced()) due_ += period_;
  }

  /// One tick. False: the loop is over, mode() says how; then it stays so.
  bool tick() noexcept {
    if (over()) return false;
    if (stop_.load(std::memory_order_acquire)) return finish(Mode::stopped);
    if (!driver_->paced()) clock_->sleep_until(due_);
    const std::int64_t wake = clock_->now();
    Record& r = record_;
    r.tick = tick_++;
    r.mode = mode();
    r.commanded = false;
    r.control = Status::held;
    r.limited = 0;
    const Reading reading = driver_->read(r.raw);
    const std::int64_t processor = clock_->thread_time();
    const std::int64_t arrived = clock_->now();
    const std::size_t allocated = allocations();
    r.late_ns = std::max<std::int64_t>(0, (driver_->paced() ? arrived : wake) - due_);
    account(r.late_ns);
    r.read_ns = arrived - wake;
    if (reading == Reading::fault) return fail(driver_->complaint());
    if (reading == Reading::finished) return finish(Mode::stopped);

    if (box_.renew()) request_ = box_.newest();
    watch(arrived);
    bool usable = false;
    JointVector torque{};
    if (reading == Reading::sample) {
      r.touch = pipeline_.step(r.raw);
      usable = r.touch.status != Status::non_finite && r.touch.status != Status::time_error;
      if (usable) {
        good_ = arrived;
        torque = decide(r);
      } else {
        count(statistics_.refused);
      }
    } else {
      count(statistics_.missing);
    }
    const std::int64_t decided = clock_->now();
    r.step_ns = decided - arrived;
    std::size_t allocated_own = allocations() - allocated;

    if (usable && r.mode == Mode::enabled) {
      if (!driver_->write(torque, r.sent)) return fail(driver_->complaint());
      r.commanded = true;
    }
    const std::int64_t written = clock_->now();
    const std::size_t allocated_after = allocations();
    r.write_ns = written - decided;
    if (reading == Reading::sample) {
      count(statistics_.samples);
      publish(r);
    }
    count(statistics_.ticks);
    end_ = clock_->now();
    allocated_own += allocations() - allocated_after;
    own_ = r.step_ns + (end_ - written);
    driver_time_ = (driver_->paced() ? 0 : r.read_ns) + r.write_ns;
    own_processor_ = clock_->thread_time() - processor;
    statistics_.own.add(own_);
    statistics_.own_processor.add(own_processor_);
    statistics_.driver.add(r.read_ns + r.write_ns);
    if (allocated_own != 0) statistics_.allocations.fetch_add(allocated_own, std::memory_order_relaxed);

    due_ = (driver_->paced() ? arrived : due_) + period_;
    if (r.mode == Mode::enabled) {
      if (arrived - good_ > patience_) return fail("no usable sample", arrived - good_);
      if (lease_ > 0 && arrived - heard_ > lease_) return fail("the program that owns the session has shown no life", arrived - heard_);
    }
    return !over() && (request_.enabled == (r.mode == Mode::enabled) || change(usable));
  }

  // --- the owner's side ------------------------------------------------------------------------------------------

  /// Replaces the request of before. Wait-free; taken at the next tick.
  void request(const Request& request) noexcept {
    box_.write(request);
    renew();
  }
  /// A sign of life, see LoopConfig::lease. Wait-free.
  void renew() noexcept { signs_.fetch_add(1, std::memory_order_relaxed); }
  /// The newest record; false: it is the one of before. Wait-free.
  bool read_state(Record& out) noexcept {
    const bool newer = state_.renew();
    if (!seen_ && !newer) return false;
    seen_ = true;
    format_.unpack(state_.newest().data(), out);
    return newer;
  }
  /// The oldest record that was not taken yet. Wait-free.
  bool take(Record& out) noexcept {
    const std::byte* packed = ring_.front();
    if (packed == nullptr) return false;
    format_.unpack(packed, out);
    ring_.pop();
    return true;
  }
  /// How many of the drives' switchings on or off are done, see Request::enabled.
  [[nodiscard]] std::uint64_t switched() const noexcept { return switched_.load(std::memory_order_acquire); }

  // --- any thread ------------------------------------------------------------------------------------------------

  /// The arm is stopped at the next tick, and the loop is over. Wait-free; again is harmless.
  void stop() noexcept { stop_.store(true, std::memory_order_release); }
  [[nodiscard]] Mode mode() const noexcept { return mode_.load(std::memory_order_acquire); }
  [[nodiscard]] bool over() const noexcept { return mode() >= Mode::stopped; }
  /// Why it ended; empty unless mode() is fault.
  [[nodiscard]] const char* fault() const noexcept { return mode() == Mode::fault ? fault_ : ""; }
  [[nodiscard]] const LoopStatistics& statistics() const noexcept { return statistics_; }
  /// Records that did not fit into the ring.
  [[nodiscard]] std::uint64_t dropped() const noexcept { return ring_.dropped(); }
  [[nodiscard]] const Arm& arm() const noexcept { return *arm_; }
  [[nodiscard]] std::int64_t period_ns() const noexcept { return period_; }
  [[nodiscard]] Driver& driver() const noexcept { return *driver_; }

  /// The newest records, oldest first. Only when the loop is over and its thread has left tick(); else none.
  [[nodiscard]] std::vector<Record> black_box() const {
    std::vector<Record> out;
    if (!over()) return out;
    for (std::size_t age = 0; age < config_.black_box; ++age) {
      const std::byte* packed = ring_.back(age);
      if (packed == nullptr) break;
      format_.unpack(packed, out.emplace_back());
    }
    out.insert(out.end(), spilled_.begin(), spilled_.begin() + static_cast<std::ptrdiff_t>(std::min<std::uint64_t>(spills_, spilled_.size())));
    std::sort(out.begin(), out.end(), [](const Record& a, const Record& b) { return a.tick < b.tick; });
    if (out.size() > config_.black_box) out.erase(out.begin(), out.end() - static_cast<std::ptrdiff_t>(config_.black_box));
    return out;
  }

  /// End it from outside, for the last resort: the thread that ticks is stuck.
  void give_up() noexcept {
    stop();
    driver_->stop();
  }

 private:
  static std::int64_t nanoseconds(double s) noexcept { return static_cast<std::int64_t>(std::llround(std::min(s, 1e9) * 1e9)); }
  static double seconds(std::int64_t ns) noexcept { return 1e-9 * static_cast<double>(ns); }
  static void count(std::atomic<std::uint64_t>& n, std::uint64_t more = 1) noexcept {
    n.store(n.load(std::memory_order_relaxed) + more, std::memory_order_relaxed);  // one writer
  }
  [[nodiscard]] std::size_t allocations() const noexcept { return config_.allocations == nullptr ? 0 : config_.allocations(); }

  /// Ticks that a late beginning has swallowed, and on whose account they are.
  void account(std::int64_t late) noexcept {
    statistics_.late.add(late);
    if (late < period_) return;
    const std::int64_t lost = late / period_;
    const bool ran_over = end_ > due_;  // the tick before
    due_ += lost * period_;
    tick_ += static_cast<std::uint64_t>(lost);
    record_.tick += static_cast<std::uint64_t>(lost);
    std::atomic<std::uint64_t>* account = &statistics_.lost_system;
    if (ran_over ? driver_time_ > own_ : driver_->paced()) account = &statistics_.lost_driver;
    else if (ran_over && 2 * own_processor_ >= own_) account = &statistics_.lost_own;
    count(*account, static_cast<std::uint64_t>(lost));
  }

  /// Signs of life of the owner.
  void watch(std::int64_t now) noexcept {
    const std::uint64_t signs = signs_.load(std::memory_order_relaxed);
    if (signs != signs_seen_) {
      signs_seen_ = signs;
      heard_ = now;
    }
  }

  /// The torque to be sent for a usable sample [N m].
  JointVector decide(Record& r) noexcept {
    if (request_.tare != r.tares && r.touch.payload.status == Status::ok) {
      r.tares = request_.tare;
      r.tare = r.touch.payload.mass;
      r.tare_std = r.touch.payload.mass_std;
    }
    const double dt = sampled_ ? std::max(0.0, seconds(r.raw.time_ns - sample_ns_)) : seconds(period_);
    sampled_ = true;
    sample_ns_ = r.raw.time_ns;
    if (r.mode != Mode::enabled) return {};
    controller_->ask(request_);
    const Inertia<double> load = pipeline_.load();
    const Wanted wanted = controller_->step(r.touch, dt, load);
    const LimitedCommand limited = limiter_.step(wanted.command, r.touch.q, r.touch.dq, gravity_torque<double>(*arm_, r.touch.q, load), dt);
    r.setpoint = wanted.setpoint;
    r.wanted = wanted.command.torque;
    r.control = limited.command.status;
    r.limited = limited.limited;
    return limited.command.torque;
  }

  void publish(const Record& r) noexcept {
    const std::byte* const packed = state_.draft().data();
    const std::size_t size = format_.pack(r, state_.draft().data());
    if (std::byte* slot = ring_.draft()) {
      std::memcpy(slot, packed, size);
      ring_.push();
    } else if (!spilled_.empty()) {
      spilled_[spills_++ % spilled_.size()] = r;
    }
    state_.publish();
  }

  /// Drives on or off, as requested. Switching on waits for a usable sample, may take long, and starts the time anew.
  bool change(bool usable) noexcept {
    if (request_.enabled) {
      if (!usable) return true;
      if (controller_ == nullptr) return fail("the session has no controller: it only watches");
      if (!driver_->enable()) return fail(driver_->complaint());
      limiter_.reset();
      controller_->start(record_.touch);
      mode_.store(Mode::enabled, std::memory_order_release);
    } else {
      driver_->stop();
      mode_.store(Mode::watching, std::memory_order_release);
    }
    due_ = clock_->now() + (driver_->paced() ? period_ : 0);
    heard_ = good_ = end_ = clock_->now();
    switched_.fetch_add(1, std::memory_order_release);
    return true;
  }

  bool finish(Mode how) noexcept {
    driver_->stop();
    mode_.store(how, std::memory_order_release);
    return false;
  }
  bool fail(const char* why) noexcept {
    std::snprintf(fault_, sizeof fault_, "%s", why);  // before stop(), which may change the driver's words
    return finish(Mode::fault);
  }
  bool fail(const char* what, std::int64_t ns) noexcept {
    std::snprintf(fault_, sizeof fault_, "%s for %.3f s", what, seconds(ns));
    return finish(Mode::fault);
  }

  std::shared_ptr<const Arm> arm_;
  std::shared_ptr<Driver> driver_;
  std::unique_ptr<Controller> controller_;
  std::shared_ptr<Clock> clock_;
  LoopConfig config_;
  Pipeline pipeline_;
  SafetyLimiter limiter_;
  RecordFormat format_;
  Ring ring_;  // to the owner; what was taken stays for black_box() until its place is used again
  Latest<std::array<std::byte, sizeof(Record)>> state_;
  Latest<Request> box_;
  std::vector<Record> spilled_;  // the newest that did not fit into the ring
  std::int64_t period_, patience_, lease_;  // [ns]
  LoopStatistics statistics_;
  std::atomic<bool> stop_{false};
  std::atomic<Mode> mode_{Mode::watching};
  std::atomic<std::uint64_t> signs_{0}, switched_{0};
  char fault_[256] = "";

  // the ticking thread's own
  Record record_{};
  Request request_{};
  std::uint64_t tick_ = 0, signs_seen_ = 0, spills_ = 0;
  std::int64_t due_ = 0;                               // when the next tick should begin [ns]
  std::int64_t good_ = 0, heard_ = 0;                  // last usable sample, last sign of life [ns]
  std::int64_t end_ = 0, own_ = 0, driver_time_ = 0, own_processor_ = 0;  // of the tick before [ns]
  std::int64_t sample_ns_ = 0;
  bool sampled_ = false;

  bool seen_ = false;  // by the owner: there is a state
};

}  // namespace palpate
