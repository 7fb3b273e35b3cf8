// Arm: everything known about a robot arm. Built once from plain figures, checked, then immutable.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>

#include "palpate/friction.hpp"
#include "palpate/spatial.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// Placement of one frame in another: x_outer = R x_inner + p.
struct Placement {
  std::array<double, 9> R{1, 0, 0, 0, 1, 0, 0, 0, 1};  ///< rotation, row-major
  std::array<double, 3> p{0, 0, 0};                    ///< origin [m]
};

/// One joint, the link it moves, and its drive, as written in a URDF or a card.
struct JointDescription {
  bool prismatic = false;                      ///< else revolute
  Placement T_parent_joint{};                  ///< joint frame at q = 0 in the previous link's frame (base for the first)
  std::array<double, 3> axis{0, 0, 1};         ///< unit axis in the joint frame
  double mass = 0.0;                           ///< of the link [kg]
  std::array<double, 3> com{};                 ///< centre of mass in the link frame [m]
  std::array<double, 6> inertia{};             ///< xx xy xz yy yz zz about the CoM, link axes [kg m^2]
  double rotor_inertia = 0.0;                  ///< I_a seen at the link [kg m^2]
  Friction friction{};
  double lower = -std::numeric_limits<double>::infinity();    ///< [rad]
  double upper = std::numeric_limits<double>::infinity();     ///< [rad]
  double max_velocity = std::numeric_limits<double>::infinity();  ///< [rad/s]
  double max_effort = std::numeric_limits<double>::infinity();    ///< [N m]
  double position_resolution = 0.0;            ///< of the encoder [rad]
  double position_std = 0.0;                   ///< noise beside the rounding [rad]
  double velocity_std = std::numeric_limits<double>::quiet_NaN();  ///< [rad/s]; NaN: velocity is not measured
  double torque_resolution = 0.0;              ///< [N m]
  double torque_std = 0.0;                     ///< noise of the torque figure [N m]
  double torque_gain_std = 0.0;                ///< relative error of the drive gain, one value for all time [1]
  double effort_gain = 1.0;                    ///< link-side N m per unit of the driver's effort
};

/// Plain figures of an arm; generated headers (palpate's Arm.to_header) are constexpr objects of this type.
struct ArmDescription {
  int n = 0;                                   ///< number of joints, 1..16
  std::array<JointDescription, max_joints> joints{};
  std::array<double, 3> gravity{0, 0, -9.81};  ///< acceleration of free fall in the base frame [m/s^2]
  Placement T_last_tip{};                      ///< tip frame in the last link
  std::array<double, 3> grasp{};               ///< grasp point in the tip frame [m]
};

/// One moving body in the frame the recursions use: the joint frame turned so that its z is the joint axis.
struct Body {
  Mat3<double> R{identity3};      ///< orientation at q = 0 in the previous body's frame
  Vec3<double> p{};               ///< origin at q = 0 in the previous body's frame [m]
  Mat3<double> R_body_link{identity3};  ///< link axes in body axes
  Inertia<double> inertia{};      ///< about the body origin, body axes
  double rotor_inertia = 0.0;     ///< [kg m^2]
  bool prismatic = false;
};

class Arm {
 public:
  /// Throws std::invalid_argument naming the joint (counted from 1) and what is wrong with it.
  explicit Arm(const ArmDescription& description) : d_(description) {
    if (d_.n < 1 || d_.n > max_joints)
      throw std::invalid_argument("arm: " + std::to_string(d_.n) + " joints; expected 1 to " + std::to_string(max_joints));
    for (double g : d_.gravity)
      if (!std::isfinite(g)) throw std::invalid_argument("arm: gravity must be finite");
    check_placement(d_.T_last_tip, "arm: tip frame");
    for (double g : d_.grasp)
      if (!std::isfinite(g)) throw std::invalid_argument("arm: grasp point must be finite");
    for (int j = 0; j < d_.n; ++j) has_dynamics_ = has_dynamics_ || joint(j).mass != 0.0;
    Mat3<double> previous = identity3;  // body axes of the previous body in its link axes
    for (int j = 0; j < d_.n; ++j) previous = add_body(j, previous);
    const Mat3<double> R_tip = to_mat(d_.T_last_tip.R);
    R_last_tip_ = transpose(previous) * R_tip;
    p_last_tip_ = transposed(previous, to_vec(d_.T_last_tip.p));
    p_last_grasp_ = p_last_tip_ + R_last_tip_ * to_vec(d_.grasp);
  }

  int n() const noexcept { return d_.n; }
  const ArmDescription& description() const noexcept { return d_; }
  const JointDescription& joint(int j) const noexcept { return d_.joints[static_cast<std::size_t>(j)]; }
  const Body& body(int j) const noexcept { return bodies_[static_cast<std::size_t>(j)]; }
  Vec3<double> gravity() const noexcept { return to_vec(d_.gravity); }
  /// Tip frame and grasp point in the last body's axes.
  const Mat3<double>& R_last_tip() const noexcept { return R_last_tip_; }
  const Vec3<double>& p_last_tip() const noexcept { return p_last_tip_; }
  const Vec3<double>& p_last_grasp() const noexcept { return p_last_grasp_; }
  /// False for an arm given by its kinematics alone (all masses zero): no dynamics can be computed.
  bool has_dynamics() const noexcept { return has_dynamics_; }
  /// The same arm with every link's mass and inertia times its factor (> 0); geometry and centres of mass stay.
  Arm scaled(const JointVector& factor) const noexcept {
    Arm out = *this;
    for (int j = 0; j < n(); ++j) {
      const auto u = static_cast<std::size_t>(j);
      out.d_.joints[u].mass *= factor[u];
      for (double& x : out.d_.joints[u].inertia) x *= factor[u];
      out.bodies_[u].inertia = factor[u] * out.bodies_[u].inertia;
    }
    return out;
  }
  /// tau_f(q') of all joints [N m].
  JointVector friction_torque(const JointVector& dq) const noexcept {
    JointVector tau{};
    for (int j = 0; j < n(); ++j) {
      const auto u = static_cast<std::size_t>(j);
      tau[u] = joint(j).friction.torque(dq[u]);
    }
    return tau;
  }
  /// Variance of one position reading: noise plus rounding (uniform in +- half a count) [rad^2].
  double position_variance(int j) const noexcept { return square(joint(j).position_std) + square(joint(j).position_resolution) / 12.0; }
  /// Variance of one torque figure [N^2 m^2].
  double torque_variance(int j) const noexcept { return square(joint(j).torque_std) + square(joint(j).torque_resolution) / 12.0; }

  static constexpr Vec3<double> to_vec(const std::array<double, 3>& a) noexcept { return {a[0], a[1], a[2]}; }
  static constexpr Mat3<double> to_mat(const std::array<double, 9>& r) noexcept {
    return {{r[0], r[3], r[6]}, {r[1], r[4], r[7]}, {r[2], r[5], r[8]}};
  }

 private:
  static constexpr double square(double x) noexcept { return x * x; }

  [[noreturn]] static void fail(int j, const std::string& what) {
    throw std::invalid_argument("joint " + std::to_string(j + 1) + ": " + what);
  }
  static void check_placement(const Placement& T, const std::string& where) {
    for (double x : T.p)
      if (!std::isfinite(x)) throw std::invalid_argument(where + ": position must be finite");
    const Mat3<double> R = to_mat(T.R);
    const double off = std::abs(dot(R.cx, R.cy)) + std::abs(dot(R.cy, R.cz)) + std::abs(dot(R.cz, R.cx)) +
                       std::abs(dot(R.cx, R.cx) - 1) + std::abs(dot(R.cy, R.cy) - 1) + std::abs(dot(R.cz, R.cz) - 1) +
                       std::abs(dot(cross(R.cx, R.cy), R.cz) - 1);
    if (!(off < 1e-9)) throw std::invalid_argument(where + ": orientation is not a rotation matrix");
  }

  /// Principal moments decide whether a tensor belongs to a real body: all positive, none above the sum of the others.
  static void check_inertia(int j, const JointDescription& d) {
    if (!(d.mass > 0.0) || !std::isfinite(d.mass)) fail(j, "mass " + std::to_string(d.mass) + " kg; expected a positive number");
    for (double x : d.com)
      if (!std::isfinite(x)) fail(j, "centre of mass must be finite");
    for (double x : d.inertia)
      if (!std::isfinite(x)) fail(j, "inertia must be finite");
    const auto [xx, xy, xz, yy, yz, zz] = d.inertia;
    // Real eigenvalues of a symmetric 3x3 matrix (Smith 1961).
    const double m = (xx + yy + zz) / 3.0;
    const double a = xx - m, b = yy - m, c = zz - m;
    const double p = std::sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0);
    double lo = m, hi = m;
    if (p > 1e-12 * std::abs(m)) {  // else p^3 may underflow; the moments are equal then
      const double det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
      const double phi = std::acos(std::clamp(det / (2.0 * p * p * p), -1.0, 1.0)) / 3.0;
      hi = m + 2.0 * p * std::cos(phi);
      lo = m + 2.0 * p * std::cos(phi + 2.0943951023931953);
    }
    const double tolerance = 1e-9 * std::abs(hi);
    if (!(lo >= -tolerance) || !(hi >= 0.0))
      fail(j, "inertia about the centre of mass is not positive definite (smallest principal moment " + std::to_string(lo) + " kg m^2)");
    if (hi > (3.0 * m - hi) + 1e-6 * hi + tolerance)
      fail(j, "inertia breaks the triangle inequality: the largest principal moment " + std::to_string(hi) +
                  " kg m^2 is more than the sum " + std::to_string(3.0 * m - hi) + " of the others; no body has that");
  }

  /// Rotation whose columns are body axes in link axes: z along the joint axis, the identity if it is already.
  static Mat3<double> body_axes(const Vec3<double>& z) noexcept {
    if (z.x == 0.0 && z.y == 0.0 && z.z > 0.0) return identity3;
    const double ax = std::abs(z.x), ay = std::abs(z.y), az = std::abs(z.z);
    const Vec3<double> e = (ax <= ay && ax <= az) ? Vec3<double>{1, 0, 0} : (ay <= az ? Vec3<double>{0, 1, 0} : Vec3<double>{0, 0, 1});
    Vec3<double> x = cross(e, z);
    x = (1.0 / std::sqrt(dot(x, x))) * x;
    return {x, cross(z, x), z};
  }

  Mat3<double> add_body(int j, const Mat3<double>& previous) {
    JointDescription& d = d_.joints[static_cast<std::size_t>(j)];
    check_placement(d.T_parent_joint, "joint " + std::to_string(j + 1));
    Vec3<double> z = to_vec(d.axis);
    const double length = std::sqrt(dot(z, z));
    if (!(std::abs(length - 1.0) < 1e-6)) fail(j, "axis has length " + std::to_string(length) + "; expected a unit vector");
    z = (1.0 / length) * z;
    if (has_dynamics_) check_inertia(j, d);
    if (!(d.rotor_inertia >= 0.0)) fail(j, "rotor inertia must not be negative");
    if (!(d.lower <= d.upper)) fail(j, "lower position limit is above the upper one");
    if (!(d.max_velocity > 0.0) || !(d.max_effort > 0.0)) fail(j, "velocity and effort limits must be positive (infinity for none)");
    for (double x : {d.position_resolution, d.position_std, d.torque_resolution, d.torque_std, d.torque_gain_std})
      if (!(x >= 0.0) || !std::isfinite(x)) fail(j, "resolutions and standard deviations must be finite and not negative");
    if (!std::isfinite(d.effort_gain) || d.effort_gain == 0.0) fail(j, "effort gain must be finite and not zero");
    const std::string friction = d.friction.problem();
    if (!friction.empty()) fail(j, friction);

    const Mat3<double> A = body_axes(z);
    Body& b = bodies_[static_cast<std::size_t>(j)];
    b.R = transpose(previous) * to_mat(d.T_parent_joint.R) * A;
    b.p = transposed(previous, to_vec(d.T_parent_joint.p));
    b.R_body_link = transpose(A);
    const auto [xx, xy, xz, yy, yz, zz] = d.inertia;
    b.inertia = moved(b.R_body_link, Vec3<double>{}, about_origin(d.mass, to_vec(d.com), Sym3<double>{xx, xy, xz, yy, yz, zz}));
    b.rotor_inertia = d.rotor_inertia;
    b.prismatic = d.prismatic;
    return A;
  }

  ArmDescription d_;
  std::array<Body, max_joints> bodies_{};
  Mat3<double> R_last_tip_{identity3};
  Vec3<double> p_last_tip_{}, p_last_grasp_{};
  bool has_dynamics_ = false;
};

/// FrictionHistory of every joint: takes out of a sample's torque what friction is beyond a function of the velocity, so that
/// no observer need remember anything.
class FrictionMemory {
 public:
  void step(const Arm& arm, JointSample& s) noexcept {
    if (s.status == Status::non_finite || s.status == Status::time_error) return;
    for (int j = 0; j < arm.n(); ++j) {
      const auto u = static_cast<std::size_t>(j);
      const JointDescription& d = arm.joint(j);
      if (s.dt > 0.0 && started_) ddq_[u] += -std::expm1(-s.dt / rotor_time) * ((s.dq[u] - dq_[u]) / s.dt - ddq_[u]);
      dq_[u] = s.dq[u];
      const double gear = s.tau[u] - d.rotor_inertia * ddq_[u];
      const double excess = joints_[u].step(d.friction, s.q[u], std::sqrt(arm.position_variance(j)), s.dq[u], gear);
      s.friction_excess[u] = excess;
      s.tau[u] -= excess;
    }
    started_ = s.status == Status::ok;
  }

 private:
  static constexpr double rotor_time = 0.02;  // time constant of the acceleration that the rotors take [s]

  std::array<FrictionHistory, max_joints> joints_{};
  JointVector dq_{}, ddq_{};
  bool started_ = false;
};

}  // namespace palpate
