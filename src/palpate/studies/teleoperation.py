"""A hand feels what a light arm touches: tracking, force and stiffness felt, onset, dead links, a bad network; in
MuJoCo."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core import teleop_step_times
from ..arm import Array
from ..teleop.channel import Faults
from ..teleop.coupling import COUPLINGS
from ..teleop.figures import Contact, Transparency, contact, jumps, transparency
from ..teleop.scenes import slave_arm
from ..teleop.session import Cut, Run
from ..teleop.setups import build
from ..teleop.slaves import STIFFEST
from . import Progress, Row, _figures, _teleop_slaves, _teleop_turning
from ._rows import at_most, told
from ._teleop_hands import JUDGED, SHOWN, free, pressing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STIFFNESS = (500.0, 2000.0, 5000.0)
"""of the walls, nominal [N/m]"""
PRESS = 0.02
"""how far behind a wall a hand goes, nominal [m]"""
CUTS = (0.1, 0.5, 1.5, 4.0, 10.0)
"""[s]"""
STEP_CALLS = 200_000
PRESSED_UNTIL = 6.4
"""the hand presses the rigid wall until then [s]"""
BOUNCES, UNSTEADY = 5, 0.1
"""of a stable contact with a rigid wall, at most: losses of the touch, and the part of the force by which it changes"""


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """All runs, one after the other."""
    walls = STIFFNESS[1:2] if quick else STIFFNESS
    cuts = CUTS[1:2] if quick else CUTS
    whole = 5.5 if quick else None
    more = _teleop_slaves.QUICK_JOBS if quick else _teleop_slaves.JOBS
    more += _teleop_turning.QUICK_JOBS if quick else _teleop_turning.JOBS
    seeds, chosen = JUDGED[:1] if quick else JUDGED, slave_arm("kuka_lbr_iiwa14")
    total = len(seeds) * (1 + len(walls) + len(cuts)) + len(COUPLINGS) + 5 + more
    begin, done = clock.perf_counter(), 0

    def next_one() -> None:
        nonlocal done
        done += 1
        progress(done, total, (clock.perf_counter() - begin) * (total - done) / done)

    free_runs = []
    for seed in seeds:
        draw = free(chosen, seed, 0.1, 4.0 if quick else 8.0)
        free_runs.append(build(None, hand=draw.hand, seed=seed).run(seconds=draw.seconds))
        next_one()
    pressed: dict[float, list[tuple[Run, Transparency]]] = {}
    for K in walls:
        pressed[K] = []
        for seed in seeds:
            draw = pressing(chosen, seed, K, PRESS)
            found = build("wall", stiffness=draw.stiffness, press=PRESS, hand=draw.hand, seed=seed).run(
                seconds=draw.seconds
            )
            pressed[K].append((found, transparency(found, stiffness=draw.stiffness)))
            next_one()
    dead: list[tuple[float, tuple[float, float, float]]] = []
    for seed in seeds:
        # it dies while the hand goes in, holds or comes back
        instants = np.random.default_rng(seed).uniform(3.0, 7.0, len(cuts))
        for at, seconds in zip(instants, cuts, strict=True):
            draw = pressing(chosen, seed, 2000.0, PRESS)
            cut = (Cut(round(float(at), 3), seconds),)
            found = build("wall", stiffness=draw.stiffness, press=PRESS, hand=draw.hand, seed=seed).run(
                seconds=float(at) + seconds + (0.6 if quick else 2.0), cuts=cut
            )
            dead.append((seconds, jumps(found, cut)))
            next_one()
    bad = Faults(delay=0.1, jitter=0.05, loss=0.2)
    with_layer = build("wall", stiffness=5000.0).run(seconds=whole, faults=bad)
    next_one()
    without = build("wall", stiffness=5000.0, passive=False).run(seconds=whole, faults=bad)
    next_one()
    rigid: dict[str, Contact] = {}
    for name, stiffest in (("gives way", STIFFEST), ("does not give way", math.inf)):
        until = 4.0 if quick else PRESSED_UNTIL
        rigid[name] = contact(build("rigid", stiffest=stiffest).run(seconds=until), until)
        next_one()
    coupled: dict[str, Transparency] = {}
    for coupling in COUPLINGS:
        found = build("wall", stiffness=2000.0, coupling=coupling).run(seconds=whole)
        coupled[coupling] = transparency(found, stiffness=2000.0)
        next_one()
    felt, followed = teleop_step_times(STEP_CALLS // 20 if quick else STEP_CALLS)
    times = {"master": felt, "slave": followed}
    next_one()
    rows = _rows([transparency(r) for r in free_runs], pressed, dead, with_layer, without, times)
    rows += _rigid_rows(rigid) + _coupling_rows(coupled)
    rows += _teleop_turning.rows(quick, next_one)
    rows += _teleop_slaves.rows(quick, next_one)
    setup_notes = [
        "Slave: KUKA LBR iiwa 14 in MuJoCo with a stick of 12 cm, its model known exactly; encoders of 1 "
        "microradian, velocities with 0.1 mrad/s and "
        "torques with 0.05 N m of noise at 1 kHz, which no source states. Master: a device of 75 g, 8.5 N, "
        "0.03 mm, held by a hand of 0.5 kg, "
        "400 N/m, 14 N s/m with tremor. Every message goes through the encrypted packets of the channel.",
        "Hands of different grip, tremor, way and place, with other sensors' noise and walls up to 15 % off, judge "
        f"(seeds {', '.join(map(str, JUDGED))}); no setting was chosen by them, and they press with no more than "
        f"{SHOWN:.0%} of what the device can show. The SO-101's and the ABB's estimators "
        "were designed on hands that go straight ahead, sensor seeds 0 and 5 to 7, and on seeds 1, 2 and 4.",
        "True forces are those of MuJoCo's contacts. Force felt and true are compared over tenths of a "
        "second while the hand holds.",
        "The contact itself gives: between the tool's way and the spring's. Stiffness felt is against what "
        "the tool meets.",
        "ABB IRB 2400-16: the robot of the sensorless-force study in MuJoCo, with its friction, transmission, phase "
        "currents, sensors and glitches, identified by its own motion beforehand (scripts/identify_irb2400.py); it "
        "follows by the position control of its drives. The device moves it with motion scale 2 and force scale 0.05.",
        "SO-101: five joints from TheRobotStudio's files, friction of the STS3215 as Rhoban/bam measured it, encoders "
        "of 12 bit, currents in steps of 6.5 mA, 250 Hz; the leader is a twin in a hand, coupled joint to joint. "
        "Friction is known exactly.",
        "Rigid wall: a box that is welded to the world; MuJoCo's contact with it is as stiff as 0.6 kN/mm. Beyond "
        f"{STIFFEST / 1e3:g} kN/m of what it touches the slave gives way like a spring.",
    ]
    return rows, _figures.drawn(lambda: _draw(free_runs[0], pressed, with_layer, without)), setup_notes


def _rigid_rows(rigid: Mapping[str, Contact]) -> list[Row]:
    ours, stiff = rigid.values()
    return [
        at_most(
            "rigid wall: the touch is lost while the hand presses, times",
            BOUNCES,
            ours.bounces,
            "",
            f"{stiff.bounces} where the slave does not give way",
        ),
        at_most(
            "rigid wall: true force changes while it is held, standard deviation",
            100.0 * UNSTEADY,
            100.0 * ours.unsteady / ours.held,
            "%",
            f"of {ours.held:.1f} N; {100.0 * stiff.unsteady / stiff.held:.0f} % of {stiff.held:.1f} N where the "
            "slave does not give way",
        ),
        told(
            "rigid wall: largest true force, the first touch included",
            ours.peak,
            "N",
            f"{stiff.peak:.1f} N where the slave does not give way",
        ),
    ]


def _coupling_rows(coupled: Mapping[str, Transparency]) -> list[Row]:
    return [
        told(
            f"{name}, wall of 2000 N/m: stiffness felt, part of what the tool meets",
            100.0 * t.stiffness,
            "%",
            f"force felt off the true one {100.0 * t.force_error:.1f} % at {t.force_held:.1f} N; free motion: tool "
            f"off {1e3 * t.tracking:.2f} mm, force {t.free_force:.2f} N",
        )
        for name, t in coupled.items()
    ]


def _rows(
    moved: Sequence[Transparency],
    pressed: Mapping[float, Sequence[tuple[Run, Transparency]]],
    dead: Sequence[tuple[float, tuple[float, float, float]]],
    with_layer: Run,
    without: Run,
    times: Mapping[str, Array],
) -> list[Row]:
    worst = f"worst of {len(moved)} hands"

    def largest(values: Iterable[float]) -> float:
        return float(np.max(list(values)))

    rows = [
        at_most(
            "free motion: the tool away from where the hand points, at most",
            2.0,
            1e3 * largest(t.tracking for t in moved),
            "mm",
            f"{worst}; tool at up to {max(t.speed for t in moved):.2f} m/s",
        ),
        at_most(
            "free motion: force of the device, at most", 0.3, largest(t.free_force for t in moved), "N", worst
        ),
    ]
    for K, runs in pressed.items():
        found = [t for _, t in runs]
        least = float(np.min([t.stiffness for t in found]))
        rows += [
            at_most(
                f"walls of about {K:g} N/m: force felt off the true one, mean",
                5.0,
                100.0 * largest(t.force_error for t in found),
                "%",
                f"{worst}, places and walls; at {min(t.force_held for t in found):.1f} to "
                f"{max(t.force_held for t in found):.1f} N",
            ),
            Row(
                f"walls of about {K:g} N/m: stiffness felt, part of what the tool meets",
                ">= 90",
                100.0 * least,
                None,
                bool(least >= 0.9),
                "%",
                f"{worst}; the tool meets {100.0 * min(t.met for t in found):.0f} % of the spring's at least",
            ),
            at_most(
                f"walls of about {K:g} N/m: felt after the touch",
                20.0,
                1e3 * largest(t.onset for t in found),
                "ms",
                f"{worst}; no delay on the line",
            ),
        ]
    lost = [d for seconds, d in dead if seconds > 0.3]
    rows += [
        at_most(
            "dead links of 0.1 to 10 s, in, at and out of a touch: force changes within 10 ms, at most",
            2.0,
            largest(d[0] for _, d in dead),
            "N",
            f"worst of {len(dead)}",
        ),
        at_most(
            "dead links: velocity of the tool changes within 10 ms, at most",
            5.0,
            1e3 * largest(d[1] for _, d in dead),
            "mm/s",
            f"worst of {len(dead)}",
        ),
        told(
            "dead links: the slave's reference moves meanwhile, at most",
            1e3 * max((d[2] for d in lost), default=0.0),
            "mm",
        ),
    ]
    for name, run_ in (("with the layer", with_layer), ("without", without)):
        late = run_.time > run_.time[-1] - 1.0
        rows.append(
            told(
                f"100 ms each way, jitter 50 ms, loss 20 %, wall of 5 kN/m, {name}: RMS force of the device in the "
                "last second",
                float(np.sqrt(np.mean(np.square(run_.force[late])))),
                "N",
                f"largest true force {np.linalg.norm(run_.true, axis=1).max():.0f} N; the hand has long come back",
            )
        )
    for side, taken in times.items():
        p50, p999, last = (1e6 * float(x) for x in (*np.quantile(taken, (0.5, 0.999)), taken.max()))
        rows.append(
            at_most(
                f"one step of the {side}'s side, median",
                10.0,
                p50,
                "us",
                f"six axes, four-channel; 99.9 % {p999:.1f} us, worst of {len(taken)}: {last:.0f} us, the computer's "
                "own pauses included",
            )
        )
    return rows


def _draw(
    free: Run, pressed: Mapping[float, Sequence[tuple[Run, Transparency]]], with_layer: Run, without: Run
) -> dict[str, Any]:
    K, ((press, _), *_) = list(pressed.items())[-1]
    inside = np.linalg.norm(press.true, axis=1) > 0.2
    return {
        f"Force while a wall of {K:g} N/m is pressed: true, estimated, felt": _figures.curves(
            {
                "true": (press.time, press.true[:, 0]),
                "estimated": (press.time, press.estimated[:, 0]),
                "felt": (press.time, press.felt[:, 0]),
            },
            "force [N]",
        ),
        "The same over the way: what the tool meets and what the hand feels": _figures.curves(
            {
                "true, over the tool's way": (1e3 * press.tip[inside, 0], -press.true[inside, 0]),
                "felt, over the device's way": (1e3 * press.wanted[inside, 0], -press.felt[inside, 0]),
            },
            "force [N]",
            across="place [mm]",
        ),
        "Free motion: the tool away from where the hand points": _figures.curves(
            {"distance": (free.time, 1e3 * np.linalg.norm(free.tip - free.wanted, axis=1))}, "distance [mm]"
        ),
        "100 ms each way, jitter, 20 % loss: force of the device": _figures.curves(
            {
                "with the layer": (with_layer.time, with_layer.force[:, 0]),
                "without": (without.time, without.force[:, 0]),
            },
            "force [N]",
        ),
    }
