"""What a report on a weighing is made of: the data, checked once, and the few numbers derived from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError

from ._series import Array

_JOINT_SERIES = (
    "q_measured",
    "q_desired",
    "q_estimated",
    "dq_measured",
    "dq_desired",
    "dq_estimated",
    "external_torque",
    "external_torque_std",
    "effort",
)


def _series(value: Any, shape: tuple[int, ...], what: str) -> Array:
    """A read-only float64 copy of the stated shape; it may hold NaN."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be numbers of shape {shape}, got {value!r:.80}") from None
    if array.shape != shape:
        raise InputError(f"{what} must have shape {shape}, got {array.shape}")
    array.setflags(write=False)
    return array


def _number(value: Any, what: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a number, got {value!r:.80}") from None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeighReport:
    """One weighing: N samples of an arm with n joints. For a prismatic joint read m for rad and N for N m.

    Only the title, the time and the mass are needed; what is None is left out of the report. Values that are not
    finite are shown as gaps. Text may come from anywhere: it is escaped.

    Raises:
        InputError: an array has the wrong shape, time is not finite, or a standard deviation is negative.
    """

    title: str
    time_s: npt.ArrayLike
    """(N,) time of each sample [s], finite; the order of the samples is kept"""
    mass: npt.ArrayLike
    """(N,) estimated mass [kg]"""
    mass_std: npt.ArrayLike | None = None
    """(N,) its standard deviation [kg]; NaN where unknown"""
    payload_status: npt.ArrayLike | None = None
    """(N,) palpate.Status values of the mass; None: all ok"""
    arm: str = ""
    """name of the arm"""

    headline_time_s: float | None = None
    """when the number in large type was known [s], e.g. just before the object was put down; None: at the end"""
    headline_mass: float | None = None
    """that number [kg]; None: the estimate at that time"""
    headline_std: float | None = None
    """its standard deviation [kg]; None: as estimated at that time"""
    headline_status: int | None = None
    """its palpate.Status; None: as at that time"""
    time_to_2_percent_s: float | None = None
    """from taking the object until the estimate stays within 2 % of the truth [s]; inf: never; None: unknown"""
    truth_mass: npt.ArrayLike | None = None
    """true mass [kg], a number, or (K,) if truth_time_s is given"""
    truth_time_s: npt.ArrayLike | None = None
    """(K,) times from which each true mass holds, ascending [s]; before the first the truth is unknown"""
    changes: npt.ArrayLike = ()
    """(C,) times at which the estimator found that an object was taken or released [s]"""
    others: Mapping[str, npt.ArrayLike] = field(default_factory=dict)
    """masses of other estimators from the same samples, each (N,) [kg], by name"""

    joint_names: Sequence[str] = ()
    joint_kinds: Sequence[str] | None = None
    """"revolute" or "prismatic" for each joint; None: all revolute"""
    q_measured: npt.ArrayLike | None = None
    """(N, n) encoder positions [rad]"""
    q_desired: npt.ArrayLike | None = None
    """(N, n) [rad]"""
    q_estimated: npt.ArrayLike | None = None
    """(N, n) [rad]"""
    dq_measured: npt.ArrayLike | None = None
    """(N, n) [rad/s]"""
    dq_desired: npt.ArrayLike | None = None
    """(N, n) [rad/s]"""
    dq_estimated: npt.ArrayLike | None = None
    """(N, n) [rad/s]"""
    external_torque: npt.ArrayLike | None = None
    """(N, n) torque of the environment on the joints [N m], > 0 when it pushes the robot"""
    external_torque_std: npt.ArrayLike | None = None
    """(N, n) its standard deviation [N m]"""
    effort: npt.ArrayLike | None = None
    """(N, n) what the drives reported, in effort_unit"""
    effort_unit: str = "N m"

    settings: Mapping[str, object] = field(default_factory=dict)
    """options to list, by name"""
    repair: Sequence[str] = ()
    """what was wrong with the log, line by line"""
    provenance: Sequence[str] = ()
    """where arm and data come from, line by line"""
    picture: bytes | None = None
    """the arm with its load, PNG"""

    def __post_init__(self) -> None:
        put = object.__setattr__
        time = np.array(self.time_s, dtype=np.float64)
        if time.ndim != 1 or not np.all(np.isfinite(time)):
            raise InputError(f"time_s must be finite and of shape (N,), got shape {time.shape}")
        time.setflags(write=False)
        put(self, "time_s", time)
        rows = (len(time),)
        put(self, "mass", _series(self.mass, rows, "mass"))
        std = np.full(rows, np.nan) if self.mass_std is None else self.mass_std
        put(self, "mass_std", _series(std, rows, "mass_std"))
        status = np.array(np.zeros(rows) if self.payload_status is None else self.payload_status)
        if status.shape != rows or (status.size and not np.all((status >= 0) & (status <= 255))):
            raise InputError(f"payload_status must hold {rows[0]} numbers of 0 to 255, got shape {status.shape}")
        status = status.astype(np.uint8)
        status.setflags(write=False)
        put(self, "payload_status", status)

        names = tuple(str(name) for name in self.joint_names)
        put(self, "joint_names", names)
        kinds = ("revolute",) * len(names) if self.joint_kinds is None else tuple(self.joint_kinds)
        if len(kinds) != len(names) or not set(kinds) <= {"revolute", "prismatic"}:
            raise InputError(
                f"joint_kinds must be revolute or prismatic for each of {len(names)} joints, got {kinds!r:.200}"
            )
        put(self, "joint_kinds", kinds)
        for what in _JOINT_SERIES:
            value = getattr(self, what)
            if value is not None:
                put(self, what, _series(value, (*rows, len(names)), what))
        for what in ("mass_std", "external_torque_std"):
            value = getattr(self, what)
            if value is not None and np.any(value < 0.0):
                raise InputError(f"{what} must not be negative")

        if (self.truth_time_s is None) != (self.truth_mass is None or np.ndim(self.truth_mass) == 0):
            raise InputError("truth_mass is one number, or several with as many truth_time_s")
        if self.truth_time_s is None:
            put(self, "truth_time_s", np.array([-math.inf] if self.truth_mass is not None else []))
            put(self, "truth_mass", np.atleast_1d([] if self.truth_mass is None else self.truth_mass))
        else:
            put(self, "truth_time_s", _series(self.truth_time_s, np.shape(self.truth_mass), "truth_time_s"))
        put(self, "truth_mass", _series(self.truth_mass, np.shape(self.truth_time_s), "truth_mass"))
        if np.ndim(self.truth_mass) != 1 or np.any(np.diff(np.asarray(self.truth_time_s)[1:]) < 0.0):
            raise InputError("truth_time_s must be ascending and of shape (K,)")
        put(self, "changes", _series(np.ravel(np.asarray(self.changes)), (np.size(self.changes),), "changes"))
        others = {str(k): _series(v, rows, f"others[{k!r:.80}]") for k, v in self.others.items()}
        put(self, "others", MappingProxyType(others))
        put(self, "settings", MappingProxyType(dict(self.settings)))
        put(self, "repair", tuple(self.repair))
        put(self, "provenance", tuple(self.provenance))

        end = float(time[-1]) if len(time) else math.nan
        at = end if self.headline_time_s is None else _number(self.headline_time_s, "headline_time_s")
        put(self, "headline_time_s", at)
        row = self.row_at(at)
        for what, series in (("headline_mass", "mass"), ("headline_std", "mass_std")):
            value = getattr(self, what)
            if value is None:
                value = math.nan if row is None else getattr(self, series)[row]
            put(self, what, _number(value, what))
        if self.headline_status is None:
            put(self, "headline_status", 1 if row is None else int(status[row]))
        else:
            put(self, "headline_status", int(self.headline_status))
        if self.time_to_2_percent_s is not None:
            put(self, "time_to_2_percent_s", _number(self.time_to_2_percent_s, "time_to_2_percent_s"))

    def __reduce__(self) -> tuple[Any, ...]:
        raw = {f.name: getattr(self, f.name) for f in fields(self)}
        raw.update(others=dict(self.others), settings=dict(self.settings))
        return _restore, (raw,)

    def row_at(self, time_s: float) -> int | None:
        """Index of the last sample at or before a time, of the first if there is none; None without samples."""
        time = np.asarray(self.time_s)
        if not len(time):
            return None
        before = np.flatnonzero(time <= time_s)
        return int(before[-1]) if before.size else 0

    def truth_at(self, time_s: npt.ArrayLike) -> Array:
        """True mass [kg] at times of any shape; NaN where it is unknown."""
        times, masses = np.asarray(self.truth_time_s), np.asarray(self.truth_mass)
        index = np.searchsorted(times, np.asarray(time_s, dtype=np.float64), side="right")
        return np.concatenate(([np.nan], masses))[index]

    @property
    def truth_known(self) -> bool:
        """True if the true mass is known at some sample."""
        return bool(np.any(np.isfinite(self.truth_at(self.time_s))))

    @property
    def settled(self) -> tuple[float, float]:
        """Begin and end of the time the close-up shows [s]: up to the headline, after the last change before it."""
        time = np.asarray(self.time_s)
        end = float(self.headline_time_s)  # type: ignore[arg-type]
        if not len(time):
            return math.nan, math.nan
        start = float(time.min())
        events = np.concatenate((np.asarray(self.changes), np.asarray(self.truth_time_s)[1:], [start]))
        # a change at the very end, such as putting the object down, is not what the estimate settles from
        before = events[(events < end - 0.02 * (end - start)) & (events >= start)]
        last = float(before.max()) if before.size else start
        return max(end - 0.3 * (float(time.max()) - start), last + 0.4 * (end - last)), end
