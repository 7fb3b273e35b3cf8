"""Emulated arms of the tests as peers of a study: modules of ``tests/python`` in a source tree."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from ..errors import InputError

_FOLDER = Path(__file__).parents[3] / "tests" / "python"


def peer(name: str) -> Any:
    """The module of that name.

    Raises:
        InputError: palpate does not run from a source tree.
    """
    for folder in (_FOLDER, Path.cwd() / "tests" / "python"):
        if (folder / f"{name}.py").is_file():
            if str(folder) not in sys.path:
                sys.path.append(str(folder))
            return importlib.import_module(name)
    raise InputError("this study needs the emulated arms of palpate's source tree: run it inside a clone")
