"""The result of weighing, from a simulated arm or from a log: the number, what it is worth, and the report."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core import Status, __version__
from ..arm import Arm, Array, Effort
from ..errors import ArmError, InputError, suggest
from ..logs import Log
from ..phase import PhaseCurrents
from ..pipeline import ESTIMATORS, OBSERVERS, Pipeline, Touch
from .noise import describe_noise
from .proposal import TwoWayMotion, stiction_std, two_way_motion
from .scenes import Scene, telling_pose, weight_torque
from .trial import Task, Trial, arm_of, arrival

if TYPE_CHECKING:
    from ..report import WeighReport

TWO_PERCENT = 0.02
TWO_SIDED_95 = 1.959963984540054
"""half width of the 95 % interval of a normal distribution [standard deviations]"""
_HOPELESS = 2.0
"""an arm whose pose takes so many times its torque limit does not lift but is dragged along"""
_SLOW = 200.0
"""below it the payload filter's steps from sample to sample are too long for friction and drives [Hz]"""
_TELLING = 1e-3
"""what hides less than this does not matter [kg]"""
_LATE, _LATE_OF_PERIOD = 0.02, 0.5
"""most of the periods of a real arm's loop that may be skipped or irregular [1]; the second where each sample's effort
is the mean since the one before, so that late periods bias nothing as long as the arm is controlled at all"""


@dataclass(frozen=True, slots=True)
class Hold:
    """A time in which the load did not change, as far as the estimator saw."""

    start: float
    """[s]"""
    stop: float
    """[s]"""
    mass: float
    """at its end [kg]"""
    mass_std: float
    """[kg]"""
    status: Status


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighing:
    """What was weighed, sample by sample, and the number at the end."""

    arm: Arm
    pipeline: Mapping[str, Any]
    """options, see :meth:`palpate.Pipeline.options`"""
    log: Log
    touch: Touch
    """one row per sample"""
    status: Status
    """of the number; only ok means: use it"""
    truth: tuple[Array, Array]
    """times [s] from which true masses hold, and these [kg], (K,) each; K = 0: nobody knows"""
    remarks: tuple[str, ...] = ()
    """what a person should know, one sentence or more each"""
    task: Task | None = None
    """None: the samples come from a log"""
    pose: str = ""
    """name of the pose in which it was weighed"""
    desired: tuple[Array, Array] | None = None
    """positions [rad] and velocities [rad/s] that were asked for, (N, n) each"""
    goal_error: float = math.nan
    """largest distance of a joint from the last pose at the end [rad]; NaN: there is none"""
    interrupted: bool = False
    proposal: TwoWayMotion | None = None
    """a motion that would show what stiction hides; None: it hides little"""

    @property
    def time(self) -> Array:
        """(N,) [s] since the first sample."""
        return self.log.seconds

    @property
    def mass(self) -> float:
        """At the end [kg]; NaN without samples."""
        return float(self.touch.payload.mass[-1]) if len(self.log) else math.nan

    @property
    def mass_std(self) -> float:
        """Standard deviation [kg]; NaN without samples."""
        return float(self.touch.payload.mass_std[-1]) if len(self.log) else math.nan

    @property
    def estimator_status(self) -> Status:
        """What the estimator itself says of the mass."""
        return Status(int(self.touch.payload.status[-1])) if len(self.log) else Status.warming

    @property
    def true_mass(self) -> float:
        """At the end [kg]; NaN: nobody knows."""
        return float(self.truth[1][-1]) if len(self.truth[1]) else math.nan

    @property
    def error_percent(self) -> float:
        """(mass - truth) / truth at the end [%]; NaN where there is none, or where nothing is held."""
        return 100.0 * (self.mass - self.true_mass) / self.true_mass if self.true_mass > 0.0 else math.nan

    @property
    def time_to_2_percent(self) -> float:
        """From taking the object until the mass stays within 2 % of the truth [s].

        Infinite: never; NaN: the truth is not known, or is nothing.
        """
        if not self.true_mass > 0.0 or not len(self.log):
            return math.nan
        time, since = self.time, max(float(self.truth[0][-1]), 0.0)
        after = np.flatnonzero(time >= since)
        off = np.abs(self.touch.payload.mass[after] - self.true_mass) > TWO_PERCENT * self.true_mass
        if not off.size or off[-1]:
            return math.inf
        wrong = np.flatnonzero(off)
        first = after[wrong[-1] + 1] if wrong.size else after[0]
        return float(time[first]) - since

    @property
    def change_times(self) -> Array:
        """(C,) when the estimator found that an object was taken or released [s].

        What it took for one before it had ever known a mass was its own start, and is left out.
        """
        payload = self.touch.payload
        rows = np.flatnonzero(np.diff(payload.changes.astype(np.int64), prepend=0) > 0)
        known = np.flatnonzero(payload.status == int(Status.ok))
        if not rows.size or not known.size:
            return np.empty(0)
        times = payload.change_time_ns[rows]
        times = times[times > int(self.log.time_ns[known[0]])]
        return np.array((times - int(self.log.time_ns[0])) * 1e-9, dtype=np.float64)

    @property
    def holds(self) -> tuple[Hold, ...]:
        """What was held between the changes."""
        if not len(self.log):
            return ()
        time, payload = self.time, self.touch.payload
        edges = [float(time[0]), *self.change_times.tolist(), float(time[-1])]
        found = []
        for start, stop in pairwise(edges):
            before = np.flatnonzero(time < stop) if stop < edges[-1] else np.array([len(time) - 1])
            row = int(before[-1]) if before.size else 0
            found.append(
                Hold(
                    start,
                    stop,
                    float(payload.mass[row]),
                    float(payload.mass_std[row]),
                    Status(int(payload.status[row])),
                )
            )
        return tuple(found)

    def method(self) -> str:
        """The pipeline in words, e.g. ``payload-filter beside momentum``."""
        observer, payload = self.pipeline.get("observer"), self.pipeline.get("payload") or {}
        name = str(payload.get("name", "none"))
        if observer is None:
            return name
        return f"{name} {'beside' if name == 'payload-filter' else 'on'} {observer['name']}"

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON; what is not known is None."""
        half = TWO_SIDED_95 * self.mass_std
        payload, observer = self.pipeline.get("payload") or {}, self.pipeline.get("observer") or {}
        return {
            "mass_kg": _plain(self.mass),
            "mass_std_kg": _plain(self.mass_std),
            "mass_95_kg": [_plain(self.mass - half), _plain(self.mass + half)],
            "status": self.status.name,
            "estimator_status": self.estimator_status.name,
            "truth_kg": _plain(self.true_mass),
            "error_percent": _plain(self.error_percent),
            "time_to_2_percent_s": _plain(self.time_to_2_percent),
            "arm": self.arm.name,
            "pose": self.pose or None,
            "goal_error_rad": _plain(self.goal_error),
            "estimator": payload.get("name"),
            "observer": observer.get("name"),
            "seed": None if self.task is None or not self.task.simulated else self.task.seed,
            "duration_s": _plain(self.log.duration),
            "samples": len(self.log),
            "changes_s": [_plain(t) for t in self.change_times],
            "holds": [
                {
                    "start_s": _plain(h.start),
                    "stop_s": _plain(h.stop),
                    "mass_kg": _plain(h.mass),
                    "mass_std_kg": _plain(h.mass_std),
                    "status": h.status.name,
                }
                for h in self.holds
            ],
            "remarks": list(self.remarks),
            "proposal": None if self.proposal is None else self.proposal.summary(),
            "interrupted": self.interrupted,
            "version": __version__,
        }

    def report(self, *, title: str | None = None, picture: bytes | None = None) -> WeighReport:
        """The data of a report; :func:`palpate.report.write_weigh_report` writes it.

        Args:
            title: heading; None: what was done.
            picture: the arm with its load, PNG.
        """
        from ..report import WeighReport

        touch, log = self.touch, self.log
        live = self.task is not None
        simulated = self.task is not None and self.task.simulated
        if title is None:
            title = "Weighing in simulation" if simulated else "Weighing" if live else "Weighing from a log"
        seen = bool(np.any(touch.external.status == int(Status.ok)))
        desired = (None, None) if self.desired is None else self.desired
        settled = self.time_to_2_percent
        truth_time, truth_mass = self.truth
        return WeighReport(
            title=title,
            arm=self.arm.name,
            time_s=self.time,
            mass=touch.payload.mass,
            mass_std=touch.payload.mass_std,
            payload_status=touch.payload.status,
            headline_status=int(self.status),
            time_to_2_percent_s=None if math.isnan(settled) else settled,
            truth_time_s=truth_time if len(truth_time) else None,
            truth_mass=truth_mass if len(truth_mass) else None,
            changes=self.change_times,
            others=_others(self),
            joint_names=self.arm.joint_names,
            joint_kinds=[j.kind for j in self.arm.joints],
            q_measured=log.position,
            q_desired=desired[0],
            q_estimated=touch.q,
            dq_measured=log.velocity,
            dq_desired=desired[1],
            dq_estimated=touch.dq,
            external_torque=touch.external.torque if seen else None,
            external_torque_std=touch.external.std if seen else None,
            effort=log.effort,
            effort_unit="A" if self.arm.effort.kind == "current" else "N m",
            settings=_settings(self),
            repair=() if live else str(log.repair).splitlines(),
            provenance=[*self.remarks, *(f"{k}: {v}" for k, v in self.arm.provenance.items())],
            picture=picture,
        )


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _settings(weighing: Weighing) -> dict[str, object]:
    found: dict[str, object] = {"palpate": __version__, "method": weighing.method()}
    for part in ("payload", "observer", "conditioner"):
        options = weighing.pipeline.get(part)
        for key, value in (options or {}).items():
            if key != "name" and value is not None:
                found[f"{part} {key}"] = value
    task = weighing.task
    if task is not None:
        found |= {
            "pose": weighing.pose,
            "rate [Hz]": task.rate,
            "motion [s]": arrival(task),
        }
        if task.simulated:
            found |= {"seed": task.seed, "encoder noise": "± 2 counts" if task.noise else "none"}
    return found


def _others(weighing: Weighing) -> dict[str, Array]:
    """The published method on the same samples, where its figures are known."""
    if weighing.task is None or not weighing.arm.name.startswith("justina_left_arm") or not len(weighing.log):
        return {}
    published = Pipeline(
        weighing.arm,
        observer=OBSERVERS["sliding-mode"](friction=False),
        payload=ESTIMATORS["joint-formula"](joint=5, lever=0.21, gravity=9.81),
    ).run(weighing.log)
    # As published it has no status: what it tells while it settles is shown too.
    told = np.isin(published.payload.status, [int(Status.ok), int(Status.saturated), int(Status.warming)])
    return {"published: sliding mode, joint formula": np.where(told, published.payload.mass, np.nan)}


def make_pipeline(
    arm: Arm,
    estimator: str | None = None,
    observer: str | None = None,
    *,
    model_torque: bool = False,
    first_moment: bool = False,
) -> tuple[Pipeline, tuple[str, ...]]:
    """The pipeline that weighs, from names.

    Args:
        arm: the arm.
        estimator: one of palpate.pipeline.ESTIMATORS; None: the payload filter, or the regression for an arm without
            masses.
        observer: one of palpate.pipeline.OBSERVERS, or "none"; None: what suits the estimator.
        model_torque: the samples carry the controller's own model torque.
        first_moment: the regression also finds where the load is held; it needs motion of several joints.

    Returns:
        the pipeline, and what was decided that a person should know.

    Raises:
        InputError: an unknown name, or an estimator without the observer it needs.
        ArmError: the arm lacks masses or a declared effort, and nothing else will do.
    """
    _known("estimator", estimator, (*ESTIMATORS,))
    _known("observer", observer, (*OBSERVERS, "none"))
    remarks = []
    if not arm.has_dynamics:
        if estimator is None and observer in (None, "model-residual") and model_torque:
            estimator, observer = "regression", "model-residual"
            remarks.append(
                f"Arm {arm.name!r} has no masses, so the external torque is taken as the controller's own model torque "
                "minus the measured one (observer model-residual), and the load from it by regression."
            )
        elif observer != "model-residual" or estimator == "payload-filter":
            raise ArmError(
                f"arm {arm.name!r} has no masses (kinematics only): "
                + (
                    "weigh with --estimator regression --observer model-residual, for the log has the model torque"
                    if model_torque
                    else "give it some, or a log with the controller's own model torque"
                )
            )
    if observer == "model-residual" and not model_torque:
        raise InputError(
            "observer 'model-residual' needs samples with the controller's own model torque; there is none"
        )
    estimator = estimator or "payload-filter"
    chosen = None
    if observer != "none" and (observer or arm.has_dynamics):
        name = observer or "extended-kalman"
        chosen = OBSERVERS[name](**_observer_options(arm, name))
    if estimator == "payload-filter":
        return Pipeline(arm, observer=chosen), tuple(remarks)
    if chosen is None:
        raise InputError(
            f"estimator {estimator!r} weighs an external torque: choose an observer, one of {', '.join(OBSERVERS)}"
        )
    options = {"first_moment": first_moment} if estimator == "regression" else {}
    return Pipeline(arm, observer=chosen, payload=ESTIMATORS[estimator](**options)), tuple(remarks)


def _observer_options(arm: Arm, name: str) -> dict[str, Any]:
    """What an observer must know of this arm: in 1 s external torque changes by a tenth of what the drives can."""
    effort = float(np.median([j.limits.effort for j in arm.joints]))
    if name == "extended-kalman" and math.isfinite(effort):
        return {"disturbance_rate": 0.1 * effort}
    return {}


def _known(what: str, name: str | None, choices: tuple[str, ...]) -> None:
    if name is not None and name not in choices:
        raise InputError(f"no {what} {name!r}; {suggest(name, choices, 'there are')}")


def weigh_trial(trial: Trial, *, pose: str = "", scene: Scene | None = None) -> Weighing:
    """What a trial weighed."""
    task = trial.task
    scene = scene or task.scene
    arm, log = task.scene.arm, trial.log
    remarks = list(task.scene.assumed)
    status = Status(int(trial.touch.payload.status[-1])) if len(log) else Status.warming
    goal_error = math.nan
    if len(log):
        goal_error, held_back = _arrived(trial)
        if held_back:
            remarks.insert(0, held_back[1])
            if held_back[0] and status == Status.ok:
                status = Status.saturated
    if not task.simulated:
        late = _late(log, trial.touch, task.rate, trial.effort_of_period)
        if late and status == Status.ok:
            status = Status.gap
        remarks[:0] = late
    if trial.interrupted:
        remarks.insert(0, f"Stopped after {log.duration:.2f} of {task.duration:g} s.")
    result = Weighing(
        arm=arm,
        pipeline=trial.pipeline,
        log=log,
        touch=trial.touch,
        status=status,
        truth=_truth(log, task.loads) if task.simulated else (np.empty(0), np.empty(0)),
        task=task,
        pose=pose,
        desired=(trial.desired_q, trial.desired_dq),
        goal_error=goal_error,
        interrupted=trial.interrupted,
    )
    return replace(result, remarks=(*_why(result, scene), *remarks))


def _arrived(trial: Trial) -> tuple[float, tuple[bool, str] | None]:
    """Largest distance of a joint from the goal [rad]; if torque limits hold it back: whether it fails, in words."""
    task, log = trial.task, trial.log
    arm, goal = task.scene.arm, task.poses[-1]
    at = log.signals["true_position"].value if task.simulated else log.position
    error = float(np.max(np.abs(at[-1] - goal)))
    last = log.seconds > log.seconds[-1] - 1.0
    held_back = np.mean(trial.control[last] == int(Status.saturated)) > 0.5
    if log.seconds[-1] < arrival(task) or error < 0.02 or not held_back:
        return error, None
    mass = max(float(trial.touch.payload.mass[-1]), 0.0)
    needed = np.abs(arm.gravity_torque(goal) - mass * (arm.gravity @ arm.jacobian(goal, arm.grasp)[:3]))
    limits = np.array([j.limits.effort for j in arm.joints])
    worst = int(np.argmax(needed / limits))
    share = float(needed[worst] / limits[worst])
    takes = f"it takes {needed[worst]:.3g} N m of {arm.joint_names[worst]}, which has {limits[worst]:g} N m"
    if share > _HOPELESS:
        return error, (
            True,
            f"The arm cannot lift this to the pose: {takes}. The mass is what its motion shows; it is not to be used.",
        )
    why = takes if share > 1.0 else "the safety limiter brakes it"
    return error, (
        False,
        f"The arm stops {error:.2f} rad short of the pose: {why}. The weighing does not depend on it.",
    )


def late_periods(log: Log, touch: Touch, rate: float) -> tuple[int, int]:
    """Skipped or irregular periods of a control loop since the load last changed, and how many there should have been.

    Args:
        log: of the loop.
        touch: one row per sample.
        rate: that was asked for [Hz].

    Returns:
        periods of which the loop skipped some, or that differ by more than a half, as many as they would have been; and
        the time, in periods.
    """
    since = int(touch.payload.change_time_ns[-1]) if len(log) else 0
    time = log.time_ns[log.time_ns >= since]
    periods = np.diff(time) * 1e-9 * rate
    wrong = periods[np.abs(periods - 1.0) > 0.5]
    return int(np.sum(np.maximum(np.rint(wrong) - 1.0, 1.0))), round(float(np.sum(periods)))


def _late(log: Log, touch: Touch, rate: float, effort_of_period: bool) -> list[str]:
    """Why a real arm's loop cannot be weighed by; empty: it can."""
    late, expected = late_periods(log, touch, rate)
    limit = _LATE_OF_PERIOD if effort_of_period else _LATE
    if late <= limit * expected:
        return []
    return [
        f"Of {expected} periods at {rate:g} Hz {late} were skipped or irregular, {late / expected:.0%}; at most "
        f"{limit:.0%} may be, for what moved the arm in them is not known well enough. The number is not to be used: "
        "end what else this computer does, or ask for a lower rate (--rate)."
    ]


def _recorded_late(log: Log, touch: Touch) -> list[str]:
    """The same of a recording; empty also where it is none of a real arm's loop."""
    try:
        plan = json.loads(log.meta.get("task", "null"))
        if not isinstance(plan, dict) or plan["loads_s_kg"] is not None:
            return []
        return _late(log, touch, float(plan["rate_hz"]), bool(plan.get("effort_of_period", False)))
    except (ValueError, KeyError, TypeError):  # of another program: it says nothing about a loop
        return []


def _truth(log: Log, loads: tuple[tuple[float, float], ...] | None = None) -> tuple[Array, Array]:
    """Times [s] from which true masses hold, and these [kg]."""
    if loads is not None:
        if not loads or loads[0][0] > 0.0:
            loads = ((0.0, 0.0), *loads)
        end = log.duration if len(log) else math.inf
        known = [load for load in loads if load[0] <= end]
        return np.array([t for t, _ in known]), np.array([m for _, m in known])
    signal = log.signals.get("true_mass")
    if signal is None or not len(signal) or signal.value.ndim != 1 or not len(log):
        return np.empty(0), np.empty(0)
    rows = np.flatnonzero(np.diff(signal.value, prepend=np.nan) != 0.0)
    seconds = (signal.time_ns[rows] - int(log.time_ns[0])) * np.float64(1e-9)
    if np.any(np.diff(seconds) < 0.0):  # a damaged recording
        return np.empty(0), np.empty(0)
    return np.asarray(seconds), np.asarray(signal.value[rows])


def _why(result: Weighing, scene: Scene | None) -> list[str]:
    """Why there is no good number, and what would give one."""
    status, arm = result.estimator_status, result.arm
    if status == Status.ok or not len(result.log):
        return []
    if status == Status.saturated:
        return [
            "The external torque is more than the observer can follow: its gain is too small for this arm. "
            "The payload filter (--estimator payload-filter) has no such bound."
        ]
    if status not in (Status.warming, Status.singular):
        return []
    finite = np.isfinite(result.log.position).all(axis=1) & (np.abs(result.log.position) < 1e3).all(axis=1)
    if not finite.any():
        return []
    rows = result.log.position[finite]
    seen = float(np.max([np.max(weight_torque(arm, q)) for q in rows[:: max(len(rows) // 50, 1)]]))
    mass = scene.mass if scene is not None else 1.0
    named = {k: float(np.max(weight_torque(arm, q))) for k, q in (scene.poses if scene else {}).items()}
    best = max(named, key=lambda k: named[k], default="")
    if named:
        name, most = best, named[best]
        # the usual one, where it is good enough
        if scene is not None and named[scene.pose] > 0.3 * most:
            name, most = scene.pose, named[scene.pose]
    else:
        q = telling_pose(arm, mass)
        name, most = ",".join(f"{x:g}" for x in q), float(np.max(weight_torque(arm, q)))
    if seen < 0.3 * most:
        return [
            f"The pose hides the weight: a kilogram puts at most {seen:.2g} N m on a joint here, and {most:.2g} N m in "
            f"pose {name}. Weigh there" + (f": --pose {name}." if result.task is not None else ".")
        ]
    half = TWO_SIDED_95 * result.mass_std
    return [
        f"Friction, noise or too short a time leave ± {half:.2g} kg (95 %): weigh longer, or move the arm while it "
        "weighs."
    ]


def weigh_log(
    log: Log,
    arm: Arm | None = None,
    *,
    estimator: str | None = None,
    observer: str | None = None,
) -> Weighing:
    """What an arm holds, from its log.

    Args:
        log: positions and effort; opened with ``keep_invalid=True`` bad rows get a status instead of going missing.
        arm: None: the one in a recording of palpate.
        estimator, observer: see :func:`make_pipeline`.

    Raises:
        LogError: no arm is given and none is in the log.
        InputError: log and arm do not fit, or an unknown name.
        ArmError: the arm lacks masses or a declared effort.
    """
    remarks: list[str] = []
    if arm is None:
        arm = arm_of(log)
        remarks.append("The arm is the one the log was recorded with.")
    arm, log, note = fit_log(log, arm)
    remarks += note
    slow = arm.has_dynamics and 0.0 < log.rate < _SLOW
    if slow:
        if estimator == "payload-filter":
            raise InputError(
                f"the payload filter needs at least {_SLOW:g} samples per second, the log has {log.rate:.3g}: "
                "take --estimator regression"
            )
        estimator = estimator or "regression"
        if estimator == "regression" and observer is None:
            observer = "momentum"
            remarks.append(
                f"At {log.rate:.3g} Hz, below {_SLOW:g} Hz, the load is weighed by regression on a momentum observer."
            )
    pipeline, decided = make_pipeline(
        arm, estimator, observer, model_torque=log.model_torque is not None, first_moment=slow
    )
    remarks += decided
    touch = pipeline.run(log)
    status = Status(int(touch.payload.status[-1])) if len(log) else Status.warming
    late = _recorded_late(log, touch)
    if late and status == Status.ok:
        status = Status.gap
    remarks[:0] = late
    result = Weighing(
        arm=arm,
        pipeline=pipeline.options(),
        log=log,
        touch=touch,
        status=status,
        truth=_truth(log),
        desired=_setpoints(log),
    )
    remarks += refused(touch)
    motion = _two_way(result)
    said = () if motion is None else (motion.words(),)
    return replace(result, remarks=(*_why(result, None), *said, *remarks), proposal=motion)


def refused(touch: Touch) -> list[str]:
    """How many samples of a run were not used, and why; empty if all were."""
    bad = int(np.count_nonzero(np.isin(touch.status, [int(Status.non_finite), int(Status.time_error)])))
    if not bad:
        return []
    return [
        f"{bad} of {len(touch.status)} samples were not used: NaN, absurd numbers or times that do not rise."
    ]


def fit_log(log: Log, arm: Arm) -> tuple[Arm, Log, list[str]]:
    """Arm and log made for each other: the arm's joints in its order, noise described; and what was assumed for that.

    Raises:
        InputError: they do not fit: joints, or torque where the arm says current.
    """
    log, remarks = fit_joints(log, arm)
    if arm.effort.kind == "phase_currents":
        log, arm = PhaseCurrents.of(arm).convert(log), arm.replace(effort=Effort.torque())
        remarks.append("Motor torque from two phase currents per joint.")
    unit = log.meta.get("effort_unit", "")
    if (
        (unit == "A") != (arm.effort.kind == "current")
        and unit in ("A", "N m")
        and arm.effort.kind != "undeclared"
    ):
        raise InputError(
            f"the log's effort is in {unit}, but arm {arm.name!r} declares {arm.effort.kind}: "
            "one of them is wrong (effort of the card, or effort_unit of the columns)"
        )
    if arm.effort.kind != "undeclared":
        arm, said = describe_noise(arm, log)
        remarks += [said] if said else []
    return arm, log, remarks


def _two_way(result: Weighing) -> TwoWayMotion | None:
    """The motion to propose where the mass is hardly better known than stiction at rest allows.

    However much worse it is known: at rest all that the joints feel below stiction may be a load, a push or nothing,
    so that doubts which widen the interval by any factor end only in motion, too. Where stiction hides nothing that
    matters there is nothing to propose.
    """
    finite = np.isfinite(result.log.position).all(axis=1) & (np.abs(result.log.position) < 1e3).all(axis=1)
    if not finite.any():
        return None
    q = result.log.position[finite][-1]
    stiction = stiction_std(result.arm, q)
    matters = max(TWO_PERCENT * abs(result.mass), _TELLING)
    if not (stiction < math.inf and matters < stiction < 2.0 * result.mass_std):
        return None
    return two_way_motion(result.arm, q)


def _setpoints(log: Log) -> tuple[Array, Array] | None:
    """Recorded setpoints, if there is one per sample."""
    q, dq = log.signals.get("setpoint_position"), log.signals.get("setpoint_velocity")
    shape = log.position.shape
    if q is None or dq is None or q.value.shape != shape or dq.value.shape != shape:
        return None
    return q.value, dq.value


def fit_joints(log: Log, arm: Arm) -> tuple[Log, list[str]]:
    """The log with the arm's joints in the arm's order, and what was assumed for that.

    Raises:
        InputError: they do not fit.
    """
    if log.joint_names == arm.joint_names:
        return log, []
    if set(arm.joint_names) <= set(log.joint_names):
        return log.select(arm.joint_names), []
    if log.n != arm.n:
        raise InputError(
            f"the log has {log.n} joints ({', '.join(log.joint_names)}), arm {arm.name!r} has {arm.n} "
            f"({', '.join(arm.joint_names)}); their names do not match either"
        )
    return log, [
        f"The log's joints are named otherwise ({', '.join(log.joint_names)}): taken in this order for the arm's "
        f"({', '.join(arm.joint_names)})."
    ]
