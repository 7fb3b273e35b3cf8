// Friction against its formula, its derivative two ways, its uncertainty at rest and in motion.
#include "palpate/friction.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <numbers>

#include "palpate/scalar.hpp"

using namespace palpate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();

const Friction full{
    .coulomb = 1.2, .viscous = 0.4, .offset = -0.1, .static_ = 2.0, .stribeck_velocity = 0.05, .load = 0.03, .sign_velocity = 0.01};
const Friction plain{.coulomb = 1.2, .viscous = 0.4, .offset = -0.1};

TEST(Friction, NoneByDefault) {
  for (double dq : {-3.0, 0.0, 1e-9, 2.0}) {
    EXPECT_EQ(Friction{}.torque(dq), 0.0);
    EXPECT_EQ(Friction{}.derivative(dq), 0.0);
    EXPECT_EQ(Friction{}.uncertainty(dq, 0.1), 0.0);
  }
  EXPECT_EQ(Friction{}.problem(), "");
}

TEST(Friction, AwayFromRestItIsTheTextbookFormula) {
  for (double dq : {-2.0, -0.5, 0.5, 2.0}) {  // |dq| >= 50 sign_velocity, 10 v_s: tanh is 1, the exponential 0
    const double sign = dq > 0 ? 1.0 : -1.0;
    EXPECT_NEAR(plain.torque(dq), 1.2 * sign + 0.4 * dq - 0.1, 1e-15);
    EXPECT_NEAR(full.torque(dq), 1.2 * sign + 0.4 * dq - 0.1, 1e-15);
    EXPECT_NEAR(full.torque(dq, -10.0), 1.5 * sign + 0.4 * dq - 0.1, 1e-15);  // of either sign: |tau_load|
  }
  Friction sharp = full;
  sharp.sign_velocity = 1e-6;
  EXPECT_NEAR(sharp.torque(0.05), 1.2 + 0.8 / std::numbers::e + 0.4 * 0.05 - 0.1, 1e-15);  // Stribeck at v_s
}

TEST(Friction, AtRestOnlyTheOffsetRemainsAndTheRestIsOdd) {
  EXPECT_EQ(full.torque(0.0), -0.1);
  for (double dq : {1e-4, 0.003, 0.02, 0.7}) EXPECT_NEAR(full.torque(dq, 4.0) + full.torque(-dq, 4.0), -0.2, 1e-15);
}

TEST(Friction, DerivativeAgreesWithDualNumbersAndDifferences) {
  for (const Friction& f : {plain, full})
    for (double load : {0.0, -12.0})
      for (double dq : {-1.0, -0.06, -0.012, -1e-3, 0.0, 1e-5, 0.004, 0.03, 0.2, 3.0}) {
        const Dual<1> dual = f.torque(Dual<1>::variable(dq, 0), load);
        EXPECT_EQ(dual.v, f.torque(dq, load));
        EXPECT_NEAR(dual.d[0], f.derivative(dq, load), 1e-12 * (1.0 + std::abs(dual.d[0]))) << dq;
        const double h = 1e-7;
        const double slope = (f.torque(dq + h, load) - f.torque(dq - h, load)) / (2 * h);
        EXPECT_NEAR(slope, f.derivative(dq, load), 1e-6 * (1.0 + std::abs(slope))) << dq;
      }
}

TEST(Friction, LoadMayBeADualToo) {
  const Dual<2> dq = Dual<2>::variable(0.5, 0), load = Dual<2>::variable(-10.0, 1);
  const Dual<2> tau = full.torque(dq, load);
  EXPECT_NEAR(tau.d[1], -0.03, 1e-15);  // d/d tau_load of load |tau_load| at tau_load < 0, forward motion
  EXPECT_EQ(tau.v, full.torque(0.5, -10.0));
}

TEST(Friction, UncertaintyIsUniformAtRestAndAFractionInMotion) {
  EXPECT_DOUBLE_EQ(plain.uncertainty(0.0, 0.1), 1.2 / std::sqrt(3.0));
  EXPECT_DOUBLE_EQ(full.uncertainty(0.0, 0.1), 2.0 / std::sqrt(3.0));         // F_s > F_c
  EXPECT_DOUBLE_EQ(full.uncertainty(0.0, 0.1, 10.0), 2.3 / std::sqrt(3.0));   // both rise with the load
  EXPECT_NEAR(full.uncertainty(0.5, 0.1), 0.12, 1e-12);
  EXPECT_NEAR(full.uncertainty(-0.5, 0.1, 10.0), 0.15, 1e-12);
  EXPECT_NEAR(full.uncertainty(1e-5, 0.1), 2.0 / std::sqrt(3.0), 1e-5);
  for (double dq = 0.0; dq < 0.1; dq += 1e-4) EXPECT_GE(full.uncertainty(dq, 0.1), full.uncertainty(dq + 1e-4, 0.1));
}

TEST(Friction, StandardDeviationAtRestIsThatOfAUniformTorque) {
  double sum = 0.0;
  const int N = 100000;
  for (int i = 0; i < N; ++i) {
    const double tau = 1.2 * (2.0 * (i + 0.5) / N - 1.0);  // stuck anywhere in +-F_c
    sum += tau * tau;
  }
  EXPECT_NEAR(std::sqrt(sum / N), plain.uncertainty(0.0, 0.05), 1e-9);
}

TEST(Friction, ProblemNamesTheParameter) {
  const auto with = [](auto change) {
    Friction f = full;
    change(f);
    return f.problem();
  };
  EXPECT_EQ(full.problem(), "");
  EXPECT_EQ(with([](Friction& f) { f.coulomb = -1; }), "friction coulomb = -1 N m; expected a finite number >= 0");
  EXPECT_EQ(with([](Friction& f) { f.viscous = nan; }), "friction viscous = nan N m s/rad; expected a finite number >= 0");
  EXPECT_EQ(with([](Friction& f) { f.offset = nan; }), "friction offset = nan N m; expected a finite number");
  EXPECT_EQ(with([](Friction& f) { f.load = -0.1; }), "friction load = -0.1 N m/N m; expected a finite number >= 0");
  EXPECT_EQ(with([](Friction& f) { f.sign_velocity = 0; }), "friction sign_velocity = 0 rad/s; expected a finite number > 0");
  EXPECT_EQ(with([](Friction& f) { f.static_ = -2; }), "friction static = -2 N m; expected a finite number >= 0, or NaN for none");
  EXPECT_EQ(with([](Friction& f) { f.stribeck_velocity = nan; }),
            "friction stribeck_velocity = nan rad/s; expected a finite number > 0, because static is given");
}

TEST(SignTravel, TwoOverAReversalHoweverSlow) {
  for (const int steps : {1, 7, 1000}) {
    SignTravel travel;
    double sum = travel.step(plain, 0.2, 1e-4);
    EXPECT_EQ(sum, 0.0);  // the first sample is where it starts
    for (int k = 1; k <= steps; ++k) sum += travel.step(plain, 0.2 - 0.4 * k / steps, 1e-4);
    EXPECT_GT(sum, 1.7);
    EXPECT_LE(sum, 2.0);
  }
}

TEST(SignTravel, NoiseAtRestAndSpeedInMotionAreNone) {
  SignTravel rest, motion;
  double sum = 0.0;
  for (int k = 0; k < 1000; ++k) {
    sum += rest.step(plain, k % 2 ? 2e-3 : -2e-3, 2e-3);
    sum += motion.step(plain, k % 2 ? 0.3 : 0.9, 2e-3);
  }
  EXPECT_EQ(sum, 0.0);
}

/// A path x(t), its excess and all friction of it.
struct Path {
  Friction friction;
  FrictionHistory history{};
  double x = 0.0, dq = 0.0;
  double go(double distance, double speed, double tau = 0.0) {  // the last excess
    const double h = 1e-3;
    const int steps = static_cast<int>(std::round(std::abs(distance) / (std::abs(speed) * h)));
    double excess = 0.0;
    dq = distance > 0.0 ? speed : -speed;
    for (int k = 0; k < steps; ++k) excess = history.step(friction, x += dq * h, 0.0, dq, tau);
    return excess;
  }
};

TEST(FrictionHistory, IsNothingWithoutMemoryAndLoad) {
  Friction f = full;
  f.load = 0.0;
  Path path{f};
  for (double d : {0.1, -0.2, 0.003}) EXPECT_EQ(path.go(d, 0.05, 20.0), 0.0);
}

TEST(FrictionHistory, FarFromAReversalItIsCoulomb) {
  Friction f = plain;
  f.presliding = 1e-3;
  for (double v : {0.002, 0.02, 0.5}) {  // slow ones too, where tanh is not yet 1
    Path path{f};
    path.go(0.01, v);
    for (double d : {-0.02, 0.02}) {
      const double sign = d > 0.0 ? 1.0 : -1.0;
      const double total = path.go(d, v) + f.torque(path.dq);
      EXPECT_NEAR(total, 1.2 * sign + f.viscous * path.dq + f.offset, 2e-3) << v;
    }
  }
}

TEST(FrictionHistory, HoldsAtRestHoweverLongAndNoisy) {
  Friction f = plain;
  f.presliding = 1e-3;
  Path path{f};
  path.go(-0.02, 0.1);
  double excess = 0.0;
  for (int k = 0; k < 100000; ++k) {
    excess = path.history.step(f, path.x + 2e-5 * (k % 3 - 1), 1e-5, 0.0, 0.0);
    if (k > 1) ASSERT_NEAR(excess, -1.2, 0.06) << k;  // within the noise it is a spring: 1.2 (1 - exp(-0.04))
  }
}

TEST(FrictionHistory, TurnsOverWithTravelNotWithTime) {
  Friction f = plain;
  f.presliding = 1e-3;
  for (double v : {0.01, 1.0}) {
    Path path{f};
    path.go(0.02, v);
    path.go(-1e-3 * std::log(2.0), v);
    EXPECT_NEAR(path.history.sign(), 0.0, v > 0.5 ? 0.6 : 0.05) << v;  // half of the way from 1 to -1, to a sample
  }
}

TEST(FrictionHistory, IsPassive) {  // over any closed path friction takes energy, never gives
  Friction f = plain;
  f.presliding = 2e-3;
  f.offset = 0.0;
  for (double amplitude : {2e-4, 1e-3, 1e-2, 0.3}) {
    FrictionHistory history;
    double work = 0.0, last = 0.0;
    const int period = 20000;
    for (int k = 0; k < 4 * period; ++k) {
      const double w = 2.0 * std::numbers::pi / period, x = amplitude * std::sin(w * k), dq = amplitude * w * 1e3 * std::cos(w * k);
      const double torque = history.step(f, x, 0.0, dq, 0.0) + f.torque(dq);
      if (k >= 3 * period) work += torque * (x - last);
      last = x;
    }
    EXPECT_GT(work, 0.0) << amplitude;
  }
}

TEST(FrictionHistory, CarriesTheLoadsPart) {
  Friction f = plain;
  f.load = 0.05;
  for (double presliding : {0.0, 1e-3}) {
    f.presliding = presliding;
    Path path{f};
    for (double d : {0.2, -0.2}) {
      const double sign = d > 0.0 ? 1.0 : -1.0, gear = 80.0;
      const double friction = (1.2 + 0.05 * gear) * sign + f.viscous * 0.5 * sign + f.offset;
      EXPECT_NEAR(path.go(d, 0.5, gear + friction) + f.torque(path.dq), friction, 1e-9);
    }
  }
}

}  // namespace
