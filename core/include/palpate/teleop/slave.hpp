// The slave's side: where the slave is to go, and what is told of its touch.
#pragma once
#include <limits>

#include "palpate/teleop/energy.hpp"
#include "palpate/teleop/felt_force.hpp"
#include "palpate/teleop/link.hpp"

namespace palpate::teleop {

/// What becomes of a place of the master that the slave has not followed: after a pause, after the clutch.
enum class Resync : std::uint8_t {
  index = 0,     ///< it counts as the slave's own place from now on: nothing moves (hands that reach around, dissimilar arms)
  approach = 1,  ///< the slave goes there at `resync_speed` (arms of one kinematics, joint to joint)
};

/// One value per axis (n of them), [m] and [N] in task space, [rad] and [N m] joint to joint; the slave's axes.
struct SlaveConfig {
  Coupling coupling = Coupling::force_position;
  Resync resync = Resync::index;
  LinkConfig link{};
  TankConfig tank{};
  bool passive = true;            ///< the passivity layer; false only to see what happens without
  bool task_space = true;         ///< the first three axes are a place in space: `rotation` turns them; false: joint to joint
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  ///< row-major R_slave_master
  double motion_scale = 1.0;      ///< motion of the slave per motion of the master [1], > 0
  double force_scale = 1.0;       ///< force felt per force of the environment [1], > 0
  double threshold = 3.0;         ///< of FeltForce, in standard deviations [1], >= 0
  JointVector lower{}, upper{};   ///< where the reference may be [m], lower < upper, infinity allowed
  JointVector speed{};            ///< of the reference at most [m/s], > 0
  JointVector acceleration{};     ///< of the reference at most [m/s^2], > 0, infinity allowed
  JointVector resync_speed{};     ///< while the two come together again [m/s], > 0
  JointVector resync_acceleration{};  ///< and then [m/s^2], > 0, infinity allowed
  JointVector stiffness{};        ///< of spring K and damper D by which the slave follows, K + 2 D/dt: what a step adds to the force [N/m], >= 0
  JointVector wall{};             ///< stiffness with which the end of the workspace is shown to the hand [N/m of the slave], >= 0
  JointVector force_limit{};      ///< largest feed-forward force (four_channel), and largest that is told [N], > 0
  double gain = 60.0;             ///< with which the reference closes on the master's place [1/s], > 0
  double velocity_time = 0.02;    ///< the master's velocity counts for so long after it was told [s], > 0
};

struct SlaveCommand {
  JointVector position{};         ///< reference [m]
  JointVector velocity{};         ///< of the reference [m/s]
  JointVector force{};            ///< to be added to what follows the reference (four_channel, else zero) [N]
  JointVector felt{};             ///< force of the environment as it is told to the master, the slave's axes and scale [N]
  std::uint16_t events = 0;       ///< Event bits
  Status status = Status::ok;     ///< held: the link is dead; saturated: a limit; non_finite: bad input
};

/// x_t+ = x_t + g s R (x_m+ - x_m),    v = g s R v_m + k (x_w - x_r),    x_r+ = x_r + a v dt          (MATH.md section 8)
///
/// x_t where the master points, x_w the same within the workspace, x_r the reference; s motion scale, R rotation, g gain of the link, k gain.
/// Velocity and acceleration are limited first; a in [0, 1] is what the energy allows: the reference does the work -F_e dx_r on what it pulls,
/// F_e the port's force, and is made slower where the tank would be emptied; a withdrawal needs no energy. Told is F = l (w(F_e) F_e + k_w (x_w - x_t)): the environment's force above the detection threshold, and the wall at the
/// end of the workspace; l force scale. With s and l the master's energy is l/s times the slave's (J. E. Colgate, ICRA 1991), and so it is booked.
class SlaveSide {
 public:
  SlaveSide(int n, const SlaveConfig& config)
      : n_(static_cast<std::size_t>(check::in_range("SlaveSide n", n, config.task_space ? 3 : 1, max_joints))), c_(config), tank_(config.tank), link_(config.link), felt_(config.threshold) {
    for (std::size_t i = 0; i < n_; ++i) {
      if (!(c_.lower[i] < c_.upper[i])) check::fail(check::entry("SlaveConfig lower", i, "m"), c_.lower[i], "less than upper, " + std::to_string(c_.upper[i]));
      check::positive(check::entry("SlaveConfig speed", i, "m/s"), c_.speed[i]);
      check::positive_or_infinite(check::entry("SlaveConfig acceleration", i, "m/s^2"), c_.acceleration[i]);
      check::positive(check::entry("SlaveConfig resync_speed", i, "m/s"), c_.resync_speed[i]);
      check::positive_or_infinite(check::entry("SlaveConfig resync_acceleration", i, "m/s^2"), c_.resync_acceleration[i]);
      check::not_negative(check::entry("SlaveConfig stiffness", i, "N/m"), c_.stiffness[i]);
      check::not_negative(check::entry("SlaveConfig wall", i, "N/m"), c_.wall[i]);
      check::positive(check::entry("SlaveConfig force_limit", i, "N"), c_.force_limit[i]);
    }
    check::positive("SlaveConfig motion_scale [1]", c_.motion_scale);
    check::positive("SlaveConfig force_scale [1]", c_.force_scale);
    check::positive("SlaveConfig gain [1/s]", c_.gain);
    check::positive("SlaveConfig velocity_time [s]", c_.velocity_time);
    for (double r : c_.rotation) check::finite("SlaveConfig rotation [1]", r);
  }

  /// A message of the master, as it came. False: it is old or broken, and was not used.
  bool receive(const Message& m) noexcept { return link_.receive(m, n_); }

  /// x [m], v [m/s] of the slave; port [N]: what the environment does to the reference, against which it works; force [N] of the environment
  /// as estimated, its weight and load removed, std [N] its standard deviation; allowed: the slave may move (its brakes are off); dt [s].
  SlaveCommand step(const JointVector& x, const JointVector& v, const JointVector& port, const JointVector& force, const JointVector& std, bool allowed, double dt,
                    std::int64_t time_ns = 0) noexcept {
    SlaveCommand out;
    const bool good_time = std::isfinite(dt) && dt > 0.0 && dt < 0.1;
    const bool good = good_time && check::all_finite(x, n_) && check::all_finite(v, n_) && check::all_finite(port, n_) && check::all_finite(force, n_);
    const double h = good_time ? dt : 0.0, power_scale = c_.force_scale / c_.motion_scale;
    link_.step(h, allowed && good);
    if (good) {
      if (!started_) {
        reference_ = target_ = x;
        started_ = true;
      } else {
        // the force went from one sample to the other while the reference moved: the dearer of the two is booked
        double before = 0.0, after = 0.0, pushing = 0.0, jump = 0.0;
        for (std::size_t i = 0; i < n_; ++i) {
          before += port_[i] * moved_[i];
          after += port[i] * moved_[i];
          pushing += pushed_[i] * (x[i] - x_[i]);
          jump += 0.5 * c_.stiffness[i] * std::abs(moved_[i] * (moved_[i] - moved_before_[i]));
        }
        // a damper jumps with the reference's velocity, at once, and neither sample shows it
        const double work = std::min(before, after) - pushing - jump;
        tank_.exchange(power_scale * work);
      }
      x_ = x;
      port_ = port;
    }
    const Message& m = link_.newest();
    if (link_.began()) tank_.begin(m.energy);
    tank_.receive(m.energy);

    // where the master points
    std::uint16_t events = link_.events();
    const bool coupled = started_ && good && link_.alive() && link_.closed();
    const JointVector place = to_slave(m.position, c_.motion_scale), going = to_slave(m.velocity, c_.motion_scale);
    const double g = coupled ? link_.gain() : 0.0;
    if (link_.returned() || !pointed_) last_ = place;
    pointed_ = pointed_ || link_.alive();
    const bool index = c_.resync == Resync::index;
    bool apart = false;
    for (std::size_t i = 0; i < n_; ++i) {
      if (!coupled) target_[i] = reference_[i];
      else if (!index) target_[i] = place[i];
      else {
        target_[i] += g * (place[i] - last_[i]);
        const double ahead = c_.resync_speed[i] / c_.gain;  // what comes back slowly is not made up for in a rush
        if (g < 1.0) target_[i] = std::clamp(target_[i], reference_[i] - ahead, reference_[i] + ahead);
      }
    }
    last_ = place;
    const double fresh = std::max(0.0, 1.0 - link_.silence() / c_.velocity_time);
    JointVector inside{}, step{};
    for (std::size_t i = 0; i < n_; ++i) {
      inside[i] = std::clamp(target_[i], c_.lower[i], c_.upper[i]);
      if (inside[i] != target_[i]) events |= event_workspace;
      const bool free = inside[i] == target_[i];
      double wanted = coupled ? (free ? g * fresh * going[i] : 0.0) + c_.gain * (inside[i] - reference_[i]) : 0.0;
      const bool slowly = g < 1.0 || (!index && !caught_);
      // so slow at first that even a stop would be no jump
      const double fastest = slowly ? std::min(c_.speed[i], c_.resync_speed[i] * (index ? g * g * g * g : 1.0)) : c_.speed[i];
      if (std::abs(wanted) > fastest) events |= event_speed;
      wanted = std::clamp(wanted, -fastest, fastest);
      // towards the end of the workspace no faster than half the acceleration brakes: the arm comes to rest with its reference
      const double ahead = std::max(0.0, wanted > 0.0 ? c_.upper[i] - reference_[i] : reference_[i] - c_.lower[i]);
      if (std::isfinite(c_.acceleration[i]) && std::isfinite(ahead)) {
        const double braked = std::sqrt(c_.acceleration[i] * ahead);
        wanted = std::clamp(wanted, -braked, braked);
      }
      apart = apart || std::abs(inside[i] - reference_[i]) > c_.resync_speed[i] / c_.gain;
      const double most = slowly ? std::min(c_.acceleration[i], c_.resync_acceleration[i]) : c_.acceleration[i];
      const double room = coupled ? most * h : std::numeric_limits<double>::infinity();
      step[i] = h * std::clamp(wanted, velocity_[i] - room, velocity_[i] + room);
      // the end of the workspace is not overrun for the sake of a limited acceleration; from beyond it there is a way back
      step[i] = std::clamp(step[i], std::min(0.0, c_.lower[i] - reference_[i]), std::max(0.0, c_.upper[i] - reference_[i]));
    }
    caught_ = coupled && (caught_ || !apart);

    // what the energy allows
    if (c_.passive) {
      double out_work = 0.0;
      for (std::size_t i = 0; i < n_; ++i) out_work += -port_[i] * step[i] + 0.5 * c_.stiffness[i] * step[i] * step[i];
      // while it comes back, no faster than the tank can bear for a while: or it would stop with a jerk
      const double most = tank_.power() * h / power_scale * (g < 1.0 ? std::min(1.0, c_.tank.horizon / bear_time) : 1.0);
      // it falls at once and rises slowly: a reference that stutters shakes the arm, and that is taken for a touch
      allowed_ = std::min({1.0, allowed_ + allowed_rate * h, out_work > most ? most / out_work : 1.0});
      if (allowed_ < 1.0) {
        events |= event_energy;
        for (std::size_t i = 0; i < n_; ++i) step[i] *= allowed_;
      }
    }
    for (std::size_t i = 0; i < n_; ++i) {
      moved_before_[i] = moved_[i];
      moved_[i] = step[i];
      reference_[i] += step[i];
      velocity_[i] = h > 0.0 ? step[i] / h : 0.0;
    }

    // the hand's force beside its motion
    pushed_ = {};
    if (c_.coupling == Coupling::four_channel && coupled) {
      const JointVector hand = to_slave(m.force, 1.0 / c_.force_scale);
      JointVector slack{};
      for (std::size_t i = 0; i < n_; ++i) {
        pushed_[i] = std::clamp(g * hand[i], -c_.force_limit[i], c_.force_limit[i]);
        slack[i] = std::isfinite(c_.acceleration[i]) ? c_.acceleration[i] * h : c_.speed[i];
      }
      if (c_.passive) {
        const double a = passive_factor(pushed_, v, slack, n_, 0.5 * tank_.level() / power_scale, c_.tank.horizon, h);
        if (a < 1.0) {
          events |= event_energy;
          for (std::size_t i = 0; i < n_; ++i) pushed_[i] *= a;
        }
      }
    }

    JointVector told{};
    for (std::size_t i = 0; i < n_; ++i) {
      const double F = good ? felt_(force[i], std[i]) : 0.0;
      const double whole = F + c_.wall[i] * (inside[i] - target_[i]);
      told[i] = std::clamp(whole, -c_.force_limit[i], c_.force_limit[i]);
      if (told[i] != whole) events |= event_force;
      out.felt[i] = told[i];
    }
    if (c_.passive) tank_.give(m.level, m.booked, g * h);
    if (!good) events |= event_input;

    out.position = reference_;
    out.velocity = velocity_;
    out.force = pushed_;
    out.events = events;
    out.status = !good                                                                          ? Status::non_finite
                 : !link_.alive()                                                               ? Status::held
                 : (events & (event_force | event_energy | event_speed | event_workspace)) != 0 ? Status::saturated
                                                                                                : Status::ok;
    JointVector seen{};
    for (std::size_t i = 0; i < n_; ++i) seen[i] = x_[i] - (target_[i] - place[i]);
    message_.sequence += 1;
    message_.time_ns = time_ns;
    message_.position = to_master(seen, 1.0 / c_.motion_scale);
    message_.velocity = good ? to_master(v, 1.0 / c_.motion_scale) : JointVector{};
    message_.force = to_master(told, c_.force_scale);
    message_.energy = tank_.sent();
    message_.booked = tank_.booked();
    message_.level = tank_.level();
    message_.engaged = allowed && good;
    return out;
  }

  /// To be sent after each step.
  const Message& message() const noexcept { return message_; }
  /// The number of this run [1], larger than that of any earlier; begins anew.
  void begin(std::uint64_t session) noexcept { *this = SlaveSide(*this, session); }
  const EnergyTank& tank() const noexcept { return tank_; }
  const Link& link() const noexcept { return link_; }

 private:
  SlaveSide(const SlaveSide& other, std::uint64_t session) noexcept
      : n_(other.n_), c_(other.c_), tank_(other.c_.tank), link_(other.c_.link), felt_(other.felt_) {
    message_.session = session;
  }
  [[nodiscard]] JointVector to_slave(const JointVector& a, double scale) const noexcept { return turned(a, scale, 3, 1); }
  [[nodiscard]] JointVector to_master(const JointVector& a, double scale) const noexcept { return turned(a, scale, 1, 3); }
  [[nodiscard]] JointVector turned(const JointVector& a, double scale, std::size_t down, std::size_t across) const noexcept {
    JointVector out{};
    for (std::size_t i = 0; i < n_; ++i) out[i] = scale * a[i];
    for (std::size_t r = 0; c_.task_space && r < 3; ++r) {
      out[r] = 0.0;
      for (std::size_t k = 0; k < 3; ++k) out[r] += scale * c_.rotation[r * down + k * across] * a[k];
    }
    return out;
  }

  static constexpr double bear_time = 0.5, allowed_rate = 10.0;  // [s], [1/s]

  std::size_t n_;
  SlaveConfig c_;
  EnergyTank tank_;
  Link link_;
  FeltForce felt_;
  Message message_{};
  JointVector x_{}, port_{}, reference_{}, velocity_{}, target_{}, last_{}, moved_{}, moved_before_{}, pushed_{};
  double allowed_ = 1.0;
  bool started_ = false, pointed_ = false, caught_ = false;
};

}  // namespace palpate::teleop
