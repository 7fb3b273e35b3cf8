// The energy of one side of a teleoperator: what came in, what may go out.
#pragma once
#include <algorithm>
#include <cmath>

#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate::teleop {

struct TankConfig {
  double desired = 0.03;  ///< level that is kept for oneself; what is above goes to the other side [J], > 0
  double most = 0.3;      ///< what is above is thrown away [J], >= desired
  double initial = 5e-3;  ///< there without anybody having paid for it: none at all, and nothing could ever begin [J], >= 0
  double horizon = 0.005; ///< no more power than level/horizon goes out [s], > 0
  double share = 30.0;    ///< rate at which a poorer other side is given from the difference of the levels [1/s], >= 0
  double surplus = 200.0; ///< and at which it is given what is above `desired` [1/s], >= 0
};

/// A tank at each port (two-layer passivity; M. Franken, S. Stramigioli, S. Misra, C. Secchi, A. Macchelli, IEEE T-RO 27(4), 2011):
///
///   level = initial + taken - given + received - sent - dissipated,     given <= initial + taken + received - sent
///
/// taken, given [J] the work of the port, both directions; sent, received [J] what went to the other side and came from there. `sent` is
/// told as a sum since the beginning, and the receiver books the largest it has seen: delay, loss, reordering and repetition can only keep
/// energy away, never make it. So together, whatever the network does,
///
///   given_M + given_S <= initial_M + initial_S + taken_M + taken_S     at every instant.
///
/// Each also tells how much of the other's sum it has booked, so what is on the way is known, and counts as the receiver's: a side that
/// would come above `most` with it is given nothing. Without that the line itself would be a store as large as its delay, and energy taken
/// long ago could feed a coupling that the delay makes unstable. So the whole store is bounded, whatever the delay:
///
///   level_M + level_S + on the way <= 2 most.
class EnergyTank {
 public:
  explicit EnergyTank(const TankConfig& config = {}) : c_(config), level_(config.initial), lowest_(config.initial) {
    check::positive("TankConfig desired [J]", c_.desired);
    check::not_negative("TankConfig initial [J]", c_.initial);
    check::positive("TankConfig horizon [s]", c_.horizon);
    check::not_negative("TankConfig share [1/s]", c_.share);
    check::not_negative("TankConfig surplus [1/s]", c_.surplus);
    if (!(c_.most >= c_.desired && c_.most >= c_.initial)) check::fail("TankConfig most [J]", c_.most, "at least desired and initial");
  }

  /// Work done at the port: > 0 what the arm gave, < 0 what it was given [J].
  void exchange(double work) noexcept {
    (work > 0.0 ? taken_ : given_) += std::abs(work);
    level_ += work;
    lowest_ = std::min(lowest_, level_);
  }
  /// The other side's sum [J], as it came.
  void receive(double total) noexcept {
    if (!(std::isfinite(total) && total > booked_)) return;
    received_ += total - booked_;
    level_ += total - booked_;
    booked_ = total;
  }
  /// A session begins whose sum is `total` so far: only what comes from now on counts. Whoever starts anew gets nothing twice.
  void begin(double total) noexcept {
    if (std::isfinite(total)) booked_ = total;
  }
  /// Give to the other side, whose level was `level` and which had booked `booked` of what was sent when it last told [J]. dt [s]. Then throw
  /// away what is too much.
  void give(double level, double booked, double dt) noexcept {
    const double other = std::max(0.0, level) + std::max(0.0, sent_ - booked);
    const double surplus = std::max(0.0, level_ - c_.desired) * -std::expm1(-c_.surplus * dt);
    const double share = std::max(0.0, level_ - other) * -std::expm1(-c_.share * dt) * 0.5;
    const double out = std::clamp(surplus + share, 0.0, std::max(0.0, std::min(level_, c_.most - other)));
    sent_ += out;
    level_ -= out;
    if (level_ > c_.most) {
      dissipated_ += level_ - c_.most;
      level_ = c_.most;
    }
  }

  double level() const noexcept { return level_; }
  /// How empty it is: 0 at `desired` or above, 1 when there is nothing [1].
  double need() const noexcept { return std::clamp(1.0 - level_ / c_.desired, 0.0, 1.0); }
  /// The most power that may go out [W].
  double power() const noexcept { return std::max(0.0, level_) / c_.horizon; }
  double taken() const noexcept { return taken_; }
  double given() const noexcept { return given_; }
  double sent() const noexcept { return sent_; }
  double received() const noexcept { return received_; }
  /// Of the other side's sum [J], to be told to it.
  double booked() const noexcept { return booked_; }
  double dissipated() const noexcept { return dissipated_; }
  /// The least the level has been [J]; never below zero while the port is sampled well.
  double lowest() const noexcept { return lowest_; }
  const TankConfig& config() const noexcept { return c_; }

 private:
  TankConfig c_;
  double level_, lowest_;
  double taken_ = 0.0, given_ = 0.0, sent_ = 0.0, received_ = 0.0, booked_ = 0.0, dissipated_ = 0.0;
};

/// The factor by which force components that do positive work must be made smaller, so that a tank of `level` [J] bears them.
///
/// velocity v [m/s] as measured, slack s: how much faster it may be at the end of the next period dt [s]. Two bounds: the work of that period,
/// sum |F| (v + s) dt <= level, whatever the hand does; and the power, sum F v <= level/horizon, so that the tank runs dry smoothly.
/// Components that brake stay as they are: what takes energy out needs none.
inline double passive_factor(const JointVector& force, const JointVector& velocity, const JointVector& slack, std::size_t n, double level, double horizon,
                             double dt) noexcept {
  double work = 0.0, power = 0.0;
  for (std::size_t i = 0; i < n; ++i) {
    work += std::max(0.0, force[i] * velocity[i] + std::abs(force[i]) * slack[i]) * dt;
    power += std::max(0.0, force[i] * velocity[i]);
  }
  const double most = std::max(work, power * horizon), have = std::max(0.0, level);
  return most > have ? have / most : 1.0;
}

}  // namespace palpate::teleop
