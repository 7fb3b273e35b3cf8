"""What a live page shows, as plain values: no browser, no thread, no clock in here."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from .._core import Status
from ..arm import Arm, Array, smallest_turn
from ..logs import Sample
from ..pipeline import Touch, Wrench
from ..report._text import TWO_SIDED_95, mass_unit, rounded, status_text

MOVING = 0.02
"""an arm with a joint faster than this moves [rad/s]"""
INSIDE_95 = 2.4477
"""half axes of the ellipse that holds 95 % of a normal distribution in a plane [standard deviations]"""
_FELT = 16.3
"""a force is shown where its square, measured by its covariance, exceeds this: by chance once in 1000 samples"""
_KEPT = 7.8
"""... and until it falls below this, the 95 % point"""
_WIDEST = math.radians(50.0)
"""a cone is drawn no wider than this; beyond, the direction counts as unknown"""
_TONES = {
    Status.ok: "green",
    Status.warming: "grey",
    Status.held: "sky",
    Status.gap: "pink",
    Status.non_finite: "red",
    Status.saturated: "orange",
    Status.singular: "yellow",
    Status.time_error: "red",
}
_SHORT = {
    Status.ok: "good",
    Status.warming: "warming up",
    Status.held: "on hold",
    Status.gap: "samples missing",
    Status.non_finite: "bad input",
    Status.saturated: "saturated",
    Status.singular: "blind pose",
    Status.time_error: "clock error",
}


def _no_poses() -> Mapping[str, Array]:
    return MappingProxyType({})


@dataclass(frozen=True, slots=True)
class ShownArm:
    """An arm on a page."""

    name: str
    """different for every arm of a page"""
    arm: Arm
    poses: Mapping[str, Array] = field(default_factory=_no_poses)
    """(n,) [rad] by name, to be offered"""
    usual_mass: float = 1.0
    """what it holds on a usual day [kg]: the length of its arrows and the range of its sliders follow from it"""
    T_world_base: Array | None = None
    """(4, 4) [m]; None: in the origin, turned so that gravity points down"""

    @property
    def placement(self) -> Array:
        """T_world_base (4, 4) [m]."""
        if self.T_world_base is not None:
            return np.asarray(self.T_world_base, dtype=np.float64)
        T, size = np.eye(4), float(np.linalg.norm(self.arm.gravity))
        if size > 0.0:
            T[:3, :3] = smallest_turn(-self.arm.gravity / size).T
        return T

    @property
    def metres_per_newton(self) -> float:
        """Length of arrows: the weight of the usual mass is a quarter of the arm's reach."""
        return 0.25 * self.arm.reach / (9.81 * self.usual_mass)


@dataclass(frozen=True, slots=True)
class Reading:
    """An arm at one moment."""

    time: float
    """[s] since the start"""
    sample: Sample
    touch: Touch
    torque: Array
    """(n,) link-side motor torque as measured [N m]"""
    goal: Array | None = None
    """(n,) where the joints should be [rad]; None: nobody moves them"""
    held_back: bool = False
    """a torque limit holds the arm back"""
    powered: bool = True
    """False: the drives are off, and somebody else holds the arm: nothing can be weighed"""
    true_mass: float = math.nan
    """[kg]; NaN: nobody knows"""

    @property
    def moving(self) -> bool:
        """Some joint moves."""
        return bool(np.max(np.abs(self.touch.dq)) > MOVING)


@dataclass(frozen=True, slots=True)
class Badge:
    """A state in words."""

    text: str
    tone: str
    """green: use it; sky, yellow, orange, pink, red: do not; grey: not yet"""
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Weight:
    """A mass as it is shown."""

    value: str
    half: str
    """half width of its 95 % interval; "?" where none is known"""
    unit: str
    badge: Badge
    tared: str = ""
    """what counts as nothing; empty: it is not tared"""

    @property
    def text(self) -> str:
        """In one line."""
        return f"{self.value} ± {self.half} {self.unit}"


class Scale:
    """Masses of one arm as they are shown; what is held at :meth:`tare` counts as nothing from then on."""

    def __init__(self) -> None:
        self._zero: tuple[float, float] | None = None

    @property
    def tared(self) -> bool:
        """Something counts as nothing."""
        return self._zero is not None

    def tare(self, reading: Reading | None) -> str:
        """Let what is held now count as nothing.

        Returns:
            why it was not done; empty: it was.
        """
        if reading is None:
            return "There is no sample yet."
        payload = reading.touch.payload
        if mass_badge(reading).tone != "green":
            return f"Only a good mass can be tared; this one is {mass_badge(reading).text}."
        self._zero = (float(payload.mass), float(payload.mass_std))
        return ""

    def clear(self) -> None:
        """Show whole masses again."""
        self._zero = None

    def weight(self, reading: Reading, *, pushed: bool = False) -> Weight:
        """What to show.

        Args:
            reading: of the arm.
            pushed: a force is felt beside the load, so the mass may hold a part of it.
        """
        payload = reading.touch.payload
        mass, std = float(payload.mass), float(payload.mass_std)
        tared = ""
        if self._zero is not None:
            # the errors of both have much in common; as if they had none the interval is too wide, not too narrow
            mass, std = mass - self._zero[0], math.hypot(std, self._zero[1])
            factor, unit = mass_unit([self._zero[0]])
            tared = f"{rounded(self._zero[0] * factor, TWO_SIDED_95 * self._zero[1] * factor)[0]} {unit}"
        if not reading.powered:
            mass = math.nan
        factor, unit = mass_unit([mass])
        value, half = rounded(mass * factor, TWO_SIDED_95 * std * factor)
        badge = mass_badge(reading, pushed=pushed)
        if badge.tone != "green" and not TWO_SIDED_95 * std < abs(mass):
            value = "–"
        return Weight(value, half, unit, badge, tared)


def mass_badge(reading: Reading, *, pushed: bool = False) -> Badge:
    """What a mass is worth, in words; see :meth:`Scale.weight`."""
    if not reading.powered:
        return Badge("drives off", "grey", "somebody else holds the arm: there is nothing to weigh by")
    status = Status(int(reading.touch.payload.status))
    detail, text, tone = status_text(int(status)).meaning, _SHORT[status], _TONES[status]
    if status == Status.ok and (pushed or lit_links(reading)[0] >= 0):
        text, tone = "pushed", "orange"
        detail = "something else pushes the arm, and the mass may hold a part of that"
    if reading.moving:
        text = "moving: last good value" if status == Status.held else f"{text}, moving"
    if reading.held_back:
        detail = f"a torque limit holds the arm back; {detail}"
        text = f"{text}, held back"
    return Badge(text, tone, detail)


@dataclass(frozen=True, slots=True)
class Force:
    """A push as it is drawn: an arrow and the cone in which it points with 95 % probability."""

    tail: Array
    """(3,) of the arrow, world [m]"""
    tip: Array
    """(3,) [m]"""
    R: Array
    """(3, 3) axes of the cone: those of its ellipse, then the arrow's direction"""
    half_axes: tuple[float, float]
    """of the ellipse at the arrow's tip [m]"""
    text: str


class ForceView:
    """Decides when a force is shown, with hysteresis, and how. One per arm."""

    def __init__(self) -> None:
        self._shown = False

    def force(self, shown: ShownArm, reading: Reading) -> Force | None:
        """The force to be drawn; None: none is felt beyond its uncertainty."""
        wrench = reading.touch.wrench
        if wrench is None or not reading.powered or not _usable(wrench):
            self._shown = False
            return None
        F, C = np.asarray(wrench.force), np.asarray(wrench.covariance)[:3, :3]
        try:
            felt = float(F @ np.linalg.solve(C, F))
        except np.linalg.LinAlgError:
            felt = 0.0
        self._shown = felt > (_KEPT if self._shown else _FELT)
        return drawn_force(shown, reading, F, C) if self._shown else None


def _usable(wrench: Wrench) -> bool:
    """Some component is known: a pose blind for one of them does not hide the others."""
    known = Status(int(wrench.status)) in (Status.ok, Status.singular)
    return known and bool(np.isfinite(wrench.force).all() and np.isfinite(wrench.covariance).all())


def drawn_force(shown: ShownArm, reading: Reading, F: Array, C: Array) -> Force:
    """An arrow for a force F (3,) [N] with covariance C (3, 3) [N^2], base axes, at the grasp point."""
    T = shown.placement
    size = float(np.linalg.norm(F))
    e = F / size
    E = smallest_turn(e)[:, :2]
    variance, turn = np.linalg.eigh(E.T @ C @ E)
    across = E @ turn
    R = np.column_stack((across[:, 0], across[:, 1], e))
    if np.linalg.det(R) < 0.0:
        R[:, 0] *= -1.0
    spread = INSIDE_95 * np.sqrt(np.maximum(variance, 0.0))
    length = min(size * shown.metres_per_newton, 0.9 * shown.arm.reach)
    half = np.minimum(spread / size, math.tan(_WIDEST)) * length
    value, plus = rounded(size, TWO_SIDED_95 * math.sqrt(max(float(e @ C @ e), 0.0)))
    angle = math.atan2(float(spread[1]), size)
    sure = "direction uncertain" if angle > _WIDEST else f"direction ± {max(1, round(math.degrees(angle)))}°"
    tail = T @ np.append(_grasp(shown.arm, reading.touch.q), 1.0)
    return Force(
        tail=tail[:3],
        tip=tail[:3] + length * (T[:3, :3] @ e),
        R=T[:3, :3] @ R,
        half_axes=(float(half[0]), float(half[1])),
        text=f"{value} ± {plus} N, {sure}",
    )


def _grasp(arm: Arm, q: Array) -> Array:
    point: Array = (arm.forward_kinematics(q) @ np.append(arm.grasp, 1.0))[:3]
    return point


def lit_links(reading: Reading) -> tuple[int, int]:
    """First and last link that something touches, counted from 0; (-1, -1): none."""
    contact = reading.touch.contact
    if contact is None or not contact.active or not reading.powered:
        return -1, -1
    return int(contact.link), int(contact.farthest)


def contact_badge(shown: ShownArm, reading: Reading) -> Badge:
    """Whether and where something touches the arm, in words."""
    if reading.touch.contact is None:
        return Badge("not looked for", "grey")
    first, last = lit_links(reading)
    if first < 0:
        status = Status(int(reading.touch.contact.status))
        if status == Status.ok and reading.powered:
            return Badge("free", "green", "nothing touches the arm")
        return Badge("not judged", "grey", status_text(int(status)).meaning)
    names = [shown.arm.joints[i].link for i in (first, last)]
    where = names[0] if first == last else f"{names[0]} … {names[1]}"
    return Badge(f"contact: {where}", "orange", "one force on this link would explain what the joints feel")


def link_frames(arm: Arm, q: npt.ArrayLike) -> Array:
    """T_base_link (n + 1, 4, 4) of the base and of every link for q (n,) [rad]."""
    frames = np.empty((arm.n + 1, 4, 4))
    frames[0] = np.eye(4)
    for i, (joint, angle) in enumerate(zip(arm.joints, np.asarray(q, dtype=np.float64), strict=True)):
        motion = np.eye(4)
        if joint.kind == "revolute":
            x, y, z = joint.axis
            K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            motion[:3, :3] += math.sin(angle) * K + (1.0 - math.cos(angle)) * (K @ K)
        else:
            motion[:3, 3] = angle * joint.axis
        frames[i + 1] = frames[i] @ joint.T_parent_joint @ motion
    return frames


@dataclass(frozen=True, slots=True)
class Channels:
    """Where in a row of a history what stands, for an arm of n joints."""

    n: int

    @property
    def count(self) -> int:
        """Numbers per row."""
        return 4 * self.n + 5

    def row(self, reading: Reading) -> Array:
        """(count,) position, velocity, torque, external torque, then mass, its 95 % bounds, good mass, truth."""
        touch = reading.touch
        payload = touch.payload
        row = np.full(self.count, np.nan)
        n = self.n
        row[:n], row[n : 2 * n], row[2 * n : 3 * n] = touch.q, touch.dq, reading.torque
        if int(touch.external.status) in (int(Status.ok), int(Status.saturated)):
            row[3 * n : 4 * n] = touch.external.torque
        if reading.powered:
            mass, half = float(payload.mass), TWO_SIDED_95 * float(payload.mass_std)
            row[4 * n :] = mass, mass - half, mass + half, math.nan, reading.true_mass
            if int(payload.status) == int(Status.ok) and mass_badge(reading).tone == "green":
                row[4 * n + 3] = mass
        return row

    def joints(self, values: Array, what: int) -> Array:
        """(K, n) of (K, count): 0 position, 1 velocity, 2 torque, 3 external torque."""
        return values[:, what * self.n : (what + 1) * self.n]

    def mass(self, values: Array) -> Array:
        """(K, 5) mass, lower and upper bound, good mass, true mass [kg]."""
        return values[:, 4 * self.n :]


def mass_range(mass: Array, low: Array, high: Array, good: Array, true: Array) -> tuple[float, float]:
    """Least and largest mass [kg] to draw: good and true ones with room around; what is unsure runs out of the picture.

    Args:
        mass, low, high, good, true: (K,) each, see :meth:`Channels.mass`; NaN is nothing.
    """
    sure = np.concatenate((good, true))
    sure = sure[np.isfinite(sure)]
    if not len(sure):
        sure = mass[np.isfinite(mass)]
        if not len(sure):
            return 0.0, 1.0
        sure = np.percentile(sure, (10.0, 90.0))
    bottom, top = float(sure.min()), float(sure.max())
    widths = (high - low)[np.isfinite(good)]
    room = float(np.median(widths)) if len(widths) else 0.0
    room = max(room, 0.25 * (top - bottom), 1e-3 * abs(top), 1e-4)
    return bottom - room, top + room
