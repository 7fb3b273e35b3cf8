// The slave's side: where the slave is to go, and what is told of its touch.
#pragma once
#include <limits>

#include "palpate/teleop/energy.hpp"
#include "palpate/teleop/felt_force.hpp"
#include "palpate/teleop/link.hpp"
#include "palpate/teleop/pose.hpp"

namespace palpate::teleop {

/// What becomes of a place of the master that the slave has not followed: after a pause, after the clutch.
enum class Resync : std::uint8_t {
  index = 0,     ///< it counts as the slave's own place from now on: nothing moves (hands that reach around, dissimilar arms)
  approach = 1,  ///< the slave goes there at `resync_speed` (arms of one kinematics, joint to joint)
};

/// One value per axis (n of them), [m] and [N] in task space, [rad] and [N m] joint to joint and for the orientation of a pose; the slave's axes.
struct SlaveConfig {
  Coupling coupling = Coupling::force_position;
  Resync resync = Resync::index;
  LinkConfig link{};
  TankConfig tank{};
  bool passive = true;            ///< the passivity layer; false only to see what happens without
  bool task_space = true;         ///< the first three axes are a place in space: `rotation` turns them; false: joint to joint
  bool pose = false;              ///< and the next three an orientation, turned by it too (Manifold); in task space only
  std::array<double, 9> rotation{1, 0, 0, 0, 1, 0, 0, 0, 1};  ///< row-major R_slave_master
  double motion_scale = 1.0;      ///< motion of the slave per motion of the master [1], > 0
  double turn_scale = 1.0;        ///< rotation of the slave per rotation of the master [1], > 0; 1 with Resync::approach
  double force_scale = 1.0;       ///< force felt per force of the environment [1], > 0
  double threshold = 3.0;         ///< of FeltForce, in standard deviations [1], >= 0
  JointVector lower{}, upper{};   ///< where the reference may be [m], lower < upper, infinity allowed; not read for an orientation
  double turn_limit = 1.5;        ///< largest angle of the reference from its orientation at the start [rad], > 0, at most 3
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
/// With a pose + and - are those of Manifold, so x_t+ of an orientation is exp(g s_r R theta_m) R_t, theta_m = log(R_m+ R_m^T) what the hand
/// turned: with turn scale s_r = 1 the slave's orientation from where the coupling was engaged is the hand's, whatever the way; any other s_r
/// scales every small turn. Torques are scaled by l s_r/s, as a force at a lever that is scaled like the motion: power is l/s in every axis.
/// The end of the workspace is for an orientation a largest angle from the start; a hand that points half the way from there to pi slips.
///
/// Velocity and acceleration are limited first; a in [0, 1] is what the energy allows: the reference does the work -F_e dx_r on what it pulls,
/// F_e the port's force, and is made slower where the tank would be emptied; a withdrawal needs no energy. An axis of which the master shows
/// no force is no port: what moves it is the slave's own drive, nothing comes back by it, and no tank is asked. Told is
/// F = l (w(F_e) F_e + k_w (x_w - x_t)): the environment's force above the detection threshold, and the wall at the end of the workspace;
/// l force scale. With s and l the master's energy is l/s times the slave's (J. E. Colgate, ICRA 1991), and so it is booked.
class SlaveSide {
 public:
  SlaveSide(int n, const SlaveConfig& config)
      : n_(static_cast<std::size_t>(check::in_range("SlaveSide n", n, config.task_space ? 3 : 1, max_joints))), c_(config), space_(n_, config.pose), tank_(config.tank), link_(config.link), felt_(config.threshold) {
    if (c_.pose) check::in_range("SlaveSide n of a pose", n, 6, max_joints);
    if (c_.pose && !c_.task_space) check::fail("SlaveConfig pose", 1.0, "false joint to joint");
    for (std::size_t i = 0; i < n_; ++i) {
      if (!space_.turns(i) && !(c_.lower[i] < c_.upper[i])) check::fail(check::entry("SlaveConfig lower", i, "m"), c_.lower[i], "less than upper, " + std::to_string(c_.upper[i]));
      check::positive(check::entry("SlaveConfig speed", i, "m/s"), c_.speed[i]);
      check::positive_or_infinite(check::entry("SlaveConfig acceleration", i, "m/s^2"), c_.acceleration[i]);
      check::positive(check::entry("SlaveConfig resync_speed", i, "m/s"), c_.resync_speed[i]);
      check::positive_or_infinite(check::entry("SlaveConfig resync_acceleration", i, "m/s^2"), c_.resync_acceleration[i]);
      check::not_negative(check::entry("SlaveConfig stiffness", i, "N/m"), c_.stiffness[i]);
      check::not_negative(check::entry("SlaveConfig wall", i, "N/m"), c_.wall[i]);
      check::positive(check::entry("SlaveConfig force_limit", i, "N"), c_.force_limit[i]);
    }
    check::positive("SlaveConfig motion_scale [1]", c_.motion_scale);
    check::positive("SlaveConfig turn_scale [1]", c_.turn_scale);
    if (c_.pose && c_.resync == Resync::approach && c_.turn_scale != 1.0) check::fail("SlaveConfig turn_scale [1]", c_.turn_scale, "1 where the slave approaches the master's orientation");
    if (!(c_.turn_limit > 0.0 && c_.turn_limit <= 3.0)) check::fail("SlaveConfig turn_limit [rad]", c_.turn_limit, "above 0 to 3");
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
        reference_ = target_ = start_ = x;
        started_ = true;
      } else {
        // the force went from one sample to the other while the reference moved: the dearer of the two is booked
        double before = 0.0, after = 0.0, pushing = 0.0, jump = 0.0;
        const JointVector dx = space_.minus(x, x_);
        for (std::size_t i = 0; i < n_; ++i) {
          if (!paid_[i]) continue;
          before += port_[i] * moved_[i];
          after += port[i] * moved_[i];
          pushing += pushed_[i] * dx[i];
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
    for (std::size_t i = 0; i < n_; ++i) {
      // three axes of space are one: turned, each of the slave's is some of each of the master's
      const std::uint32_t mask = !c_.task_space || i >= (c_.pose ? 6u : 3u) ? 1u << i : i < 3 ? 0b000111u : 0b111000u;
      paid_[i] = (m.shown & mask) != 0;
    }

    // where the master points
    std::uint16_t events = link_.events();
    const bool coupled = started_ && good && link_.alive() && link_.closed();
    const JointVector going = to_slave(m.velocity, c_.motion_scale, c_.turn_scale);
    const double g = coupled ? link_.gain() : 0.0;
    if (link_.returned() || !pointed_) last_ = m.position;
    pointed_ = pointed_ || link_.alive();
    const bool index = c_.resync == Resync::index;
    if (!coupled) target_ = reference_;
    else if (!index) target_ = to_slave(m.position, c_.motion_scale, c_.turn_scale);
    else {
      target_ = space_.plus(target_, to_slave(space_.minus(m.position, last_), g * c_.motion_scale, g * c_.turn_scale));
      if (g < 1.0) {  // what comes back slowly is not made up for in a rush
        JointVector behind = space_.minus(target_, reference_);
        for (std::size_t i = 0; i < n_; ++i) {
          const double ahead = c_.resync_speed[i] / c_.gain;
          behind[i] = std::clamp(behind[i], -ahead, ahead);
        }
        target_ = space_.plus(reference_, behind);
      }
    }
    last_ = m.position;
    if (c_.pose) target_ = turned_at_most(target_, 0.5 * (c_.turn_limit + pi));
    JointVector inside = target_;
    for (std::size_t i = 0; i < n_; ++i)
      if (!space_.turns(i)) inside[i] = std::clamp(target_[i], c_.lower[i], c_.upper[i]);
    if (c_.pose) inside = turned_at_most(inside, c_.turn_limit);
    const bool turns_free = inside[3] == target_[3] && inside[4] == target_[4] && inside[5] == target_[5];
    JointVector outside = space_.minus(target_, inside);
    const JointVector behind = space_.minus(inside, reference_);

    const double fresh = std::max(0.0, 1.0 - link_.silence() / c_.velocity_time);
    JointVector step{};
    bool apart = false;
    for (std::size_t i = 0; i < n_; ++i) {
      const bool free = space_.turns(i) ? turns_free : inside[i] == target_[i];
      if (free) outside[i] = 0.0;
      else events |= event_workspace;
      double wanted = coupled ? (free ? g * fresh * going[i] : 0.0) + c_.gain * behind[i] : 0.0;
      const bool slowly = g < 1.0 || (!index && !caught_);
      // so slow at first that even a stop would be no jump
      const double fastest = slowly ? std::min(c_.speed[i], c_.resync_speed[i] * (index ? g * g * g * g : 1.0)) : c_.speed[i];
      if (std::abs(wanted) > fastest) events |= event_speed;
      wanted = std::clamp(wanted, -fastest, fastest);
      // towards the end of the workspace no faster than half the acceleration brakes: the arm comes to rest with its reference
      const double ahead = space_.turns(i) ? std::numeric_limits<double>::infinity() : std::max(0.0, wanted > 0.0 ? c_.upper[i] - reference_[i] : reference_[i] - c_.lower[i]);
      if (std::isfinite(c_.acceleration[i]) && std::isfinite(ahead)) {
        const double braked = std::sqrt(c_.acceleration[i] * ahead);
        wanted = std::clamp(wanted, -braked, braked);
      }
      apart = apart || std::abs(behind[i]) > c_.resync_speed[i] / c_.gain;
      const double most = slowly ? std::min(c_.acceleration[i], c_.resync_acceleration[i]) : c_.acceleration[i];
      const double room = coupled ? most * h : std::numeric_limits<double>::infinity();
      step[i] = h * std::clamp(wanted, velocity_[i] - room, velocity_[i] + room);
      // the end of the workspace is not overrun for the sake of a limited acceleration; from beyond it there is a way back
      if (!space_.turns(i)) step[i] = std::clamp(step[i], std::min(0.0, c_.lower[i] - reference_[i]), std::max(0.0, c_.upper[i] - reference_[i]));
    }
    if (c_.pose) brake_turn(step, h);
    caught_ = coupled && (caught_ || !apart);

    // what the energy allows
    if (c_.passive) {
      double out_work = 0.0;
      for (std::size_t i = 0; i < n_; ++i)
        if (paid_[i]) out_work += -port_[i] * step[i] + 0.5 * c_.stiffness[i] * step[i] * step[i];
      // while it comes back, no faster than the tank can bear for a while: or it would stop with a jerk
      const double most = tank_.power() * h / power_scale * (g < 1.0 ? std::min(1.0, c_.tank.horizon / bear_time) : 1.0);
      // it falls at once and rises slowly: a reference that stutters shakes the arm, and that is taken for a touch
      allowed_ = std::min({1.0, allowed_ + allowed_rate * h, out_work > most ? most / out_work : 1.0});
      if (allowed_ < 1.0) {
        events |= event_energy;
        for (std::size_t i = 0; i < n_; ++i)
          if (paid_[i]) step[i] *= allowed_;
      }
    }
    reference_ = space_.plus(reference_, step);
    for (std::size_t i = 0; i < n_; ++i) {
      moved_before_[i] = moved_[i];
      moved_[i] = step[i];
      velocity_[i] = h > 0.0 ? step[i] / h : 0.0;
    }

    // the hand's force beside its motion
    pushed_ = {};
    if (c_.coupling == Coupling::four_channel && coupled) {
      const JointVector hand = to_slave(m.force, 1.0 / c_.force_scale, 1.0 / torque_scale());
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
      const double whole = F - c_.wall[i] * outside[i];
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
    message_.sequence += 1;
    message_.time_ns = time_ns;
    // where the hand would be if the slave were where it points
    message_.position = space_.plus(m.position, to_master(space_.minus(x_, target_), 1.0 / c_.motion_scale, 1.0 / c_.turn_scale));
    message_.velocity = good ? to_master(v, 1.0 / c_.motion_scale, 1.0 / c_.turn_scale) : JointVector{};
    message_.force = to_master(told, c_.force_scale, torque_scale());
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
      : n_(other.n_), c_(other.c_), space_(other.space_), tank_(other.c_.tank), link_(other.c_.link), felt_(other.felt_) {
    message_.session = session;
  }
  [[nodiscard]] double torque_scale() const noexcept { return c_.force_scale * c_.turn_scale / c_.motion_scale; }
  [[nodiscard]] JointVector to_slave(const JointVector& a, double scale, double turn_scale) const noexcept { return turned(a, scale, turn_scale, 3, 1); }
  [[nodiscard]] JointVector to_master(const JointVector& a, double scale, double turn_scale) const noexcept { return turned(a, scale, turn_scale, 1, 3); }
  [[nodiscard]] JointVector turned(const JointVector& a, double scale, double turn_scale, std::size_t down, std::size_t across) const noexcept {
    JointVector out{};
    for (std::size_t i = 0; i < n_; ++i) out[i] = scale * a[i];
    for (std::size_t r = 0; c_.task_space && r < (c_.pose ? 6u : 3u); ++r) {
      const std::size_t first = r < 3 ? 0 : 3;
      out[r] = 0.0;
      for (std::size_t k = 0; k < 3; ++k) out[r] += (first == 0 ? scale : turn_scale) * c_.rotation[(r - first) * down + k * across] * a[first + k];
    }
    return out;
  }
  /// A pose turned from the start by no more than an angle [rad].
  [[nodiscard]] JointVector turned_at_most(const JointVector& pose, double most) const noexcept {
    const Vec3<double> theta = Manifold::turn(space_.minus(pose, start_));
    const double angle = std::sqrt(dot(theta, theta));
    if (angle <= most) return pose;
    JointVector out = pose;
    Manifold::put(out, (Turn::exp((most / angle) * theta) * Turn::exp(Manifold::turn(start_))).log());
    return out;
  }
  /// The same for orientations as for places: towards the largest angle it brakes, and does not overrun it. d|theta| = theta/|theta| . step.
  void brake_turn(JointVector& step, double h) const noexcept {
    const Vec3<double> theta = Manifold::turn(space_.minus(reference_, start_));
    const double angle = std::sqrt(dot(theta, theta)), acceleration = std::min({c_.acceleration[3], c_.acceleration[4], c_.acceleration[5]});
    if (angle > 0.0 && std::isfinite(acceleration)) {
      const Vec3<double> out = (1.0 / angle) * theta;
      const double surplus = dot(out, Manifold::turn(step)) - h * std::sqrt(acceleration * std::max(0.0, c_.turn_limit - angle));
      if (surplus > 0.0) Manifold::put(step, Manifold::turn(step) - surplus * out);
    }
    const JointVector next = space_.plus(reference_, step), within = turned_at_most(next, std::max(angle, c_.turn_limit));
    if (within != next) Manifold::put(step, Manifold::turn(space_.minus(within, reference_)));
    double shorter = 1.0;  // along the end one axis may have become faster than all three were
    for (std::size_t i = 3; i < 6; ++i)
      if (std::abs(step[i]) > c_.speed[i] * h) shorter = std::min(shorter, c_.speed[i] * h / std::abs(step[i]));
    for (std::size_t i = 3; i < 6; ++i) step[i] *= shorter;
  }

  static constexpr double pi = 3.141592653589793;
  static constexpr double bear_time = 0.5, allowed_rate = 10.0;  // [s], [1/s]

  std::size_t n_;
  SlaveConfig c_;
  Manifold space_;
  EnergyTank tank_;
  Link link_;
  FeltForce felt_;
  Message message_{};
  JointVector x_{}, start_{}, port_{}, reference_{}, velocity_{}, target_{}, last_{}, moved_{}, moved_before_{}, pushed_{};
  std::array<bool, max_joints> paid_{};
  double allowed_ = 1.0;
  bool started_ = false, pointed_ = false, caught_ = false;
};

}  // namespace palpate::teleop
