"""One path: live, offline, replayed and chunked give the same bits; bad input gives an error or a status."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import fields, is_dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate.drivers.mujoco import MujocoDriver
from palpate.drivers.replay import ReplayDriver
from palpate.pipeline import ESTIMATORS, OBSERVERS
from palpate.simulate import Load, SensorModel

PIPELINES = {
    "payload-filter": lambda arm: pp.Pipeline(arm),
    "payload-filter beside extended-kalman": lambda arm: pp.Pipeline(arm, observer=pp.ExtendedKalman()),
    "regression on momentum": lambda arm: pp.Pipeline(
        arm, observer=pp.MomentumObserver(), payload=pp.Regression(first_moment=True, lag=1 / 30)
    ),
    "joint-formula on sliding-mode": lambda arm: pp.Pipeline(
        arm, observer=pp.SlidingModeObserver(cutoff=10.0), payload=pp.JointFormula(joint=5)
    ),
    "payload-filter, momentum, wrench and contact": lambda arm: pp.Pipeline(
        arm, observer=pp.MomentumObserver(), wrench=pp.WrenchEstimator(), contact=pp.ContactDetector()
    ),
    "disturbance-kalman": lambda arm: pp.Pipeline(arm, observer=pp.DisturbanceKalman(), payload=None),
    "super-twisting": lambda arm: pp.Pipeline(arm, observer=pp.MomentumSuperTwisting(), payload=None),
    "joint-formula on inverse-dynamics": lambda arm: pp.Pipeline(
        arm,
        observer=pp.InverseDynamicsObserver(),
        payload=pp.JointFormula(),
        conditioner=pp.Conditioner(differentiate=True, points=4, max_gap=0.05),
    ),
}
MASS = 0.25


def flat(touch: pp.Touch) -> dict[str, np.ndarray]:
    """Every array of a Touch by its name."""
    found = {}
    for f in fields(touch):
        value = getattr(touch, f.name)
        if value is None:  # not asked for
            continue
        if is_dataclass(value):
            found |= {f"{f.name}.{g.name}": np.asarray(getattr(value, g.name)) for g in fields(value)}
        else:
            found[f.name] = np.asarray(value)
    return found


def stack(touches: list[pp.Touch]) -> dict[str, np.ndarray]:
    """Touches of single samples as one of many."""
    rows = [flat(t) for t in touches]
    return {
        name: np.array([int(r[name]) if r[name].dtype == object else r[name] for r in rows])
        for name in rows[0]
    }


def assert_same_bits(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        x, y = (np.asarray(v, dtype=np.float64) for v in (a[name], b[name]))
        assert x.shape == y.shape, name
        different = np.flatnonzero((x.view(np.int64) != y.view(np.int64)).reshape(len(x), -1).any(axis=1))
        assert not different.size, f"{name}: {different.size} rows differ, first {different[0]}"


@pytest.fixture(scope="module")
def arm() -> pp.Arm:
    return pp.robots.load("justina_left_arm")


@pytest.fixture(scope="module")
def samples(arm: pp.Arm) -> list[pp.logs.Sample]:
    """Four seconds of an arm that lifts 0.25 kg, jitter and losses included."""
    sensor = SensorModel(arm, noise_counts=2, jitter=1e-3, loss=0.02, seed=5)
    driver = MujocoDriver(arm, payload=Load.box(MASS, (0.07, 0.07, 0.005)), sensor=sensor)
    controller = pp.Controller(arm, 2.5, 1.0)
    motion = pp.Quintic(np.zeros(arm.n), [0.0, -0.5, 0.5, 1.0, 0.0, 1.0, -0.3], 2.0)
    found = []
    with driver:
        driver.enable()
        for k in range(1000):
            sample = driver.read()
            if sample is not None:
                found.append(
                    sample._replace(time_ns=sample.time_ns + 1_000_000)
                )  # a bag holds no time before 0
            torque, _ = controller.step(motion.sample(k * 0.004), driver.plant.q, driver.plant.dq)
            driver.write(torque)
    return found


def as_log(samples: list[pp.logs.Sample], arm: pp.Arm) -> pp.Log:
    return pp.Log(
        time_ns=np.array([s.time_ns for s in samples]),
        position=np.array([s.position for s in samples]),
        effort=np.array([s.effort for s in samples]),
        joint_names=arm.joint_names,
    )


@pytest.fixture(scope="module")
def log(samples: list[pp.logs.Sample], arm: pp.Arm) -> pp.Log:
    return as_log(samples, arm)


@pytest.fixture(scope="module")
def damaged(log: pp.Log) -> pp.Log:
    """The same log as it might have been received: NaN, absurd numbers, time running backwards, a gap."""
    time_ns, q, effort = (np.array(a) for a in (log.time_ns, log.position, log.effort))
    q[500, 3] = np.nan
    q[501] = 1e300
    effort[502, 0] = -1e300
    effort[503, 6] = np.inf
    time_ns[600] = time_ns[590]
    time_ns[601] = time_ns[599]
    time_ns[700:] += 400_000_000
    return pp.Log(time_ns=time_ns, position=q, effort=effort, joint_names=log.joint_names)


@pytest.mark.parametrize("name", PIPELINES)
@pytest.mark.parametrize("which", ["log", "damaged"])
def test_live_offline_replayed_and_chunked_are_the_same_bits(
    name: str, which: str, arm: pp.Arm, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    log: pp.Log = request.getfixturevalue(which)
    build = PIPELINES[name]
    live_pipeline = build(arm)
    live = stack([live_pipeline.step(sample) for sample in log])

    offline_pipeline = build(arm)
    assert_same_bits(live, flat(offline_pipeline.run(log)))
    offline_pipeline.reset()
    assert_same_bits(live, flat(offline_pipeline.run(log)))

    chunked = build(arm)
    edges = [0, 1, 2, 7, 333, 334, 601, len(log)]
    parts = [flat(chunked.run(log[a:b])) for a, b in pairwise(edges)]
    assert_same_bits(live, {name: np.concatenate([p[name] for p in parts]) for name in parts[0]})

    path = tmp_path / "log.mcap"
    with pp.Recorder(path, log.joint_names) as recorder:
        for sample in log:
            recorder.sample(*sample)
    read = pp.Log.open(path, keep_invalid=True)
    assert_same_bits(live, flat(build(arm).run(read)))

    driver, again = ReplayDriver(read), build(arm)
    touches = []
    with driver:
        while not driver.finished:
            sample = driver.read()
            assert sample is not None
            touches.append(again.step(sample))
    assert_same_bits(live, stack(touches))

    options = json.loads(json.dumps(build(arm).options()))
    assert_same_bits(live, flat(pp.Pipeline.from_options(arm, options).run(log)))


def test_the_same_bits_in_another_process(arm: pp.Arm, log: pp.Log, tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    log.save(path)
    code = (
        "import hashlib, sys, palpate as pp; arm = pp.robots.load('justina_left_arm'); "
        "t = pp.Pipeline(arm, observer=pp.ExtendedKalman()).run(pp.Log.open(sys.argv[1])); "
        "print(hashlib.sha256(t.payload.mass.tobytes() + t.external.torque.tobytes() + t.q.tobytes()).hexdigest())"
    )
    runs = {
        subprocess.run(
            [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    }
    assert len(runs) == 1


def test_damage_gets_a_status_and_the_estimate_recovers(arm: pp.Arm, log: pp.Log, damaged: pp.Log) -> None:
    clean, touch = pp.Pipeline(arm).run(log), pp.Pipeline(arm).run(damaged)
    names = np.array(pp.status_names(touch.status))
    assert (names[500:504] == "non_finite").all()
    assert (names[600:602] == "time_error").all()
    assert names[700] == "gap"
    bad = np.r_[500:504, 600:602]
    assert "ok" not in pp.status_names(touch.payload.status[bad])
    # the last good number is repeated, and nothing absurd is left in any output
    assert (touch.payload.mass[bad] == touch.payload.mass[bad[0] - 1]).sum() >= 4
    for name, values in flat(touch).items():
        assert np.isfinite(np.asarray(values, dtype=np.float64)).all(), name
    assert names[504] == names[602] == "ok"
    assert pp.status_names(touch.payload.status[[510, -1]]) == ["ok", "ok"]
    assert abs(touch.payload.mass[-1] - MASS) < 0.02 * MASS
    assert abs(touch.payload.mass[-1] - clean.payload.mass[-1]) < 0.01 * MASS
    assert_same_bits({"m": clean.payload.mass[:500]}, {"m": touch.payload.mass[:500]})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e300])
@pytest.mark.parametrize("name", PIPELINES)
def test_nothing_in_a_sample_can_poison_the_state(name: str, value: float, arm: pp.Arm, log: pp.Log) -> None:
    pipeline = PIPELINES[name](arm)
    n = arm.n
    for k, sample in enumerate(log[:400]):
        if k % 50 == 10:
            sample = sample._replace(position=np.full(n, value))
        elif k % 50 == 20:
            sample = sample._replace(effort=np.full(n, value))
        elif k % 50 == 30:
            sample = sample._replace(velocity=np.full(n, value), position=np.full(n, value))
        touch = pipeline.step(sample)
        if k % 50 in (10, 20, 30):
            assert touch.status == pp.Status.non_finite
            assert touch.payload.status != pp.Status.ok and touch.external.status != pp.Status.ok
    assert touch.status == pp.Status.ok
    for values in flat(touch).values():
        if values.dtype != object:
            assert np.isfinite(values).all()


def test_wrong_inputs_are_named(arm: pp.Arm, log: pp.Log, samples: list[pp.logs.Sample]) -> None:
    pipeline = pp.Pipeline(arm)
    sample = samples[0]
    for bad in (
        sample._replace(position=np.zeros(6)),
        sample._replace(effort=np.zeros((7, 1))),
        sample._replace(velocity=np.zeros(8)),
        sample._replace(model_torque=np.zeros(3)),
        sample._replace(position=None),
        sample._replace(time_ns="now"),
    ):
        with pytest.raises(pp.InputError, match="sample"):
            pipeline.step(bad)
    with pytest.raises(pp.InputError, match=r"6 joints .* has 7 .*select"):
        pipeline.run(log.select(log.joint_names[:6]))
    silent = pp.Log(
        time_ns=log.time_ns,
        position=log.position,
        effort=np.full(log.position.shape, np.nan),
        joint_names=arm.joint_names,
    )
    with pytest.raises(pp.InputError, match="no effort"):
        pipeline.run(silent)
    with pytest.raises(pp.ArmError, match="does not say what its driver's effort is"):
        pp.Pipeline(arm.replace(effort=pp.Effort.undeclared()))
    with pytest.raises(pp.InputError, match="choose an observer"):
        pp.Pipeline(arm, payload=pp.Regression())
    with pytest.raises(pp.InputError, match="bandwidth"):
        pp.Pipeline(arm, observer=pp.MomentumObserver(bandwidth=-1.0))
    with pytest.raises(pp.InputError, match="'momentum'"):
        pp.Pipeline.from_options(arm, {"observer": {"name": "momentun"}})
    with pytest.raises(pp.InputError, match="unknown option 'speed'"):
        pp.Pipeline.from_options(arm, {"observer": {"name": "momentum", "speed": 1.0}})


@pytest.mark.parametrize("observer", [None, *OBSERVERS])
@pytest.mark.parametrize("payload", [None, *ESTIMATORS])
def test_options_come_back(observer: str | None, payload: str | None, arm: pp.Arm) -> None:
    if observer is None and payload in ("joint-formula", "regression"):
        return
    pipeline = pp.Pipeline(
        arm,
        observer=OBSERVERS[observer]() if observer else None,
        payload=ESTIMATORS[payload]() if payload else None,
        conditioner=pp.Conditioner(points=5),
    )
    options = pipeline.options()
    text = json.dumps(options, allow_nan=False)
    assert pp.Pipeline.from_options(arm, json.loads(text)).options() == options


def test_import_needs_numpy_alone() -> None:
    """How long it takes is measured by `palpate bench replay`."""
    code = (
        "import numpy, sys; before = set(sys.modules); import palpate; "
        "print(*sorted({m.split('.')[0] for m in set(sys.modules) - before} - set(sys.stdlib_module_names)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"palpate", "numpy"}
