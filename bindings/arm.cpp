// The arm and its dynamics, over one state or rows of states.
#include "common.hpp"

using namespace palpate;

namespace palpate_py {
namespace {

Placement placement(const double* T) {
  Placement out;
  for (std::size_t i = 0; i < 3; ++i) {
    for (std::size_t k = 0; k < 3; ++k) out.R[3 * i + k] = T[4 * i + k];
    out.p[i] = T[4 * i + 3];
  }
  return out;
}

std::shared_ptr<Arm> make_arm(int n, const Stack& T, const Rows& axis, const Flags& prismatic, const Vector& mass, const Rows& com,
                              const Stack& inertia, const Vector& rotor, const Rows& friction, const Rows& limits, const Rows& sensing,
                              const Vector& gain, const Vector& gravity, const Rows& tip, const Vector& grasp) {
  const auto rows = static_cast<std::size_t>(n);
  expect(n >= 1 && n <= max_joints, "an arm has 1 to 16 joints, got " + std::to_string(n));
  expect(T.shape(0) == rows && T.shape(1) == 4 && T.shape(2) == 4, "T_parent_joint: expected shape (n, 4, 4)");
  expect(axis.shape(0) == rows && axis.shape(1) == 3, "axis: expected shape (n, 3)");
  expect(com.shape(0) == rows && com.shape(1) == 3, "com: expected shape (n, 3)");
  expect(inertia.shape(0) == rows && inertia.shape(1) == 3 && inertia.shape(2) == 3, "inertia: expected shape (n, 3, 3)");
  expect(friction.shape(0) == rows && friction.shape(1) == 8, "friction: expected shape (n, 8)");
  expect(limits.shape(0) == rows && limits.shape(1) == 4, "limits: expected shape (n, 4)");
  expect(sensing.shape(0) == rows && sensing.shape(1) == 6, "sensing: expected shape (n, 6)");
  expect(prismatic.shape(0) == rows && mass.shape(0) == rows && rotor.shape(0) == rows && gain.shape(0) == rows, "expected one number per joint");
  expect(gravity.shape(0) == 3 && grasp.shape(0) == 3, "gravity, grasp: expected three numbers");
  expect(tip.shape(0) == 4 && tip.shape(1) == 4, "T_last_tip: expected shape (4, 4)");
  ArmDescription d;
  d.n = n;
  for (std::size_t j = 0; j < rows; ++j) {
    JointDescription& J = d.joints[j];
    J.prismatic = prismatic.data()[j];
    J.T_parent_joint = placement(T.data() + 16 * j);
    for (std::size_t i = 0; i < 3; ++i) {
      J.axis[i] = axis.data()[3 * j + i];
      J.com[i] = com.data()[3 * j + i];
    }
    J.mass = mass.data()[j];
    const double* I = inertia.data() + 9 * j;
    J.inertia = {I[0], I[1], I[2], I[4], I[5], I[8]};
    J.rotor_inertia = rotor.data()[j];
    const double* f = friction.data() + 8 * j;
    J.friction = {f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7]};
    const double* l = limits.data() + 4 * j;
    J.lower = l[0], J.upper = l[1], J.max_velocity = l[2], J.max_effort = l[3];
    const double* s = sensing.data() + 6 * j;
    J.position_resolution = s[0], J.position_std = s[1], J.velocity_std = s[2], J.torque_resolution = s[3], J.torque_std = s[4], J.torque_gain_std = s[5];
    J.effort_gain = gain.data()[j];
  }
  for (std::size_t i = 0; i < 3; ++i) {
    d.gravity[i] = gravity.data()[i];
    d.grasp[i] = grasp.data()[i];
  }
  d.T_last_tip = placement(tip.data());
  return std::make_shared<Arm>(d);
}

std::size_t check_rows(const Arm& arm, const Rows& a, const char* name, std::size_t count) {
  expect(a.shape(1) == static_cast<std::size_t>(arm.n()), std::string(name) + ": expected rows of " + std::to_string(arm.n()) + " joints, got " + std::to_string(a.shape(1)));
  expect(count == 0 || a.shape(0) == count, std::string(name) + ": expected " + std::to_string(count) + " rows, got " + std::to_string(a.shape(0)));
  return a.shape(0);
}

void put(double* to, std::size_t i, const JointVector& v, int n) {
  for (std::size_t j = 0; j < static_cast<std::size_t>(n); ++j) to[i * static_cast<std::size_t>(n) + j] = v[j];
}

/// The point in the last body's axes: `point` [m] in the tip frame.
Vec3<double> tip_point(const Arm& arm, const Vector& point) {
  expect(point.shape(0) == 3, "point: expected three numbers [m] in the tip frame");
  return arm.p_last_tip() + arm.R_last_tip() * Vec3<double>{point.data()[0], point.data()[1], point.data()[2]};
}

}  // namespace

void bind_arm(nb::module_& m) {
  nb::enum_<Status>(m, "Status", nb::is_arithmetic(), "What may be believed of a sample or an estimate; only ok means: use this number.")
      .value("ok", Status::ok)
      .value("warming", Status::warming)
      .value("held", Status::held)
      .value("gap", Status::gap)
      .value("non_finite", Status::non_finite)
      .value("saturated", Status::saturated)
      .value("singular", Status::singular)
      .value("time_error", Status::time_error);

  nb::class_<Inertia<double>>(m, "Load", "A rigid body on the last link, about the last joint's frame: what the arm holds.")
      .def("__init__", [](Inertia<double>* self, double mass) { new (self) Inertia<double>{}; expect(mass == 0.0, "Load() takes 0; use Arm.load() for a body"); }, nb::arg("mass") = 0.0)
      .def_prop_ro("mass", [](const Inertia<double>& I) { return I.m; });

  nb::class_<Arm>(m, "Arm", "Checked, immutable figures of an arm.")
      .def(nb::new_(&make_arm), nb::arg("n"), nb::arg("T_parent_joint"), nb::arg("axis"), nb::arg("prismatic"), nb::arg("mass"), nb::arg("com"),
           nb::arg("inertia"), nb::arg("rotor_inertia"), nb::arg("friction"), nb::arg("limits"), nb::arg("sensing"), nb::arg("effort_gain"),
           nb::arg("gravity"), nb::arg("T_last_tip"), nb::arg("grasp"))
      .def_prop_ro("n", &Arm::n)
      .def_prop_ro("has_dynamics", &Arm::has_dynamics)
      .def("inverse_dynamics", [](const Arm& arm, const Rows& q, const Rows& dq, const Rows& ddq) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        check_rows(arm, dq, "dq", N), check_rows(arm, ddq, "ddq", N);
        const int n = arm.n();
        Output<double> out({N, static_cast<std::size_t>(n)});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) put(out.data, i, inverse_dynamics<double>(arm, row(q.data(), i, n), row(dq.data(), i, n), row(ddq.data(), i, n)), n);
        });
        return out.array;
      }, nb::arg("q"), nb::arg("dq"), nb::arg("ddq"))
      .def("forward_dynamics", [](const Arm& arm, const Rows& q, const Rows& dq, const Rows& tau) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        check_rows(arm, dq, "dq", N), check_rows(arm, tau, "tau", N);
        const int n = arm.n();
        Output<double> out({N, static_cast<std::size_t>(n)});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) put(out.data, i, forward_dynamics<double>(arm, row(q.data(), i, n), row(dq.data(), i, n), row(tau.data(), i, n)), n);
        });
        return out.array;
      }, nb::arg("q"), nb::arg("dq"), nb::arg("tau"))
      .def("mass_matrix", [](const Arm& arm, const Rows& q) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        const int n = arm.n();
        const auto un = static_cast<std::size_t>(n);
        Output<double> out({N, un, un});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) {
            const JointMatrix M = mass_matrix<double>(arm, row(q.data(), i, n));
            for (int r = 0; r < n; ++r)
              for (int c = 0; c < n; ++c) out.data[(i * un + static_cast<std::size_t>(r)) * un + static_cast<std::size_t>(c)] = M(r, c);
          }
        });
        return out.array;
      }, nb::arg("q"))
      .def("momentum_terms", [](const Arm& arm, const Rows& q, const Rows& dq) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        check_rows(arm, dq, "dq", N);
        const int n = arm.n();
        Output<double> p({N, static_cast<std::size_t>(n)}), c({N, static_cast<std::size_t>(n)}), g({N, static_cast<std::size_t>(n)});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) {
            const MomentumTerms<double> t = momentum_terms<double>(arm, row(q.data(), i, n), row(dq.data(), i, n));
            put(p.data, i, t.p, n), put(c.data, i, t.Ct_dq, n), put(g.data, i, t.g, n);
          }
        });
        return nb::make_tuple(p.array, c.array, g.array);
      }, nb::arg("q"), nb::arg("dq"))
      .def("friction_torque", [](const Arm& arm, const Rows& dq) {
        const std::size_t N = check_rows(arm, dq, "dq", 0);
        const int n = arm.n();
        Output<double> out({N, static_cast<std::size_t>(n)});
        for (std::size_t i = 0; i < N; ++i) put(out.data, i, arm.friction_torque(row(dq.data(), i, n)), n);
        return out.array;
      }, nb::arg("dq"))
      .def("jacobian", [](const Arm& arm, const Rows& q, const Vector& point) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        const int n = arm.n();
        const auto un = static_cast<std::size_t>(n);
        const Vec3<double> local = tip_point(arm, point);
        Output<double> out({N, 6, un});
        for (std::size_t i = 0; i < N; ++i) {
          const Pose<double> P = forward_kinematics<double>(arm, row(q.data(), i, n));
          const Vec3<double> x = P.p + P.R * local;
          for (int j = 0; j < n; ++j) {
            const auto uj = static_cast<std::size_t>(j);
            const Vec3<double> v = jacobian_column(arm, P, j, x);
            const Vec3<double> w = arm.body(j).prismatic ? Vec3<double>{} : P.axis[uj];
            const double column[6] = {v.x, v.y, v.z, w.x, w.y, w.z};
            for (std::size_t r = 0; r < 6; ++r) out.data[(i * 6 + r) * un + uj] = column[r];
          }
        }
        return out.array;
      }, nb::arg("q"), nb::arg("point"), "Geometric Jacobian (N, 6, n) at a point [m] of the tip frame: rows vx vy vz wx wy wz, base axes.")
      .def("forward_kinematics", [](const Arm& arm, const Rows& q) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        Output<double> out({N, 4, 4});
        for (std::size_t i = 0; i < N; ++i) {
          const Pose<double> P = forward_kinematics<double>(arm, row(q.data(), i, arm.n()));
          const Mat3<double> R = P.R * arm.R_last_tip();
          const Vec3<double> p = P.p + P.R * arm.p_last_tip();
          const double T[16] = {R.cx.x, R.cy.x, R.cz.x, p.x, R.cx.y, R.cy.y, R.cz.y, p.y, R.cx.z, R.cy.z, R.cz.z, p.z, 0, 0, 0, 1};
          std::copy(T, T + 16, out.data + 16 * i);
        }
        return out.array;
      }, nb::arg("q"))
      .def("regressor", [](const Arm& arm, const Rows& q, const Rows& dq, const Rows& ddq) {
        const std::size_t N = check_rows(arm, q, "q", 0);
        check_rows(arm, dq, "dq", N), check_rows(arm, ddq, "ddq", N);
        const int n = arm.n();
        const auto un = static_cast<std::size_t>(n);
        Output<double> out({N, un, 10 * un});
        unlocked([&] {
          for (std::size_t i = 0; i < N; ++i) regressor(arm, row(q.data(), i, n), row(dq.data(), i, n), row(ddq.data(), i, n), out.data + i * un * 10 * un);
        });
        return out.array;
      }, nb::arg("q"), nb::arg("dq"), nb::arg("ddq"))
      .def("load", [](const Arm& arm, double mass, const Vector& point) {
        expect(std::isfinite(mass) && mass >= 0.0, "load: mass must be finite and not negative [kg]");
        return about_origin(mass, tip_point(arm, point), Sym3<double>{});
      }, nb::arg("mass"), nb::arg("point"), "A point mass [kg] at a point [m] of the tip frame.");
}

}  // namespace palpate_py
