"""What a robot publishes as samples of an arm: joints put in order, one publisher, one time base."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeAlias

import numpy as np

from ..arm import Array
from ..errors import InputError
from ..logs import Sample
from .messages import JointState, LBRState
from .node import Node, Subscription
from .transport import STREAM, Reliability

Kind: TypeAlias = Literal["joint_state", "lbr_state"]
Stamp: TypeAlias = Literal["header", "arrival"]

KINDS: tuple[Kind, ...] = ("joint_state", "lbr_state")
STAMPS: tuple[Stamp, ...] = ("header", "arrival")
_TRIAL = 5
"""messages of a new publisher that are passed over until it is clear that the one before is silent"""
_NO_TIME = "its stamps are zero; let them be the time of writing: --stamp arrival, or the parameter stamp"
_NAMES = 1000
"""joints in one message, at most"""


class OneWriter:
    """Follows one writer of a topic. Where two write, nothing is taken until one of them is gone.

    One that follows another, such as a node that was killed and started anew, is taken after a few messages: the
    other one may be long dead before that is known.
    """

    def __init__(self, node: Node, subscription: Subscription) -> None:
        self.fresh = True
        """another writer is followed than before; whoever has seen that puts it to False"""
        self._node, self._subscription = node, subscription
        self._writer, self._rival, self._heard = 0, 0, 0
        self._torn = False
        node.watch(self._settle)

    def accept(self, writer: int) -> bool:
        """Whether a message of this writer may be used."""
        if writer != self._writer and not self._take_over(writer):
            return False
        if self._rival and not self._torn:
            self._torn = True
            topic = self._subscription.name
            nodes = sorted(p.node or "an unnamed node" for p in self._subscription.publishers())
            self._node.trouble(
                f"{topic} publishers",
                f"{len(nodes)} publish {topic} at the same time ({', '.join(nodes)}): remap or stop one; "
                "nothing is used meanwhile",
            )
        return not self._torn

    def _take_over(self, writer: int) -> bool:
        """Whether a writer that was not followed before may be."""
        known = bool(self._writer) and self._subscription.alive(self._writer)
        if known and writer != self._rival:
            self._rival, self._heard = writer, 0
        self._heard += 1
        if known and (self._torn or self._heard <= _TRIAL):
            return False
        self._writer, self._rival, self._heard = writer, 0, 0
        self.fresh = True
        return True

    def _settle(self) -> None:
        """Go on when one of two writers is gone."""
        alive = self._subscription.alive
        if self._torn and not (alive(self._writer) and alive(self._rival)):
            self._torn = False
            self._rival = self._heard = 0
            self._node.trouble(f"{self._subscription.name} publishers", "")


class SampleSource:
    """Subscribes to the states of an arm and gives them as samples.

    Joints may come in any order and among others. Where two publish, nothing is used until one of them is gone; one
    that follows another, such as a driver that was started anew, is taken after a few messages. A stamp that was there
    already is given out as a repetition; one that lies before the last is passed over, and two of these in order are
    a new time base.

    Args:
        node: that reads.
        joint_names: of the arm, base to tip.
        topic: where.
        sample: called with every sample, and whether it repeats the one before.
        restart: called when a new time base begins: what was known of the past is void.
        kind: "joint_state" (sensor_msgs/msg/JointState) or "lbr_state" (lbr_fri_idl/msg/LBRState; seven joints, whose
            torques count as the controller gives them).
        stamp: "header": the publisher's own time; "arrival": that of the message's writing, for a publisher that
            leaves its stamps at zero.
        torque_sign: of "lbr_state": +1 if a positive measured torque pushes the joint in its positive direction, -1 if
            not. Hold something up and look: the convention was not checked on a robot.

    Raises:
        InputError: kind or stamp is none of the choices; an LBR has seven joints.
    """

    def __init__(
        self,
        node: Node,
        joint_names: Sequence[str],
        topic: str,
        sample: Callable[[Sample, bool], None],
        *,
        restart: Callable[[], None] = lambda: None,
        kind: Kind = "joint_state",
        stamp: Stamp = "header",
        torque_sign: int = 1,
        how: Reliability = STREAM,
    ) -> None:
        if kind not in KINDS:
            raise InputError(f"kind must be {' or '.join(KINDS)}, got {kind!r}")
        if stamp not in STAMPS:
            raise InputError(f"stamp must be {' or '.join(STAMPS)}, got {stamp!r}")
        if kind == "lbr_state" and len(joint_names) != 7:
            raise InputError(f"an LBR has 7 joints, this arm has {len(joint_names)}")
        if torque_sign not in (1, -1):
            raise InputError(f"torque_sign must be 1 or -1, got {torque_sign!r}")
        self._node = node
        self._sign = float(torque_sign)
        self._joints = tuple(joint_names)
        self._sample, self._restart, self._stamp = sample, restart, stamp
        self.refused = 0
        """messages that gave no sample"""
        self._names: tuple[str, ...] | None = None
        self._order: list[int] | None = None
        self._arranged = ""
        self._last = self._back = -(2**63)
        read = self._joint_state if kind == "joint_state" else self._lbr_state
        self._read: Callable[[Any], Sample | None] = read
        message = JointState if kind == "joint_state" else LBRState
        self.subscription: Subscription = node.subscribe(message, topic, self._take, how)
        self._one = OneWriter(node, self.subscription)

    @property
    def topic(self) -> str:
        """Full name."""
        return self.subscription.name

    def _take(self, message: Any, writer: int) -> None:
        sample = self._read(message) if self._one.accept(writer) else None
        if sample is None:
            self.refused += 1
        else:
            self._give(sample)

    # --- when ----------------------------------------------------------------------------------------------------

    def _give(self, sample: Sample) -> None:
        time_ns, forth = sample.time_ns, -(2**63)
        if time_ns < self._last:
            # one stamp from the past is a stray; from a new publisher, or with another behind it, it is a new clock
            if not self._one.fresh and (time_ns <= self._back or self._back == forth):
                self._back = time_ns
                self.refused += 1
                late = (self._last - time_ns) * 1e-9
                self._node.trouble(
                    f"{self.topic} time",
                    f"{self.topic}: a stamp lies {late:.3g} s before the one before",
                    error=False,
                )
                return
            self._node.log(
                f"{self.topic}: the publisher's clock went back by {(self._last - time_ns) * 1e-9:.3g} s: "
                "beginning anew",
                level=30,
            )
            self._restart()
        if self._back != forth:
            self._node.trouble(f"{self.topic} time", "")
            self._back = forth
        self._one.fresh = False
        repeated = time_ns == self._last
        self._last = time_ns
        self._sample(sample, repeated)

    # --- what ----------------------------------------------------------------------------------------------------

    def _time(self, message: Any, stamped_ns: int) -> int:
        """[ns], 0: not told."""
        return int(message.sample_info.source_timestamp) if self._stamp == "arrival" else stamped_ns

    def _complain(self, text: str) -> None:
        self._node.trouble(f"{self.topic} content", text and f"{self.topic}: {text}"[:500])

    def _joint_state(self, message: JointState) -> Sample | None:
        names = tuple(message.name)
        if names != self._names:
            self._names, self._order = names, None
            self._arranged = self._arrange(names)
        complaint, sample = self._arranged, None
        lengths = len(message.position), len(message.velocity), len(message.effort)
        time_ns = self._time(message, message.header.stamp.time_ns)
        if complaint or self._order is None:
            pass
        elif time_ns == 0:
            complaint = _NO_TIME
        elif lengths[0] != len(names) or any(n not in (0, len(names)) for n in lengths[1:]):
            complaint = (
                "{}, {}, {} positions, velocities, efforts".format(*lengths) + f" of {len(names)} joints"
            )
        else:
            velocity = np.array(message.velocity)[self._order] if lengths[1] else None
            if lengths[2]:
                effort = np.array(message.effort)[self._order]
            else:
                complaint = "no efforts: there is nothing to feel or weigh by"
                effort = np.full(len(self._joints), np.nan)
            sample = Sample(time_ns, np.array(message.position)[self._order], velocity, effort)
        self._complain(complaint)
        return sample

    def _arrange(self, names: tuple[str, ...]) -> str:
        """Find the arm's joints among the names; what is wrong with these, or nothing."""
        said = ", ".join(names[:20]) + (", ..." if len(names) > 20 else "") or "none"
        if len(names) > _NAMES:
            return f"{len(names)} joints in one message; at most {_NAMES} are read"
        if missing := [joint for joint in self._joints if joint not in names]:
            return f"joint {missing[0]!r} is missing; there are {said}"
        if len(set(names)) < len(names):
            return f"a joint comes twice: {said}"
        self._order = [names.index(joint) for joint in self._joints]
        return ""

    def _lbr_state(self, message: LBRState) -> Sample | None:
        time_ns = self._time(message, message.time_stamp_sec * 1_000_000_000 + message.time_stamp_nano_sec)
        self._complain("" if time_ns else _NO_TIME)
        if not time_ns:
            return None
        position: Array = np.array(message.measured_joint_position, dtype=np.float64)
        effort: Array = self._sign * np.array(message.measured_torque, dtype=np.float64)
        return Sample(time_ns, position, None, effort)
