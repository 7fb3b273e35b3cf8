"""Studies by the wall's clock: what they judge, and that they run; what they find is the computer's matter."""

from __future__ import annotations

import os
from typing import Any

import pytest

from palpate.errors import InputError, PalpateError
from palpate.studies import STUDIES, _peers, _session_run, _timed, session

FOUND: dict[str, Any] = {
    "ticks": 600_000,
    "samples": 600_000,
    "recorded": 600_000,
    "records_dropped": 0,
    "bytes": 1e9,
    "lost_own": 0,
    "lost_driver": 0,
    "lost_system": 3,
    "allocations": 0,
    "counted": True,
    **{
        name: {"p50_ns": 10_000, "p99_ns": 15_000, "p999_ns": 19_000, "worst_ns": 50_000}
        for name in ("own", "own_processor", "late")
    },
}


def verdicts(enough: bool = True, **other: Any) -> list[bool | None]:
    """Of the rows that can be judged."""
    rows = session.rows({**FOUND, **other}, 600.0, enough)
    return [row.ok for row in rows if row.required is not None]


def test_every_figure_of_the_session_is_judged():
    assert verdicts() == [True] * 4
    assert verdicts(own={**FOUND["own"], "p999_ns": 20_001}) == [False, True, True, True]
    assert verdicts(lost_own=1) == [True, False, True, True]
    assert verdicts(recorded=599_999) == verdicts(records_dropped=1) == [True, True, False, True]
    assert verdicts(allocations=1) == [True, True, True, False]


def test_a_run_shorter_than_asked_for_is_not_judged():
    assert verdicts(enough=False) == [None] * 4
    assert _timed.length(None, False) == (600.0, True)
    assert _timed.length(1.0, False) == (60.0, False)
    assert not _timed.length(None, True)[1]
    assert _timed.lasted(60.0) == "1 min of the 10 asked for"
    with pytest.raises(InputError, match="length is fixed"):
        STUDIES["speed"].run(minutes=1.0)


def test_a_session_is_measured():
    found = _session_run.measure(seconds=0.3, rate=500.0, everything=True, fifo=False)
    assert found["recorded"] == found["samples"] > 0 and not found["granted"]["fifo"]
    assert [row.what for row in session.rows(found, 0.3, False)]


def test_what_fails_in_the_measured_process_is_told():
    with pytest.raises(PalpateError, match="_session_run failed: .*unexpected keyword argument"):
        _timed.measured("_session_run", {"nonsense": 1}, 1.0, lambda done, total, left: None)


def test_hogs_run_and_end():
    for kind in ("computing", "copying memory"):
        with _timed.hogs(kind) as count:
            assert count == os.cpu_count()


def test_a_peer_is_a_module_of_the_tests(monkeypatch: pytest.MonkeyPatch, tmp_path):
    assert _peers.peer("fri_emulator").FriController
    monkeypatch.setattr(_peers, "_FOLDER", tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="inside a clone"):
        _peers.peer("fri_emulator")
