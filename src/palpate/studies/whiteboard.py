"""The whiteboard project's velocity controllers on a simulated iiwa: as published, corrected, and palpate's own."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .. import robots
from .._core import CartesianVelocityOptions, VelocityErrata
from ..arm import Array
from ..control import CartesianTarget, CartesianVelocity
from ..errors import InputError
from ..simulate import Plant
from ..velocity import JointVelocity
from . import Progress, Row, _figures
from ._bench import Work
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ARM = "kuka_lbr_iiwa7"
START = (-0.43, 0.36, 0.31, -1.48, 0.68, 1.49, 0.0)
"""where the real logs start [rad]"""
LOOP = 0.00813
"""period of the controller's loop, as in the real logs [s]"""
SENDER = 0.005
"""period of the robot's messages [s]"""
ENCODER = 2e-6
"""noise of a position [rad]"""
SPEED = 0.05
"""wanted [m/s]"""
SETTLED = 3.0
"""from then on velocities are judged [s]"""
DOWN = (0.0, 0.0, -2.0)
"""the way of the 1-DOF test: a goal so far down that it is not reached [m]"""
WAY = (0.1, -0.15, -0.1)
"""of the 3-D test [m]"""
BETTER = 2.5
"""the velocity must be so many times steadier than as published"""
BOUND = 5.0
"""[N]"""
STOP = 2.0
"""[mm]"""
STEP = 5.0
"""[us]"""
SEEDS = 7
"""of the 1-DOF test"""

Form = Literal["published", "corrected", "palpate"]
Axes = Literal["heading", "per_axis"]

FILTERS: Mapping[str, Mapping[str, Any]] = {
    "plain difference": {"clock": "reader"},
    "moving average of 5": {"clock": "reader", "average": 5},
    "low-pass, tau = 2 h": {"clock": "reader", "time_constant": 2 * LOOP},
    "low-pass, tau = 5 h": {"clock": "reader", "time_constant": 5 * LOOP},
    "low-pass, tau = 10 h": {"clock": "reader", "time_constant": 10 * LOOP},
    "sender's clock": {"clock": "sender"},
}
PLAIN, RECOVERED = "plain difference", "sender's clock"
STEADY: tuple[tuple[Form, str], ...] = (("published", PLAIN), ("corrected", PLAIN), ("palpate", RECOVERED))
"""what the 1-DOF test compares"""


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    form: Form
    axes: Axes
    way: tuple[float, float, float]
    """from the start to the goal, base axes [m]"""
    seconds: float
    velocity: str = PLAIN
    """how it is estimated, see :data:`FILTERS`"""
    held: bool = False
    """somebody holds the arm fast"""
    seed: int = 1
    """of the encoder noise and of where the two clocks stand to each other"""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """A run; arrays have one row per step of the controller. Diverged: it ended early."""

    time: Array
    """(N,) [s]"""
    speed: Array
    """(N,) truth, along the way [m/s]"""
    distance: Array
    """(N,) to the goal, truth [m]"""
    force: Array
    """(N,) norm of the commanded force [N]"""
    gain: Array
    """(N, 3) [1]"""
    control: Array
    """(N, 3) u [1]"""
    diverged: bool = field(default=False)


def options(form: Form, axes: Axes) -> CartesianVelocityOptions:
    """The controller: as published, the same with its errata corrected, or palpate's own."""
    if form == "palpate":
        return CartesianVelocityOptions(axes=axes)
    published = CartesianVelocityOptions.published(axes)
    if form == "published":
        return published
    return CartesianVelocityOptions(**{**published.options(), "errata": VelocityErrata()})


def measure(job: Job) -> Found:
    """Run one job: the robot sends its position every 5 ms, the loop reads it every 8.13 ms, in whole milliseconds."""
    arm = robots.load(ARM)
    rng = np.random.default_rng(job.seed)
    plant = Plant(arm)
    plant.reset(START)
    start = plant.pose()
    start[:3, 3] += start[:3, :3] @ arm.grasp
    goal = start[:3, 3] + np.array(job.way)
    along = np.array(job.way) / np.linalg.norm(job.way)
    controller = CartesianVelocity(arm, LOOP, options(job.form, job.axes))
    estimator = JointVelocity(arm.n, **FILTERS[job.velocity])
    target = CartesianTarget(goal, start[:3, :3], SPEED)
    torque, sent = np.zeros(arm.n), np.array(START)
    send_ns, read_ns = round(SENDER * 1e9), round(LOOP * 1e9)
    next_send, next_read = 0, int(rng.integers(send_ns))
    rows: list[Array] = []
    diverged = False
    while next_read <= job.seconds * 1e9:
        now = min(next_send, next_read)
        if now > plant.time_ns and not job.held:
            try:
                plant.step(torque, now - plant.time_ns)
            except InputError:  # the arm flew away: that is a result
                diverged = True
                break
        if now == next_send:
            next_send += send_ns
            sent = plant.q + ENCODER * rng.standard_normal(arm.n)
        if now == next_read:
            next_read += read_ns
            dq, _ = estimator.step(now // 1_000_000 * 1_000_000, sent)
            command = controller.step(target, sent, dq)
            torque = command.torque
            J = arm.jacobian(plant.q[None], arm.grasp)[0, :3]
            x = arm.forward_kinematics(plant.q[None])[0]
            off = goal - (x[:3, 3] + x[:3, :3] @ arm.grasp)
            abag = np.array(controller.abag)
            rows.append(
                np.concatenate(
                    (
                        [
                            now * 1e-9,
                            along @ J @ plant.dq,
                            np.linalg.norm(off),
                            np.linalg.norm(command.force),
                        ],
                        abag[:, 2],
                        abag[:, 3],
                    )
                )
            )
    table = np.array(rows)
    now_s, speed, distance, force = table[:, :4].T.copy()
    return Found(now_s, speed, distance, force, table[:, 4:7], table[:, 7:], diverged)


def step_time(repeats: int = 7, rows: int = 4000) -> tuple[float, float]:
    """Processor time of one step of palpate's controller while pressing, median and worst of so many repeats [us]."""
    arm = robots.load(ARM)
    rng = np.random.default_rng(0)
    q = np.array(START) + 0.2 * rng.standard_normal((rows, arm.n))
    dq = 0.2 * rng.standard_normal((rows, arm.n))
    force = np.array([0.0, 0.0, 3.0]) + rng.standard_normal((rows, 3))
    pose = arm.forward_kinematics(np.array(START)[None])[0]
    target = CartesianTarget(pose[:3, 3], pose[:3, :3], SPEED, normal_force=3.0)
    controller = CartesianVelocity(arm, 0.004)
    times = []
    for _ in range(repeats):
        begin = time.thread_time()
        controller.run(target, q, dq, force)
        times.append(1e6 * (time.thread_time() - begin) / rows)
    return float(np.median(times)), max(times)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with runs of 6 s."""
    seconds, long = (6.0, 6.0) if quick else (12.0, 30.0)
    line: dict[tuple[Form, str], Job] = {
        (form, what): Job(form, "heading", DOWN, 6.0 if quick else 8.0, what)
        for form in ("published", "corrected", "palpate")
        for what in FILTERS
    }
    space: dict[Form, Job] = {
        form: Job(form, "per_axis", WAY, long, RECOVERED if form == "palpate" else PLAIN)
        for form in ("published", "corrected", "palpate")
    }
    goal: dict[Form, Job] = {
        form: Job(form, "heading", WAY, long, RECOVERED if form == "palpate" else PLAIN)
        for form in ("published", "corrected", "palpate")
    }
    held: dict[Form, Job] = {
        form: Job(form, "per_axis", WAY, seconds, held=True) for form in ("published", "corrected", "palpate")
    }
    jobs = [*line.values(), *space.values(), *goal.values(), *held.values()]
    again = [
        [Job(form, "heading", DOWN, 8.0, what, seed=seed) for form, what in STEADY]
        for seed in range(2, 3 if quick else SEEDS + 1)
    ]
    jobs += [job for trio in again for job in trio]
    with Work(progress, len(jobs)) as work:
        found = dict(zip(jobs, work.map(measure, jobs), strict=True))
    rows = _steady_rows(
        [[found[line[key]] for key in STEADY], *([found[job] for job in trio] for trio in again)]
    )
    rows += _line_rows({key: found[job] for key, job in line.items()})
    rows += _space_rows(
        {form: found[job] for form, job in space.items()}, {form: found[job] for form, job in held.items()}
    )
    rows += _goal_rows(
        {form: found[job] for form, job in goal.items()}, {form: found[job] for form, job in space.items()}
    )
    rows += _filter_rows({key: found[job] for key, job in line.items()})
    rows += _time_rows()
    notes = [
        f"Simulated LBR iiwa 7 in MuJoCo, read as the real one was: positions sent every {1e3 * SENDER:g} ms, looked "
        f"at every {1e3 * LOOP:g} ms, stamped in whole milliseconds. Published and corrected: ABAG of the whiteboard "
        "project at 8 ms. Orientation is held in all forms (the project did not), so that only the errata differ. "
        "Corrected: gain in [0, 1], signed speed, norm bounded, a goal to come back to.",
        "1-DOF: one ABAG along a heading straight down, 0.05 m/s. 3-D: one ABAG per axis, 0.21 m to go. Held: somebody "
        "holds the arm fast, so every ABAG runs into its bound.",
        "palpate: smooth sign within 0.05 m/s and a least gain of 0.3, because an arm without friction has no damping "
        "of its own.",
    ]
    return (
        rows,
        _figures.drawn(
            lambda: _draw(
                {key: found[job] for key, job in line.items()},
                {form: found[job] for form, job in goal.items()},
            )
        ),
        notes,
    )


def _std(f: Found) -> float:
    return math.inf if f.diverged else float(f.speed[f.time > SETTLED].std())


def _mean(f: Found) -> float:
    return float(f.speed[f.time > SETTLED].mean())


def _steady_rows(trios: Sequence[Sequence[Found]]) -> list[Row]:
    rows = []
    forms = ("gain and sign corrected, same velocity estimate", "palpate's form on the sender's clock")
    for i, text in enumerate(forms, start=1):
        ratios = [_std(trio[0]) / _std(trio[i]) for trio in trios]
        middle = float(np.median(ratios))
        note = f"standard deviation {np.median([_std(t[0]) for t in trios]):.4f} against "
        note += f"{np.median([_std(t[i]) for t in trios]):.4f} m/s; median of {len(trios)} seeds, "
        note += f"{min(ratios):.1f} to {max(ratios):.1f}"
        what = f"1-DOF: velocity steadier than as published, {text}"
        rows.append(Row(what, f">= {BETTER}", middle, None, bool(middle >= BETTER), "x", note))
    return rows


def _line_rows(line: Mapping[tuple[Form, str], Found]) -> list[Row]:
    published, corrected = line["published", PLAIN], line["corrected", PLAIN]
    ours = line["palpate", RECOVERED]
    rows = []
    for form, f in (("published", published), ("corrected", corrected), ("palpate, sender's clock", ours)):
        rows.append(told(f"1-DOF: mean velocity, {form}", _mean(f), "m/s", beside=SPEED))
    least = min(float(f.gain.min()) for (form, _), f in line.items() if form != "published")
    rows.append(
        Row(
            "least ABAG gain, corrected and palpate, all runs of the 1-DOF test",
            ">= 0",
            least,
            None,
            bool(least >= 0.0),
            "",
            f"published {float(published.gain.min()):.3f}",
        )
    )
    return rows


def _space_rows(space: Mapping[Form, Found], held: Mapping[Form, Found]) -> list[Row]:
    rows = []
    for form in ("corrected", "palpate"):
        most = max(float(space[form].force.max()), float(held[form].force.max()))
        rows.append(
            at_most(f"3-D: largest commanded force, {form}", BOUND, most, "N", "moving, and held fast")
        )
    most = float(held["published"].force.max())
    rows.append(
        told(
            "3-D: largest commanded force, published",
            most,
            "N",
            f"held fast; moving {float(space['published'].force.max()):.2f} N",
            beside=round(math.sqrt(3.0) * BOUND, 2),
        )
    )
    for form, f in space.items():
        window = (f.time > SETTLED - 1.5) & (f.distance > 0.1)
        spread = float(f.speed[window].std()) if window.any() else math.nan
        rows.append(told(f"3-D: standard deviation of the velocity on the way, {form}", spread, "m/s"))
    return rows


def _goal_rows(goal: Mapping[Form, Found], space: Mapping[Form, Found]) -> list[Row]:
    rows = []
    for axes, runs in (("one ABAG", goal), ("three ABAGs", space)):
        for form, f in runs.items():
            end = f.distance[f.time > f.time[-1] - 1.0]
            value = 1e3 * float(end.max())
            nearest = 1e3 * float(f.distance.min())
            text = f"goal missed by, last second of {f.time[-1]:.0f} s, {axes}, {form}"
            note = f"nearest {nearest:.1f} mm"
            rows.append(
                at_most(text, STOP, value, "mm", note)
                if form != "published" and axes == "three ABAGs"
                else told(text, value, "mm", note)
            )
    return rows


def _filter_rows(line: Mapping[tuple[Form, str], Found]) -> list[Row]:
    rows = []
    for (form, what), f in line.items():
        if form == "published":
            continue
        late = f.time > SETTLED
        jitter = math.nan if f.diverged else float(np.diff(f.control[late, 0]).std())
        note = "the arm flies away" if f.diverged else f"velocity {_mean(f):.4f} ± {_std(f):.4f} m/s"
        rows.append(told(f"jitter of the control signal per step, {form}, {what}", jitter, "", note))
    return rows


def _time_rows() -> list[Row]:
    median, worst = step_time()
    return [
        at_most(
            "one step of the Cartesian velocity controller, pressing",
            STEP,
            median,
            "us",
            f"processor time; worst repeat {worst:.2f}",
        )
    ]


def _draw(line: Mapping[tuple[Form, str], Found], goal: Mapping[Form, Found]) -> dict[str, Figure]:
    names: dict[str, tuple[Form, str]] = {
        "published": ("published", PLAIN),
        "corrected": ("corrected", PLAIN),
        "palpate": ("palpate", RECOVERED),
    }
    speed = {name: (line[key].time, line[key].speed) for name, key in names.items()}
    gain = {name: (line[key].time, line[key].gain[:, 0]) for name, key in names.items()}
    return {
        "1-DOF: velocity along the heading": _figures.curves(
            speed, "velocity [m/s]", level=(SPEED, "wanted")
        ),
        "1-DOF: ABAG gain": _figures.curves(gain, "gain", level=(0.0, "0")),
        "Control signal by velocity filter, corrected": _figures.curves(
            {what: (line["corrected", what].time, line["corrected", what].control[:, 0]) for what in FILTERS},
            "u",
        ),
        "Behaviour at the goal, one ABAG": _figures.curves(
            {form: (f.time, 1e3 * f.distance) for form, f in goal.items()}, "distance [mm]"
        ),
    }
