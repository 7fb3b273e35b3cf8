"""FRI's messages as classes of the protobuf package: an oracle for palpate's own reading and writing of them."""

from __future__ import annotations

from collections.abc import Mapping

# message: {field: (number, type)}; a star is for repeated, a capital letter for a message
_FIELDS: Mapping[str, Mapping[str, tuple[int, str]]] = {
    "Header": {"message_id": (1, "fixed32"), "sequence": (2, "uint32"), "reflected": (3, "uint32")},
    "Joints": {"value": (1, "double*")},
    "Vector": {"element": (1, "double*")},
    "Time": {"sec": (1, "uint32"), "nanosec": (2, "uint32")},
    "RobotInfo": {
        "joints": (1, "int32"),
        "safety_state": (2, "int32"),
        "drive_state": (5, "int32*"),
        "control_mode": (7, "int32"),
    },
    "MonitorData": {
        "measured_position": (1, "Joints"),
        "measured_torque": (2, "Joints"),
        "external_torque": (5, "Joints"),
        "timestamp": (15, "Time"),
    },
    "ConnectionInfo": {
        "session_state": (1, "int32"),
        "quality": (2, "int32"),
        "send_period": (3, "uint32"),
        "receive_multiplier": (4, "uint32"),
    },
    "IpoData": {"joint_position": (1, "Joints"), "command_mode": (10, "int32")},
    "Monitoring": {
        "header": (1, "Header"),
        "robot": (2, "RobotInfo"),
        "monitor": (3, "MonitorData"),
        "connection": (4, "ConnectionInfo"),
        "ipo": (5, "IpoData"),
    },
    "CommandData": {
        "joint_position": (1, "Joints"),
        "wrench": (2, "Vector"),
        "joint_torque": (3, "Joints"),
    },
    "Command": {"header": (1, "Header"), "data": (2, "CommandData")},
}


def protobuf_classes() -> dict[str, type]:
    """Message classes by name, made from the table above."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="fri.proto", package="fri", syntax="proto2")
    for name, fields in _FIELDS.items():
        described = file.message_type.add(name=name)
        for field, (number, kind) in fields.items():
            added = described.field.add(name=field, number=number)
            added.label = kinds.LABEL_REPEATED if kind.endswith("*") else kinds.LABEL_OPTIONAL
            if kind in _FIELDS:
                added.type, added.type_name = kinds.TYPE_MESSAGE, f".fri.{kind}"
            else:
                added.type = getattr(kinds, f"TYPE_{kind.rstrip('*').upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"fri.{name}")) for name in _FIELDS
    }
