"""Arms behind one contract (:class:`Driver`); each driver is a module of its own, with its own imports."""

from __future__ import annotations

from ..logs import Sample
from .driver import Driver, Pace, State

__all__ = ["Driver", "Pace", "Sample", "State"]
