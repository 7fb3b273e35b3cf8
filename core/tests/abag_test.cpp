// Abag: the published law, its bounds for any input, and what the published error does to it.
#include "palpate/control/abag.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

TEST(Abag, IsTheLaw) {
  Abag a(AbagParameters::whiteboard());
  const double u = a.step(0.3);  // e_bar = 0.25: below both thresholds, so b stays and g would shrink below 0
  EXPECT_DOUBLE_EQ(a.state().e_bar, 0.25);
  EXPECT_EQ(a.state().b, 0.0);
  EXPECT_EQ(a.state().g, 0.0);
  EXPECT_EQ(u, 0.0);
  for (int k = 0; k < 3; ++k) a.step(1e-9);  // only the sign counts
  EXPECT_DOUBLE_EQ(a.state().e_bar, 1.0 - 0.75 * 0.75 * 0.75 * 0.75);
  EXPECT_DOUBLE_EQ(a.state().g, 0.002);  // grew at the third and fourth step, |e_bar| = 0.578 and 0.684
  EXPECT_EQ(a.state().b, 0.0);
  EXPECT_DOUBLE_EQ(a.step(1e-9), 0.001 + 0.003);  // e_bar = 0.763 > theta_b: b + g sgn e
  const double back = a.step(-1.0);
  EXPECT_DOUBLE_EQ(back, a.state().b - a.state().g);
}

TEST(Abag, ReplaysTheFirstRowsOfARealLog) {
  // iiwa, 17 January 2023: g, u and e_bar of the program with its error, for an error that stays positive
  Abag a(AbagParameters::whiteboard(), AbagForm::negative_gain);
  const double g[] = {-0.001, -0.002, -0.001}, e_bar[] = {0.25, 0.4375, 0.578125};
  for (int k = 0; k < 3; ++k) {
    EXPECT_DOUBLE_EQ(a.step(0.05), g[k]);
    EXPECT_DOUBLE_EQ(a.state().g, g[k]);
    EXPECT_DOUBLE_EQ(a.state().e_bar, e_bar[k]);
    EXPECT_EQ(a.state().b, 0.0);
  }
}

TEST(Abag, NothingLeavesItsBounds) {
  Random r(1);
  for (const AbagForm form : {AbagForm::corrected, AbagForm::negative_gain}) {
    for (int trial = 0; trial < 50; ++trial) {
      const AbagParameters p{r(0.0, 0.999), r(0.0, 1.0), r(1e-4, 3.0), r(0.0, 1.0), r(1e-4, 3.0), 0.008, trial % 2 == 0 ? 0.0 : r(0.0, 1.0), 0.0};
      Abag a(p, form);
      for (int k = 0; k < 500; ++k) {
        const double pick = r(0.0, 1.0);
        const double e = pick < 0.05 ? nan : pick < 0.1 ? inf : pick < 0.15 ? -inf : pick < 0.2 ? 0.0 : r(-1e300, 1e300);
        const double u = a.step(e);
        EXPECT_LE(std::abs(u), 1.0);
        EXPECT_LE(std::abs(a.state().b), 1.0);
        EXPECT_LE(std::abs(a.state().e_bar), 1.0);
        EXPECT_LE(a.state().g, 1.0);
        EXPECT_GE(a.state().g, form == AbagForm::corrected ? 0.0 : -1.0);
      }
    }
  }
}

TEST(Abag, NoErrorNoControl) {
  Abag a;
  for (int k = 0; k < 100; ++k) EXPECT_EQ(a.step(0.0), 0.0);
}

TEST(Abag, AnErrorThatIsNotANumberPushesNothingAndIsForgotten) {
  Abag a(AbagParameters::kinova()), b(AbagParameters::kinova());
  for (int k = 0; k < 50; ++k) a.step(1.0), b.step(1.0);
  EXPECT_EQ(a.step(nan), 0.0);
  EXPECT_EQ(a.status(), Status::non_finite);
  EXPECT_EQ(a.step(1.0), b.step(1.0));
  EXPECT_EQ(a.status(), Status::ok);
}

TEST(Abag, IsOdd) {
  Abag a(AbagParameters::kinova()), b(AbagParameters::kinova());
  Random r(2);
  for (int k = 0; k < 1000; ++k) {
    const double e = r(-1.0, 0.5);
    EXPECT_EQ(a.step(e), -b.step(-e));
  }
}

struct Tracking {
  double mean, std, least_gain;
};
/// m v' = F_max u - d v, the velocity read at 8.13 ms from a sender of 5 ms and divided by 8.13 ms, as W did.
Tracking one_dof(AbagForm form, double damping) {
  Abag a(AbagParameters::whiteboard(), form);
  const double m = 5.0, F_max = 5.0, h = 0.00813, T = 0.005, v_des = 0.05;
  double v = 0.0, x = 0.0, c = 0.0, x_sent = 0.0, x_read = 0.0, sum = 0.0, squares = 0.0, least = 0.0;
  const int N = 8000;
  for (int k = 0; k < N; ++k) {
    const double u = a.step(v_des - (x_sent - x_read) / h);
    least = std::min(least, a.state().g);
    x_read = x_sent;
    for (int i = 0; i < 16; ++i) {
      v += h / 16 * (F_max * u - damping * v) / m;
      x += h / 16 * v;
      c += h / 16 / T;
      if (c >= 1.0) c -= 1.0, x_sent = x;
    }
    if (k >= N / 2) sum += v, squares += v * v;
  }
  const double mean = sum / (N / 2);
  return {mean, std::sqrt(squares / (N / 2) - mean * mean), least};
}

TEST(Abag, TheNegativeGainOfThePublishedProgramShakesTheVelocity) {
  for (double damping : {5.0, 20.0}) {
    const Tracking published = one_dof(AbagForm::negative_gain, damping), corrected = one_dof(AbagForm::corrected, damping);
    EXPECT_LT(published.least_gain, -0.1);
    EXPECT_GE(corrected.least_gain, 0.0);
    EXPECT_LT(2.5 * corrected.std, published.std) << damping;
  }
}

TEST(Abag, ConvergesInOneDegreeOfFreedomWithoutNoise) {
  for (double load : {-3.0, 0.0, 3.0}) {
    Abag a(AbagParameters::kinova());
    double v = 0.0;
    const double m = 2.0, F_max = 5.0, h = 0.001;
    double sum = 0.0;
    for (int k = 0; k < 20000; ++k) {
      v += h * (F_max * a.step(0.05 - v) + load - 2.0 * v) / m;
      if (k >= 15000) sum += v / 5000;
    }
    EXPECT_NEAR(sum, 0.05, 0.002) << load;
    EXPECT_NEAR(a.state().b, (2.0 * 0.05 - load) / F_max, 0.1) << load;  // the bias has learnt what it takes
  }
}

TEST(Abag, AnotherPeriodKeepsTheBehaviourInTime) {
  const AbagParameters slow = AbagParameters::whiteboard(), fast = slow.at(0.001);
  EXPECT_NEAR(std::pow(fast.alpha, 8.0), slow.alpha, 1e-12);
  EXPECT_NEAR(8.0 * fast.delta_b, slow.delta_b, 1e-15);
  Abag a(slow), b(fast);
  for (int k = 0; k < 1000; ++k) {
    a.step(1.0);
    for (int i = 0; i < 8; ++i) b.step(1.0);
  }
  EXPECT_NEAR(a.state().b, b.state().b, 0.02);
  EXPECT_NEAR(a.state().g, b.state().g, 0.02);
}

TEST(Abag, ResetIsNewAndNothingIsAllocated) {
  Abag a(AbagParameters::kinova()), fresh(AbagParameters::kinova());
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) a.step(k % 7 - 3.0);
  a.reset();
  for (int k = 0; k < 100; ++k) EXPECT_EQ(a.step(k % 5 - 2.0), fresh.step(k % 5 - 2.0));
  EXPECT_EQ(counter.count(), 0u);
}

TEST(Abag, ConstructorNamesWhatIsWrong) {
  const auto message = [](const AbagParameters& p) -> std::string {
    try {
      Abag a(p);
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message({.alpha = 1.0}), "AbagParameters alpha = 1: expected a number from 0 to below 1");
  EXPECT_EQ(message({.theta_b = nan}), "AbagParameters theta_b = nan: expected a number from 0 to 1");
  EXPECT_EQ(message({.delta_g = 0.0}), "AbagParameters delta_g = 0: expected a finite number > 0");
  EXPECT_THROW((void)AbagParameters::whiteboard().at(0.0), std::invalid_argument);
}

}  // namespace
