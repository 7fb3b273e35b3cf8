// The continuous Kalman filter that made the published curves, errors included. For reproduction only.
#pragma once
#include "palpate/observers/observer.hpp"

namespace palpate {

struct PublishedKalmanConfig {
  double Q = 0.003;       ///< process noise, times the identity
  double R = 0.001;       ///< measurement noise, times the identity
  double P0 = 0.001;      ///< initial covariance, times the identity
  double delta_t = 0.004; ///< enters F, see below
};

/// R eqs. (12)-(14) as they were run:
///   x1' = x2 + K1 y,  x2' = f(x1, x2, tau) + K2 y,  y = z - x1,  P' = F P + P F^T - K R K^T + Q,  K = P H^T R^-1
/// without friction in f, and with the constant F = [0 1; dt dt] where the Jacobian of f belongs (MATH.md section 1, R 2
/// and 5; H = [1 0]). All blocks are multiples of the identity, so P is three numbers (a b; b c) for every joint.
/// At rest x2 keeps the bias -K1 y: the published controller therefore stops short of its goal.
/// One Runge-Kutta step (order 4) per sample with held inputs. Use ExtendedKalman for anything else.
class PublishedKalman {
 public:
  explicit PublishedKalman(const Arm& arm, const PublishedKalmanConfig& config = {})
      : arm_(&arm), config_(config), state_{{}, {}, config.P0, 0.0, config.P0} {
    if (!arm.has_dynamics()) throw std::invalid_argument("PublishedKalman: the arm has no masses; give inertials");
    check::positive("PublishedKalmanConfig Q", config.Q);
    check::positive("PublishedKalmanConfig R", config.R);
    check::positive("PublishedKalmanConfig P0", config.P0);
    check::positive("PublishedKalmanConfig delta_t [s]", config.delta_t);
  }

  /// Integrates over s.dt; refused samples change nothing. The state starts at zero, as published.
  void step(const JointSample& s) noexcept {
    if (detail::unusable(s) || !(s.dt > 0.0)) return;
    const double h = s.dt;
    const State k1 = rate(state_, s);
    const State k2 = rate(moved(state_, k1, 0.5 * h), s);
    const State k3 = rate(moved(state_, k2, 0.5 * h), s);
    const State k4 = rate(moved(state_, k3, h), s);
    state_ = moved(moved(moved(moved(state_, k1, h / 6), k2, h / 3), k3, h / 3), k4, h / 6);
  }
  void reset() { *this = PublishedKalman(*arm_, config_); }

  const JointVector& positions() const noexcept { return state_.x1; }   ///< [rad]
  const JointVector& velocities() const noexcept { return state_.x2; }  ///< [rad/s]

 private:
  struct State {
    JointVector x1, x2;
    double a, b, c;  // P of one joint
  };
  State moved(const State& x, const State& k, double h) const noexcept {
    State y = x;
    for (int j = 0; j < arm_->n(); ++j) {
      y.x1[detail::at(j)] += h * k.x1[detail::at(j)];
      y.x2[detail::at(j)] += h * k.x2[detail::at(j)];
    }
    y.a += h * k.a;
    y.b += h * k.b;
    y.c += h * k.c;
    return y;
  }
  State rate(const State& x, const JointSample& s) const noexcept {
    const double K1 = x.a / config_.R, K2 = x.b / config_.R, d = config_.delta_t;
    State k;
    k.x1 = x.x2;
    k.x2 = forward_dynamics<double>(*arm_, x.x1, x.x2, s.tau);
    for (int j = 0; j < arm_->n(); ++j) {
      const double y = s.q[detail::at(j)] - x.x1[detail::at(j)];
      k.x1[detail::at(j)] += K1 * y;
      k.x2[detail::at(j)] += K2 * y;
    }
    k.a = 2.0 * x.b - K1 * K1 * config_.R + config_.Q;
    k.b = x.c + d * (x.a + x.b) - K1 * K2 * config_.R;
    k.c = 2.0 * d * (x.b + x.c) - K2 * K2 * config_.R + config_.Q;
    return k;
  }

  const Arm* arm_;
  PublishedKalmanConfig config_;
  State state_;
};

}  // namespace palpate
