"""What pushes an arm, and where: the contacts of a log with time, link, torque and force, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ._core import (
    ContactDetector,
    DisturbanceKalman,
    HeldLoad,
    ModelResidualObserver,
    Status,
    WrenchEstimator,
    __version__,
)
from .arm import Arm, Array
from .errors import ArmError, InputError
from .logs import Log
from .pipeline import ContactEvent, Pipeline, Touch, contact_noise
from .weigh import arm_of, fit_log, refused

if TYPE_CHECKING:
    from .report import FeelReport

FALSE_ALARMS_PER_HOUR = 1e-3
"""of the whole arm, unless another rate is asked for [1/h]"""


@dataclass(frozen=True, slots=True)
class Push:
    """One contact of a log, told from the sample in which it shows best."""

    event: ContactEvent
    start: float
    """of the contact, [s] since the first sample"""
    alarm: float
    """when it was declared [s]"""
    stop: float
    """of the contact [s]; NaN: it lasts until the log ends"""
    time: float
    """of the sample in which it shows best [s]"""
    link: str
    """the link touched: the one moved by the last joint that feels it"""
    farthest: str
    """the farthest link on which one force would explain what all joints feel"""
    force: Array
    """(3,) as if it acted at the grasp point, base axes [N]; > 0 pushes the arm along the axis"""
    force_std: Array
    """(3,) standard deviation [N]"""
    singular: Any
    """(3,) bool: the pose tells (almost) nothing about this direction"""

    @property
    def tip(self) -> bool:
        """A force at the grasp point would explain it."""
        return self.event.tip

    @property
    def direction(self) -> Array:
        """(3,) unit vector of the force, base axes; NaN where an axis is not seen or the force is within its noise."""
        size = float(np.linalg.norm(self.force))
        if self.singular.any() or size <= 2.0 * float(np.max(self.force_std)):
            return np.full(3, math.nan)
        return np.asarray(self.force / size)


@dataclass(frozen=True, slots=True, kw_only=True)
class Feeling:
    """What was felt, sample by sample, and the contacts in it."""

    arm: Arm
    pipeline: dict[str, Any]
    """options, see :meth:`palpate.Pipeline.options`"""
    log: Log
    touch: Touch
    """one row per sample; wrench and contact are there"""
    pushes: tuple[Push, ...]
    false_alarms_per_hour: float
    """of the whole arm, while the model's errors are as described in `noise` [1/h]"""
    noise: str
    """where the errors come from that the rate rests on, one sentence"""
    remarks: tuple[str, ...] = ()
    """what a person should know, one sentence or more each"""

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON; what is not known is None."""
        names = self.arm.joint_names
        return {
            "contacts": [
                {
                    "onset_s": _plain(p.start),
                    "onset_time_ns": p.event.onset_time_ns,
                    "alarm_s": _plain(p.alarm),
                    "release_s": _plain(p.stop),
                    "link": p.link,
                    "farthest_link": p.farthest,
                    "tip": p.tip,
                    "clearest_s": _plain(p.time),
                    "torque_Nm": dict(zip(names, map(_plain, p.event.torque), strict=True)),
                    "torque_std_Nm": dict(zip(names, map(_plain, p.event.std), strict=True)),
                    "force_N": [_plain(x) for x in p.force],
                    "force_std_N": [_plain(x) for x in p.force_std],
                    "singular": [bool(x) for x in p.singular],
                    "direction": None if np.isnan(p.direction).any() else [_plain(x) for x in p.direction],
                }
                for p in self.pushes
            ],
            "force_frame": "base axes, as if at the grasp point",
            "false_alarms_per_hour": self.false_alarms_per_hour,
            "noise": self.noise,
            "arm": self.arm.name,
            "observer": self.pipeline["observer"]["name"],
            "duration_s": _plain(self.log.duration),
            "samples": len(self.log),
            "remarks": list(self.remarks),
            "version": __version__,
        }

    def report(self, *, title: str | None = None) -> FeelReport:
        """The data of a report; :func:`palpate.report.write_feel_report` writes it."""
        from .report import FeelReport

        touch, log = self.touch, self.log
        assert touch.wrench is not None and touch.contact is not None
        return FeelReport(
            title=title or "What pushed the arm",
            arm=self.arm.name,
            time_s=log.seconds,
            joint_names=self.arm.joint_names,
            joint_kinds=[j.kind for j in self.arm.joints],
            external_torque=touch.external.torque,
            external_torque_std=touch.external.std,
            level=touch.contact.level,
            force=touch.wrench.force,
            force_std=touch.wrench.force_std,
            moment=touch.wrench.moment,
            moment_std=touch.wrench.moment_std,
            singular=touch.wrench.singular,
            wrench_status=touch.wrench.status,
            pushes=[push_words(p, self.arm) for p in self.pushes],
            spans=[(p.start, p.stop if p.stop == p.stop else log.duration) for p in self.pushes],
            rate=rate_words(self),
            settings=_settings(self),
            repair=str(log.repair).splitlines(),
            provenance=[*self.remarks, *(f"{k}: {v}" for k, v in self.arm.provenance.items())],
        )


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _settings(feeling: Feeling) -> dict[str, object]:
    found: dict[str, object] = {"palpate": __version__}
    for part in ("observer", "wrench", "contact", "load", "conditioner"):
        for key, value in (feeling.pipeline.get(part) or {}).items():
            if value is not None and value != []:
                found[part if key == "name" else f"{part} {key}"] = value
    return found


def rate_words(feeling: Feeling) -> str:
    """The stated rate of false alarms, and what it rests on."""
    rate = feeling.false_alarms_per_hour
    often = f"one in {1.0 / rate:,.0f} h" if rate < 1.0 else f"{rate:g} per hour"
    return f"{often}, {feeling.noise}"


def push_words(push: Push, arm: Arm) -> dict[str, str]:
    """A contact in words: time, link, force, torque."""
    late = 1e3 * (push.alarm - push.start)
    until = "the end" if math.isnan(push.stop) else f"{push.stop:.3f}\N{NO-BREAK SPACE}s"
    where = push.link if push.link == push.farthest else f"{push.link} (or beyond, up to {push.farthest})"
    parts = []
    for axis, value, std, unseen in zip("xyz", push.force, push.force_std, push.singular, strict=True):
        parts.append(f"{axis} not seen" if unseen else f"{axis} {value:+.0f} ± {1.96 * std:.0f}")
    felt = np.flatnonzero(np.abs(push.event.torque) > 3.0 * push.event.std)
    torques = [
        f"{arm.joint_names[j]} {push.event.torque[j]:+.2g} ± {1.96 * push.event.std[j]:.2g}" for j in felt
    ]
    return {
        "from": f"{push.start:.3f}\N{NO-BREAK SPACE}s",
        "to": until,
        "declared after": f"{late:.0f}\N{NO-BREAK SPACE}ms",
        "link": where + (", the tip would explain it" if push.tip else ""),
        "force": ", ".join(parts) + " N",
        "torque": (", ".join(torques) + " N m") if torques else "within three standard deviations",
    }


def feel_log(
    log: Log,
    arm: Arm | None = None,
    *,
    free: Sequence[Log] = (),
    false_alarms_per_hour: float = FALSE_ALARMS_PER_HOUR,
    mass: float = 0.0,
) -> Feeling:
    """What pushed an arm, from its log.

    Args:
        log: positions and effort; opened with ``keep_invalid=True`` bad rows get a status instead of going missing.
        arm: None: the one in a recording of palpate.
        free: logs of the same arm that move every joint with nothing touched: they tell what the model gets wrong, and
            the rate of false alarms holds where that holds. Without them the card's friction and noise are believed.
        false_alarms_per_hour: of the whole arm [1/h].
        mass: held at the grasp point, known: its weight and inertia are no push [kg].

    Raises:
        LogError: no arm is given and none is in the log.
        InputError: log and arm do not fit, the log is empty, or a number is out of range.
        ArmError: the arm lacks masses (and the log the controller's model torque) or a declared effort.
    """
    if not (math.isfinite(false_alarms_per_hour) and false_alarms_per_hour > 0.0):
        raise InputError(f"false alarms per hour: expected a number > 0, got {false_alarms_per_hour:g}")
    if not (math.isfinite(mass) and mass >= 0.0):
        raise InputError(f"held mass: expected a number >= 0 [kg], got {mass:g}")
    if not len(log):
        raise InputError("the log has no samples: nothing can be felt")
    remarks: list[str] = []
    if arm is None:
        arm = arm_of(log)
        remarks.append("The arm is the one the log was recorded with.")
    arm, log, note = fit_log(log, arm)
    remarks += note
    options: dict[str, Any] = {"false_alarms_per_hour": false_alarms_per_hour}
    if not arm.has_dynamics:
        if log.model_torque is None:
            raise ArmError(
                f"arm {arm.name!r} has no masses (kinematics only): give it some (palpate identify), or a log with the "
                "controller's own model torque"
            )
        if free:
            raise InputError(
                f"arm {arm.name!r} has no masses: free logs cannot tell what a model gets wrong that there is not"
            )
        remarks.append(f"Arm {arm.name!r} has no masses: the controller's own model torque stands for them.")
        options["source"] = "model_residual"
    if free:
        rest = [fit_log(record, arm)[1] for record in free]
        noise = contact_noise(arm, rest)
        arm, detector = noise.arm(arm), noise.detector(**options)
        seconds = sum(record.duration for record in rest)
        said = f"while the model errs as in {seconds:.0f} s of free motion"
    else:
        rest, detector = [], ContactDetector(**options)
        said = "if friction and noise are as the arm's description says"
    observer = DisturbanceKalman() if arm.has_dynamics else ModelResidualObserver(cutoff=30.0)
    pipeline = Pipeline(
        arm,
        observer=observer,
        payload=None,
        wrench=WrenchEstimator(),
        contact=detector,
        load=HeldLoad(mass=mass),
    )
    for record in rest:
        pipeline.reset()
        found = pipeline.run(record).contact
        assert found is not None
        if found.count[-1]:
            count = int(found.count[-1])
            said_of = "a contact was" if count == 1 else f"{count} contacts were"
            remarks.append(
                f"In {record.duration:.0f} s of free motion {said_of} found where there is none: the model's errors "
                "are at times larger than their measure, and so they may be here."
            )
    pipeline.reset()
    touch = pipeline.run(log)
    remarks += refused(touch)
    assert touch.contact is not None
    judged = float(np.mean(touch.contact.status == int(Status.ok)))
    if judged < 0.9:
        remarks.append(
            f"Contacts were looked for in {100.0 * judged:.0f} % of the samples only: after a start or a gap "
            f"{detector.warm_up:g} s pass first."
        )
    return Feeling(
        arm=arm,
        pipeline=pipeline.options(),
        log=log,
        touch=touch,
        pushes=tuple(_push(event, touch, log, arm) for event in touch.contact.events()),
        false_alarms_per_hour=false_alarms_per_hour,
        noise=said,
        remarks=tuple(remarks),
    )


def _push(event: ContactEvent, touch: Touch, log: Log, arm: Arm) -> Push:
    wrench, begin = touch.wrench, int(log.time_ns[0])
    assert wrench is not None
    row = event.clearest

    def seconds(time_ns: int | None) -> float:
        return math.nan if time_ns is None else (time_ns - begin) * 1e-9

    return Push(
        event=event,
        start=seconds(event.onset_time_ns),
        alarm=seconds(event.alarm_time_ns),
        stop=seconds(event.release_time_ns),
        time=float(log.seconds[row]),
        link=arm.joints[event.link].link,
        farthest=arm.joints[event.farthest].link,
        force=np.array(wrench.force[row]),
        force_std=np.array(wrench.force_std[row]),
        singular=np.array(wrench.singular[row, :3]),
    )
