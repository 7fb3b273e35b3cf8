// The master's side: what the hand is made to feel.
#pragma once
#include <limits>

#include "palpate/teleop/energy.hpp"
#include "palpate/teleop/link.hpp"
#include "palpate/teleop/pose.hpp"

namespace palpate::teleop {

/// One value per axis of the device (n of them); [m], [N] for a haptic device, [rad], [N m] for the joints of a leader arm and for the
/// orientation of a pose.
struct MasterConfig {
  Coupling coupling = Coupling::force_position;
  LinkConfig link{};
  TankConfig tank{};
  bool passive = true;              ///< the passivity layer; false only to see what happens without
  bool pose = false;                ///< axes 0 to 2 are a place, 3 to 5 an orientation (Manifold)
  JointVector force_limit{};        ///< largest force of the device [N], >= 0; 0: the axis is measured and has no motor
  JointVector stiffness{};          ///< of the spring between the two [N/m], >= 0; not used by force_position
  JointVector damping{};            ///< and of the damper [N s/m], >= 0
  JointVector fill{};               ///< damping felt while the tank is empty, none when it is full [N s/m], >= 0
  JointVector contact_damping{};    ///< damping in contact, it makes up for the estimate's delay [N s/m], >= 0
  JointVector contact_force = [] { JointVector a; a.fill(1.0); return a; }();  ///< felt, from which on that damping is whole [N], > 0
  JointVector hold_stiffness{};     ///< spring that holds the device while the link is dead [N/m], >= 0
  JointVector hold_damping{};       ///< and its damper [N s/m], >= 0
  JointVector acceleration{};       ///< of the device at most: how much faster it may be next period [m/s^2], >= 0
  JointVector resync_rate{};        ///< how fast the force may change while the two come together again [N/s], > 0
  double fade = 0.3;                ///< time constant with which the force felt goes when the link dies or the clutch opens [s], > 0
};

struct MasterCommand {
  JointVector force{};              ///< of the device on the hand [N]
  JointVector felt{};               ///< of it, what the environment does; the rest is spring, damper, holding [N]
  std::uint16_t events = 0;         ///< Event bits
  Status status = Status::ok;       ///< saturated: a limit; held: the link is dead; non_finite: bad input
};

/// F = g F_env + K (x_s - x_m) + B (v_s - v_m) - (d need(tank) + c(F)) v_m - h (K_h (x_m - x_h) + B_h v_m)      (MATH.md section 8)
///
/// F_env [N] force of the environment as the slave tells it; x_s, v_s the slave's place as the master's (position_position, four_channel);
/// g gain of the link; x_h where the device was when the link died, h 1 while it is dead; need: how empty the tank is;
/// c damping in contact.
/// Then the force limit, and last the energy: F is held for one period, so its work F (x+ - x) is known exactly, and components that do work
/// on the hand are made smaller where the tank would be emptied (EnergyTank, passive_factor). Differences of places are those of Manifold:
/// of an orientation they are rotation vectors. A torque that is held does the work tau (R+ (-) R), but for a part of the third order in the
/// turn of one period.
class MasterSide {
 public:
  MasterSide(int n, const MasterConfig& config) : n_(static_cast<std::size_t>(check::in_range("MasterSide n", n, 1, max_joints))), c_(config), space_(n_, config.pose), tank_(config.tank), link_(config.link) {
    if (c_.pose) check::in_range("MasterSide n of a pose", n, 6, max_joints);
    message_.shown = 0;
    for (std::size_t i = 0; i < n_; ++i) {
      check::not_negative(check::entry("MasterConfig force_limit", i, "N"), c_.force_limit[i]);
      check::positive(check::entry("MasterConfig contact_force", i, "N"), c_.contact_force[i]);
      if (c_.force_limit[i] > 0.0) message_.shown = static_cast<std::uint16_t>(message_.shown | (1u << i));
      check::not_negative(check::entry("MasterConfig stiffness", i, "N/m"), c_.stiffness[i]);
      check::not_negative(check::entry("MasterConfig damping", i, "N s/m"), c_.damping[i]);
      check::not_negative(check::entry("MasterConfig fill", i, "N s/m"), c_.fill[i]);
      check::not_negative(check::entry("MasterConfig contact_damping", i, "N s/m"), c_.contact_damping[i]);
      check::not_negative(check::entry("MasterConfig hold_stiffness", i, "N/m"), c_.hold_stiffness[i]);
      check::not_negative(check::entry("MasterConfig hold_damping", i, "N s/m"), c_.hold_damping[i]);
      check::not_negative(check::entry("MasterConfig acceleration", i, "m/s^2"), c_.acceleration[i]);
      check::positive_or_infinite(check::entry("MasterConfig resync_rate", i, "N/s"), c_.resync_rate[i]);
    }
    check::positive("MasterConfig fade [s]", c_.fade);
  }

  /// A message of the slave, as it came. False: it is old or broken, and was not used.
  bool receive(const Message& m) noexcept { return link_.receive(m, n_); }

  /// x [m], v [m/s] of the device, hand [N] the force of the hand on it (zeros if not known; four_channel tells it to the slave),
  /// closed: the clutch, dt [s] since the step before, time_ns of the own clock.
  MasterCommand step(const JointVector& x, const JointVector& v, const JointVector& hand, bool closed, double dt, std::int64_t time_ns = 0) noexcept {
    MasterCommand out;
    const bool good_time = std::isfinite(dt) && dt > 0.0 && dt < 0.1;
    const bool good = good_time && check::all_finite(x, n_) && check::all_finite(v, n_);
    const double h = good_time ? dt : 0.0;
    link_.step(h, closed);
    if (good) {
      double work = 0.0;
      const JointVector dx = space_.minus(x, x_);
      for (std::size_t i = 0; started_ && i < n_; ++i) work -= sent_[i] * dx[i];
      tank_.exchange(work);
      x_ = x;
      v_ = v;
      started_ = true;
    } else {
      v_ = {};
    }
    const Message& s = link_.newest();
    if (link_.began()) tank_.begin(s.energy);
    tank_.receive(s.energy);

    const bool coupled = link_.alive() && link_.closed();
    const double g = link_.gain(), keep = std::exp(-h / c_.fade);
    const JointVector apart = space_.minus(s.position, x_), astray = space_.minus(x_, anchor_);
    need_ += std::clamp((c_.passive ? tank_.need() : 0.0) - need_, -need_rate * h, need_rate * h);  // energy comes in gusts, the damping must not
    for (std::size_t i = 0; i < n_; ++i) {
      if (!coupled || link_.returned()) rest_[i] += live_[i];  // what was felt before fades from where it was
      rest_[i] *= keep;
      const double before = coupled && !link_.returned() ? live_[i] : 0.0;
      live_[i] = 0.0;
      if (coupled) {
        double F = c_.coupling == Coupling::position_position ? 0.0 : s.force[i];
        if (c_.coupling != Coupling::force_position) F += c_.stiffness[i] * apart[i] + c_.damping[i] * (s.velocity[i] - v_[i]);
        live_[i] = g * std::clamp(F, -c_.force_limit[i], c_.force_limit[i]);
        const double room = g < 1.0 ? c_.resync_rate[i] * h : std::numeric_limits<double>::infinity();
        live_[i] = std::clamp(live_[i], before - room, before + room);
      }
      out.felt[i] = live_[i] + rest_[i];
      out.force[i] = out.felt[i] - holding(i, astray);
    }
    const bool engaging = g < 1.0;
    JointVector slack{}, speed = v_;
    for (std::size_t i = 0; i < n_; ++i) {
      slack[i] = c_.acceleration[i] * h;
      speed[i] = std::copysign(v_[i], out.force[i]);
    }
    // While it comes back, a force that the tank could not bear for a while if the hand turned round is not shown: it would jump when it does.
    const double borne = c_.passive && engaging ? passive_factor(out.force, speed, slack, n_, tank_.level(), bear_time, h) : 1.0;
    bearable_ = std::min(borne, bearable_ + bear_rate * h);
    for (std::size_t i = 0; i < n_; ++i) out.force[i] = bearable_ * out.force[i] - (c_.fill[i] * need_ + c_.contact_damping[i] * std::min(1.0, std::abs(live_[i]) / c_.contact_force[i])) * v_[i];
    if (link_.died()) {  // hold here from now on; an earlier place is let go of slowly
      for (std::size_t i = 0; i < n_; ++i) rest_[i] -= holding(i, astray);
      anchor_ = x_;
      hold_ = 0.0;
      anchored_ = true;
    }
    hold_ = anchored_ && !link_.alive() ? std::min(1.0, hold_ + h / hold_rise) : std::max(0.0, hold_ - h / hold_fall);

    std::uint16_t events = static_cast<std::uint16_t>(link_.events() | (bearable_ < 1.0 ? event_energy : 0));
    for (std::size_t i = 0; i < n_; ++i) {
      // what fades, what holds and what returns may all change at once: their sum does not, even where the hand starts all at once
      const double room = engaging && link_.alive() && good ? c_.resync_rate[i] * h : std::numeric_limits<double>::infinity();
      out.force[i] = std::clamp(out.force[i], sent_[i] - room, sent_[i] + room);
      const double limited = std::clamp(out.force[i], -c_.force_limit[i], c_.force_limit[i]);
      if (limited != out.force[i] && c_.force_limit[i] > 0.0) events |= event_force;
      out.force[i] = good ? limited : 0.0;
    }
    if (c_.passive) {
      const double s_f = passive_factor(out.force, v_, slack, n_, tank_.level(), c_.tank.horizon, h);
      if (s_f < 1.0) {
        events |= event_energy;
        for (std::size_t i = 0; i < n_; ++i)
          if (out.force[i] * v_[i] + std::abs(out.force[i]) * slack[i] > 0.0) out.force[i] *= s_f;
      }
      tank_.give(s.level, s.booked, g * h);  // what comes back slowly does not empty its tank at once
    }
    if (!good) events |= event_input;
    sent_ = out.force;

    out.events = events;
    out.status = !good                                      ? Status::non_finite
                 : !link_.alive()                           ? Status::held
                 : (events & (event_force | event_energy)) != 0 ? Status::saturated
                                                            : Status::ok;
    message_.sequence += 1;
    message_.time_ns = time_ns;
    message_.position = x_;
    message_.velocity = v_;
    message_.force = check::all_finite(hand, n_) ? hand : JointVector{};
    message_.energy = tank_.sent();
    message_.booked = tank_.booked();
    message_.level = tank_.level();
    message_.engaged = closed && good;
    return out;
  }

  /// To be sent after each step.
  const Message& message() const noexcept { return message_; }
  /// The number of this run [1], larger than that of any earlier; begins anew.
  void begin(std::uint64_t session) noexcept {
    *this = MasterSide(*this, session);
  }
  const EnergyTank& tank() const noexcept { return tank_; }
  const Link& link() const noexcept { return link_; }

 private:
  MasterSide(const MasterSide& other, std::uint64_t session) noexcept : n_(other.n_), c_(other.c_), space_(other.space_), tank_(other.c_.tank), link_(other.c_.link) {
    message_.session = session;
    message_.shown = other.message_.shown;
  }

  /// Force with which axis i is held, that is so far from where the link died [N].
  [[nodiscard]] double holding(std::size_t i, const JointVector& astray) const noexcept {
    const double limit = 0.25 * c_.force_limit[i];
    return hold_ * std::clamp(c_.hold_stiffness[i] * astray[i] + c_.hold_damping[i] * v_[i], -limit, limit);
  }

  static constexpr double hold_rise = 0.1, hold_fall = 1.0;  // [s]
  static constexpr double bear_time = 0.2, bear_rate = 2.0;   // [s], [1/s]
  static constexpr double need_rate = 5.0;                   // [1/s]

  std::size_t n_;
  MasterConfig c_;
  Manifold space_;
  EnergyTank tank_;
  Link link_;
  Message message_{};
  JointVector x_{}, v_{}, sent_{}, anchor_{}, live_{}, rest_{};
  double hold_ = 0.0, need_ = 0.0, bearable_ = 1.0;
  bool started_ = false, anchored_ = false;
};

}  // namespace palpate::teleop
