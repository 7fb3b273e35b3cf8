// JointVelocity: joint velocity from positions, with the published filters, on the reader's or on the sender's clock.
#pragma once
#include "palpate/filter.hpp"
#include "palpate/sender_clock.hpp"

namespace palpate {

struct JointVelocityConfig {
  bool recover_clock = true;    ///< divide by the sender's time between measurements; false: by the time between looks
  SenderClockConfig sender{};
  int average = 1;              ///< mean of so many velocities, 1 to JointVelocity::longest_average; 1: none
  double time_constant = 0.0;   ///< of a first-order low-pass [s]; 0: none
  Lag lag = Lag::published;     ///< how that is discretised
};

/// W "Velocity Estimation" (MATH.md section 8):  v = (q_k - q_{k-1}) / (t_k - t_{k-1}),  then a mean over the last `average`
/// velocities, then  v <- (1 - a) v + a v_raw,  a = h/(h + tau_f).
///
/// On the sender's clock (SenderClock) a position read twice leaves the velocity as it is, memory that nobody has written to yet
/// gives none (status warming), and nothing is differenced across a jump or an interruption (status gap). The first position has
/// no velocity: differencing it from 0 is erratum 5 of W.
class JointVelocity {
 public:
  static constexpr int longest_average = 64;

  explicit JointVelocity(int n, const JointVelocityConfig& config = {})
      : recover_(config.recover_clock), clock_(n, config.sender), average_(n, config.average), low_pass_(n, config.time_constant, config.lag), n_(n) {}

  /// dq [rad/s] from the position q [rad] that was read at time_ns.
  const JointVector& step(std::int64_t time_ns, const JointVector& q) noexcept {
    SenderStamp stamp;
    if (recover_) {
      stamp = clock_.step(time_ns, q);
    } else {
      stamp.fresh = true;
      if (!check::all_finite(q, static_cast<std::size_t>(n_))) stamp.status = Status::non_finite;
      else if (started_ && time_ns <= time_ns_) stamp.status = Status::time_error;
      else {
        stamp.interval = started_ ? seconds_between(time_ns_, time_ns) : 0.0;
        stamp.status = started_ ? Status::ok : Status::warming;
        time_ns_ = time_ns;
      }
    }
    status_ = stamp.status;
    if (status_ == Status::non_finite || status_ == Status::time_error) return v_;
    if (status_ == Status::gap) {
      average_.reset();
      low_pass_.reset();
      v_ = {};
    }
    if (stamp.fresh && stamp.interval > 0.0 && started_) {
      JointVector raw{};
      for (std::size_t j = 0; j < static_cast<std::size_t>(n_); ++j) raw[j] = (q[j] - q_[j]) / stamp.interval;
      v_ = low_pass_.step(average_.step(raw), stamp.interval);
    }
    if (stamp.fresh || !started_) q_ = q;
    started_ = true;
    return v_;
  }

  [[nodiscard]] const JointVector& value() const noexcept { return v_; }
  [[nodiscard]] Status status() const noexcept { return status_; }
  [[nodiscard]] const SenderClock& clock() const noexcept { return clock_; }

  void reset() noexcept {
    clock_.reset();
    average_.reset();
    low_pass_.reset();
    v_ = q_ = {};
    started_ = false;
    status_ = Status::warming;
  }

 private:
  bool recover_;
  SenderClock clock_;
  MovingAverage<longest_average> average_;
  FirstOrder<> low_pass_;
  int n_;
  JointVector q_{}, v_{};
  std::int64_t time_ns_ = 0;
  bool started_ = false;
  Status status_ = Status::warming;
};

}  // namespace palpate
