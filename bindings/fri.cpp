// KUKA's Fast Robot Interface: messages and the link that answers in time.
#include "common.hpp"

#include <cstring>
#include <nanobind/stl/pair.h>

#include "palpate/session/fri_link.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

nb::object values(const fri::Values& v) { return array(v.value, std::min(v.count, max_joints)); }

std::span<const double> span(const std::optional<Vector>& v, std::size_t n, const char* name) {
  if (!v) return {};
  expect(v->shape(0) == n, std::string(name) + ": expected " + std::to_string(n) + " numbers, got " + std::to_string(v->shape(0)));
  return {v->data(), n};
}

/// An OSError with its number and words, as Python's own sockets raise it.
[[noreturn]] void raise(const std::system_error& e) {
  nb::object error = nb::module_::import_("builtins").attr("OSError")(e.code().value(), e.code().message());
  PyErr_SetObject(reinterpret_cast<PyObject*>(Py_TYPE(error.ptr())), error.ptr());
  throw nb::python_error();
}

struct PyLink {
  PyLink(int joints, std::int64_t period_ns, std::int64_t deadline_ns)
      : n(static_cast<std::size_t>(check::in_range("FriLink joints", joints, 1, max_joints))), link(joints, period_ns, deadline_ns) {}
  std::size_t n;
  fri::Link link;
};

}  // namespace

void bind_fri(nb::module_& m) {
  using fri::Monitoring;
  nb::class_<Monitoring>(m, "FriMonitoring", "What the controller tells in a cycle; codes as in the messages.")
      .def_ro("sequence", &Monitoring::sequence)
      .def_prop_ro("time_ns", &Monitoring::time_ns)
      .def_prop_ro("position", [](const Monitoring& v) { return values(v.position); }, "measured [rad]")
      .def_prop_ro("torque", [](const Monitoring& v) { return values(v.torque); }, "measured [N m]")
      .def_prop_ro("external", [](const Monitoring& v) { return values(v.external); }, "the controller's estimate [N m]")
      .def_prop_ro("interpolated", [](const Monitoring& v) { return values(v.interpolated); }, "position of the robot program's motion [rad]")
      .def_prop_ro("drive_state", [](const Monitoring& v) {
        return std::vector<int>(v.drive_state.begin(), v.drive_state.begin() + std::min(v.drives, max_joints));
      })
      .def_ro("safety_state", &Monitoring::safety_state)
      .def_ro("control_mode", &Monitoring::control_mode)
      .def_ro("session_state", &Monitoring::session_state)
      .def_ro("quality", &Monitoring::quality)
      .def_ro("send_period", &Monitoring::send_period, "[ms]")
      .def_ro("receive_multiplier", &Monitoring::receive_multiplier)
      .def_ro("command_mode", &Monitoring::command_mode);

  m.def("fri_decode", [](const nb::bytes& data) -> std::optional<Monitoring> {
    Monitoring out;
    if (!fri::decode({static_cast<const std::uint8_t*>(data.data()), data.size()}, out)) return std::nullopt;
    return out;
  }, nb::arg("data"), "The monitoring message in these bytes; None: they are none.");
  m.def("fri_encode", [](std::uint32_t sequence, std::uint32_t reflected, const std::optional<Vector>& position, const std::optional<Vector>& torque,
                         const std::optional<Vector>& wrench) {
    const auto some = [](const std::optional<Vector>& v) { return span(v, v ? std::min<std::size_t>(v->shape(0), max_joints) : 0, "values"); };
    std::array<std::uint8_t, fri::max_bytes> out;
    const std::size_t size = fri::encode({sequence, reflected, some(position), some(torque), some(wrench)}, out);
    return nb::bytes(out.data(), size);
  }, nb::arg("sequence"), nb::arg("reflected"), nb::arg("position") = nb::none(), nb::arg("torque") = nb::none(), nb::arg("wrench") = nb::none(),
        "The bytes of a client's answer.");

  nb::class_<PyLink>(m, "FriLink", "The client's end of an FRI session, with a thread that answers in time; see palpate.drivers.fri.")
      .def(nb::init<int, std::int64_t, std::int64_t>(), nb::arg("joints"), nb::arg("period_ns"), nb::arg("deadline_ns"))
      .def("open", [](PyLink& self, const std::string& address, std::uint16_t port, const std::string& controller) {
        try {
          self.link.open(address, port, controller);
        } catch (const std::system_error& e) {
          raise(e);
        }
      }, nb::arg("address"), nb::arg("port"), nb::arg("controller"), "Raises OSError.")
      .def("close", [](PyLink& self) { unlocked([&] { self.link.close(); }); })
      .def("receive", [](PyLink& self, std::int64_t timeout_ns) -> std::optional<std::pair<Monitoring, std::int64_t>> {
        std::pair<Monitoring, std::int64_t> out;
        bool found = false;
        unlocked([&] { found = self.link.receive(out.first, out.second, timeout_ns); });
        if (!found) return std::nullopt;
        return out;
      }, nb::arg("timeout_ns"), "(newest message not seen yet, when it came [ns, monotonic]); None: none in this time.")
      .def("answer", [](PyLink& self, const std::optional<Vector>& position, const std::optional<Vector>& torque, const std::optional<Vector>& wrench) {
        try {
          return self.link.answer(span(position, self.n, "position"), span(torque, self.n, "torque"), span(wrench, 6, "wrench"));
        } catch (const std::system_error& e) {
          raise(e);
        }
      }, nb::arg("position").none(), nb::arg("torque").none(), nb::arg("wrench").none(),
           "Answers the message taken last; all None: what changes nothing. False: it was answered, or wants no answer. Raises OSError.")
      .def("due", [](PyLink& self) { return self.link.due(); })
      .def("expect", [](PyLink& self, bool commands) { self.link.expect(commands); }, nb::arg("commands"))
      .def("counts", [](PyLink& self) {
        const fri::LinkCounts c = self.link.counts();
        return nb::make_tuple(c.lost, c.refused, c.late);
      }, "(lost, refused, late)")
      .def("peer", [](PyLink& self) { return self.link.peer(); });
}

}  // namespace palpate_py
