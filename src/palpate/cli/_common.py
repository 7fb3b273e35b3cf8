"""What every verb uses: shared options, JSON, the console."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import InputError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from ..arm import Arm
    from ..logs import ColumnMap, Log

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only the result.")]
DEFAULT_ARM = "justina_left_arm"
"""what is simulated where no arm is named"""
RecordedLog = Annotated[
    Path | None,
    typer.Argument(
        metavar="LOG",
        help="A recording: .mcap, rosbag2 folder, .csv, .npz. Without it an arm is simulated.",
        show_default=False,
    ),
]
ArmOrRecorded = Annotated[
    str | None,
    typer.Option(
        metavar="ARM",
        help=f"Name of a reference arm (see palpate arm), a card or a URDF. [default: {DEFAULT_ARM}, or "
        "the one palpate recorded in LOG]",
        show_default=False,
    ),
]
Noise = Annotated[
    bool, typer.Option("--noise/--no-noise", help="Noise and quantisation of the simulated drives.")
]
Seed = Annotated[
    int,
    typer.Option(
        metavar="N", min=0, help="Of all that is drawn by chance; the same seed gives the same run."
    ),
]
Columns = Annotated[
    str | None,
    typer.Option(
        metavar="NAME|FILE",
        help="Where a table keeps what: the name of a known data set, or a YAML file with the fields of "
        "palpate.ColumnMap.",
    ),
]
Effort = Annotated[
    str | None,
    typer.Option(
        metavar="KIND",
        help="What the log's effort is, where the arm's card does not say: torque (link-side N m), or current:GAIN,... "
        "(A, with the N m per A of each joint, or one number for all).",
    ),
]
Base = Annotated[str | None, typer.Option(metavar="LINK", help="Base link, where ARM is a URDF.")]
Tip = Annotated[str | None, typer.Option(metavar="LINK", help="Tip link, where ARM is a URDF.")]

Repair = Annotated[
    bool,
    typer.Option("--repair-inertia", help="Replace inertias that no body can have, where ARM is a URDF."),
]


def examples(*lines: str) -> str:
    """Examples for the end of a help text, each on a line of its own."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def emit(value: dict[str, Any]) -> None:
    """Print one JSON object."""
    json.dump(value, sys.stdout, allow_nan=False, ensure_ascii=False)
    sys.stdout.write("\n")
    sys.stdout.flush()


def console() -> Console:
    """Where people read."""
    from rich.console import Console

    plain = Console(highlight=False, emoji=False, markup=False)
    if not plain.is_terminal:  # a file or a pipe has no width to fold to
        plain.width = 160
    return plain


def group(app: typer.Typer, name: str, help: str) -> typer.Typer:
    """A verb with verbs of its own; alone it shows its help."""
    made = typer.Typer(help=help, rich_markup_mode=None, invoke_without_command=True)

    @made.callback()
    def start(context: typer.Context) -> None:
        if context.invoked_subcommand is None:
            typer.echo(context.get_help())

    app.add_typer(made, name=name)
    return made


def print_rows(rows: list[tuple[str, Text | str]], remarks: Sequence[str] = ()) -> None:
    """Names and values in two columns, then remarks; folded to the terminal's width, or as they are without one."""
    from rich.table import Table
    from rich.text import Text

    out = console()
    if not out.is_terminal:
        width = max((len(name) for name, _ in rows), default=0) + 2
        for name, value in rows:
            for i, line in enumerate(str(value).splitlines()):
                say(f"{'' if i else name:{width}}{line}")
        for remark in remarks:
            say(f"! {remark}")
        return
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(name, value)
    for remark in remarks:
        table.add_row(Text("!", style="bold yellow", justify="right"), remark)
    out.print(table)


def only(where: str, why: str, given: dict[str, Any]) -> None:
    """Options that have no meaning here must not be given.

    Raises:
        InputError: one is.
    """
    for name, value in given.items():
        if value is not None:
            raise InputError(f"{name} is for {where}, and {why}")


def say(text: str = "") -> None:
    """Print a line as it is."""
    sys.stdout.write(text + "\n")


def check_target(path: Path, ours: Callable[[bytes], bool], what: str) -> None:
    """An output may replace a file of its own kind and no other.

    Raises:
        InputError: something else is there, or it cannot be written there.
    """
    if path.is_dir():
        raise InputError(f"{path} is a folder; {what} needs a file name")
    if not path.exists():
        return
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from None
    if content and not ours(content):
        raise InputError(f"{path} is there and was not written by palpate: move it, or choose another --out")


def make_folder(path: Path) -> Path:
    """The folder, made if need be.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: no folder, and none can be made: {error.strerror or error}") from None
    return path


def is_recording(content: bytes) -> bool:
    """An MCAP file that palpate wrote."""
    return content.startswith(b"\x89MCAP") and b"palpate" in content[:100]


def is_report(content: bytes) -> bool:
    """An HTML page that palpate wrote."""
    return content.startswith(b"<!DOCTYPE html>") and b"palpate" in content


def is_png(content: bytes) -> bool:
    """A picture."""
    return content.startswith(b"\x89PNG")


def is_text(content: bytes) -> bool:
    """A card, a URDF or a header of palpate's."""
    return b"palpate" in content


def a_log(path: Path) -> Path:
    """What is given as LOG, unless it is an arm.

    Raises:
        InputError: the name of a reference arm and no file, or a card or URDF.
    """
    from .. import robots

    if (str(path) in robots.names() and not path.exists()) or path.suffix.lower() in (".urdf", ".xacro"):
        raise InputError(
            f"{path} is an arm, and a recording is expected here; an arm is given as --arm {path}"
        )
    return path


def open_log(path: Path, columns: str | None) -> Log:
    """The log, bad rows kept: the pipeline gives them a status."""
    from ..logs import Log

    return Log.open(a_log(path), column_map(columns), keep_invalid=True)


def column_map(text: str | None) -> ColumnMap | None:
    from ..logs import ColumnMap, SignalColumns

    if text is None:
        return None
    path = Path(text)
    if path.suffix.lower() not in (".yaml", ".yml"):
        return ColumnMap.named(text)
    try:
        import yaml
    except ImportError:
        from ..errors import MissingExtraError

        raise MissingExtraError("card", "reading a column map") from None
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputError(f"{path}: cannot be read: {' '.join(str(error).split())}") from None
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected the fields of a ColumnMap, such as position: q{{joint}}")
    known = set(ColumnMap.__dataclass_fields__)
    for key in values:
        if key not in known:
            from ..errors import suggest

            raise InputError(f"{path}: no field {key!r}; {suggest(str(key), known, 'there are')}")
    if "position" not in values:
        raise InputError(
            f"{path}: the field position is missing: it says which columns hold the joints' positions"
        )
    signals = values.get("signals")
    try:
        if isinstance(signals, dict):
            values["signals"] = {
                k: SignalColumns(**v) if isinstance(v, dict) else v for k, v in signals.items()
            }
        return ColumnMap(**values)
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: {error}") from None


def open_arm(
    source: str, *, base: str | None, tip: str | None, repair: bool, effort: str | None = None
) -> Arm:
    """The arm, with what its driver's effort is where that is given.

    Raises:
        InputError: neither torque nor current with gains.
        ArmError: no such arm; a gain is zero, or their number is wrong.
    """
    from ..weigh import load_arm, parse_effort

    arm = load_arm(source, base=base, tip=tip, repair_inertia=repair)
    return arm if effort is None else arm.replace(effort=parse_effort(effort))


def picture_png(pixels: Any) -> bytes:
    """A picture as PNG."""
    from ..report import encode_png

    return encode_png(pixels)


def write_file(path: Path, content: bytes) -> None:
    """Write a whole file.

    Raises:
        InputError: it cannot be written.
    """
    try:
        path.write_bytes(content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from None


def mass_text(mass: float, std: float) -> str:
    """A mass and its 95 % interval, in the unit that suits it, e.g. ``250.0 g ± 0.2 g``."""
    from ..report._text import TWO_SIDED_95, mass_unit, rounded

    factor, unit = mass_unit([mass])
    value, half = rounded(mass * factor, TWO_SIDED_95 * std * factor)
    return f"{value} {unit}" + ("" if half == "?" else f" ± {half} {unit}")


def status_words(status: Any) -> str:
    """What a status means, for people."""
    from ..report._text import status_text

    return status_text(int(status)).meaning
