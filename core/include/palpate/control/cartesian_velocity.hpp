// CartesianVelocity: the tool moves at a wanted velocity by forces that never exceed a bound; on a surface it also presses.
#pragma once
#include "palpate/control/abag.hpp"
#include "palpate/control/task_space.hpp"

namespace palpate {

/// How the force follows from the velocity (W "Two Approaches for Velocity Specification and Control").
enum class VelocityAxes : std::uint8_t {
  heading = 0,   ///< (a) one ABAG on the speed towards the goal; across the heading nothing is controlled
  per_axis = 1,  ///< (b) one ABAG for each axis of the task
};

/// What W's program did wrong, for reproducing it (MATH.md section 1, W). All false: corrected.
struct VelocityErrata {
  bool negative_gain = false;    ///< (1) the ABAG gain goes down to -1
  bool turned_twice = false;     ///< (2) a wrench goes to tool axes by R_base_tool instead of its transpose, so R R F acts
  bool axis_bound = false;       ///< (3) each axis is bounded by F_max, together sqrt(3) F_max pass
  bool unsigned_speed = false;   ///< (4) the speed along the heading is a norm: moving backwards counts as moving on
  bool stop_short = false;       ///< no speed is wanted within stop_zone: nothing brings the tool back to the goal
};

/// One set of ABAG parameters each for positions and orientations, bounds, the speed profile, and what a contact may do.
struct CartesianVelocityConfig {
  VelocityAxes axes = VelocityAxes::per_axis;
  // steady with steps of 1 to 8 ms and a velocity up to 8 ms late; a mean of 5 at 8 ms (16 ms late) makes the tool tremble
  AbagParameters abag{0.5, 0.0, 0.003, 0.5, 0.008, 0.004, 0.05, 0.3};          ///< of the velocity
  AbagParameters abag_turning{0.5, 0.0, 0.0008, 1.0, 0.008, 0.004, 0.5, 0.25};  ///< of the angular velocity; its gain does not grow
  double max_force = 5.0;           ///< F_max: ||F|| never exceeds it [N], > 0
  double max_torque = 2.0;          ///< T_max: ||T|| never exceeds it [N m], > 0
  double slow_speed = 0.02;         ///< within slow_zone of the goal [m/s], > 0
  double slow_zone = 0.1;           ///< [m], >= 0; 0: none
  double stop_zone = 0.02;          ///< for VelocityErrata::stop_short [m], >= 0
  double approach = 2.0;            ///< k: speed per distance close to the goal [1/s], > 0
  double arrived = 0.002;           ///< the goal is reached within this distance [m], > 0
  double turning = 2.0;             ///< angular velocity per orientation error [1/s], > 0
  double max_turning = 0.5;         ///< [rad/s], > 0
  double touch_speed = 0.02;        ///< towards a surface not yet felt, and at most away from it [m/s], > 0
  double force_p = 0.3;             ///< of the normal force's error [1], >= 0
  double force_i = 2.0;             ///< of its integral [1/s], >= 0
  bool decoupled = true;            ///< while pressing: what moves the tool in the plane neither presses nor tips it
  double yield_force = 12.0;        ///< a push beyond this, the expected contact taken away, makes the arm yield [N], > 0; infinity: never
  double yield_time = 0.3;          ///< after a push, until the task goes on [s], >= 0
  double free_speed = 0.4;          ///< beyond this, and beyond 1.5 times the wanted speed, the brake acts [m/s], > 0
  double free_turning = 1.0;        ///< [rad/s], > 0
  double brake = 60.0;              ///< force against the speed beyond, against any speed while yielding [N s/m], >= 0; 0: none
  double brake_turning = 0.3;       ///< torque against the turning beyond [N m s/rad], >= 0
  PostureConfig posture{};
  VelocityErrata errata{};

  /// W's program as it was: one or three ABAGs at 8 ms, 5 N, 0.05 m/s, 0.02 m/s within 0.1 m, no speed within 0.02 m.
  static CartesianVelocityConfig published(VelocityAxes axes) noexcept {
    CartesianVelocityConfig c;
    c.axes = axes;
    c.abag = c.abag_turning = AbagParameters::whiteboard();
    c.yield_force = std::numeric_limits<double>::infinity();
    c.brake = c.brake_turning = 0.0;
    c.decoupled = false;
    c.errata = {true, false, true, true, true};
    return c;
  }
};

/// Where the tool should go, how fast, and what it should press on. Frames: base; rotations row-major.
struct CartesianTarget {
  std::array<double, 3> position{};                          ///< x_des of the tool point [m]
  std::array<double, 9> orientation{1, 0, 0, 0, 1, 0, 0, 0, 1};  ///< R_base_tool wanted
  double speed = 0.05;                                       ///< v_des towards the position [m/s], >= 0
  std::array<double, 3> velocity{};                          ///< of a position that moves along a path [m/s]; zero: a goal to stop at
  std::array<double, 9> axes{1, 0, 0, 0, 1, 0, 0, 0, 1};     ///< R_base_task: axes of the ABAGs; z is the outward normal of a surface
  double normal_force = 0.0;                                 ///< press along -z of `axes` with this force [N]; 0: free motion in all axes
};

/// What was commanded and why. Base axes.
struct CartesianCommand {
  JointCommand joints{};              ///< torque of the drives; status: the worst of what follows
  std::array<double, 3> force{};      ///< F at the tool point [N], ||F|| <= F_max
  std::array<double, 3> torque{};     ///< T [N m], ||T|| <= T_max
  std::array<double, 3> brake{};      ///< force of the brake beside F [N]: against the motion, never with it
  std::array<double, 3> velocity{};   ///< of the tool point [m/s]
  std::array<double, 3> wanted{};     ///< [m/s]
  double distance = 0.0;              ///< to the position, in the plane of the surface while pressing [m]
  double contact_force = 0.0;         ///< along the normal, > 0 when the surface pushes the tool [N]; 0 if not known
  bool arrived = false;               ///< within `arrived` of the position
  bool yielding = false;              ///< somebody pushes: the task waits
};

/// W "Force Based Cartesian Velocity Control" with the errata of MATH.md section 1, and what W left undone:
///
///   h = x_des - x,   v_h = v . h/||h|| the speed towards the goal, with its sign,   v_des by the profile
///   (a)  F = F_max u(v_des - v_h) h/||h||            one ABAG
///   (b)  F = F_max sum_i u_i(v_des h_i/||h|| - v_i) e_i   one ABAG per task axis e_i; a moving goal's velocity is added
///   T = T_max L sum_i u_i(w_des,i - w_i) e_i,  w_des = k phi, bounded; phi the rotation vector of R_des R^T; L the tool's inertia
///       against turning, scaled to norm 1: light axes (the flange's own) get little
///   ||F|| <= F_max, ||T|| <= T_max, the direction kept
///   tau = J^T ((F; T) + D) + C q' + g + tau_f(q') + tau_n      (tau_n: NullSpacePosture, moves no tool)
///
/// Profile: v_des = min(speed, k d), and slow_speed within slow_zone of a goal to stop at; v_des -> 0 with d, so the tool stops at
/// the goal and comes back to it. (W wanted no speed within 0.02 m and kept pushing by a bias learnt on the way.)
///
/// Pressing (hybrid split, normal_force > 0): velocity in the plane by (b), along the normal n a force,
///   F_n = -(f_d + k_p (f_d - f) + k_i integral) - (f_d / touch_speed) (v . n),   |F_n| <= F_max,
/// f the force of the surface on the tool by the sensorless estimate. The last term lets the tool approach a surface it does not
/// feel at touch_speed and brakes it if it comes faster; nothing is integrated before the surface is felt. The plane gets what the
/// bound leaves: sqrt(F_max^2 - F_n^2). Without an estimate that may be believed nothing is pressed and nothing moves (status held).
///
/// An arm's inertia couples: a force in the plane alone lifts and tips the tool. With A = J M^-1 J^T, the tool's accelerations per wrench,
/// the normal force and the torque get beside them F_c, T_c from
///   A_nn F_c + A_nw T_c = -A_np F_p - A_nw T,   A_wn F_c + A_ww T_c = -A_wp F_p,
/// F_p the force in the plane, the surface's friction with it, so that nothing of F_p and T is left in the normal direction and nothing of F_p in turning; and
/// -J^T A^-1 J'q', bounded as F and T are, takes away what the tool accelerates by the arm's own speed (part of the Coriolis
/// compensation, not of F and T). F and T with what is added keep their bounds. All of it only while the surface is felt.
///
/// A push (external force beyond yield_force, the contact's own force taken away) makes the arm yield: ABAGs and integral are
/// cleared and F = 0 until it has been gone for yield_time. The tool keeps its orientation.
///
/// D is no part of F: a brake against what the task never does, speed beyond free_speed and 1.5 times the wanted one, and any speed
/// while yielding or not knowing what is touched. Without it a push of 30 N throws an arm that may answer with 5 N only. It takes energy
/// out and never adds any.
///
/// A state or target that is not finite gives F = T = 0: gravity alone where q is known, else the last torque that held it.
class CartesianVelocity {
 public:
  /// period [s]: one step() each. Throws std::invalid_argument.
  CartesianVelocity(const Arm& arm, double period, const CartesianVelocityConfig& config = {})
      : arm_(&arm), c_(config), h_(check::positive("CartesianVelocity period [s]", period)), posture_(arm, config.posture) {
    if (!arm.has_dynamics()) throw std::invalid_argument("CartesianVelocity: the arm has no masses; give inertials");
    check::positive("CartesianVelocityConfig max_force [N]", config.max_force);
    check::positive("CartesianVelocityConfig max_torque [N m]", config.max_torque);
    check::positive("CartesianVelocityConfig slow_speed [m/s]", config.slow_speed);
    check::not_negative("CartesianVelocityConfig slow_zone [m]", config.slow_zone);
    check::not_negative("CartesianVelocityConfig stop_zone [m]", config.stop_zone);
    check::positive("CartesianVelocityConfig approach [1/s]", config.approach);
    check::positive("CartesianVelocityConfig arrived [m]", config.arrived);
    check::positive("CartesianVelocityConfig turning [1/s]", config.turning);
    check::positive("CartesianVelocityConfig max_turning [rad/s]", config.max_turning);
    check::positive("CartesianVelocityConfig touch_speed [m/s]", config.touch_speed);
    check::not_negative("CartesianVelocityConfig force_p [1]", config.force_p);
    check::not_negative("CartesianVelocityConfig force_i [1/s]", config.force_i);
    check::positive_or_infinite("CartesianVelocityConfig yield_force [N]", config.yield_force);
    check::not_negative("CartesianVelocityConfig yield_time [s]", config.yield_time);
    check::positive("CartesianVelocityConfig free_speed [m/s]", config.free_speed);
    check::positive("CartesianVelocityConfig free_turning [rad/s]", config.free_turning);
    check::not_negative("CartesianVelocityConfig brake [N s/m]", config.brake);
    check::not_negative("CartesianVelocityConfig brake_turning [N m s/rad]", config.brake_turning);
    const AbagForm form = config.errata.negative_gain ? AbagForm::negative_gain : AbagForm::corrected;
    along_.fill(Abag(config.abag.at(period), form));
    turn_.fill(Abag(config.abag_turning.at(period), form));
  }

  /// q, dq [rad, rad/s]; external: force on the tool point in base axes, as WrenchEstimator gives it (axes base, point grasp), used
  /// only with status ok or singular; load: what is held.
  CartesianCommand step(const CartesianTarget& target, const JointVector& q, const JointVector& dq, const Wrench& external = {},
                        const Inertia<double>& load = {}, std::int64_t time_ns = 0) noexcept {
    CartesianCommand out;
    out.joints.time_ns = time_ns;
    const auto n = static_cast<std::size_t>(arm_->n());
    const bool placed = check::all_finite(q, n) && largest(q, n) < 1e6;  // beyond, sine and cosine mean nothing
    const bool moving = check::all_finite(dq, n) && largest(dq, n) < 1e6;
    if (!placed || !moving || !good(target)) {
      if (placed) holding_ = gravity_torque<double>(*arm_, q, load);
      out.joints.torque = holding_;
      out.joints.status = Status::non_finite;
      rest();
      return out;
    }
    const ToolState tool(*arm_, q, dq);
    const TaskDynamics dynamics(*arm_, tool, q, load);
    const Mat3<double> A = Arm::to_mat(target.axes);
    const Vec3<double> v = transposed(A, tool.v), h = transposed(A, Arm::to_vec(target.position) - tool.x);  // task axes
    const Vec3<double> lead = transposed(A, Arm::to_vec(target.velocity));
    const bool pressing = target.normal_force > 0.0;
    if (pressing != pressing_ || target.axes != axes_) {
      if (target.axes != axes_)
        for (Abag& a : along_) a.reset();  // a bias belongs to its axis
      pressing_ = pressing;
      axes_ = target.axes;
      integral_ = 0.0;
    }
    const bool felt = (external.status == Status::ok || external.status == Status::singular) && check::all_finite(external.force, 3);
    const Vec3<double> f = felt ? transposed(A, Arm::to_vec(external.force)) : Vec3<double>{};
    if (felt) out.contact_force = f.z;
    out.yielding = pushed(felt, f, target.normal_force);
    const bool blind = pressing && !felt, touches = f.z > 0.3 * target.normal_force;

    Vec3<double> F{}, T{}, wanted{};
    const Vec3<double> in_plane{h.x, h.y, pressing ? 0.0 : h.z};
    out.distance = std::sqrt(dot(in_plane, in_plane));
    out.arrived = out.distance <= c_.arrived;
    if (blind) rest();
    if (!blind) T = turning(target, tool, dynamics);
    if (out.yielding || blind) {
      for (Abag& a : along_) a.reset();
      integral_ = 0.0;
    } else {
      wanted = lead + wanted_velocity(in_plane, out.distance, target.speed, dot(lead, lead) == 0.0);
      if (pressing) {
        wanted.z = 0.0;
        double F_n = normal_force(target.normal_force, f.z, v.z);
        F = bounded(c_.max_force * Vec3<double>{axis(0, wanted.x - v.x), axis(1, wanted.y - v.y), 0.0}, left_in_plane(F_n));
        if (c_.decoupled && touches) decouple(dynamics, A * Vec3<double>{F.x + f.x, F.y + f.y, 0.0}, A.cz, F_n, T);
        F = bounded(F, left_in_plane(F_n));
        F.z = F_n;
        F = bounded(F, c_.max_force);
      } else if (c_.axes == VelocityAxes::heading) {
        F = along_heading(h, v, wanted, out.distance);
      } else {
        F = c_.max_force * Vec3<double>{axis(0, wanted.x - v.x), axis(1, wanted.y - v.y), axis(2, wanted.z - v.z)};
        if (!c_.errata.axis_bound) F = bounded(F, c_.max_force);
      }
    }
    const Vec3<double> F_base = c_.errata.axis_bound ? A * F : bounded(A * F, c_.max_force);
    put(out.force, F_base), put(out.torque, T), put(out.velocity, tool.v), put(out.wanted, A * wanted);
    const double free_speed = out.yielding || blind ? 0.0 : std::max(c_.free_speed, 1.5 * (target.speed + std::sqrt(dot(lead, lead))));
    const Vec3<double> D = -c_.brake * excess(tool.v, free_speed), D_turning = -c_.brake_turning * excess(tool.w, c_.free_turning);
    put(out.brake, D);

    JointVector tau = inverse_dynamics<double>(*arm_, q, dq, JointVector{}, load);
    const JointVector friction = arm_->friction_torque(dq);
    const JointVector posture = posture_.torque(tool, dynamics, q, dq);
    for (std::size_t j = 0; j < n; ++j) tau[j] += friction[j] + posture[j];
    tool.add_wrench((c_.errata.turned_twice ? tool.R * (tool.R * F_base) : F_base) + D, T + dynamics.turning(D_turning), arm_->n(), tau);
    if (pressing && c_.decoupled && touches) straighten(tool, dynamics, tau);
    if (!check::all_finite(tau, n)) {
      out.joints.torque = holding_;
      out.joints.status = Status::non_finite;
      out.force = out.torque = out.brake = {};
      rest();
      return out;
    }
    holding_ = gravity_torque<double>(*arm_, q, load);
    out.joints.torque = tau;
    out.joints.status = blind ? Status::held : Status::ok;
    return out;
  }

  /// State of the ABAG of task axis i, 0 to 2; in mode (a) number 0 is the one along the heading.
  [[nodiscard]] const Abag::State& abag(int i) const noexcept { return along_[detail::at(i)].state(); }
  [[nodiscard]] const Abag::State& abag_turning(int i) const noexcept { return turn_[detail::at(i)].state(); }

  void reset() noexcept {
    rest();
    yielding_ = false;
    pressing_ = false;
    quiet_ = 0.0;
    holding_ = {};
    axes_ = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  }

 private:
  static double largest(const JointVector& x, std::size_t n) noexcept {
    double most = 0.0;
    for (std::size_t j = 0; j < n; ++j) most = std::max(most, std::abs(x[j]));
    return most;
  }
  /// The part of a velocity beyond `free`.
  static Vec3<double> excess(const Vec3<double>& v, double free) noexcept { return free > 0.0 ? v - bounded(v, free) : v; }
  static void put(std::array<double, 3>& to, const Vec3<double>& a) noexcept { to = {a.x, a.y, a.z}; }
  static bool rotation(const std::array<double, 9>& r) noexcept {
    if (!check::all_finite(r, 9)) return false;
    const Mat3<double> R = Arm::to_mat(r);
    const double off = std::abs(dot(R.cx, R.cy)) + std::abs(dot(R.cy, R.cz)) + std::abs(dot(R.cz, R.cx)) + std::abs(dot(R.cx, R.cx) - 1.0) +
                       std::abs(dot(R.cy, R.cy) - 1.0) + std::abs(dot(cross(R.cx, R.cy), R.cz) - 1.0);
    return off < 1e-6;
  }
  static bool good(const CartesianTarget& t) noexcept {
    return check::all_finite(t.position, 3) && check::all_finite(t.velocity, 3) && rotation(t.orientation) && rotation(t.axes) &&
           std::isfinite(t.speed) && t.speed >= 0.0 && std::isfinite(t.normal_force) && t.normal_force >= 0.0;
  }

  /// Nothing learnt on the way pushes on.
  void rest() noexcept {
    for (Abag& a : along_) a.reset();
    for (Abag& a : turn_) a.reset();
    integral_ = 0.0;
  }

  [[nodiscard]] double axis(std::size_t i, double error) noexcept { return along_[i].step(error); }

  [[nodiscard]] Vec3<double> wanted_velocity(const Vec3<double>& h, double distance, double speed, bool stops) const noexcept {
    if (distance == 0.0) return {};
    double v = speed;
    if (stops && distance < c_.slow_zone) v = std::min(v, c_.slow_speed);
    if (c_.errata.stop_short) v = distance < c_.stop_zone ? 0.0 : v;
    else v = std::min(v, c_.approach * distance);
    return (v / distance) * h;
  }

  [[nodiscard]] Vec3<double> along_heading(const Vec3<double>& h, const Vec3<double>& v, const Vec3<double>& wanted, double distance) noexcept {
    if (distance == 0.0) return {};
    const Vec3<double> unit = (1.0 / distance) * h;
    const double speed = dot(v, unit);
    return (c_.max_force * axis(0, dot(wanted, unit) - (c_.errata.unsigned_speed ? std::abs(speed) : speed))) * unit;
  }

  [[nodiscard]] Vec3<double> turning(const CartesianTarget& target, const ToolState& tool, const TaskDynamics& dynamics) noexcept {
    const Vec3<double> phi = rotation_vector(Arm::to_mat(target.orientation) * transpose(tool.R));
    const Vec3<double> e = bounded(c_.turning * phi, c_.max_turning) - tool.w;
    const Vec3<double> u{turn_[0].step(e.x), turn_[1].step(e.y), turn_[2].step(e.z)};
    return bounded(dynamics.turning(c_.max_torque * u), c_.max_torque);
  }

  /// Along the outward normal: < 0 presses.
  [[nodiscard]] double normal_force(double wanted, double f, double v) noexcept {
    const double error = wanted - f;
    if (f > 0.3 * wanted) integral_ = std::clamp(integral_ + c_.force_i * h_ * error, -0.5 * wanted, 0.5 * wanted);
    const double feedback = f > 0.3 * wanted ? c_.force_p * error : 0.0;
    return std::clamp(-(wanted + feedback + integral_) - wanted / c_.touch_speed * v, -c_.max_force, c_.max_force);
  }

  [[nodiscard]] double left_in_plane(double F_n) const noexcept { return std::sqrt(std::max(0.0, c_.max_force * c_.max_force - F_n * F_n)); }

  /// Adds F_c to F_n along n and T_c to T, see above; F_p in base axes. Both stay as they were where the arm cannot move every way.
  void decouple(const TaskDynamics& dynamics, const Vec3<double>& F_p, const Vec3<double>& n, double& F_n, Vec3<double>& T) const noexcept {
    const std::array<double, 6> normal{n.x, n.y, n.z, 0, 0, 0}, plane{F_p.x, F_p.y, F_p.z, 0, 0, 0}, turn{0, 0, 0, T.x, T.y, T.z};
    std::array<double, 6> by_normal{}, by_plane{}, by_turn{};
    for (int r = 0; r < 6; ++r)
      for (int c = 0; c < 6; ++c) {
        const auto u = detail::at(r), k = detail::at(c);
        by_normal[u] += dynamics.A(r, c) * normal[k], by_plane[u] += dynamics.A(r, c) * plane[k], by_turn[u] += dynamics.A(r, c) * turn[k];
      }
    const auto along = [&normal](const std::array<double, 6>& a) { return a[0] * normal[0] + a[1] * normal[1] + a[2] * normal[2]; };
    JointMatrix M{};
    JointVector b{};
    M(0, 0) = along(by_normal);
    b[0] = -along(by_plane) - along(by_turn);
    for (int r = 0; r < 3; ++r) {
      M(0, r + 1) = M(r + 1, 0) = by_normal[detail::at(r + 3)];
      for (int c = 0; c < 3; ++c) M(r + 1, c + 1) = dynamics.A(r + 3, c + 3);
      b[detail::at(r + 1)] = -by_plane[detail::at(r + 3)];
    }
    const Cholesky<double> factor(M, 4);
    if (!dynamics.good || !factor.positive()) return;
    const JointVector x = factor.solve(b);
    if (!check::all_finite(x, 4)) return;
    F_n = std::clamp(F_n + x[0], -c_.max_force, c_.max_force);
    T = bounded(T + Vec3<double>{x[1], x[2], x[3]}, c_.max_torque);
  }

  /// tau -= J^T A^-1 J'q'.
  void straighten(const ToolState& tool, const TaskDynamics& dynamics, JointVector& tau) const noexcept {
    const Cholesky<double> factor(dynamics.A, 6);
    if (!dynamics.good || !factor.positive()) return;
    const JointVector x = factor.solve({tool.dv.x, tool.dv.y, tool.dv.z, tool.dw.x, tool.dw.y, tool.dw.z});
    tool.add_wrench(bounded({-x[0], -x[1], -x[2]}, c_.max_force), bounded({-x[3], -x[4], -x[5]}, c_.max_torque), arm_->n(), tau);
  }

  /// Somebody pushes, or did a moment ago. f in task axes.
  [[nodiscard]] bool pushed(bool felt, Vec3<double> f, double normal) noexcept {
    if (normal > 0.0) f.z -= std::clamp(f.z, 0.0, 2.0 * normal);  // what the surface does by itself
    const double push = felt ? std::sqrt(dot(f, f)) : 0.0;
    if (push > c_.yield_force) {
      yielding_ = true;
      quiet_ = 0.0;
    } else if (yielding_) {
      quiet_ = push > 0.5 * c_.yield_force ? 0.0 : quiet_ + h_;
      yielding_ = quiet_ <= c_.yield_time;
    }
    return yielding_;
  }

  const Arm* arm_;
  CartesianVelocityConfig c_;
  double h_;
  NullSpacePosture posture_;
  std::array<Abag, 3> along_{}, turn_{};
  double integral_ = 0.0;  // of the normal force's error [N]
  double quiet_ = 0.0;     // since the last push [s]
  bool yielding_ = false, pressing_ = false;
  std::array<double, 9> axes_{1, 0, 0, 0, 1, 0, 0, 0, 1};
  JointVector holding_{};  // gravity at the last known position [N m]
};

}  // namespace palpate
