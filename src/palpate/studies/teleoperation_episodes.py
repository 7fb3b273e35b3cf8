"""Ten thousand random teleoperators on random bad networks: with the passivity layer, without, and with wave
variables."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .._core import teleop_episode
from . import Progress, Row, _figures
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

EPISODES, QUICK = 10_000, 15
COMPARED = 1_000
"""of them are run without the layer and with waves too"""
SHAKING = 0.25
"""RMS speed of the hand or the slave, long after the hand wants to be still, that counts as unstable [m/s]"""
GENERATED = 0.1
"""energy out of nothing that counts as unstable [J]"""
FORCE_JUMP, SPEED_JUMP = 2.0, 5e-3
"""allowed on return of a dead link [N, m/s]"""

Found = Sequence[tuple[dict[str, Any], dict[str, Any]]]


def _unstable(result: Mapping[str, Any]) -> bool:
    return bool(
        not result["finite"]
        or result["generated"] > GENERATED
        or max(result["shaking"], result["slave_shaking"]) > SHAKING
    )


def _broken(was: Mapping[str, Any], result: Mapping[str, Any]) -> bool:
    slack = 1.0 + 1e-9
    return bool(
        not result["finite"]
        or result["force"] > was["force_limit"] * slack
        or result["speed"] > was["speed"] * slack
    )


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Run them all."""
    count = QUICK if quick else EPISODES
    compared = min(count, COMPARED)
    jobs = [("tanks", count), ("none", compared), ("waves", compared)]
    total, done, begin = sum(n for _, n in jobs), 0, clock.perf_counter()
    found: dict[str, list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for layer, n in jobs:
        rows = found[layer] = []
        for seed in range(n):
            rows.append(teleop_episode(seed, layer))
            done += 1
            if done % 20 == 0 or done == total:
                spent = clock.perf_counter() - begin
                progress(done, total, spent * (total - done) / done)
    return _rows(found), _figures.drawn(lambda: _draw(found)), _notes(found["tanks"])


def _rows(found: Mapping[str, Found]) -> list[Row]:
    ours = found["tanks"]
    results = [r for _, r in ours]
    charge = max(c["initial"] for c, _ in ours)
    cut = [(c, r) for c, r in ours if c["cut"] > 0.3]
    force = np.array([r["force_jump"] for _, r in cut] or [math.nan])
    speed = np.array([r["speed_jump"] for _, r in cut] or [math.nan])
    shaking = np.array([max(r["shaking"], r["slave_shaking"]) for r in results])
    rows = [
        at_most(
            f"energy made in any of {len(ours)} random episodes, both ports together",
            charge,
            max(r["generated"] for r in results),
            "J",
            f"the tanks' initial charge is {1e3 * charge:g} mJ together; measured at the simulated ports, not by "
            "the tanks",
        ),
        at_most(
            "episodes in which a limit is broken (force, speed)", 0, sum(_broken(c, r) for c, r in ours), ""
        ),
        at_most(
            "unstable episodes",
            0,
            sum(map(_unstable, results)),
            "",
            f"made more than {GENERATED:g} J, or shook on",
        ),
        told("lowest level of a tank", min(r["lowest"] for r in results), "J"),
        told(
            "RMS speed long after the hand wants to be still: median, 99 %, worst",
            ", ".join(f"{x:.3f}" for x in np.quantile(shaking, [0.5, 0.99, 1.0])),
            "m/s",
            "tremor is part of it",
        ),
        at_most(
            f"dead links, {len(cut)} of 0.3 to 10 s: force changes within 10 ms of the return by at most",
            FORCE_JUMP,
            float(force.max()),
            "N",
            "over half a second from the return on",
        ),
        at_most(
            "dead links: velocity of the slave's reference changes within 10 ms of the return by at most",
            SPEED_JUMP,
            float(speed.max()),
            "m/s",
            f"more than that in {int((speed > SPEED_JUMP).sum())} of {len(cut)}",
        ),
        at_most(
            "dead links: the slave's reference moves meanwhile",
            0,
            max(r["hold_motion"] for _, r in cut) if cut else 0.0,
            "m",
        ),
    ]
    for layer, name in (("none", "without the layer"), ("waves", "wave variables")):
        theirs = [r for _, r in found[layer]]
        rows.append(
            told(
                f"{name}: unstable episodes, part",
                100.0 * float(np.mean([_unstable(r) for r in theirs])),
                "%",
                f"of {len(theirs)}; worst energy made {max(r['generated'] for r in theirs):.3g} J",
            )
        )
    same = len(found["waves"])
    drift = {
        layer: float(np.median([r["drift"] for c, r in found[layer][:same] if c["axes"] > 1]))
        for layer in ("tanks", "waves")
    }
    rows.append(
        told(
            "slave away from where the hand points at the end, free axes, median",
            1e3 * drift["tanks"],
            "mm",
            f"wave variables {1e3 * drift['waves']:.0f} mm: they send no position, and what is lost is lost",
        )
    )
    return rows


def _notes(ours: Found) -> list[str]:
    kinds = {
        name: sum(c["coupling"] == name for c, _ in ours)
        for name in ("force_position", "position_position", "four_channel")
    }
    return [
        f"Episodes of 10 s and more: {', '.join(f'{n} {k}' for k, n in kinds.items())}; one to three axes; "
        "delay 0 to 500 ms each way, jitter to "
        "100 ms (messages overtake one another), loss to 20 %, repetition to 10 %; walls of 0.1 to 20 kN/m; "
        "hands of 0 to 800 N/m "
        "(a tenth let go of the device), tremor to 0.5 N; slaves of 0.5 to 20 kg; scales of 0.25 to 4 and "
        "0.1 to 2; half with a dead link.",
        "Energy is counted at the ports of the simulated physics: force of the device times way of the hand, "
        "force of the position control's spring "
        "and damper times way of the reference. Hand, device, slave and wall are passive, so what appears is "
        "made by coupling and network.",
        "Links of 0.1 to 0.3 s of silence do not count as dead: the timeout is 0.25 s.",
    ]


def _draw(found: Mapping[str, Found]) -> dict[str, Any]:
    def share(values: Sequence[float]) -> tuple[Any, Any]:
        x = np.sort(np.maximum(1e-6, np.nan_to_num(np.array(values), nan=1e6, posinf=1e6)))
        return 100.0 * np.arange(1, len(x) + 1) / len(x), x

    names = {"tanks": "palpate", "none": "without the layer", "waves": "wave variables"}
    return {
        "RMS speed long after the hand wants to be still, share of the episodes below": _figures.curves(
            {
                names[k]: share([max(r["shaking"], r["slave_shaking"]) for _, r in rows])
                for k, rows in found.items()
            },
            "speed [m/s]",
            level=(SHAKING, "unstable"),
            log=True,
            across="share of the episodes [%]",
        ),
        "Energy made at both ports together, share of the episodes below": _figures.curves(
            {names[k]: share([r["generated"] for _, r in rows]) for k, rows in found.items()},
            "energy [J]",
            level=(GENERATED, "unstable"),
            log=True,
            across="share of the episodes [%]",
        ),
    }
