"""Live, offline, replayed and chunked: the same bits. And what `import palpate` costs."""

from __future__ import annotations

import io
import json
import statistics
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._core import ContactDetector, MomentumObserver, PayloadFilter, WrenchEstimator
from ..arm import Arm, Array
from ..control import Quintic
from ..drivers.mujoco import MujocoDriver
from ..drivers.replay import ReplayDriver
from ..logs import Log, Recorder, Sample
from ..pipeline import ESTIMATORS, OBSERVERS, Pipeline, Touch
from ..simulate import Attach, Fault, Release, Schedule, SensorModel
from . import Progress, Row, _bench
from ._bench import POSES, PublishedLaw, Work
from ._rows import at_most, near

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SECONDS = 8.0
CHUNKS = (1, 7, 250, 3, 1000)
"""samples per piece, over and over"""
IMPORTS = 9
IMPORT_LIMIT = 0.1
"""[s], after numpy"""
WHEEL_LIMIT = 3.0
"""[MB]"""
_IMPORT = "import numpy, time; t = time.perf_counter(); import palpate; print(time.perf_counter() - t)"


@dataclass(frozen=True, slots=True)
class Job:
    """One recording."""

    faulty: bool
    """clock jitter, lost samples, NaN, absurd numbers, stuck encoders, a clock that jumps back"""
    seconds: float


class Found(NamedTuple):
    """What was compared."""

    samples: int
    pipelines: int
    ways: dict[str, tuple[int, int]]
    """(numbers compared with those of the live run, how many have another bit) by way"""


def pipelines(arm: Arm) -> dict[str, Pipeline]:
    """Every observer with every estimator, the force and contact estimators behind one, by name."""
    touch = Pipeline(arm, observer=MomentumObserver(), wrench=WrenchEstimator(), contact=ContactDetector())
    made = {
        "wrench and contact": touch,
        "payload-filter": Pipeline(arm, payload=PayloadFilter()),
        "payload-filter, first moment": Pipeline(arm),
    }
    for name, observer in OBSERVERS.items():
        made[name] = Pipeline(arm, observer=observer(), payload=None)
        for weigher, estimator in ESTIMATORS.items():
            made[f"{name}, {weigher}"] = Pipeline(arm, observer=observer(), payload=estimator())
    return made


def measure(job: Job) -> Found:
    """Run one job."""
    arm = _bench.reference_arm()
    live = pipelines(arm)
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "run.mcap"
        with Recorder(bag, arm.joint_names) as recorder:
            samples = list(_live(arm, job, recorder, live))
        results = {name: np.array([row[name] for row in samples]) for name in live}
        log = Log.open(bag, keep_invalid=True)
        table = Path(folder) / "run.npz"
        log.save(table)
        other = Log.open(table, keep_invalid=True)
    ways = {}
    again = {name: _rebuilt(arm, pipeline) for name, pipeline in live.items()}
    runs: dict[str, Callable[[Pipeline], Array]] = {
        "offline: one batch out of the MCAP recording": lambda p: _rows(p.run(log)),
        "offline: one batch out of an NPZ copy": lambda p: _rows(p.run(other)),
        "replayed through the driver, sample by sample": lambda p: _replayed(log, p),
        "in pieces of " + ", ".join(map(str, CHUNKS)) + " samples": lambda p: _chunked(log, p),
    }
    for way, run in runs.items():
        numbers = different = 0
        for name, pipeline in again.items():
            pipeline.reset()
            got = run(pipeline)
            numbers += results[name].size
            different += _different(results[name], got)
        ways[way] = (numbers, different)
    return Found(len(samples), len(live), ways)


def _live(
    arm: Arm, job: Job, recorder: Recorder, pipelines: Mapping[str, Pipeline]
) -> Iterator[dict[str, Array]]:
    """What every pipeline says of each sample, as it comes, while it is recorded."""
    faults = (
        Fault("nan", 2.0, 2.1),
        Fault("huge", 3.0, 3.02, joint=2),
        Fault("stuck", 4.0, 4.5, joint=5),
        Fault("backwards", 5.0, 5.02),
        Fault("lost", 6.0, 6.4),
    )
    sensor = SensorModel(
        arm,
        noise_counts=_bench.NOISE_COUNTS,
        jitter=5e-4 if job.faulty else 0.0,
        loss=0.02 if job.faulty else 0.0,
        faults=faults if job.faulty else (),
    )
    schedule = Schedule([Attach(2.5, _bench.brick()), Release(5.5)])
    setpoint = Quintic(np.zeros(arm.n), POSES["goal"], _bench.MOVING)
    law = PublishedLaw(arm)
    driver = MujocoDriver(arm, sensor=sensor, schedule=schedule)
    driver.connect()
    driver.enable()
    for k in range(round(job.seconds * 1e9 / driver.period_ns) + 1):
        sample = driver.read()
        if sample is not None:
            # what a controller that knows the bare arm would tell
            model = arm.gravity_torque(driver.plant.q)
            sample = Sample(sample.time_ns, sample.position, sample.velocity, sample.effort, model)
            recorder.sample(*sample)
            yield {name: _row(p.step(sample)) for name, p in pipelines.items()}
        # the arm is steered by the truth: what comes here must not depend on a pipeline
        truth = Sample(driver.plant.time_ns, driver.plant.q, None, driver.plant.torque)
        driver.write(law.torque(truth, setpoint.sample(k * driver.period_ns * 1e-9)))
    driver.close()


def _rebuilt(arm: Arm, pipeline: Pipeline) -> Pipeline:
    """The pipeline as another program would build it: from its options as text."""
    return Pipeline.from_options(arm, json.loads(json.dumps(pipeline.options())))


def _row(touch: Touch) -> Array:
    """Everything in a Touch of one sample as 64-bit words, (k,)."""
    return np.concatenate([_words(value).ravel() for value in _values(touch)])


def _rows(touch: Touch) -> Array:
    """Everything in a Touch of N samples as 64-bit words, (N, k)."""
    rows = len(touch.time_ns)
    return np.concatenate([_words(value).reshape(rows, -1) for value in _values(touch)], axis=1)


def _values(record: Any) -> Iterator[Any]:
    """All numbers of nested records, in the order of their fields; what was not asked for is left out."""
    for field in fields(record):
        value = getattr(record, field.name)
        if is_dataclass(value):
            yield from _values(value)
        elif value is not None:
            yield value


def _words(value: Any) -> Array:
    array = np.asarray(value)
    if array.dtype == np.float64:
        return np.ascontiguousarray(array).view(np.int64)
    if array.dtype == object:  # a Status
        return np.array(int(value))
    return array.astype(np.int64)


def _replayed(log: Log, pipeline: Pipeline) -> Array:
    driver = ReplayDriver(log)
    rows = []
    with driver:
        while not driver.finished:
            sample = driver.read()
            assert sample is not None
            rows.append(_row(pipeline.step(sample)))
    return np.array(rows)


def _chunked(log: Log, pipeline: Pipeline) -> Array:
    rows, begin, k = [], 0, 0
    while begin < len(log):
        end = begin + CHUNKS[k % len(CHUNKS)]
        rows.append(_rows(pipeline.run(log[begin:end])))
        begin, k = end, k + 1
    return np.concatenate(rows)


def _different(a: Array, b: Array) -> int:
    return int(np.sum(a != b)) if a.shape == b.shape else max(a.size, b.size)


def import_seconds(times: int = IMPORTS) -> list[float]:
    """How long `import palpate` takes in fresh interpreters that have numpy already; the first, cold one left "
    "out."""
    found = []
    for _ in range(times + 1):
        done = subprocess.run(
            [sys.executable, "-c", _IMPORT], check=True, capture_output=True, text=True, timeout=60
        )
        found.append(float(done.stdout))
    return found[1:]


def packed_size() -> tuple[int, int]:
    """Bytes of the installed package, compressed as a wheel is, and its number of files."""
    root = Path(__file__).parents[1]
    out = io.BytesIO()
    files = [p for p in sorted(root.rglob("*")) if p.is_file() and "__pycache__" not in p.parts]
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as wheel:
        for path in files:
            wheel.write(path, path.relative_to(root.parent).as_posix())
    return len(out.getvalue()), len(files)


def run(progress: Progress, quick: bool) -> tuple[list[Row], Mapping[str, Figure], list[str]]:
    """Measure; `quick` on two seconds."""
    jobs = [Job(False, 2.0 if quick else SECONDS), Job(True, 2.0 if quick else SECONDS)]
    with Work(progress, len(jobs)) as work:
        found = work.map(measure, jobs)
    rows = []
    for job, result in zip(jobs, found, strict=True):
        name = "faulty input" if job.faulty else "clean input"
        for way, (numbers, different) in result.ways.items():
            what = f"{name}, {way}: numbers that differ from the live run"
            note = f"{numbers} numbers: {result.pipelines} pipelines, {result.samples} samples"
            rows.append(near(what, 0, different, 0, "1", note))
    seconds = import_seconds()
    note = f"median of {len(seconds)} fresh interpreters, worst {max(seconds):.3f} s"
    rows.append(at_most("import palpate, after numpy", IMPORT_LIMIT, statistics.median(seconds), "s", note))
    size, files = packed_size()
    note = f"the installed package's {files} files, compressed as a wheel is"
    rows.append(at_most("size of the wheel", WHEEL_LIMIT, size / 1e6, "MB", note))
    notes = [
        "Live: every pipeline steps through the samples of a simulated run as they come, while it is recorded "
        "to MCAP. The "
        "others are rebuilt from their options as JSON. Compared word by word: time, state, external torque, "
        "load, standard "
        "deviations, every status. Faulty input: jitter, 2 % loss, NaN, 1e300, a stuck encoder, a clock "
        "running backwards, "
        "a gap of 0.4 s.",
    ]
    return rows, {}, notes
