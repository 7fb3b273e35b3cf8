"""The usual kinds of rows."""

from __future__ import annotations

from . import Row


def near(
    what: str,
    required: float,
    ours: float,
    tolerance: float,
    unit: str,
    note: str = "",
    *,
    judged: bool = True,
) -> Row:
    """Ours must be within `tolerance` of `required`."""
    ok = bool(abs(ours - required) <= tolerance)
    return Row(what, required, ours, tolerance, ok if judged else None, unit, note)


def at_most(what: str, limit: float, ours: float, unit: str, note: str = "", *, judged: bool = True) -> Row:
    """Ours must not exceed `limit`."""
    return Row(what, f"<= {limit:g}", ours, None, bool(ours <= limit) if judged else None, unit, note)


def told(
    what: str, ours: float | str, unit: str, note: str = "", *, beside: float | str | None = None
) -> Row:
    """For information, `beside` what was published or would be ideal."""
    return Row(what, beside, ours, None, None, unit, note)
