"""Every error palpate raises on purpose: one tree; messages name the place, the expected, the given."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class PalpateError(Exception):
    """Root of all errors palpate raises on purpose; catch it to catch them all."""


class ArmError(PalpateError):
    """An arm's description (URDF, DH table, card) or an argument to one of its model functions is wrong."""


class LogError(PalpateError):
    """A log cannot be opened, is corrupt, or lacks what was asked of it."""


class InputError(PalpateError):
    """An argument of a palpate function has the wrong shape, type, unit or range."""


class DriverError(PalpateError):
    """A driver cannot connect, was used in the wrong order, or lost its device."""


class MissingExtraError(PalpateError):
    """An optional dependency is not installed.

    Args:
        extra: name of the extra that brings it, e.g. ``"sim"``.
        feature: what was asked for, e.g. ``"rendering a scene"``; starts the message.
    """

    def __init__(self, extra: str, feature: str = "this") -> None:
        super().__init__(extra, feature)
        self.extra = extra
        self.feature = feature

    def __str__(self) -> str:
        return f'{self.feature} needs `pip install "palpate[{self.extra}]"`'


def suggest(name: str, choices: Iterable[str], what: str = "choices") -> str:
    """The end of a message about an unknown name: the nearest choices, or else the first twenty."""
    listed = sorted(choices)
    close = difflib.get_close_matches(name[:200], listed[:1000], n=3, cutoff=0.5)
    if close:
        return "did you mean " + " or ".join(repr(c) for c in close) + "?"
    return f"{what}: {', '.join(listed[:20]) or 'none'}" + (", ..." if len(listed) > 20 else "")
