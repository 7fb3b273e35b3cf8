"""The speed study: how it judges what the benchmark says, and how it fails where there is none. Nothing is timed."""

from __future__ import annotations

import copy
import json
import math
import sys

import numpy as np
import pytest

from palpate import InputError, PalpateError, robots
from palpate.studies import speed


def contestant(how, time):
    return {
        "how": how, "calls": 1024, "p50": time, "p99": 1.5 * time, "p999": 2 * time,
        "worst": 90.0, "best_p50": time,
    }  # fmt: skip


@pytest.fixture
def report():
    """Two arms; the second is slower."""
    arms = []
    for name, time in (("left", 0.4), ("right", 0.5)):
        tasks = [
            {
                "what": "momentum observer",
                "required": {"p50": 1.0, "p999": 3.0, "ratio": 3.0},
                "disagreement": 1e-13,
                "sensitivity": 1e-13,
                "contestants": [
                    contestant("palpate", time),
                    contestant("slow", 3.0),
                    contestant("fast", 1.6),
                ],
            },
            {
                "what": "mass matrix",
                "required": {"p50": None, "p999": None, "ratio": None},
                "disagreement": 2e-13,
                "sensitivity": 0.0,
                "contestants": [contestant("palpate", 0.2), contestant("crba", 0.3)],
            },
        ]
        arms.append({"arm": name, "joints": 7, "tasks": tasks})
    return {"arms": arms, "pinned": True, "preempted": 3, "load_before": 0.5, "load_after": None}


def by_name(rows):
    return {row.what: row for row in rows}


def test_every_bar_is_judged_by_the_worst_arm_and_the_fastest_rival(report):
    rows = by_name(speed.timing_rows(report))
    assert len(rows) == 4
    median, tail = rows["momentum observer, median"], rows["momentum observer, 99.9 % quantile"]
    assert (median.ours, median.required, median.ok) == (0.5, "<= 1", True)
    assert (tail.ours, tail.ok) == (1.0, True)
    assert "right: p50 0.50, p99.9 1.00, worst 90 us" in median.note
    ratio = rows["momentum observer: times faster than the same with Pinocchio"]
    assert ratio.ours == pytest.approx(3.2) and ratio.ok and "(fast)" in ratio.note


def test_what_misses_is_not_ok(report):
    tasks = report["arms"][1]["tasks"]
    tasks[0]["contestants"][0].update(p50=1.1, best_p50=0.6)
    tasks[1]["disagreement"] = 1e-8
    rows = speed.timing_rows(report)
    assert [row.ok for row in rows] == [False, True, False, False]


def test_a_difference_that_is_no_number_is_no_agreement(report):
    report["arms"][0]["tasks"][0]["disagreement"] = None  # JSON has no infinity
    last = speed.timing_rows(report)[-1]
    assert last.ours == math.inf and last.ok is False


def test_a_job_that_rounding_upsets_is_judged_by_rounding(report):
    report["arms"][0]["tasks"][0].update(disagreement=4e-6, sensitivity=1e-6)
    firm, loose = speed.timing_rows(report)[-2:]
    assert firm.ours == 2e-13 and firm.ok and "3 jobs" in firm.note
    assert loose.ours == pytest.approx(4.0) and loose.ok and "1 jobs" in loose.note
    for difference, sensitivity in ((2e-5, 1e-6), (None, 1e-6), (None, None)):
        report["arms"][0]["tasks"][0].update(disagreement=difference, sensitivity=sensitivity)
        assert speed.timing_rows(report)[-1].ok is False


def test_without_the_rival_nothing_is_claimed(report):
    for arm in report["arms"]:
        for task in arm["tasks"]:
            del task["contestants"][1:]
    rows = speed.timing_rows(report)
    assert [row.ok for row in rows] == [True, True, False, False, False]
    for row in rows[2:]:
        assert row.ours == "not measured" and "Pinocchio was not found" in row.note


def test_figure_has_bars_for_both_and_stands_without_the_rival(report):
    alone = copy.deepcopy(report)
    for task in alone["arms"][-1]["tasks"]:
        del task["contestants"][1:]
    for given in (report, alone):
        ((caption, figure),) = speed.figures(given).items()
        (ax,) = figure.axes
        assert "right" in caption and ax.get_xscale() == "log" and len(ax.containers) == 2


def test_the_source_tree_is_found_or_asked_for(tmp_path):
    with pytest.raises(InputError, match="source tree, a C\\+\\+20 compiler and cmake"):
        speed.source_tree([tmp_path])
    (tmp_path / "benchmarks").mkdir()
    for name in ("CMakeLists.txt", "benchmarks/speed.cpp"):
        (tmp_path / name).touch()
    assert speed.source_tree([tmp_path / "benchmarks", tmp_path]) == tmp_path


def test_a_build_that_fails_names_its_log(tmp_path, monkeypatch):
    tools = tmp_path / "tools"
    tools.mkdir()
    monkeypatch.setattr(speed.sysconfig, "get_path", lambda _: str(tools))
    monkeypatch.setenv("PATH", str(tools))
    with pytest.raises(InputError, match="needs cmake"):
        speed.build(tmp_path)
    (tools / "cmake").write_text(f"#!{sys.executable}\nprint('no such thing')\nraise SystemExit(1)\n")
    (tools / "cmake").chmod(0o755)
    with pytest.raises(PalpateError, match=r"build/bench/build\.log"):
        speed.build(tmp_path)
    assert (tmp_path / "build/bench/build.log").read_text().startswith("no such thing")


def test_the_program_speaks_json_or_says_what_is_wrong(tmp_path, report):
    program = tmp_path / "program"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nprint('''{json.dumps(report)}''')\nraise SystemExit(1)\n"
    )
    program.chmod(0o755)
    assert speed.measure(program, 7) == report
    program.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('no clock ' + ' '.join(sys.argv[1:]))\n")
    with pytest.raises(PalpateError, match="code 1 and without figures: no clock --json --calls 7"):
        speed.measure(program, 7)


def test_dynamics_agree_and_a_difference_is_seen(monkeypatch):
    rows = speed.dynamics_rows(3)
    assert [row.ok for row in rows] == [True, True]
    arm = robots.load("kuka_lbr_iiwa14")

    def wrong(q, dq, ddq, tau):
        return arm.inverse_dynamics(q, dq, ddq), arm.mass_matrix(q) * (1 + 1e-9), np.full(arm.n, np.nan)

    assert not speed.disagreement(arm, wrong, 3) <= speed.AGREEMENT
    monkeypatch.setattr(speed.importlib.util, "find_spec", lambda name: None)
    for row in speed.dynamics_rows(3):
        assert row.ok is False and row.ours == "not measured" and "pip install" in row.note
