// A 1 kHz torque loop in a robot's callback, as libfranka's Robot::control() and the clients of KUKA's FRI shape it: the
// robot says where it is, the callback answers with torques. Here it lifts an object to a pose and weighs it on the way.
//
// FakeRobot stands for the vendor's class. The arm comes from a header that `palpate arm export NAME --header FILE` wrote;
// nothing is parsed.
#include <cstdio>
#include <functional>
#include <memory>

#include <palpate/control/feedforward_pd.hpp>
#include <palpate/control/limiter.hpp>
#include <palpate/pipeline.hpp>
#include <palpate/session/simulated_arm.hpp>
#include <palpate/trajectory.hpp>

#include "justina_left_arm.hpp"

namespace {

struct RobotState {
  std::int64_t time_ns;                // of the measurement [ns]
  palpate::JointVector q, tau;         // measured position [rad], torque of the motors [N m]
};
struct Torques {
  palpate::JointVector tau;            // for the next period [N m]
  bool motion_finished;
};

/// A vendor's robot: calls back once per period until the motion is finished.
class FakeRobot {
 public:
  FakeRobot(std::shared_ptr<const palpate::Arm> arm, double held) : driver_(arm, {}) {
    palpate::SimulatedWorld world;
    world.load = palpate::about_origin(held, arm->p_last_grasp(), {});  // a point mass in the hand
    driver_.set_world(world);
  }
  void control(const std::function<Torques(const RobotState&)>& callback) {
    palpate::RawSample raw;
    palpate::JointVector sent;
    for (bool finished = false; !finished && driver_.read(raw) == palpate::Reading::sample;) {
      const Torques answer = callback({raw.time_ns, raw.position, raw.effort});
      finished = answer.motion_finished || !driver_.write(answer.tau, sent);
    }
    driver_.stop();
  }

 private:
  palpate::SimulatedArm driver_;
};

}  // namespace

int main() {
  // What may throw happens here, before the loop.
  const auto arm = std::make_shared<const palpate::Arm>(justina_left_arm);  // checks every figure
  palpate::Pipeline pipeline(arm, {.payload = palpate::PayloadFilterConfig{.first_moment = true, .offset_prior_std = 0.02}});
  palpate::PdGains gains;
  gains.kp = {5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5};  // [N m/rad]
  gains.kd = {3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0};  // [N m s/rad]
  gains.limit.fill(2.5);                           // [N m]
  palpate::FeedforwardPd controller(*arm, gains, palpate::Feedforward::inverse_dynamics);
  palpate::SafetyLimiter limiter(arm->n(), palpate::LimiterConfig::of(*arm));
  const palpate::Quintic motion(arm->n(), {}, {0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3}, 2.0);

  palpate::Touch touch;
  FakeRobot robot(arm, 0.25);
  robot.control([&](const RobotState& state) -> Torques {  // nothing in here allocates, throws, locks or waits
    palpate::RawSample raw;
    raw.time_ns = state.time_ns;
    raw.position = state.q;
    raw.effort = state.tau;  // in the unit of the arm's effort_gain
    touch = pipeline.step(raw);

    const double time = 1e-9 * static_cast<double>(state.time_ns);
    const palpate::Inertia<double> load = pipeline.load();  // zero until it is known
    const palpate::JointCommand wanted = controller.step(motion.sample(time), touch.q, touch.dq, load, state.time_ns);
    const palpate::JointVector gravity = palpate::gravity_torque<double>(*arm, touch.q, load);
    const palpate::LimitedCommand safe = limiter.step(wanted, touch.q, touch.dq, gravity, 1e-3);
    return {safe.command.torque, time > 5.0};
  });

  std::printf("holds %.3f kg, standard deviation %.4f kg, status %s\n", touch.payload.mass, touch.payload.mass_std,
              palpate::name(touch.payload.status));
  return touch.payload.status == palpate::Status::ok ? 0 : 1;
}
