// Abag: an adaptive-bias, adaptive-gain controller that needs the sign of the error alone and is bounded by construction.
#pragma once
#include <algorithm>
#include <cmath>

#include "palpate/check.hpp"
#include "palpate/status.hpp"

namespace palpate {

/// Rates and thresholds, for one step every `period`.
struct AbagParameters {
  double alpha = 0.75;    ///< how much of the mean sign of the error is kept per step [1], 0 <= alpha < 1
  double theta_b = 0.75;  ///< above this mean sign the bias adapts [1], 0 to 1
  double delta_b = 0.001; ///< by so much per step [1], > 0
  double theta_g = 0.5;   ///< above this mean sign the gain grows, below it shrinks [1], 0 to 1
  double delta_g = 0.001; ///< by so much per step [1], > 0
  double period = 0.008;  ///< of the steps these numbers were made for [s], > 0
  double band = 0.0;      ///< errors up to this count in part, see Abag [unit of the error], >= 0; 0: the paper's sign
  double least_gain = 0.0;  ///< lower end of the gain [1], 0 to 1; 0: the paper's

  /// W iiwa_controller.cpp, 8 ms.
  static constexpr AbagParameters whiteboard() noexcept { return {}; }
  /// Kinova Gen3 at 1 kHz (MATH.md section 8).
  static constexpr AbagParameters kinova() noexcept { return {0.9, 4.1e-4, 4e-4, 0.5, 2.6e-3, 0.001, 0.0, 0.0}; }

  /// The same behaviour in time with steps of another period [s]: alpha^(h'/h), delta h'/h.
  [[nodiscard]] AbagParameters at(double other) const {
    const double r = check::positive("AbagParameters period [s]", other) / check::positive("AbagParameters period [s]", period);
    return {std::pow(alpha, r), theta_b, std::min(1.0, delta_b * r), theta_g, std::min(1.0, delta_g * r), other, band, least_gain};
  }
};

/// Errata of published ABAG programs, for reproducing what they did.
enum class AbagForm {
  corrected,      ///< g in [0, 1], as in the paper
  negative_gain,  ///< g in [-1, 1] (W, erratum 1): below zero it pushes away from the goal; 69 % of a real log is like that
};

/// A. Franchi, A. Mallet, "Adaptive closed-loop speed control of BLDC motors with applications to multi-rotor aerial vehicles",
/// ICRA 2017, in the form of W; e = desired - measured:
///
///   e_bar <- alpha e_bar + (1 - alpha) sgn e                       mean sign of the error
///   b     <- sat[-1,1](b + delta_b H(|e_bar| - theta_b) sgn e_bar)  bias: what it takes on average (W's sgn(e_bar - theta_b) is
///                                                                  sgn e_bar wherever H is not 0: not an error)
///   g     <- sat[0,1](g + delta_g sgn(|e_bar| - theta_g))           gain: grows while the error keeps its sign, shrinks while it
///                                                                  changes, as noise does
///   u     =  sat[-1,1](b + g sgn e)
///
/// The paper's plant is damped; a frictionless arm is not, and there bias and gain shake it for ever. Two options of our own cure that:
/// with band > 0, sgn e is sat[-1,1](e/band) and sgn e_bar in the second line is e_bar; with least_gain > 0, g does not fall below it,
/// so that damping is left when all is quiet.
///
/// |u| <= 1 whatever comes in. An error that is not a number gives u = 0 and leaves the state as it was.
class Abag {
 public:
  struct State {
    double e_bar = 0.0;  ///< mean sign of the error [1]
    double b = 0.0;      ///< bias [1]
    double g = 0.0;      ///< gain [1]
    double u = 0.0;      ///< control [1]
  };

  Abag() : Abag(AbagParameters{}) {}
  explicit Abag(const AbagParameters& p, AbagForm form = AbagForm::corrected) : p_(p), lowest_gain_(form == AbagForm::corrected ? p.least_gain : -1.0) {
    if (!(p.alpha >= 0.0 && p.alpha < 1.0)) check::fail("AbagParameters alpha", p.alpha, "a number from 0 to below 1");
    if (!(p.theta_b >= 0.0 && p.theta_b <= 1.0)) check::fail("AbagParameters theta_b", p.theta_b, "a number from 0 to 1");
    if (!(p.theta_g >= 0.0 && p.theta_g <= 1.0)) check::fail("AbagParameters theta_g", p.theta_g, "a number from 0 to 1");
    check::positive("AbagParameters delta_b", p.delta_b);
    check::positive("AbagParameters delta_g", p.delta_g);
    check::positive("AbagParameters period [s]", p.period);
    check::not_negative("AbagParameters band", p.band);
    if (!(p.least_gain >= 0.0 && p.least_gain <= 1.0)) check::fail("AbagParameters least_gain", p.least_gain, "a number from 0 to 1");
    reset();
  }

  /// u for the error e = desired - measured, in any unit: only its sign counts, or its part of the band.
  double step(double e) noexcept {
    if (std::isnan(e)) {
      status_ = Status::non_finite;
      return s_.u = 0.0;
    }
    status_ = Status::ok;
    const double sgn_e = p_.band > 0.0 ? std::clamp(e / p_.band, -1.0, 1.0) : sgn(e);
    s_.e_bar = p_.alpha * s_.e_bar + (1.0 - p_.alpha) * sgn_e;
    const double size = std::abs(s_.e_bar);
    if (size > p_.theta_b) s_.b = std::clamp(s_.b + p_.delta_b * (p_.band > 0.0 ? s_.e_bar : sgn(s_.e_bar)), -1.0, 1.0);
    s_.g = std::clamp(s_.g + p_.delta_g * sgn(size - p_.theta_g), lowest_gain_, 1.0);
    return s_.u = std::clamp(s_.b + s_.g * sgn_e, -1.0, 1.0);
  }

  [[nodiscard]] const State& state() const noexcept { return s_; }
  [[nodiscard]] Status status() const noexcept { return status_; }  ///< non_finite: the last error was not a number
  void reset() noexcept {
    s_ = {};
    s_.g = std::max(0.0, lowest_gain_);
    status_ = Status::ok;
  }

 private:
  static constexpr double sgn(double x) noexcept { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0; }

  AbagParameters p_;
  double lowest_gain_;
  State s_{};
  Status status_ = Status::ok;
};

}  // namespace palpate
