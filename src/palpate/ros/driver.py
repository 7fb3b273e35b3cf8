"""A robot of a ROS 2 graph behind the driver contract. Needs ``palpate[ros]``."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Literal, TypeAlias

import numpy as np

from .._core import __version__
from ..arm import Arm, Array
from ..drivers import Driver
from ..errors import DriverError
from ..logs import Log, Sample
from ..session import card_text
from .arguments import RosArguments
from .context import Context, Rmw
from .messages import Float64MultiArray, Header, JointState, Time
from .node import Node, Publisher
from .source import Kind, SampleSource, Stamp
from .transport import STREAM

CommandKind: TypeAlias = Literal["float64_multi_array", "joint_state"]
_FAREWELL = 0.2
"""for the last command to arrive [s]"""
_BACKLOG = 10_000
"""samples that wait to be read, at most"""


class RosDriver(Driver):
    """Reads an arm that publishes its joints' states and, if told a command topic, moves it by torque.

    Positions, velocities (where published) and efforts are taken as they come, in the order of the arm's joints.
    Without a `command` topic the driver watches: enable() is refused. With one, write() publishes link-side torque
    [N m], clipped to the joints' effort limits, as what ros2_control's effort controllers take
    ("float64_multi_array", in the order of the arm's joints: the controller's own list must be the same), or as
    ``sensor_msgs/msg/JointState`` with names and the stamp of the sample it answers. disable() and stop() publish
    zero torque once: the arm must bear that, as any that is controlled by torque; a JointState then holds no names.

    Where samples stay away, read() returns None, and raises DriverError after `patience`; so it does at once when
    the publisher's clock jumps back. close() and connect() begin anew.

    Args:
        arm: its effort says what the efforts of the messages are.
        topic: of the states.
        kind: "joint_state" or "lbr_state", see :class:`SampleSource`.
        stamp: "header" or "arrival", see :class:`SampleSource`.
        torque_sign: of "lbr_state", see :class:`SampleSource`.
        command: topic of the commands; None: watch only.
        command_kind: what is published there.
        rate: samples per second that the robot publishes, roughly [Hz].
        patience: longest silence [s].
        domain: of ROS; None: ``ROS_DOMAIN_ID``, or 0.
        localhost: stay on this machine; None: as the environment says.
        rmw: what carries messages, "dds" or "zenoh"; None: as the environment says.
        name: of the node.
        arguments: remappings.

    Raises:
        DriverError: rate or patience is out of range, or the arm of an LBR declares another effort than torque.
    """

    def __init__(
        self,
        arm: Arm,
        topic: str = "/joint_states",
        *,
        kind: Kind = "joint_state",
        stamp: Stamp = "header",
        torque_sign: int = 1,
        command: str | None = None,
        command_kind: CommandKind = "float64_multi_array",
        rate: float = 250.0,
        patience: float = 1.0,
        domain: int | None = None,
        localhost: bool | None = None,
        rmw: Rmw | None = None,
        name: str = "palpate",
        arguments: RosArguments | None = None,
    ) -> None:
        if not 1.0 <= rate <= 10_000.0:
            raise DriverError(f"rate must be between 1 and 10000 Hz, got {rate!r}")
        if not 2.0 / rate <= patience <= 3600.0:
            raise DriverError(f"patience must be two periods to 3600 s, got {patience!r}")
        if kind == "lbr_state" and arm.effort.kind != "torque":
            raise DriverError(f"an LBR reports torque: declare Effort.torque(), not {arm.effort.kind}")
        super().__init__(arm.joint_names, round(1e9 / rate), arm.effort)
        self._topic, self._kind, self._stamp, self._sign = topic, kind, stamp, torque_sign
        self._command, self._command_kind = command, command_kind
        self._patience = float(patience)
        self._where = (domain, localhost, rmw)
        self._name, self._arguments = name, arguments
        self._limit = np.array([j.limits.effort for j in arm.joints])
        self._context: Context | None = None
        self._node: Node | None = None
        self._source: SampleSource | None = None
        self._commands: Publisher | None = None
        self._waiting: deque[Sample] = deque()
        self._arrived = 0.0
        self._newest_ns = 0
        self._jumped = False
        self._commanded = False
        self._lost = 0

    @property
    def lost(self) -> int:
        """Samples since connect() that came faster than they were read, and were dropped."""
        return self._lost

    @property
    def refused(self) -> int:
        """Messages since connect() that gave no sample."""
        return 0 if self._source is None else self._source.refused

    @property
    def troubles(self) -> Sequence[str]:
        """What is wrong with what comes, in words; empty: nothing."""
        return () if self._node is None else self._node.troubles

    def _connect(self) -> None:
        domain, localhost, rmw = self._where
        self._context = Context(domain, localhost=localhost, rmw=rmw)
        try:
            self._node = Node(self._name, self._context, arguments=self._arguments, quiet=True)
            self._source = SampleSource(
                self._node,
                self._joint_names,
                self._topic,
                self._take,
                restart=self._jump,
                kind=self._kind,
                stamp=self._stamp,
                torque_sign=self._sign,
            )
            if self._command is not None:
                message = JointState if self._command_kind == "joint_state" else Float64MultiArray
                self._commands = self._node.publish(message, self._command, STREAM)
            self._waiting.clear()
            self._jumped = self._commanded = False
            self._lost = 0
            self._arrived = time.monotonic()
            while not self._waiting:
                self._node.spin_once(0.05)
                self._complain_if_silent("connect()")
        except BaseException:
            self._close()
            raise

    def _take(self, sample: Sample, repeated: bool) -> None:
        self._arrived = time.monotonic()
        if repeated:
            return
        if len(self._waiting) >= _BACKLOG:
            self._waiting.popleft()
            self._lost += 1
        self._waiting.append(sample)

    def _jump(self) -> None:
        self._jumped = True

    def _complain_if_silent(self, verb: str) -> None:
        assert self._node is not None and self._source is not None
        silent = time.monotonic() - self._arrived
        # what comes and cannot be used will not mend by waiting
        useless = bool(self._source.refused and self._node.troubles)
        if silent <= (min(self._patience, 1.0) if useless else self._patience):
            return
        wrong = self._node.troubles or [self._source.subscription.look(), "no message came"]
        reason = next(text for text in wrong if text)
        raise DriverError(f"{verb}: no sample of {self._source.topic} for {silent:.2g} s: {reason}")

    def _read(self) -> Sample | None:
        node = self._node
        assert node is not None
        end = time.monotonic() + max(2e-9 * self._period_ns, 0.02)
        node.spin_once(0.0)
        while not self._waiting:
            rest = end - time.monotonic()
            if rest <= 0.0:
                self._complain_if_silent("read()")
                return None
            node.spin_once(rest)
        if self._jumped:
            raise DriverError(
                f"read(): the clock of {self._topic} went back: its publisher was started anew; close() and connect()"
            )
        sample = self._waiting.popleft()
        self._newest_ns = sample.time_ns
        return sample

    def _publish(self, torque: Array, names: tuple[str, ...]) -> None:
        assert self._commands is not None
        if self._command_kind == "joint_state":
            header = Header(Time.of(self._newest_ns))
            self._commands.publish(JointState(header, names, effort=torque.tolist() if names else []))
        else:
            self._commands.publish(Float64MultiArray(data=torque.tolist()))

    def _write(self, torque: Array) -> Array:
        sent: Array = np.clip(torque, -self._limit, self._limit)
        self._publish(sent, self._joint_names)
        self._commanded = True
        return sent

    def _enable(self) -> None:
        if self._commands is None or self._node is None:
            raise DriverError(
                "enable(): this driver watches the arm only; to command it, name the topic that takes torque: command"
            )
        commands = self._commands
        if not self._node.spin_until(lambda: commands.readers > 0, self._patience):
            raise DriverError(f"enable(): nobody reads {commands.name}: is the controller loaded and active?")

    def _disable(self) -> None:
        if self._commanded:
            assert self._commands is not None  # there were commands
            self._commanded = False
            self._publish(np.zeros(self.n), ())
            self._commands.flush(_FAREWELL)  # closing at once would take it back

    def _close(self) -> None:
        if self._node is not None:
            self._node.close()
        self._node = self._source = self._commands = None
        if self._context is not None:
            self._context.close()
        self._context = None


def collect(
    arm: Arm,
    driver: Driver,
    seconds: float,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> Log:
    """What a connected driver reads while its own clock advances by `seconds` [s], or until `stop()`.

    The log carries the arm's card, so that it is weighed without naming the arm again.

    Raises:
        DriverError: the arm is lost.
    """
    samples: list[Sample] = []
    while not stop() and (not samples or samples[-1].time_ns - samples[0].time_ns < seconds * 1e9):
        sample = driver.read()
        if sample is not None:
            samples.append(sample)
    velocities = [s.velocity for s in samples if s.velocity is not None]
    return Log(
        time_ns=np.array([s.time_ns for s in samples], dtype=np.int64),
        position=np.array([s.position for s in samples]).reshape(-1, arm.n),
        velocity=np.array(velocities) if samples and len(velocities) == len(samples) else None,
        effort=np.array([s.effort for s in samples]).reshape(-1, arm.n),
        joint_names=arm.joint_names,
        meta={
            "palpate_version": __version__,
            "arm_card": card_text(arm),
            "effort_unit": "A" if arm.effort.kind == "current" else "N m",
        },
    )
