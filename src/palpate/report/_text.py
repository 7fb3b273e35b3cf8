"""Words and numbers as they are printed: cleaned, escaped, rounded; what each status means."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from typing import NamedTuple

TWO_SIDED_95 = 1.959963984540054
"""half width of the 95 % interval of a normal distribution, in standard deviations"""

_LONGEST = 400


def clean(text: object, limit: int = _LONGEST) -> str:
    """One printable line of at most `limit` characters: text from a log may hold anything.

    Line ends and tabs become spaces; control characters, bidirectional overrides and lone surrogates become U+FFFD.
    """
    # cut before looking at each character: a damaged log may hold a name of megabytes
    line = " ".join(str(text)[: 4 * limit].split())
    if len(line) > limit:
        line = line[: limit - 1] + "…"
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


def escape(text: object, limit: int = _LONGEST) -> str:
    """:func:`clean`, then fit for HTML text and quoted attributes."""
    return html.escape(clean(text, limit), quote=True)


def number(value: object, digits: int = 4) -> str:
    """A number in at least `digits` significant digits, with a true minus; others as their text; None: a dash."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value}".replace("-", "−")
    if isinstance(value, float):  # numpy's float64 is one
        return "–" if math.isnan(value) else _plain(value, digits).replace("-", "−").replace("inf", "∞")
    if isinstance(value, list | tuple) and len(value) <= 64:
        return ", ".join(number(v, digits) for v in value)
    return clean(value)


def _plain(value: float, digits: int) -> str:
    """Without an exponent where people would not write one."""
    if not 1e-4 <= abs(value) < 1e7:
        return f"{value:.{digits}g}"
    text = f"{value:.{max(digits - 1 - math.floor(math.log10(abs(value))), 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def mass_unit(values: Iterable[float]) -> tuple[float, str]:
    """Factor and name of the unit that suits masses in kg: g below 1 kg, else kg."""
    finite = [abs(v) for v in values if math.isfinite(v)]
    return (1.0, "kg") if finite and max(finite) >= 1.0 else (1e3, "g")


def rounded(value: float, spread: float) -> tuple[str, str]:
    """A value and its spread to the digits the spread allows: two significant ones of a spread 1x or 2x, else one."""
    if not math.isfinite(value):
        return "–", "–"
    if not math.isfinite(spread) or spread <= 0.0:
        return number(value), "0" if spread == 0.0 else "?"
    exponent = math.floor(math.log10(spread))
    digits = 1 if spread / 10.0**exponent < 2.95 else 0
    decimals = min(max(digits - exponent, 0), 9)
    # adding 0.0 turns a rounded -0.0 into 0.0
    return f"{round(value, decimals) + 0.0:.{decimals}f}".replace("-", "−"), f"{spread:.{decimals}f}"


class StatusText(NamedTuple):
    """How a status is shown."""

    name: str
    meaning: str
    severity: int
    """where many samples share one pixel, the most severe status is drawn"""
    colour: str
    """name in the palette"""


_STATUSES = {
    0: StatusText("ok", "use the number and its standard deviation", 0, "green"),
    1: StatusText("warming", "too little has been seen since start or reset", 2, "grey"),
    2: StatusText("held", "nothing can be estimated now; the last good value is repeated", 1, "sky"),
    3: StatusText("gap", "samples are missing just before this one; the value is being rebuilt", 5, "pink"),
    4: StatusText(
        "non_finite",
        "the input held a NaN, an infinity or an absurd number; the sample was not used",
        7,
        "red",
    ),
    5: StatusText(
        "saturated", "the estimator or the actuator is at its bound; the truth may lie beyond", 4, "orange"
    ),
    6: StatusText("singular", "this pose tells nothing about the quantity", 3, "yellow"),
    7: StatusText("time_error", "time stood still or ran backwards; the sample was not used", 6, "red"),
}


def status_text(status: int) -> StatusText:
    """Name, meaning and colour of a palpate status value; one this version does not know says so."""
    known = _STATUSES.get(int(status))
    return known or StatusText(
        f"status {int(status)}", "a status this version of palpate does not know", 8, "red"
    )
