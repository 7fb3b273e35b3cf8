// Friction of one joint: Coulomb, viscous, offset, Stribeck, load-dependent; with its derivative and its uncertainty.
#pragma once
#include <cmath>
#include <cstdio>
#include <limits>
#include <string>

namespace palpate {

/// tau_f = (F_c + (F_s - F_c0) exp(-(dq/v_s)^2)) tanh(dq/v_0) + F_v dq + F_o,   F_c = F_c0 + load |tau_load|
/// (MATH.md section 6), on the side of M q'' + C q' + g + tau_f = tau + tau_ext: tau_f > 0 brakes forward motion.
///
/// dq [rad/s]; F_c0 coulomb, F_v viscous, F_o offset, F_s static_, v_s stribeck_velocity, v_0 sign_velocity.
/// tanh stands for sgn, so that derivatives exist; what a joint remembers of the way it came is FrictionHistory's. The Stribeck excess F_s - F_c0 does not depend on the load: with
/// load, static friction rises as much as Coulomb friction does.
struct Friction {
  double coulomb = 0.0;   ///< F_c0 [N m]
  double viscous = 0.0;   ///< F_v [N m s/rad]
  double offset = 0.0;    ///< F_o [N m]
  double static_ = std::numeric_limits<double>::quiet_NaN();            ///< F_s [N m]; NaN: no Stribeck effect
  double stribeck_velocity = std::numeric_limits<double>::quiet_NaN();  ///< v_s [rad/s]; needed only with static_
  double load = 0.0;            ///< Coulomb friction per load torque [1]
  double sign_velocity = 1e-2;  ///< v_0 [rad/s], width of the smooth sign
  double presliding = 0.0;      ///< x_0 [rad], travel over which the sign turns after a reversal (FrictionHistory); 0: no memory

  [[nodiscard]] bool has_stribeck() const noexcept { return !std::isnan(static_); }

  /// Friction torque [N m]. T: double, or any scalar with + - * / and tanh, exp, abs found by its namespace.
  /// tau_load [N m]: torque the gear transmits, of either sign; T or double.
  template <class T, class L = double>
  [[nodiscard]] T torque(const T& dq, const L& tau_load = L(0.0)) const noexcept {
    using std::tanh;
    return level(dq, tau_load) * tanh(dq / sign_velocity) + viscous * dq + offset;
  }

  /// What the sign is multiplied by: F_c + (F_s - F_c0) exp(-(dq/v_s)^2) [N m].
  template <class T, class L = double>
  [[nodiscard]] T level(const T& dq, const L& tau_load = L(0.0)) const noexcept {
    using std::abs, std::exp;
    T level = T(coulomb + load * abs(tau_load));
    if (has_stribeck()) {
      const T x = dq / stribeck_velocity;
      level = level + (static_ - coulomb) * exp(x * x * -1.0);
    }
    return level;
  }

  /// d tau_f / d dq [N m s/rad].
  [[nodiscard]] double derivative(double dq, double tau_load = 0.0) const noexcept {
    const double sign = std::tanh(dq / sign_velocity);
    double level = coulomb + load * std::abs(tau_load);
    double slope = viscous;
    if (has_stribeck()) {
      const double x = dq / stribeck_velocity;
      const double excess = (static_ - coulomb) * std::exp(-x * x);
      level += excess;
      slope -= 2.0 * x / stribeck_velocity * excess * sign;
    }
    return slope + level * (1.0 - sign * sign) / sign_velocity;
  }

  /// Standard deviation [N m] of the friction torque about torque().
  ///
  /// At rest friction is any torque within +-F, F the level at no speed: uniform, hence F/sqrt(3). In motion the model is
  /// good to a fraction [1] of the level. In between the variances are mixed with the weight 1 - tanh^2(dq/v_0) of "at rest".
  [[nodiscard]] double uncertainty(double dq, double fraction, double tau_load = 0.0) const noexcept {
    const double sign = std::tanh(dq / sign_velocity);
    const double rest = level(0.0, tau_load), moving = fraction * level(dq, tau_load);
    return std::sqrt((1.0 - sign * sign) * rest * rest / 3.0 + sign * sign * moving * moving);
  }

  /// What is wrong with the parameters, in one line; empty if nothing is. Every constructor that takes one asks.
  [[nodiscard]] std::string problem() const {
    const auto not_negative = [](double x) { return std::isfinite(x) && x >= 0.0; };
    const auto positive = [](double x) { return std::isfinite(x) && x > 0.0; };
    const auto says = [](const char* what, double x, const char* unit, const char* expected) {
      char line[160];
      std::snprintf(line, sizeof line, "friction %s = %.9g %s; expected %s", what, x, unit, expected);
      return std::string(line);
    };
    if (!not_negative(coulomb)) return says("coulomb", coulomb, "N m", "a finite number >= 0");
    if (!not_negative(viscous)) return says("viscous", viscous, "N m s/rad", "a finite number >= 0");
    if (!std::isfinite(offset)) return says("offset", offset, "N m", "a finite number");
    if (!not_negative(load)) return says("load", load, "N m/N m", "a finite number >= 0");
    if (!positive(sign_velocity)) return says("sign_velocity", sign_velocity, "rad/s", "a finite number > 0");
    if (!not_negative(presliding)) return says("presliding", presliding, "rad", "a finite number >= 0");
    if (!has_stribeck()) return {};
    if (!not_negative(static_)) return says("static", static_, "N m", "a finite number >= 0, or NaN for none");
    if (!positive(stribeck_velocity))
      return says("stribeck_velocity", stribeck_velocity, "rad/s", "a finite number > 0, because static is given");
    return {};
  }
};

/// What a joint's friction is beyond the function of its velocity, Friction::torque(dq): what it remembers, and its load's part.
///
/// A joint at rest keeps the friction it stopped with, and after a reversal friction turns over within a few x_0 of travel,
/// not at once. Its sign is Dahl's state (1968, Aerospace Corporation TOR-0158(3107-18)-1),
///   z <- s + (z - s) exp(-|dx|/x_0),   s = sgn dx,   |z| <= 1,
/// dx the travel, kept once it is beyond noise, four standard deviations of the position and x_0/20: until then it is elastic,
/// and noise at rest wears nothing off. z = 0 until the joint has moved. tau_f = (F_c + ...) z + F_v dq + F_o; with
/// presliding = 0, z = tanh(dq/v_0). tau_load of F_c = F_c0 + load |tau_load| is what the gear passes on: the torque of the
/// motor without the friction, nor what its rotor takes.
class FrictionHistory {
 public:
  /// tau_f - Friction::torque(dq) [N m], a mean over the time since the last call. q, q_std [rad]; dq [rad/s];
  /// tau, without the rotor's part [N m].
  double step(const Friction& friction, double q, double q_std, double dq, double tau) noexcept {
    if (friction.presliding == 0.0 && friction.load == 0.0) return 0.0;
    if (!started_) q_ = q, tau_load_ = tau;
    const double smooth = std::tanh(dq / friction.sign_velocity);
    double sign = smooth;
    if (friction.presliding > 0.0) {
      const double travel = std::abs(q - q_), s = q > q_ ? 1.0 : -1.0;
      sign = s + (z_ - s) * std::exp(-travel / friction.presliding);
      if (travel > std::fmax(4.0 * q_std, 0.05 * friction.presliding)) z_ = sign, q_ = q;
    }
    const double excess = friction.level(dq, tau_load_) * sign - friction.level(dq) * smooth;
    tau_load_ = tau - friction.torque(dq) - excess;
    const double mean = started_ ? 0.5 * (excess + excess_) : excess;
    excess_ = excess;
    started_ = true;
    return mean;
  }

  /// z in [-1, 1], as last kept.
  [[nodiscard]] double sign() const noexcept { return z_; }

 private:
  double q_ = 0.0, z_ = 0.0, excess_ = 0.0, tau_load_ = 0.0;
  bool started_ = false;
};

/// How far a joint has gone through its friction's sign since it was last asked, in tanh(dq/v_0): 0 at rest and in steady
/// motion, 2 in all over a reversal, 1 over a start or a stop.
///
/// What the friction model gets wrong at one sign says little about the other, so an error is renewed in proportion to this.
/// Steps smaller than 0.3, or than four standard deviations of the noise, are saved up: summing the noise of dq at rest would
/// renew the error at every sample.
class SignTravel {
 public:
  /// dq, dq_std [rad/s].
  double step(const Friction& friction, double dq, double dq_std) noexcept {
    const double sign = std::tanh(dq / friction.sign_velocity);
    const double travel = std::abs(sign - at_);
    if (!started_) {
      started_ = true;
      at_ = sign;
      return 0.0;
    }
    if (travel < std::fmax(0.3, std::fmin(4.0 * dq_std / friction.sign_velocity, 0.9))) return 0.0;
    at_ = sign;
    return travel;
  }

 private:
  double at_ = 0.0;
  bool started_ = false;
};

}  // namespace palpate
