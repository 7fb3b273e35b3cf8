// Extended Kalman filter on joint positions and velocities, with the external torque as optional states.
#pragma once
#include "palpate/check.hpp"
#include "palpate/kalman.hpp"

namespace palpate {

struct ExtendedKalmanConfig {
  bool disturbance = true;              ///< estimate tau_ext too; else the filter only smooths (q, q') of an untouched arm
  double disturbance_rate = 5.0;        ///< growth of the external torque's standard deviation [N m / sqrt(s)]
  double disturbance_prior_std = 50.0;  ///< of tau_ext at the start [N m]
  double velocity_prior_std = 1.0;      ///< of q' at the start [rad/s]
  double model_torque_std = 0.0;        ///< error of the arm's model, white per sample, beside the drives' own [N m]
  double friction_fraction = 0.3;       ///< error of the friction model in motion, part of Coulomb friction [1]
  double max_step = 0.02;               ///< longer intervals are predicted in several steps [s]
};

/// R eqs. (9)-(14) in discrete form, with the errata of MATH.md section 1: H = [1 0], friction in f, the exact Jacobian.
///
///   x = (q, q', tau_ext):  M q'' + C q' + g + tau_f = tau + tau_ext,  tau_ext' = w_d;   z = q (and q' where its std is declared)
///
/// Prediction and Joseph-form update: kalman.hpp. With disturbance = false the external torque is not estimated and
/// its status is `held`.
class ExtendedKalman {
 public:
  explicit ExtendedKalman(const Arm& arm, const ExtendedKalmanConfig& config = {})
      : arm_(&arm), config_(config), filter_(arm.n(), 0, config.disturbance, false) {
    if (!arm.has_dynamics()) throw std::invalid_argument("ExtendedKalman: the arm has no masses; give inertials");
    check::not_negative("ExtendedKalmanConfig disturbance_rate [N m/sqrt(s)]", config.disturbance_rate);
    check::positive("ExtendedKalmanConfig disturbance_prior_std [N m]", config.disturbance_prior_std);
    check::positive("ExtendedKalmanConfig velocity_prior_std [rad/s]", config.velocity_prior_std);
    check::not_negative("ExtendedKalmanConfig model_torque_std [N m]", config.model_torque_std);
    check::not_negative("ExtendedKalmanConfig friction_fraction [1]", config.friction_fraction);
    check::positive("ExtendedKalmanConfig max_step [s]", config.max_step);
    decay_.fill(1.0);
    for (int i = 0; i < arm.n(); ++i)
      torque_variance_[detail::at(i)] = arm.torque_variance(i) + config.model_torque_std * config.model_torque_std;
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (s.status == Status::non_finite || s.status == Status::time_error) return report(Status::held);
    tau_ = s.tau;
    if (!started_ || s.status == Status::gap || !(s.dt > 0.0)) {
      start(s, true);
      return report(s.status == Status::gap ? Status::gap : Status::warming);
    }
    const int steps = 1 + static_cast<int>(s.dt / config_.max_step);
    const double h = s.dt / steps;
    const double growth = config_.disturbance_rate * config_.disturbance_rate * h;
    for (int k = 0; k < steps; ++k) {
      filter_.predict(*arm_, {s.tau, torque_variance_, Inertia<double>{}, Inertia<double>{}, decay_}, h,
                      [](const BaseFrame&, double*, int) {});
      if (config_.disturbance)
        for (int i = 0; i < arm_->n(); ++i) filter_.add_parameter_variance(i, growth);
    }
    filter_.measure_joints(*arm_, s, [](int, int, const auto&) {});
    if (!filter_.healthy()) {  // start over rather than report what came out of it
      start(s, false);
      return report(Status::warming);
    }
    return report(learnt() ? Status::ok : Status::warming);
  }

  void reset() { *this = ExtendedKalman(*arm_, config_); }

  /// How late the external torque is [s], the slowest joint's: variance over disturbance_rate^2. That is the delay at low
  /// frequencies of any settled Kalman filter that follows a random walk; infinite without a disturbance.
  double lag() const noexcept {
    double slowest = 0.0;
    for (int i = 0; i < arm_->n(); ++i)
      slowest = std::max(slowest, config_.disturbance ? filter_.parameter_variance(i) / square(config_.disturbance_rate)
                                                      : std::numeric_limits<double>::infinity());
    return slowest;
  }

  JointVector positions() const noexcept { return filter_.positions(); }
  JointVector velocities() const noexcept { return filter_.velocities(); }
  const JointKalman<max_joints>& filter() const noexcept { return filter_; }

 private:
  static constexpr double square(double x) noexcept { return x * x; }

  /// Nothing is known of the external torque now; the last estimate is its mean if it is worth that.
  void start(const JointSample& s, bool keep_mean) noexcept {
    filter_.start(*arm_, s, config_.velocity_prior_std);
    if (config_.disturbance)
      for (int i = 0; i < arm_->n(); ++i)
        filter_.set_parameter(i, keep_mean ? filter_.parameter(i) : 0.0, square(config_.disturbance_prior_std));
    started_ = true;
  }
  bool learnt() const noexcept {
    if (config_.disturbance)
      for (int i = 0; i < arm_->n(); ++i)
        if (filter_.parameter_variance(i) > square(0.5 * config_.disturbance_prior_std)) return false;
    return true;
  }
  ExternalTorque report(Status status) const noexcept {
    ExternalTorque out;
    out.status = config_.disturbance ? status : Status::held;
    if (config_.disturbance)
      for (int i = 0; i < arm_->n(); ++i) {
        const auto u = detail::at(i);
        out.torque[u] = filter_.parameter(i);
        const double friction = arm_->joint(i).friction.uncertainty(filter_.dq(i), config_.friction_fraction, tau_[u]);
        out.noise[u] = std::sqrt(filter_.parameter_variance(i));
        out.std[u] = std::hypot(out.noise[u], friction);
      }
    return out;
  }

  const Arm* arm_;
  ExtendedKalmanConfig config_;
  JointKalman<max_joints> filter_;
  JointVector torque_variance_{}, tau_{};
  JointKalman<max_joints>::Parameters decay_{};
  bool started_ = false;
};

}  // namespace palpate
