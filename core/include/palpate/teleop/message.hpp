// What the two sides of a teleoperator tell one another.
#pragma once
#include <cstdint>

#include "palpate/types.hpp"

namespace palpate::teleop {

/// One message, the same in both directions. All quantities are the master's: its axes, its scale.
struct Message {
  std::uint64_t session = 0;    ///< of the sender; a later start has a larger one, 0 is none
  std::uint64_t sequence = 0;   ///< counts up from 1 within a session; 0: no message
  std::int64_t time_ns = 0;     ///< sender's clock [ns]
  JointVector position{};       ///< of the sender [m] or [rad]; an orientation as a rotation vector (Manifold)
  JointVector velocity{};       ///< [m/s] or [rad/s]
  JointVector force{};          ///< master: of the hand on the device; slave: of the environment, as it is to be felt [N] or [N m]
  double energy = 0.0;          ///< sent since the session began: it never falls, so loss and repetition do no harm [J]
  double booked = 0.0;          ///< of what the other side has sent: the rest is still on its way [J]
  double level = 0.0;           ///< of the sender's tank [J]
  bool engaged = false;         ///< the sender wants to be coupled: the clutch is closed
  std::uint16_t shown = 0xFFFF; ///< bit i: the sender's axis i has a motor. One that is only measured is no port: no work comes back by it
};

/// What is the matter; a bit mask, 0 where everything is as wanted.
enum Event : std::uint16_t {
  event_none = 0,
  event_link = 1,        ///< nothing new has come for too long: both sides hold
  event_engaging = 2,    ///< coming back, slowly
  event_clutch = 4,      ///< the clutch is open
  event_energy = 8,      ///< there is not the energy for what is wanted: force or motion was made smaller
  event_force = 16,      ///< the force is at its limit
  event_speed = 32,      ///< the reference is at its largest speed
  event_workspace = 64,  ///< the master points out of what the slave may reach
  event_input = 128,     ///< a number was not finite: the last good ones hold
};

/// How master and slave are coupled.
enum class Coupling : std::uint8_t {
  force_position = 0,     ///< the slave follows the master, the master feels the environment's force (as published)
  position_position = 1,  ///< a spring and a damper between the two
  four_channel = 2,       ///< both, and the slave gets the hand's force beside its motion
};

}  // namespace palpate::teleop
