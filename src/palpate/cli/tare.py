"""``palpate tare``: correct an arm's masses from a motion with nothing in the hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

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
    console,
    emit,
    examples,
    is_text,
    open_arm,
    open_log,
    say,
)


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "tare",
        help="Correct an arm's masses by a log of motion without load.\n\n"
        "Each link's mass and inertia get one common factor. Twenty seconds that move every joint through gravity "
        "are enough for a small arm.",
        epilog=examples(
            "palpate simulate --load 0 --pose Take3 --pose StandBy --pose goal --duration 20 --out empty.mcap",
            "palpate tare empty.mcap --arm justina_left_arm -o justina.arm.yaml",
            "palpate tare empty.csv --columns columns.yaml --arm robot.urdf -o robot.arm.yaml",
        ),
    )(run)


def run(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Free motion, nothing held.")],
    arm: Annotated[str, typer.Option(metavar="ARM", help="Name of a reference arm, a card or a URDF.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="CARD", help="Card to write.")],
    mass_std: Annotated[
        float, typer.Option(metavar="X", help="How wrong each link's mass may be, relative to it.")
    ] = 0.2,
    columns: Columns = None,
    effort: Effort = None,
    base: Base = None,
    tip: Tip = None,
    repair: Repair = False,
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Tare."""
    from ..pipeline import tare
    from ..weigh import fit_joints

    check_target(out, is_text, "the card")
    model = open_arm(arm, base=base, tip=tip, repair=repair, effort=effort)
    record, remarks = fit_joints(open_log(log, columns), model)
    found = tare(model, record, mass_std=mass_std)
    found.arm.save(out)
    if json:
        emit(
            {
                "card": str(out),
                "links": [j.link for j in model.joints],
                "factors": found.factors.tolist(),
                "std": found.std.tolist(),
                "masses_kg": [j.mass for j in found.arm.joints],
                "remarks": remarks,
            }
        )
        return 0
    if not quiet:
        from rich.table import Table

        table = Table(box=None, padding=(0, 2), header_style="dim")
        table.add_column("link")
        for name in ("model kg", "tared kg", "factor ± 95 %"):
            table.add_column(name, justify="right")
        for joint, new, factor, std in zip(
            model.joints, found.arm.joints, found.factors, found.std, strict=True
        ):
            seen = "" if std < 0.7 * mass_std else "  (not seen)"
            table.add_row(
                joint.link, f"{joint.mass:.4g}", f"{new.mass:.4g}", f"{factor:.4f} ± {1.96 * std:.4f}{seen}"
            )
        console().print(table)
        for remark in remarks:
            say(f"! {remark}")
    say(str(out))
    return 0
