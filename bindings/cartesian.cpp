// ABAG, Cartesian velocity by force, Cartesian impedance.
#include "common.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

template <std::size_t N>
std::array<double, N> fixed(const Vector& a, const char* name) {
  expect(a.shape(0) == N, std::string(name) + ": expected " + std::to_string(N) + " numbers, got " + std::to_string(a.shape(0)));
  std::array<double, N> out{};
  std::copy(a.data(), a.data() + N, out.begin());
  return out;
}
nb::object numbers(const std::array<double, 3>& a) {
  Output<double> out({3});
  std::copy(a.begin(), a.end(), out.data);
  return out.array;
}
nb::tuple state(const Abag::State& s) { return nb::make_tuple(s.e_bar, s.b, s.g, s.u); }

struct PyCartesianVelocity {
  std::shared_ptr<const Arm> arm;
  CartesianVelocity controller;
};
struct PyCartesianImpedance {
  std::shared_ptr<const Arm> arm;
  CartesianImpedance controller;
};

}  // namespace

void bind_cartesian(nb::module_& m) {
  bind_config<AbagParameters>(m, "AbagParameters", "Rates and thresholds of an ABAG, for one step every `period`.",
                              {{"alpha", &AbagParameters::alpha, "how much of the mean sign of the error is kept per step [1]"},
                               {"theta_b", &AbagParameters::theta_b, "above this mean sign the bias adapts [1]"},
                               {"delta_b", &AbagParameters::delta_b, "by so much per step [1]"},
                               {"theta_g", &AbagParameters::theta_g, "above this mean sign the gain grows, below it shrinks [1]"},
                               {"delta_g", &AbagParameters::delta_g, "by so much per step [1]"},
                               {"period", &AbagParameters::period, "of the steps these numbers were made for [s]"},
                               {"band", &AbagParameters::band, "errors up to this count in part [unit of the error]; 0: the paper's sign"},
                               {"least_gain", &AbagParameters::least_gain, "lower end of the gain [1]; 0: the paper's"}})
      .def_static("whiteboard", &AbagParameters::whiteboard, "The whiteboard project's, 8 ms.")
      .def_static("kinova", &AbagParameters::kinova, "Those for a Kinova Gen3 at 1 kHz.")
      .def("at", &AbagParameters::at, nb::arg("period"), "The same behaviour in time with steps of another period [s].");

  nb::class_<Abag>(m, "Abag", "Adaptive bias, adaptive gain: a bounded controller that needs the sign of the error alone.")
      .def("__init__", [](Abag* self, const AbagParameters& parameters, bool negative_gain) {
        new (self) Abag(parameters, negative_gain ? AbagForm::negative_gain : AbagForm::corrected);
      }, nb::arg("parameters"), nb::arg("negative_gain"))
      .def("step", &Abag::step, nb::arg("error"))
      .def("run", [](Abag& self, const Vector& error) {
        const std::size_t N = error.shape(0);
        Output<double> out({N, 4});
        for (std::size_t i = 0; i < N; ++i) {
          self.step(error.data()[i]);
          const Abag::State& s = self.state();
          const double row[4] = {s.e_bar, s.b, s.g, s.u};
          std::copy(row, row + 4, out.data + 4 * i);
        }
        return out.array;
      }, nb::arg("error"))
      .def_prop_ro("state", [](const Abag& self) { return state(self.state()); })
      .def_prop_ro("status", &Abag::status)
      .def("reset", &Abag::reset);

  bind_config<PostureConfig>(m, "Posture", "How a redundant arm keeps away from singularities and position limits without moving its tool.",
                             {{"stiffness", &PostureConfig::stiffness, "torque per gradient of the posture's worth [N m]"},
                              {"damping", &PostureConfig::damping, "of motion that does not move the tool [N m s/rad]"},
                              {"limits", &PostureConfig::limits, "worth of the distance to position limits against that to singularities [1]"},
                              {"largest", &PostureConfig::largest, "no joint gets more than this before the projection [N m]"}});
  bind_config<VelocityErrata>(m, "VelocityErrata", "What the whiteboard project's program did wrong, for reproducing it; all False: corrected.",
                              {{"negative_gain", &VelocityErrata::negative_gain, "the ABAG gain goes down to -1"},
                               {"turned_twice", &VelocityErrata::turned_twice, "a wrench is turned by R_base_tool where its transpose belongs"},
                               {"axis_bound", &VelocityErrata::axis_bound, "each axis is bounded by max_force, together sqrt(3) of it pass"},
                               {"unsigned_speed", &VelocityErrata::unsigned_speed, "moving backwards counts as moving on"},
                               {"stop_short", &VelocityErrata::stop_short, "no speed is wanted within stop_zone of the goal"}});
  using C = CartesianVelocityConfig;
  bind_config<C>(m, "CartesianVelocityOptions", "Bounds, speed profile, ABAG parameters of CartesianVelocity.",
                 {{"axes", &C::axes, "'per_axis': an ABAG for each task axis; 'heading': one on the speed towards the goal"},
                  {"abag", &C::abag, "AbagParameters of the velocity"},
                  {"abag_turning", &C::abag_turning, "AbagParameters of the angular velocity"},
                  {"max_force", &C::max_force, "the norm of the commanded force never exceeds it [N]"},
                  {"max_torque", &C::max_torque, "the norm of the commanded torque never exceeds it [N m]"},
                  {"slow_speed", &C::slow_speed, "within slow_zone of the goal [m/s]"},
                  {"slow_zone", &C::slow_zone, "[m]; 0: none"},
                  {"stop_zone", &C::stop_zone, "for VelocityErrata(stop_short=True) [m]"},
                  {"approach", &C::approach, "speed per distance close to the goal [1/s]"},
                  {"arrived", &C::arrived, "the goal is reached within this distance [m]"},
                  {"turning", &C::turning, "angular velocity per orientation error [1/s]"},
                  {"max_turning", &C::max_turning, "[rad/s]"},
                  {"touch_speed", &C::touch_speed, "towards a surface not yet felt [m/s]"},
                  {"force_p", &C::force_p, "of the normal force's error [1]"},
                  {"force_i", &C::force_i, "of its integral [1/s]"},
                  {"decoupled", &C::decoupled, "while pressing, what moves the tool in the plane neither presses nor tips it"},
                  {"yield_force", &C::yield_force, "a push beyond this makes the arm yield [N]; infinity: never"},
                  {"yield_time", &C::yield_time, "after a push, until the task goes on [s]"},
                  {"free_speed", &C::free_speed, "the brake acts beyond this, and beyond 1.5 times the wanted speed [m/s]"},
                  {"free_turning", &C::free_turning, "[rad/s]"},
                  {"brake", &C::brake, "force against the speed beyond [N s/m]; 0: none"},
                  {"brake_turning", &C::brake_turning, "torque against the turning beyond [N m s/rad]"},
                  {"posture", &C::posture, "Posture"},
                  {"errata", &C::errata, "VelocityErrata"}})
      .def_static("published", [](const std::string& axes) {
        expect(axes == "heading" || axes == "per_axis", "axes '" + axes + "'; choose from heading, per_axis");
        return C::published(axes == "heading" ? VelocityAxes::heading : VelocityAxes::per_axis);
      }, nb::arg("axes"), "The whiteboard project's program as it was.");

  nb::class_<PyCartesianVelocity>(m, "CartesianVelocity", "The tool moves at a wanted velocity by forces that never exceed a bound.")
      .def("__init__", [](PyCartesianVelocity* self, std::shared_ptr<const Arm> arm, double period, const C& options) {
        new (self) PyCartesianVelocity{arm, CartesianVelocity(*arm, period, options)};
      }, nb::arg("arm"), nb::arg("period"), nb::arg("options"))
      .def("step", [](PyCartesianVelocity& self, const Vector& position, const Vector& orientation, double speed, const Vector& velocity, const Vector& axes,
                      double normal_force, const Vector& q, const Vector& dq, const std::optional<Vector>& force, const Inertia<double>& load) {
        const int n = self.arm->n();
        const CartesianTarget target{fixed<3>(position, "position"), fixed<9>(orientation, "orientation"), speed, fixed<3>(velocity, "velocity"),
                                     fixed<9>(axes, "axes"), normal_force};
        Wrench external;
        if (force) {
          external.force = fixed<3>(*force, "force");
          external.status = Status::ok;
        }
        const CartesianCommand c = self.controller.step(target, joints(q, n, "q"), joints(dq, n, "dq"), external, load);
        return nb::make_tuple(array(c.joints.torque, n), c.joints.status, numbers(c.force), numbers(c.torque), numbers(c.brake), numbers(c.velocity), numbers(c.wanted),
                              c.distance, c.contact_force, c.arrived, c.yielding);
      }, nb::arg("position"), nb::arg("orientation"), nb::arg("speed"), nb::arg("velocity"), nb::arg("axes"), nb::arg("normal_force"), nb::arg("q"),
           nb::arg("dq"), nb::arg("force").none(), nb::arg("load"),
           "Returns (joint torque, status, force, torque, brake, velocity, wanted velocity, distance, contact force, arrived, yielding).")
      .def("run", [](PyCartesianVelocity& self, const Vector& position, const Vector& orientation, double speed, double normal_force, const Rows& q, const Rows& dq,
                     const Rows& force) {
        const int n = self.arm->n();
        const std::size_t N = q.shape(0);
        expect(q.shape(1) == static_cast<std::size_t>(n) && dq.shape(0) == N && dq.shape(1) == q.shape(1) && force.shape(0) == N && force.shape(1) == 3,
               "expected q and dq (N, " + std::to_string(n) + ") and force (N, 3)");
        CartesianTarget target{fixed<3>(position, "position"), fixed<9>(orientation, "orientation"), speed};
        target.normal_force = normal_force;
        Output<double> torque({N, static_cast<std::size_t>(n)}), wrench({N, 6});
        unlocked([&] {
          Wrench external;
          external.status = Status::ok;
          for (std::size_t i = 0; i < N; ++i) {
            for (std::size_t k = 0; k < 3; ++k) external.force[k] = force.data()[3 * i + k];
            const CartesianCommand c = self.controller.step(target, row(q.data(), i, n), row(dq.data(), i, n), external);
            for (std::size_t j = 0; j < static_cast<std::size_t>(n); ++j) torque.data[i * static_cast<std::size_t>(n) + j] = c.joints.torque[j];
            for (std::size_t k = 0; k < 3; ++k) {
              wrench.data[6 * i + k] = c.force[k];
              wrench.data[6 * i + 3 + k] = c.torque[k];
            }
          }
        });
        return nb::make_tuple(torque.array, wrench.array);
      }, nb::arg("position"), nb::arg("orientation"), nb::arg("speed"), nb::arg("normal_force"), nb::arg("q"), nb::arg("dq"), nb::arg("force"),
           "One step per row. Returns (joint torque (N, n), force and torque (N, 6)).")
      .def("abag", [](const PyCartesianVelocity& self) {
        return nb::make_tuple(state(self.controller.abag(0)), state(self.controller.abag(1)), state(self.controller.abag(2)));
      }, "(e_bar, b, g, u) of the three task axes; in mode 'heading' the first is the one in use.")
      .def("reset", [](PyCartesianVelocity& self) { self.controller.reset(); });

  using I = CartesianImpedanceConfig;
  bind_config<I>(m, "CartesianImpedanceOptions", "Spring and damper of CartesianImpedance.",
                 {{"stiffness", &I::stiffness, "along base axes [N/m]"},
                  {"turning_stiffness", &I::turning_stiffness, "about base axes [N m/rad]"},
                  {"damping_ratio", &I::damping_ratio, "[1]"},
                  {"mass", &I::mass, "that the damping is made for [kg]"},
                  {"inertia", &I::inertia, "and for turning [kg m^2]"},
                  {"posture", &I::posture, "Posture"}});
  nb::class_<PyCartesianImpedance>(m, "CartesianImpedance", "A virtual spring and damper at the tool.")
      .def("__init__", [](PyCartesianImpedance* self, std::shared_ptr<const Arm> arm, const I& options) {
        new (self) PyCartesianImpedance{arm, CartesianImpedance(*arm, options)};
      }, nb::arg("arm"), nb::arg("options"))
      .def("step", [](PyCartesianImpedance& self, const Vector& position, const Vector& orientation, const Vector& force, const Vector& q, const Vector& dq,
                      const Inertia<double>& load) {
        const int n = self.arm->n();
        const auto c = self.controller.step(fixed<3>(position, "position"), fixed<9>(orientation, "orientation"), fixed<3>(force, "force"), joints(q, n, "q"),
                                            joints(dq, n, "dq"), load);
        return nb::make_tuple(array(c.joints.torque, n), c.joints.status, numbers(c.force), numbers(c.torque));
      }, nb::arg("position"), nb::arg("orientation"), nb::arg("force"), nb::arg("q"), nb::arg("dq"), nb::arg("load"),
           "Returns (joint torque, status, force, torque).")
      .def("reset", [](PyCartesianImpedance& self) { self.controller.reset(); });
}

}  // namespace palpate_py
