// Momentum observer with super-twisting injection: finite-time, exact for torques of bounded rate.
#pragma once
#include "palpate/observers/observer.hpp"

namespace palpate {

struct SuperTwistingConfig {
  double max_rate = 20.0;          ///< L: fastest change of the external torque to follow [N m/s]; alpha = 1.1 L
  double gain = 1.5;               ///< lambda = gain sqrt(L) [1]
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
};

/// Garofalo et al. (2019):  p^' = tau + C^T q' - g - tau_f + lambda |e|^1/2 sgn e + z,  z' = alpha sgn e,  e = p - p^;  tau_ext = z.
///
/// Works in torque units, so its gain does not depend on the arm's inertia (the sliding-mode observer's does).
/// The step is implicit: e+ and sgn e+ are those after the step, sgn 0 being any number in [-1, 1]. With c the error that
/// would remain without injection, the solution is e+ = 0, z+ = z + c/dt if |c| <= alpha dt^2, else e+ = y^2 sgn c with
/// y^2 + lambda dt y + alpha dt^2 - |c| = 0. Hence no chattering, whatever the sampling time. (MATH.md section 3.)
///
/// `saturated`: sgn e has kept one value for a tenth of a second, or had so a tenth of a second ago (then z may have run past
/// the torque): the torque changes faster than max_rate.
/// Standard deviation: sqrt(2 L std(p)), Levant's order of accuracy under noise, and the friction's.
class MomentumSuperTwisting {
 public:
  explicit MomentumSuperTwisting(const Arm& arm, const SuperTwistingConfig& config = {}) : arm_(&arm), config_(config) {
    if (!arm.has_dynamics()) throw std::invalid_argument("MomentumSuperTwisting: the arm has no masses; give inertials");
    check::positive("SuperTwistingConfig max_rate [N m/s]", config.max_rate);
    check::positive("SuperTwistingConfig gain [1]", config.gain);
    check::not_negative("SuperTwistingConfig friction_fraction [1]", config.friction_fraction);
    alpha_ = 1.1 * config.max_rate;
    lambda_ = config.gain * std::sqrt(config.max_rate);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return report(Status::held);
    const MomentumTerms<double> t = momentum_terms<double>(*arm_, s.q, s.dq);
    const int n = arm_->n();
    JointVector beta{};
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      beta[u] = t.Ct_dq[u] - t.g[u] - arm_->joint(j).friction.torque(s.dq[u]);
    }
    const bool known = detail::knows_velocity(s);
    if (known_ && known && s.dt > 0.0 && s.status != Status::gap) {
      const double h = s.dt;
      bool outrun = false;
      const JointVector& p_variance = noise_.variance(*arm_, s);
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        const double c = (t.p[u] - p_hat_[u]) - h * (s.tau[u] + 0.5 * (beta[u] + beta_[u]) + z_[u]);
        double sign = c / (alpha_ * h * h), e = 0.0;
        if (std::abs(sign) > 1.0) {
          sign = c > 0.0 ? 1.0 : -1.0;
          const double y = 0.5 * (std::sqrt(h * h * lambda_ * lambda_ + 4.0 * (std::abs(c) - alpha_ * h * h)) - h * lambda_);
          e = sign * y * y;
        }
        z_[u] += h * alpha_ * sign;
        p_hat_[u] = t.p[u] - e;
        one_sided_[u] = std::abs(sign) < 1.0 ? 0.0 : (sign * side_[u] >= 1.0 ? one_sided_[u] : 0.0) + h;
        side_[u] = sign;
        outrun = outrun || one_sided_[u] >= settling_time;
        const double friction = arm_->joint(j).friction.uncertainty(s.dq[u], config_.friction_fraction, s.tau[u]);
        variance_[u] = 2.0 * config_.max_rate * std::sqrt(p_variance[u]);
        friction_[u] = friction;
      }
      elapsed_ += h;
      since_outrun_ = outrun ? 0.0 : since_outrun_ + h;
    } else {
      p_hat_ = t.p;
      side_ = one_sided_ = {};
      elapsed_ = 0.0;
    }
    beta_ = beta;
    known_ = known;
    if (s.status != Status::ok) return report(s.status);
    return report(elapsed_ < settling_time ? Status::warming : since_outrun_ < settling_time ? Status::saturated : Status::ok);
  }

  void reset() { *this = MomentumSuperTwisting(*arm_, config_); }

 private:
  static constexpr double settling_time = 0.1;  // [s]
  ExternalTorque report(Status status) const noexcept { return detail::report(arm_->n(), z_, variance_, friction_, status); }

  const Arm* arm_;
  SuperTwistingConfig config_;
  double alpha_ = 0.0, lambda_ = 0.0;  // [N m/s], [sqrt(N m) / sqrt(s) ...]: see the class comment
  detail::MomentumNoise noise_{};
  JointVector p_hat_{}, beta_{}, z_{}, variance_{}, friction_{}, side_{}, one_sided_{};
  double elapsed_ = 0.0, since_outrun_ = 1e9;  // [s]
  bool known_ = false;  // p_hat_ comes from a known velocity
};

static_assert(DisturbanceObserver<MomentumSuperTwisting>);

}  // namespace palpate
