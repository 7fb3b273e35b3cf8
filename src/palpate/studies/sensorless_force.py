"""External force of an industrial robot from two phase currents per motor (del Sol et al., the
sensorless-force paper).

(a) The paper's rig: a motor lifts weights on a pulley. (b) Its robot, an ABB IRB 2400-16, on its way A -> B ->
A while
something pushes: the paper's method beside palpate's, which is identified from the same arm's own excitation.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..arm import Array
from ..simulate.irb2400 import GEAR, K_T, B
from . import Progress, Row, _figures
from ._geared_arm import RATE
from ._irb2400 import BEGIN, FRICTION_ERROR, LINK_ERROR, SECONDS, STATIC_LOAD, TOOL_MOMENT
from ._irb2400_force import (
    FULL,
    LAG,
    QUICK,
    Estimate,
    Experiment,
    Score,
    estimate,
    experiment,
    friction_alone,
    late,
    published,
    score,
    with_exact_currents,
    with_exact_model,
)
from ._pulley_rig import PULLEY, WEIGHTS, Lift, Rig
from ._rows import at_most, near, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAYLOAD = 20.0
"""[kg]"""
PUBLISHED = 24.2
"""the paper's mean error, 2.47 kg or 12.35 % of the payload [N]"""
BAR = 2.4
"""a tenth of it [N]"""
MOMENTS = (TOOL_MOMENT, 100.0)
"""what palpate is told of the moments at the tool: as much as in the study, nothing [N m]"""
FRESH = (1, 2, 3)
"""experiments by which no setting was chosen"""


def rms(error: Array) -> float:
    """Of what is finite."""
    return float(np.sqrt(np.nanmean(np.square(error))))


def _rig_rows(lifts: Sequence[Lift]) -> list[Row]:
    rows = []
    for x in lifts:
        printed, amplitude, found = (rms(y - x.true) for y in (x.printed, x.amplitude, x.ours))
        rows.append(
            told(
                f"rig, {x.weight:g} kg on 32 mm: error of the torque, RMS",
                found,
                "N m",
                f"of {x.weight * 9.81 * PULLEY:.3f}; eq. 5 as printed {printed:.3f}, its amplitude with "
                "the right sign and sensors as "
                f"they are {amplitude:.4f}",
            )
        )
        rows.append(
            near(
                f"rig: {x.weight:g} kg weighed by lifting and lowering",
                x.weight,
                x.mass,
                0.01 * x.weight,
                "kg",
            )
        )
    return rows


# --- rows and figures -------------------------------------------------------------------------------------------------

AXES = ("F_x", "F_y", "F_z", "M_x", "M_y", "M_z")


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """The rig, then the robot."""
    begin = clock.perf_counter()

    plan, fresh = (QUICK, FRESH[:1]) if quick else (FULL, FRESH)

    def part(of: int, done: float) -> None:
        all_done = (of + done) / (1 + len(fresh))
        spent = clock.perf_counter() - begin
        progress(round(100 * all_done), 101, spent * (1.0 / all_done - 1.0) if all_done > 0.0 else math.inf)

    rig = Rig(40)
    lifts = [rig.lift(weight) for weight in (WEIGHTS[-1:] if quick else WEIGHTS)]
    x = experiment(plan, lambda done: part(0, done))
    results = Results.of(x)
    others = []
    for k, number in enumerate(fresh, 1):
        other = experiment(replace(plan, changes=()), lambda done, k=k: part(k, done), number)  # type: ignore[misc]
        others.append(
            [
                score([(estimate(other, m, moment), late(m.wrench)) for m in other.records])
                for moment in MOMENTS
            ]
        )
    progress(101, 101, 0.0)
    return (
        [*_rig_rows(lifts), *_robot_rows(x, results), *_fresh_rows(others)],
        _figures.drawn(lambda: _draw(x, results, lifts[-1])),
        [
            "Simulated: forward dynamics of the decoded Table 1 with LuGre friction at the motors "
            "(published Coulomb, static, viscous "
            "and Stribeck figures), a 2 % ripple of it that no model knows, and the parallelogram. What "
            "no source states (torque "
            "constants, gears, rotors, presliding, sensors) is assumed and written at the top of the module.",
            f"Ours starts from links {LINK_ERROR:.0%} wrong and knows the robot from its own motion alone: "
            f"{FULL.excitation:g} s of Fourier "
            f"motion, {FULL.moves} moves with stops, {FULL.poses} static poses from both sides without and "
            f"with {STATIC_LOAD:g} kg. Its "
            "standard deviations come from another such motion that the fit has not seen.",
            f"The estimate is {1e3 * LAG:.0f} ms late and says so; its errors are against the force so "
            "much earlier, and once against the "
            "force of the same instant (live). Rows begin when the robot is at A and leave nothing out.",
            "The published figure is what 30 % of Coulomb and viscous friction make in F = J^-T tau, all "
            "else known. On the simulated "
            "currents the method as described is worse: it knows no static friction, and J^-T turns small "
            "errors of the wrist into "
            "large forces. Whether that is so on the real robot only its data could tell.",
        ],
    )


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Every score, and the first record's curves for the figures."""

    ours: Score
    live: Score
    open: Score
    free: Score
    exact_currents: Score
    exact_model: Score
    changed: list[tuple[float, Score]]
    friction_alone: Array
    published: list[Array]
    published_high: float
    first: Estimate

    @classmethod
    def of(cls, x: Experiment) -> Results:
        """Score everything."""
        found = [(estimate(x, m), m.wrench) for m in x.records]
        rows = slice(round(BEGIN * RATE), None)
        return cls(
            ours=score([(e, late(truth)) for e, truth in found]),
            live=score(found),
            open=score([(estimate(x, m, MOMENTS[1]), late(m.wrench)) for m in x.records]),
            free=score([(estimate(x, x.free), x.free.wrench)]),
            exact_currents=score([(with_exact_currents(x, m), late(m.wrench)) for m in x.records]),
            exact_model=score([(with_exact_model(x, m), late(m.wrench)) for m in x.records]),
            changed=[(part, score([(estimate(x, m), late(m.wrench))])) for part, m in x.changed],
            friction_alone=np.vstack([friction_alone(x.arm, x.drives, m)[rows] for m in x.records]),
            published_high=_mean_vertical(x, -FRICTION_ERROR),
            published=[
                published(x.arm, x.drives, x.sensors.read(m), np.sign(m.torque), FRICTION_ERROR)
                for m in x.records
            ],
            first=found[0][0],
        )

    def published_error(self, x: Experiment) -> Array:
        """(M, 6) of the paper's method on the simulated readings."""
        rows = slice(round(BEGIN * RATE), None)
        return np.vstack([(w - m.wrench)[rows] for w, m in zip(self.published, x.records, strict=True)])


def _mean_vertical(x: Experiment, friction_error: float) -> float:
    """Mean vertical error of the paper's method with this error of friction [N]."""
    rows = slice(round(BEGIN * RATE), None)
    found = [
        published(x.arm, x.drives, x.sensors.read(m), np.sign(m.torque), friction_error) for m in x.records
    ]
    return float(np.mean([np.abs((w - m.wrench)[rows, 2]) for w, m in zip(found, x.records, strict=True)]))


def _covers(what: str, coverage: float, note: str = "") -> Row:
    return Row(what, "90 to 99", 100.0 * coverage, None, bool(0.9 <= coverage <= 0.99), "%", note)


def _robot_rows(x: Experiment, r: Results) -> list[Row]:
    z = 2
    alone = float(np.abs(r.friction_alone[:, z]).mean())
    paper = np.abs(r.published_error(x))
    turning = r.ours.turning
    mine = np.abs(r.ours.error)
    force, moment = r.open.mean[:3], r.open.mean[3:]
    share = 100.0 / (PAYLOAD * 9.81)
    seen = x.robot.constants.seen
    off = (x.robot.constants.gain / (K_T * GEAR) - 1.0)[seen]
    rows = [
        near(
            "paper's method, all known but friction (30 % off): vertical force, mean error",
            PUBLISHED,
            alone,
            0.15 * PUBLISHED,
            "N",
            f"{alone * share:.1f} % of the payload; published 12.35 %",
        ),
        told(
            "paper's method on the simulated phase currents, friction 30 % too low",
            float(paper[:, z].mean()),
            "N",
            f"{paper[:, z].mean() * share:.1f} % of the payload; with friction 30 % too high {r.published_high:.0f} N",
            beside=PUBLISHED,
        ),
        at_most(
            "ours: vertical force, mean error, reversals included",
            BAR,
            float(r.ours.mean[z]),
            "N",
            f"{r.ours.mean[z] * share:.2f} % of the payload; {len(x.records)} records of 12 s; told that "
            "moments at the tool are within "
            f"+-{2.0 * TOOL_MOMENT:g} N m; {1e3 * LAG:.0f} ms late",
        ),
        _covers("ours: its 95 % interval holds the vertical force", float(r.ours.coverage[z])),
        told(
            "ours, live: against the force of the same instant",
            float(r.live.mean[z]),
            "N",
            f"interval holds it in {100.0 * r.live.coverage[z]:.0f} %: the delay is not in it",
            beside=f"<= {BAR:g}",
        ),
        told(
            "ours, told nothing of the moments (default): vertical force, mean error",
            float(r.open.mean[z]),
            "N",
            f"interval holds it in {100.0 * r.open.coverage[z]:.1f} %",
            beside=f"<= {BAR:g}",
        ),
        told(
            "at reversals (friction of motor 2 or 3 turning over): vertical force, mean error",
            float(mine[turning, z].mean()),
            "N",
            f"paper's method {paper[turning, z].mean():.1f} N; {100.0 * turning.mean():.0f} % of the rows; "
            "elsewhere ours "
            f"{mine[~turning, z].mean():.2f} N",
        ),
        told(
            "nothing pushes: vertical force, mean",
            float(r.free.mean[z]),
            "N",
            f"interval holds zero in {100.0 * r.free.coverage[z]:.1f} %",
            beside=0.0,
        ),
        told(
            "full wrench, default: mean error of F_x, F_y, F_z",
            ", ".join(f"{v:.1f}" for v in force),
            "N",
            "intervals hold "
            + ", ".join(f"{100.0 * c:.0f}" for c in r.open.coverage[:3])
            + " %; paper's method "
            + ", ".join(f"{v:.0f}" for v in paper.mean(axis=0)[:3]),
        ),
        told(
            "full wrench, default: mean error of M_x, M_y, M_z",
            ", ".join(f"{v:.1f}" for v in moment),
            "N m",
            "intervals hold "
            + ", ".join(f"{100.0 * c:.0f}" for c in r.open.coverage[3:])
            + " %; paper's method "
            + ", ".join(f"{v:.0f}" for v in paper.mean(axis=0)[3:]),
        ),
        told(
            "bound: exact currents, identified model: vertical force, mean error",
            float(r.exact_currents.mean[z]),
            "N",
            "what the error of the identified friction and links leaves",
        ),
        told(
            "bound: exact model, measured currents and positions",
            float(r.exact_model.mean[z]),
            "N",
            "what noise, glitches and filters leave",
        ),
        *(
            told(
                f"friction {100.0 * part:.0f} % higher than when identified: vertical force, mean error",
                float(s.mean[z]),
                "N",
                f"interval holds it in {100.0 * s.coverage[z]:.0f} %: it knows nothing of that; identify "
                "again when warm",
            )
            for part, s in r.changed
        ),
        told(
            "torque constants of joints 2 to 6 from static poses: largest error",
            100.0 * float(np.abs(off).max()),
            "%",
            "joint 1 bears no weight: data sheet; errors in standard deviations "
            + ", ".join(
                f"{v:.1f}" for v in np.abs(off) / (x.robot.constants.std / x.robot.constants.gain)[seen]
            ),
        ),
    ]
    return rows


def _fresh_rows(others: Sequence[Sequence[Score]]) -> list[Row]:
    """The same on robots that no setting was chosen by: told of the moments, then not."""
    z = 2
    told_so, untold = zip(*others, strict=True)

    def mean(of: Sequence[Score]) -> float:
        return float(np.mean([s.mean[z] for s in of]))

    def coverage(of: Sequence[Score]) -> float:
        return float(np.mean([s.coverage[z] for s in of]))

    name = f"{len(others)} experiments not used to choose settings"
    return [
        at_most(
            f"{name}: vertical force, mean error",
            BAR,
            mean(told_so),
            "N",
            "each "
            + ", ".join(f"{s.mean[z]:.2f}" for s in told_so)
            + " N; other link errors, sensors, excitation, static poses, held-out motion and pushes",
        ),
        _covers(
            f"{name}: the 95 % interval holds the vertical force",
            coverage(told_so),
            "each " + ", ".join(f"{100.0 * s.coverage[z]:.1f}" for s in told_so) + " %",
        ),
        told(
            f"{name}, told nothing of the moments (default): vertical force, mean error",
            mean(untold),
            "N",
            f"interval holds it in {100.0 * coverage(untold):.1f} %",
            beside=f"<= {BAR:g}",
        ),
    ]


def _draw(x: Experiment, r: Results, rig: Lift) -> Mapping[str, Figure]:
    record = x.records[0]
    begin = round(BEGIN * RATE)
    time = record.time[begin:] - BEGIN
    force, std = r.first.wrench[begin:, 2], r.first.std[begin:, 2]
    error, paper = r.ours.error[:, 2], r.published_error(x)[:, 2]
    edges = np.linspace(-60.0, 60.0, 121)
    middle = 0.5 * (edges[1:] + edges[:-1])
    shares = {
        name: (middle, 100.0 * np.histogram(np.clip(e, edges[0], edges[-1]), edges)[0] / len(e))
        for name, e in (("palpate", error), ("paper's method", paper))
    }
    speed = record.dq @ B.T
    back = next(
        k
        for k in range(begin + 3 * RATE, len(speed))
        if np.all(speed[k - 5 : k, 1] > 0.0) and speed[k, 1] <= 0.0
    )
    near_it = slice(max(0, back - begin - 1500), back - begin + 1500)
    around = time[near_it] - time[back - begin]
    first = r.published[0][begin:, 2] - record.wrench[begin:, 2]
    return {
        "Vertical force on the tool on the way A - B - A; the band is palpate's 95 % interval": _figures.curves(
            {
                "palpate": (time, force),
                "paper's method": (time, r.published[0][begin:, 2]),
                "true": (time, record.wrench[begin:, 2]),
            },
            "vertical force [N]",
            band=(time, force - 1.96 * std, force + 1.96 * std),
            limits=(0.0, SECONDS - BEGIN, -350.0, 350.0),
        ),
        "How often which error occurs, all records; errors beyond 60 N are counted at the ends": _figures.curves(
            shares, "share of the rows per newton [%]", across="error of the vertical force [N]"
        ),
        "Error of the vertical force where motor 2 turns back at B": _figures.curves(
            {"palpate": (around, error[: len(time)][near_it]), "paper's method": (around, first[near_it])},
            "error [N]",
            level=(0.0, "none"),
            across="time from the reversal [s]",
        ),
        f"The rig: {rig.weight:g} kg lifted and lowered": _figures.curves(
            {
                "palpate": (rig.time, rig.ours),
                "eq. 5 as printed": (rig.time, rig.printed),
                "true": (rig.time, rig.true),
            },
            "motor torque [N m]",
        ),
    }
