// What decides, in every tick, the torque that is wanted.
#pragma once
#include <cstdint>

#include "palpate/control/feedforward_pd.hpp"
#include "palpate/trajectory.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// What the owner of a session asks for. The newest one counts; each number says whether its part is new.
struct Request {
  std::uint64_t goal = 0;   ///< another number: position and duration are a new goal
  JointVector position{};   ///< [rad]
  double duration = 0.0;    ///< of the motion to it [s]
  std::uint64_t gains = 0;  ///< another number: kp, kd are new
  JointVector kp{}, kd{};   ///< [N m/rad], [N m s/rad]
  std::uint64_t tare = 0;   ///< another number: what is weighed now is to be called zero
  bool enabled = false;     ///< drives on
};

/// Where the arm should be and the torque for it, not limited yet.
struct Wanted {
  Setpoint setpoint{};
  JointCommand command{};
};

/// A control law within a session. Everything is called on the loop's thread: nothing may allocate, throw or block.
class Controller {
 public:
  virtual ~Controller() = default;
  /// The drives have just been switched on; the arm is where `touch` says.
  virtual void start(const Touch& touch) noexcept = 0;
  /// The newest request, in every tick while enabled, before step().
  virtual void ask(const Request& request) noexcept = 0;
  /// dt: time since the sample before [s], >= 0. load: what is held, see Pipeline::load().
  [[nodiscard]] virtual Wanted step(const Touch& touch, double dt, const Inertia<double>& load) noexcept = 0;
};

/// Joint positions: from where the arm is to the newest goal along a Transfer, by FeedforwardPd about it.
///
/// After start() it holds the pose in which the drives were switched on, until a goal that is newer than the last one it followed.
class JointController final : public Controller {
 public:
  JointController(const Arm& arm, const FeedforwardPd& law) noexcept : n_(arm.n()), law_(law) {}

  void start(const Touch& touch) noexcept override {
    law_.reset();
    motion_ = Transfer(touch.q);
    time_ = 0.0;
  }
  void ask(const Request& request) noexcept override {
    if (request.gains != gains_) {
      gains_ = request.gains;
      law_.set_gains(request.kp, request.kd);
    }
    if (request.goal != goal_) {
      goal_ = request.goal;
      if (!check::all_finite(request.position, static_cast<std::size_t>(n_))) return;
      motion_ = Transfer(n_, motion_.sample(time_), request.position, request.duration);
      time_ = 0.0;
    }
  }
  [[nodiscard]] Wanted step(const Touch& touch, double dt, const Inertia<double>& load) noexcept override {
    time_ += dt;
    const Setpoint setpoint = motion_.sample(time_);
    return {setpoint, law_.step(setpoint, touch.q, touch.dq, load, touch.time_ns)};
  }

 private:
  int n_;
  FeedforwardPd law_;
  Transfer motion_{};
  double time_ = 0.0;  // since the motion began [s]
  std::uint64_t goal_ = 0, gains_ = 0;
};

}  // namespace palpate
