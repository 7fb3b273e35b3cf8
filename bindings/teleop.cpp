// Teleoperation: the two sides, and whole episodes of a simulated teleoperator.
#include "common.hpp"

#include <chrono>

#include "palpate/teleop/episode.hpp"

using namespace palpate;
using namespace palpate::teleop;

namespace palpate_py {
namespace {

nb::dict message(const Message& m, int n) {
  nb::dict out;
  out["session"] = m.session;
  out["sequence"] = m.sequence;
  out["time_ns"] = m.time_ns;
  out["position"] = array(m.position, n);
  out["velocity"] = array(m.velocity, n);
  out["force"] = array(m.force, n);
  out["energy"] = m.energy;
  out["booked"] = m.booked;
  out["level"] = m.level;
  out["engaged"] = m.engaged;
  out["shown"] = m.shown;
  return out;
}
Message message(std::uint64_t session, std::uint64_t sequence, std::int64_t time_ns, const Vector& position, const Vector& velocity, const Vector& force, double energy,
                double booked, double level, bool engaged, std::uint16_t shown, int n) {
  return {session, sequence, time_ns, joints(position, n, "position"), joints(velocity, n, "velocity"), joints(force, n, "force"), energy, booked, level, engaged, shown};
}
nb::dict tank(const EnergyTank& t) {
  nb::dict out;
  out["level"] = t.level();
  out["taken"] = t.taken();
  out["given"] = t.given();
  out["sent"] = t.sent();
  out["received"] = t.received();
  out["booked"] = t.booked();
  out["dissipated"] = t.dissipated();
  out["lowest"] = t.lowest();
  return out;
}
Coupling coupling(const std::string& name) {
  if (name == "force_position") return Coupling::force_position;
  if (name == "position_position") return Coupling::position_position;
  expect(name == "four_channel", "coupling '" + name + "'; choose from force_position, position_position, four_channel");
  return Coupling::four_channel;
}

struct PyMaster {
  MasterSide side;
  int n;
};
struct PySlave {
  SlaveSide side;
  int n;
};

/// Both sides take and give messages in the same way.
template <class Py>
void bind_side(nb::class_<Py>& type) {
  type.def("receive", [](Py& self, std::uint64_t session, std::uint64_t sequence, std::int64_t time_ns, const Vector& position, const Vector& velocity, const Vector& force,
                         double energy, double booked, double level, bool engaged, std::uint16_t shown) {
        return self.side.receive(message(session, sequence, time_ns, position, velocity, force, energy, booked, level, engaged, shown, self.n));
      }, nb::arg("session"), nb::arg("sequence"), nb::arg("time_ns"), nb::arg("position"), nb::arg("velocity"), nb::arg("force"), nb::arg("energy"), nb::arg("booked"), nb::arg("level"),
           nb::arg("engaged"), nb::arg("shown"), "A message of the other side, as it came; False: old or broken, not used.")
      .def("message", [](const Py& self) { return message(self.side.message(), self.n); }, "To be sent after each step.")
      .def("begin", [](Py& self, std::uint64_t session) { self.side.begin(session); }, nb::arg("session"))
      .def("tank", [](const Py& self) { return tank(self.side.tank()); })
      .def_prop_ro("alive", [](const Py& self) { return self.side.link().alive(); })
      .def_prop_ro("gain", [](const Py& self) { return self.side.link().gain(); })
      .def_prop_ro("silence", [](const Py& self) { return self.side.link().silence(); });
}

nb::dict plain(const EpisodeConfig& c) {
  nb::dict out;
  out["coupling"] = std::array<const char*, 3>{"force_position", "position_position", "four_channel"}[static_cast<std::size_t>(c.coupling)];
  out["axes"] = c.axes;
  out["pose"] = c.pose;
  out["seconds"] = c.seconds;
  out["delay"] = c.delay;
  out["jitter"] = c.jitter;
  out["loss"] = c.loss;
  out["cut_at"] = c.cut_at;
  out["cut"] = c.cut;
  out["wall"] = c.wall;
  out["hand_stiffness"] = c.hand_stiffness;
  out["force_limit"] = c.force_limit;
  out["speed"] = c.speed;
  out["initial"] = 2.0 * c.tank.initial;
  return out;
}
nb::dict plain(const EpisodeResult& r) {
  nb::dict out;
  out["generated"] = r.generated;
  out["lowest"] = r.lowest;
  out["force"] = r.force;
  out["speed"] = r.speed;
  out["shaking"] = r.shaking;
  out["slave_shaking"] = r.slave_shaking;
  out["drift"] = r.drift;
  out["force_jump"] = r.force_jump;
  out["speed_jump"] = r.speed_jump;
  out["hold_motion"] = r.hold_motion;
  out["felt_error"] = r.felt_error;
  out["contact"] = r.contact;
  out["finite"] = r.finite;
  return out;
}

/// How long each of `calls` steps of both sides takes [s]: six axes, four-channel, a message every step both ways. The time
/// of reading the clock is in it.
void step_times(std::size_t calls, double* master_s, double* slave_s) {
  MasterConfig mc;
  SlaveConfig sc;
  mc.coupling = sc.coupling = Coupling::four_channel;
  mc.pose = sc.pose = true;
  mc.force_limit.fill(8.5);
  mc.stiffness.fill(300.0);
  mc.damping.fill(5.0);
  mc.fill.fill(1.0);
  mc.acceleration.fill(50.0);
  mc.resync_rate.fill(150.0);
  sc.lower.fill(-1.0);
  sc.upper.fill(1.0);
  sc.speed.fill(0.5);
  sc.acceleration.fill(20.0);
  sc.resync_speed.fill(0.05);
  sc.resync_acceleration.fill(0.2);
  sc.force_limit.fill(50.0);
  MasterSide master(6, mc);
  SlaveSide slave(6, sc);
  master.begin(1);
  slave.begin(1);
  using Clock = std::chrono::steady_clock;
  const auto seconds = [](Clock::duration d) { return std::chrono::duration<double>(d).count(); };
  JointVector x{}, v{}, hand{}, at{}, force{}, std{};
  std.fill(0.1);
  for (std::size_t k = 0; k < calls; ++k) {
    const double t = 1e-3 * static_cast<double>(k);
    for (std::size_t i = 0; i < 6; ++i) {
      x[i] = 0.05 * std::sin(3.0 * t + static_cast<double>(i));
      v[i] = 0.15 * std::cos(3.0 * t + static_cast<double>(i));
      force[i] = -2000.0 * std::max(0.0, at[i] - 0.02);
    }
    const auto a = Clock::now();
    const MasterCommand felt = master.step(x, v, hand, true, 1e-3);
    const auto b = Clock::now();
    const SlaveCommand command = slave.step(at, v, force, force, std, true, 1e-3);
    const auto c = Clock::now();
    master_s[k] = seconds(b - a);
    slave_s[k] = seconds(c - b);
    for (std::size_t i = 0; i < 6; ++i) hand[i] = -felt.force[i];
    at = command.position;
    slave.receive(master.message());
    master.receive(slave.message());
  }
}

}  // namespace

void bind_teleop(nb::module_& m) {
  bind_config<TankConfig>(m, "TankOptions", "The energy tank of one side.",
                          {{"desired", &TankConfig::desired, "level that is kept for oneself; what is above goes to the other side [J]"},
                           {"most", &TankConfig::most, "what is above is thrown away [J]"},
                           {"initial", &TankConfig::initial, "there without anybody having paid for it [J]"},
                           {"horizon", &TankConfig::horizon, "no more power than level/horizon goes out [s]"},
                           {"share", &TankConfig::share, "rate at which a poorer other side is given from the difference of the levels [1/s]"},
                           {"surplus", &TankConfig::surplus, "and at which it is given what is above desired [1/s]"}});
  bind_config<LinkConfig>(m, "LinkOptions", "When a link counts as dead, and how slowly it returns.",
                          {{"timeout", &LinkConfig::timeout, "without anything new for so long the link is dead [s]"},
                           {"ramp", &LinkConfig::ramp, "from nothing to fully coupled [s]"}});
  bind_config<MasterConfig>(m, "MasterOptions", "The master's side, one number per axis of the device.",
                            {{"passive", &MasterConfig::passive, "the passivity layer; False only to see what happens without"},
                             {"pose", &MasterConfig::pose, "axes 0 to 2 are a place, 3 to 5 an orientation"},
                             {"force_limit", &MasterConfig::force_limit, "largest force of the device [N]; 0: measured, no motor"},
                             {"stiffness", &MasterConfig::stiffness, "of the spring between the two [N/m]; not used by force_position"},
                             {"damping", &MasterConfig::damping, "and of the damper [N s/m]"},
                             {"fill", &MasterConfig::fill, "damping felt while the tank is empty [N s/m]"},
                             {"contact_damping", &MasterConfig::contact_damping, "damping in contact [N s/m]"},
                             {"contact_force", &MasterConfig::contact_force, "felt, from which on that damping is whole [N]"},
                             {"hold_stiffness", &MasterConfig::hold_stiffness, "spring that holds the device while the link is dead [N/m]"},
                             {"hold_damping", &MasterConfig::hold_damping, "and its damper [N s/m]"},
                             {"acceleration", &MasterConfig::acceleration, "of the device at most [m/s^2]"},
                             {"resync_rate", &MasterConfig::resync_rate, "how fast the force may change while the two come together again [N/s]"},
                             {"fade", &MasterConfig::fade, "time constant with which the force goes when the link dies [s]"}});
  bind_config<SlaveConfig>(m, "SlaveOptions", "The slave's side, one number per axis of the slave.",
                           {{"passive", &SlaveConfig::passive, "the passivity layer; False only to see what happens without"},
                            {"task_space", &SlaveConfig::task_space, "the first three axes are a place in space; False: joint to joint"},
                            {"pose", &SlaveConfig::pose, "and the next three an orientation"},
                            {"turn_scale", &SlaveConfig::turn_scale, "rotation of the slave per rotation of the master [1]"},
                            {"turn_limit", &SlaveConfig::turn_limit, "largest angle from the orientation at the start [rad]"},
                            {"motion_scale", &SlaveConfig::motion_scale, "motion of the slave per motion of the master [1]"},
                            {"force_scale", &SlaveConfig::force_scale, "force felt per force of the environment [1]"},
                            {"threshold", &SlaveConfig::threshold, "below so many standard deviations nothing is felt [1]"},
                            {"lower", &SlaveConfig::lower, "where the reference may be [m]"},
                            {"upper", &SlaveConfig::upper, "[m]"},
                            {"speed", &SlaveConfig::speed, "of the reference at most [m/s]"},
                            {"acceleration", &SlaveConfig::acceleration, "of the reference at most [m/s^2]"},
                            {"resync_speed", &SlaveConfig::resync_speed, "while the two come together again [m/s]"},
                            {"resync_acceleration", &SlaveConfig::resync_acceleration, "and then [m/s^2]"},
                            {"stiffness", &SlaveConfig::stiffness, "K + 2 D/dt of spring and damper by which the slave follows [N/m]"},
                            {"wall", &SlaveConfig::wall, "stiffness with which the end of the workspace is shown to the hand [N/m]"},
                            {"force_limit", &SlaveConfig::force_limit, "largest force that is told or fed forward [N]"},
                            {"gain", &SlaveConfig::gain, "with which the reference closes on the master's place [1/s]"},
                            {"velocity_time", &SlaveConfig::velocity_time, "the master's velocity counts for so long [s]"}});

  nb::class_<PyMaster> master(m, "MasterSide", "What the hand is made to feel.");
  master
      .def("__init__", [](PyMaster* self, int n, const MasterConfig& options, const std::string& name, const LinkConfig& link, const TankConfig& tank_options) {
        MasterConfig c = options;
        c.coupling = coupling(name);
        c.link = link;
        c.tank = tank_options;
        new (self) PyMaster{MasterSide(n, c), n};
      }, nb::arg("n"), nb::arg("options"), nb::arg("coupling"), nb::arg("link"), nb::arg("tank"))
      .def("step", [](PyMaster& self, const Vector& x, const Vector& v, const Vector& hand, bool closed, double dt, std::int64_t time_ns) {
        const MasterCommand c = self.side.step(joints(x, self.n, "x"), joints(v, self.n, "v"), joints(hand, self.n, "hand"), closed, dt, time_ns);
        return nb::make_tuple(array(c.force, self.n), array(c.felt, self.n), static_cast<int>(c.events), c.status);
      }, nb::arg("x"), nb::arg("v"), nb::arg("hand"), nb::arg("closed"), nb::arg("dt"), nb::arg("time_ns"), "Returns (force [N], felt [N], events, status).");
  bind_side(master);

  nb::class_<PySlave> slave(m, "SlaveSide", "Where the slave is to go, and what is told of its touch.");
  slave
      .def("__init__", [](PySlave* self, int n, const SlaveConfig& options, const std::string& name, const std::string& resync, const Vector& rotation, const LinkConfig& link,
                          const TankConfig& tank_options) {
        SlaveConfig c = options;
        c.coupling = coupling(name);
        expect(resync == "index" || resync == "approach", "resync '" + resync + "'; choose from index, approach");
        c.resync = resync == "index" ? Resync::index : Resync::approach;
        expect(rotation.shape(0) == 9, "rotation: expected 9 numbers");
        std::copy(rotation.data(), rotation.data() + 9, c.rotation.begin());
        c.link = link;
        c.tank = tank_options;
        new (self) PySlave{SlaveSide(n, c), n};
      }, nb::arg("n"), nb::arg("options"), nb::arg("coupling"), nb::arg("resync"), nb::arg("rotation"), nb::arg("link"), nb::arg("tank"))
      .def("step", [](PySlave& self, const Vector& x, const Vector& v, const Vector& port, const Vector& force, const Vector& std, bool allowed, double dt,
                      std::int64_t time_ns) {
        const int n = self.n;
        const SlaveCommand c = self.side.step(joints(x, n, "x"), joints(v, n, "v"), joints(port, n, "port"), joints(force, n, "force"), joints(std, n, "std"), allowed, dt, time_ns);
        return nb::make_tuple(array(c.position, n), array(c.velocity, n), array(c.force, n), array(c.felt, n), static_cast<int>(c.events), c.status);
      }, nb::arg("x"), nb::arg("v"), nb::arg("port"), nb::arg("force"), nb::arg("std"), nb::arg("allowed"), nb::arg("dt"), nb::arg("time_ns"),
           "Returns (reference, its velocity, force to add, felt, events, status).");
  bind_side(slave);

  const auto three = [](const Vector& a, const char* name) {
    expect(a.shape(0) == 3, std::string(name) + ": expected 3 numbers");
    return Vec3<double>{a.data()[0], a.data()[1], a.data()[2]};
  };
  const auto given = [](const Vec3<double>& a) {
    Output<double> out({3});
    out.data[0] = a.x, out.data[1] = a.y, out.data[2] = a.z;
    return out.array;
  };
  m.def("rotation_vector", [given](const Vector& R) {
    expect(R.shape(0) == 9, "R: expected 9 numbers, row by row");
    const double* r = R.data();
    return given(Turn::of({{r[0], r[3], r[6]}, {r[1], r[4], r[7]}, {r[2], r[5], r[8]}}).log());
  }, nb::arg("R"), "Axis times angle (3,) [rad], angle at most pi, of a rotation matrix (9,), row by row.");
  m.def("rotation_matrix", [three](const Vector& theta) {
    const Mat3<double> R = Turn::exp(three(theta, "theta")).matrix();
    Output<double> out({3, 3});
    const double rows[9] = {R.cx.x, R.cy.x, R.cz.x, R.cx.y, R.cy.y, R.cz.y, R.cx.z, R.cy.z, R.cz.z};
    std::copy(rows, rows + 9, out.data);
    return out.array;
  }, nb::arg("theta"), "(3, 3) of a rotation vector (3,) [rad].");
  m.def("turned", [three, given](const Vector& theta, const Vector& d) {
    return given((Turn::exp(three(d, "d")) * Turn::exp(three(theta, "theta"))).log());
  }, nb::arg("theta"), nb::arg("d"), "An orientation (3,) turned by d (3,), both rotation vectors in base axes [rad].");
  m.def("turn_between", [three, given](const Vector& to, const Vector& from) {
    return given((Turn::exp(three(to, "to")) * Turn::exp(three(from, "from")).inverse()).log());
  }, nb::arg("to"), nb::arg("from"), "What turns the orientation `from` (3,) to `to` (3,): a rotation vector in base axes [rad].");

  m.def("teleop_events", [] {
    nb::dict out;
    out["link"] = static_cast<int>(event_link);
    out["engaging"] = static_cast<int>(event_engaging);
    out["clutch"] = static_cast<int>(event_clutch);
    out["energy"] = static_cast<int>(event_energy);
    out["force"] = static_cast<int>(event_force);
    out["speed"] = static_cast<int>(event_speed);
    out["workspace"] = static_cast<int>(event_workspace);
    out["input"] = static_cast<int>(event_input);
    return out;
  }, "Bits of the events, by name.");
  m.def("felt_force", [](const Vector& force, const Vector& std, double threshold) {
    const std::size_t n = force.shape(0);
    expect(std.shape(0) == n, "std: expected as many numbers as force");
    const FeltForce felt(threshold);
    Output<double> out({n});
    for (std::size_t i = 0; i < n; ++i) out.data[i] = felt(force.data()[i], std.data()[i]);
    return out.array;
  }, nb::arg("force"), nb::arg("std"), nb::arg("threshold"));
  m.def("teleop_step_times", [](std::size_t calls) {
    Output<double> felt({calls}), followed({calls});
    unlocked([&] { step_times(calls, felt.data, followed.data); });
    return nb::make_tuple(felt.array, followed.array);
  }, nb::arg("calls"), "How long each of so many steps takes: (master (calls,), slave (calls,)) [s]; six axes, four-channel.");
  m.def("teleop_episode", [](std::uint64_t seed, const std::string& layer) {
    expect(layer == "none" || layer == "tanks" || layer == "waves", "layer '" + layer + "'; choose from none, tanks, waves");
    EpisodeConfig c = random_episode(seed);
    c.layer = layer == "none" ? Layer::none : layer == "tanks" ? Layer::tanks : Layer::waves;
    EpisodeResult r;
    unlocked([&] { r = run_episode(c, seed); });
    return nb::make_tuple(plain(c), plain(r));
  }, nb::arg("seed"), nb::arg("layer"), "A random episode of a simulated teleoperator: (what it was, what happened).");
}

}  // namespace palpate_py
