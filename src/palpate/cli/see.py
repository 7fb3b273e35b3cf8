"""``palpate see``: find a whiteboard in a picture and say what is on it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import InputError
from ._common import Json, Quiet, check_target, emit, examples, is_png, print_rows, say, write_file

if TYPE_CHECKING:
    from rich.text import Text


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "see",
        help="Find a whiteboard in a picture: corners, ink, clean or dirty.\n\n"
        "Writes an annotated picture and prints what was seen. Exit code 2 where there is no board.",
        epilog=examples(
            "palpate see photo.jpg",
            "palpate see photo.jpg --board-size 0.60 0.45 --camera camera.json -o seen.png --json",
            "palpate see photo.jpg --method published",
        ),
    )(run)


def run(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="PNG, JPEG, BMP, TIFF, WebP or PNM.")],
    method: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="lines; published (growing by hue); the same by saturation or value."
        ),
    ] = "lines",
    board_size: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="W H", help="Width and height of the writing surface [m]; else only its shape."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(metavar="CARD", help="Calibration, as palpate.vision.Camera.save writes it."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="PNG", help="Annotated picture; without it IMAGE-seen.png here."),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """See."""
    from ..vision import METHODS, Camera, annotated, load, png, see

    chosen = next((m for m in METHODS if m == method), None)
    if chosen is None:
        raise InputError(f"no method {method!r} to find a board; there are: {', '.join(METHODS)}")
    target = Path(f"{image.stem}-seen.png") if out is None else out
    check_target(target, is_png, "the annotated picture")
    picture = load(image)
    sight = see(
        picture, method=chosen, size=board_size, camera=None if camera is None else Camera.load(camera)
    )
    if sight.board is None or sight.plane is None or sight.ink is None:
        raise InputError(
            f"{image}: no whiteboard found ({method}): expected four straight edges around an even light surface, "
            "all of it in view but at most one side"
        )
    write_file(target, png(annotated(picture, sight)))
    if json:
        emit({**sight.plain(), "method": method, "picture": str(target)})
        return 0
    verdict = "dirty" if sight.dirty else "clean"
    if quiet:
        say(verdict)
        return 0
    unit = "m" if sight.plane.metric else "board heights"
    rows: list[tuple[str, Text | str]] = [
        ("board", f"{verdict}, found with confidence {100.0 * sight.board.confidence:.0f} %"),
        ("corners [px]", "  ".join(f"({x:.1f}, {y:.1f})" for x, y in sight.board.corners)),
        ("their standard deviation [px]", ", ".join(f"{s:.1f}" for s in sight.board.sigma)),
        ("size", f"{sight.plane.size[0]:.3f} x {sight.plane.size[1]:.3f} {unit}"),
        ("ink", f"{len(sight.ink.polygons)} pieces on {100.0 * sight.covered:.2f} % of the surface"),
        ("other things on it", str(len(sight.ink.objects))),
    ]
    if sight.plane.T_camera_board is not None:
        distance = sight.plane.T_camera_board[:3, 3]
        rows.append((f"corner 1 seen from the camera [{unit}]", ", ".join(f"{v:.3f}" for v in distance)))
    print_rows(rows, sight.remarks())
    say(str(target))
    return 0
