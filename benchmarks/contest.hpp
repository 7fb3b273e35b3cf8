// What the contestants of speed.cpp have in common: the jobs, the clock, and the loop that times every single call.
//
// Entry is all that speed.cpp sees of the rival, so that Pinocchio's headers are compiled in rival.cpp only.
#pragma once
#include <array>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#if defined(__x86_64__)
#include <x86intrin.h>
#else
#include <ctime>
#endif

#include "palpate/arm.hpp"
#include "palpate/types.hpp"

namespace contest {

using palpate::Arm;
using palpate::ArmDescription;
using palpate::JointSample;

enum class Job : int {
  momentum,            ///< MomentumObserver
  sliding_mode,        ///< SlidingModeObserver as configured by default: one Runge-Kutta step at 1 kHz
  sliding_mode_twice,  ///< the same, two Runge-Kutta steps
  kalman,              ///< ExtendedKalman, state (q, q')
  kalman_disturbance,  ///< ExtendedKalman, state (q, q', tau_ext)
  payload_mass,        ///< PayloadFilter, mass alone
  payload_moment,      ///< PayloadFilter, mass and first moment
  inverse_dynamics,
  mass_matrix,
  forward_dynamics,
};

/// Configurations that are not the default, for both sides' classes.
template <class ExtendedKalmanConfig>
ExtendedKalmanConfig smoother() {
  return {.disturbance = false};
}
template <class PayloadFilterConfig>
PayloadFilterConfig weigher(bool first_moment) {
  return {.first_moment = first_moment, .mass_prior_std = 2.0};
}

/// What a contestant found for one sample; the contestants must agree.
struct Numbers {
  int n = 0;
  std::array<double, 64> x{};
  void add(double value) { x[static_cast<std::size_t>(n++)] = value; }
  template <class Array>
  void add(const Array& values, int count) {
    for (int i = 0; i < count; ++i) add(values[static_cast<std::size_t>(i)]);
  }
};

/// An observer with its arm.
template <class Observer>
struct Observing {
  template <class Config>
  Observing(const ArmDescription& d, const Config& config) : arm(d), observer(arm, config) {}
  void step(const JointSample& s) { external = observer.step(s); }
  Numbers numbers() const {
    Numbers out;
    out.add(external.torque, arm.n());
    out.add(external.std, arm.n());
    if constexpr (requires { observer.positions(); }) {
      out.add(observer.positions(), arm.n());
      out.add(observer.velocities(), arm.n());
    }
    return out;
  }
  Arm arm;
  Observer observer;
  palpate::ExternalTorque external{};
};

/// A payload filter with its arm.
template <class Filter>
struct Weighing {
  template <class Config>
  Weighing(const ArmDescription& d, const Config& config) : arm(d), filter(arm, config) {}
  void step(const JointSample& s) { payload = filter.step(s); }
  Numbers numbers() const {
    Numbers out;
    out.add(payload.mass);
    out.add(payload.mass_std);
    out.add(payload.first_moment, 3);
    out.add(payload.first_moment_std, 3);
    out.add(filter.positions(), arm.n());
    out.add(filter.velocities(), arm.n());
    return out;
  }
  Arm arm;
  Filter filter;
  palpate::Payload payload{};
};

#if defined(__x86_64__)
// The fences keep work of the call from leaking past the clock readings, and other work from leaking in.
inline std::uint64_t before() noexcept {
  _mm_lfence();
  const std::uint64_t t = __rdtsc();
  _mm_lfence();
  return t;
}
inline std::uint64_t after() noexcept {
  unsigned core;
  const std::uint64_t t = __rdtscp(&core);
  _mm_lfence();
  return t;
}
#else
inline std::uint64_t before() noexcept {
  std::timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return static_cast<std::uint64_t>(t.tv_sec) * 1'000'000'000u + static_cast<std::uint64_t>(t.tv_nsec);
}
inline std::uint64_t after() noexcept { return before(); }
#endif

/// One contestant at one job, with its state.
class Entry {
 public:
  virtual ~Entry() = default;
  virtual const char* how() const = 0;
  /// Takes the samples in order; ticks of the clock per call.
  virtual void run(const JointSample* samples, int count, std::uint32_t* ticks) = 0;
  /// Of the newest sample.
  virtual Numbers numbers() const = 0;
};
using Entries = std::vector<std::unique_ptr<Entry>>;

/// `Work` has `void step(const JointSample&)` and `Numbers numbers() const`; only step() is timed.
template <class Work>
class Timed final : public Entry {
 public:
  template <class... Args>
  explicit Timed(const char* how, Args&&... args) : how_(how), work_(std::forward<Args>(args)...) {}
  const char* how() const override { return how_; }
  void run(const JointSample* samples, int count, std::uint32_t* ticks) override {
    for (int k = 0; k < count; ++k) {
      const std::uint64_t t = before();
      work_.step(samples[k]);
      asm volatile("" : : "r"(&work_) : "memory");  // the results are wanted
      ticks[k] = static_cast<std::uint32_t>(after() - t);
    }
  }
  Numbers numbers() const override { return work_.numbers(); }

 private:
  const char* how_;
  Work work_;
};

}  // namespace contest
