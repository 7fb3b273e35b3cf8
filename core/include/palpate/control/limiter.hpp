// SafetyLimiter: the last thing a command passes before the driver.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "palpate/arm.hpp"
#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// One value per joint; infinity means "no limit" where it is said.
struct LimiterConfig {
  JointVector torque{};       ///< largest |u| [N m]; > 0 and finite, there is no drive without one
  JointVector torque_rate{};  ///< largest |du/dt| [N m/s]; > 0, infinity allowed
  JointVector lower{};        ///< position limits [rad], lower < upper; infinity allowed
  JointVector upper{};        ///< [rad]
  JointVector velocity{};     ///< largest |dq| [rad/s]; > 0, infinity allowed
  JointVector approach{};     ///< k: speed allowed per distance to a position limit [1/s], > 0; braking begins velocity/k before it
  JointVector damping{};      ///< D: torque per excess of speed [N m s/rad], > 0; see the class
  double fault_decay = 0.1;   ///< time constant with which a command fades after a fault [s], > 0
  double max_dt = 0.1;        ///< a longer time step gives the torque rate no more room than this one [s], > 0

  /// What the arm's figures say: its limits, no torque rate, approach 5/s, damping effort limit over velocity limit.
  static LimiterConfig of(const Arm& arm) noexcept {
    LimiterConfig c;
    for (int i = 0; i < arm.n(); ++i) {
      const auto j = static_cast<std::size_t>(i);
      const JointDescription& d = arm.joint(i);
      c.torque[j] = d.max_effort;
      c.torque_rate[j] = std::numeric_limits<double>::infinity();
      c.lower[j] = d.lower;
      c.upper[j] = d.upper;
      c.velocity[j] = d.max_velocity;
      c.approach[j] = 5.0;
      c.damping[j] = std::isfinite(d.max_velocity) ? d.max_effort / d.max_velocity : d.max_effort;
    }
    return c;
  }
};

/// What limited a command; a bit mask.
enum Limited : std::uint8_t {
  limited_none = 0,
  limited_torque = 1,    ///< |u| at the torque limit
  limited_rate = 2,      ///< |du/dt| at the rate limit
  limited_position = 4,  ///< push towards a position limit reduced or turned into braking
  limited_velocity = 8,  ///< push to more speed than allowed reduced or turned into braking
  limited_fault = 16,    ///< a number was not finite: the command was replaced
  limited_time = 32,     ///< the time step was not a finite number > 0: the torque may not change where its rate is limited
};

struct LimitedCommand {
  JointCommand command{};           ///< status: non_finite, time_error or saturated (the first that applies), else as it came in
  std::uint8_t limited = 0;         ///< Limited bits of all joints together
  Joints<std::uint8_t> by_joint{};  ///< Limited bits of each
};

/// Keeps a command within what the arm may do, in this order:
///   1. fault: if command, q, dq or gravity holds a number that is not finite, the whole command is replaced by
///        u = w - D dq,  w <- b + exp(-dt/T_f) (w - b),   w starts at the last torque sent
///      (b = gravity if that is finite, else 0; no damping where dq is not finite): the push fades, the arm floats and brakes.
///   2. position and velocity: the push u - b is held within  [D (v_lo - dq), D (v_up - dq)],
///        v_up = sat(k (q_up - q), v_max),  v_lo = sat(k (q_lo - q), v_max),  sat(x, v): x held within [-v, v].
///      Towards a limit the allowed speed falls with the distance, pushing fades out, then turns into braking, and beyond
///      the limit into a slow way back; away from it nothing changes. (The soft limits of pr2_controllers and
///      ros_control's EffortJointSoftLimitsHandle, taken about gravity so that holding the arm is not taken for pushing.)
///   3. torque: |u| <= u_max.       4. rate: |u - u_last| <= rate dt.
/// 3 and 4 hold for every input whatever; 2 yields to them.
///
/// u [N m] torque to be sent; b [N m] gravity torque (pass zeros if unknown: then a joint near its limit sags away from
/// it); k approach [1/s], D damping [N m s/rad], v_max velocity [rad/s], T_f fault_decay [s]. Choose D >= u_max/v_max, or
/// pushing is reduced even at rest, and D < I/dt with I the joint's inertia, or braking itself rattles.
class SafetyLimiter {
 public:
  SafetyLimiter(int n, const LimiterConfig& config)
      : n_(static_cast<std::size_t>(check::in_range("SafetyLimiter n", n, 1, max_joints))), c_(config) {
    for (std::size_t j = 0; j < n_; ++j) {
      check::positive(check::entry("LimiterConfig torque", j, "N m"), c_.torque[j]);
      check::positive_or_infinite(check::entry("LimiterConfig torque_rate", j, "N m/s"), c_.torque_rate[j]);
      check::positive_or_infinite(check::entry("LimiterConfig velocity", j, "rad/s"), c_.velocity[j]);
      check::positive(check::entry("LimiterConfig approach", j, "1/s"), c_.approach[j]);
      check::positive(check::entry("LimiterConfig damping", j, "N m s/rad"), c_.damping[j]);
      if (!(c_.lower[j] < c_.upper[j]))
        check::fail(check::entry("LimiterConfig lower", j, "rad"), c_.lower[j], "less than upper, " + std::to_string(c_.upper[j]));
    }
    check::positive("LimiterConfig fault_decay [s]", c_.fault_decay);
    check::positive("LimiterConfig max_dt [s]", c_.max_dt);
  }

  /// gravity [N m]: g(q), part of the command that only holds the arm. dt [s]: time since the previous step.
  [[nodiscard]] LimitedCommand step(const JointCommand& command, const JointVector& q, const JointVector& dq, const JointVector& gravity,
                                    double dt) noexcept {
    LimitedCommand out;
    out.command.time_ns = command.time_ns;
    const bool good_time = std::isfinite(dt) && dt > 0.0;
    const double h = good_time ? std::min(dt, c_.max_dt) : 0.0;
    const bool good_gravity = check::all_finite(gravity, n_);
    const bool fault = !(good_gravity && check::all_finite(command.torque, n_) && check::all_finite(q, n_) && check::all_finite(dq, n_));
    const double keep = fault ? std::exp(-h / c_.fault_decay) : 0.0;

    for (std::size_t j = 0; j < n_; ++j) {
      std::uint8_t limited = good_time ? limited_none : limited_time;
      const double b = good_gravity ? std::clamp(gravity[j], -c_.torque[j], c_.torque[j]) : 0.0;
      const bool good_speed = std::isfinite(dq[j]);
      double u = command.torque[j];
      if (fault) {
        limited |= limited_fault;
        held_[j] = b + keep * (held_[j] - b);
        u = held_[j] - (good_speed ? c_.damping[j] * dq[j] : 0.0);
      }
      if (good_speed && std::isfinite(q[j])) u = soft_limit(j, u, b, q[j], dq[j], limited);

      const double torque = std::clamp(u, -c_.torque[j], c_.torque[j]);
      if (torque != u) limited |= limited_torque;
      const double room = std::isinf(c_.torque_rate[j]) ? 2.0 * c_.torque[j] : c_.torque_rate[j] * h;
      const double sent = std::clamp(torque, sent_[j] - room, sent_[j] + room);
      if (sent != torque) limited |= limited_rate;

      sent_[j] = sent;
      if (!fault) held_[j] = sent;
      out.command.torque[j] = sent;
      out.by_joint[j] = limited;
      out.limited |= limited;
    }
    constexpr std::uint8_t actuator = limited_torque | limited_rate | limited_position | limited_velocity;
    out.command.status = fault || command.status == Status::non_finite ? Status::non_finite
                         : !good_time                                  ? Status::time_error
                         : (out.limited & actuator) != 0               ? Status::saturated
                                                                       : command.status;
    return out;
  }

  /// Forget the past. torque_now [N m]: what the drives are applying, from which the rate limit counts (zero at enable).
  void reset(const JointVector& torque_now = {}) noexcept {
    for (std::size_t j = 0; j < n_; ++j)
      sent_[j] = held_[j] = std::isfinite(torque_now[j]) ? std::clamp(torque_now[j], -c_.torque[j], c_.torque[j]) : 0.0;
  }

 private:
  [[nodiscard]] double soft_limit(std::size_t j, double u, double b, double q, double dq, std::uint8_t& limited) const noexcept {
    const double v = c_.velocity[j], k = c_.approach[j], D = c_.damping[j];
    const double v_up = std::clamp(k * (c_.upper[j] - q), -v, v);
    const double v_lo = std::clamp(k * (c_.lower[j] - q), -v, v);
    const double push = u - b, most = D * (v_up - dq), least = D * (v_lo - dq);
    if (push > most) {
      limited |= v_up < v ? limited_position : limited_velocity;
      return b + most;
    }
    if (push < least) {
      limited |= v_lo > -v ? limited_position : limited_velocity;
      return b + least;
    }
    return u;
  }

  std::size_t n_;
  LimiterConfig c_;
  JointVector sent_{};  // last torque sent [N m]
  JointVector held_{};  // w: what is left of the last good command during a fault [N m]
};

}  // namespace palpate
