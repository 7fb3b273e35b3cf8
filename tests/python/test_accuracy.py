"""The bench over recordings of real robots: what it says without recordings and without rivals, and its instruments."""

from __future__ import annotations

import numpy as np
import pytest

from palpate import LogError
from palpate.logs import Log
from palpate.studies import _rivals, accuracy
from recordings import data_folder

pytest.importorskip("scipy", reason="palpate[identify] is not installed")


def test_without_recordings_every_job_says_so(monkeypatch, tmp_path):
    monkeypatch.setenv("PALPATE_DATA", str(tmp_path))
    for job in accuracy._JOBS:
        (row,) = accuracy.measure(job)
        assert row.ok is None and row.ours == "not measured" and "on this machine" in row.note


def test_other_errors_are_not_swallowed(monkeypatch):
    def broken() -> list:
        raise LogError("corrupt")

    monkeypatch.setitem(accuracy._JOBS, "ur10e", broken)
    with pytest.raises(LogError, match="corrupt"):
        accuracy.measure("ur10e")


@pytest.mark.parametrize("name", ["pinocchio", "figaroh", "sysid"])
def test_a_rival_that_is_not_installed_is_said_in_its_row(monkeypatch, name):
    monkeypatch.setenv("PALPATE_DATA", str(data_folder()))
    monkeypatch.setattr(_rivals, "_imported", missing)
    (row,) = accuracy.measure(f"rival-{name}")
    assert row.ok is None and "pip install" in row.note


def missing(module: str, package: str):
    raise _rivals.NotHere(f"{package} is not installed; pip install it")


def test_missing_package_names_the_extra():
    with pytest.raises(_rivals.NotHere, match=r"palpate\[bench\]"):
        _rivals._imported("palpate_has_no_such_module", "nothing")


def test_rows_of_every_joint_are_judged_each_by_its_own_bar():
    assert accuracy.within("a", (1.0, 2.0), np.array([0.9, 1.9]), "%").ok is True
    assert accuracy.within("a", (1.0, 2.0), np.array([0.9, 2.1]), "%").ok is False
    assert accuracy.within("a", (1.0, 2.0), np.array([0.94, 2.0]), "%").ours == "0.9 2.0"


def test_plain_data_are_what_was_recorded():
    t = np.arange(0.0, 20.0, 0.01)
    q = np.column_stack([np.sin(t), np.cos(0.7 * t)])
    log = Log(time_ns=np.rint(t * 1e9).astype(np.int64), position=q, effort=q, joint_names=("a", "b"))
    plain = _rivals.Plain.of(log, np.array([2.0, 3.0]), 20.0)
    inner = slice(100, -100)
    at = plain.time[inner]
    np.testing.assert_allclose(
        plain.ddq[inner], -np.column_stack([np.sin(at), 0.49 * np.cos(0.7 * at)]), atol=2e-3
    )
    torque = plain.reduce(plain.torque)
    np.testing.assert_allclose(torque, (q * [2.0, 3.0])[20 : 20 + 4 * len(torque) : 4], atol=2e-2)


def test_quick_jobs_hold(monkeypatch):
    """The bars that are met stay met; the misses are known."""
    monkeypatch.setenv("PALPATE_DATA", str(data_folder()))
    assert all(row.ok for row in accuracy.measure("xl330"))
    load, _, force = accuracy.measure("lara8")
    assert load.ok is False and force.ok
