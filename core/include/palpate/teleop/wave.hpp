// Wave variables, for comparison with the passivity layer.
#pragma once
#include <cmath>

#include "palpate/check.hpp"

namespace palpate::teleop {

/// G. Niemeyer, J.-J. E. Slotine, IEEE J. Oceanic Engineering 16(1), 1991; one axis:
///
///   u = (b v + F)/sqrt(2 b),   w = (b v - F)/sqrt(2 b),   F v = (u^2 - w^2)/2
///
/// The master sends u and gets w, the slave the other way round, so whatever the constant delay is, the line between them is passive.
/// A wave that is lost counts as zero, which only takes energy out; each is used once. Position is not sent: every loss leaves a drift, and
/// with a long delay the hand feels the impedance b. That is why palpate couples by energy tanks instead.
class WaveLine {
 public:
  /// b [N s/m] the impedance of the line, > 0.
  explicit WaveLine(double b) : b_(check::positive("WaveLine b [N s/m]", b)) {}

  struct Master {
    double force = 0.0;  ///< on the hand [N]
    double wave = 0.0;   ///< u, to be sent [sqrt(W)]
  };
  struct Slave {
    double velocity = 0.0;  ///< of the reference [m/s]
    double wave = 0.0;      ///< w, to be sent [sqrt(W)]
  };
  /// velocity of the hand [m/s], the wave that came, 0 if none did.
  [[nodiscard]] Master master(double velocity, double wave) const noexcept {
    return {std::sqrt(2.0 * b_) * wave - b_ * velocity, std::sqrt(2.0 * b_) * velocity - wave};
  }
  /// force with which the reference pulls at the slave while it stands still [N], how much more per speed of it [N s/m], the wave that came,
  /// 0 if none did.
  [[nodiscard]] Slave slave(double force, double wave, double damping = 0.0) const noexcept {
    const double v = (std::sqrt(2.0 * b_) * wave - force) / (b_ + damping);
    return {v, wave - std::sqrt(2.0 / b_) * (force + damping * v)};
  }

 private:
  double b_;
};

}  // namespace palpate::teleop
