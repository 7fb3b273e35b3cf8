"""The studies: their instruments measured against what is known, their published curve, their rows and figures."""

from __future__ import annotations

import dataclasses
import importlib
import math
import os
import pickle

import numpy as np
import pytest

from palpate import PalpateError, Pipeline, Quintic, Setpoint, robots
from palpate.pipeline import ESTIMATORS, OBSERVERS
from palpate.report import write_study
from palpate.simulate import Attach, Load, Plant, Schedule
from palpate.studies import (
    STUDIES,
    Row,
    Study,
    StudyResult,
    _bench,
    _bound,
    _figures,
    _rows,
    contacts,
    grasp_and_release,
    mass_estimation,
    payload_filter,
    pushes,
    replay,
    unknown_grasp,
    wrong_masses,
)
from palpate.studies._bench import MASS, POSES, FeedbackLaw, PublishedLaw, Work, settled
from palpate.studies._kept import Kept


@pytest.fixture(scope="module")
def arm():
    return _bench.reference_arm()


@pytest.fixture(scope="module")
def lifted(arm):
    """The object lifted from the hanging arm to the published goal."""
    return _bench.simulate(arm, PublishedLaw(arm), POSES["goal"], load=_bench.brick(), seconds=6.0, seed=1)


# --- the registry -----------------------------------------------------------------------------------------------------


def test_every_study_names_itself_and_knows_its_command():
    assert {s.verb for s in STUDIES.values()} == {"reproduce", "bench"}
    assert STUDIES["mass-estimation"].verb == "reproduce" and STUDIES["speed"].verb == "bench"
    for name, study in STUDIES.items():
        assert study.name == name and study.title and not study.title.endswith(".")
    with pytest.raises(TypeError):
        STUDIES["other"] = STUDIES["speed"]  # type: ignore[index]


@pytest.mark.parametrize("name", [n for n in STUDIES if n != "lara8"])
def test_every_study_has_a_module(name):
    assert callable(importlib.import_module(f"palpate.studies.{name.replace('-', '_')}").run)


def fake(rows, figures=(), notes=()):
    """A module whose study finds this."""

    class Module:
        @staticmethod
        def run(progress, quick):
            progress(1, 1, 0.0)
            return rows, dict(figures), list(notes)

    return Module


def test_a_quick_run_judges_nothing_and_says_so(monkeypatch):
    rows = [Row("a", "<= 1", 0.5, None, True, "s"), Row("b", "<= 1", 2.0, None, False, "s", "why")]
    monkeypatch.setattr(importlib, "import_module", lambda name: fake(rows))
    study = Study("some", "Some study", "bench")
    whole, quick = study.run(), study.run(quick=True)
    assert [r.ok for r in whole.rows] == [True, False] and not whole.ok
    assert [r.ok for r in quick.rows] == [None, None] and quick.ok
    assert [r.note for r in quick.rows] == ["quick run, not comparable", "quick run, not comparable; why"]
    assert "Quick run" in quick.notes[0] and [r.ours for r in quick.rows] == [0.5, 2.0]


def test_progress_is_passed_on(monkeypatch):
    seen = []
    monkeypatch.setattr(importlib, "import_module", lambda name: fake([]))
    result = Study("some", "Some study", "bench").run(lambda *word: seen.append(word))
    assert seen == [(1, 1, 0.0)] and result.seconds >= 0.0 and result.ok


def test_rows_judge():
    assert _rows.near("x", 1.0, 1.05, 0.1, "s").ok is True
    assert _rows.near("x", 1.0, 1.2, 0.1, "s").ok is False
    assert _rows.near("x", 1.0, math.nan, 0.1, "s").ok is False
    assert _rows.at_most("x", 2.0, math.inf, "s").ok is False
    assert _rows.at_most("x", 2.0, 1.0, "s", judged=False).ok is None
    assert _rows.at_most("x", 2.5, 1.0, "s").required == "<= 2.5"
    assert _rows.told("x", 1.0, "s", beside=2.0).ok is None


# --- measuring --------------------------------------------------------------------------------------------------------


def test_settled_is_for_good():
    time = np.arange(6) * 1.0
    assert settled(time, np.array([9, 1, 9, 1, -1, 1.0]), 2.0) == 3.0
    assert settled(time, np.zeros(6), 2.0) == 0.0
    assert settled(time, np.array([0, 0, 0, 0, 0, 9.0]), 2.0) == math.inf
    assert settled(time, np.array([0, math.nan, 0, 0, 0, 0.0]), 2.0) == 2.0
    assert settled(time, np.full(6, math.nan), 2.0) == math.inf


def test_rms_and_the_last_seconds():
    assert _bench.rms([3.0, -4.0]) == pytest.approx(math.sqrt(12.5))
    time = np.arange(0.0, 10.0, 0.1)
    assert time[_bench.last(time)].min() == pytest.approx(time[-1] - _bench.LAST + 0.1)
    assert _bench.late_percent(time, np.full(len(time), 0.01 * MASS)) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [1, 7])
def test_work_keeps_the_order_and_tells_how_far(count):
    words = []
    with Work(lambda *word: words.append(word), count) as work:
        assert work.map(abs, range(-count, 0)) == list(range(count, 0, -1))
    assert [done for done, _, _ in words] == list(range(count + 1))
    assert words[0] == (0, count, math.inf) and words[-1][2] == 0.0
    assert all(total == count and left >= 0.0 for _, total, left in words)


def test_work_passes_errors_on():
    with pytest.raises(ZeroDivisionError), Work(lambda *word: None, 3) as work:
        work.map(divide, [1, 0, 2])


def test_work_says_when_a_process_was_killed():
    with pytest.raises(PalpateError, match="killed from outside"), Work(lambda *word: None, 3) as work:
        work.map(os._exit, [1, 1, 1])


divide = (1).__truediv__  # bound methods of numbers travel to other processes


# --- the bench --------------------------------------------------------------------------------------------------------


def test_motion_is_repeatable_and_holds_the_truth(arm, lifted):
    again = _bench.simulate(arm, PublishedLaw(arm), POSES["goal"], load=_bench.brick(), seconds=1.0, seed=1)
    n = len(again.time)
    np.testing.assert_array_equal(again.position, lifted.position[:n])
    assert lifted.time[1] == 0.004 and len(lifted.time) == 1501
    count = np.array([j.sensing.position_resolution for j in arm.joints])
    noise = (lifted.position - np.rint(lifted.q / count) * count) / count
    assert set(np.rint(noise).astype(int).ravel()) == {-2, -1, 0, 1, 2}
    steps = lifted.effort / [j.sensing.torque_resolution for j in arm.joints]
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
    assert np.abs(lifted.effort[1:] - lifted.asked[1:]).max() < 0.0073  # a step, where the limit cuts one off
    np.testing.assert_array_equal(lifted.wanted[-1], [POSES["goal"], np.zeros(7)])


def test_a_log_of_a_motion_is_what_was_read(lifted):
    log = lifted.log()
    np.testing.assert_array_equal(log.effort, lifted.effort)
    np.testing.assert_array_equal(lifted.log(asked=True).effort, lifted.asked)
    assert log.time_ns[1] == 4_000_000


def test_what_a_loop_saw_is_what_a_fresh_pipeline_sees(arm):
    law = FeedbackLaw(Pipeline(arm))
    motion = _bench.simulate(arm, law, POSES["Take3"], load=_bench.brick(), seconds=2.0)
    payload = motion.weigh(Pipeline(arm)).payload
    touches = np.array(law.touches)
    np.testing.assert_array_equal(touches[:, 0], payload.mass)
    np.testing.assert_array_equal(touches[:, 1], payload.mass_std)


def test_setpoints_may_be_any_function_of_time(arm):
    way = Quintic(np.zeros(7), np.full(7, 0.1), 0.4)
    motion = _bench.simulate(arm, PublishedLaw(arm), lambda t: way.sample(t), seconds=0.5)
    assert isinstance(way.sample(0.2), Setpoint)
    np.testing.assert_allclose(motion.wanted[-1, 0], 0.1, atol=1e-12)


def test_scaled_and_published_arms(arm):
    q = np.array(POSES["goal"])
    heavier = _bench.scaled(arm, 1.2)
    np.testing.assert_allclose(heavier.mass_matrix(q), 1.2 * arm.mass_matrix(q), atol=1e-12)
    np.testing.assert_allclose(_bench.as_published(arm).gravity, [9.81, 0.0, 0.0], rtol=1e-12)
    assert [j.mass for j in _bench.scaled(arm, np.arange(1.0, 8.0)).joints][2] == 3.0 * arm.joints[2].mass


# --- the bound --------------------------------------------------------------------------------------------------------


def test_holding_is_what_the_plant_holds(arm):
    load = Load.box(0.3, (0.05, 0.1, 0.2), com=(0.01, -0.02, 0.03))
    q = np.array(POSES["Take3"])
    plant = Plant(arm)
    plant.reset(q)
    plant.attach(load)
    full = _bound.holding(arm, load)
    tau = np.linspace(-1.0, 1.0, 7)
    plant.step(tau, 1000)
    np.testing.assert_allclose(
        full.forward_dynamics(q, np.zeros(7), tau), plant.truth().ddq, rtol=1e-4, atol=1e-4
    )
    assert _bound.holding(arm, load, 0.1).joints[-1].mass == pytest.approx(arm.joints[-1].mass + 0.1)


@pytest.mark.parametrize(
    ("name", "damping", "substeps"), [("justina_left_arm", 1.0, 1), ("justina_left_arm_box", 0.1, 4)]
)
def test_sensitivities_against_the_plant_itself(name, damping, substeps):
    arm, load = robots.load(name), _bench.brick()
    law = FeedbackLaw(Pipeline(arm), kd=tuple(damping * k for k in _bench.KD))
    motion = _bench.simulate(arm, law, POSES["goal"], load=load, seconds=2.0)

    def again(mass):
        plant = Plant(arm)
        plant.attach(Load(mass, load.com, load.inertia))
        states = [np.concatenate((plant.q, plant.dq))]
        for torque in motion.effort[1:]:
            plant.step(torque, 4_000_000)
            states.append(np.concatenate((plant.q, plant.dq)))
        return np.array(states)

    expected = (again(MASS + 1e-4) - again(MASS - 1e-4)) / 2e-4
    np.testing.assert_allclose(again(MASS)[:, :7], motion.q, atol=1e-12)
    F = _bound.transitions(arm, load, motion.q, motion.dq, motion.effort, 0.004, substeps=substeps)
    x = np.zeros(15)
    x[14] = 1.0
    found = [x]
    for step in F:
        found.append(step @ found[-1])
    for part in (slice(0, 7), slice(7, 14)):
        scale = np.abs(expected[:, part]).max()
        np.testing.assert_allclose(np.array(found)[:, part], expected[:, part], atol=2e-3 * scale)


def test_bound_of_a_straight_line_is_least_squares():
    """A mass that pushes a free body: z = q0 + v0 t + m t^2/2."""
    h, N, sigma = 0.1, 30, 0.2
    F = np.array([[1.0, h, h * h / 2], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    std = _bound.mass_std(np.broadcast_to(F, (N, 3, 3)), np.array([sigma]), 5.0, 2.0)
    t = np.arange(N + 1) * h
    Y = np.stack((np.ones(N + 1), t, t * t / 2), axis=1) / sigma
    information = Y.T @ Y + np.diag([1.0, 1.0 / 4.0, 1.0 / 25.0])
    assert std[-1] == pytest.approx(math.sqrt(np.linalg.inv(information)[2, 2]), rel=1e-9)
    assert np.all(np.diff(std) <= 1e-12) and std[0] == pytest.approx(5.0)


def test_rounding_that_stays_can_only_be_worse():
    F = np.broadcast_to(np.array([[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]]), (50, 3, 3))
    count = np.array([0.5])
    noise = np.array([0.1])
    still, moving = np.zeros((51, 1)), np.arange(51.0)[:, None]
    white = _bound.mass_std(F, np.sqrt(noise**2 + count**2 / 12), 5.0, 2.0)
    stays = _bound.mass_std(F, noise, 5.0, 2.0, count=count, q=still)
    renewed = _bound.mass_std(F, noise, 5.0, 2.0, count=count, q=moving)
    np.testing.assert_allclose(renewed, white, rtol=1e-3)
    free = _bound.mass_std(F, noise, 5.0, 2.0)
    # an error that never changes is a wrong start position: no loss for a mass that shows in the curvature
    assert np.all(stays >= free - 1e-12) and stays[-1] == pytest.approx(free[-1], rel=1e-2)


def test_first_exit_of_brownian_motion():
    assert _bound.still_inside(np.array([_bound.FIRST_EXIT_MEDIAN]), 1.0)[0] == pytest.approx(0.5, abs=1e-6)
    inside = _bound.still_inside(np.array([0.0, 1e-3, 0.5, 2.0, 50.0]) * 4.0, 2.0)
    assert inside[0] == 1.0 and inside[-1] < 1e-12 and np.all(np.diff(inside) <= 0.0)
    rng = np.random.default_rng(0)
    paths = np.abs(np.cumsum(rng.normal(0.0, math.sqrt(1e-3), (2000, 4000)), axis=1))
    outside = (np.argmax(paths > 1.0, axis=1) + 1) * 1e-3
    # in steps of 1e-3 a path is seen to leave 0.5826 sqrt(1e-3) late: Broadie, Glasserman, Kou 1997
    late = (1.0 + 0.5826 * math.sqrt(1e-3)) ** 2
    assert np.median(outside) == pytest.approx(_bound.FIRST_EXIT_MEDIAN * late, rel=0.05)


def test_time_of_an_efficient_estimator():
    time = np.linspace(0.0, 10.0, 1001)
    std = np.exp(-time)
    bound = 0.01
    expected = -0.5 * math.log(_bound.FIRST_EXIT_MEDIAN * bound**2)
    assert _bound.settling_time(time, std, bound) == pytest.approx(expected, abs=1e-6)
    assert _bound.settling_time(time, std, 1e-9) == math.inf
    assert _bound.settling_time(time, std, 10.0) == 0.0


# --- what is published ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def published():
    return mass_estimation.measure(mass_estimation.Job())


def test_published_curve(published):
    rows = {r.what: r for r in mass_estimation._curve_rows(published)}
    assert all(r.ok is not False for r in rows.values())
    assert rows["peak of the mass"].ours == pytest.approx(0.3754, abs=5e-4)
    assert rows["time of the peak"].ours == pytest.approx(5.24, abs=0.02)
    assert [rows[f"mass at {t} s"].ours for t in (8, 13, 20)] == pytest.approx(
        [0.2227, 0.2553, 0.2466], abs=5e-4
    )
    assert np.abs(published.motion.q[-1] - mass_estimation.AT_20_S).max() < 0.0025


def test_published_noise_is_the_mersenne_twisters(arm):
    sensor = mass_estimation.PublishedDrives(arm, exact=False)
    count = arm.joints[0].sensing.position_resolution
    read = [sensor.read(0, np.zeros(7), np.zeros(7), np.zeros(7)).position / count for _ in range(2)]
    # the numbers that begin with 0.8147 0.9058 0.1270 0.9134 0.6324 0.0975 0.2785 0.5469
    np.testing.assert_allclose(read[0], [2, 2, -2, 2, 1, -2, -1], atol=1e-12)
    assert read[1][0] == pytest.approx(0.0)
    sensor.reset()
    np.testing.assert_array_equal(
        sensor.read(0, np.zeros(7), np.zeros(7), np.zeros(7)).position / count, read[0]
    )
    full_scale = np.array([7.3656, 7.3656, 6.4626, 7.3656, 6.4626, 6.4626, 6.4626])
    steps = sensor.drive(np.full(7, 2.5)) * 1023 / full_scale
    np.testing.assert_allclose(steps, [347, 347, 396, 347, 396, 396, 396], atol=1e-9)


def test_gates_close_where_published(published):
    estimate = published.estimates[1.0]
    speed = np.linalg.norm(estimate.touch.dq, axis=1)
    assert np.all(estimate.mass[speed >= 0.5] == 0.0) and np.all(estimate.mass[:250] == 0.0)
    assert np.any(estimate.mass[published.motion.time > 4.0] != 0.0)


@pytest.mark.slow
def test_published_limit_levers_and_wrong_parameters():
    long = mass_estimation.measure(mass_estimation.Job(exact=True, seconds=60.0))
    assert long.estimates[1.0].mass[-1] == pytest.approx(0.2440, abs=0.001)
    assert all(r.ok for r in mass_estimation._parameter_rows(long, long))
    moved = mass_estimation.Job(exact=True, seconds=60.0, offset=0.05)
    plain = mass_estimation.Job(exact=True, seconds=60.0)
    rows = mass_estimation._lever_rows({moved: mass_estimation.measure(moved), plain: long}, plain, [moved])
    assert [r.ok for r in rows] == [True, True]


def test_katana():
    rows = mass_estimation._katana_rows(mass_estimation.measure(mass_estimation.Job(katana=True)))
    assert rows[0].ok and rows[1].ours < 2e-3


# --- the payload filter and its conditions ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_runs():
    jobs = [payload_filter.Job("goal", 0, bound=True), payload_filter.Job("Take3", 0, bound=True)]
    return {job.pose: [payload_filter.measure(job)] for job in jobs}


def test_payload_filter_on_two_runs(two_runs):
    runs = [f for group in two_runs.values() for f in group]
    rows = payload_filter.time_rows(runs, _bench.MASS_ONLY, judged=True)
    rows += payload_filter.accuracy_rows(runs, _bench.MASS_ONLY, judged=True)
    assert len(rows) == 3 and all(r.ok for r in rows)
    assert payload_filter._stopped_rows(runs)[0].ok
    ratio, error, *_ = payload_filter.bound_rows(two_runs, _bench.MASS_ONLY)
    assert ratio.ok and error.ok is not None
    for f in runs:
        white, stays = f.bound["white"], f.bound["rounding"]
        late = f.time >= 1.0
        assert np.all(np.diff(white) <= 1e-12) and np.all(stays[late] >= 0.99 * white[late])
        # what the filter says of itself must not be better than what is possible
        assert np.all(f.filters[_bench.MASS_ONLY].std[late] >= 0.9 * white[late])


def test_bounds_do_not_depend_on_the_seed(two_runs):
    other = payload_filter.measure(payload_filter.Job("goal", 5, bound=True))
    late = other.time >= 0.5
    one = two_runs["goal"][0].bound["white"]
    np.testing.assert_allclose(other.bound["white"][late], one[late], rtol=2e-3)


def test_figures_of_the_payload_filter(two_runs, tmp_path):
    pytest.importorskip("matplotlib", reason="palpate[report] is not installed")
    runs = [f for group in two_runs.values() for f in group]
    figures = _figures.drawn(lambda: payload_filter._draw(runs, two_runs))
    assert len(figures) == 4
    files = write_study(
        payload_filter.time_rows(runs, _bench.MASS_ONLY), figures, tmp_path / "study", title="Title"
    )
    assert files.html.read_text(encoding="utf-8").count("<svg") == 4


def test_without_matplotlib_there_are_no_figures(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert _figures.drawn(lambda: pytest.fail("drawn")) == {}


def test_unknown_grasp_finds_mass_and_place():
    found = unknown_grasp.measure(unknown_grasp.Job("goal", "+20 mm in x", (0.02, 0.0, 0.0), 0))
    assert _bench.late_percent(found.time, found.error) < 2.0
    assert np.abs(found.moment).max() < 0.005


def test_tare_corrects_wrong_masses():
    factors = (0.85, 1.1, 0.9, 1.15, 1.05, 0.8, 1.2)
    found = wrong_masses.measure(wrong_masses.Job("some", factors, 3, ("StandBy",)))
    np.testing.assert_allclose(found.factors, factors, atol=0.02)
    assert _bench.late_percent(found.time, found.errors["StandBy", wrong_masses.TARED]) < 2.0


def test_a_push_takes_ok_away_and_gives_it_back():
    job = pushes.Job("katana_450_6m90a", 11)
    seen = pushes.measure(job)
    assert [s.filter for s in seen] == [_bench.MASS_ONLY, _bench.DEFAULT]
    for s in seen:
        assert s.pushed.begin > 0.0 and s.ok[s.time < s.pushed.begin].any()
        assert np.mean(s.wrong) < 0.01 and np.mean(s.ok[s.during]) < 0.3
        assert s.back < pushes.BACK


def test_back_after_a_push_is_when_it_stays_right():
    time = np.arange(0.0, 10.0, 0.1)
    pushed = pushes.Pushed("arm", 1.0, False, 2.0, 5.0, 10.0, 30.0, 3, False)
    error = np.where(time < 6.45, 0.5, 0.01)
    ok = (time < 2.0) | (time > 5.95)
    seen = pushes.Seen(pushed, "filter", time, error, np.full_like(time, 0.1), ok)
    assert seen.back == pytest.approx(1.5)  # ok from 6.0 s, right from 6.5 s
    assert np.count_nonzero(seen.during) == 30 and np.count_nonzero(seen.wrong & ~seen.during) == 20 + 5
    never = seen._replace(ok=np.zeros_like(ok))
    assert never.back == math.inf and not never.wrong.any()


def test_grasp_and_release_are_timed_from_the_instant():
    time = np.arange(0.0, 10.0, 0.1)
    changes = np.where(time >= 3.25, 1.0, 0.0) + np.where(time >= 7.05, 1.0, 0.0)
    mass = np.where((time >= 3.65) & (time < 7.35), MASS, 0.0)
    grasp = grasp_and_release._happened("grasp", time, mass, changes, 3.0, 7.0, MASS)
    release = grasp_and_release._happened("release", time, mass, changes, 7.0, math.inf, 0.0)
    assert grasp.found == pytest.approx(0.3) and grasp.weighed == pytest.approx(0.7)
    assert release.found == pytest.approx(0.1) and release.weighed == pytest.approx(0.4)
    blind = grasp_and_release._happened("grasp", time, 0 * mass, 0 * changes, 3.0, 7.0, MASS)
    assert blind.found == math.inf and blind.weighed == math.inf


def test_grasp_and_release_through_both_filters():
    seen = grasp_and_release.measure(grasp_and_release.Job("Take3", 0))
    assert [s.filter for s in seen] == [_bench.MASS_ONLY, _bench.DEFAULT]
    for s in seen:
        assert [e.kind for e in s.events] == ["grasp", "release"]
        assert all(0.0 < e.found < 0.5 and 0.0 < e.weighed < 2.0 for e in s.events)
        assert abs(s.mass[-1]) < 0.0125 and all(t < s.time[-1] for t in s.false)
    fed_back = grasp_and_release.measure(grasp_and_release.Job("Take3", 0, _bench.DEFAULT))
    assert [s.filter for s in fed_back] == [_bench.DEFAULT]


def test_jobs_and_results_travel(two_runs):
    for thing in (payload_filter.Job("goal", 0), two_runs["goal"][0], Row("a", 1.0, 2.0)):
        assert type(pickle.loads(pickle.dumps(thing))) is type(thing)


# --- the same bits ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("faulty", [False, True])
def test_live_is_offline_is_replay_is_chunked(faulty):
    pytest.importorskip("rosbags", reason="palpate[logs] is not installed")
    found = replay.measure(replay.Job(faulty, 2.2))
    assert found.pipelines == 3 + len(OBSERVERS) * (1 + len(ESTIMATORS))
    assert len(found.ways) == 4
    for numbers, different in found.ways.values():
        assert numbers > 100_000 and different == 0


def test_replay_notices_a_different_bit(arm):
    motion = _bench.simulate(arm, PublishedLaw(arm), POSES["goal"], seconds=0.1)
    rows = replay._rows(motion.weigh(Pipeline(arm)))
    other = rows.copy()
    other[3, 5] ^= 1
    assert replay._different(rows, rows) == 0 and replay._different(rows, other) == 1
    assert replay._different(rows, rows[:-1]) == rows.size


def test_size_is_that_of_a_wheel(tmp_path):
    size, files = replay.packed_size()
    assert 50_000 < size < 3_000_000 and files > 30


# --- whole studies, shortened -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in STUDIES if n not in ("lara8", "speed")])
def test_quick_run_of_every_study(name, tmp_path):
    words = []
    result = STUDIES[name].run(lambda *word: words.append(word), quick=True)
    assert isinstance(result, StudyResult) and result.name == name and result.ok
    assert result.rows and all(r.ok is None for r in result.rows)
    assert len({r.what for r in result.rows}) == len(result.rows)
    assert words[-1][0] == words[-1][1] and result.seconds > 0.0
    write_study(result.rows, result.figures, tmp_path / name, title=result.title, provenance=result.notes)


@pytest.mark.slow
def test_grasp_during_a_motion_is_seen(arm):
    schedule = Schedule([Attach(1.5, _bench.brick())])
    motion = _bench.simulate(arm, PublishedLaw(arm), POSES["goal"], schedule=schedule, seconds=6.0)
    payload = motion.weigh(Pipeline(arm)).payload
    assert payload.changes[-1] >= 1 and payload.mass[-1] == pytest.approx(MASS, rel=0.02)


# --- contacts ---------------------------------------------------------------------------------------------------------


def test_the_contact_campaign_counts_and_times():
    plant = contacts.iiwa()
    assert contacts.measure(contacts.Job(plant, 60.0, 1)) == contacts.measure(contacts.Job(plant, 60.0, 1))
    assert contacts.measure(contacts.Job(plant, 60.0, 1)).contacts == 0
    hard = [
        contacts.measure(contacts.Job(plant, 4.0, k, contacts.HARD, contacts.HARD_MOST)) for k in range(5)
    ]
    soft = [contacts.measure(contacts.Job(plant, 4.0, k, contacts.SOFT, 150.0)) for k in range(5)]
    assert not any(f.early for f in hard + soft)
    assert max(f.delay for f in hard) <= 0.005
    assert 0.005 < np.median([f.delay for f in soft]) <= 0.030


def test_the_contact_campaign_would_see_false_alarms():
    """A detector that is told a tenth of the errors alarms all the time: the count of none is no artefact."""
    plant = contacts.iiwa()
    told = dict(plant.options) | {"model_std": [0.03] * 7, "friction_fraction": 0.03}
    deceived = dataclasses.replace(plant, options=tuple(told.items()))
    assert contacts.measure(contacts.Job(deceived, 60.0, 1)).contacts > 3


def test_the_contact_campaign_is_what_it_is_said_to_be():
    plant, rng = contacts.iiwa(), np.random.default_rng(0)
    q, dq, ddq, sign = contacts.motion(plant, 60.0, rng)
    assert np.abs(np.gradient(q, 1.0 / contacts.RATE, axis=0) - dq)[2:-2].max() < 0.02
    assert np.abs(np.gradient(dq, 1.0 / contacts.RATE, axis=0) - ddq)[2:-2].max() < 0.2
    assert np.abs(sign).max() <= 1.0
    rest = (dq == 0.0).all(axis=1)
    assert 0.05 < rest.mean() < 0.4
    slow = contacts.wander(np.full(7, 0.5), 1.0, 400_000, rng)
    assert np.allclose(slow.std(axis=0), 0.5, rtol=0.25)
    step = slow[1000:] * slow[:-1000]  # one correlation time later
    assert np.allclose(step.mean(axis=0) / slow.var(axis=0), np.exp(-1.0), atol=0.2)
    log, push = contacts.simulate(contacts.Job(plant, 4.0, 3, contacts.SOFT, 150.0))
    assert push is not None and 2.0 <= push.time <= 2.8 and len(log) == 4000
    assert contacts.simulate(contacts.Job(plant, 4.0, 3))[1] is None


def test_the_best_possible_test_is_the_matched_filter():
    """Against its closed form for a ramp in white noise; stiction hides what it can; nothing felt, nothing found."""
    plant = dataclasses.replace(contacts.iiwa(), model_std=(1e-9,) * 7)
    time = (np.arange(4000)[:, None] + 0.5) / contacts.RATE
    ramp = time * ([50.0] + [0.0] * 6)  # N m on one joint of 0.1 N m noise
    none = np.zeros_like(ramp)
    found = contacts.shortest(plant, contacts.Push(0.0, ramp, none, none))
    # d^2 = r^2 T^3/(3 R h) meets the point of probability 1e-3/3600 T, 6.3 standard deviations
    assert found == pytest.approx((3.0 * 6.3**2 * 0.01 * 1e-3) ** (1 / 3) / 50.0 ** (2 / 3), rel=0.1)
    both = np.repeat(ramp[:, :1], 2, axis=1)
    assert contacts.shortest(plant, contacts.Push(0.0, np.hstack([both, none[:, 2:]]), none, none)) < found
    still = contacts.shortest(plant, contacts.Push(0.0, ramp, none, np.full_like(ramp, 5.0)))
    assert still == pytest.approx(0.1 + found, abs=0.002)  # 5 N m of stiction at 50 N m/s
    helped = contacts.shortest(plant, contacts.Push(0.0, ramp, none - 3.0, np.full_like(ramp, 5.0)))
    assert helped == pytest.approx(0.04 + found, abs=0.002)
    assert contacts.shortest(plant, contacts.Push(0.0, none, none, none)) == math.inf


def test_no_contact_is_found_sooner_than_possible():
    plant = contacts.iiwa()
    for k in range(5):
        found = contacts.measure(contacts.Job(plant, 4.0, k, contacts.SOFT, 150.0))
        assert 0.0 < found.bound <= found.delay


def test_fewer_hours_than_asked_for_prove_nothing():
    quiet = [contacts.Found(0)] * 3
    assert contacts.campaign_rows("arm", quiet, contacts.HOURS)[0].ok is True
    assert contacts.campaign_rows("arm", [contacts.Found(1)] * 2, contacts.HOURS)[0].ok is False
    (few,) = contacts.campaign_rows("arm", quiet, 10.0)
    assert few.ok is False and "10 h" in few.what and "100 h are asked for" in few.note


def test_kept_results_outlive_the_process_that_made_them(tmp_path):
    path = tmp_path / "state.jsonl"
    kept = Kept(path, "this arm")
    kept.put("a", {"delay": math.inf, "count": 1})
    kept.put("b", 2)
    with path.open("a") as file:
        file.write('{"name": "c", "resu')  # killed while writing
    again = Kept(path, "this arm")
    assert (
        again.get("a") == {"delay": math.inf, "count": 1} and again.get("b") == 2 and again.get("c") is None
    )
    again.put("c", 3)
    assert Kept(path, "this arm").get("c") == 3
    other = Kept(path, "another arm")
    assert other.discarded == 3 and other.get("a") is None
    assert Kept(path, "this arm").discarded == 0  # begun anew, and empty
    path.write_text("time,q1\n0,1\n")
    with pytest.raises(PalpateError, match="expected the kept results"):
        Kept(path, "this arm")
    Kept(None, "nothing is written").put("a", 1)


def test_a_campaign_goes_on_where_it_stopped(tmp_path, monkeypatch):
    monkeypatch.delenv(contacts.VARIABLE, raising=False)
    monkeypatch.setattr(contacts, "TRIALS", 2)
    monkeypatch.setattr(contacts, "CHUNK", 2.0)
    monkeypatch.setattr(_bench.os, "cpu_count", lambda: 1)
    totals = []

    def run(hours):
        totals.clear()
        return contacts.run(lambda done, total, left: totals.append(total), False, tmp_path, hours)[0]

    first = run(4.0 / 3600.0)
    assert totals[0] == 2 + 4
    more = run(8.0 / 3600.0)
    assert totals[0] == 2 and first[1:] == more[1:]
    assert run(8.0 / 3600.0) == more and totals[0] == 0
    with pytest.raises(PalpateError, match="no campaign"):
        STUDIES["speed"].run(hours=1.0)
