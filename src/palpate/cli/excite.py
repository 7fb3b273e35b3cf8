"""``palpate excite``: a motion to identify an arm with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError
from ._common import (
    Base,
    Json,
    Quiet,
    Repair,
    Seed,
    Tip,
    check_target,
    console,
    emit,
    examples,
    is_png,
    open_arm,
    say,
    write_file,
)

if TYPE_CHECKING:
    from ..arm import Arm
    from ..identify import Excitation
    from ..simulate import Rehearsal

_HEAD = b"time_s,position_1"


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "excite",
        help="Find a motion to identify an arm with.\n\n"
        "A Fourier series per joint, at rest at both ends, within the limits of position, velocity, "
        "acceleration and "
        "torque, optimised for what it shows, and tried in the simulator for limits and self-collision "
        "before it is "
        "written. Look at it before you run it: palpate knows neither the room nor the cables.",
        epilog=examples(
            "palpate excite --arm kuka_lbr_iiwa7 -o traj.csv",
            "palpate excite --arm robot.urdf --tip tool0 --velocity 1 --floor 0 --ros traj.yaml",
            "palpate excite --arm robot.urdf --ros traj.yaml && ros2 topic pub --once "
            '/joint_trajectory_controller/joint_trajectory trajectory_msgs/msg/JointTrajectory "$(cat traj.yaml)"',
        ),
    )(run)


def run(
    arm: Annotated[str, typer.Option(metavar="ARM", help="Name of a reference arm, a card or a URDF.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="CSV", help="Table to write.")] = Path(
        "traj.csv"
    ),
    ros: Annotated[
        Path | None,
        typer.Option(metavar="YAML", help="Also write a trajectory_msgs/JointTrajectory for ros2 topic pub."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="PNG", help="Also write a picture of it.")] = None,
    seconds: Annotated[
        float, typer.Option(metavar="S", help="How long it takes; it can be repeated.")
    ] = 20.0,
    harmonics: Annotated[int, typer.Option(metavar="N", help="Of the Fourier series.")] = 6,
    seed: Seed = 0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Rows per second of the table.")] = 100.0,
    margin: Annotated[float, typer.Option(metavar="X", help="Part of every limit that is used.")] = 0.95,
    velocity: Annotated[
        float | None, typer.Option(metavar="X", help="No joint faster than this [rad/s].", show_default=False)
    ] = None,
    acceleration: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Acceleration limit [rad/s^2]. [default: to full speed in half a second]",
            show_default=False,
        ),
    ] = None,
    iterations: Annotated[int, typer.Option(metavar="N", help="Of the search.")] = 40,
    floor: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Height of the floor in the base frame [m]; without it there is none."
        ),
    ] = None,
    approach: Annotated[
        float, typer.Option(metavar="S", help="With --ros: time given to reach the first point.")
    ] = 5.0,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Excite."""
    from ..identify import excite, to_csv, to_ros
    from ..simulate import Clearance, rehearse

    check_target(out, lambda content: content.startswith(_HEAD), "the trajectory")
    if ros is not None:
        check_target(ros, lambda content: b"joint_names:" in content, "the trajectory")
    if plot is not None:
        check_target(plot, is_png, "the picture")
    model = open_arm(arm, base=base, tip=tip, repair=repair)
    clearance = Clearance(model, floor=floor) if model.has_dynamics else None
    with _Bar(json or quiet) as progress:
        motion = excite(
            model,
            seconds=seconds,
            harmonics=harmonics,
            seed=seed,
            rate=rate,
            margin=margin,
            velocity=velocity,
            acceleration=acceleration,
            iterations=iterations,
            clearance=clearance,
            progress=progress,
        )
    tried: Rehearsal | None = None
    if model.has_dynamics:
        tried = rehearse(model, motion.time, motion.q, motion.dq, motion.ddq, floor=floor)
        if tried.broken:
            raise InputError(
                f"in the simulator {'; '.join(tried.broken)}: nothing is written; allow less (--margin, "
                "--velocity, "
                "--acceleration) or take another --seed"
            )
    files = {"table": str(out)}
    write_file(out, to_csv(motion).encode("utf-8"))
    if ros is not None:
        write_file(ros, to_ros(motion, approach=approach).encode("utf-8"))
        files["ros"] = str(ros)
    if plot is not None:
        _draw(motion, model, plot)
        files["picture"] = str(plot)
    if json:
        emit(_plain(motion, tried, files))
        return 0
    if not quiet:
        _tell(motion, model, tried, clearance)
    for file in files.values():
        say(file)
    return 0


def _draw(motion: Excitation, arm: Arm, path: Path) -> None:
    from ..report import joints_figure, save_png

    notes = [
        f"{j.limits.lower:.3g} to {j.limits.upper:.3g} allowed" if abs(j.limits.lower) < 1e3 else ""
        for j in arm.joints
    ]
    units = ["rad" if j.kind == "revolute" else "m" for j in arm.joints]
    figure = joints_figure(
        motion.time, {"estimated": motion.q}, motion.joint_names, unit=units, notes=notes, key=False
    )
    save_png(figure, path)


class _Bar:
    """A bar on a terminal, nothing elsewhere."""

    def __init__(self, silent: bool) -> None:
        self._bar: Any = None
        out = console()
        if out.is_terminal and not silent:
            from rich.progress import Progress

            self._bar = Progress(console=out, transient=True)

    def __enter__(self) -> Any:
        if self._bar is None:
            return None
        self._bar.start()
        row = self._bar.add_task("searching", total=None)
        bar = self._bar
        return lambda done, total: bar.update(row, completed=done, total=total)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()


def _tell(motion: Excitation, arm: Arm, tried: Rehearsal | None, clearance: Any) -> None:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2), header_style="dim")
    table.add_column("joint")
    for name in ("from rad", "to rad", "range used", "velocity", "acceleration", "torque", "of the limit"):
        table.add_column(name, justify="right")
    for j, joint in enumerate(arm.joints):
        position, speed, push = motion.share[j]
        share = motion.torque_share[j]
        table.add_row(
            joint.name,
            f"{motion.q[:, j].min():.3f}",
            f"{motion.q[:, j].max():.3f}",
            f"{position:.0%}",
            f"{speed:.0%}",
            f"{push:.0%}",
            f"{motion.torque[j]:.3g} N m" if motion.torque[j] == motion.torque[j] else "-",
            f"{share:.0%}" if share == share else "-",
        )
    console().print(table)
    say(
        f"conditioning {motion.conditioning:.3g} of the base regressor; random motion within the same limits: "
        f"{motion.random_conditioning:.3g}"
    )
    if tried is None:
        say("! the arm has no masses: neither torques nor collisions were looked at")
        return
    near = (
        f"{1e3 * tried.clearance:.0f} mm between {' and '.join(tried.nearest)}"
        if tried.nearest
        else "over 100 mm"
    )
    say(f"simulated    limits hold, clearance {near}; off by at most {tried.tracking.max():.2g} rad")
    for a, b in clearance.ignored:
        say(f"! {a} and {b} touch in most poses as they are drawn: this pair was not looked at")
    if any(s.kind == "mesh" for s in arm.shapes):
        say("! the links' meshes are not opened: the clearance is that of capsules along the links")


def _plain(motion: Excitation, tried: Rehearsal | None, files: dict[str, str]) -> dict[str, Any]:
    def finite(values: Any) -> list[float | None]:
        return [None if v != v else float(v) for v in values]

    return {
        "joints": list(motion.joint_names),
        "seconds": motion.period,
        "harmonics": motion.harmonics,
        "conditioning": motion.conditioning,
        "random_conditioning": motion.random_conditioning,
        "start_rad": motion.q[0].tolist(),
        "share": motion.share.tolist(),
        "torque_Nm": finite(motion.torque),
        "torque_share": finite(motion.torque_share),
        "clearance_m": None if tried is None else tried.clearance,
        "nearest": [] if tried is None else list(tried.nearest),
        "tracking_rad": None if tried is None else tried.tracking.tolist(),
        "files": files,
    }
