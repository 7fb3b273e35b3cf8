"""``palpate wipe``: see a dirty whiteboard, hold it, wipe it, check."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from ..errors import InputError
from . import STOPPED
from ._common import (
    Json,
    Quiet,
    Seed,
    check_target,
    console,
    emit,
    examples,
    is_recording,
    is_report,
    make_folder,
    print_rows,
    say,
)

if TYPE_CHECKING:
    from rich.text import Text

    from ..wipe import (
        Event,
        InkLayer,
        JobOptions,
        JobResult,
        Look,
        Observer,
        Setting,
        Tick,
        WipeJob,
    )

DIRTY = 1
"""exit code where ink is left"""
_REFRESH = 0.2
"""of what is shown [s]"""


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "wipe",
        help="Wipe a whiteboard with two simulated arms, without a force sensor.\n\n"
        "A camera finds the board and the ink, one arm holds the board, the other wipes with bounded force, and the "
        "camera checks. Writes run.mcap and report.html into the current folder; both replace those of an earlier run. "
        "Ctrl-C stops safely: the eraser is lifted and everything is written; a second one ends at once. "
        "Exit code 1 where ink is left that should go.",
        epilog=examples(
            "palpate wipe",
            "palpate wipe --seed 7 --speed 0.25 --video wipe.mp4",
            'palpate wipe --text "F = m a" --text "call Ana" --view',
            "palpate wipe --ink drawing.png --board-size 0.5 0.34 --colour blue --colour green",
            "palpate wipe --without 0.05,0.05,0.20,0.15 --magnet 0.3,0.2 --json",
        ),
    )(run)


def run(
    seed: Seed = 0,
    ink: Annotated[
        Path | None,
        typer.Option(
            metavar="IMAGE",
            help="Any picture as the ink: white stays bare. [default: handwriting by chance]",
            show_default=False,
        ),
    ] = None,
    text: Annotated[
        list[str] | None,
        typer.Option(
            metavar="WORDS", help="Write this line instead; may be given again.", show_default=False
        ),
    ] = None,
    board_size: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="W H",
            help="Width and height of the writing surface [m]. [default: by chance]",
            show_default=False,
        ),
    ] = None,
    tilt: Annotated[
        float | None,
        typer.Option(
            metavar="DEG",
            help="Of the table, the far edge up. [default: by chance, to 15]",
            show_default=False,
        ),
    ] = None,
    magnet: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y", help="A magnet on the board [m]; may be given again.", show_default=False
        ),
    ] = None,
    colour: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Wipe this colour only: black, red, yellow, green, blue, purple; may be given again.",
            show_default=False,
        ),
    ] = None,
    within: Annotated[
        str | None,
        typer.Option(
            metavar="REGION",
            help="Wipe only here: X0,Y0,X1,Y1 or the corners X,Y,X,Y,X,Y,... of an outline, board coordinates [m].",
            show_default=False,
        ),
    ] = None,
    without: Annotated[
        str | None,
        typer.Option(metavar="REGION", help="Touch nothing here, in the same form.", show_default=False),
    ] = None,
    speed: Annotated[float, typer.Option(metavar="M/S", help="Of the eraser on the board.")] = 0.1,
    force: Annotated[float, typer.Option(metavar="N", help="The eraser is pressed on so hard.")] = 2.5,
    max_force: Annotated[float, typer.Option(metavar="N", help="Bound of the commanded force's norm.")] = 5.0,
    max_torque: Annotated[
        float, typer.Option(metavar="N M", help="Bound of the commanded moment's norm.")
    ] = 2.0,
    passes: Annotated[int, typer.Option(metavar="N", help="Wipe and check so often at most.")] = 3,
    hold: Annotated[
        str,
        typer.Option(metavar="WHEN", help="The other arm takes the board: always, needed or never."),
    ] = "always",
    wall: Annotated[
        bool, typer.Option("--wall/--simulated", help="No faster than real time. On with --view.")
    ] = False,
    view: Annotated[
        bool,
        typer.Option("--view", help="Show camera, ink, arms and force in a browser page of this machine."),
    ] = False,
    port: Annotated[int, typer.Option(metavar="N", help="Of that page; 0: a free one.")] = 0,
    video: Annotated[
        Path | None, typer.Option(metavar="MP4", help="Also write a video of the same.", show_default=False)
    ] = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the files.")] = Path(),
    record: Annotated[bool, typer.Option("--record/--no-record", help="Write run.mcap.")] = True,
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Wipe."""
    from .. import wipe as wiping

    if ink is not None and text:
        raise InputError("--ink and --text: what is on the board is one or the other")
    options = wiping.JobOptions(
        speed=speed,
        normal_force=force,
        max_force=max_force,
        max_torque=max_torque,
        passes=passes,
        hold=cast(Literal["always", "needed", "never"], hold),
        colour=tuple(colour) if colour else None,
        within=None if within is None else _region("--within", within),
        without=None if without is None else _region("--without", without),
        seed=seed,
    )
    wiping.choose((), colours=(), colour=options.colour)  # before anything moves: are these colours?
    layer, setting = _board(seed, ink, text or [], board_size, tilt, magnet or [])
    page, recording = out / "report.html", out / "run.mcap"
    if report or record:
        make_folder(out)
    if report:
        from ..report._style import drawing

        check_target(page, is_report, "the report")
        with drawing():  # what it needs is missed now, not when all is done
            pass
    if record:
        check_target(recording, is_recording, "the recording")
    if video is not None:
        check_target(video, _is_video, "the video")
    scene = wiping.BoardScene(layer, setting)
    files: dict[str, str] = {}
    try:
        job = wiping.WipeJob(scene, options)
        result, remarks = _wipe(
            job,
            wall=wall or view,
            record=recording if record else None,
            video=video,
            port=port if view else None,
            live=not (json or quiet),
        )
        if record:
            files["log"] = str(recording)
        if video is not None:
            files["video"] = str(video)
        if report:
            from ..report import write_wipe_report

            told = wiping.report(result, options, scene, f"A whiteboard wiped, seed {seed}")
            files["report"] = str(write_wipe_report(told, page))
    finally:
        scene.close()
    if json:
        emit({**wiping.summary(result, options), "remarks": remarks, "files": files})
    elif quiet:
        say(_short(result))
    else:
        _tell(result, options, files, remarks)
    if result.verdict == "stopped":
        return STOPPED if "person" in result.reason else DIRTY
    return 0 if result.verdict == "clean" else DIRTY


def _is_video(content: bytes) -> bool:
    return content[4:8] == b"ftyp"


def _numbers(option: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(v) for v in values):
        raise InputError(f"{option}: expected numbers [m] separated by commas, got {text!r}")
    return values


def _region(option: str, text: str) -> tuple[tuple[float, float], ...]:
    """An outline from four numbers, opposite corners, or from six and more, all corners."""
    v = _numbers(option, text)
    if len(v) == 4:
        (x0, x1), (y0, y1) = sorted((v[0], v[2])), sorted((v[1], v[3]))
        if x0 == x1 or y0 == y1:
            raise InputError(f"{option}: X0,Y0,X1,Y1 must be opposite corners of a rectangle, got {text!r}")
        return (x0, y0), (x1, y0), (x1, y1), (x0, y1)
    if len(v) < 6 or len(v) % 2:
        raise InputError(
            f"{option}: expected X0,Y0,X1,Y1 or three and more corners X,Y,X,Y,X,Y,..., got {len(v)} numbers"
        )
    return tuple(zip(v[::2], v[1::2], strict=True))


def _board(
    seed: int,
    picture: Path | None,
    lines: Sequence[str],
    size: tuple[float, float] | None,
    tilt: float | None,
    magnets: Sequence[str],
) -> tuple[InkLayer, Setting]:
    """What is on the board, and how it lies."""
    from .. import wipe as wiping
    from ..vision import load
    from ..wipe.boards import place, random_board

    layer, setting = random_board(seed)
    if size is not None or picture is not None or lines:
        layer = wiping.InkLayer(size or layer.size)
        if picture is not None:
            layer.picture(load(picture)[..., ::-1])
        elif lines:
            w, h = layer.size
            colours = ("black", "blue", "red", "green")
            for k, words in enumerate(lines):
                # letters are about 0.7 times as wide as they are high
                broad = 0.7 * max(len(words), 1)
                height = min(0.5 * h / (len(lines) + 1), 0.2 * h, 0.88 * w / broad)
                at = (0.5 * (w - broad * height), (k + 1) * h / (len(lines) + 1) + 0.5 * height)
                layer.text(words, at, height=height, colour=colours[k % len(colours)])
        else:
            wiping.handwriting(layer, seed)
    if tilt is not None:
        if not math.isfinite(tilt):
            raise InputError(f"--tilt must be finite, got {tilt!r}")
        setting = replace(setting, tilt=math.radians(tilt), centre=place(math.radians(tilt)))
    where = []
    for text in magnets:
        spot = _numbers("--magnet", text)
        if len(spot) != 2 or not (0.0 < spot[0] < layer.size[0] and 0.0 < spot[1] < layer.size[1]):
            raise InputError(
                f"--magnet: expected X,Y on the board of {layer.size[0]:g} m x {layer.size[1]:g} m, got {text!r}"
            )
        where.append((spot[0], spot[1]))
    return layer, replace(setting, magnets=tuple(where))


def _wipe(
    job: WipeJob,
    *,
    wall: bool,
    record: Path | None,
    video: Path | None,
    port: int | None,
    live: bool,
) -> tuple[JobResult, list[str]]:
    """Run it, with everybody told who wants to know."""
    from ..wipe import Film, RunRecorder, Video
    from ._live import interruptible

    told: list[Observer] = []
    remarks: list[str] = []
    with ExitStack() as stack:
        recorder = None
        if record is not None:
            recorder = stack.enter_context(RunRecorder(record, job.scene, job.options, overwrite=True))
            told.append(recorder)
        screens: list[Callable[[Any], None]] = []
        if video is not None:
            film = Video(video)
            stack.callback(film.close)
            screens.append(film.show)
        if port is not None:
            screens.append(_page(stack, job, port, quiet=not live))
        if screens:

            def show(picture: Any) -> None:
                for screen in screens:
                    screen(picture)

            told.append(Film(job, show))
        stopped = stack.enter_context(interruptible())
        if live:
            told.append(stack.enter_context(_Progress(job)))
        result = job.run(observer=_everyone(job, told, stopped), clock="wall" if wall else "simulated")
        if recorder is not None and recorder.remark:
            remarks.append(recorder.remark)
    return result, remarks


def _page(stack: ExitStack, job: WipeJob, port: int, *, quiet: bool) -> Callable[[Any], None]:
    """A page in the browser, and what to give pictures to."""
    import cv2

    from ._page import LivePage

    actions = {"pause": job.pause, "resume": job.resume, "stop": job.stop}
    page = stack.enter_context(LivePage("palpate wipe", actions, port))
    if not quiet:
        say(f"live at {page.address}")

    def show(picture: Any) -> None:
        page.show(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes())

    return show


def _everyone(job: WipeJob, told: Sequence[Observer], stopped: Callable[[], bool]) -> Observer:
    """All of them as one; Ctrl-C stops the job."""
    from ..wipe import Observer

    class Everyone(Observer):
        asked = False

        def tick(self, tick: Tick) -> None:
            if stopped() and not self.asked:
                self.asked = True
                job.stop()
            for one in told:
                one.tick(tick)

        def look(self, look: Look) -> None:
            for one in told:
                one.look(look)

        def event(self, event: Event) -> None:
            for one in told:
                one.event(event)

    return Everyone()


def _Progress(job: WipeJob) -> Any:
    """What happens, a bar and the time left in a terminal; the events as lines elsewhere."""
    from rich.console import Group
    from rich.live import Live
    from rich.progress_bar import ProgressBar
    from rich.table import Table
    from rich.text import Text

    from ..wipe import Observer
    from ..wipe.film import told

    class Progress(Observer):
        def __init__(self) -> None:
            self._live = Live(console=console(), auto_refresh=False, transient=True)
            self._terminal = console().is_terminal
            self._begin, self._next = time.monotonic(), 0.0
            self._lines: list[str] = []

        def __enter__(self) -> Progress:
            if self._terminal:
                self._live.__enter__()
            return self

        def __exit__(self, *error: Any) -> None:
            if self._terminal:
                self._live.__exit__(*error)

        def event(self, event: Event) -> None:
            if event.kind == "activity":
                return
            line = f"{event.time_ns * 1e-9:7.2f} s  {event.text}"
            self._lines.append(line)
            if not self._terminal:
                say(line)

        def tick(self, tick: Tick) -> None:
            now = time.monotonic()
            if not self._terminal or now < self._next:
                return
            self._next = now + _REFRESH
            done, _ = job.progress
            pace = tick.time_ns * 1e-9 / max(now - self._begin, 1e-3)
            grid = Table.grid(padding=(0, 2))
            grid.add_column(style="dim", no_wrap=True)
            grid.add_column()
            grid.add_row("now", told(tick, job))
            grid.add_row("pass", ProgressBar(total=1.0, completed=done, width=40))
            felt = f"{tick.normal_force:.2f} N" if tick.normal_force == tick.normal_force else "–"
            grid.add_row("force", f"set {tick.wanted_force:.2f} N, felt {felt}")
            grid.add_row("time", f"{tick.time_ns * 1e-9:.1f} s, {pace:.1f} times real time")
            lines = Text("\n".join(self._lines[-6:]), style="dim")
            self._live.update(Group(grid, lines), refresh=True)

    return Progress()


def _short(result: JobResult) -> str:
    left = f", {100.0 * result.ink_left:.2g} % of the ink left" if result.ink_left == result.ink_left else ""
    return f"{result.verdict}{left}"


def _tell(result: JobResult, options: JobOptions, files: dict[str, str], remarks: Sequence[str]) -> None:
    from rich.text import Text

    from .. import wipe as wiping

    told = wiping.summary(result, options)
    style = {"clean": "bold green", "dirty": "bold yellow"}.get(result.verdict, "bold red")
    verdict = Text(result.verdict, style=style)
    if result.reason:
        verdict.append(f": {result.reason}", style="")
    rows: list[tuple[str, Text | str]] = [("board", verdict)]
    if result.ink_left == result.ink_left:
        rows.append(
            (
                "ink left",
                f"{100.0 * result.ink_left:.2g} % of {1e4 * result.ink_before:.1f} cm²"
                + (", some of which was to stay" if options.limited else ""),
            )
        )
    rows.append(("passes", str(len(result.passes))))
    if told["within_band"] is not None:
        rows.append(
            (
                "normal force",
                f"within ± {told['band_N']:g} N of {options.normal_force:g} N for "
                f"{100.0 * told['within_band']:.1f} % of the time of sliding",
            )
        )
    if told["max_commanded_force_N"] is not None:
        rows.append(
            (
                "largest",
                f"commanded {told['max_commanded_force_N']:.2f} N (bound {options.max_force:g} N), "
                f"contact {told['max_contact_force_N']:.2f} N",
            )
        )
    rows.append(("time", f"{result.simulated:.1f} s simulated in {result.wall:.1f} s"))
    rows.extend(files.items())
    if result.resumable:
        remarks = [*remarks, "it was stopped before its end; what is left is in the report"]
    print_rows(rows, remarks)
