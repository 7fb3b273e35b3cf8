// FeedforwardPd: PD control about the torque the arm needs, with or without what it holds.
#pragma once
#include "palpate/chain.hpp"
#include "palpate/control/pd_gravity.hpp"

namespace palpate {

/// Where the feed-forward torque of the PD controller comes from.
enum class Feedforward {
  reference_gravity,  ///< g(q_d) of the bare arm: what made the published curves
  gravity,            ///< g(q) of the arm with its load
  inverse_dynamics,   ///< M(q_d) q_d'' + C(q_d, q_d') q_d' + g(q_d) + tau_f(q_d') of the arm with its load
};

/// u = sat(u_ff + K_p (q_d - q) + K_d (q_d' - q'))  (R eq. 15; MATH.md section 8), u_ff by Feedforward.
///
/// `load` is what the arm holds, a body on the last link (Pipeline::load): with it the goal is reached although the object
/// pulls; without it the arm stops K_p^-1 times the object's torque short.
class FeedforwardPd {
 public:
  FeedforwardPd(const Arm& arm, const PdGains& gains, Feedforward feedforward) : arm_(&arm), pd_(arm.n(), gains), feedforward_(feedforward) {
    if (!arm.has_dynamics()) throw std::invalid_argument("FeedforwardPd: the arm has no masses; give inertials");
  }

  JointCommand step(const Setpoint& setpoint, const JointVector& q, const JointVector& dq, const Inertia<double>& load, std::int64_t time_ns) noexcept {
    JointVector u{};
    switch (feedforward_) {
      case Feedforward::reference_gravity: u = gravity_torque<double>(*arm_, setpoint.q); break;
      case Feedforward::gravity: u = gravity_torque<double>(*arm_, q, load); break;
      case Feedforward::inverse_dynamics: {
        u = inverse_dynamics<double>(*arm_, setpoint.q, setpoint.dq, setpoint.ddq, load);
        const JointVector friction = arm_->friction_torque(setpoint.dq);
        for (int j = 0; j < arm_->n(); ++j) u[detail::at(j)] += friction[detail::at(j)];
        break;
      }
    }
    return pd_.step(setpoint, q, dq, u, time_ns);
  }
  /// As PdGravity::set_gains().
  bool set_gains(const JointVector& kp, const JointVector& kd) noexcept { return pd_.set_gains(kp, kd); }
  void reset() noexcept { pd_.reset(); }

 private:
  const Arm* arm_;
  PdGravity pd_;
  Feedforward feedforward_;
};

}  // namespace palpate
