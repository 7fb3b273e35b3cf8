"""An object is taken and dropped at times nobody announces: how soon that is seen, and how soon it is "
"weighed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .._core import Status
from ..arm import Array
from ..simulate import Attach, Release, Schedule
from . import Progress, Row, _bench, _figures
from ._bench import DEFAULT, MASS, MASS_ONLY, POSES, FeedbackLaw, PublishedLaw, Work, settled
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SEEDS = 6
FIVE_PERCENT = 0.05 * MASS
QUIET = 60.0
"""of a run in which nothing happens [s]"""
QUIET_SEEDS = 4
SETTLED = 4.0
"""after a run's start the arm rests in its pose [s]"""

PUBLISHED, FED_BACK = "published controller", "fed back to the controller"


@dataclass(frozen=True, slots=True)
class Job:
    """One run."""

    pose: str
    seed: int
    fed_back: str = ""
    """filter whose state and mass the controller uses; empty: the published controller"""
    quiet: bool = False
    held: bool = False
    """of a quiet run: with the object"""


class Happened(NamedTuple):
    """A grasp or a release."""

    kind: str
    found: float
    """until it was seen [s]; infinite if it was not"""
    weighed: float
    """until the mass stayed within 5 % of the object's [s]"""


class Seen(NamedTuple):
    """A run through the eyes of one filter."""

    job: Job
    filter: str
    time: Array
    mass: Array
    """(N,) [kg]"""
    ok: npt.NDArray[np.bool_]
    """(N,) whether the status was ok"""
    events: tuple[Happened, ...]
    false: tuple[float, ...]
    """when changes were counted that did not happen [s]"""


def measure(job: Job) -> list[Seen]:
    """Run one job: through both filters where the motion does not depend on them, or nearly so."""
    arm = _bench.reference_arm()
    filters = _bench.payload_filters(arm)
    loop = FeedbackLaw(filters[job.fed_back]) if job.fed_back else None
    rng = np.random.default_rng([job.seed, list(POSES).index(job.pose)])
    taken, dropped = float(rng.uniform(4.0, 9.0)), float(rng.uniform(12.0, 16.0))
    motion = _bench.simulate(
        arm,
        loop or PublishedLaw(arm),
        POSES[job.pose],
        load=_bench.brick() if job.held else None,
        schedule=Schedule([] if job.quiet else [Attach(taken, _bench.brick()), Release(dropped)]),
        seconds=QUIET if job.quiet else _bench.SECONDS,
        seed=job.seed,
    )
    seen = []
    for name, pipeline in filters.items():
        if loop is not None and name == job.fed_back:
            touches = np.array(loop.touches)
            mass, changes, ok = touches[:, 0], touches[:, 2], touches[:, 3] == float(Status.ok)
        elif loop is None or job.quiet:
            payload = motion.weigh(pipeline).payload
            mass, changes, ok = (
                payload.mass,
                payload.changes.astype(np.float64),
                payload.status == int(Status.ok),
            )
        else:
            continue
        time = motion.time
        events = [] if job.quiet else [("grasp", taken, dropped, MASS), ("release", dropped, math.inf, 0.0)]
        happened = tuple(_happened(kind, time, mass, changes, *rest) for kind, *rest in events)
        true = {begin + h.found for (_, begin, *_), h in zip(events, happened, strict=True)}
        counted = time[1:][np.diff(changes) > 0.0].tolist()
        false = tuple(t for t in counted if not any(abs(t - u) < 1e-6 for u in true))
        seen.append(Seen(job, name, time, mass, ok, happened, false))
    return seen


def _happened(
    kind: str, time: Array, mass: Array, changes: Array, begin: float, end: float, true: float
) -> Happened:
    during = (time >= begin) & (time < end)
    before = changes[np.searchsorted(time, begin) - 1]
    seen = np.flatnonzero(changes[during] > before)
    found = float(time[during][seen[0]]) - begin if seen.size else math.inf
    return Happened(kind, found, settled(time[during], mass[during] - true, FIVE_PERCENT) - begin)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` with one seed."""
    seeds, calm = (1, 1) if quick else (SEEDS, QUIET_SEEDS)
    jobs = [Job(p, s, DEFAULT, quiet=True, held=h) for h in (False, True) for p in POSES for s in range(calm)]
    jobs += [
        Job(p, s, fed_back) for fed_back in (MASS_ONLY, DEFAULT, "") for p in POSES for s in range(seeds)
    ]
    with Work(progress, len(jobs)) as work:
        seen = [s for found in work.map(measure, jobs) for s in found]
    rows = []
    for name in (MASS_ONLY, DEFAULT):
        mine = [s for s in seen if s.filter == name]
        for fed_back, control in ((True, FED_BACK), (False, PUBLISHED)):
            group = [s for s in mine if not s.job.quiet and bool(s.job.fed_back) == fed_back]
            rows += _event_rows(group, f"{name}, {control}")
        for held in (False, True):
            rows += _quiet_rows([s for s in mine if s.job.quiet and s.job.held == held], name, held)
    notes = [
        "The arm moves from hanging to a pose in 3 s; the object is taken at a random time in 4 to 9 s and "
        "dropped in 12 to "
        f"16 s, {len(POSES)} poses x {seeds} seeds for each kind of control. Under the published controller "
        "the arm still "
        "moves then. Found: from the instant it happens to the first sample that counts it. Weighed: until "
        "within 5 % of "
        "0.25 kg of the truth for good, or until the next change.",
        f"Nothing happens: {QUIET:g} s each, from hanging to a pose and held there, the default filter fed "
        "back.",
    ]
    return rows, _figures.drawn(lambda: _draw(seen)), notes


def _event_rows(group: Sequence[Seen], name: str) -> list[Row]:
    rows = []
    for what, limit, times in (
        ("change found", 0.2, np.array([e.found for s in group for e in s.events])),
        ("new mass within 5 % for good", 1.0, np.array([e.weighed for s in group for e in s.events])),
    ):
        never = int(np.sum(~np.isfinite(times)))
        note = (
            f"median {np.median(times):.3f} s, 95 % within {np.quantile(times, 0.95, method='higher'):.3f} s"
        )
        note += f"; above the limit: {int(np.sum(times > limit))} of {len(times)}"
        note += f", never: {never}" if never else ""
        rows.append(at_most(f"{name}: {what}, worst", limit, float(times.max()), "s", note))
    rows.append(_false_row(group, f"{name}: changes counted that did not happen"))
    return rows


def _false_row(group: Sequence[Seen], what: str) -> Row:
    false = [t for s in group for t in s.false]
    early = sum(t < SETTLED for t in false)
    hours = sum(float(s.time[-1]) for s in group) / 3600.0
    note = f"in {hours:.2f} h, {len(group)} runs; {early} of them in a run's first {SETTLED:g} s"
    if not false:
        note += f"; so with 95 % confidence below {3.0 / hours:.1f} per hour"
    return told(what, len(false), "1", note)


def _quiet_rows(group: Sequence[Seen], name: str, held: bool) -> list[Row]:
    true, text = (MASS, "object held all the time") if held else (0.0, "empty hand")
    wrong = [float(np.abs(s.mass - true)[s.ok].max(initial=0.0)) for s in group]
    late = [float(np.abs(s.mass - true)[s.ok & (s.time >= SETTLED)].max(initial=0.0)) for s in group]
    note = f"from {SETTLED:g} s on {1e3 * max(late):.2f} g"
    return [
        _false_row(group, f"{name}, {text}: changes counted that did not happen"),
        told(f"{name}, {text}: largest error marked ok", 1e3 * max(wrong), "g", note),
    ]


def _draw(seen: Sequence[Seen]) -> dict[str, Any]:
    busy = [s for s in seen if not s.job.quiet and s.filter == DEFAULT]
    figures = {}
    times = {}
    for fed_back, control in ((True, FED_BACK), (False, PUBLISHED)):
        group = [s for s in busy if bool(s.job.fed_back) == fed_back]
        figures[f"Object taken and dropped, {control}, default filter"] = _figures.curves(
            {s.job.pose: (s.time, 1e3 * s.mass) for s in group if s.job.seed == 0},
            "mass [g]",
            level=(1e3 * MASS, "object"),
            limits=(3.0, _bench.SECONDS, -150.0, 500.0),
        )
        times[f"found, {control}"] = np.sort([e.found for s in group for e in s.events])
        times[f"within 5 %, {control}"] = np.sort([e.weighed for s in group for e in s.events])
    figures["How long it takes, sorted"] = _figures.curves(
        {name: (values, np.linspace(0.0, 1.0, len(values))) for name, values in times.items()},
        "share of changes",
        across="time after the change [s]",
        limits=(0.0, 2.0, 0.0, 1.02),
    )
    return figures
