// Scalars the recursions run on: double, and Dual<N> for exact derivatives; one sin/cos for all of them.
//
// sin and cos are our own so that every scalar type, live or in SIMD lanes, rounds alike: the same additions and
// multiplications in the same order, no table, no branch.
#pragma once
#include <array>
#include <cmath>
#include <concepts>
#include <cstddef>
#include <cstdint>

namespace palpate {

/// sin(x) and cos(x) together. x [rad], |x| <= 1e6; error below 1 ulp there.
///
/// Cody-Waite reduction by pi/2 in three parts, then the minimax polynomials of the classic fdlibm kernels
/// (coefficients: Sun Microsystems fdlibm 5.3, k_sin.c and k_cos.c, freely usable).
inline void sincos(double x, double& s, double& c) noexcept {
  constexpr double two_over_pi = 6.36619772367581382433e-01;
  constexpr double pio2_1 = 1.57079632673412561417e+00;  // first 33 bits of pi/2
  constexpr double pio2_2 = 6.07710050630396597660e-11;  // next 33 bits
  constexpr double pio2_3 = 2.02226624871116645580e-21;  // and the next
  constexpr double round = 6755399441055744.0;           // 1.5 * 2^52: adding it rounds to the nearest integer
  const double k = (x * two_over_pi + round) - round;
  const double r = ((x - k * pio2_1) - k * pio2_2) - k * pio2_3;
  const double z = r * r;
  const double sp = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 +
                    z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
  const double cp = z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 +
                    z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 + z * -1.13596475577881948265e-11)))));
  const double half = 0.5 * z;
  const double w = 1.0 - half;
  const double cr = w + ((1.0 - w) - half + cp);
  // Quadrant of k modulo 4; the conversion is defined because |k| stays far below 2^62 for accepted angles.
  const auto quadrant = static_cast<std::int64_t>(k) & 3;
  const double a = (quadrant & 1) ? cr : sp;
  const double b = (quadrant & 1) ? sp : cr;
  s = (quadrant & 2) ? -a : a;
  c = (quadrant == 1 || quadrant == 2) ? -b : b;
}

/// Forward-mode automatic differentiation: v + sum_i d[i] eps_i with eps_i eps_j = 0.
template <int N>
struct Dual {
  double v = 0.0;                                ///< value
  std::array<double, static_cast<std::size_t>(N)> d{};  ///< partial derivatives

  constexpr Dual() noexcept = default;
  constexpr Dual(double value) noexcept : v(value) {}  // NOLINT: constants mix freely with duals
  /// Independent variable number i.
  static constexpr Dual variable(double value, int i) noexcept {
    Dual x(value);
    x.d[static_cast<std::size_t>(i)] = 1.0;
    return x;
  }

  friend constexpr Dual operator+(const Dual& a, const Dual& b) noexcept {
    return combine(a.v + b.v, a, 1.0, b, 1.0);
  }
  friend constexpr Dual operator-(const Dual& a, const Dual& b) noexcept {
    return combine(a.v - b.v, a, 1.0, b, -1.0);
  }
  friend constexpr Dual operator*(const Dual& a, const Dual& b) noexcept { return combine(a.v * b.v, a, b.v, b, a.v); }
  friend constexpr Dual operator/(const Dual& a, const Dual& b) noexcept {
    return combine(a.v / b.v, a, 1.0 / b.v, b, -a.v / (b.v * b.v));
  }
  friend constexpr Dual operator-(const Dual& a) noexcept { return chain(-a.v, a, -1.0); }
  constexpr Dual& operator+=(const Dual& b) noexcept { return *this = *this + b; }
  constexpr Dual& operator-=(const Dual& b) noexcept { return *this = *this - b; }
  constexpr Dual& operator*=(const Dual& b) noexcept { return *this = *this * b; }

  /// f(a) with value fv and slope df.
  static constexpr Dual chain(double fv, const Dual& a, double df) noexcept {
    Dual r(fv);
    for (std::size_t i = 0; i < static_cast<std::size_t>(N); ++i) r.d[i] = df * a.d[i];
    return r;
  }

 private:
  static constexpr Dual combine(double v, const Dual& a, double fa, const Dual& b, double fb) noexcept {
    Dual r(v);
    for (std::size_t i = 0; i < static_cast<std::size_t>(N); ++i) r.d[i] = fa * a.d[i] + fb * b.d[i];
    return r;
  }
};

template <int N>
void sincos(const Dual<N>& x, Dual<N>& s, Dual<N>& c) noexcept {
  double sv, cv;
  sincos(x.v, sv, cv);
  s = Dual<N>::chain(sv, x, cv);
  c = Dual<N>::chain(cv, x, -sv);
}
template <int N>
Dual<N> sqrt(const Dual<N>& x) noexcept {
  const double r = std::sqrt(x.v);
  return Dual<N>::chain(r, x, 0.5 / r);
}
template <int N>
Dual<N> exp(const Dual<N>& x) noexcept {
  const double r = std::exp(x.v);
  return Dual<N>::chain(r, x, r);
}
template <int N>
Dual<N> tanh(const Dual<N>& x) noexcept {
  const double r = std::tanh(x.v);
  return Dual<N>::chain(r, x, 1.0 - r * r);
}
template <int N>
Dual<N> abs(const Dual<N>& x) noexcept {
  return x.v < 0.0 ? -x : x;
}

/// The value of a scalar without its derivatives.
constexpr double value(double x) noexcept { return x; }
template <int N>
constexpr double value(const Dual<N>& x) noexcept { return x.v; }

}  // namespace palpate
