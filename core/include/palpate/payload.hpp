// The load from the external torque: the published joint formula, and recursive regression over all joints.
// (The payload Kalman filter, which needs no observer before it, is in payload_filter.hpp.)
#pragma once
#include <limits>

#include "palpate/chain.hpp"
#include "palpate/check.hpp"

namespace palpate {

namespace detail {

/// Bodies on the last link for one unit of each load parameter: m at the grasp point, and m delta along the tip's axes.
inline std::array<Inertia<double>, 4> load_basis(const Arm& arm) noexcept {
  const Vec3<double> c = arm.p_last_grasp();
  const Mat3<double> R = arm.R_last_tip();
  return {about_origin(1.0, c, Sym3<double>{}), Inertia<double>{0.0, R.cx, parallel_axis(R.cx, c)},
          Inertia<double>{0.0, R.cy, parallel_axis(R.cy, c)}, Inertia<double>{0.0, R.cz, parallel_axis(R.cz, c)}};
}

/// Forward, at rest or backward, per joint: while it stays, so does the error of the friction model.
/// A joint rests as soon as it is slow, and until it has left that place by more than `presliding` [rad]: what holds it there is
/// one torque, however often a noisy velocity, or trembling on the spot, crosses zero.
class Regime {
 public:
  explicit Regime(double presliding = 0.0) : presliding_(presliding) {}

  /// True if joint j has started, stopped or reversed. q, dq [rad, rad/s].
  bool changed(const Arm& arm, int j, double q, double dq) noexcept {
    const double v0 = arm.joint(j).friction.sign_velocity;
    Joint& joint = joints_[at(j)];
    if (!joint.known) {
      joint.known = true;
      joint.stopped_at = q;
    }
    if (joint.direction == 0) {
      const double away = q - joint.stopped_at;
      const double noise = 4.0 * std::sqrt(arm.position_variance(j));
      if (std::abs(dq) < 1.25 * v0 || (presliding_ > 0.0 && std::abs(away) < presliding_ + noise)) return false;
      joint.direction = dq > 0.0 ? 1 : -1;
      return true;
    }
    if (joint.direction * dq > 0.75 * v0) return false;
    joint.direction = 0;
    joint.stopped_at = q;
    return true;
  }
  bool at_rest(int j) const noexcept { return joints_[at(j)].direction == 0; }

 private:
  struct Joint {
    bool known = false;
    int direction = 0;
    double stopped_at = 0.0;  // [rad]
  };
  double presliding_;
  std::array<Joint, max_joints> joints_{};
};

}  // namespace detail

struct JointFormulaConfig {
  int joint = -1;                 ///< counted from 0; -1: the one nearest to the tip that feels the load in this pose
  double lever = std::numeric_limits<double>::quiet_NaN();    ///< axis to load [m]; NaN: to the grasp point (the published l4 is 0.21)
  double gravity = std::numeric_limits<double>::quiet_NaN();  ///< [m/s^2]; NaN: the arm's
  double sin_threshold = 0.2;     ///< the load must stand out at least so far sideways, sin theta [1]
  double speed_threshold = 0.5;   ///< ||q'|| above this is motion, not weighing [rad/s]
  double ok_relative = 0.25;      ///< status `ok` once mass_std is below the larger of this part of the mass
  double ok_absolute = 0.05;      ///< and this [kg]
};

/// R eq. (8), m = -tau_6/(g l_4 sin theta), for any joint i and any mount:  m = tau_ext,i / (J_c,i^T g),  c the grasp point,
/// with sin theta = J_c,i^T g / (r |g|), r the distance of c from the axis. Only at rest, only where |sin theta| is large.
/// (MATH.md section 4.) Status `held` in motion, `singular` where the load hangs below the axis: the last value is repeated.
class JointFormula {
 public:
  explicit JointFormula(const Arm& arm, const JointFormulaConfig& config = {}) : arm_(&arm), config_(config) {
    check::in_range("JointFormulaConfig joint", config.joint, -1, arm.n() - 1);
    check::positive("JointFormulaConfig sin_threshold [1]", config.sin_threshold);
    check::positive("JointFormulaConfig speed_threshold [rad/s]", config.speed_threshold);
    check::positive("JointFormulaConfig ok_relative [1]", config.ok_relative);
    check::positive("JointFormulaConfig ok_absolute [kg]", config.ok_absolute);
    if (!std::isnan(config.lever)) check::positive("JointFormulaConfig lever [m]", config.lever);
    if (!std::isnan(config.gravity)) check::positive("JointFormulaConfig gravity [m/s^2]", config.gravity);
    const Vec3<double> g = arm.gravity();
    if (!(dot(g, g) > 0.0)) throw std::invalid_argument("JointFormula: the arm's gravity is zero; a load has no weight there");
  }

  /// q, q' of the same instant as the torque [rad, rad/s].
  Payload step(const JointVector& q, const JointVector& dq, const ExternalTorque& external) noexcept {
    const bool settled = external.status == Status::ok || external.status == Status::saturated;
    if (!settled && external.status != Status::warming) return repeat(external.status);
    double speed = 0.0;
    for (int j = 0; j < arm_->n(); ++j) speed += dq[detail::at(j)] * dq[detail::at(j)];
    if (!(speed <= config_.speed_threshold * config_.speed_threshold)) return repeat(Status::held);
    const Pose<double> P = forward_kinematics<double>(*arm_, q);
    const Vec3<double> c = P.p + P.R * arm_->p_last_grasp(), g = arm_->gravity();
    const double g_length = std::sqrt(dot(g, g));
    for (int j = config_.joint < 0 ? arm_->n() - 1 : config_.joint; j >= 0; --j) {
      const Vec3<double> J = jacobian_column(*arm_, P, j, c);
      const double r = std::sqrt(dot(J, J));
      const double sin = r > 1e-6 ? dot(J, g) / (r * g_length) : 0.0;
      if (std::abs(sin) > config_.sin_threshold) {
        const double arm_of_force = (std::isnan(config_.lever) ? r : config_.lever) * sin * (std::isnan(config_.gravity) ? g_length : config_.gravity);
        last_.mass = external.torque[detail::at(j)] / arm_of_force;
        last_.mass_std = external.std[detail::at(j)] / std::abs(arm_of_force);
        last_.status = external.status;
        const bool sure = last_.mass_std <= std::max(config_.ok_relative * std::abs(last_.mass), config_.ok_absolute);
        if (external.status == Status::ok && !sure) last_.status = Status::warming;
        return last_;
      }
      if (config_.joint >= 0) break;
    }
    return repeat(Status::singular);
  }

  void reset() { last_ = {}; }

 private:
  Payload repeat(Status status) const noexcept {
    Payload out = last_;
    out.status = last_.status == Status::warming ? Status::warming : status;
    if (last_.status == Status::warming && status == Status::singular) out.status = Status::singular;
    return out;
  }

  const Arm* arm_;
  JointFormulaConfig config_;
  Payload last_{};
};

struct RegressionConfig {
  bool first_moment = false;        ///< estimate m and m (c - grasp); else m alone, held exactly at the grasp point
  double mass_prior_std = 20.0;     ///< of the mass before anything is known, about 0 [kg]
  double offset_prior_std = 0.05;   ///< of the grasp point's error, each tip axis [m]
  double lag = std::numeric_limits<double>::quiet_NaN();  ///< of the observer before this, applied to the regressor too [s]; NaN: as the observer knows it
  double acceleration_time = 0.05;  ///< time constant of the acceleration in the regressor [s]
  double friction_fraction = 0.3;   ///< error of the friction model in motion, part of Coulomb friction [1]
  double bias_time = 5.0;           ///< how long an error of friction or drive gain stays the same [s]
  double settling_time = 0.2;       ///< a joint that starts, stops or reverses is not used so long, nor for 5 lags [s]
  double ok_relative = 0.25;        ///< status `ok` once mass_std is below the larger of this part of the mass
  double ok_absolute = 0.05;        ///< and this [kg]
};

/// Recursive least squares over all joints:  tau_ext,j = -Y_L,j(q, q', q'') theta + b_j + v_j,   theta = m or (m, m delta).
///
/// b_j is what friction and drive gain get wrong: a first-order process of time bias_time with
///   std(b_j)^2 = Friction::uncertainty^2 + (torque_gain_std tau_j)^2,
/// drawn anew when the joint starts, stops or reverses. Near rest friction is known only within +-F_c, so the interval
/// stays wide there instead of trusting an average of the same error. v_j is the observer's noise, counted once per
/// correlation time. All errors of one kind at one joint are thus one unknown, not thousands. (MATH.md section 4.)
class Regression {
 public:
  explicit Regression(const Arm& arm, const RegressionConfig& config = {}) : arm_(&arm), config_(config), loads_(config.first_moment ? 4 : 1), unit_(detail::load_basis(arm)) {
    check::positive("RegressionConfig mass_prior_std [kg]", config.mass_prior_std);
    check::positive("RegressionConfig offset_prior_std [m]", config.offset_prior_std);
    if (!std::isnan(config.lag)) check::not_negative("RegressionConfig lag [s]", config.lag);
    check::not_negative("RegressionConfig acceleration_time [s]", config.acceleration_time);
    check::not_negative("RegressionConfig friction_fraction [1]", config.friction_fraction);
    check::positive("RegressionConfig bias_time [s]", config.bias_time);
    check::not_negative("RegressionConfig settling_time [s]", config.settling_time);
    check::positive("RegressionConfig ok_relative [1]", config.ok_relative);
    check::positive("RegressionConfig ok_absolute [kg]", config.ok_absolute);
    for (int k = 0; k < loads_; ++k) {
      const double prior = k == 0 ? config.mass_prior_std : config.mass_prior_std * config.offset_prior_std;
      P(k, k) = prior * prior;
    }
  }

  /// The sample, the external torque an observer made of it, and how late that is [s]; the configuration's lag has precedence.
  Payload step(const JointSample& s, const ExternalTorque& external, double lag = 0.0) noexcept {
    lag_ = std::isnan(config_.lag) ? lag : config_.lag;
    const bool continues = started_ && s.dt > 0.0 && s.status != Status::gap;
    if (s.status == Status::ok) {
      update_regressor(s, continues ? s.dt : 0.0);
      predict(s, continues ? s.dt : 0.0);
      started_ = true;
    }
    const bool usable = s.status == Status::ok && (external.status == Status::ok || external.status == Status::saturated);
    if (!usable) return report(s.status == Status::ok ? external.status : s.status);
    const double correlated = s.dt > 0.0 ? std::max(1.0, 2.0 * lag_ / s.dt) : 1.0;
    for (int j = 0; j < arm_->n(); ++j) {
      const auto u = detail::at(j);
      if (since_change_[u] < std::max(5.0 * lag_, config_.settling_time)) continue;  // the residual still holds what was before
      measure(j, external.torque[u], correlated * external.noise[u] * external.noise[u] + 1e-12);
    }
    return report(external.status);
  }

  void reset() { *this = Regression(*arm_, config_); }

 private:
  static constexpr int stride = 4 + max_joints;
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }
  double& P(int r, int c) noexcept { return P_[u(r * stride + c)]; }
  int dim() const noexcept { return loads_ + arm_->n(); }

  void update_regressor(const JointSample& s, double dt) noexcept {
    if (dt > 0.0) {
      const double a = config_.acceleration_time > 0.0 ? -std::expm1(-dt / config_.acceleration_time) : 1.0;
      for (int j = 0; j < arm_->n(); ++j) ddq_[u(j)] += a * ((s.dq[u(j)] - dq_[u(j)]) / dt - ddq_[u(j)]);
    } else {
      ddq_ = {};
    }
    dq_ = s.dq;
    BaseFrame chain(*arm_, s.q, s.dq);
    chain.inverse_dynamics(without_noise(s, dt));
    const double b = dt > 0.0 && lag_ > 0.0 ? -std::expm1(-dt / lag_) : 1.0;
    for (int k = 0; k < loads_; ++k) {
      const JointVector column = chain.body_torque(arm_->n() - 1, moved(chain.pose().R, chain.pose().p, unit_[u(k)]));
      for (int j = 0; j < arm_->n(); ++j) H_[u(k)][u(j)] += b * (-column[u(j)] - H_[u(k)][u(j)]);
    }
  }

  /// The acceleration, shrunk by the part of it that is noise: a noisy regressor pulls the mass towards zero, the harder
  /// the more samples there are.  a (1 - (2 std(a)/a)^2),  std(a) that of the filtered difference of the velocities.
  JointVector without_noise(const JointSample& s, double dt) const noexcept {
    JointVector out{};
    if (!(dt > 0.0)) return out;
    const double a = config_.acceleration_time > 0.0 ? -std::expm1(-dt / config_.acceleration_time) : 1.0;
    for (int j = 0; j < arm_->n(); ++j) {
      const double noise = a / dt * s.dq_std[u(j)] * std::sqrt(2.0 / (2.0 - a)), square = ddq_[u(j)] * ddq_[u(j)];
      if (square > 4.0 * noise * noise) out[u(j)] = ddq_[u(j)] * (1.0 - 4.0 * noise * noise / square);
    }
    return out;
  }

  void predict(const JointSample& s, double dt) noexcept {
    const double phi = std::exp(-dt / config_.bias_time);
    const double smoothing = -std::expm1(-dt / 0.02);
    for (int j = 0; j < arm_->n(); ++j) {
      slow_dq_[u(j)] = started_ ? slow_dq_[u(j)] + smoothing * (s.dq[u(j)] - slow_dq_[u(j)]) : s.dq[u(j)];
      const JointDescription& d = arm_->joint(j);
      const bool changed = regime_.changed(*arm_, j, s.q[u(j)], slow_dq_[u(j)]);
      const double rest = d.friction.uncertainty(regime_.at_rest(j) ? 0.0 : 1e3 * d.friction.sign_velocity, config_.friction_fraction, s.tau[u(j)]);
      const double gain = d.torque_gain_std * s.tau[u(j)];
      const double variance = rest * rest + gain * gain;
      const double keep = !started_ || changed ? 0.0 : phi;
      since_change_[u(j)] = started_ && !changed ? since_change_[u(j)] + dt : 0.0;
      const int row = loads_ + j;
      x_[u(row)] *= keep;
      for (int c = 0; c < dim(); ++c) P(row, c) *= keep;
      for (int c = 0; c < dim(); ++c) P(c, row) *= keep;
      P(row, row) += (1.0 - keep * keep) * variance;
    }
  }

  void measure(int j, double y, double R) noexcept {
    const int row = loads_ + j, n = dim();
    std::array<double, stride> p{}, K{};
    for (int c = 0; c < n; ++c) {
      p[u(c)] = P(row, c);
      for (int k = 0; k < loads_; ++k) p[u(c)] += H_[u(k)][u(j)] * P(k, c);
    }
    double S = R + p[u(row)], predicted = x_[u(row)];
    for (int k = 0; k < loads_; ++k) {
      S += H_[u(k)][u(j)] * p[u(k)];
      predicted += H_[u(k)][u(j)] * x_[u(k)];
    }
    for (int c = 0; c < n; ++c) K[u(c)] = p[u(c)] / S;
    for (int r = 0; r < n; ++r) {
      const double left = p[u(r)] - S * K[u(r)];  // Joseph form: zero but for rounding
      for (int c = 0; c < n; ++c) P(r, c) -= K[u(r)] * p[u(c)] + left * K[u(c)];
      x_[u(r)] += K[u(r)] * (y - predicted);
    }
  }

  Payload report(Status status) const noexcept {
    Payload out;
    out.mass = x_[0];
    out.mass_std = std::sqrt(std::max(P_[0], 0.0));
    for (int k = 1; k < loads_; ++k) {
      out.first_moment[u(k - 1)] = x_[u(k)];
      out.first_moment_std[u(k - 1)] = std::sqrt(std::max(P_[u(k * stride + k)], 0.0));
    }
    out.status = status;
    if (status == Status::ok && !(out.mass_std <= std::max(config_.ok_relative * std::abs(out.mass), config_.ok_absolute)))
      out.status = Status::warming;
    return out;
  }

  const Arm* arm_;
  RegressionConfig config_;
  int loads_;
  double lag_ = 0.0;  // [s]
  std::array<Inertia<double>, 4> unit_;
  std::array<JointVector, 4> H_{};  // d tau_ext / d theta
  JointVector dq_{}, ddq_{}, slow_dq_{};
  detail::Regime regime_{};
  JointVector since_change_{};  // [s]
  std::array<double, stride> x_{};
  std::array<double, static_cast<std::size_t>(stride* stride)> P_{};
  bool started_ = false;
};

}  // namespace palpate
