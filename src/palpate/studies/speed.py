"""Time per sample of the C++ core beside the same written with Pinocchio, and the dynamics of both beside MuJoCo's.

Builds and runs ``benchmarks/`` of the source tree, which says how it measures.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import robots
from ..arm import Arm, Array
from ..errors import InputError, PalpateError
from . import Progress, Row
from ._figures import colour, drawn
from ._rows import at_most

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CALLS = 300_000
"""of everything that is timed"""
STATES = 1000
"""in which the dynamics are compared, per arm"""
AGREEMENT = 1e-10
"""relative to the largest entry of a state"""
SAME_NUMBERS = 1e-9
"""how far what palpate and the rival find in a job may differ, relative"""
ROUNDING = 10.0
"""and in a job that rounding alone upsets: so many times what the last digit of every position changes"""
_STEPS = 4
_NO_RIVAL = 'Pinocchio was not found: pip install "palpate[bench]"'

Report = Mapping[str, Any]
Dynamics = Callable[[Array, Array, Array, Array], tuple[Array, Array, Array]]
"""(q, dq, ddq, tau) of one state to inverse dynamics (n,), mass matrix (n, n), forward dynamics (n,)"""


# --- the benchmark -----------------------------------------------------------------------------------------------


def source_tree(places: Iterable[Path] | None = None) -> Path:
    """The source tree palpate was imported from, or the one around the working folder.

    Raises:
        InputError: there is none.
    """
    for place in places or (Path(__file__).parents[3], Path.cwd(), *Path.cwd().parents):
        if (place / "benchmarks" / "speed.cpp").is_file() and (place / "CMakeLists.txt").is_file():
            return place
    raise InputError(
        "the speed benchmark is C++ and needs palpate's source tree, a C++20 compiler and cmake: run it inside a clone"
    )


def build(tree: Path) -> Path:
    """Build the benchmark in ``build/bench`` of the tree; its program.

    Raises:
        InputError: cmake is missing.
        PalpateError: it does not build; the output is kept in ``build/bench/build.log``.
    """
    python = Path(sysconfig.get_path("scripts"))
    path = os.pathsep.join([str(python), os.environ.get("PATH", os.defpath)])
    cmake, ninja = (shutil.which(tool, path=path) for tool in ("cmake", "ninja"))
    if cmake is None:
        raise InputError('building the speed benchmark needs cmake: pip install "palpate[bench]"')
    folder = tree / "build" / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    pinocchio = Path(sysconfig.get_path("platlib")) / "cmeel.prefix"
    configure = [
        cmake,
        "-S",
        str(tree),
        "-B",
        str(folder),
        "--log-level=WARNING",
        "-DPALPATE_BUILD_TESTS=OFF",
    ]
    configure += ["-DPALPATE_BUILD_BENCHMARKS=ON", f"-DPython_EXECUTABLE={sys.executable}"]
    configure += [f"-DCMAKE_PREFIX_PATH={pinocchio}"]
    if ninja is not None and not (folder / "CMakeCache.txt").exists():
        configure += ["-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}"]
    jobs = os.environ.get("CMAKE_BUILD_PARALLEL_LEVEL", "2")  # a part of Pinocchio takes a compiler 1.5 GB
    make = [cmake, "--build", str(folder), "--target", "benchmark_speed", "--parallel", jobs]
    with (folder / "build.log").open("w") as log:
        for command in (configure, make):
            if subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, check=False).returncode:
                log.flush()
                raise PalpateError(
                    f"the speed benchmark does not build; the compiler's words are in {log.name}"
                )
    return folder / "benchmarks" / "benchmark_speed"


def measure(program: Path, calls: int) -> dict[str, Any]:
    """What the benchmark says, timing `calls` of everything."""
    done = subprocess.run(
        [str(program), "--json", "--calls", str(calls)], capture_output=True, text=True, check=False
    )
    try:
        report = json.loads(done.stdout)
    except json.JSONDecodeError:
        raise PalpateError(
            f"{program} ended with code {done.returncode} and without figures: {done.stderr.strip()[:500]}"
        ) from None
    assert isinstance(report, dict)
    return report


def timing_rows(report: Report) -> list[Row]:
    """The rows of a report of the benchmark: every bar by the arm that is worst for it."""
    rows: list[Row] = []
    for tasks in zip(*(arm["tasks"] for arm in report["arms"]), strict=True):
        named = {arm["arm"]: task for arm, task in zip(report["arms"], tasks, strict=True)}
        what, required = tasks[0]["what"], tasks[0]["required"]
        own = [task["contestants"][0] for task in tasks]
        note = "; ".join(f"{arm}: {_times(task['contestants'][0])}" for arm, task in named.items())
        for key, name in (("p50", "median"), ("p999", "99.9 % quantile")):
            if required[key] is not None:
                rows.append(at_most(f"{what}, {name}", required[key], max(c[key] for c in own), "us", note))
        if required["ratio"] is not None:
            rows.append(_ratio_row(what, required["ratio"], named))
    return rows + _agreement_rows([task for arm in report["arms"] for task in arm["tasks"]])


def _agreement_rows(tasks: Iterable[Mapping[str, Any]]) -> list[Row]:
    """Both find the same numbers: to 1e-9, or as nearly as rounding lets them."""
    firm, loose = [], []
    whats = (
        "largest difference between what palpate and the rival find in the same samples",
        "the same in jobs that rounding upsets, over what the last digit of every position changes",
    )
    for task in tasks:
        if _rival(task) is None:
            limits = (SAME_NUMBERS, ROUNDING)
            return [
                Row(what, f"<= {limit:g}", "not measured", None, False, "1", _NO_RIVAL)
                for what, limit in zip(whats, limits, strict=True)
            ]
        # JSON has no infinity; what is missing was one
        apart, upset = (math.inf if task[k] is None else task[k] for k in ("disagreement", "sensitivity"))
        if ROUNDING * upset <= SAME_NUMBERS:
            firm.append(apart)
        else:
            loose.append(apart / upset)  # NaN, which is not ok, if both are infinite
    rows = (
        [at_most(whats[0], SAME_NUMBERS, max(firm), "1", f"{len(firm)} jobs, 4096 samples each")]
        if firm
        else []
    )
    if loose:
        rows.append(
            at_most(whats[1], ROUNDING, float(np.max(loose)), "1", f"{len(loose)} jobs, 4096 samples each")
        )
    return rows


def _ratio_row(what: str, required: float, named: Mapping[str, Mapping[str, Any]]) -> Row:
    title = f"{what}: times faster than the same with Pinocchio"
    limit = f">= {required:g}"
    ratios, words = [], []
    for arm, task in named.items():
        rival, own = _rival(task), task["contestants"][0]
        if rival is None:
            return Row(title, limit, "not measured", None, False, "1", _NO_RIVAL)
        ratios.append(rival["best_p50"] / own["best_p50"])
        words.append(f"{arm}: {own['best_p50']:.2f} beside {rival['best_p50']:.2f} us ({rival['how']})")
    note = "medians of the quietest sixteenth of the calls; " + "; ".join(words)
    return Row(title, limit, min(ratios), None, min(ratios) >= required, "1", note)


def _rival(task: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The fastest way without palpate's core; None: there is none in the report."""
    others: list[Mapping[str, Any]] = task["contestants"][1:]
    return min(others, key=lambda c: c["best_p50"], default=None)


def _times(c: Mapping[str, Any]) -> str:
    quietest = f"p50 of the quietest round {c['best_p50']:.2f}"
    return f"p50 {c['p50']:.2f}, p99.9 {c['p999']:.2f}, worst {c['worst']:.0f} us ({quietest})"


def figures(report: Report) -> Mapping[str, Figure]:
    """The medians of the quietest calls as bars, for the last arm."""
    from matplotlib.figure import Figure

    from ..report._style import drawing

    arm = report["arms"][-1]
    tasks = arm["tasks"][::-1]
    y = np.arange(len(tasks))
    with drawing():
        figure = Figure(figsize=(8.4, 4.2), layout="constrained")
        ax = figure.add_subplot()
        ours = [task["contestants"][0]["best_p50"] for task in tasks]
        theirs = [math.nan if (r := _rival(task)) is None else r["best_p50"] for task in tasks]
        for at, values, name, c in ((0.2, ours, "palpate", 0), (-0.2, theirs, "Pinocchio and Eigen", 1)):
            bars = ax.barh(y + at, values, 0.38, color=colour(c), label=name)
            ax.bar_label(
                bars, [f"{v:.2f}" if math.isfinite(v) else "" for v in values], padding=2, fontsize=6.5
            )
        ax.set_xscale("log")
        ax.set_yticks(y, [task["what"] for task in tasks])
        ax.set_xlabel("time per call, median of the quietest sixteenth [us]")
        ax.legend(loc="lower right", frameon=False)
    return {f"Time per call on one core, {arm['arm']}": figure}


# --- the dynamics ------------------------------------------------------------------------------------------------


def pinocchio_dynamics(urdf: str, arm: Arm) -> Dynamics:
    """Pinocchio's reading of a URDF: joints that are not the arm's locked at zero, gravity and rotors as in the arm."""
    pin: Any = importlib.import_module("pinocchio")
    full = pin.buildModelFromXML(urdf)
    locked = [i for i in range(1, full.njoints) if full.names[i] not in arm.joint_names]
    model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
    data = model.createData()
    pin.framesForwardKinematics(model, data, pin.neutral(model))
    base = model.getFrameId(arm.base)
    model.gravity.linear = data.oMf[base].rotation @ arm.gravity
    model.armature = np.array([j.rotor_inertia for j in arm.joints])

    def dynamics(q: Array, dq: Array, ddq: Array, tau: Array) -> tuple[Array, Array, Array]:
        M = np.triu(pin.crba(model, data, q))
        return (
            pin.rnea(model, data, q, dq, ddq).copy(),
            M + np.triu(M, 1).T,
            pin.aba(model, data, q, dq, tau).copy(),
        )

    return dynamics


def mujoco_dynamics(urdf: str, arm: Arm) -> Dynamics:
    """MuJoCo's reading of a URDF: joints that are not the arm's locked at zero, gravity and rotors as in the arm."""
    import mujoco

    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = False
    for joint in [j for j in spec.joints if j.name not in arm.joint_names]:
        spec.delete(joint)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    model.opt.gravity[:] = data.body(arm.base).xmat.reshape(3, 3) @ arm.gravity
    model.dof_armature[:] = [j.rotor_inertia for j in arm.joints]

    def dynamics(q: Array, dq: Array, ddq: Array, tau: Array) -> tuple[Array, Array, Array]:
        data.qpos[:], data.qvel[:], data.qacc[:] = q, dq, ddq
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        torque, bias = np.empty((2, arm.n))
        M = np.empty((arm.n, arm.n))
        acceleration = np.empty((1, arm.n))
        mujoco.mj_rne(model, data, 1, torque)
        mujoco.mj_rne(model, data, 0, bias)
        mujoco.mj_fullM(model, data, M)
        mujoco.mj_solveM(model, data, acceleration, (tau - bias)[None])
        return torque + model.dof_armature * ddq, M, acceleration[0]

    return dynamics


def disagreement(arm: Arm, theirs: Dynamics, states: int = STATES) -> float:
    """Largest difference of inverse dynamics, mass matrix and forward dynamics over random states.

    Relative to the quantity's largest entry in the state.
    """
    rng = np.random.default_rng(11)
    q, dq, ddq = rng.uniform(-3.0, 3.0, (3, states, arm.n))
    size = np.abs(arm.gravity_torque(q)).max()
    tau = rng.uniform(-size, size, (states, arm.n))
    ours = (arm.inverse_dynamics(q, dq, ddq), arm.mass_matrix(q), arm.forward_dynamics(q, dq, tau))
    expected = zip(*(theirs(*state) for state in zip(q, dq, ddq, tau, strict=True)), strict=True)
    worst = []
    for mine, other in zip(ours, expected, strict=True):
        a, b = mine.reshape(states, -1), np.reshape(np.array(other), (states, -1))
        worst.append(np.abs(a - b).max(axis=1) / np.abs(b).max(axis=1))
    return float(np.max(worst))  # NaN stays NaN


def dynamics_rows(states: int) -> list[Row]:
    """How far palpate's dynamics are from those of others, over every reference arm."""
    rows = []
    oracles = (
        ("Pinocchio", "pinocchio", "pin", pinocchio_dynamics),
        ("MuJoCo", "mujoco", "palpate[sim]", mujoco_dynamics),
    )
    names = robots.names()
    for name, module, package, oracle in oracles:
        what = f"dynamics, largest relative difference from {name}'s"
        if importlib.util.find_spec(module) is None:
            note = f'{name} is not installed: pip install "{package}"'
            rows.append(Row(what, f"<= {AGREEMENT:g}", "not measured", None, False, "1", note))
            continue
        found = {}
        for arm_name in names:
            urdf = resources.files("palpate.robots").joinpath(f"{arm_name}.urdf").read_text(encoding="utf-8")
            arm = robots.load(arm_name)
            found[arm_name] = disagreement(arm, oracle(urdf, arm), states)
        worst = max(found, key=lambda n: found[n])
        note = f"{len(names)} arms, {states} states each: tau, M, q''; largest for {worst}"
        rows.append(at_most(what, AGREEMENT, found[worst], "1", note))
    return rows


# --- both --------------------------------------------------------------------------------------------------------


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with a tenth of the calls and states."""
    progress(0, _STEPS, math.inf)
    program = build(source_tree())
    progress(1, _STEPS, math.inf)
    report = measure(program, CALLS // 10 if quick else CALLS)
    progress(_STEPS - 1, _STEPS, math.inf)
    rows = timing_rows(report) + dynamics_rows(STATES // 10 if quick else STATES)
    progress(_STEPS, _STEPS, 0.0)
    load = report["load_before"], report["load_after"]
    notes = [
        "Every single call is timed on one core, with the time of reading the clock taken away. The samples are those "
        "of a moving arm of seven joints at 1 kHz that holds a load half of the time. Quantiles are over all calls "
        "and include what else the machine did. Ratios compare the medians of the quietest sixteenth; palpate and "
        "the rival take turns and are compiled with the same flags. A row gives the arm that is worst for it.",
        "The rival has the same observers and filters on Pinocchio's algorithms and Eigen's fixed-size matrices; of "
        "its ways the fastest counts. Both are built for any x86-64; for the machine's own vector instructions see "
        "benchmarks/rival_kalman.cpp.",
        f"Load average {load[0]} before and {load[1]} after, taken off the core {report['preempted']} times, "
        f"{'kept to one core' if report['pinned'] else 'free to move between cores'}.",
    ]
    return rows, drawn(lambda: figures(report)), notes
