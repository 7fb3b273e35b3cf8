"""``palpate simulate``: a log of an arm that does not exist."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError
from . import STOPPED
from ._common import (
    DEFAULT_ARM,
    Base,
    Json,
    Noise,
    Quiet,
    Repair,
    Seed,
    Tip,
    check_target,
    console,
    emit,
    examples,
    is_png,
    is_recording,
    make_folder,
    mass_text,
    open_arm,
    picture_png,
    say,
    write_file,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "simulate",
        help="Simulate an arm that moves and holds something; write its log.\n\n"
        "It goes through poses, objects are taken and released. "
        "The log holds every sample, setpoint and command, what the default pipeline made of them, and the truth "
        "(true_mass, true_position).",
        epilog=examples(
            "palpate simulate",
            "palpate simulate --pose Take3 --load 0.25@4 --load 0@9 --duration 12 --out pick.mcap",
            "palpate simulate --arm kuka_lbr_iiwa7 --pose 0,0.5,0,-1.2,0,0.8,0 --load 3 --png arm.png",
            "palpate simulate --pose StandBy --frames film --fps 25",
        ),
    )(run)


def run(
    arm: Annotated[
        str, typer.Option(metavar="ARM", help="Name of a reference arm, a card or a URDF.")
    ] = DEFAULT_ARM,
    pose: Annotated[
        list[str] | None,
        typer.Option(
            metavar="POSE",
            help="Pose to go to, a name or angles in rad; again for the next one. [default: the arm's usual one]",
            show_default=False,
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(metavar="POSE", help="Pose to start from. [default: zero]", show_default=False),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KG[@S]",
            help="Mass in the hand from a time on; 0 is nothing; again for the next one. "
            "[default: the arm's usual one from the start]",
            show_default=False,
        ),
    ] = None,
    duration: Annotated[float, typer.Option(metavar="S", help="How long to simulate.")] = 10.0,
    move: Annotated[
        float, typer.Option(metavar="S", help="Time of each motion, longer where a joint would be too fast.")
    ] = 3.0,
    hold: Annotated[float, typer.Option(metavar="S", help="Time at each pose but the last.")] = 2.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Samples per second.")] = 250.0,
    noise: Noise = True,
    jitter: Annotated[float, typer.Option(metavar="S", help="Error of the time stamps, up to.")] = 0.0,
    loss: Annotated[float, typer.Option(metavar="P", help="Probability that a sample is lost.")] = 0.0,
    seed: Seed = 0,
    speed: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Simulated seconds per second. [default: as fast as it goes]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path, typer.Option(metavar="LOG", help="Recording to write (.mcap).")] = Path(
        "simulated.mcap"
    ),
    png: Annotated[Path | None, typer.Option(metavar="FILE", help="Picture of the end.")] = None,
    frames: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for the frames of a film, frame_00000.png, ...")
    ] = None,
    fps: Annotated[float, typer.Option(metavar="HZ", help="Frames per simulated second.")] = 25.0,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Simulate."""
    from .. import weigh as weighing
    from ._live import interruptible

    if out.suffix != ".mcap":
        raise InputError(f"--out: the log is an .mcap file, got {out}")
    if not 0.0 < fps <= 1000.0:
        raise InputError(f"--fps must be above 0 and at most 1000, got {fps!r}")
    loads = None if load is None else tuple(_load(text) for text in load)
    heaviest = max((m for _, m in loads or ()), default=None)
    scene = weighing.scene(open_arm(arm, base=base, tip=tip, repair=repair), mass=heaviest)
    task = weighing.Task(
        scene=scene,
        start=weighing.find_pose(scene, start or scene.start)[1],
        poses=tuple(weighing.find_pose(scene, text)[1] for text in pose or [scene.pose]),
        loads=((0.0, scene.mass),) if loads is None else loads,
        duration=duration,
        move=move,
        hold=hold,
        rate=rate,
        noise=noise,
        jitter=jitter,
        loss=loss,
        seed=seed,
        speed=speed,
    )
    check_target(out, is_recording, "the recording")
    if png is not None:
        check_target(png, is_png, "the picture")
    film = None if frames is None else _Film(make_folder(frames))
    pipeline, _ = weighing.make_pipeline(scene.arm)
    with interruptible() as stopped, _progress(task, json or quiet) as progress:
        trial = weighing.run(
            task,
            pipeline,
            record=out,
            progress=progress,
            stop=stopped,
            picture=png is not None,
            frames=film,
            frame_rate=fps,
        )
    files = {"log": str(out)}
    if png is not None:
        if trial.picture is None:
            raise InputError(f"--png: {trial.picture_error}")
        write_file(png, picture_png(trial.picture))
        files["picture"] = str(png)
    if film is not None:
        files["frames"] = str(frames)
    result = weighing.weigh_trial(trial)
    log = trial.log
    if json:
        emit(
            {
                "arm": scene.arm.name,
                "samples": len(log),
                "duration_s": log.duration,
                "loads": [{"time_s": t, "mass_kg": m} for t, m in task.loads or ()],
                "arrival_s": weighing.arrival(task),
                "frames": 0 if film is None else film.count,
                "seed": seed,
                "remarks": list(result.remarks),
                "interrupted": trial.interrupted,
                "files": files,
            }
        )
    else:
        if not quiet:
            held = ", ".join(f"{mass_text(m, float('nan'))} from {t:g} s" for t, m in task.loads or ())
            say(f"{scene.arm.name}: {len(log)} samples in {log.duration:g} s, held: {held or 'nothing'}")
            for remark in result.remarks:
                say(f"! {remark}")
        for name in files.values():
            say(name)
    return STOPPED if trial.interrupted else 0


def _load(text: str) -> tuple[float, float]:
    mass, at, time = text.partition("@")
    try:
        return (float(time) if at else 0.0), float(mass)
    except ValueError:
        raise InputError(
            f"--load: expected a mass in kg, or mass@time in kg and s such as 0.25@4, got {text!r}"
        ) from None


class _Film:
    """Writes frames as they come."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.count = 0

    def __call__(self, pixels: npt.NDArray[np.uint8]) -> None:
        write_file(self._folder / f"frame_{self.count:05d}.png", picture_png(pixels))
        self.count += 1


class _progress:
    """A bar on a terminal, nothing elsewhere."""

    def __init__(self, task: Any, silent: bool) -> None:
        self._task, self._bar = task, None
        out = console()
        if out.is_terminal and not silent:
            from rich.progress import Progress

            self._bar = Progress(console=out, transient=True)

    def __enter__(self) -> Any:
        if self._bar is None:
            return None
        self._bar.start()
        row = self._bar.add_task("simulating", total=self._task.duration)
        bar = self._bar
        return lambda moment: bar.update(row, completed=moment.time)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
