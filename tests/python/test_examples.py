"""Every numbered example runs by itself and prints what its docstring says."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from palpate import weigh
from recordings import recording

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("[0-9][0-9]_*.py"))
NUMBER = re.compile(r"-?\d+\.?\d*")
EXTRAS = {
    "sim": "mujoco",
    "logs": "rosbags",
    "card": "yaml",
    "data": "pooch",
    "identify": "scipy",
    "vision": "cv2",
    "wipe": "shapely",
    "ros": "cyclonedds",
    "teleop": "cryptography",
}


def promised(script: Path) -> list[str]:
    """The indented lines at the end of the docstring."""
    text = ast.get_docstring(ast.parse(script.read_text(encoding="utf-8"))) or ""
    return [line.strip() for line in text.partition("Prints:")[2].strip().splitlines()]


def agree(line: str, expected: str) -> bool:
    """The same words, and numbers within 10 % or two of the last digit: another physics engine may round otherwise."""
    if " ".join(NUMBER.sub("#", line).split()) != " ".join(NUMBER.sub("#", expected).split()):
        return False
    for ours, theirs in zip(NUMBER.findall(line), NUMBER.findall(expected), strict=True):
        digits = len(theirs.partition(".")[2])
        if abs(float(ours) - float(theirs)) > max(0.1 * abs(float(theirs)), 2.5 * 10.0**-digits):
            return False
    return True


def test_there_are_examples_and_each_is_short():
    assert [int(script.name[:2]) for script in EXAMPLES] == list(range(1, len(EXAMPLES) + 1))
    for script in EXAMPLES:
        assert len(script.read_text(encoding="utf-8").splitlines()) <= 60, script.name
        assert promised(script), f"{script.name}: the docstring does not say what it prints"


def quick_or_slow(script: Path):
    slow = "Takes about half a minute" in script.read_text(encoding="utf-8")
    return pytest.param(script, id=script.stem, marks=pytest.mark.slow if slow else ())


@pytest.mark.parametrize("script", map(quick_or_slow, EXAMPLES))
def test_example(script, tmp_path):
    source = script.read_text(encoding="utf-8")
    needed = re.search(r"[Nn]eeds\s+palpate\[([a-z,]+)\]", source)
    for extra in needed[1].split(",") if needed else ():
        if extra != "data" and importlib.util.find_spec(EXTRAS[extra]) is None:
            pytest.skip(f"palpate[{extra}] is not installed")
    environment = dict(os.environ, PYTHONWARNINGS="error")
    if '"lara8"' in source:
        environment["PALPATE_DATA"] = str(recording("lara8_neura_ft", "jogging_linear_mass.csv").parents[1])
    run = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    lines, expected = run.stdout.strip().splitlines(), promised(script)
    assert len(lines) == len(expected), run.stdout
    for line, promise in zip(lines, expected, strict=True):
        assert agree(line, promise), f"{line!r} is not as promised: {promise!r}"


def test_the_arm_of_the_manual_can_be_read_and_rehearsed_with():
    """docs/bring-your-own-arm.md walks through this file."""
    arm = weigh.load_arm(str(Path(__file__).parents[2] / "examples" / "hobby_arm.urdf"))
    assert arm.n == 4 and arm.has_dynamics and arm.tip == "tool0"
    scene = weigh.scene(arm, mass=0.2)
    task = weigh.Task(
        scene=scene,
        start=scene.poses[scene.start],
        poses=(scene.poses[scene.pose],),
        loads=((0.0, 0.2),),
        duration=4.0,
    )
    found = weigh.weigh_trial(weigh.run(task, weigh.make_pipeline(scene.arm)[0]))
    assert found.status.name == "ok" and abs(found.error_percent) < 2.0
