"""Enforces who may include whom in core/include/palpate, and that the core keeps to the standard library.

A unit is a header, or a folder of headers (observers, control). A header may include its own folder's
headers, the units that ALLOWED gives it, and the standard library without what a control loop must not touch.
The session's headers may include the core, the whole standard library and POSIX; the core never includes them.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

BASE = {"status", "types", "check", "scalar", "spatial"}
MODEL = BASE | {"arm", "chain", "friction"}
ESTIMATORS = {"conditioner", "observers", "payload", "payload_filter", "wrench", "contact"}

ALLOWED: dict[str, set[str]] = {
    "status": set(),
    "types": {"status"},
    "check": {"status", "types"},
    "scalar": {"status", "types"},
    "spatial": {"status", "types", "scalar"},
    "friction": BASE,
    "filter": BASE,
    "sender_clock": BASE | {"filter"},
    "velocity": BASE | {"filter", "sender_clock"},
    "trajectory": BASE,
    "arm": BASE | {"friction"},
    "chain": BASE | {"friction", "arm"},
    "conditioner": MODEL | {"filter"},
    "phase_currents": BASE,
    "kalman": MODEL,
    "observers": MODEL | {"filter", "kalman"},
    "payload": MODEL | {"filter"},
    "payload_filter": MODEL | {"filter", "kalman", "payload"},
    "tare": MODEL | {"kalman"},
    "wrench": MODEL | {"filter"},
    "contact": MODEL | {"filter", "wrench"},
    "control": MODEL | {"filter", "trajectory"},
    "teleop": BASE,
    "pipeline": MODEL | ESTIMATORS | {"filter"},
}

# Locks, threads, clocks and I/O have no place in a step(); a loop's owner brings its own.
FORBIDDEN_STD = set(
    "atomic barrier chrono condition_variable ctime execution filesystem format fstream future iomanip "
    "iostream latch mutex ostream print random regex semaphore shared_mutex sstream stop_token syncstream "
    "thread".split()
)

POSIX = set(
    "pthread.h sched.h sys/mman.h time.h arpa/inet.h netinet/in.h poll.h sys/socket.h unistd.h".split()
)

INCLUDE = re.compile(r'^\s*#\s*include\s*([<"])([^>"]+)[>"]', re.MULTILINE)


def unit_of(path: str) -> str:
    """`palpate/observers/momentum.hpp` -> `observers`, `palpate/chain.hpp` -> `chain`."""
    return path.removeprefix("palpate/").split("/")[0].removesuffix(".hpp")


def faults(include_root: Path) -> list[str]:
    """One line per include that should not be there."""
    found = []
    for header in sorted((include_root / "palpate").rglob("*.hpp")):
        name = header.relative_to(include_root).as_posix()
        unit = unit_of(name)
        if unit not in ALLOWED:
            found.append(f"{name}: '{unit}' has no row in ALLOWED of scripts/check_includes.py")
            continue
        text = header.read_text(encoding="utf-8")
        if "#pragma once" not in text:
            found.append(f"{name}: no #pragma once")
        for bracket, target in INCLUDE.findall(text):
            if bracket == "<":
                if "/" in target or "." in target or target in FORBIDDEN_STD:
                    found.append(
                        f"{name}: <{target}> is not for the core: standard library, no I/O, clock, lock"
                    )
            elif not target.startswith("palpate/"):
                found.append(f'{name}: "{target}"; write the full path "palpate/..."')
            elif not (include_root / target).is_file():
                found.append(f'{name}: "{target}" does not exist')
            elif unit_of(target) != unit and unit_of(target) not in ALLOWED[unit]:
                choices = sorted(ALLOWED[unit])
                found.append(f"{name}: '{unit}' may not include '{unit_of(target)}' (it may: {choices})")
    return found


def session_faults(session_root: Path, core_root: Path) -> list[str]:
    """The same for the session's headers."""
    found = []
    for header in sorted((session_root / "palpate").rglob("*.hpp")):
        name = header.relative_to(session_root).as_posix()
        text = header.read_text(encoding="utf-8")
        if "#pragma once" not in text:
            found.append(f"{name}: no #pragma once")
        for bracket, target in INCLUDE.findall(text):
            if bracket == "<":
                if ("/" in target or "." in target) and target not in POSIX:
                    found.append(f"{name}: <{target}> is neither of the standard library nor in POSIX here")
            elif not any((root / target).is_file() for root in (session_root, core_root)):
                found.append(f'{name}: "{target}" does not exist; write the full path "palpate/..."')
    return found


def main() -> int:
    top = Path(__file__).resolve().parent.parent
    root, session = top / "core" / "include", top / "session" / "include"
    lines = faults(root) + session_faults(session, root)
    count = len([*root.rglob("*.hpp"), *session.rglob("*.hpp")])
    print("\n".join(lines) if lines else f"includes: {count} headers keep to the layers")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
