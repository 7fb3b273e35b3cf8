// A simulated arm on a test bench: the truth that estimates are compared with.
//
// The plant is integrated finely (Runge-Kutta 4) with friction, an external torque per joint and a load on the last link;
// the controller runs at the sample rate on the true state and its torque is held between samples, as drives do.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <vector>

#include "palpate/chain.hpp"
#include "test_arms.hpp"

namespace palpate_test {

constexpr std::size_t at(int i) { return static_cast<std::size_t>(i); }

/// Random's streams of neighbouring seeds are one stream, shifted by a number; these overlap only after 2^32 numbers.
inline Random independent(std::uint64_t seed) { return Random(seed << 32); }

/// M q'' + C q' + g + tau_f = tau + push, with a load on the last link.
struct Plant {
  const palpate::Arm* arm;
  palpate::JointVector q{}, dq{};
  palpate::JointVector push{};  // tau_ext [N m]
  palpate::Inertia<double> load{};

  palpate::JointVector acceleration(const palpate::JointVector& tau) const { return acceleration(q, dq, tau); }
  void advance(const palpate::JointVector& tau, double seconds, double longest_step) {
    const int steps = std::max(1, static_cast<int>(std::ceil(seconds / longest_step - 1e-9)));
    for (int k = 0; k < steps; ++k) step(tau, seconds / steps);
  }

 private:
  palpate::JointVector acceleration(const palpate::JointVector& x, const palpate::JointVector& v, palpate::JointVector tau) const {
    const palpate::JointVector friction = arm->friction_torque(v);
    for (int j = 0; j < arm->n(); ++j) tau[at(j)] += push[at(j)] - friction[at(j)];
    return palpate::forward_dynamics<double>(*arm, x, v, tau, load);
  }
  void step(const palpate::JointVector& tau, double h) {
    const auto ahead = [&](const palpate::JointVector& a, const palpate::JointVector& b, double s) {
      palpate::JointVector r = a;
      for (int j = 0; j < arm->n(); ++j) r[at(j)] += s * b[at(j)];
      return r;
    };
    const palpate::JointVector v1 = dq, a1 = acceleration(q, dq, tau);
    const palpate::JointVector v2 = ahead(dq, a1, h / 2), a2 = acceleration(ahead(q, v1, h / 2), v2, tau);
    const palpate::JointVector v3 = ahead(dq, a2, h / 2), a3 = acceleration(ahead(q, v2, h / 2), v3, tau);
    const palpate::JointVector v4 = ahead(dq, a3, h), a4 = acceleration(ahead(q, v3, h), v4, tau);
    for (int j = 0; j < arm->n(); ++j) {
      q[at(j)] += h / 6 * (v1[at(j)] + 2 * v2[at(j)] + 2 * v3[at(j)] + v4[at(j)]);
      dq[at(j)] += h / 6 * (a1[at(j)] + 2 * a2[at(j)] + 2 * a3[at(j)] + a4[at(j)]);
    }
  }
};

/// What happens on the bench. The arm starts at rest in q0 and swings about it, every joint at its own frequency.
struct Scene {
  double seconds = 2.0;
  double rate = 250.0;           // [Hz]
  double jitter = 0.0;           // of the sample instants, part of the period
  double swing = 0.3;            // [rad]
  double stiffness = 8.0;        // of the computed-torque controller, natural frequency [rad/s]
  palpate::JointVector q0{};
  std::function<void(double, Plant&)> events = [](double, Plant&) {};  // called before every interval with its start [s]
  double longest_step = 1e-3;    // of the plant [s]
  std::uint64_t seed = 1;
};

struct Recording {
  std::vector<palpate::RawSample> raw;          // exact: velocity measured, model torque made from the arm
  std::vector<palpate::JointSample> samples;    // the same as the conditioner would hand them on
  std::vector<palpate::JointVector> push;       // tau_ext during the interval that ended at the sample [N m]
};

/// Computed torque about a swing A (1 - cos w t)/2; of friction only the offset, the rest is left to the feedback.
inline palpate::JointVector control(const palpate::Arm& arm, const Plant& plant, const Scene& scene, double t) {
  palpate::JointVector wanted{};
  for (int j = 0; j < arm.n(); ++j) {
    const double w = 1.5 + 0.37 * j, A = scene.swing * (j % 2 ? -1.0 : 1.0), k = scene.stiffness;
    const double q = scene.q0[at(j)] + 0.5 * A * (1.0 - std::cos(w * t)), dq = 0.5 * A * w * std::sin(w * t);
    wanted[at(j)] = 0.5 * A * w * w * std::cos(w * t) + k * k * (q - plant.q[at(j)]) + 2.0 * k * (dq - plant.dq[at(j)]);
  }
  palpate::JointVector tau = palpate::inverse_dynamics<double>(arm, plant.q, plant.dq, wanted);
  for (int j = 0; j < arm.n(); ++j) tau[at(j)] += arm.joint(j).friction.offset;
  return tau;
}

inline Recording simulate(const palpate::Arm& arm, const Scene& scene) {
  Recording out;
  Random random = independent(scene.seed);
  Plant plant{&arm, scene.q0};
  palpate::JointVector tau = control(arm, plant, {.swing = 0.0, .q0 = scene.q0}, 0.0);
  std::int64_t t = 0;
  for (int k = 0; static_cast<double>(k) < scene.seconds * scene.rate; ++k) {
    const std::int64_t next = std::llround(1e9 * (k + scene.jitter * random(-0.5, 0.5)) / scene.rate);
    const double dt = k > 0 ? static_cast<double>(next - t) / 1e9 : 0.0;
    if (k > 0) {
      scene.events(static_cast<double>(t) / 1e9, plant);
      tau = control(arm, plant, scene, static_cast<double>(t) / 1e9);
      plant.advance(tau, dt, scene.longest_step);
    }
    t = next;
    const palpate::JointVector ddq = plant.acceleration(tau);  // just before the sample
    palpate::RawSample raw;
    raw.time_ns = t;
    raw.position = plant.q;
    raw.velocity = plant.dq;
    raw.effort = tau;
    raw.model_torque = palpate::inverse_dynamics<double>(arm, plant.q, plant.dq, ddq);
    const palpate::JointVector friction = arm.friction_torque(plant.dq);
    for (int j = 0; j < arm.n(); ++j) raw.model_torque[at(j)] += friction[at(j)];
    raw.has_velocity = raw.has_model_torque = true;
    out.raw.push_back(raw);
    palpate::JointSample s;
    s.time_ns = t;
    s.dt = dt;
    s.q = raw.position;
    s.dq = raw.velocity;
    s.velocity_measured = true;
    s.tau = tau;
    s.model_torque = raw.model_torque;
    s.has_model_torque = true;
    s.status = palpate::Status::ok;
    out.samples.push_back(s);
    out.push.push_back(plant.push);
  }
  return out;
}

/// tau_ext of a point mass at the grasp point: J^T m g at rest [N m].
inline palpate::JointVector weight_torque(const palpate::Arm& arm, const palpate::JointVector& q, double mass) {
  const palpate::Pose<double> P = palpate::forward_kinematics<double>(arm, q);
  const palpate::Vec3<double> c = P.p + P.R * arm.p_last_grasp(), f = mass * arm.gravity();
  palpate::JointVector tau{};
  for (int j = 0; j < arm.n(); ++j) tau[at(j)] = palpate::dot(palpate::jacobian_column(arm, P, j, c), f);
  return tau;
}
inline palpate::Inertia<double> point_load(const palpate::Arm& arm, double mass) {
  return palpate::about_origin(mass, arm.p_last_grasp(), palpate::Sym3<double>{});
}

}  // namespace palpate_test
