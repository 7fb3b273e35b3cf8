"""``palpate doctor``: what this machine has, and what to do about what it has not."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import typer

from ._common import Json, console, emit, examples

#: extra: modules it brings, what for
_EXTRAS = {
    "cli": (("typer", "rich"), "the command palpate"),
    "card": (("pydantic", "yaml"), "arms as cards"),
    "sim": (("mujoco",), "simulated arms"),
    "report": (("matplotlib",), "reports and pictures"),
    "logs": (("rosbags", "lz4"), "compressed bags, any ROS 2 message"),
    "identify": (("scipy", "threadpoolctl"), "identification"),
    "cad": (("trimesh",), "inertias from meshes"),
    "teleop": (("mujoco", "cryptography"), "teleoperation over a network"),
    "gamepad": (("evdev",), "gamepads and SpaceMice that lead an arm"),
    "dynamixel": (("dynamixel_sdk",), "arms of Dynamixel servos"),
    "feetech": (("scservo_sdk",), "arms of Feetech servos"),
    "ur": (("rtde_control", "rtde_receive"), "Universal Robots arms (Python up to 3.12)"),
    "ros": (("cyclonedds", "yaml"), "ROS 2 without a ROS installation"),
    "ros-zenoh": (("cyclonedds", "zenoh"), "the same over Zenoh"),
    "view": (("viser", "yaml"), "the live page in a browser"),
    "xacro": (("xacro",), "arms from .xacro files"),
    "data": (("pooch",), "palpate data get"),
    "vision": (("cv2",), "whiteboards in pictures"),
    "wipe": (("shapely", "scipy", "cv2", "statemachine"), "wiping a board: strokes, ink, scene, the job"),
}
_DRAW = (
    "from palpate.simulate import Plant; from palpate import robots; "
    "print(Plant(robots.load('justina_left_arm')).render(64, 48).std() > 0)"
)


class Finding(NamedTuple):
    """One thing that was looked at."""

    what: str
    ok: bool | None
    """None: neither good nor bad"""
    found: str
    advice: str = ""


def add(app: typer.Typer) -> None:
    """Make the verb known."""
    app.command(
        "doctor",
        help="Look at this machine: what works, what is missing.\n\n"
        "Versions, extras, compiler, drawing, real-time limits. The exit code is 0 whatever is found.",
        epilog=examples("palpate doctor", "palpate doctor --json"),
    )(run)


def run(json: Json = False) -> int:
    """Look around."""
    from .. import __version__

    findings = [
        Finding("palpate", True, __version__),
        Finding("python", sys.version_info >= (3, 11), f"{platform.python_version()}, {sys.executable}"),
        Finding(
            "machine",
            None,
            f"{platform.system()} {platform.release()}, {platform.machine()}, {os.cpu_count()} cores",
        ),
        Finding("numpy", True, metadata.version("numpy")),
        _core(),
        *(_extra(name, modules, use) for name, (modules, use) in _EXTRAS.items()),
        _drawing(),
        _compiler(),
        *_real_time(),
    ]
    if json:
        emit({"findings": [f._asdict() for f in findings]})
        return 0
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(style="dim", no_wrap=True)
    table.add_column(overflow="fold")
    marks = {True: Text("ok", style="green"), False: Text("no", style="bold red"), None: Text("")}
    for f in findings:
        text = Text(f.found)
        if f.advice:
            text.append(f"\n{f.advice}", style="yellow")
        table.add_row(marks[f.ok], f.what, text)
    console().print(table)
    return 0


def _core() -> Finding:
    """The C++ core, and how long one sample of the reference arm takes."""
    import numpy as np

    from .. import Log, Pipeline, _core, robots

    arm = robots.load("justina_left_arm")
    count = 2000
    log = Log(
        time_ns=np.arange(count) * 4_000_000,
        position=np.zeros((count, arm.n)),
        effort=np.zeros((count, arm.n)),
        joint_names=arm.joint_names,
    )
    pipeline = Pipeline(arm)
    pipeline.run(log[:100])
    begin = time.perf_counter()
    pipeline.run(log)
    each = (time.perf_counter() - begin) / count
    path = Path(str(_core.__file__))
    size = path.stat().st_size / 1024.0
    return Finding(
        "C++ core",
        True,
        f"{_core.__version__}, {path.name}, {size:.0f} kB; weighs a sample of 7 joints in {1e6 * each:.1f} µs",
    )


def _found(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def _extra(name: str, modules: tuple[str, ...], use: str) -> Finding:
    missing = [m for m in modules if not _found(m)]
    if missing:
        return Finding(
            f"extra {name}", False, f"no {', '.join(missing)}: {use}", f'pip install "palpate[{name}]"'
        )
    providers = metadata.packages_distributions()
    versions = []
    for module in modules:
        package = next(iter(providers.get(module, ())), module)
        try:
            versions.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:  # found beside the program, not installed
            versions.append(module)
    return Finding(f"extra {name}", True, f"{', '.join(versions)}: {use}")


def _drawing() -> Finding:
    """Drawing may end the process where OpenGL is broken, so another one tries."""
    if importlib.util.find_spec("mujoco") is None:
        return Finding("drawing", None, "not tried: needs the extra sim")
    try:
        done = subprocess.run(
            [sys.executable, "-c", _DRAW], capture_output=True, text=True, timeout=60, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding("drawing", False, "no picture within 60 s", "try MUJOCO_GL=egl or MUJOCO_GL=osmesa")
    if done.returncode == 0 and done.stdout.strip() == "True":
        return Finding("drawing", True, f"works (MUJOCO_GL={os.environ.get('MUJOCO_GL') or 'not set'})")
    lines = done.stderr.strip().splitlines()
    return Finding(
        "drawing",
        False,
        lines[-1][:200] if lines else f"ended with code {done.returncode}",
        "reports come without a picture; install libegl1 or libosmesa6, or set MUJOCO_GL=egl or osmesa",
    )


def _compiler() -> Finding:
    for name in (os.environ.get("CXX", ""), "c++", "g++", "clang++"):
        path = shutil.which(name) if name else None
        if path is None:
            continue
        done = subprocess.run([path, "--version"], capture_output=True, text=True, timeout=20, check=False)
        first = (done.stdout.splitlines() or [""])[0]
        return Finding("C++ compiler", True, f"{first}, {path}")
    return Finding(
        "C++ compiler",
        None,
        "none",
        "needed only to build palpate or to use its core from C++: apt install g++",
    )


def _real_time() -> list[Finding]:
    """Whether a control loop may ask for priority and locked memory."""
    if sys.platform != "linux":
        return [Finding("real time", None, f"not looked at on {sys.platform}")]
    import resource

    def limit(which: int) -> str:
        value = resource.getrlimit(which)[1]
        return "unlimited" if value == resource.RLIM_INFINITY else str(value)

    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[1]
    allowed = priority != 0 or os.geteuid() == 0
    file = Path("/sys/kernel/realtime")
    preempt = file.exists() and file.read_text().strip() == "1"
    advice = "a 1 kHz loop wants priority: rtprio 90 and memlock unlimited for your user in /etc/security/limits.conf"
    return [
        Finding(
            "real time",
            None,
            f"priority up to {limit(resource.RLIMIT_RTPRIO)}{' (root: any)' if os.geteuid() == 0 else ''}, "
            f"locked memory {limit(resource.RLIMIT_MEMLOCK)}, PREEMPT_RT {'yes' if preempt else 'no'}",
            "" if allowed else advice,
        )
    ]
