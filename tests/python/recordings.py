"""Recordings of real robots for the tests: from the folder PALPATE_DATA names, or ../shared/data beside the clone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_folder() -> Path:
    """The folder of all data sets; skips the test where there is none."""
    folder = Path(os.environ.get("PALPATE_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recorded data in {folder} (set PALPATE_DATA)")
    return folder.resolve()


def recording(folder: str, file: str) -> Path:
    """One file of a data set; skips the test where it is not there."""
    path = data_folder() / folder / file
    if not path.is_file():
        pytest.skip(f"no recorded data {path} (set PALPATE_DATA)")
    return path
