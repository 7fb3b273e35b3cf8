// Motor torque from two measured phase currents: amplitude, sign, and what the sensors' errors do to it.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>

#include "palpate/check.hpp"
#include "palpate/status.hpp"

namespace palpate {

/// Peak of three balanced sinusoidal phase currents from two of them [A], at any instant:
///   i_a = I sin theta_e,  i_b = I sin(theta_e - 2 pi/3)   =>   I = (2/sqrt 3) sqrt(i_a^2 + i_a i_b + i_b^2)  >= 0
/// (MATH.md section 7; the RMS value is I / sqrt 2).
inline double phase_amplitude(double i_a, double i_b) noexcept {
  return 2.0 / std::numbers::sqrt3 * std::sqrt(std::fmax(i_a * i_a + i_a * i_b + i_b * i_b, 0.0));
}

/// F eq. (5), I = i_a / sin(atan(-sqrt3 i_a / (2 i_b + i_a))) as a peak value (printed with a further factor that belongs to
/// the torque constant). It equals -sgn(2 i_b + i_a) phase_amplitude(i_a, i_b): its sign turns every half period, and at
/// i_a = 0 it is 0/0, NaN here. For the reproduction of the published curves only.
inline double published_amplitude(double i_a, double i_b) noexcept {
  return i_a / std::sin(std::atan(-std::numbers::sqrt3 * i_a / (2.0 * i_b + i_a)));
}

/// q-axis current i_q [A] by the Park transformation at the electrical angle theta_e [rad]:
///   i_q = -i_alpha sin theta_e + i_beta cos theta_e,   i_alpha = i_a,   i_beta = (i_a + 2 i_b)/sqrt 3.
/// theta_e is that of the rotor field (d axis); the torque is proportional to i_q, sign included.
inline double quadrature_current(double i_a, double i_b, double theta_e) noexcept {
  return -i_a * std::sin(theta_e) + (i_a + 2.0 * i_b) / std::numbers::sqrt3 * std::cos(theta_e);
}

/// d-axis current i_d [A] at the same angle: i_d = i_alpha cos theta_e + i_beta sin theta_e. A field-oriented drive keeps it at
/// zero, so what is not zero tells that the readings or the angle are wrong.
inline double direct_current(double i_a, double i_b, double theta_e) noexcept {
  return i_a * std::cos(theta_e) + (i_a + 2.0 * i_b) / std::numbers::sqrt3 * std::sin(theta_e);
}

/// Where the sign of the torque comes from, in the order of preference.
enum class CurrentSign : std::uint8_t {
  electrical_angle = 0,    ///< Park transformation with the rotor's electrical angle
  controller_current = 1,  ///< sign of the current the controller asks for or reports
  model_torque = 2,        ///< sign-tracking filter on the torque the model asks for
  published = 3,           ///< F eq. (5): turns over every half period; for reproduction only
};

struct PhaseCurrentConfig {
  double torque_constant = std::numeric_limits<double>::quiet_NaN();  ///< k_t, per ampere of peak phase current [N m/A]
  double gear = 1.0;               ///< G, motor turns per joint turn; negative if they turn against each other [1]
  int pole_pairs = 0;              ///< electrical per mechanical turn of the motor; 0: the electrical angle is not known
  double angle_offset = 0.0;       ///< electrical angle at joint position 0 [rad]
  double amplitude_std = 0.05;     ///< noise of the amplitude [A]
  double direct_share = 0.2;       ///< largest i_d that is believed beside 4 amplitude_std, part of the amplitude [1]
  double current_rate = std::numeric_limits<double>::infinity();  ///< fastest change of i_q that is believed, beside noise [A/s]
  double settle_time = 0.02;       ///< after an i_d that was not believed, readings count again so much later [s]
  double flip_rate = 5.0;          ///< sign changes to be expected near zero torque [1/s]
  double model_std = 1.0;          ///< error of the model torque that tells the sign, external torque included, at the link [N m]
  double model_time = 0.1;         ///< how long such an error lasts [s]
  bool published = false;          ///< F eq. (5) as printed
};

/// What is known beside the two currents; leave at NaN what is not.
struct PhaseHints {
  double position = std::numeric_limits<double>::quiet_NaN();            ///< joint position [rad], for the electrical angle
  double controller_current = std::numeric_limits<double>::quiet_NaN();  ///< [A], any positive scale
  double model_torque = std::numeric_limits<double>::quiet_NaN();        ///< tau the model asks for, link side [N m]
};

/// tau = k_t G I with sign (MATH.md section 7; F eq. 4). One per joint.
///
/// The sign is taken from the electrical angle if pole pairs and position are known, else from the controller's current, else
/// from a two-state filter on the model torque: with L the log-odds of the sign being plus,
///   L <- log((1 - p) e^L + p) - log(p e^L + 1 - p),  p = flip_rate dt where the amplitude is within 3 amplitude_std of zero,
///   L <- L + 2 tau_model k_t G I / model_std^2 * min(1, dt/model_time)
/// (Bayes for tau_model = +-k_t G I + an error of model_std, of which only every model_time brings a new one). A current
/// cannot change its sign but through zero: elsewhere p is a billionth per second, so a glitch of the model or a push that
/// outdoes the model for a moment does not turn the torque over.
///
/// Where a motor turns back, the change of the phase order leaves a wave for some tens of milliseconds that is no sine, and whose
/// amplitude is not the torque's. With the electrical angle known it shows as a d-axis current, or, where the field happens to
/// stand so that the wave lies on the q axis, as a current that changes faster than the drive's does (current_rate): then the
/// last good torque is repeated, as `held`.
class PhaseTorque {
 public:
  explicit PhaseTorque(const PhaseCurrentConfig& config) : config_(config) {
    check::positive("PhaseCurrentConfig torque_constant [N m/A]", config.torque_constant);
    if (!std::isfinite(config.gear) || config.gear == 0.0) check::fail("PhaseCurrentConfig gear [1]", config.gear, "a finite number other than 0");
    check::in_range("PhaseCurrentConfig pole_pairs", config.pole_pairs, 0, 1000);
    check::finite("PhaseCurrentConfig angle_offset [rad]", config.angle_offset);
    check::positive("PhaseCurrentConfig amplitude_std [A]", config.amplitude_std);
    check::positive("PhaseCurrentConfig direct_share [1]", config.direct_share);
    if (!(config.current_rate > 0.0)) check::fail("PhaseCurrentConfig current_rate [A/s]", config.current_rate, "a positive number, infinity for none");
    check::not_negative("PhaseCurrentConfig settle_time [s]", config.settle_time);
    check::positive("PhaseCurrentConfig flip_rate [1/s]", config.flip_rate);
    check::positive("PhaseCurrentConfig model_std [N m]", config.model_std);
    check::positive("PhaseCurrentConfig model_time [s]", config.model_time);
  }

  struct Torque {
    double torque = 0.0;             ///< link side [N m]
    double current = 0.0;            ///< signed peak current [A]
    double sign_probability = 0.5;   ///< that the sign is right [1]
    CurrentSign source = CurrentSign::model_torque;
    Status status = Status::warming;  ///< warming: the sign is not known (torque is 0 then); held: the readings are no sine, the
                                      ///< last good torque is repeated; non_finite: nothing was used
  };

  /// i_a, i_b measured phase currents [A]; dt time since the last call [s].
  Torque step(double i_a, double i_b, double dt, const PhaseHints& hints) noexcept {
    Torque out;
    if (!std::isfinite(i_a) || !std::isfinite(i_b) || !(dt >= 0.0) || !std::isfinite(dt)) {
      out.status = Status::non_finite;
      return out;
    }
    if (config_.published) return finish(published_amplitude(i_a, i_b), 1.0, CurrentSign::published);
    if (config_.pole_pairs > 0 && std::isfinite(hints.position)) {
      const double theta_e = config_.pole_pairs * config_.gear * hints.position + config_.angle_offset;
      const double i_d = direct_current(i_a, i_b, theta_e);
      const double i_q = quadrature_current(i_a, i_b, theta_e);
      age_ += dt;
      const bool jump = known_ && std::abs(i_q - good_) > 6.0 * config_.amplitude_std + config_.current_rate * age_;
      const bool no_sine = jump || std::abs(i_d) > 4.0 * config_.amplitude_std + config_.direct_share * phase_amplitude(i_a, i_b);
      settling_ = no_sine ? config_.settle_time : settling_ - dt;  // such a wave may pass the q axis on its way
      if (no_sine || settling_ > 0.0) {
        out = finish(good_, 1.0, CurrentSign::electrical_angle);
        out.status = known_ ? Status::held : Status::warming;
        return out;
      }
      good_ = i_q;
      age_ = 0.0;
      known_ = true;
      return finish(good_, 1.0, CurrentSign::electrical_angle);
    }
    const double amplitude = phase_amplitude(i_a, i_b);
    if (std::isfinite(hints.controller_current)) {
      const double sign = hints.controller_current < 0.0 ? -1.0 : 1.0;
      return finish(hints.controller_current == 0.0 ? 0.0 : sign * amplitude, 1.0, CurrentSign::controller_current);
    }
    track(amplitude, dt, hints.model_torque);
    const double plus = 1.0 / (1.0 + std::exp(-odds_));
    out = finish(odds_ == 0.0 ? 0.0 : std::copysign(amplitude, odds_), std::fmax(plus, 1.0 - plus), CurrentSign::model_torque);
    if (out.sign_probability < 0.9 && amplitude > 3.0 * config_.amplitude_std) out.status = Status::warming;
    return out;
  }

  void reset() noexcept {
    odds_ = good_ = age_ = settling_ = 0.0;
    known_ = false;
  }

 private:
  void track(double amplitude, double dt, double model_torque) noexcept {
    const bool near_zero = amplitude < 3.0 * config_.amplitude_std;
    const double p = 0.5 * -std::expm1(-2.0 * (near_zero ? config_.flip_rate : 1e-9) * dt);
    // log-odds after a possible flip, in a form that does not overflow
    const double e = std::exp(-std::abs(odds_));
    const double mixed = std::log((1.0 - p) + p * e) - std::log(p + (1.0 - p) * e);
    odds_ = std::copysign(mixed, odds_);
    if (std::isfinite(model_torque)) {
      const double torque = config_.torque_constant * config_.gear * amplitude;
      odds_ += 2.0 * model_torque * torque / (config_.model_std * config_.model_std) * std::fmin(1.0, dt / config_.model_time);
    }
    odds_ = std::fmin(std::fmax(odds_, -50.0), 50.0);
  }
  Torque finish(double current, double probability, CurrentSign source) const noexcept {
    Torque out;
    out.current = current;
    out.torque = config_.torque_constant * config_.gear * current;
    out.sign_probability = probability;
    out.source = source;
    out.status = std::isfinite(current) ? Status::ok : Status::non_finite;
    return out;
  }

  PhaseCurrentConfig config_;
  double odds_ = 0.0;   // log of P(plus)/P(minus)
  double good_ = 0.0;   // newest i_q that was believed [A]
  double age_ = 0.0;    // how old it is [s]
  double settling_ = 0.0;  // until readings count again [s]
  bool known_ = false;  // there was a good i_q
};

/// Offset and gain of one pair of current sensors: i_true = gain (reading - offset).
struct PhaseCalibration {
  std::array<double, 2> offset{};          ///< of a and b [A]
  std::array<double, 2> gain{1.0, 1.0};    ///< of a and b; only their ratio shows in the currents, so their product is 1 [1]
  std::array<double, 2> offset_std{};      ///< [A]
  double gain_ratio_std = 0.0;             ///< of gain_b/gain_a [1]
  Status status = Status::warming;         ///< warming: less than a turn of the field seen, or too few samples

  std::array<double, 2> apply(double reading_a, double reading_b) const noexcept {
    return {gain[0] * (reading_a - offset[0]), gain[1] * (reading_b - offset[1])};
  }
};

/// Calibrates the sensors from a motion: whatever the amplitude does, the true currents lie on the ellipse
/// i_a^2 + i_a i_b + i_b^2 = 3/4 I^2 about the origin. With I steady over the electrical turns that were seen,
///   x^2 + rho x y + rho^2 y^2 + k3 x + k4 y = k5,   x, y the readings,  rho = gain_b/gain_a,
/// whose centre is the offset; least squares by Gauss-Newton. The phase shift of 2 pi/3 ties the second and the third
/// coefficient together. A common gain belongs to the torque constant. With the drives off, offsets are just the mean reading.
class PhaseCalibrator {
 public:
  /// One pair of readings [A]. Samples of one steady speed and torque, over many electrical turns.
  void add(double x, double y) noexcept {
    if (!std::isfinite(x) || !std::isfinite(y)) return;
    const std::array<double, 6> row{x * x, x * y, y * y, x, y, 1.0};
    for (std::size_t r = 0; r < 6; ++r)
      for (std::size_t c = 0; c <= r; ++c) S_[r][c] += row[r] * row[c];
    const double angle = std::atan2((x + 2.0 * y) / std::numbers::sqrt3, x);
    sector_ |= 1u << static_cast<unsigned>(std::fmin(11.0, std::floor((angle + std::numbers::pi) / (std::numbers::pi / 6.0))));
    ++count_;
  }

  PhaseCalibration result() const noexcept {
    PhaseCalibration out;
    if (count_ < 50 || sector_ != 0xFFFu) return out;
    double ratio = 1.0, residual = 0.0;
    std::array<double, 4> k{};
    std::array<double, 16> inverse{};
    for (int pass = 0; pass < 12; ++pass) {
      if (!solve(ratio, k, inverse, residual)) return out;
      ratio += k[0];
      if (!(ratio > 0.1 && ratio < 10.0)) return out;
    }
    // Centre: gradient zero.  2 x + rho y + k3 = 0,  rho x + 2 rho^2 y + k4 = 0.
    const double det = 3.0 * ratio * ratio;
    const double a = 2.0 * ratio * ratio / det, b = ratio / det, c = 2.0 / det;
    out.offset = {b * k[2] - a * k[1], b * k[1] - c * k[2]};
    out.gain = {1.0 / std::sqrt(ratio), std::sqrt(ratio)};
    const double variance = residual / static_cast<double>(count_ - 4);
    const auto spread = [&](double f, double g) {
      return std::sqrt(variance * std::fmax(0.0, f * f * inverse[5] + g * g * inverse[10] + 2.0 * f * g * inverse[6]));
    };
    out.offset_std = {spread(-a, b), spread(b, -c)};
    out.gain_ratio_std = std::sqrt(variance * std::fmax(0.0, inverse[0]));
    out.status = Status::ok;
    return out;
  }

  void reset() noexcept { *this = PhaseCalibrator(); }

 private:
  // Sums of products of x^2, x y, y^2, x, y, 1.
  double S(std::size_t r, std::size_t c) const noexcept { return r >= c ? S_[r][c] : S_[c][r]; }

  /// Entry of the normal matrix for two combinations of the columns of S_.
  using Combination = std::array<double, 6>;
  double product(const Combination& f, const Combination& g) const noexcept {
    double sum = 0.0;
    for (std::size_t r = 0; r < 6; ++r)
      for (std::size_t c = 0; c < 6; ++c) sum += f[r] * g[c] * S(r, c);
    return sum;
  }

  /// One Gauss-Newton step about rho for k = (change of rho, k3, k4, k5), with the inverse of the normal matrix.
  bool solve(double rho, std::array<double, 4>& k, std::array<double, 16>& inverse, double& residual) const noexcept {
    const std::array<Combination, 4> column{Combination{0, -1, -2.0 * rho, 0, 0, 0}, {0, 0, 0, -1, 0, 0}, {0, 0, 0, 0, -1, 0}, {0, 0, 0, 0, 0, 1}};
    const Combination target{1, rho, rho * rho, 0, 0, 0};
    std::array<std::array<double, 8>, 4> A{};
    std::array<double, 4> b{};
    for (std::size_t r = 0; r < 4; ++r) {
      for (std::size_t c = 0; c < 4; ++c) A[r][c] = product(column[r], column[c]);
      A[r][4 + r] = 1.0;
      b[r] = product(column[r], target);
    }
    for (std::size_t p = 0; p < 4; ++p) {  // Gauss-Jordan with pivoting
      std::size_t best = p;
      for (std::size_t r = p + 1; r < 4; ++r)
        if (std::abs(A[r][p]) > std::abs(A[best][p])) best = r;
      if (!(std::abs(A[best][p]) > 1e-12 * S(5, 5))) return false;
      std::swap(A[p], A[best]);
      const double pivot = 1.0 / A[p][p];
      for (double& x : A[p]) x *= pivot;
      for (std::size_t r = 0; r < 4; ++r) {
        if (r == p) continue;
        const double f = A[r][p];
        for (std::size_t c = 0; c < 8; ++c) A[r][c] -= f * A[p][c];
      }
    }
    k = {};
    residual = product(target, target);
    for (std::size_t r = 0; r < 4; ++r) {
      for (std::size_t c = 0; c < 4; ++c) {
        inverse[4 * r + c] = A[r][4 + c];
        k[r] += A[r][4 + c] * b[c];
      }
      residual -= k[r] * b[r];
    }
    residual = std::fmax(residual, 0.0);
    return true;
  }

  std::array<std::array<double, 6>, 6> S_{};
  unsigned sector_ = 0;
  std::int64_t count_ = 0;
};

}  // namespace palpate
