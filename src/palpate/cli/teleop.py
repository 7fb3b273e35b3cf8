"""``palpate teleop``: a hand moves a device, an arm follows, and the hand feels what it touches."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError
from . import STOPPED
from ._common import (
    Json,
    Quiet,
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
from ._live import interruptible

if TYPE_CHECKING:
    from ..teleop.session import Cut


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "teleop",
        help="Teleoperate a simulated arm and feel what it touches, without a force sensor.\n\n"
        "A scripted hand holds a simulated haptic device; the arm follows it in MuJoCo. Scenes: wall (press "
        "a spring of known stiffness), "
        "surface (trace it), peg (into a hole), lift (objects whose masses nobody knows), free (nothing to touch). "
        "Delay, jitter, loss and dead links come from a fault layer; every message is encrypted and authenticated.",
        epilog=examples(
            "palpate teleop",
            "palpate teleop wall --stiffness 5000 --delay 0.1 --jitter 0.05 --loss 0.2",
            "palpate teleop wall --delay 0.1 --no-passivity",
            "palpate teleop lift --mass 0.4 --mass 1.5",
            "palpate teleop wall --cut 5@1.5",
            "palpate teleop --new-key teleop.key",
        ),
    )(run)


def run(
    scene: Annotated[
        str, typer.Argument(metavar="[SCENE]", help="wall, surface, peg, lift or free.", show_default=False)
    ] = "wall",
    arm: Annotated[
        str, typer.Option(metavar="ARM", help="The slave: kuka_lbr_iiwa14, kuka_lbr_iiwa7 or abb_irb2400_16.")
    ] = "kuka_lbr_iiwa14",
    coupling: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="force_position (as published), position_position or four_channel."
        ),
    ] = "force_position",
    stiffness: Annotated[float, typer.Option(metavar="N/M", help="Of the wall.")] = 2000.0,
    press: Annotated[
        float, typer.Option(metavar="M", help="How far behind wall or surface the hand goes.")
    ] = 0.02,
    mass: Annotated[
        list[float] | None,
        typer.Option(
            metavar="KG",
            help="Object to lift; again for the next one. [default: what suits the arm]",
            show_default=False,
        ),
    ] = None,
    motion_scale: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Motion of the arm per motion of the hand. [default: what suits the arm]",
            show_default=False,
        ),
    ] = None,
    force_scale: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Force felt per force touched. [default: what suits the arm]",
            show_default=False,
        ),
    ] = None,
    delay: Annotated[float, typer.Option(metavar="S", help="Of every message, each way.")] = 0.0,
    jitter: Annotated[
        float, typer.Option(metavar="S", help="Uniform, on top of the delay; messages overtake one another.")
    ] = 0.0,
    loss: Annotated[float, typer.Option(metavar="P", help="Probability that a message is lost.")] = 0.0,
    duplicate: Annotated[
        float, typer.Option(metavar="P", help="Probability that a message comes twice.")
    ] = 0.0,
    cut: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AT@FOR",
            help="The link dies at a time, for so long [s]; again for the next.",
            show_default=False,
        ),
    ] = None,
    passivity: Annotated[
        bool,
        typer.Option(
            "--passivity/--no-passivity", help="The passivity layer; without it see what delay does."
        ),
    ] = True,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="How long. [default: as long as the scene takes]", show_default=False),
    ] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of noise and faults.")] = 0,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for report.html and teleop.mcap.")
    ] = Path("teleop"),
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    record: Annotated[
        bool, typer.Option("--record/--no-record", help="Write teleop.mcap, both sides in one log.")
    ] = True,
    new_key: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a new key for the channel between two machines, and stop.",
            show_default=False,
        ),
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Teleoperate."""
    if new_key is not None:
        from ..teleop import make_key

        path = make_key(new_key)
        emit({"key": str(path)}) if json else say(
            f"{path}: a new key, readable by you alone; both machines need the same"
        )
        return 0
    from ..teleop.channel import Faults
    from ..teleop.coupling import COUPLINGS
    from ..teleop.record import record as write_log
    from ..teleop.record import rows, write_report
    from ..teleop.setups import build

    if coupling not in COUPLINGS:
        raise InputError(f"--coupling: expected {', '.join(COUPLINGS)}, got {coupling!r}")
    faults = Faults(delay=delay, jitter=jitter, loss=loss, duplicate=duplicate)
    cuts = tuple(map(_cut, cut or ()))
    page, log = out / "report.html", out / "teleop.mcap"
    if report or record:
        make_folder(out)
        check_target(page, is_report, "the report")
        check_target(log, is_recording, "the recording")
    setup = build(
        None if scene == "free" else scene,
        arm=arm,
        coupling=coupling,
        stiffness=stiffness,
        press=press,
        masses=tuple(mass) if mass else None,
        motion_scale=motion_scale,
        force_scale=force_scale,
        passive=passivity,
        seed=seed,
    )
    with interruptible() as stopped, _Bar(silent=json or quiet) as bar:
        result = setup.run(seconds=seconds, faults=faults, cuts=cuts, progress=bar, seed=seed, stop=stopped)
        ended = stopped()
    files: dict[str, str] = {}
    settings: dict[str, object] = {
        "scene": scene,
        "arm": arm,
        "coupling": coupling,
        "passivity layer": "on" if passivity else "off",
        "motion scale": setup.motion_scale,
        "force scale": setup.follower.force_scale,
        "delay, jitter [s]": f"{delay:g}, {jitter:g}",
        "loss, duplicates": f"{loss:g}, {duplicate:g}",
        "dead links": ", ".join(f"{c.at:g} s for {c.seconds:g} s" for c in cuts) or "none",
        "seed": seed,
    }
    if report:
        files["report"] = str(write_report(result, setup, page, settings=settings, cuts=cuts))
    if record:
        files["log"] = str(write_log(result, setup, log, overwrite=True))
    found = rows(result, setup, cuts)
    if json:
        emit(
            {
                "settings": settings,
                "rows": [{"what": r.what, "value": r.ours, "unit": r.unit, "note": r.note} for r in found],
                "reasons": [{"time_s": t, "text": text} for t, text in result.reasons],
                "refused": result.refused,
                "files": files,
            }
        )
    elif quiet:
        for r in found:
            say(f"{r.what}: {r.ours:.4g} {r.unit}")
    else:
        head: list[tuple[str, Any]] = [("scene", "free motion" if setup.scene is None else setup.scene.text)]
        head += [(r.what, f"{r.ours:.3g} {r.unit}" + (f"  ({r.note})" if r.note else "")) for r in found]
        head += list(files.items())
        print_rows(head, [f"at {t:.2f} s: {text}" for t, text in result.reasons])
    return STOPPED if ended else 0


def _cut(text: str) -> Cut:
    from ..teleop.session import Cut

    at, _, length = text.partition("@")
    try:
        found = Cut(float(at), float(length))
    except ValueError:
        raise InputError(f"--cut: expected AT@FOR in seconds, such as 5@1.5, got {text!r}") from None
    if not (found.at >= 0.0 and 0.0 < found.seconds <= 3600.0):
        raise InputError(f"--cut: expected a time >= 0 and a length above 0 to 3600 s, got {text!r}")
    return found


class _Bar:
    """How far the simulation is and when it will be done; without a terminal a line on stderr every half minute."""

    def __init__(self, *, silent: bool) -> None:
        self._silent = silent
        self._begin = self._told = time.monotonic()
        self._status: Any = None

    def __enter__(self) -> _Bar:
        if not self._silent and console().is_terminal:
            self._status = console().status("starting")
            self._status.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._status is not None:
            self._status.stop()

    def __call__(self, done: float, whole: float) -> None:
        spent = time.monotonic() - self._begin
        text = f"{done:.1f} of {whole:g} s simulated, {spent * (whole - done) / max(done, 1e-9):.0f} s left"
        if self._status is not None:
            self._status.update(text)
        elif not self._silent and time.monotonic() - self._told >= 30.0:
            self._told = time.monotonic()
            sys.stderr.write(text + "\n")
