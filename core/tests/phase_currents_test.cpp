// Torque from two phase currents: amplitude, signs, the published form, calibration, and the error budget.
#include "palpate/phase_currents.hpp"

#include <gtest/gtest.h>

#include <utility>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr double pi = std::numbers::pi;

/// Phase currents of peak I at the phase angle theta [rad].
std::pair<double, double> phases(double I, double theta) { return {I * std::sin(theta), I * std::sin(theta - 2.0 * pi / 3.0)}; }

TEST(PhaseCurrents, AmplitudeAtEveryAngle) {
  for (double I : {0.0, 0.3, 7.0})
    for (int k = 0; k < 360; ++k) {
      const auto [a, b] = phases(I, k * pi / 180.0);
      EXPECT_NEAR(phase_amplitude(a, b), I, 1e-14 * (1.0 + I)) << k;
    }
}

TEST(PhaseCurrents, ThePublishedFormTurnsItsSignEveryHalfTurnAndFailsAtZero) {
  for (int k = 1; k < 360; ++k) {
    if (k == 180) continue;
    const auto [a, b] = phases(2.0, k * pi / 180.0);
    const double sign = 2.0 * b + a > 0.0 ? -1.0 : 1.0;
    if (k != 90 && k != 270) EXPECT_NEAR(published_amplitude(a, b), sign * 2.0, 1e-9) << k;
  }
  EXPECT_TRUE(std::isnan(published_amplitude(0.0, -1.0)));
  PhaseTorque published({.torque_constant = 1.0, .published = true});
  EXPECT_EQ(published.step(0.0, -1.0, 1e-3, {}).status, Status::non_finite);
  EXPECT_EQ(published.step(1.0, -0.5, 1e-3, {.controller_current = 1.0}).source, CurrentSign::published);
}

TEST(PhaseCurrents, TheErrorBudget) {  // MATH.md section 7
  double offset_low = 1e9, offset_high = 0.0, gain_low = 1e9, gain_high = 0.0, offset_sum = 0.0, gain_sum = 0.0;
  const int steps = 3600;
  for (int k = 0; k < steps; ++k) {
    const auto [a, b] = phases(1.0, 2.0 * pi * k / steps);
    const double offset = phase_amplitude(a + 0.02, b), gain = phase_amplitude(1.02 * a, b);
    offset_low = std::min(offset_low, offset), offset_high = std::max(offset_high, offset), offset_sum += offset / steps;
    gain_low = std::min(gain_low, gain), gain_high = std::max(gain_high, gain), gain_sum += gain / steps;
  }
  EXPECT_NEAR(offset_high - 1.0, 0.023, 0.0005);  // 2 % offset of one sensor: +-2.3 % ripple
  EXPECT_NEAR(1.0 - offset_low, 0.023, 0.0005);
  EXPECT_NEAR(offset_sum, 1.0, 0.0003);
  EXPECT_NEAR(gain_sum - 1.0, 0.01, 0.0002);      // 2 % gain mismatch: +1 % mean, +-1.15 % ripple
  EXPECT_NEAR(0.5 * (gain_high - gain_low), 0.0115, 0.0003);
}

TEST(PhaseCurrents, SignFromTheElectricalAngle) {
  PhaseTorque drive({.torque_constant = 0.5, .gear = 100.0, .pole_pairs = 4, .angle_offset = 0.3});
  for (double current : {3.0, -3.0})
    for (int k = 0; k < 50; ++k) {
      const double q = -1.0 + 0.04 * k, theta_e = 4 * 100.0 * q + 0.3;
      // i_a = -i_q sin theta_e, i_beta = i_q cos theta_e
      const double a = -current * std::sin(theta_e), b = 0.5 * (std::numbers::sqrt3 * current * std::cos(theta_e) - a);
      const auto out = drive.step(a, b, 1e-3, {.position = q, .controller_current = -current});  // the angle comes first
      EXPECT_EQ(out.source, CurrentSign::electrical_angle);
      EXPECT_EQ(out.status, Status::ok);
      EXPECT_NEAR(out.torque, 50.0 * current, 1e-9);
    }
}

TEST(PhaseCurrents, AWaveThatIsNoSineIsHeld) {  // where the phase order changes, both readings pass into one another
  PhaseTorque drive({.torque_constant = 0.5, .gear = 100.0, .pole_pairs = 4, .angle_offset = 0.7, .amplitude_std = 0.02});
  double worst = 0.0, ignorant = 0.0;
  int held = 0;
  for (int k = 0; k < 400; ++k) {
    const double q = 5e-5 * k, theta_e = 400.0 * q + 0.7, current = 2.0 + 0.001 * k;
    const double a = -current * std::sin(theta_e), b = 0.5 * (std::numbers::sqrt3 * current * std::cos(theta_e) - a);
    const double w = k >= 100 && k < 140 ? std::sin(pi * (k - 100) / 40.0) : 0.0;
    const auto out = drive.step(a + w * (b - a), b + w * (a - b), 1e-3, {.position = q});
    EXPECT_TRUE(out.status == Status::ok || out.status == Status::held);
    if (k < 100 || k > 165) {
      EXPECT_EQ(out.status, Status::ok);
    }
    held += out.status == Status::held;
    worst = std::max(worst, std::abs(out.current - current));
    ignorant = std::max(ignorant, std::abs(phase_amplitude(a + w * (b - a), b + w * (a - b)) - current));
  }
  EXPECT_GT(held, 20);
  EXPECT_LT(worst, 0.2 * 2.1);     // what hides below direct_share, and what the torque did in the meantime
  EXPECT_GT(ignorant, 0.25 * 2.1);  // the amplitude alone does not know
  // Where the wave lies on the q axis only its haste gives it away.
  for (const bool told : {false, true}) {
    PhaseCurrentConfig config{.torque_constant = 1.0, .pole_pairs = 1, .amplitude_std = 0.02};
    if (told) config.current_rate = 20.0;
    PhaseTorque slow(config);
    const double q = pi / 3.0;  // the two phases are each other's negative: swapped, the current turns over
    double error = 0.0;
    for (int k = 0; k < 100; ++k) {
      const double a = -2.0 * std::sin(q), b = 0.5 * (std::numbers::sqrt3 * 2.0 * std::cos(q) - a);
      const double w = k >= 20 && k < 60 ? std::sin(pi * (k - 20) / 40.0) : 0.0;
      const auto out = slow.step(a + w * (b - a), b + w * (a - b), 1e-3, {.position = q});
      error = std::max(error, std::abs(out.current - 2.0));
      if (k > 85) {
        EXPECT_EQ(out.status, Status::ok);
      }
    }
    EXPECT_EQ(error < 0.2, told) << error;
  }
  PhaseTorque fresh({.torque_constant = 0.5, .gear = 100.0, .pole_pairs = 4});
  EXPECT_EQ(fresh.step(2.0, 0.0, 1e-3, {.position = 0.0}).status, Status::warming);  // d axis only: never a good torque yet
}

TEST(PhaseCurrents, SignFromTheControllersCurrent) {
  PhaseTorque drive({.torque_constant = 0.5, .gear = -10.0});
  const auto [a, b] = phases(2.0, 1.0);
  const auto out = drive.step(a, b, 1e-3, {.controller_current = -0.1, .model_torque = -50.0});
  EXPECT_EQ(out.source, CurrentSign::controller_current);
  EXPECT_NEAR(out.current, -2.0, 1e-12);
  EXPECT_NEAR(out.torque, 10.0, 1e-12);
  EXPECT_EQ(drive.step(a, b, 1e-3, {.controller_current = 0.0}).torque, 0.0);
}

TEST(PhaseCurrents, SignFromTheModelThroughReversalsAndGlitches) {
  const double dt = 1e-3;
  PhaseTorque drive({.torque_constant = 0.4, .gear = 50.0, .amplitude_std = 0.02, .model_std = 6.0});
  Random r(2);
  int wrong = 0, judged = 0, unsure = 0;
  for (int k = 0; k < 20000; ++k) {
    const double t = k * dt, torque = 40.0 * std::sin(2.0 * t);
    const auto [a, b] = phases(std::abs(torque) / 20.0, 60.0 * t + (torque < 0.0 ? pi : 0.0));
    double model = torque + 5.0 * std::sin(0.7 * t);       // the model is wrong by 5 N m, and for 20 ms altogether
    if (k % 1571 > 700 && k % 1571 < 720) model = -model;
    const auto out = drive.step(a + 0.02 * r.normal(), b + 0.02 * r.normal(), dt, {.model_torque = model});
    EXPECT_EQ(out.source, CurrentSign::model_torque);
    if (std::abs(torque) < 10.0) continue;
    ++judged;
    if (out.status != Status::ok) ++unsure;
    else if (out.torque * torque < 0.0) ++wrong;
  }
  EXPECT_LT(wrong, judged / 50);
  EXPECT_LT(unsure, judged / 20);
}

TEST(PhaseCurrents, WithoutAnyHintTheSignIsNotKnown) {
  PhaseTorque drive({.torque_constant = 1.0});
  const auto [a, b] = phases(2.0, 1.0);
  const auto out = drive.step(a, b, 1e-3, {});
  EXPECT_EQ(out.status, Status::warming);
  EXPECT_EQ(out.torque, 0.0);
  EXPECT_EQ(out.sign_probability, 0.5);
  EXPECT_EQ(drive.step(std::nan(""), b, 1e-3, {}).status, Status::non_finite);
  (void)drive.step(a, b, 0.1, {.model_torque = 5.0});
  EXPECT_EQ(drive.step(a, b, 0.1, {.model_torque = 5.0}).status, Status::ok);
  drive.reset();
  EXPECT_EQ(drive.step(a, b, 1e-3, {}).status, Status::warming);
}

TEST(PhaseCurrents, CalibrationFindsOffsetsAndGains) {
  Random r(9);
  const double noise = 0.01;
  std::array<double, 2> error{}, squared{};
  double ratio_error = 0.0, ratio_squared = 0.0;
  PhaseCalibration found;
  const int runs = 200;
  for (int run = 0; run < runs; ++run) {
    PhaseCalibrator calibrator;
    for (int k = 0; k < 2000; ++k) {
      const auto [a, b] = phases(2.0, 0.11 * k);
      calibrator.add(a / 1.03 + 0.08 + noise * r.normal(), b / 0.98 - 0.05 + noise * r.normal());
    }
    found = calibrator.result();
    ASSERT_EQ(found.status, Status::ok);
    const std::array<double, 2> e{found.offset[0] - 0.08, found.offset[1] + 0.05};
    const double er = found.gain[1] / found.gain[0] - 0.98 / 1.03;
    for (std::size_t k = 0; k < 2; ++k) error[k] += e[k] / runs, squared[k] += e[k] * e[k] / runs;
    ratio_error += er / runs, ratio_squared += er * er / runs;
  }
  for (std::size_t k = 0; k < 2; ++k) {
    EXPECT_NEAR(error[k], 0.0, 3e-4);
    EXPECT_NEAR(std::sqrt(squared[k]) / found.offset_std[k], 1.0, 0.25);
  }
  EXPECT_NEAR(ratio_error, 0.0, 5e-4);
  EXPECT_NEAR(std::sqrt(ratio_squared) / found.gain_ratio_std, 1.0, 0.3);
  EXPECT_NEAR(found.gain[0] * found.gain[1], 1.0, 1e-12);
  // What calibration is for: the ripple is gone.
  double low = 1e9, high = 0.0;
  for (int k = 0; k < 360; ++k) {
    const auto [a, b] = phases(2.0, k * pi / 180.0);
    const auto corrected = found.apply(a / 1.03 + 0.08, b / 0.98 - 0.05);
    const double I = phase_amplitude(corrected[0], corrected[1]);
    low = std::min(low, I), high = std::max(high, I);
  }
  EXPECT_LT((high - low) / (high + low), 0.002);
}

TEST(PhaseCurrents, CalibrationSaysWhenItCannot) {
  PhaseCalibrator calibrator;
  EXPECT_EQ(calibrator.result().status, Status::warming);
  for (int k = 0; k < 1000; ++k) {
    const auto [a, b] = phases(2.0, 0.002 * k);  // a third of a turn
    calibrator.add(a, b);
  }
  EXPECT_EQ(calibrator.result().status, Status::warming);
  calibrator.reset();
  for (int k = 0; k < 1000; ++k) calibrator.add(0.0, 0.0);  // drives off
  EXPECT_EQ(calibrator.result().status, Status::warming);
}

TEST(PhaseCurrents, RefusesWhatCannotWork) {
  EXPECT_THROW(PhaseTorque({}), std::invalid_argument);  // the torque constant has no default
  EXPECT_THROW(PhaseTorque({.torque_constant = 1.0, .gear = 0.0}), std::invalid_argument);
  EXPECT_THROW(PhaseTorque({.torque_constant = 1.0, .pole_pairs = -1}), std::invalid_argument);
  EXPECT_THROW(PhaseTorque({.torque_constant = 1.0, .current_rate = 0.0}), std::invalid_argument);
  EXPECT_THROW(PhaseTorque({.torque_constant = 1.0, .direct_share = 0.0}), std::invalid_argument);
  EXPECT_THROW(PhaseTorque({.torque_constant = 1.0, .model_std = 0.0}), std::invalid_argument);
}

TEST(PhaseCurrents, AllocatesNothing) {
  PhaseTorque drive({.torque_constant = 1.0});
  PhaseCalibrator calibrator;
  const palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) {
    calibrator.add(std::sin(k), std::sin(k - 2.1));
    (void)drive.step(1.0, 0.5, 1e-3, {.model_torque = 1.0});
  }
  (void)calibrator.result();
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
