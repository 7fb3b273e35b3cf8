"""How a board is to be wiped."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from ..errors import InputError
from .strokes import Motion

FASTEST = 0.25
"""the force is measured up to this speed, `palpate bench wipe` [m/s]"""


@dataclass(frozen=True, slots=True)
class JobOptions:
    """How a board is to be wiped.

    Raises:
        InputError: a number is out of range.
    """

    speed: float = 0.1
    """of the eraser on the board [m/s]"""
    normal_force: float = 2.5
    """[N]"""
    max_force: float = 5.0
    """bound of the commanded force's norm [N]"""
    max_torque: float = 2.0
    """of the moment's [N m]"""
    passes: int = 3
    """at most"""
    hold: Literal["always", "needed", "never"] = "always"
    """the other arm takes the board: before wiping; when it was seen to move; or it is left loose"""
    look_every: float = 2.0
    """a loose board is looked at so often while it is wiped [s]; 0: not at all"""
    colour: tuple[str, ...] | None = None
    """wipe these colours only"""
    within: tuple[tuple[float, float], ...] | None = None
    """outline of a region to wipe, board coordinates [m]"""
    without: tuple[tuple[float, float], ...] | None = None
    """outline of a region to leave alone"""
    rub: float = 0.035
    """strokes reach so far that the eraser slides for this way over every dirty place [m]"""
    motion: Motion | None = None
    """speeds and accelerations; None: by `speed`"""
    seed: int = 0
    """of the sensors' noise"""

    def __post_init__(self) -> None:
        for name in ("speed", "normal_force", "max_force", "max_torque"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"wiping: {name} must be finite and > 0, got {value!r}")
        if self.speed > FASTEST:
            raise InputError(
                f"wiping: speed must be at most {FASTEST:g} m/s, beyond which the force is not known to hold, got "
                f"{self.speed!r}"
            )
        if not self.normal_force < self.max_force:
            raise InputError(
                f"wiping: normal_force must be below max_force, {self.max_force:g} N, to leave something for the way, "
                f"got {self.normal_force!r}"
            )
        if self.passes < 1:
            raise InputError(f"wiping: passes must be at least 1, got {self.passes!r}")
        if self.hold not in ("always", "needed", "never"):
            raise InputError(f"wiping: hold must be one of always, needed, never, got {self.hold!r}")
        if not self.look_every >= 0.0:
            raise InputError(f"wiping: look_every must be >= 0 s, got {self.look_every!r}")

    @property
    def limited(self) -> bool:
        """Some ink may be meant to stay."""
        return not (self.colour is None and self.within is None and self.without is None)

    @property
    def motions(self) -> Motion:
        """`motion`, or the usual one at `speed`."""
        return self.motion or Motion(speed=self.speed, acceleration=0.25)
