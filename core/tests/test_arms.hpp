// Random but physical arms for the tests, and a small portable random generator (the same numbers everywhere).
#pragma once
#include <cmath>
#include <cstdint>

#include "palpate/arm.hpp"

namespace palpate_test {

/// SplitMix64; uniform in [a, b).
class Random {
 public:
  explicit Random(std::uint64_t seed) : x_(seed * 0x9E3779B97F4A7C15ull + 1) {}
  double operator()(double a, double b) { return a + (b - a) * static_cast<double>(next() >> 11) * 0x1.0p-53; }
  /// Standard normal number (Box-Muller).
  double normal() { return std::sqrt(-2.0 * std::log((*this)(1e-300, 1.0))) * std::cos(6.283185307179586 * (*this)(0.0, 1.0)); }
  std::uint64_t next() {
    std::uint64_t z = (x_ += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return z ^ (z >> 31);
  }

 private:
  std::uint64_t x_;
};

inline palpate::Placement random_placement(Random& r, double reach) {
  // A rotation from a random unit quaternion.
  double w = r.normal(), x = r.normal(), y = r.normal(), z = r.normal();
  const double s = 1.0 / std::sqrt(w * w + x * x + y * y + z * z);
  w *= s, x *= s, y *= s, z *= s;
  return {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z),
           2 * (y * z - w * x), 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)},
          {r(-reach, reach), r(-reach, reach), r(-reach, reach)}};
}

inline palpate::ArmDescription random_description(Random& r, int n, bool rotors = true) {
  palpate::ArmDescription d;
  d.n = n;
  d.gravity = {r(-5, 5), r(-5, 5), -8};
  for (int j = 0; j < n; ++j) {
    auto& J = d.joints[static_cast<std::size_t>(j)];
    J.T_parent_joint = random_placement(r, 0.4);
    double x = r.normal(), y = r.normal(), z = r.normal();
    const double s = 1.0 / std::sqrt(x * x + y * y + z * z);
    J.axis = {x * s, y * s, z * s};
    if (j % 3 == 0) J.axis = {0, 0, 1};
    J.prismatic = j == 4;
    J.mass = r(0.2, 5);
    J.com = {r(-.2, .2), r(-.2, .2), r(-.2, .2)};
    const double a = r(0.01, 0.1), b = r(0.01, 0.1), c = r(0.01, 0.1);  // a box of these extents squared
    J.inertia = {J.mass * (b + c), 0.0, 0.0, J.mass * (a + c), 0.0, J.mass * (a + b)};
    if (rotors) J.rotor_inertia = r(0, 0.1);
  }
  d.T_last_tip = random_placement(r, 0.2);
  d.grasp = {0.05, 0.01, 0.1};
  return d;
}
inline palpate::Arm random_arm(Random& r, int n, bool rotors = true) { return palpate::Arm(random_description(r, n, rotors)); }

}  // namespace palpate_test
