// The disturbance Kalman filter against a dense textbook filter, and its covariance against what really happens.
#include "palpate/observers/disturbance_kalman.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr std::size_t at(int i) { return static_cast<std::size_t>(i); }

ArmDescription description(int n) {
  Random r(11);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    d.joints[at(j)].friction = {.coulomb = 1.0, .viscous = 0.4, .sign_velocity = 0.05};
    d.joints[at(j)].torque_std = 0.2;
  }
  return d;
}

/// Samples of an arm that obeys its model exactly under a push, made by inverse dynamics at the middle of each step.
struct Motion {
  const Arm& arm;
  double h;
  JointVector q(double t) const { return value(t, [](double w, double x) { return 0.3 * std::sin(w * x); }); }
  JointVector dq(double t) const { return value(t, [](double w, double x) { return 0.3 * w * std::cos(w * x); }); }
  /// Torque that changes the momentum as the motion wants it: exact for the observer's own discretisation.
  JointVector tau(double t, const JointVector& push) const {
    const auto a = terms(t - h), b = terms(t);
    JointVector out{};
    for (int j = 0; j < arm.n(); ++j) {
      const auto u = at(j);
      out[u] = (b.first[u] - a.first[u]) / h - 0.5 * (a.second[u] + b.second[u]) - push[u];
    }
    return out;
  }
  JointSample sample(int k, const JointVector& push) const {
    JointSample s;
    const double t = k * h;
    s.time_ns = static_cast<std::int64_t>(t * 1e9);
    s.dt = k > 0 ? h : 0.0;
    s.q = q(t);
    s.dq = dq(t);
    s.tau = tau(t, push);
    s.status = Status::ok;
    return s;
  }

 private:
  template <class F>
  JointVector value(double t, F f) const {
    JointVector out{};
    for (int j = 0; j < arm.n(); ++j) out[at(j)] = f(1.0 + 0.3 * j, t + j);
    return out;
  }
  std::pair<JointVector, JointVector> terms(double t) const {
    const JointVector v = dq(t);
    const auto m = momentum_terms<double>(arm, q(t), v);
    JointVector beta{};
    for (int j = 0; j < arm.n(); ++j) beta[at(j)] = m.Ct_dq[at(j)] - m.g[at(j)] - arm.joint(j).friction.torque(v[at(j)]);
    return {m.p, beta};
  }
};

/// One step of the textbook filter on (p, d), dense, Joseph form, with the noise the header states.
struct Dense {
  int n;
  std::vector<double> P;
  double& operator()(int r, int c) { return P[at(r * 2 * n + c)]; }
  explicit Dense(int joints) : n(joints), P(at(4 * joints * joints), 0.0) {}

  void step(double h, const JointVector& w_p, const JointVector& w_d, const JointMatrix& R) {
    const int m = 2 * n;
    Dense F(n), T(n), N(n);
    for (int i = 0; i < m; ++i) F(i, i) = 1.0;
    for (int i = 0; i < n; ++i) F(i, n + i) = h;
    product(F, *this, T, false);
    product(T, F, N, true);
    for (int i = 0; i < n; ++i) {
      N(i, i) += h * h * (w_p[at(i)] + w_d[at(i)] / 3.0);
      N(i, n + i) += 0.5 * h * w_d[at(i)];
      N(n + i, i) += 0.5 * h * w_d[at(i)];
      N(n + i, n + i) += w_d[at(i)];
    }
    JointMatrix S{};
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) S(i, j) = N(i, j) + R(i, j);
    const Cholesky<double> factor(S, n);
    Dense L(n);  // 1 - K H
    std::vector<JointVector> K(at(m));
    for (int r = 0; r < m; ++r) {
      JointVector row{};
      for (int j = 0; j < n; ++j) row[at(j)] = N(r, j);
      K[at(r)] = factor.solve(row);
      L(r, r) += 1.0;
      for (int j = 0; j < n; ++j) L(r, j) -= K[at(r)][at(j)];
    }
    product(L, N, T, false);
    product(T, L, *this, true);
    for (int r = 0; r < m; ++r)
      for (int c = 0; c < m; ++c)
        for (int i = 0; i < n; ++i)
          for (int j = 0; j < n; ++j) (*this)(r, c) += K[at(r)][at(i)] * R(i, j) * K[at(c)][at(j)];
  }

 private:
  static void product(Dense& A, Dense& B, Dense& out, bool transposed) {
    const int m = 2 * A.n;
    for (int r = 0; r < m; ++r)
      for (int c = 0; c < m; ++c) {
        double sum = 0.0;
        for (int k = 0; k < m; ++k) sum += A(r, k) * (transposed ? B(c, k) : B(k, c));
        out(r, c) = sum;
      }
  }
};

TEST(DisturbanceKalman, CovarianceIsTheDenseFilters) {
  const int n = 5;
  ArmDescription d = description(n);
  for (int j = 0; j < n; ++j) d.joints[at(j)].friction = {};  // the velocity-dependent terms are tested below
  const Arm arm(d);
  const Motion motion{arm, 1e-3};
  const DisturbanceKalmanConfig config{.disturbance_rate = 15.0, .disturbance_prior_std = 30.0};
  DisturbanceKalman observer(arm, config);
  Dense dense(n);
  for (int k = 0; k < 300; ++k) {
    JointSample s = motion.sample(k, {});
    for (int j = 0; j < n; ++j) s.dq_std[at(j)] = 1e-3 * (1 + j);
    const ExternalTorque seen = observer.step(s);
    const JointMatrix& R = observer.momentum_noise();
    if (k == 0) {
      for (int i = 0; i < n; ++i) {
        for (int j = 0; j < n; ++j) dense(i, j) = R(i, j);
        dense(n + i, n + i) = 900.0;
      }
      continue;
    }
    JointVector w_p{}, w_d{};
    w_p.fill(0.04);
    w_d.fill(225.0 * 1e-3);
    dense.step(s.dt, w_p, w_d, R);
    const JointMatrix P = observer.covariance();
    for (int i = 0; i < n; ++i) {
      EXPECT_NEAR(seen.std[at(i)], std::sqrt(dense(n + i, n + i)), 1e-9 * seen.std[at(i)]);
      for (int j = 0; j < n; ++j) ASSERT_NEAR(P(i, j), dense(n + i, n + j), 1e-8 * std::sqrt(P(i, i) * P(j, j))) << k << " " << i << " " << j;
    }
  }
}

TEST(DisturbanceKalman, TheIntervalsHoldWhatTheyPromise) {  // noise of q' and of the torque as declared, a push that wanders
  const int n = 3;
  ArmDescription d = description(n);
  for (int j = 0; j < n; ++j) d.joints[at(j)].friction = {};
  const Arm arm(d);
  const Motion motion{arm, 1e-3};
  Random r(5);
  double chi2 = 0.0, cross = 0.0, expected_cross = 0.0;
  int count = 0;
  for (int run = 0; run < 60; ++run) {
    DisturbanceKalman observer(arm, {.disturbance_rate = 30.0});
    JointVector push{};
    for (double& x : push) x = r(-20, 20);
    for (int k = 0; k < 400; ++k) {
      JointVector mean = push;  // over the step: a Brownian motion's, given where it starts and ends
      for (int j = 0; j < n; ++j) {
        const double change = 30.0 * std::sqrt(1e-3) * r.normal();
        mean[at(j)] += 0.5 * change + 30.0 * std::sqrt(1e-3 / 12.0) * r.normal();
        push[at(j)] += change;
      }
      JointSample s = motion.sample(k, mean);
      for (int j = 0; j < n; ++j) {
        s.dq_std[at(j)] = 2e-3;
        s.dq[at(j)] += 2e-3 * r.normal();
        s.tau[at(j)] += 0.2 * r.normal();
      }
      const ExternalTorque seen = observer.step(s);
      if (k < 300 || k % 20) continue;
      JointVector e{};
      for (int j = 0; j < n; ++j) e[at(j)] = seen.torque[at(j)] - push[at(j)];
      const JointMatrix P = observer.covariance();
      const JointVector x = Cholesky<double>(P, n).solve(e);
      for (int j = 0; j < n; ++j) chi2 += e[at(j)] * x[at(j)];
      cross += e[0] * e[1];
      expected_cross += P(0, 1);
      ++count;
    }
  }
  EXPECT_NEAR(chi2 / (n * count), 1.0, 0.15);  // standard deviation of the mean: sqrt(2/900) = 0.05, more as errors repeat
  EXPECT_GT(std::abs(expected_cross), 0.0);
  EXPECT_GT(cross * expected_cross, 0.0);  // joints share the noise of q' through M
}

TEST(DisturbanceKalman, NearRestFrictionWidensTheInterval) {
  const Arm arm(description(2));
  DisturbanceKalman observer(arm);
  const auto settle = [&](double dq) {
    ExternalTorque seen;
    for (int k = 0; k < 500; ++k) {
      JointSample s;
      s.dt = 1e-3;
      s.dq = {dq, dq};
      s.dq_std = {1e-4, 1e-4};
      s.status = Status::ok;
      const auto m = momentum_terms<double>(arm, s.q, s.dq);
      for (int j = 0; j < 2; ++j) s.tau[at(j)] = m.g[at(j)] - m.Ct_dq[at(j)] + arm.joint(j).friction.torque(dq);
      seen = observer.step(s);
    }
    return seen.std[0];
  };
  const double moving = settle(0.5), resting = settle(0.0);
  EXPECT_GT(resting, 1.0 / std::sqrt(3.0));  // within +-F_c, uniform
  EXPECT_GT(moving, 0.3);
  EXPECT_LT(moving, resting);
}

TEST(DisturbanceKalman, AReversalRenewsTheFrictionError) {
  const Arm arm(description(1));
  DisturbanceKalman steady(arm, {.disturbance_rate = 1.0}), reversing = steady;
  double before = 0.0, at_reversal = 0.0;
  for (int k = 0; k < 400; ++k) {
    JointSample s;
    s.dt = 1e-3;
    s.dq_std = {1e-4};
    s.status = Status::ok;
    s.dq = {0.5};
    (void)steady.step(s);
    if (k >= 300) s.dq = {-0.5};
    const double std = reversing.step(s).std[0];
    if (k == 299) before = std;
    if (k == 300) at_reversal = std;
  }
  EXPECT_GT(at_reversal, 1.2 * before);
}

TEST(DisturbanceKalman, DecayForgets) {
  const Arm arm(description(1));
  const Motion motion{arm, 1e-3};
  DisturbanceKalman lasting(arm), forgetting(arm, {.decay = 500.0});
  ExternalTorque a, b;
  for (int k = 0; k < 2000; ++k) {
    JointSample s = motion.sample(k, {5.0});
    s.dq_std = {1e-3};
    a = lasting.step(s);
    b = forgetting.step(s);
  }
  EXPECT_NEAR(a.torque[0], 5.0, 0.01);
  EXPECT_LT(b.torque[0], 4.9);
  EXPECT_GT(b.torque[0], 0.5);
}

TEST(DisturbanceKalman, ANewStartAfterAbsurdInput) {
  const Arm arm(description(2));
  DisturbanceKalman observer(arm);
  JointSample s;
  s.status = Status::ok;
  s.dt = 1e-3;
  (void)observer.step(s);
  s.dq = {1e200, 0.0};
  (void)observer.step(s);
  s.dq = {};
  ExternalTorque seen;
  for (int k = 0; k < 2000; ++k) seen = observer.step(s);
  for (int j = 0; j < 2; ++j) EXPECT_TRUE(std::isfinite(seen.torque[at(j)]) && std::isfinite(seen.std[at(j)]));
}

TEST(DisturbanceKalman, RefusesWhatCannotWork) {
  const Arm arm(description(2));
  EXPECT_THROW(DisturbanceKalman(arm, {.disturbance_rate = 0.0}), std::invalid_argument);
  EXPECT_THROW(DisturbanceKalman(arm, {.decay = -1.0}), std::invalid_argument);
  EXPECT_THROW(DisturbanceKalman(arm, {.disturbance_prior_std = 0.0}), std::invalid_argument);
  EXPECT_THROW(DisturbanceKalman(arm, {.model_torque_std = -1.0}), std::invalid_argument);
  EXPECT_THROW(DisturbanceKalman(arm, {.friction_time = 0.0}), std::invalid_argument);
  ArmDescription massless = description(2);
  for (auto& joint : massless.joints) joint.mass = 0.0;
  EXPECT_THROW(DisturbanceKalman(Arm(massless), {}), std::invalid_argument);
}

TEST(DisturbanceKalman, AllocatesNothing) {
  const Arm arm(description(7));
  const Motion motion{arm, 1e-3};
  DisturbanceKalman observer(arm);
  std::vector<JointSample> samples;
  for (int k = 0; k < 100; ++k) samples.push_back(motion.sample(k, {}));
  const palpate::test::AllocationCounter counter;
  for (const JointSample& s : samples) (void)observer.step(s);
  (void)observer.covariance();
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
