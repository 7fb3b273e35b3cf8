// CartesianImpedance: the spring that W decided against, for comparison.
#pragma once
#include "palpate/control/task_space.hpp"

namespace palpate {

struct CartesianImpedanceConfig {
  std::array<double, 3> stiffness{500, 500, 500};       ///< k_c along base axes [N/m], >= 0
  std::array<double, 3> turning_stiffness{30, 30, 30};  ///< about base axes [N m/rad], >= 0; less where the tool turns lightly
  double damping_ratio = 0.7;                           ///< d_c [1], >= 0: D = 2 d_c sqrt(k_c m)
  double mass = 5.0;                                    ///< m that the damping is made for [kg], > 0
  double inertia = 0.1;                                 ///< and for turning [kg m^2], > 0
  PostureConfig posture{};
};

/// tau = J^T [k_c (x_ref - x) + F] + D(d_c) + f_dyn(q, q', q'')      (W; MATH.md section 8)
///
/// Turning about a light axis gets spring and damper in proportion to its inertia (TaskDynamics::turning), or the flange's own axis rattles.
/// x_ref, R_ref the pose of the virtual spring's other end; F [N] a force beside it; D = -2 d_c J^T sqrt(k_c m) v; f_dyn = C q' + g +
/// tau_f(q') + tau_n of this arm with its load, q'' = 0. The force grows with the distance and has no bound: that is what CartesianVelocity
/// does better. A state that is not finite gives the gravity torque last known, status non_finite.
class CartesianImpedance {
 public:
  CartesianImpedance(const Arm& arm, const CartesianImpedanceConfig& config = {}) : arm_(&arm), c_(config), posture_(arm, config.posture) {
    if (!arm.has_dynamics()) throw std::invalid_argument("CartesianImpedance: the arm has no masses; give inertials");
    for (std::size_t i = 0; i < 3; ++i) {
      check::not_negative(check::entry("CartesianImpedanceConfig stiffness", i, "N/m"), config.stiffness[i]);
      check::not_negative(check::entry("CartesianImpedanceConfig turning_stiffness", i, "N m/rad"), config.turning_stiffness[i]);
    }
    check::not_negative("CartesianImpedanceConfig damping_ratio [1]", config.damping_ratio);
    check::positive("CartesianImpedanceConfig mass [kg]", config.mass);
    check::positive("CartesianImpedanceConfig inertia [kg m^2]", config.inertia);
  }

  /// What was commanded: joint torque [N m], and the force [N] and torque [N m] of spring and damper in base axes.
  struct Command {
    JointCommand joints{};
    std::array<double, 3> force{}, torque{};
  };

  /// position [m], orientation (row-major R_base_tool) of the spring's other end; force [N], base axes.
  Command step(const std::array<double, 3>& position, const std::array<double, 9>& orientation, const std::array<double, 3>& force,
               const JointVector& q, const JointVector& dq, const Inertia<double>& load = {}, std::int64_t time_ns = 0) noexcept {
    Command out;
    out.joints.time_ns = time_ns;
    const auto n = static_cast<std::size_t>(arm_->n());
    const bool placed = check::all_finite(q, n);
    if (placed) holding_ = gravity_torque<double>(*arm_, q, load);
    out.joints.torque = holding_;
    out.joints.status = Status::non_finite;
    if (!placed || !check::all_finite(dq, n) || !check::all_finite(position, 3) || !check::all_finite(orientation, 9) || !check::all_finite(force, 3)) return out;

    const ToolState tool(*arm_, q, dq);
    const Vec3<double> d = Arm::to_vec(position) - tool.x, phi = rotation_vector(Arm::to_mat(orientation) * transpose(tool.R));
    const std::array<double, 3> x{d.x, d.y, d.z}, v{tool.v.x, tool.v.y, tool.v.z}, r{phi.x, phi.y, phi.z}, w{tool.w.x, tool.w.y, tool.w.z};
    std::array<double, 3> T{};
    for (std::size_t i = 0; i < 3; ++i) {
      const double k = c_.stiffness[i], kr = c_.turning_stiffness[i];
      out.force[i] = k * x[i] + force[i] - 2.0 * c_.damping_ratio * std::sqrt(k * c_.mass) * v[i];
      T[i] = kr * r[i] - 2.0 * c_.damping_ratio * std::sqrt(kr * c_.inertia) * w[i];
    }
    const TaskDynamics dynamics(*arm_, tool, q, load);
    const Vec3<double> turning = dynamics.turning(Arm::to_vec(T));
    out.torque = {turning.x, turning.y, turning.z};
    JointVector tau = inverse_dynamics<double>(*arm_, q, dq, JointVector{}, load);
    const JointVector friction = arm_->friction_torque(dq), posture = posture_.torque(tool, dynamics, q, dq);
    for (std::size_t j = 0; j < n; ++j) tau[j] += friction[j] + posture[j];
    tool.add_wrench(Arm::to_vec(out.force), turning, arm_->n(), tau);
    if (!check::all_finite(tau, n)) return out;
    out.joints.torque = tau;
    out.joints.status = Status::ok;
    return out;
  }

  void reset() noexcept { holding_ = {}; }

 private:
  const Arm* arm_;
  CartesianImpedanceConfig c_;
  NullSpacePosture posture_;
  JointVector holding_{};
};

}  // namespace palpate
