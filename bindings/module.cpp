// palpate._core: the C++ core as a Python module. Shapes and types are checked here; no mathematics.
#include "common.hpp"

NB_MODULE(_core, m) {
  m.doc() = "palpate's C++ core. Use the palpate package; this module is its inside.";
  // Reference arms are cached for the life of the interpreter and hold core objects when it ends: no leak.
  nb::set_leak_warnings(false);
  m.attr("__version__") = PALPATE_VERSION;
  palpate_py::bind_arm(m);
  palpate_py::bind_pipeline(m);
  palpate_py::bind_control(m);
  palpate_py::bind_phase(m);
  palpate_py::bind_cartesian(m);
  palpate_py::bind_velocity(m);
  palpate_py::bind_session(m);
  palpate_py::bind_teleop(m);
  palpate_py::bind_fri(m);
}
