"""Other slaves and scenes of the teleoperation study: an industrial arm felt by its phase currents, a leader arm and
its twin, a peg in a hole, objects to lift."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..arm import Array
from ..teleop.figures import SETTLED, transparency
from ..teleop.masters import Hand
from ..teleop.scenes import slave_arm, smooth
from ..teleop.servo_arms import ServoSlave, joint_path
from ..teleop.session import Run
from ..teleop.setups import JOINT_HAND, build
from . import Row
from ._rows import at_most, told

ABB, SO101, IIWA = "abb_irb2400_16", "so101", "kuka_lbr_iiwa14"
SPEED = 0.25
"""of the hand in free motion [m/s]"""
PAYLOAD = 16.0
"""of the IRB 2400-16 [kg]"""
BAR, PAPER = 2.4, 24.2
"""of the force felt, and the paper's error [N]"""
WALLS = ((1000.0, 0.03), (2000.0, 0.03), (5000.0, 0.02))
"""stiffness [N/m], and how far behind its surface the hand goes [m]"""
SO101_WALL = (500.0, 0.03)
HOLE = 0.03
"""below the start of the scene the peg's tip meets the block [m]"""
_TOUCH = 1.0
"""a true force that is a touch [N]"""


def circle(radius: float) -> Callable[[float], Array]:
    """The hand's way in free motion, at SPEED once it has begun."""

    def place(time: float) -> Array:
        t = max(0.0, time - SETTLED)
        angle = SPEED / radius * t
        return smooth(t / 1.5) * radius * np.array([math.sin(angle), math.cos(angle), 0.0])

    return place


@dataclass(frozen=True, slots=True)
class Contact:
    """Force felt against the true one, both at the tool [N]."""

    held: float
    """mean distance over tenths of a second in which the tool rests and presses [N]"""
    whole: float
    """mean distance of every sample with a touch, delay and what is below the threshold included [N]"""
    estimated: float
    """the same of the estimate [N]"""
    force: float
    """true force that is held [N]"""


def contact(run: Run, force_scale: float) -> Contact:
    """Measure it."""
    true = np.linalg.norm(run.true, axis=1)
    touched = true > _TOUCH
    felt = run.felt / force_scale
    rest = touched & (np.linalg.norm(run.tip_velocity, axis=1) < 3e-3) & (true > 0.7 * true.max())
    rows = np.flatnonzero(rest)
    rows = rows[: len(rows) // 100 * 100]
    each = (felt - run.true)[rows].reshape(-1, 100, 3).mean(axis=1)
    return Contact(
        float(np.linalg.norm(each, axis=1).mean()) if len(each) else math.nan,
        float(np.linalg.norm(felt - run.true, axis=1)[touched].mean()),
        float(np.linalg.norm(run.estimated - run.true, axis=1)[touched].mean()),
        float(true[rows].mean()) if len(rows) else math.nan,
    )


def industrial(quick: bool, done: Callable[[], None]) -> list[Row]:
    """The ABB."""
    scale = slave_arm(ABB).force_scale
    free_run = build(None, arm=ABB, hand=Hand(wish=circle(0.1))).run(seconds=4.5 if quick else 10.0)
    free = transparency(free_run, force_scale=scale)
    done()
    rows = [
        at_most(
            f"ABB, hand at {SPEED:g} m/s: the tool away from where the hand points, at most",
            2.0,
            1e3 * free.tracking,
            "mm",
            f"motion scale 2, tool at up to {free.speed:.2f} m/s; 0.3 mm of it is play against the hand's tremor",
        ),
        at_most(
            "ABB, free motion: force felt, as a force at the tool, at most",
            0.01 * PAYLOAD * 9.81,
            float(np.linalg.norm(free_run.felt, axis=1)[round(SETTLED * 1e3) :].max()) / scale,
            "N",
            f"1 % of {PAYLOAD:g} kg; force scale {scale:g}, the device pushes with {free.free_force:.2f} N at most",
        ),
        told(
            "ABB, free motion: estimated force, mean of |F|",
            float(np.linalg.norm(free_run.estimated[round(SETTLED * 1e3) :], axis=1).mean()),
            "N",
            "phase currents and encoders alone; below the threshold of three standard deviations nothing is felt",
        ),
    ]
    for K, press in WALLS[1:2] if quick else WALLS:
        run = build("wall", arm=ABB, stiffness=K, press=press).run(seconds=5.5 if quick else None)
        t, c = transparency(run, force_scale=scale, stiffness=K), contact(run, scale)
        done()
        rows += [
            at_most(
                f"ABB, wall of {K:g} N/m: force felt off the true one while held, mean",
                BAR,
                c.held,
                "N",
                f"at {c.force:.0f} N; the paper: {PAPER:g} N",
            ),
            told(
                f"ABB, wall of {K:g} N/m: the same over every sample of the touch",
                c.whole,
                "N",
                f"pressing, delay and what is below the threshold included; the estimate {c.estimated:.2f} N",
                beside=f"<= {BAR:g}",
            ),
            told(
                f"ABB, wall of {K:g} N/m: felt after the touch",
                1e3 * t.onset,
                "ms",
                "two low-passes are 21 ms late, and a force is felt from three standard deviations on",
            ),
        ]
    return rows


def leader_and_follower(quick: bool, done: Callable[[], None]) -> list[Row]:
    """The SO-101."""
    chosen = slave_arm(SO101)
    wish = joint_path(chosen.arm, chosen.q, circle(0.06), 4.5 if quick else 8.0)
    setup = build(None, arm=SO101, hand=Hand(wish=wish, **JOINT_HAND))
    free = setup.run(seconds=4.5 if quick else 8.0)
    done()
    slave = setup.slave
    assert isinstance(slave, ServoSlave)
    begin = round(SETTLED * 1e3)
    tip, wanted = (np.array([slave.tip(q) for q in part[begin:]]) for part in (free.tip, free.wanted))
    K, press = SO101_WALL
    run = build("wall", arm=SO101, stiffness=K, press=press).run(seconds=5.5 if quick else None)
    done()
    size = np.square(run.true).sum(axis=1)
    rest = (np.abs(run.tip_velocity).max(axis=1) < 0.02) & (size > 0.5 * size.max())
    ratio = {
        name: float(np.abs((part * run.true).sum(axis=1)[rest] / size[rest] - 1.0).mean())
        for name, part in (("felt", run.felt), ("estimated", run.estimated))
    }
    return [
        at_most(
            f"SO-101 led by its twin, hand at {SPEED:g} m/s: the tool away from where the leader's is, at most",
            2.0,
            1e3 * float(np.linalg.norm(tip - wanted, axis=1).max()),
            "mm",
            f"joints {1e3 * float(np.abs(free.tip - free.wanted)[begin:].max()):.1f} mrad: encoders of 12 bit have "
            "steps of 1.5 mrad, the bus 250 Hz, so that 1 mrad is out of reach",
        ),
        at_most(
            "SO-101, free motion: force felt at the grip, at most",
            0.3,
            float(max(np.linalg.norm(slave.at_tip(q, f)) for q, f in zip(free.tip, free.felt, strict=True))),
            "N",
            "what the leader's motors add; its own gears' friction is felt as well",
        ),
        at_most(
            f"SO-101, wall of {K:g} N/m: torque felt off the true one while held, mean",
            5.0,
            100.0 * ratio["felt"],
            "%",
            f"the estimate {100.0 * ratio['estimated']:.0f} %, at {math.sqrt(float(size[rest].mean())):.2f} N m: "
            "at rest the gears carry 0.056 N m and 21 % of the load by friction, which no current shows",
        ),
    ]


def scenes(quick: bool, done: Callable[[], None]) -> list[Row]:
    """A peg in a hole, objects lifted."""
    rows = []
    for arm, name in ((IIWA, "iiwa"),) if quick else ((IIWA, "iiwa"), (ABB, "ABB")):
        setup = build("peg", arm=arm)
        run = setup.run(seconds=10.0)
        done()
        limit = 8.5 / setup.follower.force_scale
        rows += [
            Row(
                f"{name}, peg in a hole 1.5 mm wider on each side: inserted by",
                ">= 25",
                1e3 * float(run.tip[0, 2] - HOLE - run.tip[:, 2].min()),
                None,
                bool(run.tip[0, 2] - HOLE - run.tip[:, 2].min() >= 0.025),
                "mm",
                "the hand misses the hole by 8 mm at first and slides into it",
            ),
            at_most(
                f"{name}, peg in a hole: largest true force",
                limit,
                float(np.linalg.norm(run.true, axis=1).max()),
                "N",
                "what the device can show",
            ),
        ]
        if quick:
            continue
        run = build("lift", arm=arm).run()
        done()
        for time, true, mass, std in run.held:
            after = (run.time > time + 0.5) & (run.time < time + 3.0)
            rows.append(
                told(
                    f"{name}, lifts {true:g} kg that nobody knows: weighed",
                    mass,
                    "kg",
                    f"± {1.96 * std:.2f} kg (95 %); of {9.81 * true:.0f} N the hand then feels "
                    f"{float(np.linalg.norm(run.felt[after], axis=1).mean()) / setup.follower.force_scale:.1f} N",
                    beside=true,
                )
            )
    return rows


JOBS, QUICK_JOBS = 1 + len(WALLS) + 2 + 4, 5
"""runs in all"""


def rows(quick: bool, done: Callable[[], None]) -> list[Row]:
    """Every row; `done` is called after each run."""
    return [*industrial(quick, done), *leader_and_follower(quick, done), *scenes(quick, done)]
