// Tare: correct the links' masses from a motion with nothing in the hand, so that the model's error is not weighed later.
#pragma once
#include "palpate/check.hpp"
#include "palpate/kalman.hpp"

namespace palpate {

struct TareConfig {
  double mass_std = 0.2;            ///< how wrong each link's mass may be, relative [1]
  double velocity_prior_std = 1.0;  ///< of q' at the start [rad/s]
  double max_step = 0.02;           ///< longer intervals are predicted in several steps [s]
};

/// Kalman filter with one factor s_j per link for its mass and inertia together, centre of mass kept:
///   x = (q, q', s - 1),   sum_j s_j (body j's torque) + tau_f = tau,   z = q + encoder rounding
/// (the payload filter with every link in the place of the load; kalman.hpp). What a motion does not show keeps its
/// prior: the factor stays near 1 and its standard deviation says so.
class Tare {
 public:
  using Filter = JointKalman<2 * max_joints>;

  explicit Tare(const Arm& arm, const TareConfig& config = {})
      : arm_(&arm), config_(config), filter_(arm.n(), arm.n(), false, true) {
    if (!arm.has_dynamics()) throw std::invalid_argument("Tare: the arm has no masses; give inertials");
    check::positive("TareConfig mass_std [1]", config.mass_std);
    check::positive("TareConfig velocity_prior_std [rad/s]", config.velocity_prior_std);
    check::positive("TareConfig max_step [s]", config.max_step);
    decay_.fill(1.0);
    for (int j = 0; j < arm.n(); ++j) {
      filter_.set_parameter(j, 0.0, config.mass_std * config.mass_std);
      torque_variance_[detail::at(j)] = arm.torque_variance(j);
    }
  }

  Status step(const JointSample& raw) noexcept {
    JointSample s = raw;
    friction_.step(*arm_, s);
    if (s.status == Status::non_finite || s.status == Status::time_error) return Status::held;
    if (!started_ || s.status == Status::gap || !(s.dt > 0.0)) {
      filter_.start(*arm_, s, config_.velocity_prior_std);
      started_ = true;
      return s.status == Status::gap ? Status::gap : Status::warming;
    }
    const int steps = 1 + static_cast<int>(s.dt / config_.max_step), n = arm_->n();
    for (int k = 0; k < steps; ++k) {
      const JointVector factor = factors();
      const Arm now = arm_->scaled(factor);
      JointVector variance = torque_variance_;
      for (int j = 0; j < n; ++j) {
        const double friction = arm_->joint(j).friction.uncertainty(filter_.dq(j), 0.3, s.tau[detail::at(j)]);
        variance[detail::at(j)] += friction * friction;
      }
      filter_.predict(now, {s.tau, variance, Inertia<double>{}, Inertia<double>{}, decay_}, s.dt / steps,
                      [&](const BaseFrame& chain, double* D, int stride) {
                        for (int j = 0; j < n; ++j) {
                          const JointVector column = chain.body_torque(j, (1.0 / factor[detail::at(j)]) * chain.body(j));
                          for (int i = 0; i < n; ++i) D[i * stride + j] = column[detail::at(i)];
                        }
                      });
    }
    filter_.measure_joints(*arm_, s, [](int, int, const auto&) {});
    return filter_.healthy() ? Status::ok : Status::non_finite;
  }

  void reset() { *this = Tare(*arm_, config_); }

  /// s_j: true mass over the model's, kept within [0.1, 10] [1].
  JointVector factors() const noexcept {
    JointVector s{};
    for (int j = 0; j < arm_->n(); ++j) s[detail::at(j)] = std::clamp(1.0 + filter_.parameter(j), 0.1, 10.0);
    return s;
  }
  JointVector factor_std() const noexcept {
    JointVector s{};
    for (int j = 0; j < arm_->n(); ++j) s[detail::at(j)] = std::sqrt(std::max(filter_.parameter_variance(j), 0.0));
    return s;
  }

 private:
  const Arm* arm_;
  TareConfig config_;
  Filter filter_;
  JointVector torque_variance_{};
  Filter::Parameters decay_{};
  FrictionMemory friction_{};
  bool started_ = false;
};

}  // namespace palpate
