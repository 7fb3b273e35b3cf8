// From an estimated force to one that a hand may be shown.
#pragma once
#include <cmath>

#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate::teleop {

/// Force felt = w(r) F,  r = |F|/(z sigma),  w = 0 for r <= 1, smooth (C1) up to 1 at r = 2, 1 beyond.
///
/// F [N] estimated force, sigma [N] its standard deviation, component by component, z the detection threshold in standard deviations.
/// Below it nothing is felt, because there may be nothing; from twice the threshold on the force is felt whole: a dead zone
/// that is subtracted would make every force too small.
class FeltForce {
 public:
  explicit FeltForce(double threshold = 3.0) : z_(check::not_negative("FeltForce threshold [1]", threshold)) {}

  [[nodiscard]] double operator()(double force, double std) const noexcept {
    if (!std::isfinite(force) || std::isnan(std)) return 0.0;
    const double bound = z_ * std;
    if (!(bound > 0.0)) return force;
    const double x = std::abs(force) / bound - 1.0;
    if (!(x > 0.0)) return 0.0;
    return x >= 1.0 ? force : x * x * (3.0 - 2.0 * x) * force;
  }
  double threshold() const noexcept { return z_; }

 private:
  double z_;
};

}  // namespace palpate::teleop
