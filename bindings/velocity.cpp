// The sender's clock, and joint velocity from positions.
#include "common.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

struct PySenderClock {
  SenderClock clock;
  int n;
};
struct PyJointVelocity {
  JointVelocity velocity;
  int n;
};

std::size_t checked(const Times& time, const Rows& position, int n) {
  const std::size_t N = time.shape(0);
  expect(position.shape(0) == N && position.shape(1) == static_cast<std::size_t>(n),
         "position: expected shape (" + std::to_string(N) + ", " + std::to_string(n) + "), got (" + std::to_string(position.shape(0)) + ", " +
             std::to_string(position.shape(1)) + ")");
  return N;
}

}  // namespace

void bind_velocity(nb::module_& m) {
  using S = SenderClockConfig;
  bind_config<S>(m, "SenderClockOptions", "What is known of a sender and of who reads it.",
                 {{"period", &S::period, "of the sender [s], more than twice stamp_std; 0: found from the data"},
                  {"stamp_std", &S::stamp_std, "jitter of the reader's time stamps [s]"},
                  {"position_std", &S::position_std, "of a position [rad]"},
                  {"acceleration", &S::acceleration, "the least that the speed is thought to change [rad/s^2]; how much it does is learnt"},
                  {"max_speed", &S::max_speed, "no joint is faster [rad/s]; a position that is further away ends what came before"}});
  nb::class_<PySenderClock>(m, "SenderClock", "When a position was measured, if its sender gives no time stamp.")
      .def("__init__", [](PySenderClock* self, int n, const S& options) { new (self) PySenderClock{SenderClock(n, options), n}; }, nb::arg("n"), nb::arg("options"))
      .def("step", [](PySenderClock& self, std::int64_t time_ns, const Vector& q) {
        const SenderStamp s = self.clock.step(time_ns, joints(q, self.n, "q"));
        return nb::make_tuple(s.time_ns, s.cycles, s.interval, s.fresh, s.status);
      }, nb::arg("time_ns"), nb::arg("q"))
      .def("run", [](PySenderClock& self, const Times& time, const Rows& position) {
        const std::size_t N = checked(time, position, self.n);
        Output<std::int64_t> stamp({N});
        Output<std::int32_t> cycles({N});
        Output<double> interval({N}), period({N});
        Output<bool> fresh({N});
        Output<std::uint8_t> status({N});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) {
            const SenderStamp s = self.clock.step(time.data()[i], row(position.data(), i, self.n));
            stamp.data[i] = s.time_ns;
            cycles.data[i] = s.cycles;
            interval.data[i] = s.interval;
            fresh.data[i] = s.fresh;
            status.data[i] = static_cast<std::uint8_t>(s.status);
            period.data[i] = self.clock.period();
          }
        });
        return nb::make_tuple(stamp.array, cycles.array, interval.array, fresh.array, status.array, period.array);
      }, nb::arg("time_ns"), nb::arg("position"))
      .def_prop_ro("period", [](const PySenderClock& self) { return self.clock.period(); })
      .def("reset", [](PySenderClock& self) { self.clock.reset(); });

  using V = JointVelocityConfig;
  bind_config<V>(m, "JointVelocityOptions", "Clock and filters of JointVelocity.",
                 {{"recover_clock", &V::recover_clock, "divide by the sender's time between measurements; False: by the time between looks"},
                  {"sender", &V::sender, "SenderClockOptions"},
                  {"average", &V::average, "mean of so many velocities, 1 to 64"},
                  {"time_constant", &V::time_constant, "of a first-order low-pass [s]; 0: none"},
                  {"lag", &V::lag, "how that is discretised: 'published' a = h/(h + tau), or 'exact'"}});
  nb::class_<PyJointVelocity>(m, "JointVelocity", "Joint velocity from positions and time stamps.")
      .def("__init__", [](PyJointVelocity* self, int n, const V& options) { new (self) PyJointVelocity{JointVelocity(n, options), n}; }, nb::arg("n"), nb::arg("options"))
      .def("step", [](PyJointVelocity& self, std::int64_t time_ns, const Vector& q) {
        const JointVector& v = self.velocity.step(time_ns, joints(q, self.n, "q"));
        return nb::make_tuple(array(v, self.n), self.velocity.status());
      }, nb::arg("time_ns"), nb::arg("q"))
      .def("run", [](PyJointVelocity& self, const Times& time, const Rows& position) {
        const std::size_t N = checked(time, position, self.n);
        const auto un = static_cast<std::size_t>(self.n);
        Output<double> v({N, un});
        Output<std::uint8_t> status({N});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) {
            const JointVector& x = self.velocity.step(time.data()[i], row(position.data(), i, self.n));
            for (std::size_t j = 0; j < un; ++j) v.data[i * un + j] = x[j];
            status.data[i] = static_cast<std::uint8_t>(self.velocity.status());
          }
        });
        return nb::make_tuple(v.array, status.array);
      }, nb::arg("time_ns"), nb::arg("position"))
      .def("reset", [](PyJointVelocity& self) { self.velocity.reset(); });
}

}  // namespace palpate_py
