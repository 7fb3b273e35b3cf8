// Conditioner: what a driver read becomes a sample fit for estimation, or is refused with a reason.
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <numbers>

#include "palpate/check.hpp"
#include "palpate/filter.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// Where the velocity comes from.
enum class VelocitySource {
  driver,         ///< the driver's if the sample has one, else the difference of positions
  differentiate,  ///< always the difference of positions
};

struct ConditionerConfig {
  VelocitySource velocity = VelocitySource::driver;
  DifferentiatorConfig differentiator{};
  double max_gap = 0.1;         ///< longest time between two samples that still belong together [s]
  double max_position = 1e6;    ///< larger |q| is no position [rad]
  double max_velocity = 1e4;    ///< larger |dq| is no velocity [rad/s]
  double max_torque = 1e6;      ///< larger |effort * gain| is no torque [N m]
  int clock_restart = 10;       ///< so many refused stamps in a row, rising among themselves, are a clock set back [samples]
};

/// RawSample -> JointSample:  tau = effort_gain * effort,  dt = t - t_last,  dq measured or differentiated.
///
/// effort_gain: link-side torque per unit of the driver's effort, [N m/A] or 1 for [N m]; a negative one turns the sign.
/// tau is the torque applied during the interval that ended at this sample: a driver that can only tell what it
/// commands reports the command that was in force up to the reading, not the one it is about to send.
///
/// Status of the result:
///   ok          use it
///   warming     q and tau are good, dq is not yet (zero, or a slope over fewer points than configured)
///   gap         more than max_gap since the last sample, or a new time base (see clock_restart; dt is 0 then). q and
///               tau are good; a differentiated dq is the mean over the gap, or the last one if its length is unknown
///   time_error  time stood still or ran backwards. Not used: dt is 0, q, dq, tau repeat the last accepted sample
///   non_finite  NaN, infinity or an absurd number, a jump faster than max_velocity included. Not used, as above
/// A refused sample changes nothing: the next good one continues from the last accepted one. A model torque that is not
/// finite is dropped alone (has_model_torque = false), since q, dq and tau are still good.
class Conditioner {
 public:
  Conditioner(int n, const JointVector& effort_gain, const ConditionerConfig& config = {})
      : n_(static_cast<std::size_t>(check::in_range("Conditioner n", n, 1, max_joints))),
        gain_(effort_gain),
        config_(config),
        differentiator_(n, config.differentiator) {
    for (std::size_t j = 0; j < n_; ++j)
      if (!std::isfinite(gain_[j]) || gain_[j] == 0.0)
        check::fail(check::entry("Conditioner effort_gain", j, "N m per unit"), gain_[j], "a finite number other than 0");
    check::positive("ConditionerConfig max_gap [s]", config.max_gap);
    check::positive("ConditionerConfig max_position [rad]", config.max_position);
    check::positive("ConditionerConfig max_velocity [rad/s]", config.max_velocity);
    check::positive("ConditionerConfig max_torque [N m]", config.max_torque);
    check::in_range("ConditionerConfig clock_restart [samples]", config.clock_restart, 2, 1000000);
  }

  JointSample step(const RawSample& raw) noexcept {
    bool restarted = false;
    if (started_ && raw.time_ns <= last_.time_ns) {
      refused_stamps_ = refused_stamps_ > 0 && raw.time_ns > refused_time_ ? refused_stamps_ + 1 : 1;
      refused_time_ = raw.time_ns;
      if (refused_stamps_ < config_.clock_restart) return refuse(raw.time_ns, Status::time_error);
      restarted = true;
    }
    const bool measured = raw.has_velocity && config_.velocity == VelocitySource::driver;
    if (!plausible(raw, measured)) return refuse(raw.time_ns, Status::non_finite);

    JointSample s;
    s.time_ns = raw.time_ns;
    if (started_ && !restarted) s.dt = seconds_between(last_.time_ns, raw.time_ns);
    if (!measured && s.dt > 0.0 && jumped(raw.position, s.dt)) return refuse(raw.time_ns, Status::non_finite);

    const bool gap = restarted || s.dt > config_.max_gap;
    if (gap) differentiator_.reset();
    differentiator_.step(raw.time_ns, raw.position);
    if (!gap && s.dt > 0.0) noise_gain_ = differentiator_.noise_gain();
    if (gap && !restarted) noise_gain_ = std::numbers::sqrt2 / s.dt;
    s.has_model_torque = raw.has_model_torque && check::all_finite(raw.model_torque, n_);
    for (std::size_t j = 0; j < n_; ++j) {
      s.q[j] = raw.position[j];
      s.tau[j] = gain_[j] * raw.effort[j];
      if (s.has_model_torque) s.model_torque[j] = raw.model_torque[j];
      if (measured) s.dq[j] = raw.velocity[j];
      else if (!gap) s.dq[j] = differentiator_.value()[j];
      else s.dq[j] = restarted ? last_.dq[j] : (s.q[j] - last_.q[j]) / s.dt;
    }
    s.velocity_measured = measured;
    s.status = gap ? Status::gap : measured ? Status::ok : differentiator_.status();
    last_ = s;
    started_ = true;
    refused_stamps_ = 0;
    return s;
  }

  /// Standard deviation of the last differentiated velocity per standard deviation of the positions [1/s], a low-pass not
  /// counted; 0 before there is one.
  [[nodiscard]] double velocity_noise_gain() const noexcept { return noise_gain_; }

  void reset() noexcept {
    differentiator_.reset();
    noise_gain_ = 0.0;
    last_ = {};
    started_ = false;
    refused_stamps_ = 0;
  }

 private:
  [[nodiscard]] bool plausible(const RawSample& raw, bool measured) const noexcept {
    for (std::size_t j = 0; j < n_; ++j) {  // written so that a NaN fails
      if (!(std::abs(raw.position[j]) <= config_.max_position)) return false;
      if (!(std::abs(raw.effort[j] * gain_[j]) <= config_.max_torque)) return false;
      if (measured && !(std::abs(raw.velocity[j]) <= config_.max_velocity)) return false;
    }
    return true;
  }

  [[nodiscard]] bool jumped(const JointVector& q, double dt) const noexcept {
    for (std::size_t j = 0; j < n_; ++j)
      if (std::abs(q[j] - last_.q[j]) > config_.max_velocity * dt) return true;
    return false;
  }

  [[nodiscard]] JointSample refuse(std::int64_t time_ns, Status why) const noexcept {
    JointSample s = last_;
    s.time_ns = time_ns;
    s.dt = 0.0;
    s.has_model_torque = false;
    s.model_torque = {};
    s.status = why;
    return s;
  }

  std::size_t n_;
  JointVector gain_;
  ConditionerConfig config_;
  Differentiator<> differentiator_;
  double noise_gain_ = 0.0;        // of the differentiated velocity [1/s]
  JointSample last_{};             // the last accepted one
  bool started_ = false;
  int refused_stamps_ = 0;         // refused for their time in a row, each later than the one before
  std::int64_t refused_time_ = 0;  // newest of them [ns]
};

}  // namespace palpate
