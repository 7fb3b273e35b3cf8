// PD control with a feed-forward torque: gravity alone, or the whole inverse dynamics of the planned motion.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate {

struct PdGains {
  JointVector kp{};     ///< [N m/rad], >= 0
  JointVector kd{};     ///< [N m s/rad], >= 0
  JointVector limit{};  ///< largest |u| [N m], > 0; infinity for none
};

/// u = sat(u_ff + K_p (q_d - q) + K_d (dq_d - dq))   (mass-estimation report eq. 15; MATH.md section 8).
///
/// u [N m] link-side motor torque; q, dq measured or estimated [rad, rad/s]; q_d, dq_d from the Setpoint; u_ff [N m] is
/// the caller's: g(q) for PD + gravity, g(q_d) for the published variant, M(q) ddq_d + C(q,dq) dq_d + g(q) with the
/// payload for feed-forward control. sat clips each joint to its limit; status saturated if any was clipped.
///
/// If the state or the setpoint is not finite the feedback says nothing, so the command is the feed-forward alone: the
/// arm floats instead of dropping or jumping. If the feed-forward is not finite either, it is the last one that was
/// (zero before there was one): the last whole command may hold a push that was meant for a moment. Both with status
/// non_finite, all joints together; what to do when that lasts is the SafetyLimiter's and the caller's decision.
class PdGravity {
 public:
  PdGravity(int n, const PdGains& gains) : n_(static_cast<std::size_t>(check::in_range("PdGravity n", n, 1, max_joints))), gains_(gains) {
    for (std::size_t j = 0; j < n_; ++j) {
      check::not_negative(check::entry("PdGains kp", j, "N m/rad"), gains.kp[j]);
      check::not_negative(check::entry("PdGains kd", j, "N m s/rad"), gains.kd[j]);
      check::positive_or_infinite(check::entry("PdGains limit", j, "N m"), gains.limit[j]);
    }
  }

  /// Other kp [N m/rad] and kd [N m s/rad] from the next step on. False: not all are finite and >= 0; the old ones stay.
  bool set_gains(const JointVector& kp, const JointVector& kd) noexcept {
    for (std::size_t j = 0; j < n_; ++j)
      if (!(std::isfinite(kp[j]) && kp[j] >= 0.0 && std::isfinite(kd[j]) && kd[j] >= 0.0)) return false;
    gains_.kp = kp;
    gains_.kd = kd;
    return true;
  }

  [[nodiscard]] JointCommand step(const Setpoint& setpoint, const JointVector& q, const JointVector& dq, const JointVector& feedforward,
                                  std::int64_t time_ns = 0) noexcept {
    JointCommand command;
    command.time_ns = time_ns;
    JointVector wanted{};
    for (std::size_t j = 0; j < n_; ++j)
      wanted[j] = feedforward[j] + gains_.kp[j] * (setpoint.q[j] - q[j]) + gains_.kd[j] * (setpoint.dq[j] - dq[j]);
    const bool good_feedforward = check::all_finite(feedforward, n_);
    if (good_feedforward) std::copy_n(feedforward.begin(), n_, feedforward_.begin());
    const bool good = good_feedforward && check::all_finite(wanted, n_);
    if (!good) {
      wanted = feedforward_;
      command.status = Status::non_finite;
    }
    for (std::size_t j = 0; j < n_; ++j) {
      command.torque[j] = std::clamp(wanted[j], -gains_.limit[j], gains_.limit[j]);
      if (good && command.torque[j] != wanted[j]) command.status = Status::saturated;
    }
    return command;
  }

  void reset() noexcept { feedforward_ = {}; }

 private:
  std::size_t n_;
  PdGains gains_;
  JointVector feedforward_{};  // the last finite one [N m]
};

}  // namespace palpate
