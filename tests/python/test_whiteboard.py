"""The studies of the whiteboard project: the real iiwa logs whole, the simulated controllers in part."""

from __future__ import annotations

import numpy as np
import pytest

from palpate import data
from palpate.errors import LogError
from palpate.studies import STUDIES, _iiwa_logs, whiteboard
from palpate.studies.whiteboard import DOWN, PLAIN, RECOVERED, SETTLED, WAY, Job, measure
from recordings import recording


def test_the_study_of_the_real_logs_holds():
    recording("iiwa_whiteboard_logs", "README.md")
    result = STUDIES["iiwa-velocity"].run()
    assert [row.what for row in result.rows if row.ok is False] == []
    assert sum(row.ok is True for row in result.rows) >= 14


def test_the_published_gain_shakes_the_velocity():
    published, corrected = (measure(Job(form, "heading", DOWN, 8.0)) for form in ("published", "corrected"))
    assert published.gain.min() < -0.1
    assert corrected.gain.min() == 0.0
    late = published.time > SETTLED
    assert published.speed[late].std() > whiteboard.BETTER * corrected.speed[late].std()


def test_the_goal_is_reached_and_kept():
    found = measure(Job("palpate", "per_axis", WAY, 14.0, RECOVERED))
    assert found.distance[found.time > 13.0].max() < 1e-3 * whiteboard.STOP
    assert found.force.max() <= whiteboard.BOUND


def test_the_published_heading_controller_runs_on():
    found = measure(Job("published", "heading", WAY, 14.0, PLAIN))
    assert found.distance[-1] > 0.05


def test_runs_repeat():
    first, second = (measure(Job("palpate", "per_axis", WAY, 1.0)) for _ in range(2))
    np.testing.assert_array_equal(first.force, second.force)


def test_step_time_is_measured():
    median, worst = whiteboard.step_time(3, 200)
    assert 0.0 < median <= worst


def test_a_missing_or_changed_log_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr(data, "local", lambda folder: None)
    with pytest.raises(LogError, match=r"iiwase_log_1.csv.gz is not on this machine.*PALPATE_DATA"):
        _iiwa_logs.load("log 1")
    import gzip

    (tmp_path / "iiwase_log_1.csv.gz").write_bytes(gzip.compress(b"other"))
    monkeypatch.setattr(data, "local", lambda folder: tmp_path)
    with pytest.raises(LogError, match="is not the published file"):
        _iiwa_logs.load("log 1")


@pytest.mark.slow
def test_the_whole_study_holds():
    result = STUDIES["whiteboard"].run()
    assert [row.what for row in result.rows if row.ok is False] == []
