// Inverse-dynamics observers: the plain residual, from our own model or from the controller's.
#pragma once
#include "palpate/filter.hpp"
#include "palpate/observers/observer.hpp"

namespace palpate {

namespace detail {

/// A torque residual through a second-order Butterworth low-pass, with the variance that is left of its noise.
class ResidualFilter {
 public:
  ResidualFilter(const Arm& arm, double cutoff) : arm_(&arm), cutoff_(cutoff), low_pass_(Butterworth::from_rad_per_s(2, cutoff), arm.n()) {}

  /// One residual [N m] of variance noise [N^2 m^2], white; friction_fraction of the friction's error stays whole.
  void step(const JointSample& s, const JointVector& residual, const JointVector& noise, double friction_fraction) noexcept {
    low_pass_.step(residual, s.dt);
    elapsed_ += s.dt;
    const double share = std::min(1.0, 0.5 * 1.11 * cutoff_ * s.dt);  // noise bandwidth, 1.11 w_c for order 2, against the sampling
    for (int j = 0; j < arm_->n(); ++j) {
      friction_[at(j)] = arm_->joint(j).friction.uncertainty(s.dq[at(j)], friction_fraction, s.tau[at(j)]);
      variance_[at(j)] = share * noise[at(j)];
    }
  }
  /// After a gap: what was before it is past.
  void restart() noexcept {
    low_pass_.reset();
    elapsed_ = 0.0;
  }
  ExternalTorque report(Status status) const noexcept {
    if (status == Status::ok && elapsed_ * cutoff_ < 4.0) status = Status::warming;
    return detail::report(arm_->n(), low_pass_.value(), variance_, friction_, status);
  }

 private:
  const Arm* arm_;
  double cutoff_;
  HeldButterworth<> low_pass_;
  JointVector variance_{}, friction_{};
  double elapsed_ = 0.0;
};

}  // namespace detail

struct InverseDynamicsConfig {
  double cutoff = 30.0;            ///< of the second-order Butterworth low-pass on the residual [rad/s]
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
};

/// F eq. (3):  tau_ext = M q'' + C q' + g + tau_f - tau, with q'' the difference of the velocities, low-passed as a whole so
/// that model and measurement are late by the same time. The baseline: it needs the acceleration. (MATH.md section 3.)
class InverseDynamicsObserver {
 public:
  explicit InverseDynamicsObserver(const Arm& arm, const InverseDynamicsConfig& config = {})
      : arm_(&arm), config_(config), filter_(arm, check::positive("InverseDynamicsConfig cutoff [rad/s]", config.cutoff)) {
    if (!arm.has_dynamics()) throw std::invalid_argument("InverseDynamicsObserver: the arm has no masses; give inertials");
    check::not_negative("InverseDynamicsConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return filter_.report(Status::held);
    const bool known = detail::knows_velocity(s);
    if (known_ && known && s.dt > 0.0 && s.status != Status::gap) {
      const int n = arm_->n();
      JointVector q{}, dq{}, ddq{};  // at the middle of the step, where the difference of velocities is the acceleration
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        q[u] = 0.5 * (s.q[u] + q_[u]);
        dq[u] = 0.5 * (s.dq[u] + dq_[u]);
        ddq[u] = (s.dq[u] - dq_[u]) / s.dt;
      }
      JointVector residual = inverse_dynamics<double>(*arm_, q, dq, ddq), noise{};
      const JointVector& p_variance = noise_.variance(*arm_, s);
      const double wdt = std::min(1.0, config_.cutoff * s.dt);  // the low-pass takes this much of a difference of white noise
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        residual[u] += arm_->joint(j).friction.torque(dq[u]) - s.tau[u];
        noise[u] = arm_->torque_variance(j) + 2.0 * p_variance[u] * (wdt / s.dt) * (wdt / s.dt);
      }
      filter_.step(s, residual, noise, config_.friction_fraction);
    } else {
      filter_.restart();
    }
    q_ = s.q;
    dq_ = s.dq;
    known_ = known;
    return filter_.report(s.status);
  }

  /// How late the residual is [s]: the delay of the low-pass at low frequencies.
  double lag() const noexcept { return std::numbers::sqrt2 / config_.cutoff; }

  void reset() { *this = InverseDynamicsObserver(*arm_, config_); }

 private:
  const Arm* arm_;
  InverseDynamicsConfig config_;
  detail::ResidualFilter filter_;
  detail::MomentumNoise noise_{};
  JointVector q_{}, dq_{};
  bool known_ = false;  // dq_ is a velocity
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
      : arm_(&arm), config_(config), filter_(arm, check::positive("ModelResidualConfig cutoff [rad/s]", config.cutoff)) {
    check::not_negative("ModelResidualConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s) || !s.has_model_torque) return filter_.report(Status::held);
    if (s.status == Status::gap) filter_.restart();
    JointVector residual{}, noise{};
    for (int j = 0; j < arm_->n(); ++j) {
      residual[detail::at(j)] = s.model_torque[detail::at(j)] - s.tau[detail::at(j)];
      noise[detail::at(j)] = arm_->torque_variance(j);
    }
    filter_.step(s, residual, noise, config_.friction_fraction);
    return filter_.report(s.status);
  }

  /// How late the residual is [s]: the delay of the low-pass at low frequencies.
  double lag() const noexcept { return std::numbers::sqrt2 / config_.cutoff; }

  void reset() { *this = ModelResidualObserver(*arm_, config_); }

 private:
  const Arm* arm_;
  ModelResidualConfig config_;
  detail::ResidualFilter filter_;
};

static_assert(DisturbanceObserver<InverseDynamicsObserver>);
static_assert(DisturbanceObserver<ModelResidualObserver>);

}  // namespace palpate
