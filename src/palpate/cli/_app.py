"""The command line: which verbs there are."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from . import (
    arm,
    bench,
    data,
    doctor,
    excite,
    feel,
    identify,
    replay,
    reproduce,
    see,
    simulate,
    tare,
    teleop,
    weigh,
)

app = typer.Typer(
    name="palpate",
    help="A sense of touch for robot arms without a force sensor.\n\n"
    "Start with palpate weigh: a simulated arm lifts something and tells what it weighs.",
    epilog="Every command has --help with examples. Exit codes: 0 done, 1 a row of a study misses or a replay differs, "
    "2 wrong input, 70 a bug in palpate, 130 stopped by Ctrl-C.",
    add_completion=False,
    invoke_without_command=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        from .. import __version__

        typer.echo(f"palpate {__version__}")
        raise typer.Exit


@app.callback()
def _start(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Print a traceback with every error; so does PALPATE_DEBUG=1.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


for module in (
    weigh,
    feel,
    simulate,
    replay,
    tare,
    identify,
    excite,
    arm,
    see,
    teleop,
    reproduce,
    bench,
    data,
    doctor,
):
    module.add(app)


def command() -> Any:
    """The command, ready to be called."""
    return typer.main.get_command(app)
