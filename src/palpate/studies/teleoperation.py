"""A hand feels what a light arm touches: tracking, force and stiffness felt, onset, dead links, a bad network; in
MuJoCo."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core import teleop_step_times
from ..arm import Array
from ..teleop.channel import Faults
from ..teleop.coupling import COUPLINGS
from ..teleop.figures import SETTLED, Contact, Transparency, contact, jumps, transparency
from ..teleop.masters import Hand
from ..teleop.scenes import smooth
from ..teleop.session import Cut, Run
from ..teleop.setups import build
from ..teleop.slaves import STIFFEST
from . import Progress, Row, _figures, _teleop_slaves, _teleop_turning
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPEED = 0.25
"""of the hand in free motion [m/s]"""
STIFFNESS = (500.0, 2000.0, 5000.0)
"""of the walls [N/m]"""
CUTS = (0.1, 0.5, 1.5, 4.0, 10.0)
"""[s]"""
STEP_CALLS = 200_000
PRESSED_UNTIL = 6.4
"""the hand presses the rigid wall until then [s]"""
BOUNCES, UNSTEADY = 5, 0.1
"""of a stable contact with a rigid wall, at most: losses of the touch, and the part of the force by which it changes"""


def _circle(time: float) -> Array:
    """A circle of 10 cm, the hand as fast as asked for."""
    t, radius = max(0.0, time - SETTLED), 0.1
    angle = SPEED / radius * t
    return smooth(t / 1.5) * radius * np.array([math.sin(angle), math.cos(angle), 0.0])


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """All runs, one after the other."""
    walls = STIFFNESS[1:2] if quick else STIFFNESS
    cuts = CUTS[1:2] if quick else CUTS
    whole = 5.5 if quick else None
    more = _teleop_slaves.QUICK_JOBS if quick else _teleop_slaves.JOBS
    more += _teleop_turning.QUICK_JOBS if quick else _teleop_turning.JOBS
    total, begin, done = len(walls) + len(cuts) + len(COUPLINGS) + 6 + more, clock.perf_counter(), 0

    def next_one() -> None:
        nonlocal done
        done += 1
        progress(done, total, (clock.perf_counter() - begin) * (total - done) / done)

    free_run = build(None, hand=Hand(wish=_circle)).run(seconds=4.0 if quick else 10.0)
    free = transparency(free_run)
    next_one()
    pressed: dict[float, tuple[Run, Transparency]] = {}
    for K in walls:
        found = build("wall", stiffness=K).run(seconds=whole)
        pressed[K] = found, transparency(found, stiffness=K)
        next_one()
    dead: dict[float, tuple[float, float, float]] = {}
    for seconds in cuts:
        cut = (Cut(5.0, seconds),)
        found = build("wall", stiffness=2000.0).run(seconds=5.0 + seconds + (0.6 if quick else 2.0), cuts=cut)
        dead[seconds] = jumps(found, cut)
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
        if coupling == "force_position" and 2000.0 in pressed:
            coupled[coupling] = pressed[2000.0][1]
        else:
            found = build("wall", stiffness=2000.0, coupling=coupling).run(seconds=whole)
            coupled[coupling] = transparency(found, stiffness=2000.0)
        next_one()
    felt, followed = teleop_step_times(STEP_CALLS // 20 if quick else STEP_CALLS)
    times = {"master": felt, "slave": followed}
    next_one()
    rows = _rows(free, pressed, dead, with_layer, without, times)
    rows += _rigid_rows(rigid) + _coupling_rows(coupled)
    rows += _teleop_turning.rows(quick, next_one)
    rows += _teleop_slaves.rows(quick, next_one)
    setup_notes = [
        "Slave: KUKA LBR iiwa 14 in MuJoCo with a stick of 12 cm, its model known exactly; encoders of 1 "
        "microradian, velocities with 0.1 mrad/s and "
        "torques with 0.05 N m of noise at 1 kHz, which no source states. Master: a device of 75 g, 8.5 N, "
        "0.03 mm, held by a hand of 0.5 kg, "
        "400 N/m, 14 N s/m with tremor. Every message goes through the encrypted packets of the channel.",
        "True forces are those of MuJoCo's contacts. Force felt and true are compared over tenths of a "
        "second while the hand holds.",
        "The contact itself gives: between the tool's way and the spring's. Stiffness felt is against what "
        "the tool meets.",
        "ABB IRB 2400-16: the robot of the sensorless-force study in MuJoCo, with its friction, transmission, phase "
        "currents, sensors and glitches, identified by its own motion beforehand (scripts/identify_irb2400.py); it "
        "follows by the position control of its drives. The device moves it with motion scale 2 and force scale 0.05.",
        "SO-101: five joints from TheRobotStudio's files, friction of the STS3215 as Rhoban/bam measured it, encoders "
        "of 12 bit, currents in steps of 6.5 mA, 250 Hz; the leader is a twin in a hand, coupled joint to joint.",
        "Rigid wall: a box that is welded to the world; MuJoCo's contact with it is as stiff as 0.6 kN/mm. Beyond "
        f"{STIFFEST / 1e3:g} kN/m of what it touches the slave gives way like a spring.",
    ]
    return rows, _figures.drawn(lambda: _draw(free_run, pressed, with_layer, without)), setup_notes


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
    free: Transparency,
    pressed: Mapping[float, tuple[Run, Transparency]],
    dead: Mapping[float, tuple[float, float, float]],
    with_layer: Run,
    without: Run,
    times: Mapping[str, Array],
) -> list[Row]:
    rows = [
        at_most(
            "free motion: the tool away from where the hand points, at most",
            2.0,
            1e3 * free.tracking,
            "mm",
            f"tool at up to {free.speed:.2f} m/s",
        ),
        at_most("free motion: force of the device, at most", 0.3, free.free_force, "N"),
    ]
    for K, (_, t) in pressed.items():
        rows += [
            at_most(
                f"wall of {K:g} N/m: force felt off the true one, mean",
                5.0,
                100.0 * t.force_error,
                "%",
                f"at {t.force_held:.1f} N",
            ),
            Row(
                f"wall of {K:g} N/m: stiffness felt, part of what the tool meets",
                ">= 90",
                100.0 * t.stiffness,
                None,
                bool(t.stiffness >= 0.9),
                "%",
                f"the tool meets {100.0 * t.met:.0f} % of the spring's",
            ),
            at_most(
                f"wall of {K:g} N/m: felt after the touch", 20.0, 1e3 * t.onset, "ms", "no delay on the line"
            ),
        ]
    lost = [d for seconds, d in dead.items() if seconds > 0.3]
    rows += [
        at_most(
            "dead links of 0.1 to 10 s while pressing: force changes within 10 ms, at most",
            2.0,
            max(d[0] for d in dead.values()),
            "N",
        ),
        at_most(
            "dead links: velocity of the tool changes within 10 ms, at most",
            5.0,
            1e3 * max(d[1] for d in dead.values()),
            "mm/s",
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
        p50, p999, worst = (1e6 * float(x) for x in (*np.quantile(taken, (0.5, 0.999)), taken.max()))
        rows.append(
            at_most(
                f"one step of the {side}'s side, median",
                10.0,
                p50,
                "us",
                f"six axes, four-channel; 99.9 % {p999:.1f} us, worst of {len(taken)}: {worst:.0f} us, the computer's "
                "own pauses included",
            )
        )
    return rows


def _draw(
    free: Run, pressed: Mapping[float, tuple[Run, Transparency]], with_layer: Run, without: Run
) -> dict[str, Any]:
    K, (press, _) = list(pressed.items())[-1]
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
