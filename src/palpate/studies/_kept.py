"""Results of long studies, kept in a file so that they can be measured in pieces."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import InputError


class Kept:
    """Results by name, one JSON line each behind a head line; what is put survives the process.

    >>> kept = Kept(Path("results/contacts.state.jsonl"), "arm 3f2a, core 91cc")  # doctest: +SKIP
    >>> kept.get("UR10e 17")  # doctest: +SKIP
    """

    def __init__(self, path: Path | None, made_by: str) -> None:
        """Open or begin.

        Args:
            path: None: nothing is written.
            made_by: what the results depend on; a file that says otherwise is begun anew.

        Raises:
            InputError: the file is something else.
        """
        self._path = path
        self._results: dict[str, Any] = {}
        self.discarded = 0
        """results that another version or arm had made"""
        if path is None:
            return
        head = {"made_by": made_by}
        lines = path.read_text(encoding="utf-8").split("\n") if path.exists() else []
        if lines:
            try:
                before = json.loads(lines[0])["made_by"]
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{path}: expected the kept results of a study; move it away to begin anew"
                ) from None
            whole = [line for line in lines[1:-1] if line]  # what follows the last newline was cut short
            if before == made_by:
                self._results = {r["name"]: r["result"] for r in map(json.loads, whole)}
            else:
                self.discarded = len(whole)
        kept = [head, *({"name": name, "result": result} for name, result in self._results.items())]
        path.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")

    def get(self, name: str) -> Any:
        """A result, or None."""
        return self._results.get(name)

    def put(self, name: str, result: Any) -> None:
        """Keep a result, plain values."""
        self._results[name] = result
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"name": name, "result": result}) + "\n")
