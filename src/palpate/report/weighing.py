"""What a report on a weighing is made of: the data, checked once, and the few numbers derived from them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError

from ._series import Array, finite

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


def _series(value: Any, shape: tuple[int, ...] | None, what: str, *, low: float | None = None) -> Array:
    """A read-only float64 copy of the stated shape (None: any), NaN for what is no number, nothing below `low`."""
    try:
        array = finite(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be numbers, got {value!r:.80}") from None
    if shape is not None and array.shape != shape:
        raise InputError(f"{what} must have shape {shape}, got {array.shape}")
    if low is not None and np.any(array < low):
        raise InputError(f"{what} must be >= {low:g}, got {float(np.nanmin(array)):g}")
    array.setflags(write=False)
    return array


def _number(value: Any, what: str) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{what} must be a number, got {value!r:.80}") from None


class Headline(NamedTuple):
    """The number in large type."""

    time_s: float
    """when it was known [s]"""
    mass: float
    """[kg]"""
    std: float
    """standard deviation [kg]; NaN where unknown"""
    status: int
    """palpate.Status value"""
    truth: float
    """true mass at that time [kg]; NaN where unknown"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeighReport:
    """One weighing: N samples of an arm with n joints. For a prismatic joint read m for rad and N for N m.

    Only the title, the time and the mass are needed; what is None is left out of the report. Values that are not
    finite are shown as gaps. Arrays are copied, made float64 and read-only; anything numpy understands may be given.
    Text may come from anywhere: it is escaped.

    Raises:
        InputError: an array has the wrong shape, time is not finite, a standard deviation is negative, or the times
            of the truth do not ascend.
    """

    title: str
    time_s: Array
    """(N,) time of each sample [s], finite; the order of the samples is kept"""
    mass: Array
    """(N,) estimated mass [kg]"""
    mass_std: Array | None = None
    """(N,) its standard deviation [kg]; NaN where unknown"""
    payload_status: npt.NDArray[np.uint8] | None = None
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
    truth_mass: Array | float | None = None
    """true mass [kg]: one number, or (K,) if truth_time_s is given"""
    truth_time_s: Array | None = None
    """(K,) times from which each true mass holds, ascending [s]; before the first the truth is unknown"""
    changes: Array | Sequence[float] = ()
    """(C,) times at which the estimator found that an object was taken or released [s]"""
    others: Mapping[str, Array] = field(default_factory=dict)
    """masses of other estimators from the same samples, each (N,) [kg], by name"""

    joint_names: Sequence[str] = ()
    joint_kinds: Sequence[str] | None = None
    """"revolute" or "prismatic" for each joint; None: all revolute"""
    q_measured: Array | None = None
    """(N, n) encoder positions [rad]"""
    q_desired: Array | None = None
    """(N, n) [rad]"""
    q_estimated: Array | None = None
    """(N, n) [rad]"""
    dq_measured: Array | None = None
    """(N, n) [rad/s]"""
    dq_desired: Array | None = None
    """(N, n) [rad/s]"""
    dq_estimated: Array | None = None
    """(N, n) [rad/s]"""
    external_torque: Array | None = None
    """(N, n) torque of the environment on the joints [N m], > 0 when it pushes the robot"""
    external_torque_std: Array | None = None
    """(N, n) its standard deviation [N m]"""
    effort: Array | None = None
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
        time = _series(self.time_s, None, "time_s")
        if time.ndim != 1 or not np.all(np.isfinite(time)):
            raise InputError(f"time_s must be finite and of shape (N,), got shape {time.shape}")
        put(self, "time_s", time)
        rows = time.shape
        put(self, "mass", _series(self.mass, rows, "mass"))
        if self.mass_std is not None:
            put(self, "mass_std", _series(self.mass_std, rows, "mass_std", low=0.0))
        if self.payload_status is not None:
            status = _series(self.payload_status, rows, "payload_status")
            if not np.all((status >= 0.0) & (status <= 255.0)):
                raise InputError("payload_status must hold numbers of 0 to 255")
            values = status.astype(np.uint8)
            values.setflags(write=False)
            put(self, "payload_status", values)

        names = tuple(str(name) for name in self.joint_names)
        put(self, "joint_names", names)
        if self.joint_kinds is not None:
            kinds = tuple(self.joint_kinds)
            if len(kinds) != len(names) or not set(kinds) <= {"revolute", "prismatic"}:
                raise InputError(
                    f"joint_kinds must be revolute or prismatic for each of {len(names)} joints, got {kinds!r:.200}"
                )
            put(self, "joint_kinds", kinds)
        for what in _JOINT_SERIES:
            value = getattr(self, what)
            if value is not None:
                low = 0.0 if what.endswith("_std") else None
                put(self, what, _series(value, (*rows, len(names)), what, low=low))

        if self.truth_time_s is not None:
            times = _series(self.truth_time_s, None, "truth_time_s")
            if times.ndim != 1 or np.any(np.diff(times) < 0.0) or np.any(np.isnan(times)):
                raise InputError(f"truth_time_s must ascend and have shape (K,), got shape {times.shape}")
            put(self, "truth_time_s", times)
            put(self, "truth_mass", _series(self.truth_mass, times.shape, "truth_mass"))
        elif self.truth_mass is not None:
            put(self, "truth_mass", _number(self.truth_mass, "truth_mass (without truth_time_s)"))
        changes = _series(self.changes, None, "changes").ravel()
        put(self, "changes", changes)
        others = {str(k): _series(v, rows, f"others[{k!r:.80}]") for k, v in self.others.items()}
        put(self, "others", MappingProxyType(others))
        put(self, "settings", MappingProxyType(dict(self.settings)))
        put(self, "repair", tuple(self.repair))
        put(self, "provenance", tuple(self.provenance))
        for what in ("headline_time_s", "headline_mass", "headline_std", "time_to_2_percent_s"):
            value = getattr(self, what)
            if value is not None:
                put(self, what, _number(value, what))
        if self.headline_status is not None:
            put(self, "headline_status", int(self.headline_status))

    def __reduce__(self) -> tuple[Any, ...]:
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        for name, value in given.items():
            if isinstance(value, MappingProxyType):  # cannot be pickled
                given[name] = dict(value)
        return partial(type(self), **given), ()

    @property
    def status(self) -> npt.NDArray[np.uint8]:
        """(N,) status of every sample."""
        return np.zeros(self.time_s.shape, np.uint8) if self.payload_status is None else self.payload_status

    @property
    def std(self) -> Array:
        """(N,) standard deviation of the mass [kg]; NaN where unknown."""
        return np.full(self.time_s.shape, np.nan) if self.mass_std is None else self.mass_std

    @property
    def truth(self) -> tuple[Array, Array]:
        """Times [s] from which true masses hold, and these [kg]; (K,) each, K = 0 if nothing is known."""
        if self.truth_mass is None:
            return np.empty(0), np.empty(0)
        if self.truth_time_s is None:
            return np.array([-math.inf]), np.array([self.truth_mass])
        return self.truth_time_s, np.asarray(self.truth_mass)

    def truth_at(self, time_s: npt.ArrayLike) -> Array:
        """True mass [kg] at times of any shape; NaN where it is unknown."""
        times, masses = self.truth
        index = np.searchsorted(times, np.asarray(time_s, dtype=np.float64), side="right")
        return np.concatenate(([np.nan], masses))[index]

    @property
    def truth_known(self) -> bool:
        """True if the true mass is known at some sample."""
        return bool(np.isfinite(self.truth_at(self.time_s)).any())

    def row_at(self, time_s: float) -> int | None:
        """Index of the last sample at or before a time, of the first if there is none; None without samples."""
        if not len(self.time_s):
            return None
        before = np.flatnonzero(self.time_s <= time_s)
        return int(before[-1]) if before.size else 0

    @property
    def headline(self) -> Headline:
        """The number in large type; without samples NaN with status warming, unless it was given."""
        time = self.headline_time_s
        if time is None:
            time = float(self.time_s[-1]) if len(self.time_s) else math.nan
        row = self.row_at(time)
        empty = (math.nan, math.nan, 1)
        mass, std, status = empty if row is None else (self.mass[row], self.std[row], self.status[row])
        return Headline(
            time,
            float(mass if self.headline_mass is None else self.headline_mass),
            # a mass from elsewhere does not have the estimate's uncertainty
            float(
                (std if self.headline_mass is None else math.nan)
                if self.headline_std is None
                else self.headline_std
            ),
            int(status if self.headline_status is None else self.headline_status),
            float(self.truth_at(time)) if math.isfinite(time) else math.nan,
        )

    @property
    def settled(self) -> tuple[float, float]:
        """Begin and end of the time the close-up shows [s]: up to the headline, after the last change before it."""
        if not len(self.time_s):
            return math.nan, math.nan
        end = self.headline.time_s
        start = float(self.time_s.min())
        events = np.concatenate((self.changes, self.truth[0], [start]))
        # a change at the very end, such as putting the object down, is not what the estimate settles from
        before = events[(events < end - 0.02 * (end - start)) & (events >= start)]
        last = float(before.max()) if before.size else start
        return max(end - 0.3 * float(np.ptp(self.time_s)), last + 0.4 * (end - last)), end
