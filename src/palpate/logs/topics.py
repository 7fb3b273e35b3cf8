"""Which topic carries what in a recording."""

from __future__ import annotations

JOINT_STATES = "/joint_states"
MODEL_TORQUE = "/model_torque"
COMMANDS = "/joint_commands"
SETPOINT = "/setpoint"
EXTERNAL_TORQUE = "/palpate/external_torque"
EXTERNAL_TORQUE_STD = "/palpate/external_torque_std"
PAYLOAD_MASS = "/palpate/payload_mass"
PAYLOAD_MASS_STD = "/palpate/payload_mass_std"
STATUS = "/palpate/status"
EVENTS = "/palpate/events"
SESSION = "/palpate/session"
SIGNALS = "/palpate/signal/"  #: prefix of every other signal

#: signals that are a field of a JointState, by name: topic, field, unit
JOINT_SIGNALS = {
    "command": (COMMANDS, "effort", ""),
    "setpoint_position": (SETPOINT, "position", "rad"),
    "setpoint_velocity": (SETPOINT, "velocity", "rad/s"),
    "external_torque": (EXTERNAL_TORQUE, "effort", "N m"),
    "external_torque_std": (EXTERNAL_TORQUE_STD, "effort", "N m"),
}
#: signals that are a std_msgs/msg/Float64, by name: topic, unit
NUMBER_SIGNALS = {
    "payload_mass": (PAYLOAD_MASS, "kg"),
    "payload_mass_std": (PAYLOAD_MASS_STD, "kg"),
}
#: a note about rows that were dropped from an earlier file
BEFORE = r"dropped (?P<count>[0-9]{1,15}) before it was saved: (?P<reason>.*)"
FORMAT = 1  #: version of this arrangement, stored with every recording
