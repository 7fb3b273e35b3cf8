"""``palpate replay``: does a recording still give the same bits?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ._common import Json, Quiet, emit, examples, open_log, say


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "replay",
        help="Run a recorded session once more and compare, bit for bit.\n\n"
        "The recorded samples go through the pipeline that the recording describes, and every recorded output is "
        "compared with the new one. Exit code 1 if anything differs.",
        epilog=examples("palpate replay run.mcap", "palpate replay run.mcap --json"),
    )(run)


def run(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="A recording of palpate weigh or palpate simulate.")
    ],
    json: Json = False,
    quiet: Quiet = False,
) -> int:
    """Replay."""
    from .. import __version__
    from ..weigh import replay

    found = replay(open_log(log, None))
    if json:
        emit(
            {
                "same": found.same,
                "samples": found.samples,
                "compared": found.compared,
                "quantities": list(found.quantities),
                "differences": [
                    {
                        "quantity": d.quantity,
                        "samples": d.rows,
                        "first_sample": d.first,
                        "first_time_s": d.time_s,
                        "recorded": _number(d.recorded),
                        "replayed": _number(d.replayed),
                    }
                    for d in found.differences
                ],
                "recorded_by": found.version,
                "version": __version__,
            }
        )
        return 0 if found.same else 1
    if found.same:
        say(f"the same, bit for bit: {len(found.quantities)} quantities of {found.compared} samples")
    else:
        say(f"different: {len(found.differences)} of {len(found.quantities)} quantities")
    if quiet:
        return 0 if found.same else 1
    for d in found.differences:
        say(
            f"  {d.quantity}: {d.rows} samples, first at {d.time_s:.3f} s (sample {d.first}): "
            f"recorded {d.recorded!r}, now {d.replayed!r}"
        )
    if found.compared < found.samples:
        say(f"the recording was cut short: {found.samples - found.compared} samples have no recorded outputs")
    if not found.same_version:
        say(f"recorded by palpate {found.version}; this is {__version__}")
    return 0 if found.same else 1


def _number(value: float) -> float | str:
    """JSON has no NaN and no infinity."""
    return value if value - value == 0.0 else str(value)
