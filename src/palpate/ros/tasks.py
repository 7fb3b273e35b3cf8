"""The published graph, a node for each task: arm, trajectory, control, observers, mass.

Source of the partition: the mass-estimation report (section "A ROS node for each task"; Negrete and Savage 2020).
Every message carries the stamp of the sample it answers, and nothing looks at a wall clock but the simulated arm,
which keeps pace and, commanded in step, waits for the command of each sample. A repeated sample is answered by the same
message again: so a node that comes late, or was started anew, joins without anything being lost or computed twice.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from .._core import Status, WrenchEstimator
from ..arm import Arm, Array, Sensing
from ..control import Controller, Quintic, SafetyLimiter, Setpoint
from ..drivers.mujoco import MujocoDriver
from ..errors import InputError
from ..logs import Sample
from ..pipeline import ESTIMATORS, OBSERVERS, Pipeline, Touch
from ..weigh import Scene, Task, brick, check_mass, find_pose, load_arm, scene, simulated_driver
from ..weigh.scenes import gains_at, parse_effort
from .arguments import RosArguments
from .context import Context
from .messages import (
    Float64,
    Header,
    Inertia,
    InertiaStamped,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)
from .node import Node, Publisher
from .source import KINDS, STAMPS, OneWriter, SampleSource
from .transport import LARGEST

_Message = TypeVar("_Message")
_RESEND = 0.25
"""after so long without a command a sample is sent again [s]"""
_START_NS = 1_000_000_000
"""stamp of a simulated arm's first sample: 0 means no stamp in ROS [ns]"""
_HELD = 0.1
"""how long a command holds where the arm does not wait for the next [s]"""
_KEPT = 100
"""setpoints that wait for their state, and states for their setpoint"""


class TaskNode(Node):
    """A node of the graph with the arm it is about.

    Args:
        context: where it lives.
        arguments: remappings and values of parameters.
        quiet: say nothing on stderr.

    Raises:
        PalpateError: a name, a parameter or the arm is wrong.
    """

    task = ""
    """name of the node, and of the task"""
    about = ""
    """what it does, one line"""
    reads_samples = False
    """whether it reads joint_states"""
    simulated = False
    """whether the arm is; a launch ends where it does"""
    largest = LARGEST
    """of its messages [kB]"""

    def __init__(
        self, context: Context, arguments: RosArguments | None = None, *, quiet: bool = False
    ) -> None:
        super().__init__(self.task, context, arguments=arguments, quiet=quiet)
        self.finished = False
        try:
            self._begin()
        except BaseException:
            Node.close(self)
            raise

    def _begin(self) -> None:
        self._choose_arm()
        self._prepare()
        for remark in self.parameters.check_overrides():
            self.log(remark, level=30)
        self.parameters.on_set(self._consider)

    def _choose_arm(self) -> None:
        """Declare which arm it is about, and load it."""
        self.arm_name: str = self._declare(
            "arm", "justina_left_arm", "name of a reference arm, a card or a URDF", fixed=True
        )
        effort: str = self._declare(
            "effort",
            "",
            "what efforts are, where the card does not say: torque, or current:GAIN,...",
            fixed=True,
        )
        assume: bool = self._declare(
            "assume",
            self.simulated,
            "what the arm's description leaves open is taken as in simulation, and said",
            fixed=True,
        )
        arm = load_arm(self.arm_name)
        arm = arm.replace(effort=parse_effort(effort)) if effort else arm
        self.scene: Scene = scene(arm)
        self.arm: Arm = self.scene.arm if assume else arm
        for sentence in self.scene.assumed if assume else ():
            self.log(sentence)

    def _declare(self, name: str, default: Any, meaning: str, *, fixed: bool = False) -> Any:
        return self.parameters.declare(name, default, meaning, read_only=fixed)

    def _prepare(self) -> None:
        """Declare parameters, publish and subscribe."""
        raise NotImplementedError

    def _consider(self, values: Mapping[str, Any]) -> None:
        """Parameters are about to change to these; InputError refuses."""

    def header(self, time_ns: int) -> Header:
        """Stamped [ns], in the arm's base."""
        return Header(Time.of(time_ns), self.arm.base)

    def work(self) -> None:
        """One turn."""
        self.spin_once()

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Work until `stop()` or until the task is done.

        Raises:
            PalpateError: the task cannot go on.
        """
        while not (self.finished or stop()):
            self.work()

    def read_samples(self, step: Callable[[Sample, bool], None], restart: Callable[[], None]) -> SampleSource:
        """Have every sample of ``joint_states`` given to `step`, with whether it repeats the one before."""
        kind = self._declare(
            "state_kind", "joint_state", f"what joint_states is: {', '.join(KINDS)}", fixed=True
        )
        stamp = self._declare("stamp", "header", f"which time counts: {', '.join(STAMPS)}", fixed=True)
        sign = self._declare("torque_sign", 1, "of an LBR's measured torque: 1 or -1", fixed=True)
        return SampleSource(
            self,
            self.arm.joint_names,
            "joint_states",
            step,
            restart=restart,
            kind=kind,
            stamp=stamp,
            torque_sign=sign,
        )


class ArmSimulation(TaskNode):
    """The simulated arm: publishes ``joint_states``, takes torque from ``joint_commands`` (a JointState's effort).

    Once a command has come, each period waits for the command that bears its sample's stamp (parameter ``lockstep``;
    the first may bear any). A command without names lets time go on by itself, with no torque.
    """

    task = "arm_simulation"
    about = "a simulated arm with noise: joint_states out, torque in by joint_commands"
    simulated = True

    def _prepare(self) -> None:
        declare = self._declare
        start = declare("start", self.scene.start, "pose it begins in: a name, or angles [rad]", fixed=True)
        mass = declare("payload_mass", self.scene.mass, "what it holds [kg]; 0: nothing")
        self._lockstep = declare("lockstep", True, "wait for the command of every sample", fixed=True)
        pace = declare("pace", 1.0, "simulated seconds per second; 0: as fast as it goes", fixed=True)
        self._awaited = declare(
            "wait_for",
            0,
            "readers of joint_states before time begins; then a command is awaited too",
            fixed=True,
        )
        self._duration = declare("duration", 0.0, "then it ends [s]; 0: never", fixed=True)
        task = Task(
            scene=self.scene,
            start=find_pose(self.scene, start)[1],
            poses=(find_pose(self.scene, start)[1],),
            loads=((0.0, mass),) if mass else (),
            rate=declare("rate", 250.0, "samples per second [Hz]", fixed=True),
            noise=declare("noise", True, "of encoders and drives", fixed=True),
            seed=declare("seed", 0, "of the noise", fixed=True),
            speed=pace or None,
        )
        self._driver: MujocoDriver = simulated_driver(task)
        self._gain = self.arm.effort.gain(self.arm.n)
        self._states = self.publish(JointState, "joint_states")
        self._reader = self.subscribe(JointState, "joint_commands", self._take)
        self._one = OneWriter(self, self._reader)
        self._message = JointState()
        self._stamp_ns, self._sent = 0, 0.0
        self._commanded = self._awaited > 0
        self._command: Array | None = None
        self._begun = False
        self._ignored = 0
        self._stop: Callable[[], bool] = lambda: False
        self._uncommanded = 0.0

    def _consider(self, values: Mapping[str, Any]) -> None:
        mass = check_mass(values["payload_mass"])
        if self._begun and mass != self.parameters["payload_mass"]:
            load = brick(mass)
            if load is None:
                self._driver.plant.release()
            else:
                self._driver.plant.attach(load)

    def _take(self, message: JointState, writer: int) -> None:
        if not self._one.accept(writer):
            return
        if not message.name:
            self._commanded, self._command = False, np.zeros(self.arm.n)
            return
        complaint = ""
        effort = dict(zip(message.name, message.effort, strict=False))
        if len(message.effort) != len(message.name) or set(effort) != set(self.arm.joint_names):
            complaint = (
                f"{self._reader.name}: expected one effort for each of {', '.join(self.arm.joint_names)}"
            )
        else:
            torque = np.array([effort[name] for name in self.arm.joint_names])
            if not np.isfinite(torque).all():
                complaint = f"{self._reader.name}: an effort is not a finite number"
        self.trouble("commands", complaint)
        if complaint:
            return
        joins = not self._commanded  # time went on by itself: no stamp can be the newest
        if joins or not self._lockstep or message.header.stamp.time_ns == self._stamp_ns:
            self._commanded, self._command = True, torque
        else:
            self._ignored += 1
            self.fact("commands for another sample", self._ignored)

    def work(self) -> None:
        """One period, or a look whether it may begin."""
        if not self._begun:
            if self._states.readers < self._awaited:
                self.spin_once()
                return
            self._driver.connect()
            self._driver.enable()
            self._begun = True
        elif self._lockstep and self._commanded:
            while self._commanded and self._command is None:
                if time.monotonic() - self._sent > _RESEND:
                    self._send()
                self.spin_once(0.05)
                if self._stop():
                    return
        else:
            self.spin_once(0.0)
        if self._command is not None:
            self._driver.write(self._command)
            self._command, self._uncommanded = None, 0.0
        elif self._commanded:
            self._uncommanded += self._driver.period_ns * 1e-9
            if self._uncommanded > _HELD:
                self._driver.write(np.zeros(self.arm.n))
                self._commanded = False
                self.log(f"no command for {_HELD:g} s: no torque", level=30)
        sample = self._driver.read()
        if sample is None:
            return
        self._stamp_ns = sample.time_ns + _START_NS
        self._message = JointState(
            self.header(self._stamp_ns),
            self.arm.joint_names,
            sample.position.tolist(),
            [] if sample.velocity is None else sample.velocity.tolist(),
            sample.effort.tolist(),
        )
        self._send()
        self.finished = 0.0 < self._duration <= sample.time_ns * 1e-9

    def run(self, stop: Callable[[], bool] = lambda: False) -> None:
        """See :meth:`TaskNode.run`."""
        self._stop = stop
        super().run(stop)

    def _send(self) -> None:
        self._states.publish(self._message)
        self._sent = time.monotonic()

    def close(self) -> None:
        """See :meth:`Node.close`."""
        self._driver.close()
        super().close()


class Trajectory(TaskNode):
    """Quintics from where the arm stands to ``pose``, then to whatever comes on ``goal``: ``setpoint`` per sample.

    A setpoint is a ``trajectory_msgs/msg/JointTrajectory`` of one point. A goal is a JointState whose names and
    positions say where to; joints it does not name stay. One that comes during a motion follows it.
    """

    task = "trajectory"
    about = "smooth motion to a pose, then to goals: setpoint out"
    reads_samples = True

    def _prepare(self) -> None:
        pose = self._declare("pose", self.scene.pose, "where it goes first: a name, or angles [rad]")
        self._move = self._declare(
            "move", 3.0, "duration of a motion [s]; longer where joints would be too fast"
        )
        self._consider(self.parameters.values())
        self._goal: Array | None = find_pose(self.scene, pose)[1]
        self._speed = np.array([j.limits.velocity for j in self.arm.joints])
        self._leg: Quintic | None = None
        self._began = 0
        self._message: JointTrajectory | None = None
        self._out = self.publish(JointTrajectory, "setpoint")
        self.subscribe(JointState, "goal", self._take, optional=True)
        self.read_samples(self._step, self._forget)

    def _consider(self, values: Mapping[str, Any]) -> None:
        goal = find_pose(self.scene, values["pose"])[1]
        if not 0.0 < values["move"] <= 600.0:
            raise InputError(f"move must be above 0 and at most 600 s, got {values['move']!r}")
        if values["pose"] != self.parameters["pose"]:
            self._goal = goal
        self._move = values["move"]

    def _take(self, message: JointState, writer: int) -> None:
        wanted = dict(zip(message.name, message.position, strict=False))
        if len(message.name) != len(message.position) or not set(wanted) <= set(self.arm.joint_names):
            self.trouble(
                "goal", f"goal: expected positions of joints among {', '.join(self.arm.joint_names)}"
            )
            return
        base = self._leg.sample(math.inf).q if self._leg is not None and self._goal is None else self._goal
        if base is None:
            self.trouble("goal", "goal: nothing is known of the arm yet")
            return
        q = np.array([wanted.get(name, base[i]) for i, name in enumerate(self.arm.joint_names)])
        try:
            self._goal = find_pose(self.scene, ",".join(repr(float(x)) for x in q))[1]
        except InputError as error:
            self.trouble("goal", f"goal: {error}")
            return
        self.trouble("goal", "")

    def _forget(self) -> None:
        if self._leg is not None and self._goal is None:
            self._goal = self._leg.sample(math.inf).q
        self._leg = None

    def _step(self, sample: Sample, repeated: bool) -> None:
        if repeated and self._message is not None:
            self._out.publish(self._message)
            return
        if not np.isfinite(sample.position).all():
            return
        now = (sample.time_ns - self._began) * 1e-9
        if self._goal is not None and (self._leg is None or now >= self._leg.duration):
            at = sample.position if self._leg is None else self._leg.sample(now).q
            least = float(np.max(1.875 * np.abs(self._goal - at) / (0.5 * self._speed)))
            self._leg = Quintic(at, self._goal, max(self._move, least))
            self._began, self._goal, now = sample.time_ns, None, 0.0
        assert self._leg is not None  # without a leg there is a goal
        point = self._leg.sample(now)
        self._message = JointTrajectory(
            self.header(sample.time_ns),
            self.arm.joint_names,
            [JointTrajectoryPoint(point.q.tolist(), point.dq.tolist(), point.ddq.tolist())],
        )
        self._out.publish(self._message)


class Control(TaskNode):
    """PD about the torque the arm needs: ``estimated_state`` and ``setpoint`` of one sample to ``joint_commands``."""

    task = "control"
    about = "PD with feed-forward and limits: torque out by joint_commands"

    def _prepare(self) -> None:
        gains = self.scene.gains or gains_at(self.arm, self.scene.poses[self.scene.pose], 1.0 / 250.0)
        self._declare("kp", gains[0].tolist(), "[N m/rad]")
        self._declare("kd", gains[1].tolist(), "[N m s/rad]")
        self._declare("feedforward", "inverse_dynamics", "reference_gravity, gravity or inverse_dynamics")
        self._consider(self.parameters.values())
        self._limiter = SafetyLimiter(self.arm)
        self._states: dict[int, tuple[Array, Array]] = {}
        self._setpoints: dict[int, Setpoint] = {}
        self._newest: int | None = None
        self._message: JointState | None = None
        self._out = self.publish(JointState, "joint_commands")
        self._one_state = OneWriter(self, self.subscribe(JointState, "estimated_state", self._state))
        self._one_setpoint = OneWriter(self, self.subscribe(JointTrajectory, "setpoint", self._setpoint))

    def _consider(self, values: Mapping[str, Any]) -> None:
        limit = [j.limits.effort for j in self.arm.joints]
        self._controller = Controller(
            self.arm, values["kp"], values["kd"], limit=limit, feedforward=values["feedforward"]
        )

    def _vectors(self, what: str, names: Any, *rows: Any) -> list[Array] | None:
        """Numbers in the order of the arm's joints; None, said, if they are not one per joint."""
        joints = self.arm.joint_names
        complaint = ""
        if tuple(names) != joints and sorted(names) != sorted(joints):
            complaint = f"{what}: expected the joints {', '.join(joints)}, got {', '.join(names[:20])}"
        elif any(len(row) != len(joints) for row in rows):
            complaint = f"{what}: expected {len(joints)} numbers of each kind"
        self.trouble(what, complaint[:500])
        if complaint:
            return None
        order = [list(names).index(joint) for joint in joints]
        return [np.array(row, dtype=np.float64)[order] for row in rows]

    def _state(self, message: JointState, writer: int) -> None:
        if not self._one_state.accept(writer):
            return
        found = self._vectors("estimated_state", message.name, message.position, message.velocity)
        if found is not None:
            self._keep(self._states, message.header.stamp.time_ns, (found[0], found[1]))

    def _setpoint(self, message: JointTrajectory, writer: int) -> None:
        if not self._one_setpoint.accept(writer):
            return
        if len(message.points) != 1:
            self.trouble("setpoint", f"setpoint: expected one point, got {len(message.points)}")
            return
        point = message.points[0]
        found = self._vectors(
            "setpoint", message.joint_names, point.positions, point.velocities, point.accelerations
        )
        if found is not None:
            self._keep(self._setpoints, message.header.stamp.time_ns, Setpoint(*found))

    def _keep(self, waiting: dict[int, _Message], time_ns: int, value: _Message) -> None:
        if time_ns == self._newest and self._message is not None:
            self._out.publish(self._message)
            return
        waiting[time_ns] = value
        while len(waiting) > _KEPT:
            del waiting[next(iter(waiting))]
        if time_ns in self._states and time_ns in self._setpoints:
            self._command(time_ns)

    def _command(self, time_ns: int) -> None:
        q, dq = self._states.pop(time_ns)
        setpoint = self._setpoints.pop(time_ns)
        forward = self._newest is not None and time_ns > self._newest
        dt = (time_ns - self._newest) * 1e-9 if forward and self._newest is not None else 1.0 / 250.0
        self._newest = time_ns
        torque, status = self._controller.step(setpoint, q, dq)
        torque, limited = self._limiter.step(torque, q, dq, dt)
        self.fact("status", (limited if status == Status.ok else status).name)
        self._message = JointState(self.header(time_ns), self.arm.joint_names, effort=torque.tolist())
        self._out.publish(self._message)


class Estimator(TaskNode):
    """A pipeline as a node: what it finds in ``joint_states``, published sample by sample.

    A number that is not ``ok`` is published as NaN: standard messages have no place for a status. The status itself is
    in the diagnostics. The options of the estimators are parameters; changing one begins anew.
    """

    reads_samples = True
    observer: str | None = None
    payload: str | None = None

    def _prepare(self) -> None:
        silent = [j.name for j in self.arm.joints if j.sensing == Sensing()]
        if silent:
            raise InputError(
                f"arm {self.arm.name!r} does not say how noisy its readings are ({', '.join(silent)}): no "
                "interval would be true; palpate identify measures it, the parameter assume takes it as in simulation"
            )
        self._kinds: list[tuple[str, type[Any]]] = []
        self._options: dict[str, Any] = {}
        for what, name, kinds in (
            ("observer", self.observer, OBSERVERS),
            ("estimator", self.payload, ESTIMATORS),
        ):
            if name is not None:
                self._kinds.append((what, kinds[name]))
                self._declare_options(what, self._default(kinds[name]).options())
        self._consider(self.parameters.values())
        self._answer: list[tuple[Publisher, Any]] = []
        self._open()
        self._status = ""
        self.read_samples(self._step, self._restart)

    def _default(self, kind: type[Any]) -> Any:
        return kind()

    def _declare_options(self, what: str, options: Mapping[str, Any]) -> None:
        for option, value in options.items():
            plain = list(value) if isinstance(value, tuple) else value
            if isinstance(plain, float) and math.isnan(plain):
                plain = -1.0  # parameters of ROS know no NaN, and no option is negative
            self._declare(f"{what}.{option}", plain, f"see palpate.{self._kinds[-1][1].__name__}")

    def _consider(self, values: Mapping[str, Any]) -> None:
        wanted = {name: value for name, value in values.items() if "." in name}
        if wanted == self._options:
            return
        made: dict[str, Any] = {}
        for what, kind in self._kinds:
            options = {}
            for option, default in self._default(kind).options().items():
                value = values[f"{what}.{option}"]
                unset = isinstance(default, float) and math.isnan(default) and value == -1.0
                options[option] = math.nan if unset else value
            try:
                made[what] = kind(**options)
            except (TypeError, ValueError) as error:
                raise InputError(f"{what}: {str(error).splitlines()[0]}") from None
        self._pipeline = self._pipe(made.get("observer"), made.get("estimator"))
        self._options = wanted

    def _pipe(self, observer: Any, payload: Any) -> Pipeline:
        return Pipeline(self.arm, observer=observer, payload=payload)

    def _open(self) -> None:
        """Make the publishers."""
        raise NotImplementedError

    def _restart(self) -> None:
        self._pipeline.reset()

    def _step(self, sample: Sample, repeated: bool) -> None:
        if not repeated:
            self._answer = self._messages(sample.time_ns, self._pipeline.step(sample))
        for publisher, message in self._answer:
            publisher.publish(message)

    def _messages(self, time_ns: int, touch: Touch) -> list[tuple[Publisher, Any]]:
        """What to publish."""
        raise NotImplementedError

    def _tell(self, status: Any) -> bool:
        """Put a status into the diagnostics; whether it is ok."""
        status = Status(int(status))
        name = status.name
        if name != self._status:
            self._status = name
            self.fact("status", name)
        return bool(status == Status.ok)

    def _joint_effort(self, time_ns: int, values: Array, ok: bool) -> JointState:
        numbers = values.tolist() if ok else [math.nan] * self.arm.n
        return JointState(self.header(time_ns), self.arm.joint_names, effort=numbers)


class SlidingModeObserver(Estimator):
    """``external_torque``, ``external_torque_std`` by the sliding-mode observer, the mass by the published formula."""

    task = "sliding_mode_observer"
    about = "external torque by the published observer, and the mass by the published joint formula"
    observer, payload = "sliding-mode", "joint-formula"

    def _open(self) -> None:
        self._torque = self.publish(JointState, "external_torque")
        self._std = self.publish(JointState, "external_torque_std")
        self._mass = self.publish(Float64, "~/payload_mass")

    def _messages(self, time_ns: int, touch: Touch) -> list[tuple[Publisher, Any]]:
        ok = self._tell(touch.external.status)
        weighed = Status(int(touch.payload.status)) == Status.ok
        return [
            (self._torque, self._joint_effort(time_ns, touch.external.torque, ok)),
            (self._std, self._joint_effort(time_ns, touch.external.std, ok)),
            (self._mass, Float64(float(touch.payload.mass) if weighed else math.nan)),
        ]


class ExtendedKalmanFilter(Estimator):
    """``estimated_state`` (position, velocity) and ``external_wrench`` by the extended Kalman filter."""

    task = "extended_kalman_filter"
    about = "position, velocity and the wrench at the hand by the extended Kalman filter"
    observer = "extended-kalman"

    def _pipe(self, observer: Any, payload: Any) -> Pipeline:
        return Pipeline(self.arm, observer=observer, payload=None, wrench=WrenchEstimator())

    def _open(self) -> None:
        self._state = self.publish(JointState, "estimated_state")
        self._wrench = self.publish(WrenchStamped, "external_wrench")

    def _messages(self, time_ns: int, touch: Touch) -> list[tuple[Publisher, Any]]:
        self._tell(touch.external.status)
        state = JointState(self.header(time_ns), self.arm.joint_names, touch.q.tolist(), touch.dq.tolist())
        wrench = touch.wrench
        assert wrench is not None  # it was asked for
        values = np.concatenate([wrench.force, wrench.moment])
        values[wrench.singular] = math.nan
        if Status(int(wrench.status)) not in (Status.ok, Status.singular):
            values[:] = math.nan
        force, moment = Vector3(*values[:3].tolist()), Vector3(*values[3:].tolist())
        return [
            (self._state, state),
            (self._wrench, WrenchStamped(self.header(time_ns), Wrench(force, moment))),
        ]


class Mass(Estimator):
    """``payload_mass``, ``payload_mass_std`` and, stamped, with the centre of mass, ``payload``."""

    task = "mass"
    about = "what is held, with its standard deviation"
    payload = "payload-filter"

    def _default(self, kind: type[Any]) -> Any:
        return kind(first_moment=True, offset_prior_std=0.02)  # the pipeline's own

    def _open(self) -> None:
        self._mass = self.publish(Float64, "payload_mass")
        self._std = self.publish(Float64, "payload_mass_std")
        self._payload = self.publish(InertiaStamped, "payload")

    def _messages(self, time_ns: int, touch: Touch) -> list[tuple[Publisher, Any]]:
        held = touch.payload
        ok = self._tell(held.status)
        mass, std = (float(held.mass), float(held.mass_std)) if ok else (math.nan, math.nan)
        com = [math.nan] * 3
        if ok and mass > 0.0:
            com = (self.arm.grasp + held.first_moment / mass).tolist()
        inertia = [math.nan] * 6  # not estimated
        stamped = InertiaStamped(
            Header(Time.of(time_ns), self.arm.tip), Inertia(mass, Vector3(*com), *inertia)
        )
        self.fact("mass", mass)
        return [(self._mass, Float64(mass)), (self._std, Float64(std)), (self._payload, stamped)]
