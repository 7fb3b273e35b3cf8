// Kalman filter on the generalised momentum with the external torque as its disturbance: cheap, and with a full covariance.
#pragma once
#include <algorithm>

#include "palpate/observers/observer.hpp"

namespace palpate {

struct DisturbanceKalmanConfig {
  double disturbance_rate = 20.0;       ///< growth of the external torque's standard deviation [N m/sqrt(s)]
  double decay = 0.0;                   ///< a: the external torque forgets itself at this rate [1/s]; 0: it stays
  double disturbance_prior_std = 50.0;  ///< of tau_ext at the start [N m]
  double model_torque_std = 0.0;        ///< error of the arm's model, white per sample, beside the drives' own [N m]
  double friction_fraction = 0.3;       ///< error of the friction model in motion, part of Coulomb friction [1]
  double friction_time = 5.0;           ///< how long such an error lasts [s]
};

/// Wahrburg et al. (2015, 2018), "Cartesian contact force estimation ... using Kalman filters and the generalized momentum":
///
///   p' = tau + C^T q' - g - tau_f + d + w_p,   d' = -a d + w_d,   z = M q' + M v,        tau_ext = d + b
///
/// p = M q' momentum [N m s], d what the filter sees, v the noise of q' [rad/s], and b the error of the friction model, which
/// nothing here tells from a torque: its variance Friction::uncertainty^2 (F/sqrt(3) at rest, friction_fraction F_c in
/// motion) is added to what is reported. Noise that depends on velocity (MATH.md section 3):
///   w_p  torque noise, model_torque_std, and the noise of q' through the slope of friction, large near rest only;
///   w_d  disturbance_rate, the wandering of b within friction_time, and its renewal when the sign of friction turns;
///   M v  full covariance M diag(std(q')^2) M^T: a light wrist moved by a heavy shoulder shares the shoulder's noise.
/// Discretised exactly for the time that passed; covariances are n x n blocks, one Cholesky factor per step.
class DisturbanceKalman {
 public:
  explicit DisturbanceKalman(const Arm& arm, const DisturbanceKalmanConfig& config = {}) : arm_(&arm), config_(config) {
    if (!arm.has_dynamics()) throw std::invalid_argument("DisturbanceKalman: the arm has no masses; give inertials");
    check::positive("DisturbanceKalmanConfig disturbance_rate [N m/sqrt(s)]", config.disturbance_rate);
    check::not_negative("DisturbanceKalmanConfig decay [1/s]", config.decay);
    check::positive("DisturbanceKalmanConfig disturbance_prior_std [N m]", config.disturbance_prior_std);
    check::not_negative("DisturbanceKalmanConfig model_torque_std [N m]", config.model_torque_std);
    check::not_negative("DisturbanceKalmanConfig friction_fraction [1]", config.friction_fraction);
    check::positive("DisturbanceKalmanConfig friction_time [s]", config.friction_time);
    forget_disturbance();
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return report(Status::held);
    const int n = arm_->n();
    const MomentumTerms<double> t = momentum_terms<double>(*arm_, s.q, s.dq);
    JointVector beta{}, slope{}, turned{};
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      const Friction& friction = arm_->joint(j).friction;
      beta[u] = t.Ct_dq[u] - t.g[u] - friction.torque(s.dq[u]);
      slope[u] = friction.derivative(s.dq[u]);
      turned[u] = travel_[u].step(friction, s.dq[u], s.dq_std[u]);
      const double error = friction.uncertainty(s.dq[u], config_.friction_fraction, s.tau[u]);
      friction_variance_[u] = error * error;
    }
    momentum_noise(s);
    const bool known = detail::knows_velocity(s);
    if (!known_ || !known || s.status == Status::gap || !(s.dt > 0.0)) {
      if (s.status == Status::gap) forget_disturbance();
      start(t.p);
    } else {
      predict(s, beta, slope, turned);
      update(t.p);
    }
    beta_ = beta;
    known_ = known;
    if (!healthy()) {  // start over rather than report what came out of it
      d_ = {};
      forget_disturbance();
      start(t.p);
      return report(Status::warming);
    }
    if (s.status != Status::ok) return report(s.status);
    return report(learnt() ? Status::ok : Status::warming);
  }

  void reset() { *this = DisturbanceKalman(*arm_, config_); }

  /// Covariance of the external torque [N^2 m^2], n x n: of d, and of the friction error on the diagonal.
  JointMatrix covariance() const noexcept {
    JointMatrix out{};
    const int n = arm_->n();
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) out(i, j) = P_dd_(i, j);
      out(i, i) += friction_variance_[detail::at(i)];
    }
    return out;
  }

  /// How late the external torque is [s], the slowest joint's: the variance of d over its growth per second. That is the delay
  /// at low frequencies of any settled Kalman filter that follows a random walk.
  double lag() const noexcept {
    double slowest = 0.0;
    for (int i = 0; i < arm_->n(); ++i) slowest = std::max(slowest, P_dd_(i, i) / growth(i, 0.0));
    return slowest;
  }

  /// Filtered momentum M q' [N m s] and the joint velocity noise seen through M [N^2 m^2 s^2].
  const JointVector& momentum() const noexcept { return p_; }
  const JointMatrix& momentum_noise() const noexcept { return R_; }

 private:
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }

  /// Variance that d gains per second of a step of h, by its own wandering and by that of the friction's error [N^2 m^2/s].
  double growth(int i, double h) const noexcept {
    return square(config_.disturbance_rate) + 2.0 * friction_variance_[u(i)] / std::max(config_.friction_time, h);
  }

  /// R = M D M^T; M is refreshed once a joint has moved by 0.1 rad.
  void momentum_noise(const JointSample& s) noexcept {
    const int n = arm_->n();
    bool moved = !started_;
    for (int j = 0; j < n; ++j) moved = moved || std::abs(s.q[u(j)] - M_at_[u(j)]) > 0.1;
    if (moved) {
      M_ = mass_matrix<double>(*arm_, s.q);
      M_at_ = s.q;
    }
    if (!moved && s.dq_std == dq_std_) return;
    dq_std_ = s.dq_std;
    JointMatrix MD;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) MD(i, j) = M_(i, j) * square(std::max(s.dq_std[u(j)], least_velocity_std));
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        double sum = 0.0;
        for (int k = 0; k < n; ++k) sum += MD(i, k) * M_(j, k);
        R_(i, j) = R_(j, i) = sum;
      }
  }

  void start(const JointVector& p) noexcept {
    p_ = p;
    P_pp_ = R_;
    P_pd_ = JointMatrix{};
    started_ = true;
  }

  void forget_disturbance() noexcept {
    P_dd_ = JointMatrix{};
    for (int j = 0; j < arm_->n(); ++j) P_dd_(j, j) = square(config_.disturbance_prior_std);
  }

  void predict(const JointSample& s, const JointVector& beta, const JointVector& slope, const JointVector& turned) noexcept {
    const int n = arm_->n();
    const double h = s.dt, x = config_.decay * h;
    const double phi = std::exp(-x), g = x > 1e-8 ? h * (-std::expm1(-x) / x) : h;  // d -> p over the step
    for (int i = 0; i < n; ++i) {
      p_[u(i)] += h * (s.tau[u(i)] + 0.5 * (beta[u(i)] + beta_[u(i)])) + g * d_[u(i)];
      d_[u(i)] *= phi;
    }
    for (int i = 0; i < n; ++i)  // P <- F P F^T, F = [1 g; 0 phi]
      for (int j = 0; j <= i; ++j) {
        P_pp_(i, j) = P_pp_(j, i) = P_pp_(i, j) + g * (P_pd_(i, j) + P_pd_(j, i)) + g * g * P_dd_(i, j);
        P_dd_old_(i, j) = P_dd_old_(j, i) = P_dd_(i, j);
        P_dd_(i, j) = P_dd_(j, i) = phi * phi * P_dd_(i, j);
      }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) P_pd_(i, j) = phi * (P_pd_(i, j) + g * P_dd_old_(i, j));
    for (int i = 0; i < n; ++i) {
      const double torque = arm_->torque_variance(i) + square(config_.model_torque_std) + 0.5 * square(slope[u(i)] * s.dq_std[u(i)]);
      const double wander = growth(i, h) * h +
                            turned[u(i)] * square(arm_->joint(i).friction.uncertainty(0.0, config_.friction_fraction));
      P_pp_(i, i) += h * h * (torque + wander / 3.0);
      P_pd_(i, i) += 0.5 * h * wander;
      P_dd_(i, i) += wander;
    }
  }

  /// z = p + M v: S = P_pp + R, gains A S^-1 and C^T S^-1 with A = P_pp, C = P_pd.
  void update(const JointVector& z) noexcept {
    const int n = arm_->n();
    JointMatrix S;
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) S(i, j) = P_pp_(i, j) + R_(i, j);
    const Cholesky<double> factor(S, n);
    // [A C y] -> S^-1 [A C y], rows in memory order.
    constexpr int stride = 2 * max_joints + 1;
    std::array<double, static_cast<std::size_t>(max_joints* stride)> X;
    const int columns = 2 * n + 1;
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j < n; ++j) {
        X[u(i * stride + j)] = P_pp_(i, j);
        X[u(i * stride + n + j)] = P_pd_(i, j);
      }
      X[u(i * stride + 2 * n)] = z[u(i)] - p_[u(i)];
    }
    factor.solve_rows(X.data(), stride, columns);
    JointMatrix A, C;
    for (int i = 0; i < n; ++i) {
      // R S^-1 [A C y]: what the measurement leaves of A and C, without the cancellation of A - A S^-1 A.
      std::array<double, stride> row{};
      double gain = 0.0;
      for (int k = 0; k < n; ++k) {
        const double r = R_(i, k);
        const double* x = X.data() + k * stride;
        for (int c = 0; c < columns; ++c) row[u(c)] += r * x[c];
        gain += P_pd_(k, i) * x[2 * n];
      }
      for (int j = 0; j < n; ++j) {
        A(i, j) = row[u(j)];
        C(i, j) = row[u(n + j)];
      }
      p_[u(i)] = z[u(i)] - row[u(2 * n)];
      d_[u(i)] += gain;
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        double sum = 0.0;
        for (int k = 0; k < n; ++k) sum += P_pd_(k, i) * X[u(k * stride + n + j)];
        P_dd_(i, j) = P_dd_(j, i) = P_dd_(i, j) - sum;
      }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) P_pp_(i, j) = P_pp_(j, i) = 0.5 * (A(i, j) + A(j, i));
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) P_pd_(i, j) = C(i, j);
  }

  bool healthy() const noexcept {
    for (int i = 0; i < arm_->n(); ++i)
      if (!std::isfinite(p_[u(i)]) || !std::isfinite(d_[u(i)]) || !(P_dd_(i, i) > 0.0) || !(P_pp_(i, i) > 0.0)) return false;
    return true;
  }
  bool learnt() const noexcept {
    for (int i = 0; i < arm_->n(); ++i)
      if (P_dd_(i, i) > square(0.5 * config_.disturbance_prior_std)) return false;
    return true;
  }
  ExternalTorque report(Status status) const noexcept {
    ExternalTorque out;
    out.torque = d_;
    for (int i = 0; i < arm_->n(); ++i) {
      out.noise[u(i)] = std::sqrt(P_dd_(i, i));
      out.std[u(i)] = std::sqrt(P_dd_(i, i) + friction_variance_[u(i)]);
    }
    out.status = status;
    return out;
  }

  static constexpr double square(double x) noexcept { return x * x; }
  static constexpr double least_velocity_std = 1e-7;  // of a velocity said to be exact [rad/s]: keeps R invertible

  const Arm* arm_;
  DisturbanceKalmanConfig config_;
  JointVector p_{}, d_{}, beta_{}, friction_variance_{}, M_at_{}, dq_std_{};
  JointMatrix P_pp_{}, P_pd_{}, P_dd_{}, P_dd_old_{}, R_{}, M_{};
  std::array<SignTravel, max_joints> travel_{};
  bool started_ = false, known_ = false;  // M is there; p_ is of a known velocity
};

static_assert(DisturbanceObserver<DisturbanceKalman>);

}  // namespace palpate
