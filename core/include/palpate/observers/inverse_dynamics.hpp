// Inverse-dynamics observers: the plain residual, from our own model or from the controller's.
#pragma once
#include "palpate/filter.hpp"
#include "palpate/observers/observer.hpp"

namespace palpate {

struct InverseDynamicsConfig {
  double cutoff = 30.0;            ///< of the second-order Butterworth low-pass on the residual [rad/s]
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
};

/// F eq. (3):  tau_ext = M q'' + C q' + g + tau_f - tau, with q'' the difference of the velocities, low-passed as a whole so
/// that model and measurement are late by the same time. The baseline: it needs the acceleration. (MATH.md section 3.)
class InverseDynamicsObserver {
 public:
  explicit InverseDynamicsObserver(const Arm& arm, const InverseDynamicsConfig& config = {})
      : arm_(&arm),
        config_(config),
        low_pass_(Butterworth::from_rad_per_s(2, check::positive("InverseDynamicsConfig cutoff [rad/s]", config.cutoff)), arm.n()) {
    if (!arm.has_dynamics()) throw std::invalid_argument("InverseDynamicsObserver: the arm has no masses; give inertials");
    check::not_negative("InverseDynamicsConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return report(Status::held);
    const bool continues = started_ && s.dt > 0.0 && s.status != Status::gap;
    if (continues && s.status != Status::warming) {
      const int n = arm_->n();
      JointVector q{}, dq{}, ddq{};  // at the middle of the step, where the difference of velocities is the acceleration
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        q[u] = 0.5 * (s.q[u] + q_[u]);
        dq[u] = 0.5 * (s.dq[u] + dq_[u]);
        ddq[u] = (s.dq[u] - dq_[u]) / s.dt;
      }
      JointVector residual = inverse_dynamics<double>(*arm_, q, dq, ddq);
      const JointVector& p_variance = noise_.variance(*arm_, s);
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        residual[u] += arm_->joint(j).friction.torque(dq[u]) - s.tau[u];
        // Noise bandwidth of the filter, 1.11 w_c for order 2, against the sampling rate.
        const double share = std::min(1.0, 0.5 * 1.11 * config_.cutoff * s.dt);
        const double wdt = std::min(1.0, config_.cutoff * s.dt);
        const double friction = arm_->joint(j).friction.uncertainty(s.dq[u], config_.friction_fraction);
        variance_[u] = share * (arm_->torque_variance(j) + 2.0 * p_variance[u] / (s.dt * s.dt) * wdt * wdt) + friction * friction;
      }
      low_pass_.step(residual, s.dt);
      elapsed_ += s.dt;
    } else if (!continues) {
      elapsed_ = 0.0;
    }
    q_ = s.q;
    dq_ = s.dq;
    started_ = true;
    if (s.status != Status::ok) return report(s.status);
    return report(elapsed_ * config_.cutoff < 4.0 ? Status::warming : Status::ok);
  }

  void reset() { *this = InverseDynamicsObserver(*arm_, config_); }

 private:
  ExternalTorque report(Status status) const noexcept {
    ExternalTorque out;
    out.torque = low_pass_.value();
    for (int j = 0; j < arm_->n(); ++j) out.std[detail::at(j)] = std::sqrt(variance_[detail::at(j)]);
    out.status = status;
    return out;
  }

  const Arm* arm_;
  InverseDynamicsConfig config_;
  HeldButterworth<> low_pass_;
  detail::MomentumNoise noise_{};
  JointVector q_{}, dq_{}, variance_{};
  double elapsed_ = 0.0;
  bool started_ = false;
};

struct ModelResidualConfig {
  double cutoff = 30.0;            ///< of the second-order Butterworth low-pass on the residual [rad/s]
  double friction_fraction = 0.3;  ///< error of the controller's friction model in motion, part of Coulomb friction [1]
};

/// tau_ext = tau_model - tau, where the controller itself reports tau_model, the torque its bare arm needs. Needs no masses.
/// A sample without model torque is `held`.
class ModelResidualObserver {
 public:
  explicit ModelResidualObserver(const Arm& arm, const ModelResidualConfig& config = {})
      : arm_(&arm),
        config_(config),
        low_pass_(Butterworth::from_rad_per_s(2, check::positive("ModelResidualConfig cutoff [rad/s]", config.cutoff)), arm.n()) {
    check::not_negative("ModelResidualConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s) || !s.has_model_torque) return report(Status::held);
    if (s.status == Status::gap) low_pass_.reset(), elapsed_ = 0.0;
    JointVector residual{};
    for (int j = 0; j < arm_->n(); ++j) {
      const auto u = detail::at(j);
      residual[u] = s.model_torque[u] - s.tau[u];
      const double share = std::min(1.0, 0.5 * 1.11 * config_.cutoff * s.dt);
      const double friction = arm_->joint(j).friction.uncertainty(s.dq[u], config_.friction_fraction);
      variance_[u] = share * arm_->torque_variance(j) + friction * friction;
    }
    low_pass_.step(residual, s.dt);
    elapsed_ += s.dt;
    if (s.status != Status::ok) return report(s.status);
    return report(elapsed_ * config_.cutoff < 4.0 ? Status::warming : Status::ok);
  }

  void reset() { *this = ModelResidualObserver(*arm_, config_); }

 private:
  ExternalTorque report(Status status) const noexcept {
    ExternalTorque out;
    out.torque = low_pass_.value();
    for (int j = 0; j < arm_->n(); ++j) out.std[detail::at(j)] = std::sqrt(variance_[detail::at(j)]);
    out.status = status;
    return out;
  }

  const Arm* arm_;
  ModelResidualConfig config_;
  HeldButterworth<> low_pass_;
  JointVector variance_{};
  double elapsed_ = 0.0;
};

static_assert(DisturbanceObserver<InverseDynamicsObserver>);
static_assert(DisturbanceObserver<ModelResidualObserver>);

}  // namespace palpate
