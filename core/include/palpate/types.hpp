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
  JointVector tau{};            ///< link-side motor torque [N m], held from the previous sample to this one
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

/// Everything known after one sample.
struct Touch {
  std::int64_t time_ns = 0;
  JointVector q{};              ///< estimated position [rad]
  JointVector dq{};             ///< estimated velocity [rad/s]
  ExternalTorque external{};
  Payload payload{};
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
