"""How figures look, and how they become SVG and PNG: the same bytes for the same data.

matplotlib's settings are changed only while a figure is built or written and are put back after; like those
settings themselves, this is not for two threads at once.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError, MissingExtraError

from ._text import escape

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHT: Mapping[str, str] = {
    "ink": "#1b2430",
    "muted": "#5d6875",
    "grid": "#e4e8ed",
    "paper": "#ffffff",
    # Okabe and Ito's palette: told apart with any colour vision
    "blue": "#0072b2",
    "red": "#d55e00",
    "green": "#009e73",
    "pink": "#cc79a7",
    "orange": "#e69f00",
    "sky": "#56b4e9",
    "yellow": "#b8a800",
    "grey": "#98a2ad",
}
"""colours on white paper"""

DARK: Mapping[str, str] = {
    "ink": "#e8ebef",
    "muted": "#a3adb9",
    "grid": "#2e3742",
    "paper": "#171c22",
    "blue": "#4aaee6",
    "red": "#ff8a3d",
    "green": "#2cc79b",
    "pink": "#e39cc4",
    "orange": "#f5b731",
    "sky": "#8acdf5",
    "yellow": "#e0d040",
    "grey": "#7d8894",
}
"""the same for a page that is dark"""

OTHERS = ("red", "pink", "orange", "sky", "yellow", "green")
"""colours of further curves, in order"""

_SETTINGS: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "text.color": LIGHT["ink"],
    "axes.labelcolor": LIGHT["muted"],
    "axes.titlecolor": LIGHT["ink"],
    "xtick.color": LIGHT["muted"],
    "ytick.color": LIGHT["muted"],
    "axes.edgecolor": LIGHT["grey"],
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": LIGHT["grid"],
    "grid.linewidth": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.pad": 2.5,
    "ytick.major.pad": 2.5,
    "axes.labelpad": 3.0,
    "axes.titlepad": 4.0,
    "lines.linewidth": 1.2,
    "lines.solid_joinstyle": "round",
    "figure.dpi": 100.0,
    "savefig.dpi": "figure",
    "svg.fonttype": "none",
    "svg.hashsalt": "palpate",
}


@contextmanager
def drawing() -> Iterator[None]:
    """Inside, matplotlib draws in palpate's style whatever the user's settings are.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import style
    except ImportError:
        raise MissingExtraError("report", "drawing figures") from None
    with style.context(["default", _SETTINGS]), warnings.catch_warnings():
        # whoever shows the SVG has the letters that matplotlib's own font lacks
        warnings.filterwarnings("ignore", message="Glyph .* missing from", category=UserWarning)
        yield


def svg(figure: Figure, label: str, prefix: str, *, fixed: bool = False) -> str:
    """The figure as an ``<svg>`` element for a page whose CSS names the colours of the palette.

    Args:
        figure: what to draw; its colours out of the palette follow the page, others stay.
        label: what a screen reader says.
        prefix: letters and digits, different for every figure of a page, so that their ids differ.
        fixed: keep near the figure's own size; else it becomes as wide as there is room.
    """
    out = io.BytesIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with drawing():
        figure.savefig(out, format="svg", transparent=True, metadata=nothing)
    text = out.getvalue().decode("utf-8")
    head, body = re.match(r".*?<svg([^>]*)>(.*)$", text, re.DOTALL).groups()  # type: ignore[union-attr]
    view = re.search(r'viewBox="([\d. -]+)"', head)
    assert view is not None
    # its style sheet would hold for the whole page; the page has its own
    body = re.sub(r"<metadata>.*?</metadata>|<defs>\s*<style.*?</style>\s*</defs>", "", body, flags=re.DOTALL)
    body = re.sub(r"<!--.*?-->\s*", "", body, flags=re.DOTALL)
    body = body.replace("xlink:href=", "href=")
    used = dict.fromkeys(re.findall(r'(?:url\(|href=")#([^)"]+)', body))
    names = {old: f"{prefix}-{i}" for i, old in enumerate(used)}
    body = re.sub(r' id="([^"]*)"', lambda m: f' id="{names[m[1]]}"' if m[1] in names else "", body)
    body = re.sub(r'(url\(|href=")#([^)"]+)', lambda m: f"{m[1]}#{names[m[2]]}", body)
    body = re.sub(r' d="([^"]*)"', _shorter_path, body)
    body = re.sub(r'style="([^"]*)"', _page_style, body)
    body = re.sub(r"\s*\n\s*", "\n", body)
    width = (
        108.0 * figure.get_size_inches()[0]
    )  # the letters of 8 points get the size of the page's small print
    size = f' style="max-width:{width:.0f}px;min-width:{0.7 * width:.0f}px"' if fixed else ""
    return (
        f'<svg class="fig" role="img" aria-label="{escape(label)}" viewBox="{view[1]}"{size}>{body}'.strip()
    )


def _shorter_path(match: re.Match[str]) -> str:
    """Hundredths of a point are enough, and blanks beside letters are not needed."""
    path = re.sub(r"-?\d+\.\d{3,}", lambda m: f"{float(m[0]):.2f}".rstrip("0").rstrip("."), match[1])
    path = re.sub(r"\s*([MLCQZz])\s*", r"\1", path).strip()
    return f' d="{path}"'


_VARIABLE = {colour: f"var(--{name})" for name, colour in LIGHT.items()} | {"#000000": "var(--ink)"}


def _page_style(match: re.Match[str]) -> str:
    style = re.sub(r"#[0-9a-f]{6}\b", lambda m: _VARIABLE.get(m[0], m[0]), match[1])
    # the page's fonts, matplotlib's sizes
    style = re.sub(
        r"font: (?:(bold|[5-9]00) )?(?:\w+ )*?([\d.]+px) [^;]*",
        lambda m: ("font-weight: 600; " if m[1] else "") + f"font-size: {m[2]}",
        style,
    )
    return f'style="{style}"'


def png(figure: Figure) -> bytes:
    """The figure as PNG at its own size and resolution, without date and program name."""
    out = io.BytesIO()
    with drawing():
        figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def encode_png(pixels: npt.ArrayLike) -> bytes:
    """A picture as PNG, e.g. of :meth:`palpate.simulate.Plant.render`.

    Args:
        pixels: (height, width, 3) uint8.

    Raises:
        InputError: another shape or type.
        MissingExtraError: matplotlib is not installed.
    """
    array = np.asarray(pixels)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8 or not array.size:
        raise InputError(
            f"a picture must have shape (height, width, 3) and type uint8, got {array.shape} {array.dtype}"
        )
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("report", "writing pictures") from None
    out = io.BytesIO()
    Image.fromarray(array).save(out, format="PNG", optimize=True)
    return out.getvalue()


def decode_png(picture: bytes) -> npt.NDArray[np.uint8]:
    """The pixels of a PNG, (height, width, 3) uint8.

    Raises:
        InputError: not a PNG picture, or a damaged one.
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from PIL import Image
    except ImportError:
        raise MissingExtraError("report", "reading pictures") from None
    try:
        with Image.open(io.BytesIO(picture), formats=["PNG"]) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, SyntaxError, ValueError) as error:  # what Pillow raises for damaged files
        raise InputError(f"the picture is not a readable PNG ({error})") from None


def data_url(picture: bytes) -> str:
    """A PNG or a JPEG as the text of an image's address."""
    kind = "jpeg" if picture.startswith(b"\xff\xd8") else "png"
    return f"data:image/{kind};base64," + base64.b64encode(picture).decode("ascii")
