// Torque from phase currents.
#include "common.hpp"

#include "palpate/phase_currents.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

using OptionalRows = std::optional<Rows>;

/// One PhaseTorque per joint, behind the calibration of its sensors.
struct PyPhaseCurrents {
  std::vector<PhaseTorque> drives;
  std::vector<PhaseCalibration> sensors;
  std::optional<std::int64_t> last_ns;
};

const double* column(const Vector& v, std::size_t n, const char* name) {
  expect(v.shape(0) == n, std::string(name) + ": expected " + std::to_string(n) + " numbers, got " + std::to_string(v.shape(0)));
  return v.data();
}
const double* table(const Rows& r, std::size_t N, std::size_t n, const char* name) {
  expect(r.shape(0) == N && r.shape(1) == n, std::string(name) + ": expected shape (" + std::to_string(N) + ", " + std::to_string(n) + "), got (" +
                                                 std::to_string(r.shape(0)) + ", " + std::to_string(r.shape(1)) + ")");
  return r.data();
}
const double* table(const OptionalRows& r, std::size_t N, std::size_t n, const char* name) { return r ? table(*r, N, n, name) : nullptr; }

nb::dict run(PyPhaseCurrents& p, const Times& time, const Rows& phase_a, const Rows& phase_b, const OptionalRows& position,
             const OptionalRows& controller, const OptionalRows& model) {
  const std::size_t N = time.shape(0), n = p.drives.size();
  const double *a = table(phase_a, N, n, "phase_a"), *b = table(phase_b, N, n, "phase_b"), *q = table(position, N, n, "position");
  const double *i = table(controller, N, n, "controller_current"), *tau = table(model, N, n, "model_torque");
  Output<double> torque({N, n}), current({N, n}), probability({N, n});
  Output<std::uint8_t> source({N, n}), status({N, n});
  unlocked([&] {
    const double unknown = std::numeric_limits<double>::quiet_NaN();
    for (std::size_t k = 0; k < N; ++k) {
      const std::int64_t now = time.data()[k];
      const double dt = p.last_ns ? static_cast<double>(now - *p.last_ns) * 1e-9 : 0.0;
      if (dt >= 0.0) p.last_ns = now;
      for (std::size_t j = 0; j < n; ++j) {
        const std::size_t at = k * n + j;
        const std::array<double, 2> true_current = p.sensors[j].apply(a[at], b[at]);
        const auto out = p.drives[j].step(true_current[0], true_current[1], dt,
                                          {q != nullptr ? q[at] : unknown, i != nullptr ? i[at] : unknown, tau != nullptr ? tau[at] : unknown});
        torque.data[at] = out.torque;
        current.data[at] = out.current;
        probability.data[at] = out.sign_probability;
        source.data[at] = static_cast<std::uint8_t>(out.source);
        status.data[at] = static_cast<std::uint8_t>(out.status);
      }
    }
  });
  nb::dict d;
  d["torque"] = torque.array;
  d["current"] = current.array;
  d["sign_probability"] = probability.array;
  d["source"] = source.array;
  d["status"] = status.array;
  return d;
}

}  // namespace

void bind_phase(nb::module_& m) {
  nb::class_<PyPhaseCurrents>(m, "PhaseCurrents", "tau = k_t G I with sign from two phase currents per joint; see palpate.PhaseCurrents.")
      .def("__init__", [](PyPhaseCurrents* self, const Vector& k_t, const Vector& gear, const Vector& pole_pairs, const Vector& angle_offset, const Rows& offset,
                          const Rows& gain, const Vector& amplitude_std, double direct_share, double current_rate, double settle_time, double flip_rate, const Vector& model_std, double model_time, bool published) {
        const std::size_t n = k_t.shape(0);
        expect(n >= 1 && n <= static_cast<std::size_t>(max_joints), "PhaseCurrents: 1 to 16 joints");
        const double *G = column(gear, n, "gear"), *poles = column(pole_pairs, n, "pole_pairs"), *angle = column(angle_offset, n, "angle_offset");
        const double *noise = column(amplitude_std, n, "amplitude_std"), *model = column(model_std, n, "model_std");
        const double *zero = table(offset, n, 2, "offset"), *scale = table(gain, n, 2, "gain");
        PyPhaseCurrents out;
        for (std::size_t j = 0; j < n; ++j) {
          out.drives.emplace_back(PhaseCurrentConfig{.torque_constant = k_t.data()[j], .gear = G[j], .pole_pairs = static_cast<int>(poles[j]),
                                                     .angle_offset = angle[j], .amplitude_std = noise[j],
                                                     .direct_share = direct_share, .current_rate = current_rate, .settle_time = settle_time, .flip_rate = flip_rate,
                                                     .model_std = model[j], .model_time = model_time, .published = published});
          PhaseCalibration sensor;
          sensor.offset = {zero[2 * j], zero[2 * j + 1]};
          sensor.gain = {scale[2 * j], scale[2 * j + 1]};
          out.sensors.push_back(sensor);
        }
        new (self) PyPhaseCurrents(std::move(out));
      }, nb::kw_only(), nb::arg("k_t"), nb::arg("gear"), nb::arg("pole_pairs"), nb::arg("angle_offset"), nb::arg("offset"), nb::arg("gain"), nb::arg("amplitude_std"),
           nb::arg("direct_share"), nb::arg("current_rate"), nb::arg("settle_time"), nb::arg("flip_rate"), nb::arg("model_std"), nb::arg("model_time"), nb::arg("published"))
      .def("run", &run, nb::arg("time_ns"), nb::arg("phase_a"), nb::arg("phase_b"), nb::arg("position").none() = nb::none(),
           nb::arg("controller_current").none() = nb::none(), nb::arg("model_torque").none() = nb::none(), "Rows of all joints; continues from the rows before.")
      .def("reset", [](PyPhaseCurrents& self) {
        for (PhaseTorque& drive : self.drives) drive.reset();
        self.last_ns.reset();
      });
}

}  // namespace palpate_py
