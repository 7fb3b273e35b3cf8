// What the Cartesian controllers share: the tool's pose and Jacobian, bounds of a wrench, the posture of a redundant arm.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <numbers>

#include "palpate/chain.hpp"
#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// The vector shortened to length `bound` if it is longer, its direction kept; 0 if it holds a number that is not finite.
inline Vec3<double> bounded(const Vec3<double>& a, double bound) noexcept {
  const double most = std::max({std::abs(a.x), std::abs(a.y), std::abs(a.z)});
  if (!std::isfinite(most)) return {};
  if (most == 0.0) return a;
  const Vec3<double> unit = (1.0 / most) * a;  // its square cannot overflow
  const double length = std::sqrt(dot(unit, unit));
  if (most <= (1.0 - 1e-14) * bound / length) return a;
  Vec3<double> out = (bound / length) * unit;
  while (dot(out, out) > bound * bound) out = (1.0 - 1e-15) * out;  // rounding must not lift it above the bound
  return out;
}

/// Rotation vector phi of a rotation, R = exp([phi]x): axis times angle, 0 <= angle <= pi [rad].
inline Vec3<double> rotation_vector(const Mat3<double>& R) noexcept {
  // unit quaternion by the largest of its four squares: exact at every angle
  const double t = R.cx.x + R.cy.y + R.cz.z;
  double w, x, y, z;
  if (t >= R.cx.x && t >= R.cy.y && t >= R.cz.z) {
    w = 1.0 + t, x = R.cy.z - R.cz.y, y = R.cz.x - R.cx.z, z = R.cx.y - R.cy.x;
  } else if (R.cx.x >= R.cy.y && R.cx.x >= R.cz.z) {
    w = R.cy.z - R.cz.y, x = 1.0 + 2.0 * R.cx.x - t, y = R.cx.y + R.cy.x, z = R.cz.x + R.cx.z;
  } else if (R.cy.y >= R.cz.z) {
    w = R.cz.x - R.cx.z, x = R.cx.y + R.cy.x, y = 1.0 + 2.0 * R.cy.y - t, z = R.cy.z + R.cz.y;
  } else {
    w = R.cx.y - R.cy.x, x = R.cz.x + R.cx.z, y = R.cy.z + R.cz.y, z = 1.0 + 2.0 * R.cz.z - t;
  }
  const double s = std::sqrt(x * x + y * y + z * z);
  if (s == 0.0) return {};
  const double angle = 2.0 * std::atan2(s, std::abs(w));
  return (std::copysign(angle, w) / s) * Vec3<double>{x, y, z};
}

/// Pose, velocity and Jacobian of the tool: the arm's grasp point with the axes of its tip frame, in base axes.
struct ToolState {
  Pose<double> chain;
  Vec3<double> x;             ///< [m]
  Mat3<double> R;             ///< R_base_tip
  Vec3<double> v, w;          ///< velocity [m/s], angular velocity [rad/s]
  Vec3<double> dv, dw;        ///< J' q': what the tool accelerates while no joint does [m/s^2, rad/s^2]
  Joints<Vec3<double>> Jv, Jw;  ///< columns of the Jacobian [m, 1]

  ToolState(const Arm& arm, const JointVector& q, const JointVector& dq) noexcept
      : chain(forward_kinematics<double>(arm, q)), x(chain.p + chain.R * arm.p_last_grasp()), R(chain.R * arm.R_last_tip()), v{}, w{}, dv{}, dw{}, Jv{}, Jw{} {
    for (int j = 0; j < arm.n(); ++j) {
      const auto u = detail::at(j);
      Jv[u] = jacobian_column(arm, chain, j, x);
      Jw[u] = arm.body(j).prismatic ? Vec3<double>{} : chain.axis[u];
      // dJ_v,j/dq_k = J_w,min(j,k) x J_v,max(j,k),  dJ_w,j/dq_k = J_w,k x J_w,j for k < j
      const Vec3<double> step = dq[u] * Jv[u], turn = dq[u] * Jw[u];
      dv = dv + cross(2.0 * w + turn, step);
      dw = dw + cross(w, turn);
      v = v + step;
      w = w + turn;
    }
  }

  /// tau += J^T (F; T).
  void add_wrench(const Vec3<double>& F, const Vec3<double>& T, int n, JointVector& tau) const noexcept {
    for (int j = 0; j < n; ++j) tau[detail::at(j)] += dot(Jv[detail::at(j)], F) + dot(Jw[detail::at(j)], T);
  }
};

/// What moves how under a wrench at the tool: M^-1 J^T by joint, and A = J M^-1 J^T, the inverse of the task-space inertia.
struct TaskDynamics {
  static constexpr int stride = 6;
  std::array<double, static_cast<std::size_t>(max_joints * stride)> Jt{}, X{};  ///< rows of J^T and of M^-1 J^T, one per joint
  JointMatrix A{};  ///< 6 x 6, force before moment [1/kg, 1/(kg m), 1/(kg m^2)]
  bool good;        ///< M was positive definite

  TaskDynamics(const Arm& arm, const ToolState& tool, const JointVector& q, const Inertia<double>& load) noexcept {
    const int n = arm.n();
    for (int j = 0; j < n; ++j) {
      const Vec3<double>&v = tool.Jv[detail::at(j)], &w = tool.Jw[detail::at(j)];
      double* row = Jt.data() + j * stride;
      row[0] = v.x, row[1] = v.y, row[2] = v.z, row[3] = w.x, row[4] = w.y, row[5] = w.z;
    }
    X = Jt;
    const Cholesky<double> M(mass_matrix<double>(arm, q, load), n);
    good = M.positive();
    M.solve_rows(X.data(), stride, stride);
    for (int j = 0; j < n; ++j)
      for (int r = 0; r < 6; ++r)
        for (int c = r; c < 6; ++c) A(r, c) += Jt[detail::at(j * stride + r)] * X[detail::at(j * stride + c)];
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < r; ++c) A(r, c) = A(c, r);
  }

  /// (J_w M^-1 J_w^T)^-1 a, divided by the Frobenius norm of that matrix: a torque that turns the tool about `a` and not across it,
  /// no longer than `a`. `a` itself where the arm cannot turn the tool about every axis.
  [[nodiscard]] Vec3<double> turning(const Vec3<double>& a) const noexcept {
    JointMatrix W{};
    for (int r = 0; r < 3; ++r)
      for (int c = 0; c < 3; ++c) W(r, c) = A(r + 3, c + 3);
    const Cholesky<double> factor(W, 3);
    if (!good || !factor.positive()) return a;
    double squares = 0.0;
    for (std::size_t c = 0; c < 3; ++c) {
      JointVector unit{};
      unit[c] = 1.0;
      const JointVector x = factor.solve(unit);
      squares += x[0] * x[0] + x[1] * x[1] + x[2] * x[2];
    }
    const JointVector x = factor.solve({a.x, a.y, a.z});
    const double s = 1.0 / std::sqrt(squares);
    const Vec3<double> out{s * x[0], s * x[1], s * x[2]};
    return std::isfinite(dot(out, out)) ? out : a;
  }
};

struct PostureConfig {
  double stiffness = 2.0;      ///< k_n: torque per gradient of the posture's worth [N m], >= 0; 0: only damping
  double damping = 0.5;        ///< d_n: of motion that does not move the tool [N m s/rad], >= 0
  double limits = 0.2;         ///< worth of the distance to position limits against that to singularities [1], >= 0
  double largest = 5.0;        ///< no joint gets more than this before the projection [N m], > 0
};

/// Torque that improves the posture of a redundant arm and does not move its tool:
///
///   tau_n = N^T (k_n grad H - d_n q'),   N^T = 1 - J^T (J M^-1 J^T)^-1 J M^-1    (dynamically consistent: J M^-1 tau_n = 0)
///   H(q) = 1/2 log det(J J^T) - w_l sum_j x_j^2/(1 - x_j^2),   x_j = (q_j - middle)/(half the range)
///
/// The first term is the logarithm of Yoshikawa's manipulability, the second is large only near a limit. Its gradient is exact:
/// dH/dq_k = sum_j (dJ_j/dq_k) . (J J^T)^-1 J_j. An arm without spare joints (n <= 6) gets zero, and so does a singular pose.
class NullSpacePosture {
 public:
  NullSpacePosture(const Arm& arm, const PostureConfig& config = {}) : arm_(&arm), c_(config) {
    check::not_negative("PostureConfig stiffness [N m]", config.stiffness);
    check::not_negative("PostureConfig damping [N m s/rad]", config.damping);
    check::not_negative("PostureConfig limits [1]", config.limits);
    check::positive("PostureConfig largest [N m]", config.largest);
  }

  /// grad H [1/rad]; zero in a singular pose.
  [[nodiscard]] JointVector gradient(const ToolState& tool, const JointVector& q) const noexcept {
    const int n = arm_->n();
    JointMatrix A{};
    for (int j = 0; j < n; ++j) {
      const std::array<double, 6> J = column(tool, j);
      for (int r = 0; r < 6; ++r)
        for (int c = 0; c < 6; ++c) A(r, c) += J[detail::at(r)] * J[detail::at(c)];
    }
    const Cholesky<double> factor(A, 6);
    JointVector out{};
    if (!factor.positive()) return out;
    for (int j = 0; j < n; ++j) {
      JointVector J{};
      const std::array<double, 6> own = column(tool, j);
      std::copy(own.begin(), own.end(), J.begin());
      const JointVector X = factor.solve(J);
      const Vec3<double> Xv{X[0], X[1], X[2]}, Xw{X[3], X[4], X[5]};
      const bool turns = !arm_->body(j).prismatic;
      for (int k = 0; k < n; ++k) {
        const auto uk = detail::at(k), uj = detail::at(j);
        if (k < j) out[uk] += dot(Xv, cross(tool.Jw[uk], tool.Jv[uj])) + dot(Xw, cross(tool.Jw[uk], tool.Jw[uj]));
        else if (turns) out[uk] += dot(Xv, cross(tool.Jw[uj], tool.Jv[uk]));
      }
    }
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      const double half = 0.5 * (arm_->joint(j).upper - arm_->joint(j).lower);
      if (!std::isfinite(half) || half <= 0.0) continue;
      const double x = std::clamp((q[u] - arm_->joint(j).lower) / half - 1.0, -0.98, 0.98), rest = 1.0 - x * x;
      out[u] -= c_.limits * 2.0 * x / (rest * rest) / half;
    }
    return out;
  }

  /// tau_n [N m].
  [[nodiscard]] JointVector torque(const ToolState& tool, const TaskDynamics& dynamics, const JointVector& q, const JointVector& dq) const noexcept {
    const int n = arm_->n();
    if (n <= 6 || !dynamics.good) return {};
    const Cholesky<double> inertia(dynamics.A, 6);
    if (!inertia.positive()) return {};
    const JointVector slope = gradient(tool, q);
    JointVector tau{}, b{};
    for (int j = 0; j < n; ++j) {
      const auto u = detail::at(j);
      tau[u] = std::clamp(c_.stiffness * slope[u] - c_.damping * dq[u], -c_.largest, c_.largest);
      for (int r = 0; r < 6; ++r) b[detail::at(r)] += dynamics.X[detail::at(j * TaskDynamics::stride + r)] * tau[u];
    }
    const JointVector f = inertia.solve(b);
    tool.add_wrench({-f[0], -f[1], -f[2]}, {-f[3], -f[4], -f[5]}, n, tau);
    return check::all_finite(tau, detail::at(n)) ? tau : JointVector{};
  }

 private:
  static std::array<double, 6> column(const ToolState& t, int j) noexcept {
    const Vec3<double>&v = t.Jv[detail::at(j)], &w = t.Jw[detail::at(j)];
    return {v.x, v.y, v.z, w.x, w.y, w.z};
  }

  const Arm* arm_;
  PostureConfig c_;
};

}  // namespace palpate
