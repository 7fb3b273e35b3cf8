// Second-order sliding-mode observer: the published one, with every choice its authors made as an option.
#pragma once
#include "palpate/filter.hpp"
#include "palpate/observers/observer.hpp"

namespace palpate {

/// How the observer's own equations are integrated over a sample.
enum class Solver {
  euler,           ///< one evaluation; friction implicit, so it stays stable on light links with heavy friction
  rk4,             ///< classical Runge-Kutta, four evaluations
  dormand_prince,  ///< order 5, six evaluations: Simulink's ode5
};

struct SlidingModeConfig {
  double lambda = 6.0;         ///< [rad^1/2 / s]
  double alpha = 4.2;          ///< [rad/s^2]; valid only while it exceeds sup |M^-1 tau_ext|
  double gamma = 1e-4;         ///< sgn e is tanh(e / 2 gamma) [rad]; 0: the true sign
  bool friction = true;        ///< friction in f; the published curves were made without (MATH.md section 1, R 2)
  int order = 4;               ///< of the Butterworth low-pass
  double cutoff = 1.0;         ///< of the low-pass [rad/s]: 1 rad/s made the published curves, not the text's 1 Hz
  Solver solver = Solver::rk4;
  int substeps = 0;            ///< steps of the solver per sample; 0: as many as the injection's slope needs
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
};

/// R eqs. (4)-(7), (16)-(17) (Davila, Fridman, Levant 2005), e = q - x1:
///   x1' = x2 + lambda |e|^1/2 sgn e,   x2' = f(q, x2, tau) + alpha sgn e,   tau_ext = M(q) LPF(alpha sgn e)
/// f = M^-1 (tau - C x2 - g [- tau_f]) is the arm's own acceleration. (MATH.md section 3.)
///
/// Inputs are held over the sample. The low-pass gets the mean of alpha sgn e over the sample as the solver weighted it:
/// one point of it is aliased by the switching. The step of an explicit solver must resolve the smooth sign's slope,
/// at most 0.635 lambda / sqrt(gamma) [1/s]; substeps = 0 takes care of that.
///
/// `saturated`: sgn e has stayed at one side, so alpha is too small for this arm and load: in acceleration units a light arm
/// needs alpha in the hundreds. If the state then leaves the measurement by 0.5 rad, it is set back to it.
class SlidingModeObserver {
 public:
  explicit SlidingModeObserver(const Arm& arm, const SlidingModeConfig& config = {})
      : arm_(&arm),
        config_(config),
        low_pass_(Butterworth::from_rad_per_s(config.order, config.cutoff), arm.n(), Start::zero) {
    if (!arm.has_dynamics()) throw std::invalid_argument("SlidingModeObserver: the arm has no masses; give inertials");
    check::positive("SlidingModeConfig lambda [rad^1/2/s]", config.lambda);
    check::positive("SlidingModeConfig alpha [rad/s^2]", config.alpha);
    check::not_negative("SlidingModeConfig gamma [rad]", config.gamma);
    check::in_range("SlidingModeConfig substeps", config.substeps, 0, 64);
    check::not_negative("SlidingModeConfig friction_fraction [1]", config.friction_fraction);
  }

  ExternalTorque step(const JointSample& s) noexcept {
    if (detail::unusable(s)) return report(Status::held);
    const int n = arm_->n();
    if (!started_ || s.status == Status::gap || !(s.dt > 0.0)) {
      x1_ = s.q;
      x2_ = s.velocity_measured ? s.dq : JointVector{};
      started_ = true;
      elapsed_ = 0.0;
      return report(s.status == Status::gap ? Status::gap : Status::warming);
    }
    M_ = mass_matrix<double>(*arm_, s.q);
    const int steps = substeps(s.dt);
    const double h = s.dt / steps;
    const Cholesky<double> factor(M_, n);
    const Placements<double> at(*arm_, s.q);
    JointVector injected{};  // integral of alpha sgn e over the sample [rad/s]
    for (int k = 0; k < steps; ++k) {
      if (config_.solver == Solver::euler) euler(s, at, h, injected);
      else if (config_.solver == Solver::rk4) runge_kutta(rk4_, s, at, h, factor, injected);
      else runge_kutta(dormand_prince_, s, at, h, factor, injected);
    }
    bool astray = false, one_sided = false;
    const double weight = -std::expm1(-s.dt / 0.25);
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      z2_[u] = injected[u] / s.dt;
      side_[u] += weight * (z2_[u] / config_.alpha - side_[u]);
      one_sided = one_sided || std::abs(side_[u]) > 0.95;
      astray = astray || !(std::abs(s.q[u] - x1_[u]) < 0.5) || !std::isfinite(x2_[u]);
    }
    if (astray) {
      x1_ = s.q;
      x2_ = s.velocity_measured ? s.dq : JointVector{};
      for (double& z : z2_) z = std::isfinite(z) ? z : 0.0;
      since_astray_ = 0.0;
    }
    low_pass_.step(z2_, s.dt);
    elapsed_ += s.dt;
    since_astray_ += s.dt;
    const double settle = 7.0 / config_.cutoff;  // of a fourth-order Butterworth to 5 %
    const double spread = config_.alpha * s.dt * config_.cutoff;
    for (int i = 0; i < n; ++i) {
      double tau = 0.0, variance = 0.0;
      for (int j = 0; j < n; ++j) {
        tau += M_(i, j) * low_pass_.value()[detail::at(j)];
        variance += M_(i, j) * M_(i, j) * spread * spread;
      }
      const double friction = arm_->joint(i).friction.uncertainty(x2_[detail::at(i)], config_.friction_fraction, s.tau[detail::at(i)]);
      torque_[detail::at(i)] = tau;
      variance_[detail::at(i)] = variance + arm_->torque_variance(i);
      friction_[detail::at(i)] = friction;
    }
    if (s.status != Status::ok && s.status != Status::warming) return report(s.status);  // velocity is not needed: warming is fine
    return report(one_sided || since_astray_ < settle ? Status::saturated : elapsed_ < settle ? Status::warming : Status::ok);
  }

  /// How late the torque is [s]: the delay of the Butterworth low-pass at low frequencies.
  double lag() const noexcept { return 1.0 / (config_.cutoff * std::sin(std::numbers::pi / (2.0 * config_.order))); }

  void reset() { *this = SlidingModeObserver(*arm_, config_); }

  const JointVector& positions() const noexcept { return x1_; }   ///< x1 [rad]
  const JointVector& velocities() const noexcept { return x2_; }  ///< x2 [rad/s]

 private:
  struct Tableau {
    int stages;
    std::array<std::array<double, 5>, 6> a;  // a[s]: weights of earlier stages for stage s
    std::array<double, 6> b;
  };
  static constexpr Tableau rk4_{4, {{{}, {1.0 / 2}, {0, 1.0 / 2}, {0, 0, 1.0}}}, {1.0 / 6, 1.0 / 3, 1.0 / 3, 1.0 / 6}};
  static constexpr Tableau dormand_prince_{
      6,
      {{{},
        {1.0 / 5},
        {3.0 / 40, 9.0 / 40},
        {44.0 / 45, -56.0 / 15, 32.0 / 9},
        {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
        {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656}}},
      {35.0 / 384, 0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84}};

  double sign(double e) const noexcept {
    if (config_.gamma > 0.0) return std::tanh(e / (2.0 * config_.gamma));
    return e > 0.0 ? 1.0 : e < 0.0 ? -1.0 : 0.0;
  }
  int substeps(double dt) const noexcept {
    if (config_.substeps > 0) return config_.substeps;
    if (!(config_.gamma > 0.0)) return 1;
    const double reach = config_.solver == Solver::euler ? 1.6 : config_.solver == Solver::rk4 ? 2.2 : 2.6;
    return 1 + std::min(63, static_cast<int>(0.635 * config_.lambda / std::sqrt(config_.gamma) * dt / reach));
  }

  /// x1' and the injection alpha sgn e, at the state (x1, x2).
  void injection(const JointSample& s, const JointVector& x1, const JointVector& x2, JointVector& dx1, JointVector& z2) const noexcept {
    for (int j = 0; j < arm_->n(); ++j) {
      const auto u = detail::at(j);
      const double e = s.q[u] - x1[u], sgn = sign(e);
      dx1[u] = x2[u] + config_.lambda * std::sqrt(std::abs(e)) * sgn;
      z2[u] = config_.alpha * sgn;
    }
  }

  void euler(const JointSample& s, const Placements<double>& at, double h, JointVector& injected) noexcept {
    JointVector dx1{}, z2{};
    injection(s, x1_, x2_, dx1, z2);
    JointVector r = inverse_dynamics<double>(*arm_, at, x2_, JointVector{});
    JointMatrix W = M_;
    for (int j = 0; j < arm_->n(); ++j) {
      const auto u = detail::at(j);
      r[u] = h * (s.tau[u] - r[u]);
      if (config_.friction) {
        const Friction& friction = arm_->joint(j).friction;
        r[u] -= h * friction.torque(x2_[u]);
        W(j, j) += h * std::max(friction.derivative(x2_[u]), 0.0);  // falling friction (Stribeck) keeps its value over the step
      }
    }
    const JointVector dv = Cholesky<double>(W, arm_->n()).solve(r);
    for (int j = 0; j < arm_->n(); ++j) {
      const auto u = detail::at(j);
      x1_[u] += h * dx1[u];
      x2_[u] += dv[u] + h * z2[u];
      injected[u] += h * z2[u];
    }
  }

  void runge_kutta(const Tableau& t, const JointSample& s, const Placements<double>& at, double h, const Cholesky<double>& factor,
                   JointVector& injected) noexcept {
    const int n = arm_->n();
    std::array<JointVector, 6> k1{}, k2{}, z2{};
    for (int stage = 0; stage < t.stages; ++stage) {
      const auto S = detail::at(stage);
      JointVector x1 = x1_, x2 = x2_;
      for (std::size_t p = 0; p < S; ++p)
        for (int j = 0; j < n; ++j) {
          x1[detail::at(j)] += h * t.a[S][p] * k1[p][detail::at(j)];
          x2[detail::at(j)] += h * t.a[S][p] * k2[p][detail::at(j)];
        }
      injection(s, x1, x2, k1[S], z2[S]);
      JointVector r = inverse_dynamics<double>(*arm_, at, x2, JointVector{});
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        r[u] = s.tau[u] - r[u];
        if (config_.friction) r[u] -= arm_->joint(j).friction.torque(x2[u]);
      }
      k2[S] = factor.solve(r);
      for (int j = 0; j < n; ++j) k2[S][detail::at(j)] += z2[S][detail::at(j)];
    }
    for (int stage = 0; stage < t.stages; ++stage) {
      const auto S = detail::at(stage);
      for (int j = 0; j < n; ++j) {
        const auto u = detail::at(j);
        x1_[u] += h * t.b[S] * k1[S][u];
        x2_[u] += h * t.b[S] * k2[S][u];
        injected[u] += h * t.b[S] * z2[S][u];
      }
    }
  }

  ExternalTorque report(Status status) const noexcept { return detail::report(arm_->n(), torque_, variance_, friction_, status); }

  const Arm* arm_;
  SlidingModeConfig config_;
  HeldButterworth<> low_pass_;
  JointMatrix M_{};
  JointVector x1_{}, x2_{}, z2_{}, side_{}, torque_{}, variance_{}, friction_{};
  double elapsed_ = 0.0, since_astray_ = 1e9;  // [s]
  bool started_ = false;
};

static_assert(DisturbanceObserver<SlidingModeObserver>);

}  // namespace palpate
