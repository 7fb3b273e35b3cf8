// Momentum observer: external torque as the filtered difference of momentum and its model, without acceleration.
#pragma once
#include "palpate/observers/observer.hpp"

namespace palpate {

struct MomentumConfig {
  double bandwidth = 30.0;         ///< K [rad/s]: the residual follows the torque with time constant 1/K
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
};

/// De Luca, Mattone (2003):  r = K (p - p_0 - int (tau + C^T q' - g - tau_f + r) dt),  hence  r' = K (tau_ext - r).
///
/// The lag is discretised exactly for the time dt that really passed:
///   r+ = a r + (1 - a) ((p+ - p)/dt - (tau + beta)),  a = exp(-K dt),  beta the mean of C^T q' - g - tau_f over the step,
/// which holds no sum that could drift. p, C^T q' and g come from one sweep (chain.hpp). (MATH.md section 3.)
class MomentumObserver {
 public:
  explicit MomentumObserver(const Arm& arm, const MomentumConfig& config = {}) : arm_(&arm), config_(config) {
    if (!arm.has_dynamics()) throw std::invalid_argument("MomentumObserver: the arm has no masses; give inertials");
    check::positive("MomentumConfig bandwidth [rad/s]", config.bandwidth);
    check::not_negative("MomentumConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return report(Status::held);
    const MomentumTerms<double> t = momentum_terms<double>(*arm_, s.q, s.dq);
    JointVector beta{};
    const int n = arm_->n();
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      beta[u] = t.Ct_dq[u] - t.g[u] - arm_->joint(j).friction.torque(s.dq[u]);
    }
    const bool known = detail::knows_velocity(s);
    if (known_ && known && s.dt > 0.0 && s.status != Status::gap) {
      const double a = std::exp(-config_.bandwidth * s.dt), b = 1.0 - a;
      const JointVector& p_variance = noise_.variance(*arm_, s);
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        r_[u] = a * r_[u] + b * ((t.p[u] - p_[u]) / s.dt - s.tau[u] - 0.5 * (beta[u] + beta_[u]));
        // White torque noise through the lag, white momentum noise through its derivative and the lag, and the friction.
        const double friction = arm_->joint(j).friction.uncertainty(s.dq[u], config_.friction_fraction, s.tau[u]);
        variance_[u] = b / (1.0 + a) * arm_->torque_variance(j) + 2.0 / (1.0 + a) * (b / s.dt) * (b / s.dt) * p_variance[u];
        friction_[u] = friction;
      }
      elapsed_ += s.dt;
    } else {
      elapsed_ = 0.0;
    }
    p_ = t.p;
    beta_ = beta;
    known_ = known;
    // After three time constants 95 % of a constant torque is seen.
    return report(s.status != Status::ok ? s.status : elapsed_ * config_.bandwidth < 3.0 ? Status::warming : Status::ok);
  }

  /// How late the residual is [s].
  double lag() const noexcept { return 1.0 / config_.bandwidth; }

  void reset() { *this = MomentumObserver(*arm_, config_); }

 private:
  ExternalTorque report(Status status) const noexcept { return detail::report(arm_->n(), r_, variance_, friction_, status); }

  const Arm* arm_;
  MomentumConfig config_;
  detail::MomentumNoise noise_{};
  JointVector p_{}, beta_{}, r_{}, variance_{}, friction_{};
  double elapsed_ = 0.0;
  bool known_ = false;  // p_ is of a known velocity
};

static_assert(DisturbanceObserver<MomentumObserver>);

}  // namespace palpate
