"""ROS 2 messages as DDS types: the names, fields and bytes that a ROS 2 installation would put on the wire.

A message ``pkg/msg/T`` is the DDS type ``pkg::msg::dds_::T_``, final, in CDR version 1. Field names and order are those
of the public interface packages (Jazzy); the hashes are those of REP-2016. The requests and replies of services carry
the identity of their caller in front of their fields, as rmw_cyclonedds has it; a request knows its service's hash.
"""

# no `from __future__ import annotations`: cyclonedds looks at the annotations themselves

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeAlias, TypeVar, dataclass_transform

from cyclonedds.idl import IdlStruct, annotations
from cyclonedds.idl import types as idl

_T = TypeVar("_T", bound=type)

Int8: TypeAlias = Annotated[int, "int8"]
UInt8: TypeAlias = Annotated[int, "uint8"]
Int32: TypeAlias = Annotated[int, "int32"]
UInt32: TypeAlias = Annotated[int, "uint32"]
Int64: TypeAlias = Annotated[int, "int64"]
UInt64: TypeAlias = Annotated[int, "uint64"]
Double: TypeAlias = Annotated[float, "float64"]
Strings: TypeAlias = Annotated[Sequence[str], idl.sequence(str)]
Doubles: TypeAlias = Annotated[Sequence[float], idl.sequence(idl.float64)]
Ints: TypeAlias = Annotated[Sequence[int], idl.sequence(idl.int64)]
Bools: TypeAlias = Annotated[Sequence[bool], idl.sequence(bool)]
Bytes: TypeAlias = Annotated[Sequence[int], idl.sequence(idl.uint8)]
Seven: TypeAlias = Annotated[Sequence[float], idl.array(idl.float64, 7)]


class Malformed:
    """What arrives in place of a message whose bytes cannot be that message."""

    def __init__(self, reason: str) -> None:
        self.reason = reason
        """one line"""


@dataclass_transform()
def _message(type_hash: str = "", *, service_hash: str = "") -> Callable[[_T], _T]:
    """A final dataclass with its ROS name (``ros_type``) and hash, whose bad bytes become :class:`Malformed`."""

    def make(cls: _T) -> _T:
        made: Any = dataclass(annotations.final(cls))
        package, kind, _, name = made.__idl_typename__.split(".")
        made.ros_type = f"{package}/{kind}/{name.removesuffix('_')}"
        made.type_hash, made.service_hash = type_hash, service_hash
        decode = made.deserialize

        def deserialize(data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
            try:
                return decode(data, has_header=has_header, use_version_2=use_version_2)
            except Exception as error:  # noqa: BLE001 whatever a stranger's bytes do to the decoder ends here
                return Malformed(f"{type(error).__name__}: {' '.join(str(error).split())[:200]}")

        made.deserialize = staticmethod(deserialize)
        return made

    return make


# --- builtin_interfaces, std_msgs --------------------------------------------------------------------------------


@_message("RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197")
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    """``builtin_interfaces/msg/Time``."""

    sec: Int32 = 0
    nanosec: UInt32 = 0

    @classmethod
    def of(cls, time_ns: int) -> "Time":
        """A time [ns]."""
        sec, nanosec = divmod(time_ns, 1_000_000_000)
        return cls(sec, nanosec)

    @property
    def time_ns(self) -> int:
        """[ns]."""
        return self.sec * 1_000_000_000 + self.nanosec


@_message("RIHS01_e8d009f659816f758b75334ee1a9ca5b5c0b859843261f14c7f937349599d93b")
class Duration(IdlStruct, typename="builtin_interfaces.msg.dds_.Duration_"):
    """``builtin_interfaces/msg/Duration``."""

    sec: Int32 = 0
    nanosec: UInt32 = 0


@_message("RIHS01_f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01")
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    """``std_msgs/msg/Header``."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@_message("RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a")
class Float64(IdlStruct, typename="std_msgs.msg.dds_.Float64_"):
    """``std_msgs/msg/Float64``."""

    data: Double = 0.0


@_message("RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18")
class String(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    """``std_msgs/msg/String``."""

    data: str = ""


@_message()
class MultiArrayDimension(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayDimension_"):
    """``std_msgs/msg/MultiArrayDimension``."""

    label: str = ""
    size: UInt32 = 0
    stride: UInt32 = 0


@_message()
class MultiArrayLayout(IdlStruct, typename="std_msgs.msg.dds_.MultiArrayLayout_"):
    """``std_msgs/msg/MultiArrayLayout``."""

    dim: Annotated[Sequence[MultiArrayDimension], idl.sequence(MultiArrayDimension)] = field(
        default_factory=list
    )
    data_offset: UInt32 = 0


@_message("RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f")
class Float64MultiArray(IdlStruct, typename="std_msgs.msg.dds_.Float64MultiArray_"):
    """``std_msgs/msg/Float64MultiArray``."""

    layout: MultiArrayLayout = field(default_factory=MultiArrayLayout)
    data: Doubles = field(default_factory=list)


# --- sensor_msgs, geometry_msgs, trajectory_msgs -----------------------------------------------------------------


@_message("RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e")
class JointState(IdlStruct, typename="sensor_msgs.msg.dds_.JointState_"):
    """``sensor_msgs/msg/JointState``; arrays are empty or one number per name."""

    header: Header = field(default_factory=Header)
    name: Strings = field(default_factory=list)
    position: Doubles = field(default_factory=list)
    velocity: Doubles = field(default_factory=list)
    effort: Doubles = field(default_factory=list)


@_message("RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a")
class CompressedImage(IdlStruct, typename="sensor_msgs.msg.dds_.CompressedImage_"):
    """``sensor_msgs/msg/CompressedImage``."""

    header: Header = field(default_factory=Header)
    format: str = ""
    data: Bytes = field(default_factory=list)


@_message("RIHS01_cc12fe83e4c02719f1ce8070bfd14aecd40f75a96696a67a2a1f37f7dbb0765d")
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    """``geometry_msgs/msg/Vector3``."""

    x: Double = 0.0
    y: Double = 0.0
    z: Double = 0.0


@_message("RIHS01_018e8519d57c16adbe97c9fe1460ef21fec7e31bc541de3d653a35895677ce52")
class Wrench(IdlStruct, typename="geometry_msgs.msg.dds_.Wrench_"):
    """``geometry_msgs/msg/Wrench``."""

    force: Vector3 = field(default_factory=Vector3)
    torque: Vector3 = field(default_factory=Vector3)


@_message("RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77")
class WrenchStamped(IdlStruct, typename="geometry_msgs.msg.dds_.WrenchStamped_"):
    """``geometry_msgs/msg/WrenchStamped``."""

    header: Header = field(default_factory=Header)
    wrench: Wrench = field(default_factory=Wrench)


@_message("RIHS01_2ddd5dab5c347825ba2e56c895ddccfd0b8efe53ae931bf67f905529930b4bd7")
class Inertia(IdlStruct, typename="geometry_msgs.msg.dds_.Inertia_"):
    """``geometry_msgs/msg/Inertia``."""

    m: Double = 0.0
    com: Vector3 = field(default_factory=Vector3)
    ixx: Double = 0.0
    ixy: Double = 0.0
    ixz: Double = 0.0
    iyy: Double = 0.0
    iyz: Double = 0.0
    izz: Double = 0.0


@_message("RIHS01_766be45976252babf7f9d8ac4ae7c912a7ceccf71035622529f27518b695aa09")
class InertiaStamped(IdlStruct, typename="geometry_msgs.msg.dds_.InertiaStamped_"):
    """``geometry_msgs/msg/InertiaStamped``."""

    header: Header = field(default_factory=Header)
    inertia: Inertia = field(default_factory=Inertia)


@_message()
class JointTrajectoryPoint(IdlStruct, typename="trajectory_msgs.msg.dds_.JointTrajectoryPoint_"):
    """``trajectory_msgs/msg/JointTrajectoryPoint``."""

    positions: Doubles = field(default_factory=list)
    velocities: Doubles = field(default_factory=list)
    accelerations: Doubles = field(default_factory=list)
    effort: Doubles = field(default_factory=list)
    time_from_start: Duration = field(default_factory=Duration)


@_message("RIHS01_179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e")
class JointTrajectory(IdlStruct, typename="trajectory_msgs.msg.dds_.JointTrajectory_"):
    """``trajectory_msgs/msg/JointTrajectory``."""

    header: Header = field(default_factory=Header)
    joint_names: Strings = field(default_factory=list)
    points: Annotated[Sequence[JointTrajectoryPoint], idl.sequence(JointTrajectoryPoint)] = field(
        default_factory=list
    )


# --- diagnostic_msgs ---------------------------------------------------------------------------------------------


@_message()
class KeyValue(IdlStruct, typename="diagnostic_msgs.msg.dds_.KeyValue_"):
    """``diagnostic_msgs/msg/KeyValue``."""

    key: str = ""
    value: str = ""


@_message("RIHS01_b0e3e692ea2d54a8af2f4ef1930e81556a2db55216b771f8a7d2724ed47bf0e4")
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticStatus_"):
    """``diagnostic_msgs/msg/DiagnosticStatus``; level 0 ok, 1 warning, 2 error, 3 stale."""

    level: UInt8 = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: Annotated[Sequence[KeyValue], idl.sequence(KeyValue)] = field(default_factory=list)


@_message("RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e")
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticArray_"):
    """``diagnostic_msgs/msg/DiagnosticArray``."""

    header: Header = field(default_factory=Header)
    status: Annotated[Sequence[DiagnosticStatus], idl.sequence(DiagnosticStatus)] = field(
        default_factory=list
    )


# --- rcl_interfaces ----------------------------------------------------------------------------------------------


@_message("RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac")
class Log(IdlStruct, typename="rcl_interfaces.msg.dds_.Log_"):
    """``rcl_interfaces/msg/Log``; level 10 debug, 20 info, 30 warning, 40 error, 50 fatal."""

    stamp: Time = field(default_factory=Time)
    level: UInt8 = 20
    name: str = ""
    msg: str = ""
    file: str = ""
    function: str = ""
    line: UInt32 = 0


@_message("RIHS01_115fc089a387e23c7ecd3525c9189c379109119d6ab82e8dfbde0fdf6a7f9b68")
class ParameterValue(IdlStruct, typename="rcl_interfaces.msg.dds_.ParameterValue_"):
    """``rcl_interfaces/msg/ParameterValue``; the type says which field holds the value."""

    type: UInt8 = 0
    bool_value: bool = False
    integer_value: Int64 = 0
    double_value: Double = 0.0
    string_value: str = ""
    byte_array_value: Bytes = field(default_factory=list)
    bool_array_value: Bools = field(default_factory=list)
    integer_array_value: Ints = field(default_factory=list)
    double_array_value: Doubles = field(default_factory=list)
    string_array_value: Strings = field(default_factory=list)


@_message()
class Parameter(IdlStruct, typename="rcl_interfaces.msg.dds_.Parameter_"):
    """``rcl_interfaces/msg/Parameter``."""

    name: str = ""
    value: ParameterValue = field(default_factory=ParameterValue)


Parameters: TypeAlias = Annotated[Sequence[Parameter], idl.sequence(Parameter)]


@_message()
class FloatingPointRange(IdlStruct, typename="rcl_interfaces.msg.dds_.FloatingPointRange_"):
    """``rcl_interfaces/msg/FloatingPointRange``."""

    from_value: Double = 0.0
    to_value: Double = 0.0
    step: Double = 0.0


@_message()
class IntegerRange(IdlStruct, typename="rcl_interfaces.msg.dds_.IntegerRange_"):
    """``rcl_interfaces/msg/IntegerRange``."""

    from_value: Int64 = 0
    to_value: Int64 = 0
    step: UInt64 = 0


@_message("RIHS01_52175dbfda6c51153101d33d2a9da05743f66f02d5ab2ca9ec4709b46b73d704")
class ParameterDescriptor(IdlStruct, typename="rcl_interfaces.msg.dds_.ParameterDescriptor_"):
    """``rcl_interfaces/msg/ParameterDescriptor``."""

    name: str = ""
    type: UInt8 = 0
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = False
    dynamic_typing: bool = False
    floating_point_range: Annotated[Sequence[FloatingPointRange], idl.sequence(FloatingPointRange, 1)] = (
        field(default_factory=list)
    )
    integer_range: Annotated[Sequence[IntegerRange], idl.sequence(IntegerRange, 1)] = field(
        default_factory=list
    )


@_message()
class SetParametersResult(IdlStruct, typename="rcl_interfaces.msg.dds_.SetParametersResult_"):
    """``rcl_interfaces/msg/SetParametersResult``."""

    successful: bool = False
    reason: str = ""


@_message()
class ListParametersResult(IdlStruct, typename="rcl_interfaces.msg.dds_.ListParametersResult_"):
    """``rcl_interfaces/msg/ListParametersResult``."""

    names: Strings = field(default_factory=list)
    prefixes: Strings = field(default_factory=list)


@_message("RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204")
class ParameterEvent(IdlStruct, typename="rcl_interfaces.msg.dds_.ParameterEvent_"):
    """``rcl_interfaces/msg/ParameterEvent``."""

    stamp: Time = field(default_factory=Time)
    node: str = ""
    new_parameters: Parameters = field(default_factory=list)
    changed_parameters: Parameters = field(default_factory=list)
    deleted_parameters: Parameters = field(default_factory=list)


@_message(service_hash="RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d")
class ListParametersRequest(IdlStruct, typename="rcl_interfaces.srv.dds_.ListParameters_Request_"):
    """Request of ``rcl_interfaces/srv/ListParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    prefixes: Strings = field(default_factory=list)
    depth: UInt64 = 0


@_message()
class ListParametersReply(IdlStruct, typename="rcl_interfaces.srv.dds_.ListParameters_Response_"):
    """Reply of ``rcl_interfaces/srv/ListParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    result: ListParametersResult = field(default_factory=ListParametersResult)


@_message(service_hash="RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc")
class GetParametersRequest(IdlStruct, typename="rcl_interfaces.srv.dds_.GetParameters_Request_"):
    """Request of ``rcl_interfaces/srv/GetParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    names: Strings = field(default_factory=list)


@_message()
class GetParametersReply(IdlStruct, typename="rcl_interfaces.srv.dds_.GetParameters_Response_"):
    """Reply of ``rcl_interfaces/srv/GetParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    values: Annotated[Sequence[ParameterValue], idl.sequence(ParameterValue)] = field(default_factory=list)


@_message(service_hash="RIHS01_da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca")
class GetParameterTypesRequest(IdlStruct, typename="rcl_interfaces.srv.dds_.GetParameterTypes_Request_"):
    """Request of ``rcl_interfaces/srv/GetParameterTypes``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    names: Strings = field(default_factory=list)


@_message()
class GetParameterTypesReply(IdlStruct, typename="rcl_interfaces.srv.dds_.GetParameterTypes_Response_"):
    """Reply of ``rcl_interfaces/srv/GetParameterTypes``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    types: Bytes = field(default_factory=list)


@_message(service_hash="RIHS01_845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff")
class DescribeParametersRequest(IdlStruct, typename="rcl_interfaces.srv.dds_.DescribeParameters_Request_"):
    """Request of ``rcl_interfaces/srv/DescribeParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    names: Strings = field(default_factory=list)


@_message()
class DescribeParametersReply(IdlStruct, typename="rcl_interfaces.srv.dds_.DescribeParameters_Response_"):
    """Reply of ``rcl_interfaces/srv/DescribeParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    descriptors: Annotated[Sequence[ParameterDescriptor], idl.sequence(ParameterDescriptor)] = field(
        default_factory=list
    )


@_message(service_hash="RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0")
class SetParametersRequest(IdlStruct, typename="rcl_interfaces.srv.dds_.SetParameters_Request_"):
    """Request of ``rcl_interfaces/srv/SetParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    parameters: Parameters = field(default_factory=list)


@_message()
class SetParametersReply(IdlStruct, typename="rcl_interfaces.srv.dds_.SetParameters_Response_"):
    """Reply of ``rcl_interfaces/srv/SetParameters``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    results: Annotated[Sequence[SetParametersResult], idl.sequence(SetParametersResult)] = field(
        default_factory=list
    )


@_message(service_hash="RIHS01_0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd")
class SetParametersAtomicallyRequest(
    IdlStruct, typename="rcl_interfaces.srv.dds_.SetParametersAtomically_Request_"
):
    """Request of ``rcl_interfaces/srv/SetParametersAtomically``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    parameters: Parameters = field(default_factory=list)


@_message()
class SetParametersAtomicallyReply(
    IdlStruct, typename="rcl_interfaces.srv.dds_.SetParametersAtomically_Response_"
):
    """Reply of ``rcl_interfaces/srv/SetParametersAtomically``."""

    guid: UInt64 = 0
    sequence: Int64 = 0
    result: SetParametersResult = field(default_factory=SetParametersResult)


# --- rmw_dds_common ----------------------------------------------------------------------------------------------


@_message()
class Gid(IdlStruct, typename="rmw_dds_common.msg.dds_.Gid_"):
    """``rmw_dds_common/msg/Gid``, 16 bytes as from Iron on."""

    data: Annotated[Sequence[int], idl.array(idl.uint8, 16)] = bytes(16)


Gids: TypeAlias = Annotated[Sequence[Gid], idl.sequence(Gid)]


@_message()
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.NodeEntitiesInfo_"):
    """``rmw_dds_common/msg/NodeEntitiesInfo``."""

    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: Gids = field(default_factory=list)
    writer_gid_seq: Gids = field(default_factory=list)


@_message("RIHS01_e725f4a506958c79f95dd693b965722c57b19cd18e7eff984f49561b93dc985d")
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_"):
    """``rmw_dds_common/msg/ParticipantEntitiesInfo``: the nodes of one process and what they read and write."""

    gid: Gid = field(default_factory=Gid)
    node_entities_info_seq: Annotated[Sequence[NodeEntitiesInfo], idl.sequence(NodeEntitiesInfo)] = field(
        default_factory=list
    )


# --- lbr_fri_idl -------------------------------------------------------------------------------------------------


@_message("RIHS01_fd177ecc6baa43da48eb4def81ca8527febc5f5d5c9b6a0fcd8b27933377e3e0")
class LBRState(IdlStruct, typename="lbr_fri_idl.msg.dds_.LBRState_"):
    """``lbr_fri_idl/msg/LBRState`` of lbr_fri_ros2_stack: what a KUKA LBR says by FRI."""

    sample_time: Double = 0.0
    session_state: Int8 = 0
    connection_quality: Int8 = 0
    safety_state: Int8 = 0
    operation_mode: Int8 = 0
    drive_state: Int8 = 0
    client_command_mode: Int8 = 0
    overlay_type: Int8 = 0
    control_mode: Int8 = 0
    time_stamp_sec: UInt32 = 0
    time_stamp_nano_sec: UInt32 = 0
    measured_joint_position: Seven = field(default_factory=lambda: [0.0] * 7)
    measured_torque: Seven = field(default_factory=lambda: [0.0] * 7)
    commanded_torque: Seven = field(default_factory=lambda: [0.0] * 7)
    external_torque: Seven = field(default_factory=lambda: [0.0] * 7)
    ipo_joint_position: Seven = field(default_factory=lambda: [0.0] * 7)
    tracking_performance: Double = 0.0
