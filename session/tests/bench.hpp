// A small arm, a driver that does what a test says, and a loop around either.
#pragma once
#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "palpate/session/loop.hpp"
#include "palpate/session/simulated_arm.hpp"

namespace palpate_test {

/// Two links of 0.3 m about horizontal axes, with friction, a 14-bit encoder and torque steps; the tip at its end.
inline std::shared_ptr<const palpate::Arm> two_links() {
  palpate::ArmDescription d;
  d.n = 2;
  for (std::size_t j = 0; j < 2; ++j) {
    palpate::JointDescription& joint = d.joints[j];
    joint.axis = {0, 1, 0};
    joint.T_parent_joint.p = {j == 0 ? 0.0 : 0.3, 0, 0};
    joint.mass = 1.0;
    joint.com = {0.15, 0, 0};
    joint.inertia = {1e-4, 0, 0, 7.5e-3, 0, 7.5e-3};
    joint.rotor_inertia = 0.02;
    joint.friction.coulomb = 0.2;
    joint.friction.viscous = 0.3;
    joint.lower = -3.0, joint.upper = 3.0;
    joint.max_velocity = 4.0, joint.max_effort = 30.0;
    joint.position_resolution = 6.283185307179586 / 16384;
    joint.torque_resolution = 0.01;
    joint.torque_std = 0.02;
  }
  d.T_last_tip.p = {0.3, 0, 0};
  return std::make_shared<const palpate::Arm>(d);
}

/// A point mass [kg] at the grasp point, as the last body carries it.
inline palpate::Inertia<double> point_mass(const palpate::Arm& arm, double m) {
  const palpate::Vec3<double> c = arm.p_last_grasp();
  return palpate::about_origin(m, c, {});
}

/// Stands still; what read() brings and how long the verbs take is the test's to say.
class ScriptedDriver final : public palpate::Driver {
 public:
  ScriptedDriver(int n, std::int64_t period_ns, bool paced = false) : n_(n), period_(period_ns), paced_(paced) {}

  std::function<palpate::Reading(int, palpate::RawSample&)> on_read = [](int, palpate::RawSample&) { return palpate::Reading::sample; };
  std::function<bool()> on_write = [] { return true; };
  bool willing = true;
  int reads = 0, writes = 0, stops = 0, enables = 0;

  int joints() const noexcept override { return n_; }
  std::int64_t period_ns() const noexcept override { return period_; }
  bool paced() const noexcept override { return paced_; }
  bool enable() noexcept override { return ++enables, willing; }
  palpate::Reading read(palpate::RawSample& out) noexcept override {
    out = {};
    out.time_ns = reads * period_;
    return on_read(reads++, out);
  }
  bool write(const palpate::JointVector& torque, palpate::JointVector& sent) noexcept override {
    ++writes;
    sent = torque;
    return on_write();
  }
  void stop() noexcept override { ++stops; }
  const char* complaint() const noexcept override { return "the scripted arm says no"; }

 private:
  int n_;
  std::int64_t period_;
  bool paced_;
};

inline palpate::LoopConfig small() {
  palpate::LoopConfig c;
  c.records = 64;
  c.black_box = 16;
  return c;
}

inline palpate::PdGains gains() { return {.kp = {60, 30}, .kd = {6, 3}, .limit = {30, 30}}; }

inline std::shared_ptr<palpate::ControlLoop> make_loop(std::shared_ptr<const palpate::Arm> arm, std::shared_ptr<palpate::Driver> driver,
                                                       const palpate::LoopConfig& config, std::shared_ptr<palpate::Clock> clock) {
  const palpate::FeedforwardPd law(*arm, gains(), palpate::Feedforward::inverse_dynamics);
  auto controller = std::make_unique<palpate::JointController>(*arm, law);
  return std::make_shared<palpate::ControlLoop>(arm, std::move(driver), std::move(controller), palpate::SafetyLimiter(arm->n(), palpate::LimiterConfig::of(*arm)),
                                                config, std::move(clock));
}

}  // namespace palpate_test
