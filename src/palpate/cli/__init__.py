"""The command ``palpate``: one module per verb, all of it a thin cover over the package.

Exit codes: 0 done; 1 a row of a study misses, or a replay differs; 2 wrong input; 70 a bug in palpate; 130 stopped by
Ctrl-C.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

from ..errors import MissingExtraError, PalpateError

WRONG_INPUT, BUG, STOPPED = 2, 70, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        argv: arguments without the program's name; None: those of the process.

    Returns:
        the exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments or os.environ.get("PALPATE_DEBUG", "") not in ("", "0")
    arguments = [a for a in arguments if a != "--debug"]
    try:
        from ._app import command

        result = command().main(arguments, prog_name="palpate", standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except KeyboardInterrupt:
        return STOPPED
    except BrokenPipeError:
        # the reader has seen enough; nothing is left to tell it, not even at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:  # noqa: BLE001 the last place that can tell a person what happened
        if debug:
            traceback.print_exc()
        return _complain(error, debug)


def _complain(error: Exception, debug: bool) -> int:
    """Say in one line what is wrong; the exit code."""
    if isinstance(error, ImportError) and (error.name or "").split(".")[0] in ("typer", "rich", "click"):
        error = MissingExtraError("cli", "the command palpate")
    usage = getattr(error, "format_message", None)  # of typer's own errors, in whichever module they live
    if isinstance(error, PalpateError) or usage is not None:
        text = " ".join(str(usage() if usage is not None else error).split())
        print(f"palpate: {text}", file=sys.stderr)
        return WRONG_INPUT
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    place = (
        "" if trace is None else f" ({os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno})"
    )
    text = " ".join(str(error).split())
    print(f"palpate: internal error: {type(error).__name__}: {text}{place}", file=sys.stderr)
    if not debug:
        print(
            "This is a bug in palpate. Please report it with the command line and what --debug prints.",
            file=sys.stderr,
        )
    return BUG
