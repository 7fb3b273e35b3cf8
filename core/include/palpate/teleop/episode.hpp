// A whole teleoperator in a few equations: hand, device, bad network, slave and wall. For trying the couplings ten thousand times.
#pragma once
#include <vector>

#include "palpate/teleop/master.hpp"
#include "palpate/teleop/slave.hpp"
#include "palpate/teleop/wave.hpp"

namespace palpate::teleop {

/// What keeps master and slave from shaking.
enum class Layer : std::uint8_t { none = 0, tanks = 1, waves = 2 };

struct EpisodeConfig {
  Coupling coupling = Coupling::force_position;
  Layer layer = Layer::tanks;
  int axes = 1;                   ///< 1 to 3; the wall is across the first
  bool pose = false;              ///< three axes and the orientation; its wall is a largest angle. Its masses, forces, ways: at a lever of 0.1 m
  bool torque = true;             ///< the device shows torques; false: it measures its orientation
  double turn_scale = 1.0;
  double seconds = 10.0;          ///< the last four the hand wants to be still
  // network, each way
  double delay = 0.0;             ///< [s], at most 0.6
  double jitter = 0.0;            ///< uniform, on top; messages overtake one another [s], at most 0.3
  double loss = 0.0;              ///< probability [1]
  double repeat = 0.0;            ///< probability that a message comes twice [1]
  double cut_at = 0.0, cut = 0.0; ///< from when on nothing passes, and for how long [s]
  // hand and device
  double hand_mass = 1.0;         ///< with the device [kg]
  double hand_stiffness = 300.0;  ///< towards where the hand wants to be [N/m]; 0: nobody holds the device
  double hand_damping = 10.0;     ///< [N s/m]
  double tremor = 0.2;            ///< amplitude [N]
  double tremor_rate = 10.0;      ///< [Hz]
  double depth = 0.03;            ///< where the hand goes: so far behind the wall [m]
  double wobble = 0.01;           ///< and to and fro [m]
  double wobble_rate = 1.0;       ///< [Hz]
  // slave and wall
  double slave_mass = 3.0;        ///< [kg]
  double slave_stiffness = 5e3;   ///< of its position control [N/m]
  double slave_ratio = 1.0;       ///< damping ratio of that [1]
  double slave_friction = 5.0;    ///< viscous [N s/m]
  double wall = 2e3;              ///< stiffness [N/m]
  double wall_damping = 5.0;      ///< [N s/m]
  double wall_at = 0.05;          ///< [m]
  // what is felt
  double lag = 0.01;              ///< time constant of the estimated force [s]
  double noise = 0.3;             ///< its standard deviation [N]
  double motion_scale = 1.0, force_scale = 1.0;
  double force_limit = 20.0;      ///< of the device [N]
  double speed = 1.0;             ///< of the reference at most [m/s]
  double coupling_stiffness = 300.0;  ///< position_position, four_channel [N/m]
  double coupling_damping = 5.0;      ///< [N s/m]
  double fill = 5.0;              ///< damping while the tank is empty [N s/m]
  double impedance = 20.0;        ///< of the wave line [N s/m]
  LinkConfig link{};
  TankConfig tank{};
};

/// What happened. Energies and works are those of the simulated ports themselves, not what the tanks booked.
struct EpisodeResult {
  double generated = 0.0;      ///< largest of (given - taken) by both ports together, the master's scale [J]; <= 0: passive
  double lowest = 0.0;         ///< of the tanks' levels [J]
  double force = 0.0;          ///< largest of the device [N]; of an orientation everything as at the lever of 0.1 m
  double speed = 0.0;          ///< largest of the reference [m/s]
  double shaking = 0.0;        ///< RMS speed of the hand in the last second and a half [m/s]
  double slave_shaking = 0.0;  ///< and of the slave [m/s]
  double drift = 0.0;          ///< slave from where the master points, at the end, along the wall's free axes or in front of it [m]
  double force_jump = 0.0;     ///< after the cut: largest change of the force within 10 ms, over half a second from the return on [N]
  double speed_jump = 0.0;     ///< and of the reference's velocity [m/s]
  double hold_motion = 0.0;    ///< of the reference while the link was dead [m]
  double felt_error = 0.0;     ///< mean |force of the device + scaled true force|, in contact at the end [N]
  double contact = 0.0;        ///< mean true force there [N]
  bool finite = true;
};

/// SplitMix64: the same numbers everywhere.
class EpisodeRandom {
 public:
  explicit EpisodeRandom(std::uint64_t seed) : x_(seed * 0xD1342543DE82EF95ull + 0x2545F4914F6CDD1Dull) {}  // not the step: neighbours would share their numbers
  double operator()(double a, double b) noexcept { return a + (b - a) * static_cast<double>(next() >> 11) * 0x1.0p-53; }
  double log(double a, double b) noexcept { return a * std::exp((*this)(0.0, 1.0) * std::log(b / a)); }
  double normal() noexcept { return std::sqrt(-2.0 * std::log((*this)(1e-300, 1.0))) * std::cos(6.283185307179586 * (*this)(0.0, 1.0)); }

 private:
  std::uint64_t next() noexcept {
    std::uint64_t z = (x_ += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
  }
  std::uint64_t x_;
};

/// Any hand, slave, wall and network: delay to 0.5 s, jitter, loss to 20 %, walls of 0.1 to 20 kN/m; half of them with a cut of 0.1 to 10 s.
inline EpisodeConfig random_episode(std::uint64_t seed) {
  EpisodeRandom r(seed);
  EpisodeConfig c;
  const double kind = r(0.0, 3.0);
  c.coupling = kind < 1.0 ? Coupling::force_position : kind < 2.0 ? Coupling::position_position : Coupling::four_channel;
  c.axes = 1 + static_cast<int>(r(0.0, 3.0));
  c.delay = r(0.0, 1.0) < 0.15 ? 0.0 : r(0.0, 0.5);
  c.jitter = r(0.0, 1.0) < 0.3 ? 0.0 : r(0.0, 0.1);
  c.loss = r(0.0, 0.2);
  c.repeat = r(0.0, 0.1);
  c.hand_mass = r.log(0.2, 2.0);
  c.hand_stiffness = r(0.0, 1.0) < 0.1 ? 0.0 : r.log(30.0, 800.0);
  c.hand_damping = c.hand_stiffness == 0.0 ? r(0.0, 0.5) : r(0.2, 1.0) * 2.0 * std::sqrt(c.hand_stiffness * c.hand_mass);
  c.tremor = r(0.0, 0.5);
  c.tremor_rate = r(6.0, 12.0);
  c.depth = r(-0.01, 0.08);
  c.wobble = r(0.0, 0.03);
  c.wobble_rate = r(0.2, 3.0);
  c.slave_mass = r.log(0.5, 20.0);
  c.slave_stiffness = r.log(500.0, 20e3);
  c.slave_ratio = r(0.4, 1.2);
  c.slave_friction = r(0.0, 20.0);
  c.wall = r.log(100.0, 20e3);
  c.wall_damping = r(0.0, 0.3) * 2.0 * std::sqrt(c.wall * c.slave_mass);
  c.lag = r(0.001, 0.03);
  c.noise = r(0.0, 1.0);
  c.motion_scale = r.log(0.25, 4.0);
  c.force_scale = r.log(0.1, 2.0);
  c.coupling_stiffness = r.log(50.0, 2000.0);
  c.coupling_damping = r(0.0, 0.7) * 2.0 * std::sqrt(c.coupling_stiffness * c.hand_mass);
  c.fill = r(2.0, 15.0);
  if (r(0.0, 1.0) < 0.5) {
    c.cut = r.log(0.1, 10.0);
    c.cut_at = r(2.0, 4.0);
    c.seconds = c.cut_at + c.cut + 7.0;
  }
  c.pose = r(0.0, 1.0) < 0.2;
  c.torque = r(0.0, 1.0) < 0.6;
  c.turn_scale = r.log(0.5, 2.0);
  return c;
}

/// Messages on their way: some late, some twice, some never, some overtaking others.
class EpisodeNetwork {
 public:
  explicit EpisodeNetwork(const EpisodeConfig& c, std::uint64_t seed) : c_(&c), random_(seed), slot_(1024) {}
  void send(const Message& m, int step, bool cut) {
    const int copies = random_(0.0, 1.0) < c_->repeat ? 2 : 1;
    for (int k = 0; k < copies; ++k) {
      const bool lost = random_(0.0, 1.0) < c_->loss;
      const int late = static_cast<int>(1e3 * (c_->delay + random_(0.0, 1.0) * c_->jitter) + 0.5);
      if (!lost && !cut) slot_[static_cast<std::size_t>(step + late) % slot_.size()].push_back(m);
    }
  }
  template <class Take>
  void deliver(int step, bool cut, Take&& take) {
    auto& here = slot_[static_cast<std::size_t>(step) % slot_.size()];
    for (const Message& m : here)
      if (!cut) take(m);
    here.clear();
  }

 private:
  const EpisodeConfig* c_;
  EpisodeRandom random_;
  std::vector<std::vector<Message>> slot_;
};

/// One episode: 1 kHz on both sides, ten steps of physics in each period.
///
/// Hand and device: m x'' = F + K_h (x_i - x) - B_h x' + tremor. Slave: m x'' = K (x_r - x) + D (v_r - x') - f x' + F_ff - wall, spring and
/// damper to the reference being its position control. The port's force is that spring's and damper's, known without an estimate, and all
/// else is passive: so energy that appears is the coupling's and the network's, and none may. An orientation is a body of equal inertia about all
/// axes on springs of torque K log(R_r R^T), whose energy is K |log|^2/2; the wave line has places alone.
inline EpisodeResult run_episode(const EpisodeConfig& c, std::uint64_t seed) {
  check::in_range("EpisodeConfig axes", c.axes, 1, 3);
  check::positive("EpisodeConfig hand_mass [kg]", c.hand_mass);
  check::positive("EpisodeConfig slave_mass [kg]", c.slave_mass);
  if (!(c.delay >= 0.0 && c.delay <= 0.6)) check::fail("EpisodeConfig delay [s]", c.delay, "0 to 0.6");
  if (!(c.jitter >= 0.0 && c.jitter <= 0.3)) check::fail("EpisodeConfig jitter [s]", c.jitter, "0 to 0.3");
  if (!(c.seconds >= 5.0 && c.seconds <= 3600.0)) check::fail("EpisodeConfig seconds [s]", c.seconds, "5 to 3600");
  constexpr double T = 1e-3, pi = 3.141592653589793;
  constexpr int substeps = 10;
  const bool tanks = c.layer == Layer::tanks, waves = c.layer == Layer::waves, pose = c.pose && !waves;
  const std::size_t n = pose ? 6 : static_cast<std::size_t>(c.axes);
  const Manifold space(n, pose);
  JointVector lever{};  // axis i is an angle times that [m], or a way
  for (std::size_t i = 0; i < n; ++i) lever[i] = space.turns(i) ? 0.1 : 1.0;
  EpisodeRandom random(seed ^ 0xABCDEF);
  EpisodeNetwork there(c, seed * 2 + 1), back(c, seed * 2 + 2);

  const double slave_damping = 2.0 * c.slave_ratio * std::sqrt(c.slave_stiffness * c.slave_mass);
  MasterConfig mc;
  SlaveConfig sc;
  mc.coupling = sc.coupling = c.coupling;
  mc.link = sc.link = c.link;
  mc.tank = sc.tank = c.tank;
  mc.passive = sc.passive = tanks;
  sc.task_space = mc.pose = sc.pose = pose;
  sc.turn_scale = c.turn_scale;
  sc.motion_scale = c.motion_scale;
  sc.force_scale = c.force_scale;
  for (std::size_t i = 0; i < n; ++i) {
    const double L = lever[i];
    mc.force_limit[i] = space.turns(i) && !c.torque ? 0.0 : c.force_limit * L;
    mc.stiffness[i] = c.coupling_stiffness * L * L;
    mc.damping[i] = c.coupling_damping * L * L;
    mc.resync_rate[i] = 150.0 * L;
    mc.fill[i] = tanks ? c.fill * L * L : 0.0;
    mc.hold_stiffness[i] = 200.0 * L * L;
    mc.hold_damping[i] = 2.0 * L * L;
    mc.acceleration[i] = (c.force_limit / c.hand_mass + 200.0) / L;
    sc.lower[i] = -0.5;
    sc.upper[i] = 0.5;
    sc.speed[i] = c.speed / L;
    sc.acceleration[i] = 50.0 / L;
    sc.resync_speed[i] = 0.05 / L;
    sc.resync_acceleration[i] = 0.2 / L;
    sc.stiffness[i] = (c.slave_stiffness + 2.0 * slave_damping / T) * L * L;
    sc.wall[i] = 500.0 * L * L;
    sc.force_limit[i] = c.force_limit / c.force_scale * L;
  }
  const int axes = static_cast<int>(n);
  MasterSide master(axes, mc);
  SlaveSide slave(axes, sc);
  master.begin(1);
  slave.begin(1);
  const WaveLine line(c.impedance);
  JointVector wave_there{}, wave_back{};

  EpisodeResult out;
  JointVector x{}, v{}, X{}, V{}, reference{}, port{}, estimate{}, wall_force{}, F{}, v_ref{};
  JointVector std{};
  for (std::size_t i = 0; i < n; ++i) std[i] = c.noise * lever[i];
  std::array<std::array<double, 11>, 6> recent_F{}, recent_v{};
  double balance = 0.0, shaking = 0.0, slave_shaking = 0.0, error = 0.0, contact = 0.0;
  int last = 0, quiet = 0, after_return = -1;
  double before_cut = 0.0;
  const int steps = static_cast<int>(c.seconds / T + 0.5);
  const double power_scale = c.force_scale / c.motion_scale;
  for (int k = 0; k < steps; ++k) {
    const double t = k * T;
    const bool cut = c.cut > 0.0 && t >= c.cut_at && t < c.cut_at + c.cut;
    // the link counts as dead from its timeout on; the return is the first message after the cut
    wave_there = wave_back = {};
    back.deliver(k, cut, [&](const Message& m) {
      if (waves) wave_back = m.force;
      else master.receive(m);
    });
    there.deliver(k, cut, [&](const Message& m) {
      if (waves) wave_there = m.force;
      else slave.receive(m);
    });

    JointVector command{}, push{}, next = reference;
    if (waves) {
      Message mm, sm;
      for (std::size_t i = 0; i < n; ++i) {
        const WaveLine::Master a = line.master(v[i], wave_back[i]);
        command[i] = std::clamp(a.force, -c.force_limit, c.force_limit);
        mm.force[i] = a.wave;
        // spring and damper answer within the period: solved for the velocity at which both agree
        const double stiff = c.force_scale * c.motion_scale * (slave_damping + c.slave_stiffness * T);
        const WaveLine::Slave b = line.slave(-c.force_scale * (port[i] + slave_damping * v_ref[i]), wave_there[i], stiff);
        next[i] = reference[i] + T * std::clamp(c.motion_scale * b.velocity, -c.speed, c.speed);
        sm.force[i] = b.wave;
      }
      there.send(mm, k, cut);
      back.send(sm, k, cut);
    } else {
      JointVector hand{}, felt{};
      for (std::size_t i = 0; i < n; ++i) {
        estimate[i] += (T / (c.lag + T)) * (wall_force[i] - estimate[i]);
        felt[i] = estimate[i] + std[i] * random.normal();
        hand[i] = -F[i];  // quasi-static: what the device pushes, the hand pushes back
      }
      const MasterCommand mcmd = master.step(x, v, hand, true, T, k);
      const SlaveCommand scmd = slave.step(X, V, port, felt, std, true, T, k);
      command = mcmd.force;
      next = scmd.position;
      push = scmd.force;
      there.send(master.message(), k, cut);
      back.send(slave.message(), k, cut);
    }

    // physics
    JointVector wish{};
    const JointVector ahead = space.minus(next, reference);
    const double stop = c.seconds - 4.0;
    const double ease = std::min(1.0, t / 1.0), moving = t < stop ? 1.0 : std::exp(-(t - stop) / 0.1);
    for (std::size_t i = 0; i < n; ++i) {
      F[i] = command[i];
      v_ref[i] = ahead[i] / T;
      const double scale = lever[i] * (space.turns(i) ? c.turn_scale : c.motion_scale);
      const double aim = (c.wall_at + c.depth) / scale;
      const double wobble = std::min(c.wobble / scale, 0.05 / lever[i]);
      wish[i] = (i % 3 == 0 ? std::min(aim, space.turns(i) ? 1.4 : 0.4) * ease * ease * (3.0 - 2.0 * ease) : 0.0) +
                moving * wobble * std::sin(2.0 * pi * c.wobble_rate * (1.0 + 0.3 * static_cast<double>(i)) * t);
    }
    const double h = T / substeps;
    JointVector half{}, way{};
    double work = 0.0;
    for (int s = 0; s < substeps; ++s) {
      const double ts = t + s * h;
      const JointVector yearning = space.minus(wish, x);
      for (std::size_t i = 0; i < n; ++i) {
        const double L = lever[i];
        const double tremor = c.hand_stiffness > 0.0 ? c.tremor * L * std::sin(2.0 * pi * c.tremor_rate * ts + static_cast<double>(i)) : 0.0;
        v[i] += h / (c.hand_mass * L * L) * (F[i] + L * L * (c.hand_stiffness * yearning[i] - c.hand_damping * v[i]) + tremor);
        way[i] = h * v[i];
        work += F[i] * way[i];
        half[i] = v_ref[i] * h * (s + 0.5);
      }
      x = space.plus(x, way);

      const JointVector behind = space.minus(space.plus(reference, half), X);
      const Vec3<double> theta = Manifold::turn(X);
      const double angle = pose ? std::sqrt(dot(theta, theta)) : 0.0;
      for (std::size_t i = 0; i < n; ++i) {
        const double L2 = lever[i] * lever[i];
        const double pull = L2 * (c.slave_stiffness * behind[i] + slave_damping * (v_ref[i] - V[i]));
        if (space.turns(i)) {
          const double deep = angle - c.wall_at / lever[i];
          wall_force[i] = deep > 0.0 ? -L2 * (c.wall * deep * X[i] / angle + c.wall_damping * V[i]) : 0.0;
        } else {
          const double deep = i == 0 ? X[i] - c.wall_at : -1.0;
          wall_force[i] = deep > 0.0 ? -std::max(0.0, c.wall * deep + c.wall_damping * V[i]) : 0.0;
        }
        V[i] += h / (c.slave_mass * L2) * (pull + push[i] - L2 * c.slave_friction * V[i] + wall_force[i]);
        way[i] = h * V[i];
        // what no torque is shown of is no port
        if (!space.turns(i) || c.torque) work += power_scale * (pull * v_ref[i] + push[i] * V[i]) * h;
      }
      X = space.plus(X, way);
    }
    balance += work;
    reference = next;
    const JointVector behind = space.minus(reference, X);
    for (std::size_t i = 0; i < n; ++i) {
      // what the reference works against: its own spring and damper, which the slave's controller knows
      port[i] = -lever[i] * lever[i] * (c.slave_stiffness * behind[i] + slave_damping * (v_ref[i] - V[i]));
      out.force = std::max(out.force, std::abs(F[i]) / lever[i]);
      out.speed = std::max(out.speed, std::abs(v_ref[i]) * lever[i]);
      out.finite = out.finite && std::isfinite(x[i]) && std::isfinite(X[i]) && std::abs(x[i]) < 1e3 && std::abs(X[i]) < 1e3;
    }
    out.generated = std::max(out.generated, balance);
    if (!out.finite) break;

    if (t >= c.seconds - 1.5) {
      for (std::size_t i = 0; i < n; ++i) {
        shaking += lever[i] * lever[i] * v[i] * v[i];
        slave_shaking += lever[i] * lever[i] * V[i] * V[i];
      }
      error += std::abs(F[0] - c.force_scale * wall_force[0]);
      contact += std::abs(wall_force[0]);
      ++quiet;
    }
    if (c.cut > 0.0 && !waves) {
      const double dead_from = c.cut_at + c.link.timeout + c.delay + c.jitter;
      if (cut && std::abs(t - dead_from) < 0.5 * T) before_cut = reference[0];
      if (cut && t > dead_from) out.hold_motion = std::max(out.hold_motion, std::abs(reference[0] - before_cut));
      if (!cut && t >= c.cut_at + c.cut && after_return < 0 && (master.link().returned() || slave.link().returned()) && c.cut > c.link.timeout + c.jitter) after_return = 0;
      if (after_return >= 0 && after_return < 500) {
        for (std::size_t i = 0; i < n; ++i)
          for (const int past : {1, 5, 10}) {
            if (after_return < past && k < past) continue;
            const auto slot = static_cast<std::size_t>((last + 11 - past) % 11);
            out.force_jump = std::max(out.force_jump, std::abs(F[i] - recent_F[i][slot]) / lever[i]);
            out.speed_jump = std::max(out.speed_jump, std::abs(v_ref[i] - recent_v[i][slot]) * lever[i]);
          }
        ++after_return;
      }
      for (std::size_t i = 0; i < n; ++i) {
        recent_F[i][static_cast<std::size_t>(last)] = F[i];
        recent_v[i][static_cast<std::size_t>(last)] = v_ref[i];
      }
      last = (last + 1) % 11;
    }
  }
  const double count = std::max(1, quiet);
  out.shaking = std::sqrt(shaking / count);
  out.slave_shaking = std::sqrt(slave_shaking / count);
  out.felt_error = error / count;
  out.contact = contact / count;
  out.lowest = std::min(master.tank().lowest(), slave.tank().lowest());
  for (std::size_t i = 1; i < std::min<std::size_t>(n, 3); ++i) out.drift = std::max(out.drift, std::abs(X[i] - c.motion_scale * x[i]));
  return out;
}

}  // namespace palpate::teleop
