// SimulatedArm: a driver whose arm is palpate's own chain, with friction, encoders and an object in the hand.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <utility>

#include "palpate/chain.hpp"
#include "palpate/check.hpp"
#include "palpate/session/driver.hpp"
#include "palpate/session/latest.hpp"

namespace palpate {

struct SimulatedArmConfig {
  double period = 1e-3;      ///< of the samples [s], > 0
  int substeps = 4;          ///< of the integration per period, >= 1
  bool noise = true;         ///< encoders and drives with the arm's resolutions and standard deviations; false: ideal ones
  std::uint64_t seed = 0;    ///< of the noise
  JointVector position{};    ///< at the start [rad], at rest
};

/// What the hand holds and what pushes it, changed while it runs.
struct SimulatedWorld {
  Inertia<double> load{};                 ///< on the last body, see Inertia
  std::array<double, 3> force{};          ///< of the environment on the grasp point, base axes [N]
};

/// M(q) q'' + C q' + g + tau_f(q') = tau + J_c^T F, stepped `substeps` times per period from one read() to the next:
///   (M + h S) v+ = M v + h (tau + J_c^T F - C v - g - F_o),   q+ = q + h v+,   S = diag(tau_f(v) - F_o)/v,
/// h the step [s], v = q'. Friction by its secant S taken at the new velocity only ever takes energy out, however steep
/// its smooth sign is. The first read() is the start, with zero effort; the drives off, the torque is zero.
///
/// Time is counted in periods, so that a run is the same on any computer and at any speed; the session's clock decides
/// whether a period of it lasts one.
class SimulatedArm final : public Driver {
 public:
  /// Throws std::invalid_argument: a number is out of range, or the arm has no masses.
  SimulatedArm(std::shared_ptr<const Arm> arm, const SimulatedArmConfig& config)
      : arm_(std::move(arm)),
        c_(config),
        n_(static_cast<std::size_t>(arm_->n())),
        period_(std::llround(1e9 * check::positive("SimulatedArmConfig period [s]", config.period))),
        step_(config.period / check::in_range("SimulatedArmConfig substeps", config.substeps, 1, 1000)),
        random_(config.seed),
        q_(config.position) {
    if (!arm_->has_dynamics()) throw std::invalid_argument("SimulatedArm: the arm has no masses; give inertials");
    for (std::size_t j = 0; j < n_; ++j) check::finite(check::entry("SimulatedArmConfig position", j, "rad"), q_[j]);
  }

  [[nodiscard]] int joints() const noexcept override { return arm_->n(); }
  [[nodiscard]] std::int64_t period_ns() const noexcept override { return period_; }
  [[nodiscard]] bool paced() const noexcept override { return false; }
  [[nodiscard]] bool enable() noexcept override { return true; }
  [[nodiscard]] const char* complaint() const noexcept override { return "the simulated arm left all bounds: its numbers are not finite"; }

  [[nodiscard]] Reading read(RawSample& out) noexcept override {
    world_.read(now_);
    if (started_) {
      for (int k = 0; k < c_.substeps; ++k) advance();
      time_ += period_;
    }
    started_ = true;
    if (!check::all_finite(q_, n_)) return Reading::fault;
    out = {};
    out.time_ns = time_;
    for (std::size_t j = 0; j < n_; ++j) {
      const JointDescription& d = arm_->joint(static_cast<int>(j));
      out.position[j] = measured(q_[j], d.position_std, d.position_resolution);
      out.effort[j] = measured(applied_[j], d.torque_std, d.torque_resolution) / d.effort_gain;
    }
    truth_.write({q_, v_});
    return Reading::sample;
  }

  [[nodiscard]] bool write(const JointVector& torque, JointVector& sent) noexcept override {
    for (std::size_t j = 0; j < n_; ++j) {
      const double most = arm_->joint(static_cast<int>(j)).max_effort;
      applied_[j] = sent[j] = std::clamp(torque[j], -most, most);
    }
    return true;
  }

  void stop() noexcept override { applied_ = {}; }

  /// From the next sample on. Wait-free, one thread.
  void set_world(const SimulatedWorld& world) noexcept { world_.write(world); }

  /// True positions and velocities [rad, rad/s].
  struct Truth {
    JointVector q{}, dq{};
  };
  /// At the newest sample. Wait-free, one thread.
  [[nodiscard]] Truth truth() noexcept {
    Truth out;
    truth_.read(out);
    return out;
  }

 private:
  void advance() noexcept {
    JointMatrix M = mass_matrix<double>(*arm_, q_, now_.load);
    const JointVector bias = inverse_dynamics<double>(*arm_, q_, v_, JointVector{}, now_.load);
    JointVector r{};
    const Pose<double> pose = forward_kinematics<double>(*arm_, q_);
    const Vec3<double> grasp = pose.p + pose.R * arm_->p_last_grasp(), force = Arm::to_vec(now_.force);
    for (std::size_t j = 0; j < n_; ++j) {
      const int i = static_cast<int>(j);
      const Friction& f = arm_->joint(i).friction;
      const double push = dot(jacobian_column<double>(*arm_, pose, i, grasp), force);
      for (std::size_t k = 0; k < n_; ++k) r[j] += M(i, static_cast<int>(k)) * v_[k];
      r[j] += step_ * (applied_[j] + push - bias[j] - f.offset);
    }
    for (int i = 0; i < arm_->n(); ++i) M(i, i) += step_ * secant(arm_->joint(i).friction, v_[static_cast<std::size_t>(i)]);
    v_ = Cholesky<double>(M, arm_->n()).solve(r);
    for (std::size_t j = 0; j < n_; ++j) q_[j] += step_ * v_[j];
  }

  /// (tau_f(v) - F_o)/v [N m s/rad]; at v = 0 its limit.
  static double secant(const Friction& f, double v) noexcept {
    const double speed = std::max(std::abs(v), 1e-9);
    return (f.torque(speed) - f.offset) / speed;
  }

  double measured(double value, double std, double resolution) noexcept {
    if (!c_.noise) return value;
    const double noisy = value + std * normal();
    return resolution > 0.0 ? resolution * std::round(noisy / resolution) : noisy;
  }
  /// Standard normal number: SplitMix64 and Box-Muller, the same on every computer that rounds alike.
  double normal() noexcept {
    const auto uniform = [this] {
      std::uint64_t z = (random_ += 0x9E3779B97F4A7C15ull);
      z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
      z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
      return (static_cast<double>((z ^ (z >> 31)) >> 11) + 0.5) * 0x1.0p-53;
    };
    const double radius = std::sqrt(-2.0 * std::log(uniform()));
    return radius * std::cos(6.283185307179586 * uniform());
  }

  std::shared_ptr<const Arm> arm_;
  SimulatedArmConfig c_;
  std::size_t n_;
  std::int64_t period_;  // [ns]
  double step_;          // h [s]
  std::uint64_t random_;
  JointVector q_, v_{};
  JointVector applied_{};  // torque of the drives [N m]
  Latest<SimulatedWorld> world_{SimulatedWorld{}};
  SimulatedWorld now_{};
  Latest<Truth> truth_;
  std::int64_t time_ = 0;  // [ns]
  bool started_ = false;
};

}  // namespace palpate
