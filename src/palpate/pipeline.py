"""The pipeline: samples in, what the arm holds and what pushes it out; computed by the C++ core, nothing here."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from ._core import (
    Conditioner,
    ContactDetector,
    DisturbanceKalman,
    ExtendedKalman,
    HeldLoad,
    InverseDynamicsObserver,
    JointFormula,
    ModelResidualObserver,
    MomentumObserver,
    MomentumSuperTwisting,
    PayloadFilter,
    Regression,
    SlidingModeObserver,
    Status,
    WrenchEstimator,
)
from ._core import Load as CoreLoad
from ._core import Pipeline as CorePipeline
from ._core import Touch as CoreTouch
from ._core import tare as core_tare
from .arm import Arm, Array, Effort
from .errors import ArmError, InputError, suggest
from .logs import Log, Sample
from .phase import PhaseCurrents

Observer: TypeAlias = (
    InverseDynamicsObserver
    | ModelResidualObserver
    | SlidingModeObserver
    | MomentumObserver
    | MomentumSuperTwisting
    | DisturbanceKalman
    | ExtendedKalman
)
PayloadEstimator: TypeAlias = JointFormula | Regression | PayloadFilter

OBSERVERS: Mapping[str, type[Any]] = {
    "inverse-dynamics": InverseDynamicsObserver,
    "model-residual": ModelResidualObserver,
    "sliding-mode": SlidingModeObserver,
    "momentum": MomentumObserver,
    "super-twisting": MomentumSuperTwisting,
    "disturbance-kalman": DisturbanceKalman,
    "extended-kalman": ExtendedKalman,
}
ESTIMATORS: Mapping[str, type[Any]] = {
    "joint-formula": JointFormula,
    "regression": Regression,
    "payload-filter": PayloadFilter,
}


@dataclass(frozen=True, slots=True)
class ExternalTorque:
    """Torque the environment exerts on the joints; of one sample, or one row per sample."""

    torque: Array
    """(n,) or (N, n) [N m], > 0 when the environment pushes the joint forward"""
    std: Array
    """(n,) or (N, n) standard deviation [N m]"""
    status: Any
    """Status, or (N,) uint8 of Status values"""


@dataclass(frozen=True, slots=True)
class Payload:
    """What the arm holds; of one sample, or one row per sample. Frame: the arm's tip; point: its grasp point."""

    mass: Any
    """float or (N,) [kg]"""
    mass_std: Any
    """float or (N,) standard deviation [kg]"""
    first_moment: Array
    """(3,) or (N, 3) m (c - grasp) [kg m], tip axes; zero where only the mass is estimated"""
    changes: Any
    """int or (N,): grasps and releases detected since the start"""
    change_time_ns: Any
    """int or (N,): estimated time of the newest one [ns]"""
    status: Any
    """Status, or (N,) uint8 of Status values"""


@dataclass(frozen=True, slots=True)
class Wrench:
    """Force and moment the environment exerts on the hand, beyond the held load; of one sample, or one row per sample.

    Axes and point are those of the :class:`WrenchEstimator`. Signs: > 0 pushes the arm along the axis.
    """

    force: Array
    """(3,) or (N, 3) [N]"""
    force_std: Array
    """(3,) or (N, 3) standard deviation [N]"""
    moment: Array
    """(3,) or (N, 3) about the point [N m]; zero where only a force is estimated"""
    moment_std: Array
    """(3,) or (N, 3) standard deviation [N m]"""
    covariance: Array
    """(6, 6) or (N, 6, 6) force before moment [N^2, N^2 m, N^2 m^2]"""
    singular: npt.NDArray[np.bool_]
    """(6,) or (N, 6): the pose tells (almost) nothing about this component"""
    conditioning: Any
    """float or (N,): best over worst known direction, >= 1; inf: one is not seen"""
    load_mass: Any
    """float or (N,): of the load whose weight and inertia were taken away [kg]"""
    status: Any
    """Status, or (N,) uint8; singular: some component is"""


@dataclass(frozen=True, slots=True)
class Contact:
    """Whether something touches the arm, and where; of one sample, or one row per sample."""

    active: Any
    """bool or (N,)"""
    link: Any
    """int or (N,): the link touched, counted from 0: the one moved by the last joint that feels it; -1: none"""
    farthest: Any
    """int or (N,): the farthest link on which one force would explain what all joints feel; >= link"""
    tip: Any
    """bool or (N,): a force at the grasp point would explain what all joints feel"""
    torque: Array
    """(n,) or (N, n) of the contact at each joint [N m]"""
    std: Array
    """(n,) or (N, n) standard deviation [N m]"""
    level: Array
    """(n,) or (N, n) test statistic over its threshold; 1: alarm"""
    count: Any
    """int or (N,): contacts since the start"""
    onset_time_ns: Any
    """int or (N,): estimated start of the newest one [ns]"""
    alarm_time_ns: Any
    """int or (N,): when it was declared [ns]"""
    release_time_ns: Any
    """int or (N,): estimated end of the newest one that ended [ns]"""
    status: Any
    """Status, or (N,) uint8"""

    def events(self) -> list[ContactEvent]:
        """The contacts of a run, in order of time. For rows, not for one sample."""
        active = np.asarray(self.active)
        found = []
        for number in np.unique(self.count[active]):
            rows = np.flatnonzero(active & (self.count == number))
            last = rows[-1]
            ended = last + 1 < len(active)
            clearest = rows[np.abs(self.torque[rows] / self.std[rows]).max(axis=1).argmax()]
            found.append(
                ContactEvent(
                    onset_time_ns=int(self.onset_time_ns[last]),
                    alarm_time_ns=int(self.alarm_time_ns[last]),
                    release_time_ns=int(self.release_time_ns[last + 1]) if ended else None,
                    link=int(self.link[last]),
                    farthest=int(self.farthest[clearest]),
                    tip=bool(self.tip[clearest]),
                    clearest=int(clearest),
                    torque=np.array(self.torque[clearest]),
                    std=np.array(self.std[clearest]),
                )
            )
        return found


@dataclass(frozen=True, slots=True)
class ContactEvent:
    """One contact, from its onset to its release."""

    onset_time_ns: int
    """estimated start [ns]"""
    alarm_time_ns: int
    """when it was declared [ns]"""
    release_time_ns: int | None
    """estimated end [ns]; None: it lasted until the end of the run"""
    link: int
    """the link touched, counted from 0: the one moved by the last joint that feels it"""
    farthest: int
    """the farthest link on which one force would explain what all joints feel"""
    tip: bool
    """a force at the grasp point would explain it"""
    clearest: int
    """row of the run in which it shows best, in standard deviations"""
    torque: Array
    """(n,) [N m] in that row"""
    std: Array
    """(n,) its standard deviation [N m]"""


@dataclass(frozen=True, slots=True)
class Touch:
    """Everything known after a sample; of one sample, or one row per sample.

    Only status ``ok`` means: use the number.
    """

    time_ns: Any
    """int or (N,) int64 [ns]"""
    q: Array
    """(n,) or (N, n) estimated position [rad]"""
    dq: Array
    """(n,) or (N, n) estimated velocity [rad/s]"""
    status: Any
    """of the sample itself: Status, or (N,) uint8"""
    external: ExternalTorque
    payload: Payload
    wrench: Wrench | None = None
    """None: not asked for"""
    contact: Contact | None = None
    """None: not asked for"""


class Pipeline:
    """One path from samples to :class:`Touch`: conditioner, observer, payload estimator, wrench and contact.

    Live, simulated, replayed and batch data go through the same C++ code; the same samples give the same bits.

    Args:
        arm: the arm; what its driver's effort means must be declared (``arm.effort``).
        observer: turns samples into external torque; None: not wanted.
        payload: weighs; None: not wanted. The default needs no observer. JointFormula and Regression do.
        conditioner: velocity from the driver or differentiated, longest gap.
        wrench: turns the external torque into force and moment at the hand; needs an observer. None: not wanted.
        contact: detects contacts, with its own residual. None: not wanted.
        load: what is held and known, taken away before wrench and contact; by default what `payload` finds.

    Raises:
        ArmError: the effort is not declared, or masses are missing where they are needed.
        InputError: an option is out of range, or an estimator lacks its observer.
    """

    def __init__(
        self,
        arm: Arm,
        *,
        observer: Observer | None = None,
        payload: PayloadEstimator | None = PayloadFilter(first_moment=True, offset_prior_std=0.02),  # noqa: B008
        conditioner: Conditioner | None = None,
        wrench: WrenchEstimator | None = None,
        contact: ContactDetector | None = None,
        load: HeldLoad | None = None,
    ) -> None:
        if arm.effort.kind == "undeclared":
            raise ArmError(
                f"arm {arm.name!r} does not say what its driver's effort is; "
                "arm.replace(effort=Effort.torque()) if it is link-side N m, Effort.current(k_t, gear) if it is A"
            )
        self.arm = arm
        self.observer = observer
        self.payload = payload
        self.conditioner = conditioner or Conditioner()
        self.wrench = wrench
        self.contact = contact
        self.load_config = load or HeldLoad()
        for name in ("noise_std", "model_std") if contact is not None else ():
            given = len(getattr(contact, name))
            if given > arm.n:
                raise InputError(
                    f"ContactDetector {name}: {given} numbers, arm {arm.name!r} has {arm.n} joints"
                )
        self._phases = PhaseCurrents.of(arm) if arm.effort.kind == "phase_currents" else None
        model = arm if self._phases is None else arm.replace(effort=Effort.torque())
        try:
            self._core = CorePipeline(
                model.core, observer, payload, self.conditioner, self.load_config, wrench, contact
            )
        except ValueError as e:
            raise InputError(str(e)) from None

    def step(self, sample: Sample) -> Touch:
        """Take one sample; its effort holds two readings per joint (n, 2) where the arm declares phase currents.

        Raises:
            InputError: a vector has the wrong length. Bad numbers are no error: the status says so.
        """
        try:
            effort = sample.effort if self._phases is None else self._phases.step(sample)
            t = self._core.step(sample.time_ns, sample.position, sample.velocity, effort, sample.model_torque)
        except (ValueError, TypeError) as e:
            raise InputError(f"sample: {str(e).splitlines()[0]}") from None
        return self.touch_of(t)

    def touch_of(self, t: CoreTouch) -> Touch:
        """What the core found for one sample with a pipeline of these options."""
        return Touch(
            t.time_ns,
            cast(Array, t.q),
            cast(Array, t.dq),
            t.status,
            ExternalTorque(
                cast(Array, t.external_torque), cast(Array, t.external_torque_std), t.external_status
            ),
            Payload(
                t.mass,
                t.mass_std,
                np.array(t.first_moment),
                t.changes,
                t.change_time_ns,
                t.payload_status,
            ),
            None if self.wrench is None else Wrench(**t.wrench),
            None if self.contact is None else Contact(**t.contact),
        )

    def run(self, log: Log) -> Touch:
        """Take all samples of a log, from the state the pipeline is in (:meth:`reset` for a fresh start).

        Returns:
            Touch with one row per sample.

        Raises:
            InputError: the log has another number of joints, or no effort.
        """
        if log.n != self.arm.n:
            raise InputError(
                f"the log has {log.n} joints ({', '.join(log.joint_names)}), arm {self.arm.name!r} has "
                f"{self.arm.n} ({', '.join(self.arm.joint_names)}); log.select([...]) picks joints by name"
            )
        if self._phases is not None:
            log = self._phases.convert(log)
        if not log.has_effort:
            raise InputError("the log has no effort (torque or current): there is nothing to weigh by")
        r = self._core.run(log.time_ns, log.position, log.velocity, log.effort, log.model_torque)
        return Touch(
            np.array(log.time_ns),
            r["q"],
            r["dq"],
            r["status"],
            ExternalTorque(r["torque"], r["torque_std"], r["external_status"]),
            Payload(
                r["mass"],
                r["mass_std"],
                r["first_moment"],
                r["changes"],
                r["change_time_ns"],
                r["payload_status"],
            ),
            None if self.wrench is None else Wrench(**r["wrench"]),
            None if self.contact is None else Contact(**r["contact"]),
        )

    @property
    def core(self) -> CorePipeline:
        """The C++ pipeline."""
        return self._core

    @property
    def load(self) -> CoreLoad:
        """What is held, as a body for :class:`palpate.Controller`; zero unless the payload filter says ``ok``."""
        return self._core.load()

    def reset(self) -> None:
        """Back to the state before the first sample."""
        self._core.reset()
        if self._phases is not None:
            self._phases.reset()

    def options(self) -> dict[str, Any]:
        """What :meth:`from_options` needs to build the same pipeline: plain values, fit for JSON."""
        return {
            "observer": _describe(self.observer, OBSERVERS),
            "payload": _describe(self.payload, ESTIMATORS),
            "conditioner": self.conditioner.options(),
            "wrench": _plain(self.wrench),
            "contact": _plain(self.contact),
            "load": _plain(self.load_config),
        }

    @classmethod
    def from_options(cls, arm: Arm, options: Mapping[str, Any]) -> Pipeline:
        """The pipeline that :meth:`options` described.

        Raises:
            InputError: a name or an option is not known.
        """
        try:
            return cls(
                arm,
                observer=_build(options.get("observer"), OBSERVERS, "observer"),
                payload=_build(options.get("payload"), ESTIMATORS, "estimator"),
                conditioner=Conditioner(**options.get("conditioner", {})),
                wrench=_made(WrenchEstimator, options.get("wrench")),
                contact=_made(ContactDetector, options.get("contact")),
                load=_made(HeldLoad, options.get("load")),
            )
        except (TypeError, ValueError) as e:
            raise InputError(f"pipeline options: {str(e).splitlines()[0]}") from None


def _describe(config: Any, kinds: Mapping[str, type[Any]]) -> dict[str, Any] | None:
    if config is None:
        return None
    name = next(name for name, kind in kinds.items() if isinstance(config, kind))
    return {"name": name, **(_plain(config) or {})}


def _plain(config: Any) -> dict[str, Any] | None:
    """A configuration's options, fit for JSON, where nan cannot be written."""
    if config is None:
        return None
    values = config.options().items()
    return {
        k: None if isinstance(v, float) and math.isnan(v) else list(v) if isinstance(v, tuple) else v
        for k, v in values
    }


def _made(kind: type[Any], options: Mapping[str, Any] | None) -> Any:
    if options is None:
        return None
    return kind(**{k: math.nan if v is None else v for k, v in options.items()})


def _build(options: Mapping[str, Any] | None, kinds: Mapping[str, type[Any]], what: str) -> Any:
    if options is None:
        return None
    values = dict(options)
    name = values.pop("name", "")
    if name not in kinds:
        raise InputError(f"no {what} {name!r}; {suggest(str(name), kinds, 'there are')}")
    return _made(kinds[name], values)


@dataclass(frozen=True, slots=True)
class Tare:
    """What a motion with nothing in the hand says about the links' masses."""

    arm: Arm
    """the arm with corrected masses"""
    factors: Array
    """(n,) true mass over the model's [1]"""
    std: Array
    """(n,) standard deviation of the factors [1]; near `mass_std` where the motion shows nothing"""


def tare(arm: Arm, log: Log, *, mass_std: float = 0.2) -> Tare:
    """Correct the masses of an arm's links from a log of free motion without load.

    Each link's mass and inertia get one common factor; the centre of mass is kept. Twenty seconds that move every
    joint through gravity are enough for a small arm.

    Args:
        arm: the arm as modelled.
        log: free motion, nothing held.
        mass_std: how wrong each link's mass may be, relative [1].

    Raises:
        ArmError: the arm has no masses.
        InputError: the log does not fit the arm, or too few of its samples can be used.
    """
    if log.n != arm.n:
        raise InputError(f"the log has {log.n} joints, arm {arm.name!r} has {arm.n}")
    try:
        factors, std, used = core_tare(
            arm.core, mass_std, log.time_ns, log.position, log.velocity, log.effort
        )
    except ValueError as e:
        raise InputError(str(e)) from None
    if used < 100:
        raise InputError(
            f"tare: only {used} of {len(log)} samples can be used; a tare needs some seconds of motion"
        )
    joints = tuple(
        joint.replace(mass=joint.mass * s, inertia=joint.inertia * s)
        for joint, s in zip(arm.joints, factors, strict=True)
    )
    note = {**arm.provenance, "tare": "link masses corrected by " + ", ".join(f"{s:.4f}" for s in factors)}
    return Tare(arm.replace(joints=joints, provenance=note), factors, std)


def status_names(codes: npt.ArrayLike) -> list[str]:
    """Names of Status values."""
    return [Status(int(c)).name for c in np.atleast_1d(np.asarray(codes))]


@dataclass(frozen=True, slots=True)
class ContactNoise:
    """What a model gets wrong while nothing touches the arm; the false-alarm rate holds where this holds."""

    torque_std: Array
    """(n,) white error of the torque, per sample [N m]"""
    velocity_std: Array | None
    """(n,) white error of the measured velocity [rad/s]; None: velocity is not measured"""
    model_std: Array
    """(n,) slow error of the model in motion [N m]"""
    model_time: float
    """how long such an error lasts [s]"""

    def arm(self, arm: Arm) -> Arm:
        """`arm` with these errors in its sensing; of velocity at least 1e-4 rad/s, so that none counts as exact."""
        joints = []
        for j, joint in enumerate(arm.joints):
            velocity = None if self.velocity_std is None else max(float(self.velocity_std[j]), 1e-4)
            sensing = replace(
                joint.sensing,
                torque_std=float(self.torque_std[j]),
                velocity_std=velocity,
                torque_resolution=0.0,
            )
            joints.append(joint.replace(sensing=sensing))
        return arm.replace(joints=tuple(joints))

    def detector(self, **options: Any) -> ContactDetector:
        """A detector for :meth:`arm`; friction in motion is part of `model_std`. Options are ContactDetector's."""
        own = {
            "model_std": self.model_std.tolist(),
            "model_time": self.model_time,
            "friction_fraction": 0.0,
        }
        return ContactDetector(**{**own, **options})


def contact_noise(arm: Arm, logs: Iterable[Log]) -> ContactNoise:
    """Measure a model's errors in logs of free motion, for contact detection with a rate one can state.

    The one-step torque residual of the momentum is split by its autocovariance C(lag), over samples where the joint
    moves: a slow error s^2 exp(-lag/T), fitted from the second lag on; noise of the velocity, which enters as a
    difference and makes C(1) smaller by its variance; white torque noise, the rest of C(0). Residuals beyond five
    median deviations count as five.

    Args:
        arm: with the dynamics and friction to be used later.
        logs: free motion of every joint in both directions, nothing held, nothing touched.

    Raises:
        InputError: a log does not fit the arm, or a joint moves for fewer than 500 samples.
    """
    lags = 64
    product, count = np.zeros((arm.n, lags)), np.zeros((arm.n, lags))
    inertia, period, poses = np.zeros((arm.n, arm.n)), [], 0
    measured = True
    still = [3.0 * j.friction.sign_velocity for j in arm.joints]
    for log in logs:
        raw = Pipeline(arm, observer=MomentumObserver(bandwidth=1e6), payload=None).run(log)
        measured = measured and log.velocity is not None
        good = raw.external.status == int(Status.ok.value)
        residual, speed = raw.external.torque, np.abs(raw.dq)
        for j in range(arm.n):
            use = good & (speed[:, j] > still[j])
            if np.count_nonzero(use) < 2:
                continue
            x = residual[:, j] - np.median(residual[use, j])
            limit = 5.0 * 1.4826 * np.median(np.abs(x[use]))
            x = np.clip(residual[:, j], *(np.median(residual[use, j]) + np.array([-limit, limit])))
            for lag in range(lags):
                both = use[lag:] & use[: len(use) - lag]
                product[j, lag] += (x[lag:] * x[: len(x) - lag])[both].sum()
                count[j, lag] += np.count_nonzero(both)
        period.append(np.diff(log.time_ns) * 1e-9)
        sampled = arm.mass_matrix(np.ascontiguousarray(log.position[:: max(1, len(log) // 100)]))
        inertia += np.square(sampled).sum(axis=0)
        poses += len(sampled)
    seldom = [arm.joints[j].name for j in range(arm.n) if count[j, 0] < 500]
    if seldom:
        raise InputError(
            f"contact noise: {', '.join(seldom)} moves for fewer than 500 samples; add a log where it moves"
        )
    h = float(np.median(np.concatenate(period)))
    covariance = product / np.maximum(count, 1.0)
    lag_time = np.arange(2, lags) * h
    times = np.geomspace(5.0 * h, 50.0 * lags * h, 40)
    slow, time = np.zeros(arm.n), np.zeros(arm.n)
    for j in range(arm.n):
        shapes = np.exp(-lag_time / times[:, None])
        scale = np.maximum(shapes @ covariance[j, 2:] / np.square(shapes).sum(axis=1), 0.0)
        best = int(np.square(covariance[j, 2:] - scale[:, None] * shapes).sum(axis=1).argmin())
        slow[j], time[j] = scale[best], times[best]
    model_time = float(np.median(time))
    difference = np.maximum(slow * np.exp(-h / time) - covariance[:, 1], 0.0) if measured else np.zeros(arm.n)
    white = np.maximum(covariance[:, 0] - slow - 2.0 * difference, 1e-4 * covariance[:, 0])
    velocity = np.sqrt(_non_negative(inertia / poses / h**2, difference)) if measured else None
    return ContactNoise(np.sqrt(white), velocity, np.sqrt(slow), model_time)


def _non_negative(A: Array, b: Array) -> Array:
    """x >= 0 (n,) that minimises |A x - b|, for A (n, n) and b (n,) without negative entries; by coordinates."""
    x = np.zeros(A.shape[1])
    for _ in range(2000):
        for k in range(len(x)):
            column = A[:, k]
            x[k] = max(0.0, x[k] + column @ (b - A @ x) / (column @ column))
    return x
