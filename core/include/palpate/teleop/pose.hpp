// Poses as vectors of numbers: sums and differences where some axes are an orientation.
#pragma once
#include <algorithm>
#include <cmath>

#include "palpate/spatial.hpp"
#include "palpate/types.hpp"

namespace palpate::teleop {

/// Rotation by a rotation vector theta [rad], axis times angle: R = exp([theta]_x). As a unit quaternion, because its logarithm is as good
/// near pi as near 0, unlike the matrix's.
struct Turn {
  double w = 1.0;
  Vec3<double> v{};

  static Turn exp(const Vec3<double>& theta) noexcept {
    const double angle = std::sqrt(dot(theta, theta));
    return {std::cos(0.5 * angle), (angle > 0.0 ? std::sin(0.5 * angle) / angle : 0.5) * theta};
  }
  /// Of a rotation matrix; its largest component first, so that no digits are lost at any angle (S. W. Shepperd, J. Guidance and Control 1(3), 1978).
  static Turn of(const Mat3<double>& R) noexcept {
    const double x = R.cx.x, y = R.cy.y, z = R.cz.z;
    Turn q;
    if (x + y + z >= std::max({x, y, z})) q = {1.0 + x + y + z, {R.cy.z - R.cz.y, R.cz.x - R.cx.z, R.cx.y - R.cy.x}};
    else if (x >= y && x >= z) q = {R.cy.z - R.cz.y, {1.0 + x - y - z, R.cx.y + R.cy.x, R.cz.x + R.cx.z}};
    else if (y >= z) q = {R.cz.x - R.cx.z, {R.cx.y + R.cy.x, 1.0 - x + y - z, R.cy.z + R.cz.y}};
    else q = {R.cx.y - R.cy.x, {R.cz.x + R.cx.z, R.cy.z + R.cz.y, 1.0 - x - y + z}};
    const double scale = 1.0 / std::sqrt(q.w * q.w + dot(q.v, q.v));
    return {scale * q.w, scale * q.v};
  }
  [[nodiscard]] Mat3<double> matrix() const noexcept {
    const auto column = [this](const Vec3<double>& e) {
      const Vec3<double> t = 2.0 * cross(v, e);
      return e + w * t + cross(v, t);
    };
    return {column({1, 0, 0}), column({0, 1, 0}), column({0, 0, 1})};
  }
  /// theta, |theta| <= pi; at pi the one of the two that the signs of the numbers give.
  [[nodiscard]] Vec3<double> log() const noexcept {
    const double sine = std::sqrt(dot(v, v));
    const double scale = sine > 0.0 ? 2.0 * std::atan2(sine, std::abs(w)) / sine : 2.0;
    return (w < 0.0 ? -scale : scale) * v;
  }
  [[nodiscard]] Turn inverse() const noexcept { return {w, -v}; }
  friend Turn operator*(const Turn& a, const Turn& b) noexcept { return {a.w * b.w - dot(a.v, b.v), a.w * b.v + b.w * a.v + cross(a.v, b.v)}; }
};

/// n axes of a side. Without a pose they are numbers. With one, axes 0 to 2 are a place [m] and axes 3 to 5 an orientation R, written as its
/// rotation vector [rad]; further axes are numbers.
///
/// What is added to an orientation, and what lies between two, is a rotation vector in the axes of the base, which does not turn with it:
///
///   R (+) d = exp(d) R,     R_2 (-) R_1 = log(R_2 R_1^T)
///
/// (C. Hertzberg, R. Wagner, U. Frese, L. Schroeder, Information Fusion 14(1), 2013). So velocity [rad/s], step [rad] and torque [N m] are
/// vectors of the same axes, power is their product, and limits, springs and energy are the same code for every axis.
class Manifold {
 public:
  Manifold(std::size_t n, bool pose) noexcept : n_(n), pose_(pose) {}

  [[nodiscard]] JointVector plus(const JointVector& x, const JointVector& d) const noexcept {
    JointVector out{};
    for (std::size_t i = 0; i < n_; ++i) out[i] = x[i] + d[i];
    if (!pose_) return out;
    const Vec3<double> step = turn(d);
    if (dot(step, step) == 0.0) put(out, turn(x));  // what stands still does so to the last digit
    else put(out, (Turn::exp(step) * Turn::exp(turn(x))).log());
    return out;
  }
  [[nodiscard]] JointVector minus(const JointVector& to, const JointVector& from) const noexcept {
    JointVector out{};
    for (std::size_t i = 0; i < n_; ++i) out[i] = to[i] - from[i];
    if (pose_) put(out, (Turn::exp(turn(to)) * Turn::exp(turn(from)).inverse()).log());
    return out;
  }
  [[nodiscard]] bool pose() const noexcept { return pose_; }
  /// Axis i is one of an orientation.
  [[nodiscard]] bool turns(std::size_t i) const noexcept { return pose_ && i >= 3 && i < 6; }
  static Vec3<double> turn(const JointVector& x) noexcept { return {x[3], x[4], x[5]}; }
  static void put(JointVector& x, const Vec3<double>& theta) noexcept { x[3] = theta.x, x[4] = theta.y, x[5] = theta.z; }

 private:
  std::size_t n_;
  bool pose_;
};

}  // namespace palpate::teleop
