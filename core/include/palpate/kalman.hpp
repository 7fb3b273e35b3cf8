// The Kalman filter that the extended Kalman observer and the payload filter share.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>

#include "palpate/chain.hpp"

namespace palpate {

/// Kalman filter for a serial chain with parameters that enter the torque linearly.
///
/// State x = (q, q', theta), n + n + k numbers; theta = (loads, joint torques, encoder errors), the latter two n each or
/// absent. Over one step h with the torque tau held,
///   W dv = h (tau - tau_f(q') - C q' - g - Y(q_m, q', 0) theta),     W = M(q_m; theta) + h Theta B,   q_m = q + h/2 q'
///   q+ = q + h (q' + Theta dv),   q'+ = q' + dv,   theta+ = phi theta,
/// B = d tau_f / d q'. Theta_j = (1/phi_1(x) - 1)/x with x = h B_j / M_jj and phi_1(x) = (1 - e^-x)/x: the weight that makes
/// each joint's friction decay exactly right, 1/2 (midpoint, second order) for slow joints and 1 (implicit) for joints whose
/// friction settles within a step, as with light links on heavily geared servos.
/// F - 1 = [0 h 0; 0 0 0; 0 0 phi-1] + [h Theta; 1; 0] X with X = -h W^-1 dtau/d(q, q', theta) exact (chain.hpp), so only
/// the n rows of X are multiplied with the covariance:  P <- F (F P)^T + Q.
/// Torque noise enters through W^-1. Measurements z = q + encoder error + noise are scalar, hence the update needs no
/// inversion; Joseph form. An encoder error is the rounding to a count: it stays while the joint stands, so no averaging
/// removes it, and is new after every count of motion.
/// (MATH.md section 3, extended Kalman; section 4, payload filter.)
template <int max_parameters>
class JointKalman {
 public:
  static constexpr int max_dim = 2 * max_joints + max_parameters;
  using Parameters = std::array<double, static_cast<std::size_t>(max_parameters)>;

  /// n joints, `loads` parameters with columns of their own, one torque per joint or none, one encoder error per joint or none.
  JointKalman(int n, int loads, bool torques, bool encoders) noexcept
      : n_(n),
        torque_(torques ? loads : -1),
        encoder_(encoders ? loads + (torques ? n : 0) : -1),
        k_(loads + (torques ? n : 0) + (encoders ? n : 0)),
        dim_(2 * n + k_),
        active_(encoders ? dim_ - n : dim_) {}

  int dim() const noexcept { return dim_; }
  double q(int i) const noexcept { return x_[u(i)]; }
  double dq(int i) const noexcept { return x_[u(n_ + i)]; }
  double parameter(int i) const noexcept { return x_[u(2 * n_ + i)]; }
  double covariance(int r, int c) const noexcept { return P_[u(r * dim_ + c)]; }
  double variance(int i) const noexcept { return covariance(i, i); }
  double parameter_variance(int i) const noexcept { return variance(2 * n_ + i); }
  JointVector positions() const noexcept { return slice(0); }
  /// q'' in the last prediction [rad/s^2].
  const JointVector& acceleration() const noexcept { return acceleration_; }
  /// The constant torque [N m] that steps of h seconds would have lacked, had they to be corrected by the same change of
  /// (q, q') each: M dq'/h, and dq/h is a velocity that friction, of slope B, would have damped.
  JointVector torque_of(const JointVector& dq, const JointVector& ddq, double h) const noexcept {
    JointVector out{};
    for (int i = 0; i < n_; ++i) {
      double sum = slope_[u(i)] * dq[u(i)];
      for (int j = 0; j < n_; ++j) sum += W_(i, j) * ddq[u(j)];
      out[u(i)] = sum / h;
    }
    return out;
  }
  /// The mass matrix of the last prediction, with what friction adds in a step [kg m^2].
  const JointMatrix& mass() const noexcept { return W_; }
  /// Slope of friction over q' in the last prediction [N m s/rad].
  const JointVector& damping() const noexcept { return slope_; }
  JointVector velocities() const noexcept { return slice(n_); }

  void set(int i, double mean, double var) noexcept {
    x_[u(i)] = mean;
    for (int c = 0; c < dim_; ++c) P_[u(i * dim_ + c)] = P_[u(c * dim_ + i)] = 0.0;
    P_[u(i * dim_ + i)] = var;
  }
  void set_parameter(int i, double mean, double var) noexcept { set(2 * n_ + i, mean, var); }
  void add_variance(int i, double var) noexcept { P_[u(i * dim_ + i)] += var; }
  void add_parameter_variance(int i, double var) noexcept { add_variance(2 * n_ + i, var); }
  /// Friction as it is on average over the velocities that are possible: the sign is only as sharp as the velocity is known
  /// (statistical linearisation: tanh(v / v_0) of v ~ N(v, P) is close to tanh(v / sqrt(v_0^2 + P))).
  Friction expected_friction(const Arm& arm, int i) const noexcept {
    Friction friction = arm.joint(i).friction;
    friction.sign_velocity = std::sqrt(friction.sign_velocity * friction.sign_velocity + std::max(variance(n_ + i), 0.0));
    return friction;
  }
  /// False once rounding or an absurd input has broken the state: it must then be started anew.
  bool healthy() const noexcept {
    for (int i = 0; i < dim_; ++i)
      if (!std::isfinite(x_[u(i)]) || !(covariance(i, i) >= 0.0) || !std::isfinite(covariance(i, i))) return false;
    return true;
  }
  /// P += v e e^T and x += m e: an error known to lie along e.
  void add_direction(const std::array<double, max_dim>& e, double m, double v) noexcept {
    for (int r = 0; r < dim_; ++r) {
      x_[u(r)] += m * e[u(r)];
      for (int c = 0; c < dim_; ++c) P_[u(r * dim_ + c)] += v * e[u(r)] * e[u(c)];
    }
  }

  /// What one prediction needs beside the arm.
  struct Input {
    const JointVector& tau;               ///< link-side motor torque held over the step [N m]
    const JointVector& torque_variance;   ///< of tau and of the model, white per step [N^2 m^2]
    Inertia<double> load;                 ///< body on the last link that theta stands for, made physical, about the link's origin
    Inertia<double> load_rest;            ///< what making it physical took away: its weight acts, its inertia does not
    const Parameters& decay;              ///< phi per parameter
  };

  /// One step of h seconds. `columns(chain, D, stride)` fills the loads' columns of D, row-major: torque needed per unit of
  /// theta, from the chain at (q_m, q', dv/h).
  template <class Columns>
  void predict(const Arm& arm, const Input& in, double h, Columns&& columns) noexcept {
    JointVector q_m{}, v{};
    for (int i = 0; i < n_; ++i) {
      v[u(i)] = dq(i);
      q_m[u(i)] = q(i) + 0.5 * h * dq(i);
    }
    BaseFrame chain(arm, q_m, v, in.load);
    const JointVector bias = chain.inverse_dynamics(JointVector{});
    JointVector rest{};
    if (in.load_rest.m != 0.0 || in.load_rest.mc.x != 0.0 || in.load_rest.mc.y != 0.0 || in.load_rest.mc.z != 0.0)
      rest = chain.body_torque(n_ - 1, moved(chain.pose().R, chain.pose().p, in.load_rest));
    W_ = mass_matrix<double>(arm, q_m, in.load);
    JointVector r{};
    for (int i = 0; i < n_; ++i) {
      const Friction friction = expected_friction(arm, i);
      // Friction that falls with speed (Stribeck) keeps its value over the step: extrapolated, a light joint would run away.
      slope_[u(i)] = std::max(friction.derivative(v[u(i)]), 0.0);
      const double x = h * slope_[u(i)] / W_(i, i);
      theta_[u(i)] = weight(x);
      r[u(i)] = h * (in.tau[u(i)] - friction.torque(v[u(i)]) - bias[u(i)] - rest[u(i)]);
      if (torque_ >= 0) r[u(i)] += h * parameter(torque_ + i);
    }
    for (int i = 0; i < n_; ++i) W_(i, i) += h * theta_[u(i)] * slope_[u(i)];
    const Cholesky<double> factor(W_, n_);
    const JointVector dv = factor.solve(r);
    JointVector a{};
    for (int i = 0; i < n_; ++i) a[u(i)] = dv[u(i)] / h;
    acceleration_ = a;

    // X = -h W^-1 [dtau/dq, dtau/dq' + B + h/2 dtau/dq, D], and N = h W^-1 beside it.
    chain.inverse_dynamics(a);
    JointMatrix M, Jq, Jv;
    chain.derivatives(M, Jq, Jv);
    const int columns_x = active_ + n_, dynamic = active_ - 2 * n_;
    std::array<double, static_cast<std::size_t>(max_joints* max_parameters)> D{};
    columns(chain, D.data(), dynamic);
    if (torque_ >= 0)
      for (int i = 0; i < n_; ++i) D[u(i * dynamic + torque_ + i)] = -1.0;
    for (int i = 0; i < n_; ++i) {
      double* row = X_.data() + i * columns_x;
      for (int j = 0; j < n_; ++j) {
        row[j] = -h * Jq(i, j);
        row[n_ + j] = -h * (Jv(i, j) + 0.5 * h * Jq(i, j));
      }
      row[n_ + i] -= h * slope_[u(i)];
      for (int p = 0; p < dynamic; ++p) row[2 * n_ + p] = -h * D[u(i * dynamic + p)];
      for (int j = 0; j < n_; ++j) row[active_ + j] = i == j ? h : 0.0;
    }
    factor.solve_rows(X_.data(), columns_x, columns_x);

    for (int i = 0; i < n_; ++i) {
      x_[u(i)] += h * (v[u(i)] + theta_[u(i)] * dv[u(i)]);
      x_[u(n_ + i)] += dv[u(i)];
    }
    h_ = h;
    decay_ = in.decay;
    if (encoder_ >= 0)
      for (int i = 0; i < n_; ++i) decay_[u(encoder_ + i)] = rounding_decay(arm, i);
    for (int p = 0; p < k_; ++p) x_[u(2 * n_ + p)] *= decay_[u(p)];
    apply_F(P_, T_);
    transpose();
    apply_F(T_, P_);
    add_torque_noise(in.torque_variance);
    if (encoder_ >= 0)
      for (int i = 0; i < n_; ++i) {
        const double phi = decay_[u(encoder_ + i)];
        add_parameter_variance(encoder_ + i, (1.0 - phi * phi) * encoder_variance(arm, i));
      }
    symmetrise();
  }

  /// e <- F e with the F of the last prediction: how an error travels.
  void propagate(std::array<double, max_dim>& e) const noexcept {
    const int columns_x = active_ + n_;
    std::array<double, max_joints> g{};
    for (int i = 0; i < n_; ++i) {
      double s = 0.0;
      for (int c = 0; c < active_; ++c) s += X_[u(i * columns_x + c)] * e[u(c)];
      g[u(i)] = s;
    }
    for (int i = 0; i < n_; ++i) {
      e[u(i)] += h_ * e[u(n_ + i)] + h_ * theta_[u(i)] * g[u(i)];
      e[u(n_ + i)] += g[u(i)];
    }
    for (int p = 0; p < k_; ++p) e[u(2 * n_ + p)] *= decay_[u(p)];
  }

  /// Result of one scalar measurement: innovation y, its variance s, gain K (valid until the next call).
  struct Update {
    double y, s;
    const double* K;
  };
  /// z = x_i + noise of variance R, or z = x_i + x_e + noise where e >= 0.
  Update measure(int i, int e, double z, double R) noexcept {
    const Update update = measure_upper(i, e, z, R);
    symmetrise();
    return update;
  }

  /// Position measured, velocity unknown within velocity_std, no correlation with the parameters.
  void start(const Arm& arm, const JointSample& sample, double velocity_std) noexcept {
    for (int i = 0; i < n_; ++i) {
      set(i, sample.q[u(i)], std::max(arm.position_variance(i), least_variance));
      if (encoder_ >= 0) {
        const double rounding = encoder_variance(arm, i);
        rounded_at_[u(i)] = sample.q[u(i)];
        set_parameter(encoder_ + i, 0.0, rounding);
        P_[u(i * dim_ + 2 * n_ + encoder_ + i)] = P_[u((2 * n_ + encoder_ + i) * dim_ + i)] = -rounding;  // z = q + e is known
      }
      const double measured = arm.joint(i).velocity_std;
      if (sample.velocity_measured && std::isfinite(measured)) set(n_ + i, sample.dq[u(i)], measured * measured);
      else set(n_ + i, 0.0, velocity_std * velocity_std);
    }
  }

  struct Innovation {
    double y, s;
  };
  /// What measure_joints() would see of joint i's position: innovation and variance.
  Innovation innovation(const Arm& arm, const JointSample& sample, int i) const noexcept {
    Innovation out{sample.q[u(i)] - q(i), variance(i) + std::max(arm.position_variance(i), least_variance)};
    if (encoder_ >= 0) {
      const int e = 2 * n_ + encoder_ + i;
      out.y -= x_[u(e)];
      out.s += 2.0 * covariance(i, e) + variance(e);
    }
    return out;
  }
  /// All of a sample's positions, and its velocities where the arm declares how good they are. `seen(i, e, update)` after
  /// each: it measured state i, plus state e if e >= 0.
  template <class Seen>
  void measure_joints(const Arm& arm, const JointSample& sample, Seen&& seen) noexcept {
    for (int i = 0; i < n_; ++i) {
      const JointDescription& d = arm.joint(i);
      const int e = encoder_ >= 0 ? 2 * n_ + encoder_ + i : -1;
      // The rounding counts twice, as a state that stays and as noise: it is in truth neither, but a saw-tooth of q.
      seen(i, e, measure_upper(i, e, sample.q[u(i)], std::max(arm.position_variance(i), least_variance)));
      if (sample.velocity_measured && std::isfinite(d.velocity_std))
        seen(n_ + i, -1, measure_upper(n_ + i, -1, sample.dq[u(i)], std::max(d.velocity_std * d.velocity_std, least_variance)));
    }
    symmetrise();
  }

  /// X of the last prediction, the part that is not zero (for tests).
  double sensitivity(int i, int c) const noexcept { return X_[u(i * (active_ + n_) + c)]; }

 private:
  static constexpr double least_variance = 1e-16;  // of a reading said to be exact [rad^2]
  static double encoder_variance(const Arm& arm, int i) noexcept {
    return arm.joint(i).position_resolution * arm.joint(i).position_resolution / 12.0;
  }
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }
  using Matrix = std::array<double, static_cast<std::size_t>(max_dim* max_dim)>;

  JointVector slice(int first) const noexcept {
    JointVector out{};
    for (int i = 0; i < n_; ++i) out[u(i)] = x_[u(first + i)];
    return out;
  }
  /// Correlation of joint i's rounding error before and after a step. The error of rounding repeats with every count of
  /// motion, its correlation is zero after a fifth of one; motion is judged from where the error was last renewed, since
  /// summing |q'| of a joint at rest would let the noise of q' move it.
  double rounding_decay(const Arm& arm, int i) noexcept {
    const double count = arm.joint(i).position_resolution, moved = std::abs(q(i) - rounded_at_[u(i)]);
    if (moved < 0.25 * count) return 1.0;
    rounded_at_[u(i)] = q(i);
    return count > 0.0 ? std::exp(-moved / (0.2 * count)) : 0.0;
  }
  /// (1/phi_1(x) - 1)/x, by its series near zero.
  static double weight(double x) noexcept {
    if (x < 1e-2) return 0.5 + x / 12.0 - x * x * x / 720.0;
    return 1.0 / (1.0 - std::exp(-x)) - 1.0 / x;
  }
  /// to = F from.
  void apply_F(const Matrix& from, Matrix& to) noexcept {
    const int columns_x = active_ + n_;
    for (int i = 0; i < n_; ++i) {
      std::array<double, max_dim> g{};
      for (int c = 0; c < active_; ++c) {
        const double f = X_[u(i * columns_x + c)];
        const double* row = from.data() + c * dim_;
        for (int j = 0; j < dim_; ++j) g[u(j)] += f * row[j];
      }
      const double ht = h_ * theta_[u(i)];
      const double *fq = from.data() + i * dim_, *fv = from.data() + (n_ + i) * dim_;
      double *tq = to.data() + i * dim_, *tv = to.data() + (n_ + i) * dim_;
      for (int j = 0; j < dim_; ++j) {
        tq[j] = fq[j] + h_ * fv[j] + ht * g[u(j)];
        tv[j] = fv[j] + g[u(j)];
      }
    }
    for (int p = 0; p < k_; ++p)
      for (int j = 0; j < dim_; ++j) to[u((2 * n_ + p) * dim_ + j)] = decay_[u(p)] * from[u((2 * n_ + p) * dim_ + j)];
  }
  void transpose() noexcept {
    for (int r = 0; r < dim_; ++r)
      for (int c = r + 1; c < dim_; ++c) std::swap(T_[u(r * dim_ + c)], T_[u(c * dim_ + r)]);
  }
  /// measure() on the upper triangle of P; symmetrise() after the last.
  Update measure_upper(int i, int e, double z, double R) noexcept {
    const auto add_row = [this](int row) {
      for (int c = 0; c < row; ++c) p_[u(c)] += P_[u(c * dim_ + row)];
      for (int c = row; c < dim_; ++c) p_[u(c)] += P_[u(row * dim_ + c)];
    };
    double y = z - x_[u(i)];
    std::fill_n(p_.begin(), dim_, 0.0);
    add_row(i);
    if (e >= 0) {
      add_row(e);
      y -= x_[u(e)];
    }
    const double s = p_[u(i)] + (e >= 0 ? p_[u(e)] : 0.0) + R;
    const double scale = 1.0 / std::sqrt(s);  // P -= u u^T with u = p/sqrt(s): what is taken away is never negative
    for (int c = 0; c < dim_; ++c) {
      K_[u(c)] = p_[u(c)] / s;
      p_[u(c)] *= scale;
    }
    for (int r = 0; r < dim_; ++r) {
      const double ur = p_[u(r)];
      double* P = P_.data() + r * dim_;
      for (int c = r; c < dim_; ++c) P[c] -= ur * p_[u(c)];
      x_[u(r)] += K_[u(r)] * y;
    }
    return {y, s, K_.data()};
  }
  void symmetrise() noexcept {
    for (int r = 0; r < dim_; ++r)
      for (int c = r + 1; c < dim_; ++c) P_[u(c * dim_ + r)] = P_[u(r * dim_ + c)];
  }
  /// White within the step too: were it constant there, a large one would leave a velocity error that alternates from sample to
  /// sample, which the positions at the samples cannot see.
  void add_torque_noise(const JointVector& variance) noexcept {
    const int columns_x = active_ + n_;
    for (int i = 0; i < n_; ++i)
      for (int j = 0; j < n_; ++j) {
        double s = 0.0;
        for (int c = 0; c < n_; ++c) s += X_[u(i * columns_x + active_ + c)] * variance[u(c)] * X_[u(j * columns_x + active_ + c)];
        const double hi = h_ * theta_[u(i)], hj = h_ * theta_[u(j)];
        P_[u((n_ + i) * dim_ + n_ + j)] += s;
        P_[u(i * dim_ + n_ + j)] += hi * s;
        P_[u((n_ + i) * dim_ + j)] += s * hj;
        P_[u(i * dim_ + j)] += hi * s * hj + h_ * h_ / 12.0 * s;
      }
  }

  int n_, torque_, encoder_, k_, dim_;
  int active_;  // states the dynamics depend on: all but the encoder errors, which come last
  double h_ = 0.0;
  std::array<double, max_dim> x_{}, K_{}, p_{};
  JointVector theta_{}, slope_{}, acceleration_{}, rounded_at_{};
  JointMatrix W_{};
  Parameters decay_{};
  Matrix P_{}, T_{};
  std::array<double, static_cast<std::size_t>(max_joints*(max_dim + max_joints))> X_{};
};

}  // namespace palpate
