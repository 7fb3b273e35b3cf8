// The concept every disturbance observer obeys, and what several of them share.
#pragma once
#include <concepts>

#include "palpate/chain.hpp"
#include "palpate/check.hpp"

namespace palpate {

/// Turns conditioned samples into the torque the environment exerts on the joints. Laws (core/tests/laws_test.cpp):
/// nothing in, nothing out; a known push is recovered; a run in pieces equals the whole run; reset() equals new.
template <class O>
concept DisturbanceObserver = requires(O o, const JointSample& s) {
  { o.step(s) } noexcept -> std::same_as<ExternalTorque>;
  o.reset();
};

namespace detail {

inline bool unusable(const JointSample& s) noexcept {
  return s.status == Status::non_finite || s.status == Status::time_error;
}

/// Whether dq is the velocity at the sample. A differentiated one is not before `ok`, nor at a gap, where it is a mean: what
/// differences momenta or velocities begins with the first sample that has one, or a start in motion would look like a push.
inline bool knows_velocity(const JointSample& s) noexcept { return s.velocity_measured || s.status == Status::ok; }

/// An external torque with the variance of its noise, the deviation of its friction model and its status as the struct that
/// travels on.
inline ExternalTorque report(int n, const JointVector& torque, const JointVector& variance, const JointVector& friction,
                             Status status) noexcept {
  ExternalTorque out;
  out.torque = torque;
  for (int j = 0; j < n; ++j) {
    out.noise[at(j)] = std::sqrt(variance[at(j)]);
    out.std[at(j)] = std::hypot(out.noise[at(j)], friction[at(j)]);
  }
  out.status = status;
  return out;
}

/// Standard deviation of the generalised momentum p = M q' from that of q' [N m s], with the inertia of a pose nearby:
/// M is refreshed once a joint has moved by 0.1 rad, so that a step stays one sweep.
class MomentumNoise {
 public:
  const JointVector& variance(const Arm& arm, const JointSample& s) noexcept {
    bool moved = !valid_;
    for (int j = 0; j < arm.n(); ++j) moved = moved || std::abs(s.q[at(j)] - q_[at(j)]) > 0.1;
    if (moved) {
      M_ = mass_matrix<double>(arm, s.q);
      q_ = s.q;
      valid_ = true;
    }
    if (!moved && s.dq_std == dq_std_) return variance_;
    dq_std_ = s.dq_std;
    for (int i = 0; i < arm.n(); ++i) {
      double sum = 0.0;
      for (int j = 0; j < arm.n(); ++j) sum += M_(i, j) * M_(i, j) * s.dq_std[at(j)] * s.dq_std[at(j)];
      variance_[at(i)] = sum;
    }
    return variance_;
  }

 private:
  JointMatrix M_{};
  JointVector q_{}, dq_std_{}, variance_{};
  bool valid_ = false;
};

}  // namespace detail
}  // namespace palpate
