"""The pipeline: samples in, what the arm holds and what pushes it out; computed by the C++ core, nothing here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from ._core import (
    Conditioner,
    ExtendedKalman,
    InverseDynamicsObserver,
    JointFormula,
    ModelResidualObserver,
    MomentumObserver,
    MomentumSuperTwisting,
    PayloadFilter,
    Regression,
    SlidingModeObserver,
    Status,
)
from .arm import Arm, Array
from .errors import ArmError, InputError, suggest
from .logs import Log, Sample

Observer = (
    InverseDynamicsObserver
    | ModelResidualObserver
    | SlidingModeObserver
    | MomentumObserver
    | MomentumSuperTwisting
    | ExtendedKalman
)
PayloadEstimator = JointFormula | Regression | PayloadFilter

OBSERVERS: Mapping[str, type[Any]] = {
    "inverse-dynamics": InverseDynamicsObserver,
    "model-residual": ModelResidualObserver,
    "sliding-mode": SlidingModeObserver,
    "momentum": MomentumObserver,
    "super-twisting": MomentumSuperTwisting,
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


class Pipeline:
    """One path from samples to :class:`Touch`: conditioner, observer, payload estimator.

    Live, simulated, replayed and batch data go through the same C++ code; the same samples give the same bits.

    Args:
        arm: the arm; what its driver's effort means must be declared (``arm.effort``).
        observer: turns samples into external torque; None: not wanted.
        payload: weighs; None: not wanted. The default needs no observer. JointFormula and Regression do.
        conditioner: velocity from the driver or differentiated, longest gap.

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
        try:
            self._core = _core.Pipeline(arm.core, observer, payload, self.conditioner)
        except ValueError as e:
            raise InputError(str(e)) from None

    def step(self, sample: Sample) -> Touch:
        """Take one sample.

        Raises:
            InputError: a vector has the wrong length. Bad numbers are no error: the status says so.
        """
        try:
            t = self._core.step(
                sample.time_ns, sample.position, sample.velocity, sample.effort, sample.model_torque
            )
        except (ValueError, TypeError) as e:
            raise InputError(f"sample: {str(e).splitlines()[0]}") from None
        return Touch(
            t.time_ns,
            t.q,
            t.dq,
            t.status,
            ExternalTorque(t.external_torque, t.external_torque_std, t.external_status),
            Payload(
                t.mass,
                t.mass_std,
                np.array(t.first_moment),
                t.changes,
                t.change_time_ns,
                t.payload_status,
            ),
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
        )

    @property
    def load(self) -> _core.Load:
        """What is held, as a body for :class:`palpate.Controller`; zero unless the payload filter says ``ok``."""
        return self._core.load()

    def reset(self) -> None:
        """Back to the state before the first sample."""
        self._core.reset()

    def options(self) -> dict[str, Any]:
        """What :meth:`from_options` needs to build the same pipeline: plain values, fit for JSON."""
        return {
            "observer": _describe(self.observer, OBSERVERS),
            "payload": _describe(self.payload, ESTIMATORS),
            "conditioner": self.conditioner.options(),
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
            )
        except (TypeError, ValueError) as e:
            raise InputError(f"pipeline options: {str(e).splitlines()[0]}") from None


def _describe(config: Any, kinds: Mapping[str, type[Any]]) -> dict[str, Any] | None:
    if config is None:
        return None
    name = next(name for name, kind in kinds.items() if isinstance(config, kind))
    values = config.options()
    return {
        "name": name,
        **{k: None if isinstance(v, float) and math.isnan(v) else v for k, v in values.items()},
    }


def _build(options: Mapping[str, Any] | None, kinds: Mapping[str, type[Any]], what: str) -> Any:
    if options is None:
        return None
    values = dict(options)
    name = values.pop("name", "")
    if name not in kinds:
        raise InputError(f"no {what} {name!r}; {suggest(str(name), kinds, 'there are')}")
    return kinds[name](**{k: math.nan if v is None else v for k, v in values.items()})


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
        factors, std, used = _core.tare(
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
