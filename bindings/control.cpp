// Trajectories, the controller and the safety limiter.
#include "common.hpp"
#include "objects.hpp"

#include "palpate/trajectory.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

struct PyQuintic {
  Quintic quintic;
  int n;
};

nb::tuple setpoint(const Setpoint& s, int n) { return nb::make_tuple(array(s.q, n), array(s.dq, n), array(s.ddq, n)); }

}  // namespace

void bind_control(nb::module_& m) {
  nb::class_<PyQuintic>(m, "Quintic", "Joint motion from rest to rest by a fifth-degree polynomial (R section 4).")
      .def("__init__", [](PyQuintic* self, const Vector& start, const Vector& goal, double duration) {
        const int n = static_cast<int>(start.shape(0));
        expect(n >= 1 && n <= max_joints, "Quintic: 1 to 16 joints");
        new (self) PyQuintic{Quintic(n, joints(start, n, "start"), joints(goal, n, "goal"), duration), n};
      }, nb::arg("start"), nb::arg("goal"), nb::arg("duration"))
      .def("sample", [](const PyQuintic& self, double t) { return setpoint(self.quintic.sample(t), self.n); }, nb::arg("t"), "(q, dq, ddq) at t [s].");

  nb::class_<PyController>(m, "FeedforwardPd", "u = sat(u_ff + Kp (q_d - q) + Kd (dq_d - dq)), u_ff the torque the arm needs, with its load.")
      .def("__init__", [](PyController* self, std::shared_ptr<const Arm> arm, const Vector& kp, const Vector& kd, const Vector& limit, const std::string& feedforward) {
        const int n = arm->n();
        expect(feedforward == "reference_gravity" || feedforward == "gravity" || feedforward == "inverse_dynamics",
               "feedforward '" + feedforward + "'; choose from reference_gravity, gravity, inverse_dynamics");
        const Feedforward mode = feedforward == "gravity" ? Feedforward::gravity : feedforward == "inverse_dynamics" ? Feedforward::inverse_dynamics : Feedforward::reference_gravity;
        new (self) PyController{arm, FeedforwardPd(*arm, {joints(kp, n, "kp"), joints(kd, n, "kd"), joints(limit, n, "limit")}, mode)};
      }, nb::arg("arm"), nb::arg("kp"), nb::arg("kd"), nb::arg("limit"), nb::arg("feedforward"))
      .def("step", [](PyController& self, const Vector& q_d, const Vector& dq_d, const Vector& ddq_d, const Vector& q, const Vector& dq, const Inertia<double>& load) {
        const int n = self.arm->n();
        const Setpoint target{joints(q_d, n, "q_d"), joints(dq_d, n, "dq_d"), joints(ddq_d, n, "ddq_d")};
        const JointCommand command = self.pd.step(target, joints(q, n, "q"), joints(dq, n, "dq"), load, 0);
        return nb::make_tuple(array(command.torque, n), command.status);
      }, nb::arg("q_d"), nb::arg("dq_d"), nb::arg("ddq_d"), nb::arg("q"), nb::arg("dq"), nb::arg("load"), "Returns (torque [N m], status).");

  nb::class_<PyLimiter>(m, "SafetyLimiter", "The last thing a command passes before the driver: torque, rate, position and velocity limits, faults.")
      .def("__init__", [](PyLimiter* self, const Vector& torque, const Vector& torque_rate, const Vector& lower, const Vector& upper, const Vector& velocity,
                          const Vector& approach, const Vector& damping) {
        const int n = static_cast<int>(torque.shape(0));
        expect(n >= 1 && n <= max_joints, "SafetyLimiter: 1 to 16 joints");
        LimiterConfig c;
        c.torque = joints(torque, n, "torque");
        c.torque_rate = joints(torque_rate, n, "torque_rate");
        c.lower = joints(lower, n, "lower");
        c.upper = joints(upper, n, "upper");
        c.velocity = joints(velocity, n, "velocity");
        c.approach = joints(approach, n, "approach");
        c.damping = joints(damping, n, "damping");
        new (self) PyLimiter{SafetyLimiter(n, c), n};
      }, nb::arg("torque"), nb::arg("torque_rate"), nb::arg("lower"), nb::arg("upper"), nb::arg("velocity"), nb::arg("approach"), nb::arg("damping"))
      .def("step", [](PyLimiter& self, const Vector& torque, const Vector& q, const Vector& dq, const Vector& gravity, double dt) {
        JointCommand command;
        command.torque = joints(torque, self.n, "torque");
        const LimitedCommand out = self.limiter.step(command, joints(q, self.n, "q"), joints(dq, self.n, "dq"), joints(gravity, self.n, "gravity"), dt);
        return nb::make_tuple(array(out.command.torque, self.n), out.command.status, static_cast<int>(out.limited));
      }, nb::arg("torque"), nb::arg("q"), nb::arg("dq"), nb::arg("gravity"), nb::arg("dt"), "Returns (torque [N m], status, bits of what limited it).")
      .def("reset", [](PyLimiter& self, const Vector& torque) { self.limiter.reset(joints(torque, self.n, "torque")); }, nb::arg("torque"));
}

}  // namespace palpate_py
