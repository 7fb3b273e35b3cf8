// Wrench at the hand from the external torque of the joints: weighted, damped by a prior, with covariance and conditioning.
#pragma once
#include <algorithm>
#include <limits>

#include "palpate/chain.hpp"
#include "palpate/check.hpp"

namespace palpate {

/// What is held and known, so that its weight and inertia are not taken for a push.
struct LoadConfig {
  double mass = std::numeric_limits<double>::quiet_NaN();  ///< [kg]; NaN: what the payload estimator says, once it is `ok`
  std::array<double, 3> com{};      ///< centre of mass from the grasp point, tip axes [m]; with a given mass
  double mass_std = 0.0;            ///< of a given mass [kg]
  double acceleration_time = 0.02;  ///< time constant of the acceleration that the inertia needs [s]
};

/// Torque a held load exerts on the joints, tau_L = -Y_L(q, q', q'') pi_L, and what its uncertainty does to a covariance.
class LoadTorque {
 public:
  explicit LoadTorque(const Arm& arm, const LoadConfig& config = {}) : arm_(&arm), config_(config) {
    if (!std::isnan(config.mass)) check::not_negative("LoadConfig mass [kg]", config.mass);
    for (double x : config.com) check::finite("LoadConfig com [m]", x);
    check::not_negative("LoadConfig mass_std [kg]", config.mass_std);
    check::not_negative("LoadConfig acceleration_time [s]", config.acceleration_time);
    const Mat3<double> R = arm.R_last_tip();
    const Vec3<double> c = arm.p_last_grasp();
    const std::array<Vec3<double>, 3> axes{R.cx, R.cy, R.cz};
    unit_[0] = about_origin(1.0, c, Sym3<double>{});
    for (std::size_t k = 0; k < 3; ++k) unit_[k + 1] = {0.0, axes[k], parallel_axis(axes[k], c)};
    if (!std::isnan(config.mass)) {
      unit_[0] = about_origin(1.0, c + R * Arm::to_vec(config.com), Sym3<double>{});
      theta_[0] = config.mass;
      std_[0] = config.mass_std;
    }
  }

  /// The newest sample, and what the estimator says of the load (taken if the mass is not given and the estimator says `ok`).
  void step(const JointSample& s, const Payload& payload) noexcept {
    if (s.status == Status::non_finite || s.status == Status::time_error) return;
    if (std::isnan(config_.mass) && payload.status == Status::ok) {
      theta_ = {payload.mass, payload.first_moment[0], payload.first_moment[1], payload.first_moment[2]};
      std_ = {payload.mass_std, payload.first_moment_std[0], payload.first_moment_std[1], payload.first_moment_std[2]};
    }
    const bool continues = started_ && s.dt > 0.0 && s.status == Status::ok;
    if (continues) {
      const double a = config_.acceleration_time > 0.0 ? -std::expm1(-s.dt / config_.acceleration_time) : 1.0;
      for (int j = 0; j < arm_->n(); ++j) ddq_[u(j)] += a * ((s.dq[u(j)] - dq_[u(j)]) / s.dt - ddq_[u(j)]);
    } else {
      ddq_ = {};
    }
    dq_ = s.dq;
    started_ = s.status == Status::ok;
    torque_ = {};
    present_ = theta_[0] != 0.0 || std_[0] != 0.0;
    if (!present_) return;
    BaseFrame chain(*arm_, s.q, s.dq);
    chain.inverse_dynamics(ddq_);
    for (int k = 0; k < 4; ++k) {
      column_[u(k)] = chain.body_torque(arm_->n() - 1, moved(chain.pose().R, chain.pose().p, unit_[u(k)]));
      for (int j = 0; j < arm_->n(); ++j) torque_[u(j)] -= theta_[u(k)] * column_[u(k)][u(j)];
    }
  }

  /// tau_L [N m]: what the load adds to the external torque.
  const JointVector& torque() const noexcept { return torque_; }
  double mass() const noexcept { return theta_[0]; }
  /// Standard deviation of tau_L at one joint [N m].
  double std(int j) const noexcept {
    double sum = 0.0;
    for (int k = 0; present_ && k < 4; ++k) sum += std_[u(k)] * std_[u(k)] * column_[u(k)][u(j)] * column_[u(k)][u(j)];
    return std::sqrt(sum);
  }
  /// Sigma += covariance of tau_L.
  void add_covariance(JointMatrix& sigma) const noexcept {
    for (int k = 0; present_ && k < 4; ++k) {
      const double v = std_[u(k)] * std_[u(k)];
      for (int i = 0; v > 0.0 && i < arm_->n(); ++i)
        for (int j = 0; j < arm_->n(); ++j) sigma(i, j) += v * column_[u(k)][u(i)] * column_[u(k)][u(j)];
    }
  }
  void reset() { *this = LoadTorque(*arm_, config_); }

 private:
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }

  const Arm* arm_;
  LoadConfig config_;
  std::array<Inertia<double>, 4> unit_{};
  std::array<double, 4> theta_{}, std_{};  // m, m delta [kg, kg m]
  std::array<JointVector, 4> column_{};
  JointVector dq_{}, ddq_{}, torque_{};
  bool started_ = false, present_ = false;
};

struct WrenchConfig {
  Axes axes = Axes::base;             ///< of force and moment
  Point point = Point::grasp;         ///< about which the moment is
  double force_prior_std = 500.0;     ///< how large a force may be, each direction [N]
  double moment_prior_std = 100.0;    ///< and a moment [N m]; 0: nothing but a force acts at the point
  double singular_share = 0.1;        ///< a component is singular while its variance is above this part of the prior's [1]
};

/// MATH.md section 5:  F = (J Sigma^-1 J^T + Lambda)^-1 J Sigma^-1 (tau_ext - tau_L),   Cov(F) = (J Sigma^-1 J^T + Lambda)^-1
///
/// J the 6 x n Jacobian of the point [m, 1], Sigma the observer's covariance and the load's [N^2 m^2], tau_L the load's torque
/// (LoadTorque). Lambda = diag(1/force_prior_std^2, 1/moment_prior_std^2) is the damping lambda^2 with its units set right: the
/// solution is the mean, and Cov(F) the covariance, of a wrench that is known to be about so large before anything is felt.
/// A joint the observer is unsure of counts little. Where the pose shows nothing the estimate tends to zero, the standard
/// deviation to the prior's, and the component is marked singular. conditioning = sqrt(largest/smallest eigenvalue) of
/// Lambda^-1/2 J Sigma^-1 J^T Lambda^-1/2.
class WrenchEstimator {
 public:
  explicit WrenchEstimator(const Arm& arm, const WrenchConfig& config = {})
      : arm_(&arm), config_(config), dim_(config.moment_prior_std > 0.0 ? 6 : 3) {
    check::positive("WrenchConfig force_prior_std [N]", config.force_prior_std);
    check::not_negative("WrenchConfig moment_prior_std [N m]", config.moment_prior_std);
    check::positive("WrenchConfig singular_share [1]", config.singular_share);
    for (int k = 0; k < dim_; ++k) prior_[u(k)] = k < 3 ? config.force_prior_std : config.moment_prior_std;
    last_.axes = config.axes;
    last_.point = config.point;
  }

  /// q of the instant of the torque [rad]; sigma its covariance [N^2 m^2].
  Wrench step(const JointVector& q, const ExternalTorque& external, const JointMatrix& sigma, const LoadTorque& load) noexcept {
    const bool usable = external.status == Status::ok || external.status == Status::saturated;
    if (!usable) {
      last_.status = solved_ || external.status != Status::held ? external.status : Status::warming;
      return last_;
    }
    const int n = arm_->n();
    JointMatrix S = sigma;
    load.add_covariance(S);
    for (int j = 0; j < n; ++j) S(j, j) += least_variance;
    const Cholesky<double> factor(S, n);

    // Rows of [J^T | tau]: one per joint, so that the solver runs over memory in order.
    const Pose<double> P = forward_kinematics<double>(*arm_, q);
    const Vec3<double> x = P.p + P.R * (config_.point == Point::grasp ? arm_->p_last_grasp() : arm_->p_last_tip());
    const Mat3<double> R = P.R * arm_->R_last_tip();
    constexpr int stride = 7;
    std::array<double, static_cast<std::size_t>(max_joints* stride)> Jt{}, X;
    for (int j = 0; j < n; ++j) {
      Vec3<double> v = jacobian_column(*arm_, P, j, x), w = arm_->body(j).prismatic ? Vec3<double>{} : P.axis[u(j)];
      if (config_.axes == Axes::tip) {
        v = transposed(R, v);
        w = transposed(R, w);
      }
      double* row = Jt.data() + j * stride;
      row[0] = v.x, row[1] = v.y, row[2] = v.z;
      if (dim_ == 6) row[3] = w.x, row[4] = w.y, row[5] = w.z;
      row[dim_] = external.torque[u(j)] - load.torque()[u(j)];
    }
    X = Jt;
    factor.solve_rows(X.data(), stride, dim_ + 1);

    JointMatrix A{}, posterior{};  // in units of the prior: Lambda^-1/2 J Sigma^-1 J^T Lambda^-1/2
    JointVector b{};
    for (int j = 0; j < n; ++j)
      for (int r = 0; r < dim_; ++r) {
        const double jr = Jt[u(j * stride + r)] * prior_[u(r)];
        for (int c = 0; c < dim_; ++c) A(r, c) += jr * X[u(j * stride + c)] * prior_[u(c)];
        b[u(r)] += jr * X[u(j * stride + dim_)];
      }
    for (int r = 0; r < dim_; ++r)
      for (int c = 0; c < dim_; ++c) posterior(r, c) = 0.5 * (A(r, c) + A(c, r)) + (r == c ? 1.0 : 0.0);
    const Cholesky<double> inverse(posterior, dim_);
    if (!factor.positive() || !inverse.positive()) {
      last_.status = Status::non_finite;
      return last_;
    }
    const JointVector f = inverse.solve(b);
    Wrench out;
    out.axes = config_.axes;
    out.point = config_.point;
    out.load_mass = load.mass();
    bool singular = false;
    for (int c = 0; c < dim_; ++c) {
      JointVector unit{};
      unit[u(c)] = 1.0;
      const JointVector column = inverse.solve(unit);
      for (int r = 0; r < dim_; ++r) out.covariance[u(6 * r + c)] = column[u(r)] * prior_[u(r)] * prior_[u(c)];
      const double value = f[u(c)] * prior_[u(c)], std = std::sqrt(column[u(c)]) * prior_[u(c)];
      (c < 3 ? out.force[u(c)] : out.moment[u(c - 3)]) = value;
      (c < 3 ? out.force_std[u(c)] : out.moment_std[u(c - 3)]) = std;
      out.singular[u(c)] = column[u(c)] > config_.singular_share;
      singular = singular || out.singular[u(c)];
    }
    out.conditioning = conditioning(A);
    out.status = singular ? Status::singular : external.status;
    solved_ = true;
    return last_ = out;
  }

  void reset() { *this = WrenchEstimator(*arm_, config_); }

 private:
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }

  /// sqrt(largest/smallest eigenvalue) of a symmetric positive semidefinite matrix, by Jacobi's rotations.
  double conditioning(JointMatrix A) const noexcept {
    double trace = 0.0;
    for (int i = 0; i < dim_; ++i) trace += A(i, i);
    for (int sweep = 0; sweep < 12; ++sweep) {
      double off = 0.0;
      for (int p = 0; p < dim_; ++p)
        for (int q = p + 1; q < dim_; ++q) {
          if (std::abs(A(p, q)) <= 1e-15 * trace) continue;
          off = std::max(off, std::abs(A(p, q)));
          const double theta = (A(q, q) - A(p, p)) / (2.0 * A(p, q));
          const double t = (theta >= 0.0 ? 1.0 : -1.0) / (std::abs(theta) + std::sqrt(theta * theta + 1.0));
          const double c = 1.0 / std::sqrt(t * t + 1.0), s = t * c;
          for (int k = 0; k < dim_; ++k) {
            const double kp = A(k, p), kq = A(k, q);
            A(k, p) = c * kp - s * kq;
            A(k, q) = s * kp + c * kq;
          }
          for (int k = 0; k < dim_; ++k) {
            const double pk = A(p, k), qk = A(q, k);
            A(p, k) = c * pk - s * qk;
            A(q, k) = s * pk + c * qk;
          }
        }
      if (off <= 1e-12 * trace) break;
    }
    double least = A(0, 0), most = A(0, 0);
    for (int i = 1; i < dim_; ++i) {
      least = std::min(least, A(i, i));
      most = std::max(most, A(i, i));
    }
    return least > 1e-13 * most ? std::sqrt(most / least) : std::numeric_limits<double>::infinity();
  }

  static constexpr double least_variance = 1e-12;  // of a torque said to be exact [N^2 m^2]

  const Arm* arm_;
  WrenchConfig config_;
  int dim_;
  std::array<double, 6> prior_{};
  Wrench last_{};
  bool solved_ = false;
};

}  // namespace palpate
