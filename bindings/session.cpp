// The session and its simulated arm; a driver written in Python behind the same contract.
#include "common.hpp"
#include "objects.hpp"
#include "rows.hpp"

#include <nanobind/stl/array.h>

#include "palpate/session/session.hpp"
#include "palpate/session/simulated_arm.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

constexpr std::array<const char*, 4> mode_names{"watching", "enabled", "stopped", "fault"};

/// A palpate.drivers.Driver. Takes the interpreter's lock for its own calls alone; what goes wrong in Python is a fault.
class PythonDriver final : public Driver {
 public:
  PythonDriver(nb::object driver, int n, std::int64_t period_ns, bool paced)
      : driver_(std::move(driver)), n_(n), period_(period_ns), paced_(paced) {}
  ~PythonDriver() override {
    nb::gil_scoped_acquire lock;
    driver_.reset();
  }

  int joints() const noexcept override { return n_; }
  std::int64_t period_ns() const noexcept override { return period_; }
  bool paced() const noexcept override { return paced_; }
  const char* complaint() const noexcept override { return complaint_.c_str(); }
  bool enable() noexcept override {
    return guarded([&] { driver_.attr("enable")(); });
  }
  Reading read(RawSample& out) noexcept override {
    Reading reading = Reading::fault;
    guarded([&] {
      if (nb::cast<bool>(driver_.attr("finished"))) {
        reading = Reading::finished;
        return;
      }
      const nb::object sample = driver_.attr("read")();
      if (sample.is_none()) {
        reading = Reading::none;
        return;
      }
      out = {};
      out.time_ns = nb::cast<std::int64_t>(sample.attr("time_ns"));
      out.position = vector(sample.attr("position"), "position");
      out.effort = vector(sample.attr("effort"), "effort");
      const nb::object velocity = sample.attr("velocity"), model = sample.attr("model_torque");
      out.has_velocity = !velocity.is_none();
      out.has_model_torque = !model.is_none();
      if (out.has_velocity) out.velocity = vector(velocity, "velocity");
      if (out.has_model_torque) out.model_torque = vector(model, "model_torque");
      reading = Reading::sample;
    });
    return reading;
  }
  bool write(const JointVector& torque, JointVector& sent) noexcept override {
    return guarded([&] { sent = vector(driver_.attr("write")(array(torque, n_)), "what write() returned"); });
  }
  void stop() noexcept override {
    guarded([&] { driver_.attr("stop")(); });
  }

 private:
  JointVector vector(const nb::object& values, const char* what) const { return palpate_py::joints(nb::cast<Vector>(values), n_, what); }

  template <class Call>
  bool guarded(Call&& call) noexcept {
    nb::gil_scoped_acquire lock;
    try {
      call();
      return true;
    } catch (nb::python_error& e) {
      complaint_ = nb::str(e.value()).c_str();
      if (complaint_.empty()) complaint_ = nb::cast<std::string>(nb::handle(e.type()).attr("__name__"));
    } catch (const std::exception& e) {
      complaint_ = std::string("the driver's answer is no sample: ") + e.what();
    }
    return false;
  }

  nb::object driver_;
  int n_;
  std::int64_t period_;
  bool paced_;
  std::string complaint_;
};

struct PySimulatedArm {
  std::shared_ptr<const Arm> arm;
  std::shared_ptr<SimulatedArm> driver;
  SimulatedWorld world{};
};

/// Records as arrays, one row each.
nb::dict table(const std::vector<Record>& records, int n, const PipelineConfig& config) {
  const std::size_t N = records.size(), un = static_cast<std::size_t>(n);
  TouchRows touch(N, un, config);
  Output<std::int64_t> time({N}), late({N}), read({N}), step({N}), write({N});
  Output<std::uint64_t> tick({N}), tares({N});
  Output<double> position({N, un}), velocity({N, un}), effort({N, un}), model({N, un}), setpoint_q({N, un}), setpoint_dq({N, un}), setpoint_ddq({N, un}), wanted({N, un}), sent({N, un}), tare({N}), tare_std({N});
  Output<bool> has_velocity({N}), has_model({N}), commanded({N});
  Output<std::uint8_t> control({N}), limited({N}), mode({N});
  for (std::size_t i = 0; i < N; ++i) {
    const Record& r = records[i];
    touch.fill(i, r.touch);
    time.data[i] = r.raw.time_ns;
    for (std::size_t j = 0; j < un; ++j) {
      const std::size_t k = i * un + j;
      position.data[k] = r.raw.position[j];
      velocity.data[k] = r.raw.velocity[j];
      effort.data[k] = r.raw.effort[j];
      model.data[k] = r.raw.model_torque[j];
      setpoint_q.data[k] = r.setpoint.q[j];
      setpoint_dq.data[k] = r.setpoint.dq[j];
      setpoint_ddq.data[k] = r.setpoint.ddq[j];
      wanted.data[k] = r.wanted[j];
      sent.data[k] = r.sent[j];
    }
    has_velocity.data[i] = r.raw.has_velocity;
    has_model.data[i] = r.raw.has_model_torque;
    commanded.data[i] = r.commanded;
    control.data[i] = static_cast<std::uint8_t>(r.control);
    limited.data[i] = r.limited;
    mode.data[i] = static_cast<std::uint8_t>(r.mode);
    tick.data[i] = r.tick;
    tare.data[i] = r.tare;
    tare_std.data[i] = r.tare_std;
    tares.data[i] = r.tares;
    late.data[i] = r.late_ns, read.data[i] = r.read_ns, step.data[i] = r.step_ns, write.data[i] = r.write_ns;
  }
  nb::dict d;
  d["touch"] = touch.dict();
  d["tick"] = tick.array;
  d["mode"] = mode.array;
  d["time_ns"] = time.array;
  d["position"] = position.array;
  d["velocity"] = velocity.array;
  d["has_velocity"] = has_velocity.array;
  d["effort"] = effort.array;
  d["model_torque"] = model.array;
  d["has_model_torque"] = has_model.array;
  d["setpoint_q"] = setpoint_q.array;
  d["setpoint_dq"] = setpoint_dq.array;
  d["setpoint_ddq"] = setpoint_ddq.array;
  d["wanted"] = wanted.array;
  d["sent"] = sent.array;
  d["commanded"] = commanded.array;
  d["control"] = control.array;
  d["limited"] = limited.array;
  d["tare"] = tare.array;
  d["tare_std"] = tare_std.array;
  d["tares"] = tares.array;
  d["late_ns"] = late.array;
  d["read_ns"] = read.array;
  d["step_ns"] = step.array;
  d["write_ns"] = write.array;
  return d;
}

nb::dict quantiles(const Histogram& h) {
  nb::dict d;
  d["count"] = h.count();
  d["p50_ns"] = h.quantile(0.5);
  d["p99_ns"] = h.quantile(0.99);
  d["p999_ns"] = h.quantile(0.999);
  d["worst_ns"] = h.worst();
  d["bins"] = h.bins();
  return d;
}

/// The owner's side of a session; its calls come one at a time, under the interpreter's lock.
class PySession {
 public:
  PySession(const std::shared_ptr<const Arm>& arm, const nb::object& driver, const PyPipeline& pipeline, const PyController* controller, const PyLimiter* limiter,
            std::int64_t period_ns, bool simulated_time, double patience, double lease, std::size_t records, std::size_t black_box, int priority,
            bool lock_memory, int processor, double grace, std::size_t allocations)
      : n_(arm->n()), config_(pipeline.pipeline.config()) {
    std::shared_ptr<Driver> made;
    if (nb::isinstance<PySimulatedArm>(driver)) {
      made = nb::cast<PySimulatedArm&>(driver).driver;
    } else {
      made = std::make_shared<PythonDriver>(driver, n_, period_ns, !simulated_time);
    }
    std::shared_ptr<Clock> clock;
    if (simulated_time) clock = std::make_shared<SteppedClock>();
    else clock = std::make_shared<MonotonicClock>();
    LoopConfig c;
    c.pipeline = config_;
    c.patience = patience;
    c.lease = lease;
    c.records = records;
    c.black_box = black_box;
    c.allocations = reinterpret_cast<std::size_t (*)() noexcept>(allocations);  // NOLINT: a symbol's address, from ctypes
    expect((controller == nullptr) == (limiter == nullptr), "controller and limiter: give both or none");
    std::unique_ptr<JointController> law;
    if (controller != nullptr) law = std::make_unique<JointController>(*arm, controller->pd);
    auto loop = std::make_shared<ControlLoop>(arm, std::move(made), std::move(law), limiter != nullptr ? limiter->limiter : unused_limiter(), c, std::move(clock));
    if (simulated_time) loop->begin();
    session_ = std::make_unique<Session>(std::move(loop), RealtimeConfig{priority, lock_memory, processor}, grace);
  }
  ~PySession() {
    nb::gil_scoped_release release;  // the loop's thread may need the lock to end
    session_.reset();
  }

  nb::tuple start() {
    const RealtimeReport* report = nullptr;
    unlocked([&] { report = &session_->start(); });
    return nb::make_tuple(report->fifo, report->locked, report->pinned, report->complaint);
  }
  void stop() {
    unlocked([&] { session_->stop(); });
  }
  std::size_t tick(std::size_t most) {
    std::size_t done = 0;
    unlocked([&] {
      while (done < most && loop().tick()) ++done;
    });
    return done;
  }
  void enable(bool on) {
    request_.enabled = on;
    loop().request(request_);
  }
  void move_to(const Vector& q, double duration) {
    request_.position = joints(q, n_, "q");
    request_.duration = duration;
    ++request_.goal;
    loop().request(request_);
  }
  void set_gains(const Vector& kp, const Vector& kd) {
    request_.kp = joints(kp, n_, "kp");
    request_.kd = joints(kd, n_, "kd");
    ++request_.gains;
    loop().request(request_);
  }
  std::uint64_t tare() {
    ++request_.tare;
    loop().request(request_);
    return request_.tare;
  }
  nb::dict take(std::size_t most) {
    std::vector<Record> records;
    Record r;
    while (records.size() < most && loop().take(r)) records.push_back(r);
    return table(records, n_, config_);
  }
  nb::object state() {
    Record r;
    if (!loop().read_state(r) && !seen_) return nb::none();
    seen_ = true;
    return nb::make_tuple(PyTouch{r.touch, n_}, table({r}, n_, config_));
  }
  nb::dict black_box() const { return table(session_->loop().black_box(), n_, config_); }
  nb::dict statistics() const {
    const LoopStatistics& s = session_->loop().statistics();
    nb::dict d;
    d["ticks"] = s.ticks.load();
    d["samples"] = s.samples.load();
    d["missing"] = s.missing.load();
    d["refused"] = s.refused.load();
    const LostTicks lost = s.lost();
    d["lost_own"] = lost.own;
    d["lost_driver"] = lost.driver;
    d["lost_system"] = lost.system;
    d["records_dropped"] = session_->loop().dropped();
    d["allocations"] = s.allocations.load();
    d["own"] = quantiles(s.own);
    d["own_processor"] = quantiles(s.own_processor);
    d["driver"] = quantiles(s.driver);
    d["late"] = quantiles(s.late);
    return d;
  }
  const char* mode() const { return mode_names[static_cast<std::size_t>(session_->loop().mode())]; }
  ControlLoop& loop() { return session_->loop(); }
  const Session& session() const { return *session_; }

 private:
  /// Of a session that only watches.
  static SafetyLimiter unused_limiter() {
    LimiterConfig c;
    c.torque.fill(1.0), c.torque_rate.fill(1.0), c.upper.fill(1.0), c.velocity.fill(1.0), c.approach.fill(1.0), c.damping.fill(1.0);
    return SafetyLimiter(1, c);
  }

  int n_;
  PipelineConfig config_;
  std::unique_ptr<Session> session_;
  Request request_{};
  bool seen_ = false;
};

}  // namespace

void bind_session(nb::module_& m) {
  nb::class_<PySimulatedArm>(m, "SimulatedArm", "A simulated arm in C++ for Session; see palpate.SimulatedArm.")
      .def("__init__", [](PySimulatedArm* self, std::shared_ptr<const Arm> arm, double period, int substeps, bool noise, std::uint64_t seed, const Vector& position) {
        SimulatedArmConfig c{period, substeps, noise, seed, joints(position, arm->n(), "position")};
        new (self) PySimulatedArm{arm, std::make_shared<SimulatedArm>(arm, c)};
      }, nb::arg("arm"), nb::arg("period"), nb::arg("substeps"), nb::arg("noise"), nb::arg("seed"), nb::arg("position"))
      .def_prop_ro("period_ns", [](const PySimulatedArm& s) { return s.driver->period_ns(); })
      .def("hold", [](PySimulatedArm& s, const Inertia<double>& load) {
        s.world.load = load;
        s.driver->set_world(s.world);
      }, nb::arg("load"))
      .def("push", [](PySimulatedArm& s, const Vector& force) {
        expect(force.shape(0) == 3, "force: expected 3 numbers [N], base axes");
        for (std::size_t i = 0; i < 3; ++i) s.world.force[i] = force.data()[i];
        s.driver->set_world(s.world);
      }, nb::arg("force"))
      .def("truth", [](PySimulatedArm& s) {
        const SimulatedArm::Truth t = s.driver->truth();
        return nb::make_tuple(array(t.q, s.arm->n()), array(t.dq, s.arm->n()));
      });

  nb::class_<PySession>(m, "Session", "A loop with a thread of its own; see palpate.Session.")
      .def(nb::init<const std::shared_ptr<const Arm>&, const nb::object&, const PyPipeline&, const PyController*, const PyLimiter*, std::int64_t, bool, double,
                    double, std::size_t, std::size_t, int, bool, int, double, std::size_t>(),
           nb::arg("arm"), nb::arg("driver"), nb::arg("pipeline"), nb::arg("controller").none(), nb::arg("limiter").none(), nb::arg("period_ns"), nb::arg("simulated_time"),
           nb::arg("patience"), nb::arg("lease"), nb::arg("records"), nb::arg("black_box"), nb::arg("priority"), nb::arg("lock_memory"), nb::arg("processor"),
           nb::arg("grace"), nb::arg("allocations"))
      .def("start", &PySession::start, "(SCHED_FIFO, memory locked, on one processor, what was refused and why)")
      .def("stop", &PySession::stop)
      .def("tick", &PySession::tick, nb::arg("most"))
      .def("enable", &PySession::enable, nb::arg("on"))
      .def("move_to", &PySession::move_to, nb::arg("q"), nb::arg("duration"))
      .def("set_gains", &PySession::set_gains, nb::arg("kp"), nb::arg("kd"))
      .def("tare", &PySession::tare)
      .def("renew", [](PySession& s) { s.loop().renew(); })
      .def("take", &PySession::take, nb::arg("most"))
      .def("state", &PySession::state)
      .def("black_box", &PySession::black_box)
      .def("statistics", &PySession::statistics)
      .def_prop_ro("mode", &PySession::mode)
      .def_prop_ro("fault", [](const PySession& s) { return s.session().loop().fault(); })
      .def_prop_ro("left", [](const PySession& s) { return s.session().left(); })
      .def_prop_ro("switched", [](const PySession& s) { return s.session().loop().switched(); });
}

}  // namespace palpate_py
