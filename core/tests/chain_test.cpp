// The recursions against each other: every quantity is computed in two independent ways.
// (Pinocchio and MuJoCo are compared in tests/python/test_dynamics.py.)
#include <gtest/gtest.h>

#include "palpate/chain.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::random_arm;
using palpate_test::Random;

namespace {

constexpr int N = 7;

struct State {
  JointVector q{}, dq{}, ddq{};
};
State random_state(Random& r, int n) {
  State s;
  for (int j = 0; j < n; ++j) {
    const auto u = static_cast<std::size_t>(j);
    s.q[u] = r(-3, 3), s.dq[u] = r(-2, 2), s.ddq[u] = r(-5, 5);
  }
  return s;
}

TEST(SinCos, AgreesWithTheStandardLibrary) {
  Random r(1);
  for (int k = 0; k < 200000; ++k) {
    const double x = k % 2 ? r(-7, 7) : r(-1e6, 1e6);
    double s, c;
    sincos(x, s, c);
    ASSERT_NEAR(s, std::sin(x), 2.3e-16) << x;
    ASSERT_NEAR(c, std::cos(x), 2.3e-16) << x;
  }
}

TEST(Chain, MomentumTermsAreMassMatrixCoriolisAndGravity) {
  Random r(2);
  for (int trial = 0; trial < 50; ++trial) {
    const Arm arm = random_arm(r, N);
    const State s = random_state(r, N);
    const auto t = momentum_terms<double>(arm, s.q, s.dq);
    const JointMatrix M = mass_matrix<double>(arm, s.q);
    const JointVector bias = inverse_dynamics<double>(arm, s.q, s.dq, JointVector{});
    const JointVector g = inverse_dynamics<double>(arm, s.q, JointVector{}, JointVector{});
    // C^T q' = M' q' - C q', and M' q' = d/dt p at q'' = 0: differentiate p along q' with duals.
    Joints<Dual<1>> q{}, dq{};
    for (std::size_t j = 0; j < N; ++j) {
      q[j] = Dual<1>(s.q[j]);
      q[j].d[0] = s.dq[j];
      dq[j] = Dual<1>(s.dq[j]);
    }
    const auto dual = momentum_terms<Dual<1>>(arm, q, dq);
    for (std::size_t j = 0; j < N; ++j) {
      double p = 0;
      for (int k = 0; k < N; ++k) p += M(static_cast<int>(j), k) * s.dq[static_cast<std::size_t>(k)];
      EXPECT_NEAR(t.p[j], p, 1e-11);
      EXPECT_NEAR(t.g[j], g[j], 1e-11);
      EXPECT_NEAR(t.Ct_dq[j], dual.p[j].d[0] - (bias[j] - g[j]), 1e-10);
    }
  }
}

TEST(Chain, ForwardDynamicsInvertsInverseDynamics) {
  Random r(3);
  for (int trial = 0; trial < 50; ++trial) {
    const Arm arm = random_arm(r, N);
    const State s = random_state(r, N);
    const JointVector tau = inverse_dynamics<double>(arm, s.q, s.dq, s.ddq);
    const JointVector ddq = forward_dynamics<double>(arm, s.q, s.dq, tau);
    for (std::size_t j = 0; j < N; ++j) EXPECT_NEAR(ddq[j], s.ddq[j], 1e-8);
  }
}

TEST(Chain, BaseFrameAgreesWithLocalSweepsAndItsDerivativesAreExact) {
  Random r(4);
  for (int trial = 0; trial < 50; ++trial) {
    const Arm arm = random_arm(r, N);
    const State s = random_state(r, N);
    BaseFrame chain(arm, s.q, s.dq);
    const JointVector tau = chain.inverse_dynamics(s.ddq);
    JointMatrix M, dq, dv;
    chain.derivatives(M, dq, dv);
    const JointMatrix M2 = mass_matrix<double>(arm, s.q);
    Joints<Dual<2 * N>> x{}, v{}, a{};
    for (int j = 0; j < N; ++j) {
      const auto u = static_cast<std::size_t>(j);
      x[u] = Dual<2 * N>::variable(s.q[u], j);
      v[u] = Dual<2 * N>::variable(s.dq[u], N + j);
      a[u] = s.ddq[u];
    }
    const auto dual = inverse_dynamics<Dual<2 * N>>(arm, x, v, a);
    for (int i = 0; i < N; ++i)
      for (int j = 0; j < N; ++j) {
        const auto ui = static_cast<std::size_t>(i), uj = static_cast<std::size_t>(j);
        EXPECT_NEAR(tau[ui], dual[ui].v, 1e-10);
        EXPECT_NEAR(M(i, j), M2(i, j), 1e-11);
        EXPECT_NEAR(dq(i, j), dual[ui].d[uj], 1e-9) << i << j;
        EXPECT_NEAR(dv(i, j), dual[ui].d[N + uj], 1e-9) << i << j;
      }
  }
}

TEST(Chain, RegressorTimesParametersIsTorque) {
  Random r(5);
  for (int trial = 0; trial < 20; ++trial) {
    const Arm arm = random_arm(r, N, /*rotors=*/false);
    const State s = random_state(r, N);
    std::array<double, N * 10 * N> Y{};
    regressor(arm, s.q, s.dq, s.ddq, Y.data());
    const JointVector tau = inverse_dynamics<double>(arm, s.q, s.dq, s.ddq);
    for (int i = 0; i < N; ++i) {
      double sum = 0;
      for (int j = 0; j < N; ++j) {
        const JointDescription& d = arm.joint(j);
        const Inertia<double> I = about_origin(d.mass, Arm::to_vec(d.com), {d.inertia[0], d.inertia[1], d.inertia[2], d.inertia[3], d.inertia[4], d.inertia[5]});
        const std::array<double, 10> pi{I.m, I.mc.x, I.mc.y, I.mc.z, I.I.xx, I.I.xy, I.I.xz, I.I.yy, I.I.yz, I.I.zz};
        for (int c = 0; c < 10; ++c) sum += Y[static_cast<std::size_t>(i * 10 * N + 10 * j + c)] * pi[static_cast<std::size_t>(c)];
      }
      EXPECT_NEAR(sum, tau[static_cast<std::size_t>(i)], 1e-9);
    }
  }
}

TEST(Chain, ALoadIsAHeavierLastLink) {
  Random r(6);
  ArmDescription d = palpate_test::random_description(r, N);
  const Arm bare(d);
  JointDescription& last = d.joints[N - 1];
  const double m = 1.3;
  const Vec3<double> c{0.1, -0.05, 0.2};
  // Join the point mass to the last link by hand.
  const double M = last.mass + m;
  const Vec3<double> c0 = Arm::to_vec(last.com);
  const Vec3<double> cm = (1.0 / M) * (last.mass * c0 + m * c);
  const Inertia<double> both = about_origin(last.mass, c0, {last.inertia[0], last.inertia[1], last.inertia[2], last.inertia[3], last.inertia[4], last.inertia[5]}) +
                               about_origin(m, c, Sym3<double>{});
  const Sym3<double> I = both.I - parallel_axis(0.5 * M * cm, cm);
  last.mass = M;
  last.com = {cm.x, cm.y, cm.z};
  last.inertia = {I.xx, I.xy, I.xz, I.yy, I.yz, I.zz};
  const Arm joined(d);
  const Inertia<double> load = moved(bare.body(N - 1).R_body_link, Vec3<double>{}, about_origin(m, c, Sym3<double>{}));
  const State s = random_state(r, N);
  const JointVector a = inverse_dynamics<double>(bare, s.q, s.dq, s.ddq, load);
  const JointVector b = inverse_dynamics<double>(joined, s.q, s.dq, s.ddq);
  for (std::size_t j = 0; j < N; ++j) EXPECT_NEAR(a[j], b[j], 1e-10);
}

TEST(Chain, JacobianIsTheDerivativeOfThePoint) {
  Random r(7);
  const Arm arm = random_arm(r, N);
  const State s = random_state(r, N);
  Joints<Dual<N>> q{};
  for (int j = 0; j < N; ++j) q[static_cast<std::size_t>(j)] = Dual<N>::variable(s.q[static_cast<std::size_t>(j)], j);
  const auto P = forward_kinematics<Dual<N>>(arm, q);
  const auto x = P.p + P.R * arm.p_last_grasp();
  const Pose<double> Pd = forward_kinematics<double>(arm, s.q);
  const Vec3<double> xd = Pd.p + Pd.R * arm.p_last_grasp();
  for (int j = 0; j < N; ++j) {
    const Vec3<double> c = jacobian_column(arm, Pd, j, xd);
    EXPECT_NEAR(c.x, x.x.d[static_cast<std::size_t>(j)], 1e-12);
    EXPECT_NEAR(c.y, x.y.d[static_cast<std::size_t>(j)], 1e-12);
    EXPECT_NEAR(c.z, x.z.d[static_cast<std::size_t>(j)], 1e-12);
  }
}

TEST(Arm, RefusesWhatNoBodyCanBe) {
  Random r(8);
  const ArmDescription good = palpate_test::random_description(r, 3);
  auto broken = [&](auto change) {
    ArmDescription d = good;
    change(d.joints[1]);
    EXPECT_THROW(Arm{d}, std::invalid_argument);
  };
  broken([](JointDescription& j) { j.mass = -1; });
  broken([](JointDescription& j) { j.mass = std::numeric_limits<double>::quiet_NaN(); });
  broken([](JointDescription& j) { j.inertia = {1, 0, 0, 1, 0, 3}; });
  broken([](JointDescription& j) { j.inertia = {1, 2, 0, 1, 0, 1}; });
  broken([](JointDescription& j) { j.axis = {0, 0, 2}; });
  broken([](JointDescription& j) { j.T_parent_joint.R[0] = -1; });
  broken([](JointDescription& j) { j.effort_gain = 0; });
  ArmDescription none = good;
  none.n = 0;
  EXPECT_THROW(Arm{none}, std::invalid_argument);
}

}  // namespace
