// The wrench at the hand: recovered, weighted, with an honest covariance, silent where the pose shows nothing.
#include "palpate/wrench.hpp"

#include <gtest/gtest.h>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr std::size_t at(int i) { return static_cast<std::size_t>(i); }
using Six = std::array<double, 6>;

ArmDescription revolute(int n, std::uint64_t seed = 4) {
  Random r(seed);
  ArmDescription d = palpate_test::random_description(r, n);
  for (auto& joint : d.joints) joint.prismatic = false;
  return d;
}
JointVector pose(int n) {
  JointVector q{};
  for (int j = 0; j < n; ++j) q[at(j)] = 0.5 - 0.35 * (j % 4);
  return q;
}
/// J^T F for a wrench in base axes about a point of the last link (base frame).
JointVector torque_of(const Arm& arm, const JointVector& q, const Vec3<double>& point, const Six& F) {
  const Pose<double> P = forward_kinematics<double>(arm, q);
  JointVector tau{};
  for (int j = 0; j < arm.n(); ++j) {
    const Vec3<double> v = jacobian_column(arm, P, j, point);
    tau[at(j)] = dot(v, Vec3<double>{F[0], F[1], F[2]});
    if (!arm.body(j).prismatic) tau[at(j)] += dot(P.axis[at(j)], Vec3<double>{F[3], F[4], F[5]});
  }
  return tau;
}
Vec3<double> grasp(const Arm& arm, const JointVector& q) {
  const Pose<double> P = forward_kinematics<double>(arm, q);
  return P.p + P.R * arm.p_last_grasp();
}
Mat3<double> tip_axes(const Arm& arm, const JointVector& q) { return forward_kinematics<double>(arm, q).R * arm.R_last_tip(); }

ExternalTorque felt(const JointVector& tau, double std = 0.01) {
  ExternalTorque out;
  out.torque = tau;
  out.std.fill(std);
  out.status = Status::ok;
  return out;
}
JointMatrix diagonal(int n, double std) {
  JointMatrix S{};
  for (int j = 0; j < n; ++j) S(j, j) = std * std;
  return S;
}
Six all(const Wrench& w) { return {w.force[0], w.force[1], w.force[2], w.moment[0], w.moment[1], w.moment[2]}; }

TEST(Wrench, AKnownOneIsRecoveredWithItsSign) {
  for (int n : {6, 7, 9}) {
    ArmDescription d = revolute(n);
    d.joints[2].prismatic = n == 9;
    const Arm arm(d);
    const JointVector q = pose(n);
    const Six F{12.0, -7.0, 30.0, 1.5, -2.0, 0.7};
    const Wrench w = WrenchEstimator(arm).step(q, felt(torque_of(arm, q, grasp(arm, q), F)), diagonal(n, 1e-3), LoadTorque(arm));
    EXPECT_EQ(w.status, Status::ok) << name(w.status);
    for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(w)[at(k)], F[at(k)], 1e-3) << n << " joints, component " << k;
    EXPECT_GE(w.conditioning, 1.0);
    EXPECT_LT(w.conditioning, 1e4);
    EXPECT_EQ(w.load_mass, 0.0);
  }
}

TEST(Wrench, AxesAndPointAreWhatTheySay) {
  const Arm arm(revolute(7));
  const JointVector q = pose(7);
  const Six F{12.0, -7.0, 30.0, 1.5, -2.0, 0.7};  // base axes, grasp point
  const ExternalTorque tau = felt(torque_of(arm, q, grasp(arm, q), F));
  const Mat3<double> R = tip_axes(arm, q);
  const Pose<double> P = forward_kinematics<double>(arm, q);
  const Vec3<double> lever = grasp(arm, q) - (P.p + P.R * arm.p_last_tip());
  for (Axes axes : {Axes::base, Axes::tip})
    for (Point point : {Point::grasp, Point::tip}) {
      const Wrench w = WrenchEstimator(arm, {.axes = axes, .point = point}).step(q, tau, diagonal(7, 1e-4), LoadTorque(arm));
      EXPECT_EQ(w.axes, axes);
      EXPECT_EQ(w.point, point);
      Vec3<double> f{F[0], F[1], F[2]}, m{F[3], F[4], F[5]};
      if (point == Point::tip) m = m + cross(lever, f);
      if (axes == Axes::tip) {
        f = transposed(R, f);
        m = transposed(R, m);
      }
      const Six expected{f.x, f.y, f.z, m.x, m.y, m.z};
      for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(w)[at(k)], expected[at(k)], 1e-3) << k;
    }
}

TEST(Wrench, CovarianceIsWhatNoiseDoes) {
  const int n = 7;
  const Arm arm(revolute(n));
  const JointVector q = pose(n);
  Random r(3);
  JointMatrix L{}, S{};  // a full covariance, S = L L^T
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) L(i, j) = i == j ? r(0.3, 1.0) : r(-0.3, 0.3);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j)
      for (int k = 0; k < n; ++k) S(i, j) += L(i, k) * L(j, k);
  const Six F{12.0, -7.0, 30.0, 1.5, -2.0, 0.7};
  const JointVector exact = torque_of(arm, q, grasp(arm, q), F);
  // With a wide prior the estimate is unbiased, and the stated covariance is that of its errors.
  const WrenchConfig config{.force_prior_std = 1e5, .moment_prior_std = 1e5};
  WrenchEstimator estimator(arm, config);
  std::array<double, 36> sum{};
  Wrench w;
  const int runs = 20000;
  for (int run = 0; run < runs; ++run) {
    JointVector white{}, tau = exact;
    for (int j = 0; j < n; ++j) white[at(j)] = r.normal();
    for (int i = 0; i < n; ++i)
      for (int k = 0; k <= i; ++k) tau[at(i)] += L(i, k) * white[at(k)];
    w = estimator.step(q, felt(tau), S, LoadTorque(arm));
    for (int a = 0; a < 6; ++a)
      for (int b = 0; b < 6; ++b) sum[at(6 * a + b)] += (all(w)[at(a)] - F[at(a)]) * (all(w)[at(b)] - F[at(b)]) / runs;
  }
  for (int a = 0; a < 6; ++a)
    for (int b = 0; b < 6; ++b) {
      const double scale = std::sqrt(w.covariance[at(7 * a)] * w.covariance[at(7 * b)]);
      EXPECT_NEAR(sum[at(6 * a + b)], w.covariance[at(6 * a + b)], 0.05 * scale) << a << " " << b;
    }
  EXPECT_NEAR(w.force_std[1], std::sqrt(w.covariance[7]), 1e-12);
  EXPECT_NEAR(w.moment_std[2], std::sqrt(w.covariance[35]), 1e-12);
}

TEST(Wrench, AnUnsureJointCountsLittle) {
  const int n = 7;
  const Arm arm(revolute(n));
  const JointVector q = pose(n);
  const Six F{12.0, -7.0, 30.0, 1.5, -2.0, 0.7};
  JointVector tau = torque_of(arm, q, grasp(arm, q), F);
  tau[3] += 20.0;  // stiction, say
  JointMatrix S = diagonal(n, 0.01);
  S(3, 3) = 400.0;
  const Wrench weighted = WrenchEstimator(arm).step(q, felt(tau), S, LoadTorque(arm));
  for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(weighted)[at(k)], F[at(k)], 0.5) << k;
}

/// Two joints about vertical axes, links along x: forces in the plane are felt, nothing else.
Arm planar() {
  ArmDescription d;
  d.n = 2;
  for (int j = 0; j < 2; ++j) {
    d.joints[at(j)].mass = 1.0;
    d.joints[at(j)].inertia = {0.1, 0.0, 0.0, 0.1, 0.0, 0.1};
    d.joints[at(j)].T_parent_joint.p = {j * 0.5, 0.0, 0.0};
  }
  d.T_last_tip.p = {0.5, 0.0, 0.0};
  return Arm(d);
}

TEST(Wrench, WhatThePoseDoesNotShowIsSingularAndWide) {
  const Arm arm = planar();
  const LoadTorque load(arm);
  WrenchEstimator force_only(arm, {.moment_prior_std = 0.0});
  const JointVector bent{0.3, 1.2}, stretched{0.3, 0.0};
  const Wrench w = force_only.step(bent, felt(torque_of(arm, bent, grasp(arm, bent), {5.0, -3.0, 8.0, 0, 0, 0})), diagonal(2, 0.01), load);
  EXPECT_EQ(w.status, Status::singular);
  EXPECT_EQ(w.singular, (std::array<bool, 6>{false, false, true, false, false, false}));
  EXPECT_NEAR(w.force[0], 5.0, 0.01);
  EXPECT_NEAR(w.force[1], -3.0, 0.01);
  EXPECT_EQ(w.force[2], 0.0);
  EXPECT_NEAR(w.force_std[2], 500.0, 1e-6);
  EXPECT_LT(w.force_std[0], 0.1);
  EXPECT_TRUE(std::isinf(w.conditioning));
  for (int k = 0; k < 3; ++k) EXPECT_EQ(w.moment[at(k)], 0.0);

  WrenchEstimator along(arm, {.axes = Axes::tip, .moment_prior_std = 0.0});  // stretched out: nothing along the arm
  const Wrench s = along.step(stretched, felt(torque_of(arm, stretched, grasp(arm, stretched), {1.0, 2.0, 0, 0, 0, 0})), diagonal(2, 0.01), load);
  EXPECT_TRUE(s.singular[0]);
  EXPECT_FALSE(s.singular[1]);
}

TEST(Wrench, AHeldLoadIsRemovedAtRestAndInMotion) {
  ArmDescription d = revolute(7);
  d.gravity = {1.0, -2.0, -9.0};
  const Arm arm(d);
  const LoadConfig held{.mass = 2.0, .com = {0.03, -0.02, 0.08}, .acceleration_time = 0.0};
  LoadTorque load(arm, held);
  WrenchEstimator estimator(arm);
  const Vec3<double> c = arm.p_last_grasp() + arm.R_last_tip() * Vec3<double>{0.03, -0.02, 0.08};
  const Inertia<double> body = about_origin(2.0, c, Sym3<double>{});
  const Six F{12.0, -7.0, 30.0, 1.5, -2.0, 0.7};
  Wrench w;
  for (int k = 0; k < 50; ++k) {
    JointSample s;
    s.dt = 1e-3;
    s.status = Status::ok;
    JointVector ddq{};
    for (int j = 0; j < 7; ++j) {
      ddq[at(j)] = 2.0 + 0.3 * j;
      s.q[at(j)] = pose(7)[at(j)];
      s.dq[at(j)] = ddq[at(j)] * 1e-3 * k;
    }
    load.step(s, {});
    BaseFrame chain(arm, s.q, s.dq);
    chain.inverse_dynamics(k > 0 ? ddq : JointVector{});
    const JointVector weight = chain.body_torque(6, moved(chain.pose().R, chain.pose().p, body));
    JointVector tau = torque_of(arm, s.q, grasp(arm, s.q), F);
    for (int j = 0; j < 7; ++j) {
      EXPECT_NEAR(load.torque()[at(j)], -weight[at(j)], 1e-9) << k;
      tau[at(j)] -= weight[at(j)];
    }
    w = estimator.step(s.q, felt(tau), diagonal(7, 1e-4), load);
  }
  for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(w)[at(k)], F[at(k)], 1e-3) << k;
  EXPECT_EQ(w.load_mass, 2.0);
}

TEST(Wrench, TheEstimatedLoadIsUsedOnceItIsOkAndItsDoubtWidens) {
  const Arm arm(revolute(7));
  LoadTorque load(arm);
  JointSample s;
  s.q = pose(7);
  s.status = Status::ok;
  Payload payload;
  payload.mass = 1.5;
  payload.mass_std = 0.2;
  payload.status = Status::warming;
  load.step(s, payload);
  EXPECT_EQ(load.mass(), 0.0);
  EXPECT_EQ(load.torque(), JointVector{});
  WrenchEstimator estimator(arm);
  const double sure = estimator.step(s.q, felt({}), diagonal(7, 0.01), load).force_std[2];
  payload.status = Status::ok;
  load.step(s, payload);
  EXPECT_EQ(load.mass(), 1.5);
  const Wrench w = estimator.step(s.q, felt(load.torque()), diagonal(7, 0.01), load);
  for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(w)[at(k)], 0.0, 1e-6);
  EXPECT_NEAR(w.force_std[2], std::hypot(sure, 0.2 * 8.0), 0.05);  // |g_z| = 8 in this mount
  payload.status = Status::held;  // what was weighed is still held
  load.step(s, payload);
  EXPECT_EQ(load.mass(), 1.5);
  EXPECT_GT(load.std(1), 0.0);
  load.reset();
  EXPECT_EQ(load.mass(), 0.0);
}

TEST(Wrench, WhatTheObserverDoesNotKnowIsNotUsed) {
  const Arm arm(revolute(7));
  const LoadTorque load(arm);
  WrenchEstimator estimator(arm);
  ExternalTorque tau = felt(torque_of(arm, pose(7), grasp(arm, pose(7)), {1, 2, 3, 0, 0, 0}));
  tau.status = Status::warming;
  EXPECT_EQ(estimator.step(pose(7), tau, diagonal(7, 0.1), load).status, Status::warming);
  tau.status = Status::ok;
  const Wrench good = estimator.step(pose(7), tau, diagonal(7, 0.1), load);
  for (Status why : {Status::held, Status::gap, Status::non_finite}) {
    ExternalTorque bad = tau;
    bad.status = why;
    bad.torque.fill(1e9);
    const Wrench repeated = estimator.step(pose(7), bad, diagonal(7, 0.1), load);
    EXPECT_EQ(repeated.status, why);
    EXPECT_EQ(repeated.force, good.force);
  }
}

TEST(Wrench, ZeroCovarianceIsTakenAsAlmostExact) {
  const Arm arm(revolute(6));
  const JointVector q = pose(6);
  const Six F{1.0, 2.0, 3.0, 0.1, 0.2, 0.3};
  const Wrench w = WrenchEstimator(arm).step(q, felt(torque_of(arm, q, grasp(arm, q), F)), JointMatrix{}, LoadTorque(arm));
  EXPECT_EQ(w.status, Status::ok);
  for (int k = 0; k < 6; ++k) EXPECT_NEAR(all(w)[at(k)], F[at(k)], 1e-4);
}

TEST(Wrench, RefusesWhatCannotWork) {
  const Arm arm(revolute(6));
  EXPECT_THROW(WrenchEstimator(arm, {.force_prior_std = 0.0}), std::invalid_argument);
  EXPECT_THROW(WrenchEstimator(arm, {.moment_prior_std = -1.0}), std::invalid_argument);
  EXPECT_THROW(WrenchEstimator(arm, {.singular_share = 0.0}), std::invalid_argument);
  EXPECT_THROW(LoadTorque(arm, {.mass = -1.0}), std::invalid_argument);
  EXPECT_THROW(LoadTorque(arm, {.mass = 1.0, .mass_std = -1.0}), std::invalid_argument);
  EXPECT_THROW(LoadTorque(arm, {.acceleration_time = -1.0}), std::invalid_argument);
}

TEST(Wrench, AllocatesNothing) {
  const Arm arm(revolute(7));
  LoadTorque load(arm, {.mass = 1.0});
  WrenchEstimator estimator(arm);
  JointSample s;
  s.q = pose(7);
  s.status = Status::ok;
  const palpate::test::AllocationCounter counter;
  load.step(s, {});
  (void)estimator.step(s.q, felt({}), diagonal(7, 0.1), load);
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
