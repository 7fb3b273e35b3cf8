// The plain structs that travel from driver to estimate (DESIGN.md section 1).
//
// SI units everywhere: [s], [rad], [rad/s], [N m], [kg], [m]. Time stamps are int64 [ns] of the driver's clock.
// Sign: M(q) q'' + C(q,q') q' + g(q) + tau_f(q') = tau + tau_ext; tau_ext > 0 when the environment pushes the robot.
#pragma once
#include <array>
#include <cstdint>

#include "palpate/status.hpp"

namespace palpate {

inline constexpr int max_joints = 16;  ///< longest chain; arrays have this size, entries beyond Arm::n are zero

template <class T>
using Joints = std::array<T, max_joints>;  ///< one value per joint
using JointVector = Joints<double>;

/// Square joint-space matrix, row-major, entries beyond Arm::n unused; zero only if made with {}.
template <class T>
struct JointMatrixT {
  std::array<std::array<T, max_joints>, max_joints> a;
  constexpr T& operator()(int i, int j) noexcept { return a[static_cast<unsigned>(i)][static_cast<unsigned>(j)]; }
  constexpr const T& operator()(int i, int j) const noexcept {
    return a[static_cast<unsigned>(i)][static_cast<unsigned>(j)];
  }
};
using JointMatrix = JointMatrixT<double>;

/// What a driver read, before any conversion.
struct RawSample {
  std::int64_t time_ns = 0;     ///< measurement time [ns]
  JointVector position{};       ///< encoder position q [rad]
  JointVector velocity{};       ///< q' [rad/s]; read only if has_velocity
  JointVector effort{};         ///< in the driver's unit: [N m] or [A], see Arm's drive gains
  JointVector model_torque{};   ///< controller's own bare-arm torque [N m]; read only if has_model_torque
  bool has_velocity = false;
  bool has_model_torque = false;
};

/// A sample fit for estimation: torque in [N m], velocity known, validity judged.
struct JointSample {
  std::int64_t time_ns = 0;
  double dt = 0.0;              ///< time since the previous accepted sample [s]; 0 for the first
  JointVector q{};              ///< [rad]
  JointVector dq{};             ///< [rad/s], measured or differentiated
  JointVector dq_std{};         ///< its standard deviation [rad/s]; 0 if not known
  bool velocity_measured = false;  ///< dq comes from the driver, not from the positions
  JointVector tau{};            ///< link-side motor torque [N m], held from the previous sample to this one; less friction_excess
  JointVector friction_excess{};  ///< friction beyond Friction::torque(dq), already taken out of tau [N m] (FrictionHistory)
  JointVector model_torque{};   ///< [N m]; read only if has_model_torque
  bool has_model_torque = false;
  Status status = Status::warming;
};

/// Torque the environment exerts on each joint.
struct ExternalTorque {
  JointVector torque{};         ///< tau_ext [N m], > 0 when the environment pushes the joint forward
  JointVector std{};            ///< standard deviation [N m]
  JointVector noise{};          ///< the part of std that averages out: without the error of the friction model [N m]
  Status status = Status::warming;
};

/// What the arm holds. Frame: the arm's tip frame (Arm::T_last_tip); the point is the grasp point Arm::grasp.
struct Payload {
  double mass = 0.0;                   ///< [kg]
  double mass_std = 0.0;               ///< [kg]
  std::array<double, 3> first_moment{};      ///< m (c - grasp) [kg m], tip axes; zero where only the mass is estimated
  std::array<double, 3> first_moment_std{};  ///< [kg m]
  std::uint32_t changes = 0;           ///< grasps and releases detected since reset
  std::int64_t change_time_ns = 0;     ///< estimated time of the newest one [ns]; meaningless if changes == 0
  Status status = Status::warming;
};

/// Whose axes a wrench is written in, and about which point its moment is.
enum class Axes : std::uint8_t { base = 0, tip = 1 };
enum class Point : std::uint8_t { grasp = 0, tip = 1 };

/// Force and moment the environment exerts on the last link, beyond what the held load does.
struct Wrench {
  std::array<double, 3> force{};       ///< [N], in `axes`
  std::array<double, 3> moment{};      ///< about `point` [N m], in `axes`; zero where only a force is estimated
  std::array<double, 3> force_std{};   ///< [N]
  std::array<double, 3> moment_std{};  ///< [N m]
  std::array<double, 36> covariance{}; ///< row-major 6 x 6, force before moment [N^2, N^2 m, N^2 m^2]
  std::array<bool, 6> singular{};      ///< the pose tells (almost) nothing about this component
  double conditioning = 0.0;           ///< best over worst known direction of the wrench, >= 1; infinity: one is not seen [1]
  double load_mass = 0.0;              ///< of the load whose weight and inertia were taken away [kg]
  Axes axes = Axes::base;
  Point point = Point::grasp;
  Status status = Status::warming;     ///< singular: some component is; `singular` tells which
};

/// Something touches the arm where it should not be touched, or where it should.
struct Contact {
  bool active = false;                 ///< there is a contact now
  int link = -1;                       ///< link touched, counted from 0: the one that the last joint that feels it moves; -1: none
  int farthest = -1;                   ///< the farthest link on which one force would explain what all joints feel; >= link
  bool tip = false;                    ///< a force at the grasp point would explain it
  JointVector torque{};                ///< of the contact at each joint: tau_ext since the onset [N m]
  JointVector std{};                   ///< its standard deviation [N m]
  JointVector level{};                 ///< test statistic over its threshold, the larger side; 1: alarm [1]
  std::uint32_t count = 0;             ///< contacts since reset
  std::int64_t onset_time_ns = 0;      ///< estimated start of the newest one [ns]; meaningless if count == 0
  std::int64_t alarm_time_ns = 0;      ///< when it was declared [ns]
  std::int64_t release_time_ns = 0;    ///< estimated end of the newest one that ended [ns]; meaningless if none did
  Status status = Status::warming;
};

/// Everything known after one sample.
struct Touch {
  std::int64_t time_ns = 0;
  JointVector q{};              ///< estimated position [rad]
  JointVector dq{};             ///< estimated velocity [rad/s]
  ExternalTorque external{};
  Payload payload{};
  Wrench wrench{};
  Contact contact{};
  Status status = Status::warming;  ///< of the sample itself
};

/// Where a joint should be.
struct Setpoint {
  JointVector q{}, dq{}, ddq{};  ///< [rad], [rad/s], [rad/s^2]
};

/// What is sent to the drives.
struct JointCommand {
  std::int64_t time_ns = 0;
  JointVector torque{};         ///< link-side motor torque [N m]
  Status status = Status::ok;   ///< saturated: a limit was applied
};

}  // namespace palpate
