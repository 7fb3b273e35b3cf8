"""Other slaves and scenes of the teleoperation study: an industrial arm felt by its phase currents, a leader arm and
its twin, a peg in a hole, objects to lift."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ..teleop.channel import Faults
from ..teleop.figures import SETTLED, transparency
from ..teleop.scenes import slave_arm
from ..teleop.servo_arms import BUS_RATE, LOAD_FRICTION, ServoSlave, SimulatedLeader
from ..teleop.session import Run, Wish
from ..teleop.setups import build
from ..teleop.slaves import RATE
from . import Row
from ._rows import at_most, told
from ._teleop_hands import JUDGED, SPEED, Draw, free, pressing

ABB, SO101, IIWA = "abb_irb2400_16", "so101", "kuka_lbr_iiwa14"
PAYLOAD = 16.0
"""of the IRB 2400-16 [kg]"""
BAR, PAPER = 2.4, 24.2
"""of the force felt, and the paper's error [N]"""
WALLS = ((1000.0, 0.03), (2000.0, 0.03), (5000.0, 0.02))
"""stiffness [N/m], and how far behind its surface the hand goes [m]"""
SO101_WALLS = ((400.0, 0.03), (700.0, 0.025))
HIDDEN = 100.0 * LOAD_FRICTION / math.sqrt(3.0)
"""of a torque that geared servos hold at rest, Coulomb friction aside, by the standard deviation of a friction that may
be anything within its bounds: no estimator that knows only the present is better [%]"""
HOLE = 0.03
"""below the start of the scene the peg's tip meets the block [m]"""
_TOUCH = 1.0
"""a true force that is a touch [N]"""


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
    """The ABB, by hands that nothing was chosen by; the worst counts."""
    chosen = slave_arm(ABB)
    scale, seeds = chosen.force_scale, JUDGED[:1] if quick else JUDGED
    begin = round(SETTLED * 1e3)
    tracking, speed, felt, pushes, estimated = [], [], [], [], []
    for seed in seeds:
        draw = free(chosen, seed, 0.1, 4.5 if quick else 7.0)
        run = build(None, arm=ABB, hand=draw.hand, seed=seed).run(seconds=draw.seconds)
        t = transparency(run, force_scale=scale)
        tracking.append(1e3 * t.tracking)
        speed.append(t.speed)
        felt.append(float(np.linalg.norm(run.felt[begin:], axis=1).max()) / scale)
        pushes.append(t.free_force)
        estimated.append(float(np.linalg.norm(run.estimated[begin:], axis=1).mean()))
        done()
    worst = f"worst of {len(seeds)} hands"
    rows = [
        at_most(
            f"ABB, hand at {SPEED:g} m/s: the tool away from where the hand points, at most",
            2.0,
            max(tracking),
            "mm",
            f"{worst}; motion scale 2, tool at up to {max(speed):.2f} m/s; 0.3 mm of it is play against the hand's "
            "tremor",
        ),
        at_most(
            "ABB, free motion: force felt, as a force at the tool, at most",
            0.01 * PAYLOAD * 9.81,
            max(felt),
            "N",
            f"{worst}; 1 % of {PAYLOAD:g} kg; force scale {scale:g}, the device pushes with {max(pushes):.2f} N at "
            "most",
        ),
        told(
            "ABB, free motion: estimated force, mean of |F|",
            max(estimated),
            "N",
            "phase currents and encoders alone; below the threshold of three standard deviations nothing is felt",
        ),
    ]
    for K, press in WALLS[1:2] if quick else WALLS:
        found, onset, stiffness = [], [], []
        for seed in seeds:
            draw = pressing(chosen, seed, K, press)
            stiffness.append(draw.stiffness)
            run = build(
                "wall", arm=ABB, stiffness=draw.stiffness, press=press, hand=draw.hand, seed=seed
            ).run(seconds=draw.seconds)
            found.append(contact(run, scale))
            onset.append(transparency(run, force_scale=scale, stiffness=draw.stiffness).onset)
            done()
        walls = f"ABB, walls of {min(stiffness):.0f} to {max(stiffness):.0f} N/m"
        each = ", ".join(f"{c.held:.2f}" for c in found)
        rows += [
            at_most(
                f"{walls}: force felt off the true one while held, mean",
                BAR,
                _largest(c.held for c in found),
                "N",
                f"{worst} and places: {each} N, at {min(c.force for c in found):.0f} to "
                f"{max(c.force for c in found):.0f} N; the paper: {PAPER:g} N",
            ),
            told(
                f"{walls}: the same over every sample of the touch",
                _largest(c.whole for c in found),
                "N",
                "pressing, delay and what is below the threshold included; the estimate "
                f"{_largest(c.estimated for c in found):.2f} N",
                beside=f"<= {BAR:g}",
            ),
            at_most(
                f"{walls}: felt after the touch",
                20.0,
                1e3 * _largest(onset),
                "ms",
                "two low-passes are 21 ms late, and a force is felt from three standard deviations on",
            ),
        ]
    return rows


def _largest(values: Iterable[float]) -> float:
    """The largest; NaN if any is."""
    return float(np.max(list(values)))


@dataclass(frozen=True, slots=True)
class Led:
    """What a leader and its follower do to one another."""

    tracking: float
    """largest distance of the follower's tool from the leader's, both as they truly are at the bus's samples [m]"""
    joints: float
    """the same of a joint [rad]"""
    free_force: float
    """largest force felt at the grip with nothing touched [N]"""


def led(draw: Draw) -> Led:
    """Free motion of leader and follower."""
    setup = build(None, arm=SO101, hand=draw.hand, seed=draw.seed)
    slave, leader = setup.slave, setup.device
    assert isinstance(slave, ServoSlave) and isinstance(leader, SimulatedLeader)
    begin, places = round(SETTLED * 1e3), []
    every = round(RATE / BUS_RATE)

    def tap(k: int, run: Run) -> Wish:
        # in the second period after a sample both arms stand at its instant
        if k >= begin and k % every == 1:
            places.append((leader.plant.q, slave.plant.q))
        return Wish(Faults())

    run = setup.run(seconds=draw.seconds, tap=tap)
    ahead = np.array([slave.tip(q) - slave.tip(p) for p, q in places])
    return Led(
        float(np.linalg.norm(ahead, axis=1).max()),
        float(max(np.abs(q - p).max() for p, q in places)),
        float(max(np.linalg.norm(slave.at_tip(q, f)) for q, f in zip(run.tip, run.felt, strict=True))),
    )


def held_torque(run: Run) -> tuple[float, float, float]:
    """Felt and estimated torque off the true one, part of it, over tenths of a second in which a touch is held; the
    true torque [N m]."""
    size = np.linalg.norm(run.true, axis=1)
    smooth = np.convolve(size, np.ones(100) / 100.0, mode="same")
    rows = np.flatnonzero(smooth > 0.8 * smooth.max())
    rows = rows[: len(rows) // 100 * 100]
    true, felt, told_ = (
        part[rows].reshape(-1, 100, part.shape[1]).mean(axis=1)
        for part in (run.true, run.felt, run.estimated)
    )
    square = np.square(true).sum(axis=1)
    off = [float(np.abs((part * true).sum(axis=1) / square - 1.0).mean()) for part in (felt, told_)]
    return off[0], off[1], float(np.sqrt(square).mean())


def leader_and_follower(quick: bool, done: Callable[[], None]) -> list[Row]:
    """The SO-101, by hands that nothing was chosen by; the worst counts."""
    chosen, seeds = slave_arm(SO101), JUDGED[:1] if quick else JUDGED
    moved = []
    for seed in seeds:
        moved.append(led(free(chosen, seed, 0.06, 4.5 if quick else 6.0)))
        done()
    worst = f"worst of {len(seeds)} hands"
    rows = [
        at_most(
            f"SO-101 led by its twin, hand at {SPEED:g} m/s: the tool away from where the leader's is, at most",
            2.0,
            1e3 * max(m.tracking for m in moved),
            "mm",
            f"{worst}; both as they truly are; joints {1e3 * max(m.joints for m in moved):.1f} mrad: encoders of 12 "
            "bit have steps of 1.5 mrad, so that 1 mrad is out of reach",
        ),
        at_most(
            "SO-101, free motion: force felt at the grip, at most",
            0.3,
            max(m.free_force for m in moved),
            "N",
            f"{worst}; what the leader's motors add; its own gears' friction is felt as well",
        ),
    ]
    for K, press in SO101_WALLS[:1] if quick else SO101_WALLS:
        found, onset, stiffness = [], [], []
        for seed in seeds:
            draw = pressing(chosen, seed, K, press)
            stiffness.append(draw.stiffness)
            run = build(
                "wall", arm=SO101, stiffness=draw.stiffness, press=press, hand=draw.hand, seed=seed
            ).run(seconds=draw.seconds)
            done()
            found.append(held_torque(run))
            onset.append(transparency(run).onset)
        walls = f"SO-101, walls of {min(stiffness):.0f} to {max(stiffness):.0f} N/m"
        rows += [
            at_most(
                f"{walls}: torque felt off the true one while held, mean",
                5.0,
                100.0 * _largest(f[0] for f in found),
                "%",
                f"{worst} and places: {', '.join(f'{100.0 * f[0]:.1f}' for f in found)} %; the estimate "
                f"{100.0 * _largest(f[1] for f in found):.1f} %, at {found[0][2]:.1f} N m; at rest the gears would "
                f"hide {HIDDEN:.0f} %: the joints are shaken",
            ),
            at_most(
                f"{walls}: felt after the touch",
                20.0,
                1e3 * _largest(onset),
                "ms",
                "no delay on the line; a step of the encoders is 4 ms and 0.4 mm of the tool",
            ),
        ]
    return rows


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


JOBS, QUICK_JOBS = len(JUDGED) * (2 + len(WALLS) + len(SO101_WALLS)) + 4, 5
"""runs in all"""


def rows(quick: bool, done: Callable[[], None]) -> list[Row]:
    """Every row; `done` is called after each run."""
    return [*industrial(quick, done), *leader_and_follower(quick, done), *scenes(quick, done)]
