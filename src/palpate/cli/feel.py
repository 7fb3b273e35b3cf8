"""``palpate feel``: what pushes the arm, and where?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ._common import (
    Base,
    Columns,
    Effort,
    Json,
    Quiet,
    Repair,
    Tip,
    check_target,
    emit,
    examples,
    is_report,
    make_folder,
    open_arm,
    open_log,
    print_rows,
    say,
)

if TYPE_CHECKING:
    from rich.text import Text

    from ..feel import Feeling


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "feel",
        help="Find what pushed an arm in its log: when, on which link, how hard, and how sure that is.\n\n"
        "Contacts are told from the model's own errors by a test with a stated rate of false alarms. The rate rests on "
        "what the model gets wrong in free motion: give logs of that with --free, or the card's friction and noise are "
        "believed. Writes report.html.",
        epilog=examples(
            "palpate feel task.mcap --arm robot.arm.yaml",
            "palpate feel task.csv --columns ur10e --arm ur10e.arm.yaml --free free_1.csv --free free_2.csv",
            "palpate feel task.mcap --arm robot.arm.yaml --mass 1.2 --false-alarms 0.1 --json",
        ),
    )(run)


def run(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="A recording: .mcap, rosbag2 folder, .csv, .npz.")
    ],
    arm: Annotated[
        str | None,
        typer.Option(
            metavar="ARM",
            help="Name of a reference arm (see palpate arm), a card or a URDF. [default: the one palpate recorded in "
            "LOG]",
            show_default=False,
        ),
    ] = None,
    free: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="LOG",
            help="Free motion of every joint, nothing held or touched, from which the model's errors are measured; "
            "may be given several times.",
            show_default=False,
        ),
    ] = None,
    free_columns: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE", help="Columns of the free logs. [default: --columns]", show_default=False
        ),
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(metavar="PER_HOUR", help="False alarms of the whole arm, per hour.")
    ] = 1e-3,
    mass: Annotated[
        float, typer.Option(metavar="KG", help="What the hand holds all the time: its weight is no push.")
    ] = 0.0,
    columns: Columns = None,
    effort: Effort = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for the report.")] = Path(),
    report: Annotated[bool, typer.Option("--report/--no-report", help="Write report.html.")] = True,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Feel."""
    from ..feel import feel_log

    page = out / "report.html"
    if report:
        make_folder(out)
        check_target(page, is_report, "the report")
    model = None if arm is None else open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
    result = feel_log(
        open_log(log, columns),
        model,
        free=[open_log(path, free_columns or columns) for path in free or ()],
        false_alarms_per_hour=false_alarms,
        mass=mass,
    )
    files: dict[str, str] = {}
    if report:
        from ..report import write_feel_report

        title = f"What pushed {result.arm.name} in {log.name}"
        files["report"] = str(write_feel_report(result.report(title=title), page))
    if json:
        emit({**result.summary(), "files": files})
    elif quiet:
        for push in result.pushes:
            say(f"{push.start:.3f} {push.stop:.3f} {push.link}")
    else:
        _tell(result, files)
    return 0


def _tell(result: Feeling, files: dict[str, str]) -> None:
    """The result for people."""
    from ..feel import push_words, rate_words

    log = result.log
    count = len(result.pushes)
    rows: list[tuple[str, Text | str]] = [
        ("what", f"{result.arm.name}: {len(log)} samples, {log.duration:.3g} s, {log.rate:.3g} Hz"),
        ("contacts", str(count) if count else "none"),
    ]
    for k, push in enumerate(result.pushes):
        words = push_words(push, result.arm)
        lines = [
            f"{words['from']} to {words['to']}, declared after {words['declared after']}, {words['link']}",
            f"as a force at the grasp point, base axes: {words['force']}",
            f"joints: {words['torque']}",
        ]
        rows.append((f"{k + 1}", "\n".join(lines)))
    rows.append(("false alarms", rate_words(result)))
    rows.append(("read", "\n".join(str(log.repair).splitlines())))
    rows.extend((name, str(path)) for name, path in files.items())
    print_rows(rows, result.remarks)
