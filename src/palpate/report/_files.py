"""Write a whole file or leave the old one."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path

from palpate.errors import InputError


def write(path: str | PathLike[str], content: str | bytes) -> Path:
    """Write `content` (text as UTF-8 with the line ends it has); a failure leaves what was there.

    Raises:
        InputError: the file cannot be written.
    """
    target = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    try:
        if target.exists() and not target.is_file():  # a pipe or a terminal cannot be replaced
            target.write_bytes(data)
            return target
        part = target.with_name(target.name + ".part")
        try:
            part.write_bytes(data)
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    return target
