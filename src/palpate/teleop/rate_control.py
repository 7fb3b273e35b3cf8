"""Rate control: sticks, caps and keys give a velocity, which is integrated to the place of a master.

The two sides see a master like any other: workspace, clutch and the passivity layer are those of every device.
"""

from __future__ import annotations

import math
import os
import re
import select
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import NamedTuple, Protocol, Self

import numpy as np

from .._core import turned
from ..arm import Array
from ..errors import DriverError, InputError

AXES = 6
"""of a source: forward, left, up, and the turns about these, right-handed"""
KEYS: dict[str, tuple[int, float]] = {
    "w": (0, 1.0),
    "s": (0, -1.0),
    "a": (1, 1.0),
    "d": (1, -1.0),
    "q": (2, 1.0),
    "e": (2, -1.0),
    "u": (3, -1.0),
    "o": (3, 1.0),
    "i": (4, 1.0),
    "k": (4, -1.0),
    "j": (5, 1.0),
    "l": (5, -1.0),
}
"""key to (axis, sign)"""
ARROWS = {"A": "w", "B": "s", "C": "d", "D": "a"}
"""last letter of what a terminal sends for an arrow, to the key it is the same as"""
_SEQUENCE = re.compile(r"\x1b(?:[\[O][0-9;]*([A-Za-z~])?)?|[^\x1b]")
"""a key, or an escape sequence, maybe not all of it yet"""


@dataclass(frozen=True, slots=True)
class Curve:
    """From deflection to part of the largest speed: nothing within the dead zone, fine near it::

        r = (|u| - dead) / (1 - dead),   f(u) = sign(u) ((1 - expo) r + expo r^3)

    odd, never falling, 0 at rest, 1 at the end.

    Raises:
        InputError: a number is out of range.
    """

    dead: float = 0.1
    """deflection that counts as none, of 1"""
    expo: float = 0.6
    """0 straight, 1 cubic"""

    def __post_init__(self) -> None:
        if not (0.0 <= self.dead < 1.0 and 0.0 <= self.expo <= 1.0):
            raise InputError(
                f"expected a dead zone of 0 to below 1 and an expo of 0 to 1, got {self.dead!r} and {self.expo!r}"
            )

    def __call__(self, u: Array) -> Array:
        """Deflections (n,) of -1 to 1 to parts of the largest speed (n,); what is not a number is at rest."""
        u = np.where(np.isfinite(u), u, 0.0)
        r = np.clip((np.abs(u) - self.dead) / (1.0 - self.dead), 0.0, 1.0)
        found: Array = np.sign(u) * ((1.0 - self.expo) * r + self.expo * r**3)
        return found


class Reading(NamedTuple):
    """What a source says now."""

    deflection: Array
    """(6,) of -1 to 1: forward, left, up, and the turns about these"""
    held: str = ""
    """what must be done before it moves, for people; empty: it does"""


class Source(Protocol):
    """What a person moves: a gamepad, a SpaceMouse, keys."""

    name: str
    """for people"""
    usage: str
    """how it is used, for people"""
    curve: Curve
    """that suits it"""

    def read(self) -> Reading:
        """What it says now; at most once per period.

        Raises:
            DriverError: it is gone.
        """

    def feel(self, part: float) -> None:
        """Let the hand feel a force, a part of the largest, 0 to 1; where nothing can be felt, nothing happens."""

    def close(self) -> None:
        """Let go of it."""


class RateMaster:
    """A master whose place is the integral of what a source says, smoothly.

    A source that is gone stands still at once, and goes on from the same place when it is back.

    Args:
        source: what a person moves.
        speed: at full deflection [m/s].
        turning: and of the turns [rad/s].
        smooth: time constant of starting and stopping [s].
        force_limit: what is shown as felt, at most [N].
        axes: 6, or 3 without the turns.

    Raises:
        InputError: a number is out of range.
    """

    def __init__(
        self,
        source: Source,
        *,
        speed: float = 0.1,
        turning: float = 0.5,
        smooth: float = 0.05,
        force_limit: float = 8.5,
        axes: int = AXES,
    ) -> None:
        if not all(0.0 < value < math.inf for value in (speed, turning, smooth, force_limit)):
            raise InputError(
                "speed, turning, smooth and force_limit must be finite and > 0, "
                f"got {speed!r}, {turning!r}, {smooth!r}, {force_limit!r}"
            )
        if axes not in (3, AXES):
            raise InputError(f"axes: expected 3 or {AXES}, got {axes!r}")
        self.source, self.force_limit = source, force_limit
        self.status = ""
        """what must be done before it moves, for people; empty: it does"""
        self.felt = 0.0
        """size of the force that is shown [N]"""
        self._smooth = smooth
        self._most = np.array([speed] * 3 + [turning] * (axes - 3))
        self._wanted = np.zeros(axes)
        self._x, self._v = np.zeros(axes), np.zeros(axes)

    def read(self) -> tuple[Array, Array]:
        """(n,) place [m] and behind it orientation, a rotation vector [rad]; (n,) velocity [m/s, rad/s].

        Raises:
            DriverError: the source is gone.
        """
        try:
            found = self.source.read()
        except DriverError:
            self._wanted, self._v = np.zeros_like(self._x), np.zeros_like(self._x)
            self.status = "gone"
            raise
        self.status = found.held
        part = self.source.curve(found.deflection)[: len(self._x)]
        for three in (part[:3], part[3:]):  # the largest speed is that of every direction
            three /= max(1.0, float(np.linalg.norm(three)))
        self._wanted = np.zeros_like(self._x) if found.held else self._most * part
        return self._x.copy(), self._v.copy()

    def step(self, force: Array, dt: float) -> None:
        """Go on by a period [s]; the force (n,) [N, N m] is shown by the source as well as it can."""
        self._v = self._v - math.expm1(-dt / self._smooth) * (self._wanted - self._v)
        self._x[:3] += dt * self._v[:3]
        if len(self._x) == AXES:
            self._x[3:] = turned(self._x[3:], dt * self._v[3:])
        self.felt = float(np.linalg.norm(force[:3]))
        self.source.feel(min(1.0, self.felt / self.force_limit))

    def close(self) -> None:
        """Let go of the source."""
        self.source.close()


class TerminalKeys:
    """Keys of the terminal: a tap is a small step, and a key moves as long as the keyboard repeats it, for a terminal
    tells no release. Use it as a context, which gives the terminal back as it was.

    Args:
        hold: how long a key counts after it was seen, longer than from one repetition to the next [s].
        clock: what time it is [s].

    Raises:
        InputError: there is no terminal.
    """

    name = "keys of this terminal"
    usage = (
        "w s or arrows forward and back, a d left and right, q e up and down, i k j l u o turn; "
        "a key moves as long as it is down"
    )
    curve = Curve(dead=0.0, expo=0.0)

    def __init__(self, hold: float = 0.15, *, clock: Callable[[], float] = time.monotonic) -> None:
        if not sys.stdin.isatty():
            raise InputError("keyboard needs a terminal to read keys from, and this input is none")
        self._hold, self._clock = hold, clock
        self._seen: dict[str, float] = {}
        self._rest = ""

    def __enter__(self) -> Self:
        import termios
        import tty

        self._before = termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import contextlib
        import termios

        with contextlib.suppress(termios.error):  # a terminal that is gone needs nothing back
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)

    def read(self) -> Reading:
        """What the keys say.

        Raises:
            DriverError: the terminal is gone.
        """
        now = self._clock()
        while select.select([sys.stdin], [], [], 0.0)[0]:
            try:
                pressed = os.read(sys.stdin.fileno(), 64)
            except OSError:
                pressed = b""
            if not pressed:
                raise DriverError(f"{self.name}: the terminal is gone")
            self._seen |= dict.fromkeys(self._keys(pressed.decode("ascii", "ignore")), now)
        deflection = np.zeros(AXES)
        for key, seen in self._seen.items():
            if now - seen < self._hold:
                axis, sign = KEYS[key]
                deflection[axis] += sign
        return Reading(deflection)

    def _keys(self, text: str) -> list[str]:
        """Keys of ours in what the terminal has sent; an unfinished sequence waits for its rest."""
        found, text, self._rest = [], self._rest + text, ""
        for part in _SEQUENCE.finditer(text):
            key = part[0].lower()
            if part[0].startswith("\x1b"):
                key = ARROWS.get(part[1] or "", "")
                if part[1] is None and part.end() == len(text):
                    self._rest = part[0]
            if key in KEYS:
                found.append(key)
        return found

    def feel(self, part: float) -> None:
        """Nothing: keys cannot push back."""

    def close(self) -> None:
        """Nothing: the context gives the terminal back."""
