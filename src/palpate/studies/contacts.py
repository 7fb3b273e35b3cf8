"""Contacts on a real UR10e, and a long campaign in simulation: false alarms, and how soon a contact is found."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _core, robots
from .._core import ContactDetector, MomentumObserver
from ..arm import Arm, Array, Effort, Friction, Sensing
from ..data import VARIABLE
from ..logs import ColumnMap, Log
from ..pipeline import ContactEvent, Pipeline, contact_noise
from . import Progress, Row
from ._bench import Work
from ._kept import Kept
from ._rows import at_most, told

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATE = 1000.0
"""of the simulated arms [Hz]"""
CHUNK = 300.0
"""of the campaign, one job [s]"""
HOURS = 100.0
"""of the campaign, per arm"""
ALARMS_PER_HOUR = 3.55e-3
"""that the detector is asked for: at this mean rate 100 h hold one alarm or none in 95 of 100 campaigns (Poisson)"""
FASTEST = 1.5
"""of the simulated motion [rad/s]"""
HARD = 37.5e3
"""rise of a hard contact's force [N/s]: 0.25 m/s against 150 N/mm, a skull in ISO/TS 15066"""
HARD_MOST = 300.0
"""[N]"""
SOFT = 100.0
"""rise of a soft contact's force [N/s]"""
TRIALS = 200
"""contacts of each kind, per arm"""
ONSET = 0.15
"""how far an onset may be from its label [s]; the labels themselves are good to 0.1 s"""

GAINS = (11.976, 11.976, 9.839, 10.763, 10.763, 10.763)
"""of the UR10e's drives [N m/A]"""
FREE = (
    "identification_data/ur-20_01_31-unload.csv",
    "identification_data/ur-20_02_10-30sec_12harm.csv",
    "identification_data/ur-20_02_12-40sec_12harm.csv",
    "identification_data/ur-20_02_19_14harm50sec.csv",
)
"""what model and noise are learnt from"""
UNSEEN = (
    "validation_data/ur-20_01_17-ptp_10_points.csv",
    "collision_detection_data/collision_free.csv",
    "jointwise_motion/ur-20_01_22-joint_2.csv.gz",
)
"""free motion that had no part in it"""
HITS = "collision_detection_data/collision_2link.csv"
PUSHES = "collision/ur-20_01_22-push_pose_1.csv"
PUSHED = ((1.8, 2.6), (4.6, 5.7), (8.2, 9.3), (11.9, 13.0))
"""when, since the log's start [s]"""


# --- the real arm -----------------------------------------------------------------------------------------------------


def recordings() -> Path | None:
    """Folder of the UR10e's recordings, if it is on this machine."""
    named = os.environ.get(VARIABLE)
    found = Path(named) / "ur10e_innopolis" if named else None
    return found if found is not None and found.is_dir() else None


def open_recording(folder: Path, name: str) -> Log:
    """A recording of the UR10e."""
    return Log.open(folder / name, ColumnMap.named("ur10e_wrench" if "collision_" in name else "ur10e"))


def identified(folder: Path) -> tuple[Arm, ContactDetector]:
    """The arm identified from its free logs, its noise with it, and the detector that goes with both."""
    from ..identify import fit

    logs = [open_recording(folder, name) for name in FREE]
    start = Arm.from_urdf(folder / "ur10e.urdf", tip="tool0", effort=Effort.current(GAINS))
    arm = fit(start, logs, cross_validate=False).arm
    noise = contact_noise(arm, logs)
    return noise.arm(arm), noise.detector(false_alarms_per_hour=ALARMS_PER_HOUR)


def events(arm: Arm, detector: ContactDetector, log: Log) -> list[tuple[float, ContactEvent]]:
    """Onsets [s] since the log's first sample, and the contacts."""
    found = Pipeline(arm, observer=MomentumObserver(), payload=None, contact=detector).run(log).contact
    assert found is not None
    begin = int(log.time_ns[0])
    return [((e.onset_time_ns - begin) * 1e-9, e) for e in found.events()]


def real_rows(folder: Path, arm: Arm, detector: ContactDetector) -> list[Row]:
    """Hits, pushes and free motion of the UR10e."""
    labels = json.loads((folder / "collision_detection_data/contact_labels.json").read_text(encoding="utf-8"))
    truth = [float(c["rel_on"]) for c in labels["files"][Path(HITS).name]]
    hits = events(arm, detector, open_recording(folder, HITS))
    near = [min(hits, key=lambda h, t=t: abs(h[0] - t), default=None) for t in truth]  # type: ignore[misc]
    met = [h for t, h in zip(truth, near, strict=True) if h is not None and abs(h[0] - t) <= 2.0 * ONSET]
    away = [abs(h[0] - t) for t, h in zip(truth, near, strict=True) if h in met and h is not None]
    extra = [h for h in hits if all(h[1] is not m[1] for m in met)]
    second = sum(e.link == 1 for _, e in met)
    felt = [f"{e.torque[1] / e.std[1]:.1f}" for _, e in met if e.link == 0]
    allowed = sum(e.link <= 1 <= e.farthest for _, e in met)
    rows = [
        _all("UR10e, hits on link 2: found", len(truth), len(met), f"labels within {2.0 * ONSET:g} s"),
        _all(
            "UR10e, hits on link 2: link 2 named",
            len(truth),
            second,
            f"of {len(met)} found; {allowed} say link 2 or beyond is possible; pushed along the axis of joint 2, only "
            f"joint 1 feels it: in those named link 1 joint 2 bears {', '.join(felt)} standard deviations",
        ),
        at_most("UR10e, hits: onset off the label, worst", ONSET, max(away, default=math.inf), "s"),
        at_most(
            "UR10e, hits: contacts without a label",
            0,
            len(extra),
            "",
            _where(extra),
        ),
    ]
    pushes = events(arm, detector, open_recording(folder, PUSHES))
    first = [min((t for t, _ in pushes if a - ONSET <= t <= b), default=None) for a, b in PUSHED]
    late = [t - a for t, (a, _) in zip(first, PUSHED, strict=True) if t is not None]
    rows.append(
        _all("UR10e at rest, pushes: found", len(PUSHED), len(late), f"{len(pushes)} contacts in the log")
    )
    rows.append(
        at_most(
            "UR10e at rest, pushes: onset after the push began, worst",
            ONSET,
            max(late, default=math.inf),
            "s",
            ", ".join(f"{x:+.2f}" for x in late) + " s; begins are read off to 0.1 s",
        )
    )
    for name in (*FREE, *UNSEEN):
        log = open_recording(folder, name)
        found = events(arm, detector, log)
        note = f"{log.duration:.0f} s" + (f"; {_where(found)}" if found else "")
        rows.append(
            at_most(f"UR10e, free: contacts in {Path(name).name.split('.')[0]}", 0, len(found), "", note)
        )
    return rows


def _where(found: Sequence[tuple[float, ContactEvent]]) -> str:
    """When contacts began, and what the joint felt that felt most."""
    parts = []
    for t, e in found:
        j = int(np.argmax(np.abs(e.torque / e.std)))
        parts.append(f"{t:.2f} s: {e.torque[j]:+.3g} ± {1.96 * e.std[j]:.2g} N m on joint {j + 1}")
    return "; ".join(parts)


def _all(what: str, required: int, ours: int, note: str = "") -> Row:
    return Row(what, required, ours, None, ours == required, "", note)


# --- the simulated arms -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Plant:
    """An arm, what its model gets wrong, and the detector that is told so."""

    name: str
    arm: Arm
    centre: tuple[float, ...]
    """of the motion [rad]"""
    model_std: tuple[float, ...]
    """slow error of each joint [N m]"""
    model_time: float
    """how long it lasts [s]"""
    friction_error: float
    """largest error of dry friction, part of it"""
    options: tuple[tuple[str, Any], ...]
    """the detector's, by name"""

    def detector(self) -> ContactDetector:
        """Told of these errors."""
        return ContactDetector(**dict(self.options))


@dataclass(frozen=True, slots=True)
class Job:
    """A stretch of free motion, or one contact if `rise` is given."""

    plant: Plant
    seconds: float
    seed: int
    rise: float = 0.0
    """of the force [N/s]"""
    most: float = 0.0
    """of the force [N]"""

    @property
    def name(self) -> str:
        """To keep the result by."""
        return f"{self.plant.name} {self.seconds:g} s seed {self.seed} rise {self.rise:g} to {self.most:g}"


@dataclass(frozen=True, slots=True)
class Found:
    """What a job found."""

    contacts: int
    delay: float = math.nan
    """from touch to alarm [s]; NaN: none was wanted, infinite: missed"""
    early: bool = False
    """an alarm before the touch"""
    bound: float = math.nan
    """the delay of a test that knows what no test can know, see :func:`shortest` [s]"""
    resting: bool = False
    """every joint rests when the arm is touched"""


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """What a simulated arm feels from the touch on, and what hides it."""

    time: float
    """of the touch [s]"""
    torque: Array
    """(K, n) of the contact at the joints [N m]"""
    friction: Array
    """(K, n) dry friction [N m]"""
    stiction: Array
    """(K, n) what friction may be while the joint rests, +- [N m]; zero in motion"""


def iiwa() -> Plant:
    """A KUKA LBR iiwa 14: joint torque sensors, little friction beyond them."""
    arm = robots.load("kuka_lbr_iiwa14")
    sensing = Sensing(position_std=1e-6, velocity_std=2e-4, torque_std=0.1)
    joints = tuple(
        j.replace(sensing=sensing, rotor_inertia=0.0, friction=Friction(coulomb=0.5, viscous=0.3))
        for j in arm.joints
    )
    slow = 0.3
    options = {"model_std": [slow] * arm.n, "model_time": 1.0, "friction_fraction": 0.3}
    return Plant(
        "iiwa",
        arm.replace(joints=joints, effort=Effort.torque()),
        (0.1, 0.6, 0.0, -1.3, 0.2, 0.7, 0.0),
        (slow,) * arm.n,
        1.0,
        0.3,
        tuple((options | {"false_alarms_per_hour": ALARMS_PER_HOUR}).items()),
    )


def ur10e(arm: Arm, detector: ContactDetector) -> Plant:
    """The identified UR10e with the errors measured on it, sampled faster."""
    options = {
        k: list(v) if isinstance(v, tuple) else v
        for k, v in detector.options().items()
        if k in ("model_std", "model_time", "friction_fraction", "false_alarms_per_hour")
    }
    return Plant(
        "UR10e-like",
        arm.replace(effort=Effort.torque()),
        (0.0, -1.2, 1.4, -1.0, -1.5, 0.0),
        tuple(detector.model_std),
        detector.model_time,
        0.0,
        tuple(options.items()),
    )


def motion(plant: Plant, seconds: float, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Quintic moves to and fro, some with a rest after them: q, dq, ddq and the sign of friction, (N, n) each."""
    arm, count = plant.arm, int(seconds * RATE)
    reach = np.array([j.friction.presliding or 1e-3 for j in arm.joints])
    centre = np.array(plant.centre)
    q = np.empty((count, arm.n))
    dq, ddq, sign = np.zeros_like(q), np.zeros_like(q), np.empty_like(q)
    at, z, k = centre.copy(), np.zeros(arm.n), 0
    while k < count:
        way = centre + rng.uniform(-0.6, 0.6, arm.n) - at
        lasts = max(rng.uniform(0.8, 3.0), 1.875 * float(np.abs(way).max()) / FASTEST)
        rows = min(max(int(lasts * RATE), 1), count - k)
        s = slice(k, k + rows)
        x = (np.arange(1, rows + 1) / (lasts * RATE))[:, None]
        q[s] = at + way * (10.0 * x**3 - 15.0 * x**4 + 6.0 * x**5)
        dq[s] = way * (30.0 * x**2 - 60.0 * x**3 + 30.0 * x**4) / lasts
        ddq[s] = way * (60.0 * x - 180.0 * x**2 + 120.0 * x**3) / lasts**2
        forward = np.sign(way)
        sign[s] = forward + (z - forward) * np.exp(-np.abs(q[s] - at) / reach)
        at, z, k = q[k + rows - 1].copy(), sign[k + rows - 1].copy(), k + rows
        if rng.random() < 0.3 and k < count:
            rows = min(int(rng.uniform(0.3, 2.0) * RATE), count - k)
            s = slice(k, k + rows)
            q[s] = at
            # the drive loads its gear anew without moving it: friction takes up whatever is within stiction
            other = rng.uniform(-1.0, 1.0, arm.n)
            sign[s] = z + (other - z) * (np.arange(1, rows + 1) / rows)[:, None]
            z, k = other, k + rows
    return q, dq, ddq, sign


def wander(std: Array, lasts: float, count: int, rng: np.random.Generator) -> Array:
    """Ornstein-Uhlenbeck errors (count, n) of deviation `std` (n,) that last so long [s]."""
    step = max(int(0.02 * lasts * RATE), 1)
    coarse = count // step + 2
    phi = math.exp(-step / (RATE * lasts))
    noise = rng.normal(size=(coarse, len(std))) * std
    out = np.empty_like(noise)
    out[0] = noise[0]
    for k in range(1, coarse):
        out[k] = phi * out[k - 1] + math.sqrt(1.0 - phi * phi) * noise[k]
    place = np.arange(count) / step
    low = place.astype(np.int64)
    part = (place - low)[:, None]
    return np.asarray(out[low] * (1.0 - part) + out[low + 1] * part)


def simulate(job: Job) -> tuple[Log, Push | None]:
    """The job's log, and what touches the arm in it."""
    plant, arm = job.plant, job.plant.arm
    rng = np.random.default_rng(job.seed)
    q, dq, ddq, sign = motion(plant, job.seconds, rng)
    f = [j.friction for j in arm.joints]
    static = np.array([x.coulomb if x.static is None else x.static for x in f])
    speed = np.array([math.inf if x.stribeck_velocity is None else x.stribeck_velocity for x in f])
    coulomb = np.array([x.coulomb for x in f])
    excess = np.where(np.isfinite(speed), (static - coulomb) * np.exp(-np.square(dq / speed)), 0.0)
    rigid = arm.inverse_dynamics(q, dq, ddq)
    gear = rigid - ddq * [j.rotor_inertia for j in arm.joints]
    wrong = 1.0 + plant.friction_error * rng.uniform(-1.0, 1.0, arm.n)
    level = wrong * (coulomb + excess + np.array([x.load for x in f]) * np.abs(gear))
    torque = rigid + level * sign + dq * [x.viscous for x in f] + np.array([x.offset for x in f])
    torque += wander(np.array(plant.model_std), plant.model_time, len(q), rng)
    torque[1:] = 0.5 * (torque[1:] + torque[:-1])  # a sample's torque is that of the period before it
    push = None
    if job.rise > 0.0:
        row = int((0.5 + 0.2 * rng.random()) * len(q))
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        force = np.minimum(job.rise * (np.arange(1, len(q) - row + 1) - 0.5) / RATE, job.most)
        jacobian = arm.jacobian(np.ascontiguousarray(q[row:]), point=arm.grasp)[:, :3]
        felt = np.einsum("kij,i->kj", jacobian, direction) * force[:, None]
        torque[row:] -= felt
        stiction = np.where(dq[row:] == 0.0, level[row:], 0.0)
        push = Push(row / RATE, felt, (level * sign)[row:], stiction)
    sensing = [j.sensing for j in arm.joints]
    log = Log(
        time_ns=np.rint(np.arange(len(q)) * (1e9 / RATE)).astype(np.int64),
        position=q,
        velocity=dq + rng.normal(size=q.shape) * [s.velocity_std or 0.0 for s in sensing],
        effort=torque + rng.normal(size=q.shape) * [s.torque_std for s in sensing],
        joint_names=arm.joint_names,
    )
    return log, push


def shortest(plant: Plant, push: Push) -> float:
    """How long any test needs until it finds this push in one of two cases [s]; infinite: never.

    The matched filter: it knows when and how the arm is pushed, the exact motion, friction and inertia, and the slow
    error at the touch; it does not know the white noise of the torque, how the slow error goes on, and where within
    stiction friction is at a resting joint. One test per its own length may alarm as often as the detector may. With
    innovations nu of the push in a Kalman filter of the slow error, d^2 = sum nu^2/S over joints and time; found in
    half the cases once d >= z, P(N(0, 1) > z) = rate T.
    """
    rest = push.stiction > 0.0
    borne = push.friction - push.torque  # what the motor of a resting joint bears in the place of friction
    hidden = np.sign(borne) * np.maximum(np.abs(borne) - push.stiction, 0.0)
    shown = np.where(rest, hidden, -push.torque)
    std = np.array(plant.model_std)
    R = np.array([j.sensing.torque_std for j in plant.arm.joints]) ** 2
    phi = math.exp(-1.0 / (RATE * plant.model_time))
    P, drift = np.zeros(plant.arm.n), (1.0 - phi * phi) * std**2
    for _ in range(int(20.0 * RATE * plant.model_time)):  # the slow error as known at the touch
        P = phi * phi * P * R / (P + R) + drift
    S = P + R
    taken, total = np.zeros(plant.arm.n), 0.0
    for k, row in enumerate(shown, 1):
        nu = row - taken
        total += float(np.sum(nu**2 / S))
        taken = phi * (taken + P / S * nu)
        chance = ALARMS_PER_HOUR / 3600.0 * k / RATE
        if total >= NormalDist().inv_cdf(1.0 - chance) ** 2:
            return k / RATE
    return math.inf


def measure(job: Job) -> Found:
    """Run one job."""
    log, push = simulate(job)
    contact = Pipeline(job.plant.arm, payload=None, contact=job.plant.detector()).run(log).contact
    assert contact is not None
    count = int(contact.count[-1])
    if push is None:
        return Found(count)
    times = np.unique(contact.alarm_time_ns[contact.count > 0]) * 1e-9
    after = times[times >= push.time - 1e-9]
    return Found(
        count,
        float(after[0] - push.time) if after.size else math.inf,
        bool((times < push.time - 1e-9).any()),
        shortest(job.plant, push),
        bool((push.stiction[0] > 0.0).all()),
    )


def campaign_rows(name: str, found: Sequence[Found], hours: float) -> list[Row]:
    """False alarms of one arm; fewer hours than are asked for prove nothing."""
    count = sum(f.contacts for f in found)
    enough = hours >= HOURS - 1e-6
    note = f"{ALARMS_PER_HOUR:g} per hour were asked for of the detector"
    return [
        Row(
            f"{name}, simulated: false alarms in {hours:.3g} h at 1 kHz",
            f"<= 1 in {HOURS:g} h",
            float(count),
            None,
            enough and count <= 1,
            "",
            note if enough else f"{HOURS:g} h are asked for; {note}",
        )
    ]


def delay_rows(name: str, kind: str, limit: float, found: Sequence[Found]) -> list[Row]:
    """How soon contacts of one kind are found: judged by the median, beside what is possible at all."""
    heard = [f for f in found if not f.early]

    def late(of: Sequence[Found], share: float, what: str = "delay") -> float:
        values = np.array([getattr(f, what) for f in of])
        return 1e3 * float(np.quantile(values, share, method="higher")) if len(of) else math.nan

    missed = sum(math.isinf(f.delay) for f in heard)
    rest = [f for f in heard if f.resting]
    move = [f for f in heard if not f.resting]
    before = f"{name}, simulated: {kind}, from touch to alarm"
    return [
        at_most(
            f"{before}, median",
            1e3 * limit,
            late(heard, 0.5),
            "ms",
            f"{len(heard)} contacts at the tip in random directions, {missed} missed; {len(found) - len(heard)} left "
            f"out for an alarm before; in motion {late(move, 0.5):.3g} ms, at rest {late(rest, 0.5):.3g} ms",
        ),
        told(f"{before}, 95 %", late(heard, 0.95), "ms"),
        told(
            f"{before}, median of the best possible test",
            late(heard, 0.5, "bound"),
            "ms",
            f"matched filter that knows onset, direction and friction; in motion {late(move, 0.5, 'bound'):.3g} ms, "
            f"at rest {late(rest, 0.5, 'bound'):.3g} ms; 95 % {late(heard, 0.95, 'bound'):.3g} ms",
        ),
    ]


def jobs_of(plants: Sequence[Plant], hours: float, trials: int) -> Iterator[Job]:
    """The campaign, then the contacts of every arm."""
    for k in range(max(round(hours * 3600.0 / CHUNK), 1)):
        for plant in plants:
            yield Job(plant, CHUNK, 1000 + k)
    for plant in plants:
        for k in range(trials):
            yield Job(plant, 4.0, 1_000_000 + k, HARD, HARD_MOST)
        for k in range(trials):
            yield Job(plant, 4.0, 2_000_000 + k, SOFT, 150.0)


def made_by(plants: Sequence[Plant]) -> str:
    """What results depend on: the arms, the detectors, the compiled core and the simulation."""
    digest = hashlib.sha256()
    for plant in plants:
        digest.update(plant.arm.to_header().encode())
        digest.update(repr((plant.name, *(getattr(plant, k) for k in Plant.__slots__[2:]))).encode())
    digest.update(Path(str(_core.__file__)).read_bytes())
    for part in (motion, wander, simulate, shortest, measure):
        digest.update(inspect.getsource(part).encode())
    return digest.hexdigest()


def run(
    progress: Progress, quick: bool, folder: Path | None = None, hours: float | None = None
) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick`: ten minutes and ten contacts per arm, nothing is kept.

    Args:
        folder: where results are kept, so that another run goes on from there; None: nowhere.
        hours: of the campaign per arm, instead of all.
    """
    wanted, trials = (CHUNK / 1800.0, 10) if quick else (HOURS if hours is None else hours, TRIALS)
    rows: list[Row] = []
    notes = [
        "Simulated: quintic moves with reversals and rests, white noise of torque and velocity, a slow error of the "
        "model, dry friction off by up to 30 % (iiwa), friction that remembers and, at rest, wanders anywhere within "
        "stiction.",
        f"A hard contact rises by {HARD / 1e3:g} N/ms (0.25 m/s against 150 N/mm) to {HARD_MOST:g} N, a soft one by "
        f"{SOFT:g} N/s.",
    ]
    plants = [iiwa()]
    real = recordings()
    if real is None:
        notes.append(
            f"No recordings of the UR10e here ({VARIABLE} names no folder with ur10e_innopolis): its rows are left out."
        )
    else:
        arm, detector = identified(real)
        rows += real_rows(real, arm, detector)
        plants.append(ur10e(arm, detector))
        notes.append(
            "UR10e: model, friction and noise are learnt from four free logs; labels and begins of pushes are read off "
            "residuals by others' eyes, the struck link is known from the file's name."
        )
    kept = Kept(None if quick or folder is None else folder / "contacts.state.jsonl", made_by(plants))
    if kept.discarded:
        notes.append(
            f"{kept.discarded} kept results came from other arms, another core or another study and were dropped."
        )
    jobs = list(jobs_of(plants, wanted, trials))
    left = [job for job in jobs if kept.get(job.name) is None]
    with Work(progress, len(left)) as work:
        work.map(measure, left, lambda k, found: kept.put(left[k].name, asdict(found)))
    for plant in plants:
        mine = [(job, Found(**kept.get(job.name))) for job in jobs if job.plant.name == plant.name]
        free = [f for j, f in mine if j.rise == 0.0]
        rows += campaign_rows(plant.name, free, len(free) * CHUNK / 3600.0)
        for kind, rise, limit in (("hard contact", HARD, 0.005), ("soft contact", SOFT, 0.030)):
            rows += delay_rows(plant.name, kind, limit, [f for j, f in mine if j.rise == rise])
    return rows, {}, notes
