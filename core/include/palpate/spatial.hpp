// Three-vectors, rotations and rigid-body inertia: just what the recursions of chain.hpp need.
// Plain aggregates: `Vec3<T> a{}` is zero, `Vec3<T> a` is not set (the recursions fill their work space themselves).
#pragma once
#include "palpate/scalar.hpp"

namespace palpate {

template <class T>
struct Vec3 {
  T x, y, z;
};
template <class T> constexpr Vec3<T> operator+(const Vec3<T>& a, const Vec3<T>& b) noexcept { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T> constexpr Vec3<T> operator-(const Vec3<T>& a, const Vec3<T>& b) noexcept { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T> constexpr Vec3<T> operator-(const Vec3<T>& a) noexcept { return {-a.x, -a.y, -a.z}; }
template <class T, class S> constexpr auto operator*(const S& s, const Vec3<T>& a) noexcept -> Vec3<decltype(s * a.x)> { return {s * a.x, s * a.y, s * a.z}; }
template <class T> constexpr T dot(const Vec3<T>& a, const Vec3<T>& b) noexcept { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class A, class B> constexpr auto cross(const Vec3<A>& a, const Vec3<B>& b) noexcept -> Vec3<decltype(a.x * b.x)> {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T> Vec3<T> lift(const Vec3<double>& a) noexcept { return {T(a.x), T(a.y), T(a.z)}; }

/// 3x3 matrix by columns; for rotations R_a_b the columns are the axes of b in a.
template <class T>
struct Mat3 {
  Vec3<T> cx, cy, cz;
};
inline constexpr Mat3<double> identity3{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
template <class A, class B> constexpr auto operator*(const Mat3<A>& R, const Vec3<B>& a) noexcept -> Vec3<decltype(R.cx.x * a.x)> {
  return {R.cx.x * a.x + R.cy.x * a.y + R.cz.x * a.z, R.cx.y * a.x + R.cy.y * a.y + R.cz.y * a.z, R.cx.z * a.x + R.cy.z * a.y + R.cz.z * a.z};
}
template <class A, class B> constexpr auto operator*(const Mat3<A>& R, const Mat3<B>& S) noexcept -> Mat3<decltype(R.cx.x * S.cx.x)> {
  return {R * S.cx, R * S.cy, R * S.cz};
}
/// R^T a, for a rotation: from the outer frame into the inner one.
template <class A, class B> constexpr auto transposed(const Mat3<A>& R, const Vec3<B>& a) noexcept -> Vec3<decltype(R.cx.x * a.x)> {
  return {R.cx.x * a.x + R.cx.y * a.y + R.cx.z * a.z, R.cy.x * a.x + R.cy.y * a.y + R.cy.z * a.z, R.cz.x * a.x + R.cz.y * a.y + R.cz.z * a.z};
}
template <class T> constexpr Mat3<T> transpose(const Mat3<T>& R) noexcept {
  return {{R.cx.x, R.cy.x, R.cz.x}, {R.cx.y, R.cy.y, R.cz.y}, {R.cx.z, R.cy.z, R.cz.z}};
}

/// Symmetric 3x3 matrix.
template <class T>
struct Sym3 {
  T xx, xy, xz, yy, yz, zz;
};
template <class T> constexpr Sym3<T> operator+(const Sym3<T>& a, const Sym3<T>& b) noexcept { return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz}; }
template <class T> constexpr Sym3<T> operator-(const Sym3<T>& a, const Sym3<T>& b) noexcept { return {a.xx - b.xx, a.xy - b.xy, a.xz - b.xz, a.yy - b.yy, a.yz - b.yz, a.zz - b.zz}; }
template <class A, class B> constexpr auto operator*(const Sym3<A>& I, const Vec3<B>& a) noexcept -> Vec3<decltype(I.xx * a.x)> {
  return {I.xx * a.x + I.xy * a.y + I.xz * a.z, I.xy * a.x + I.yy * a.y + I.yz * a.z, I.xz * a.x + I.yz * a.y + I.zz * a.z};
}
/// R I R^T: a tensor from the inner frame of R to the outer one.
template <class A, class B> constexpr auto rotated(const Mat3<A>& R, const Sym3<B>& I) noexcept -> Sym3<decltype(R.cx.x * I.xx)> {
  const auto ax = I.xx * R.cx + I.xy * R.cy + I.xz * R.cz;  // columns of R I
  const auto ay = I.xy * R.cx + I.yy * R.cy + I.yz * R.cz;
  const auto az = I.xz * R.cx + I.yz * R.cy + I.zz * R.cz;
  return {ax.x * R.cx.x + ay.x * R.cy.x + az.x * R.cz.x, ax.x * R.cx.y + ay.x * R.cy.y + az.x * R.cz.y,
          ax.x * R.cx.z + ay.x * R.cy.z + az.x * R.cz.z, ax.y * R.cx.y + ay.y * R.cy.y + az.y * R.cz.y,
          ax.y * R.cx.z + ay.y * R.cy.z + az.y * R.cz.z, ax.z * R.cx.z + ay.z * R.cy.z + az.z * R.cz.z};
}
/// (a.b) 1 - (a b^T + b a^T)/2, doubled: the mixed term of moving a first moment a by b. parallel_axis(c, c)/2 = |c|^2 1 - c c^T.
template <class T> constexpr Sym3<T> parallel_axis(const Vec3<T>& a, const Vec3<T>& b) noexcept {
  return {T(2.0) * (a.y * b.y + a.z * b.z), -(a.x * b.y + a.y * b.x), -(a.x * b.z + a.z * b.x),
          T(2.0) * (a.x * b.x + a.z * b.z), -(a.y * b.z + a.z * b.y), T(2.0) * (a.x * b.x + a.y * b.y)};
}

/// Inertia of a rigid body about the origin of the frame it is written in: linear in its ten numbers, so bodies add.
template <class T>
struct Inertia {
  T m;          ///< mass [kg]
  Vec3<T> mc;   ///< first moment m c [kg m]
  Sym3<T> I;    ///< second moment about the frame's origin [kg m^2]
};
template <class T> constexpr Inertia<T> operator+(const Inertia<T>& a, const Inertia<T>& b) noexcept { return {a.m + b.m, a.mc + b.mc, a.I + b.I}; }
template <class T> constexpr Inertia<T> operator*(double s, const Inertia<T>& a) noexcept {
  return {s * a.m, s * a.mc, {s * a.I.xx, s * a.I.xy, s * a.I.xz, s * a.I.yy, s * a.I.yz, s * a.I.zz}};
}
template <class T> Inertia<T> lift(const Inertia<double>& a) noexcept {
  return {T(a.m), lift<T>(a.mc), {T(a.I.xx), T(a.I.xy), T(a.I.xz), T(a.I.yy), T(a.I.yz), T(a.I.zz)}};
}
/// The same body written in an outer frame, in which the inner one has the placement (R, p).
template <class A, class B> constexpr auto moved(const Mat3<A>& R, const Vec3<A>& p, const Inertia<B>& b) noexcept -> Inertia<decltype(R.cx.x * b.m)> {
  using T = decltype(R.cx.x * b.m);
  const Vec3<T> rc = R * b.mc;
  const Vec3<T> mp = b.m * p;
  // I' = R I R^T + parallel_axis(rc, p) + m parallel_axis(p, p)/2
  const Vec3<T> h = rc + 0.5 * mp;
  return {T(b.m), rc + mp, rotated(R, b.I) + parallel_axis<T>(h, p)};
}
/// Inertia about the frame's origin of a body given by mass, centre of mass and inertia about it.
inline Inertia<double> about_origin(double m, const Vec3<double>& c, const Sym3<double>& I_c) noexcept {
  return {m, m * c, I_c + parallel_axis(0.5 * m * c, c)};
}

}  // namespace palpate
