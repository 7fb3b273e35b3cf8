// The same task in a session: a real-time thread owns the loop, main() only asks and looks on.
#include <chrono>
#include <cstdio>
#include <memory>
#include <thread>

#include <palpate/session/session.hpp>
#include <palpate/session/simulated_arm.hpp>

#include "justina_left_arm.hpp"

int main() {
  const auto arm = std::make_shared<const palpate::Arm>(justina_left_arm);
  palpate::PdGains gains;
  gains.kp = {5.0, 2.5, 2.5, 2.5, 2.5, 2.5, 2.5};  // [N m/rad]
  gains.kd = {3.5, 1.0, 1.0, 1.5, 1.0, 1.0, 1.0};  // [N m s/rad]
  gains.limit.fill(2.5);                           // [N m]
  const palpate::FeedforwardPd law(*arm, gains, palpate::Feedforward::inverse_dynamics);

  auto driver = std::make_shared<palpate::SimulatedArm>(arm, palpate::SimulatedArmConfig{});  // yours: derive from palpate::Driver
  palpate::SimulatedWorld world;
  world.load = palpate::about_origin(0.25, arm->p_last_grasp(), {});
  driver->set_world(world);

  palpate::LoopConfig config;
  config.patience = 10.0;  // [s] without a usable sample: stop; a real arm wants less
  auto loop = std::make_shared<palpate::ControlLoop>(arm, driver, std::make_unique<palpate::JointController>(*arm, law),
                                                     palpate::SafetyLimiter(arm->n(), palpate::LimiterConfig::of(*arm)), config,
                                                     std::make_shared<palpate::MonotonicClock>());
  palpate::Session session(loop);
  const palpate::RealtimeReport& granted = session.start();
  std::printf("real-time priority: %s\n", granted.fifo ? "yes" : granted.complaint.c_str());

  palpate::Request request;  // wait-free: the loop takes the newest at its next tick
  request.enabled = true;
  request.goal = 1;
  request.position = {0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3};
  request.duration = 2.0;
  loop->request(request);

  palpate::Record newest;
  do {
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
    loop->read_state(newest);
  } while (!loop->over() && newest.touch.time_ns < 5'000'000'000);
  session.stop();  // so would its destructor

  if (loop->mode() == palpate::Mode::fault) return std::fprintf(stderr, "%s\n", loop->fault()), 1;
  std::printf("holds %.3f kg, standard deviation %.4f kg, status %s\n", newest.touch.payload.mass, newest.touch.payload.mass_std,
              palpate::name(newest.touch.payload.status));
  std::printf("own time, 99.9 %% of the ticks: %.1f us\n", 1e-3 * static_cast<double>(loop->statistics().own.quantile(0.999)));
}
