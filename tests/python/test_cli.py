"""The command ``palpate``: what a person sees, what a script reads, and what happens with wrong input."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate import studies
from palpate.cli import main
from palpate.report import StudyRow
from palpate.studies import Study, StudyResult

VERBS = (
    "weigh",
    "feel",
    "simulate",
    "replay",
    "tare",
    "identify",
    "excite",
    "reproduce",
    "bench",
    "doctor",
    "arm",
    "data",
    "see",
    "ros",
    "wipe",
    "teleop",
)


class Outcome:
    """Exit code and what was printed."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def json(self) -> dict:
        assert len(self.out.strip().splitlines()) == 1, self.out
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


@pytest.fixture
def palpate(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run the command in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PALPATE_DEBUG", raising=False)

    def run(*arguments: object) -> Outcome:
        code = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cli") / "task.mcap"
    arguments = ["simulate", "--load", "0.25@1.5", "--load", "0@5", "--start", "Take3", "--duration", "7"]
    assert main([*arguments, "--out", str(path), "--quiet"]) == 0
    return path


# --- weigh --------------------------------------------------------------------------------------------------


def test_weigh_alone_shows_a_mass_and_writes_both_files(palpate, tmp_path: Path) -> None:
    done = palpate("weigh")
    assert done.code == 0 and done.err == ""
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "run.mcap"]
    lines = dict(line.split(maxsplit=1) for line in done.out.splitlines())
    assert " g ± 0." in lines["mass"] and lines["mass"].endswith("(95 %)")
    assert lines["status"].startswith("ok")
    assert lines["truth"].startswith("250 g, error")
    assert "before the arm stopped at 3.00 s" in lines["known"]
    assert (lines["log"], lines["report"]) == ("run.mcap", "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<svg" in page and "http://" not in page.replace("http://www.w3.org", "")
    assert "data:image/png;base64," in page
    # a second run replaces its own files
    assert palpate("weigh", "--duration", 1, "--no-report").code == 0
    assert len(pp.Log.open(tmp_path / "run.mcap")) == 251


def test_weigh_json_is_one_object_with_what_was_promised(palpate) -> None:
    done = palpate("weigh", "--json", "--seed", 7, "--no-report", "--out", "there")
    found = done.json
    assert done.code == 0 and done.err == ""
    assert found["status"] == "ok"
    assert abs(found["mass_kg"] - 0.25) < 0.005 and 0.0 < found["mass_std_kg"] < 0.001
    assert 0.0 < found["time_to_2_percent_s"] < 3.0
    assert found["truth_kg"] == 0.25 and abs(found["error_percent"]) < 2.0
    assert (found["arm"], found["pose"], found["seed"]) == ("justina_left_arm", "Take3", 7)
    assert found["estimator"] == "payload-filter"
    assert found["files"] == {"log": str(Path("there", "run.mcap"))}
    again = palpate("weigh", "--json", "--seed", 7, "--no-report", "--out", "there").json
    assert again == found
    other = palpate("weigh", "--json", "--seed", 8, "--no-report", "--no-record").json
    assert other["mass_kg"] != found["mass_kg"]


def test_weigh_quiet_is_one_line(palpate, tmp_path: Path) -> None:
    done = palpate("weigh", "--quiet", "--no-report", "--no-record", "--mass", 0.4, "--pose", "StandBy")
    assert done.code == 0 and list(tmp_path.iterdir()) == []
    (line,) = done.out.splitlines()
    assert line.endswith("g (95 %), ok") and abs(float(line.split()[0]) - 400.0) < 4.0


@pytest.mark.parametrize(
    "options, status, words",
    [
        (("--mass", 0), "ok", ""),
        (("--mass", 5, "--pose", "goal"), "saturated", "cannot lift"),
        (("--pose", "Zero"), "warming", "hides the weight"),
        (("--pose", "Take3", "--start", "Take3", "--no-noise"), "ok", ""),
        (("--pose", "0.3,0,0,0.5,0,0.7,0", "--estimator", "regression"), "ok", "short of the pose"),
    ],
)
def test_weigh_at_the_edges(options: tuple, status: str, words: str, palpate) -> None:
    done = palpate("weigh", "--no-report", "--no-record", "--duration", 6, *options)
    assert done.code == 0 and done.err == ""
    lines = done.out.splitlines()
    (mass,) = [line for line in lines if line.startswith("mass")]
    assert ("not to be used" in mass) == (status != "ok")
    assert any(line.startswith("status") and f" {status}:" in line for line in lines)
    assert words in done.out


def test_weigh_draws_one_picture(palpate, tmp_path: Path) -> None:
    done = palpate(*"weigh --duration 1 --no-record --no-report --picture lift.png --json".split())
    assert done.json["files"] == {"picture": "lift.png"}
    assert (tmp_path / "lift.png").read_bytes().startswith(b"\x89PNG")
    done = palpate("weigh", "log.csv", "--picture", "lift.png")
    assert done.code == 2 and "--picture is for a simulation" in done.err


def test_weigh_a_log(palpate, recording: Path, tmp_path: Path) -> None:
    done = palpate("weigh", recording)
    assert done.code == 0 and done.err == ""
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert "changes  at 1." in done.out and "rows read" in done.out
    assert "! The arm is the one the log was recorded with." in done.out
    found = palpate("weigh", recording, "--json", "--no-report", "--arm", "justina_left_arm").json
    assert found["status"] == "ok" and len(found["changes_s"]) == 2
    masses = [hold["mass_kg"] for hold in found["holds"]]
    assert masses == pytest.approx([0.0, 0.25, 0.0], abs=0.005)


def test_weigh_a_table_with_a_column_map(palpate, recording: Path, tmp_path: Path) -> None:
    log = pp.Log.open(recording).between(2.0, 4.9)
    with open(tmp_path / "log.csv", "w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["t_ms", *(f"q{i}" for i in range(1, 8)), *(f"I{i}" for i in range(1, 8))])
        for time_ns, q, tau in zip(log.time_ns, np.rad2deg(log.position), log.effort / 1.5, strict=True):
            table.writerow([time_ns / 1e6, *q, *tau])
    (tmp_path / "map.yaml").write_text(
        'time: t_ms\ntime_unit: ms\nposition: "q{joint}"\nposition_unit: deg\neffort: "I{joint}"\neffort_unit: A\n'
    )
    pp.robots.load("justina_left_arm").replace(effort=pp.Effort.undeclared()).save(tmp_path / "arm.yaml")
    common = ("weigh", "log.csv", "--columns", "map.yaml", "--arm", "arm.yaml", "--no-report")
    found = palpate(*common, "--effort", "current:1.5", "--json").json
    assert found["status"] == "ok" and abs(found["mass_kg"] - 0.25) < 0.005
    assert "named otherwise" in found["remarks"][0]
    for options, words in (
        ((), "does not say what its driver's effort is"),
        (("--effort", "torque"), "in A, but arm"),
        (("--effort", "current"), "current:0.9"),
        (("--effort", "current:1,2"), "7 numbers"),
    ):
        done = palpate(*common, *options)
        assert done.code == 2 and words in done.err
    for text, words in (
        ("position: [1", "cannot be read"),
        ("just text", "fields of a ColumnMap"),
        ("time: t_ms", "position is missing"),
        ("position: q1\npositon_unit: deg", "did you mean 'position"),
        ("position: q1\ntime_unit: hours", "time_unit must be one of"),
    ):
        (tmp_path / "map.yaml").write_text(text)
        done = palpate(*common)
        assert done.code == 2 and words in done.err, done.err


def test_files_of_others_are_not_replaced(palpate, tmp_path: Path) -> None:
    for name, words in (("report.html", "the report"), ("run.mcap", "the recording")):
        (tmp_path / name).mkdir()
        done = palpate("weigh", "--duration", 1)
        assert done.code == 2 and words in done.err
        (tmp_path / name).rmdir()
        (tmp_path / name).write_bytes(b"something of mine")
        done = palpate("weigh", "--duration", 1)
        assert done.code == 2 and "was not written by palpate" in done.err and done.out == ""
        assert (tmp_path / name).read_bytes() == b"something of mine"
        (tmp_path / name).unlink()
    (tmp_path / "file").write_text("")
    assert "no folder" in palpate("weigh", "--out", "file").err


# --- wrong input --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, words",
    [
        ("weigh justina_left_arm", "given as --arm justina_left_arm"),
        ("view kuka_lbr_iiwa7", "given as --arm kuka_lbr_iiwa7"),
        ("feel arm.urdf --arm justina_left_arm", "given as --arm arm.urdf"),
        *(
            (f"{verb} --seed -1", "--seed")
            for verb in ("weigh", "simulate", "view", "wipe", "teleop", "excite")
        ),
        ("weigh --pose Tkae3", "did you mean 'Take3'"),
        ("weigh --pose 1,2", "has 7 joints, got 2 angles"),
        ("weigh --pose 9,0,0,0,0,0,0", "outside its limits"),
        ("weigh --arm justina", "did you mean 'justina_left_arm'"),
        ("weigh --arm gone.yaml", "gone.yaml"),
        ("weigh --estimator payload", "did you mean 'payload-filter'"),
        ("weigh --observer kalman", "extended-kalman"),
        ("weigh --estimator regression --observer none", "choose an observer"),
        ("weigh --observer model-residual", "model torque"),
        ("weigh --mass -1", "from 0 to 1000 kg, got -1.0"),
        ("weigh --mass nan", "got nan"),
        ("weigh --mass inf", "got inf"),
        ("weigh --mass heavy", "--mass"),
        ("weigh --seed 1.5", "--seed"),
        ("weigh --duration 0", "duration must be above 0"),
        ("weigh --duration nan", "duration"),
        ("weigh --speed -2", "speed"),
        ("weigh --mas 1", "--mass"),
        ("weigh gone.mcap", "gone.mcap: no such file"),
        ("weigh gone.mcap --mass 1", "--mass is for a simulation"),
        ("weigh --columns lara8", "--columns is for a LOG"),
        ("wegh", "weigh"),
        ("simulate --out x.csv", ".mcap"),
        ("simulate --load 1@", "0.25@4"),
        ("simulate --load 1@3 --load 2@1", "ascend"),
        ("simulate --rate 0", "rate"),
        ("simulate --jitter 1", "jitter"),
        ("simulate --loss 2", "loss"),
        ("simulate --fps 0", "--fps"),
        ("replay gone.mcap", "no such file"),
        ("replay", "LOG"),
        ("tare gone.mcap --arm justina_left_arm -o card.yaml", "no such file"),
        ("tare gone.mcap --arm justina_left_arm", "out"),
        ("reproduce nothing", "there are"),
        ("reproduce payload-filter", "palpate bench payload-filter"),
        ("bench lara8", "palpate reproduce lara8"),
        ("arm show nobody", "reference arms"),
        ("arm show justina_left_arm --pose no", "there are"),
        ("arm export justina_left_arm", "--card"),
        ("data get lara", "did you mean 'lara8'"),
        ("data path nothing", "lara8"),
    ],
)
def test_wrong_input_is_one_line_that_names_the_place_and_the_choices(
    arguments: str, words: str, palpate
) -> None:
    done = palpate(*arguments.split())
    assert done.code == 2
    assert done.out == ""
    (line,) = done.err.splitlines()
    assert line.startswith("palpate: ") and words in line
    assert "Traceback" not in done.err


def test_damaged_files_are_named(palpate, tmp_path: Path, recording: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    (tmp_path / "bad.urdf").write_text("<robot><link></robot>")
    (tmp_path / "bad.yaml").write_text("palpate_card: 1\nname: x\n")
    for arguments, words in (
        (("weigh", "bad.mcap", "--arm", "justina_left_arm"), "bad.mcap"),
        (("weigh", "--arm", "bad.urdf"), "bad.urdf"),
        (("weigh", "--arm", "bad.yaml"), "bad.yaml"),
        (("replay", "bad.yaml"), "unknown kind of log"),
        (("weigh", recording, "--arm", "kuka_lbr_iiwa7", "--no-report"), "ok"),
        (("weigh", recording, "--arm", "katana_300_6m180"), "7 joints"),
    ):
        done = palpate(*arguments)
        if words == "ok":  # as many joints, other names: weighed, and said
            assert done.code == 0 and "named otherwise" in done.out
            continue
        assert done.code == 2 and words in done.err and len(done.err.splitlines()) == 1
    # a recording cut short is weighed as far as it goes
    (tmp_path / "cut.mcap").write_bytes(recording.read_bytes()[:1_500_000])
    done = palpate("weigh", "cut.mcap", "--json", "--no-report")
    assert done.code == 0 and 100 < done.json["samples"] < 1751
    assert palpate("replay", "cut.mcap").code == 0


def test_debug_adds_the_traceback(palpate, monkeypatch: pytest.MonkeyPatch) -> None:
    done = palpate("weigh", "--pose", "no", "--debug")
    assert done.code == 2 and "Traceback" in done.err
    monkeypatch.setenv("PALPATE_DEBUG", "1")
    assert "Traceback" in palpate("weigh", "--pose", "no").err


def test_a_bug_says_that_it_is_one(palpate, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("palpate.weigh.scene", broken)
    done = palpate("weigh")
    assert done.code == 70 and done.out == ""
    assert done.err.startswith("palpate: internal error: ZeroDivisionError: division by zero (test_cli.py:")
    assert "report it" in done.err and "Traceback" not in done.err
    assert "Traceback" in palpate("weigh", "--debug").err


@pytest.mark.parametrize(
    "module, arguments, extra",
    [
        ("typer", "weigh", "cli"),
        ("rich", "weigh --no-report --no-record --duration 1", "cli"),
        ("mujoco", "weigh --no-report --no-record", "sim"),
        ("matplotlib", "weigh --duration 1 --no-record", "report"),
        ("yaml", "weigh --duration 1", "card"),
        ("cv2", "see photo.png", "vision"),
    ],
)
def test_a_missing_extra_is_one_line_with_the_pip_install(
    module: str, arguments: str, extra: str, tmp_path: Path
) -> None:
    code = f"import sys; sys.modules[{module!r}] = None; from palpate.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments.split()],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and f'pip install "palpate[{extra}]"' in line


# --- the other verbs ----------------------------------------------------------------------------------------


def test_simulate_writes_a_log_a_picture_and_a_film(palpate, tmp_path: Path) -> None:
    done = palpate(
        *"simulate --pose Take --pose StandBy --load 0.1@0.1 --duration 0.4 --move 0.2 --hold 0".split(),
        *"--png arm.png --frames film --fps 10 --json --loss 0.1 --jitter 0.001".split(),
    )
    found = done.json
    assert found["frames"] in (4, 5) and found["files"]["log"] == "simulated.mcap"
    names = sorted(p.name for p in (tmp_path / "film").iterdir())
    assert names == [f"frame_{i:05d}.png" for i in range(found["frames"])]
    assert (tmp_path / "arm.png").read_bytes().startswith(b"\x89PNG")
    log = pp.Log.open(tmp_path / "simulated.mcap", keep_invalid=True)
    assert len(log) == found["samples"] < 101
    assert set(log.signals["true_mass"].value) == {0.0, 0.1}
    assert palpate("replay", "simulated.mcap").code == 0
    assert palpate("simulate", "--duration", 0.1, "--quiet").out == "simulated.mcap\n"


def test_replay_says_same_or_different(palpate, recording: Path, tmp_path: Path) -> None:
    done = palpate("replay", recording)
    assert done.code == 0 and done.out.startswith("the same, bit for bit: 10 quantities of 1751 samples")
    log = pp.Log.open(recording, keep_invalid=True)
    effort = np.array(log.effort)
    effort.view(np.int64)[100, 2] ^= 1 << 30
    pp.Log(
        **{
            name: getattr(log, name)
            for name in ("time_ns", "position", "joint_names", "signals", "events", "meta")
        },
        effort=effort,
    ).save(tmp_path / "flipped.mcap")
    done = palpate("replay", "flipped.mcap")
    assert done.code == 1 and done.out.startswith("different: ") and "first at 0.4" in done.out
    found = palpate("replay", "flipped.mcap", "--json")
    assert found.code == 1 and found.json["same"] is False
    assert min(d["first_sample"] for d in found.json["differences"]) in (100, 101)
    quiet = palpate("replay", recording, "--quiet")
    assert quiet.code == 0 and len(quiet.out.splitlines()) == 1


def test_tare_corrects_the_masses(palpate, tmp_path: Path) -> None:
    arm = pp.robots.load("justina_left_arm")
    poses = "--pose Take3 --pose StandBy --pose Take4 --pose StandBy2".split()
    done = palpate("simulate", "--load", 0, *poses, "--duration", 18, "--out", "empty.mcap", "--hold", 1)
    assert done.code == 0
    wrong = arm.replace(
        joints=tuple(j.replace(mass=1.2 * j.mass, inertia=1.2 * j.inertia) for j in arm.joints)
    )
    wrong.save(tmp_path / "wrong.yaml")
    done = palpate("tare", "empty.mcap", "--arm", "wrong.yaml", "-o", "right.yaml")
    assert done.code == 0 and done.out.splitlines()[-1] == "right.yaml"
    found = palpate("tare", "empty.mcap", "--arm", "wrong.yaml", "-o", "right.yaml", "--json").json
    assert found["factors"][3:6] == pytest.approx([1 / 1.2] * 3, abs=0.05)
    tared = pp.Arm.from_card(tmp_path / "right.yaml")
    assert [j.mass for j in tared.joints] == found["masses_kg"]
    (tmp_path / "right.yaml").write_text("mine")
    assert palpate("tare", "empty.mcap", "--arm", "wrong.yaml", "-o", "right.yaml").code == 2


def test_arm_show_and_export(palpate, tmp_path: Path) -> None:
    assert "kuka_lbr_iiwa7" in palpate("arm", "list").out
    assert palpate("arm", "list", "--json").json["arms"] == list(pp.robots.names())
    shown = palpate("arm", "show", "justina_left_arm", "--pose", "Take3").out
    assert "la_6_joint: lever 0.183 m" in shown and "mass      1.39 kg" in shown
    found = palpate("arm", "show", "justina_left_arm", "--pose", "Take3", "--json").json
    assert found["weighing_joint"]["name"] == "la_6_joint" and len(found["joints"]) == 7
    assert palpate("arm", "show", "abb_irb2400_16", "--json").json["joints"][0]["effort_Nm"] is None

    done = palpate(
        "arm", "export", "kuka_lbr_iiwa7", "--card", "a.yaml", "--urdf", "a.urdf", "--header", "a.hpp"
    )
    assert done.code == 0 and done.out.split() == ["a.yaml", "a.urdf", "a.hpp"]
    arm = pp.robots.load("kuka_lbr_iiwa7")
    assert pp.Arm.from_card(tmp_path / "a.yaml") == arm
    assert "ArmDescription" in (tmp_path / "a.hpp").read_text()
    assert "kuka_lbr_iiwa7" in palpate("arm", "export", "a.urdf", "--card", "-").out
    (tmp_path / "a.yaml").write_text("mine")
    assert palpate("arm", "export", "kuka_lbr_iiwa7", "--card", "a.yaml").code == 2


def test_arm_show_without_masses(palpate, tmp_path: Path) -> None:
    pp.Arm.from_dh([0.0, 0.5, 0.4], [np.pi / 2, 0.0, 0.0], [0.3, 0.0, 0.0], name="dh").save(
        tmp_path / "dh.yaml"
    )
    shown = palpate("arm", "show", "dh.yaml").out
    assert "kinematics only" in shown and "weighs" in shown
    assert palpate("arm", "show", "dh.yaml", "--pose", "0,0,0").code == 2
    assert "cannot be simulated" in palpate("weigh", "--arm", "dh.yaml").err


def test_data(palpate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    listed = palpate("data", "list", "--json").json["sets"]
    assert listed[0]["name"] == "lara8" and listed[0]["licence"] == "BSD-3-Clause"
    assert "lara8" in palpate("data", "list").out
    monkeypatch.setattr("palpate.data.path", lambda name: None)
    done = palpate("data", "path", "lara8")
    assert done.code == 2 and "palpate data get lara8" in done.err
    monkeypatch.setattr("palpate.data.path", lambda name: tmp_path)
    assert palpate("data", "path", "lara8").out == f"{tmp_path}\n"
    assert palpate("data", "get", "lara8").out == f"{tmp_path}\n"


def test_data_get_asks_for_the_licence(palpate, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("palpate.data.path", lambda name: None)
    done = palpate("data", "get", "lara8")
    assert done.code == 2 and "BSD 3-Clause License" in done.err and "--yes" in done.err.splitlines()[-1]


def test_doctor_finds_everything_here(palpate) -> None:
    found = {f["what"]: f for f in palpate("doctor", "--json").json["findings"]}
    for extra in ("cli", "card", "sim", "report", "dynamixel", "feetech"):
        assert found[f"extra {extra}"]["ok"] is True
    assert "µs" in found["C++ core"]["found"]


def test_doctor_knows_every_extra(palpate) -> None:
    """Those a user asks for by what they bring; the others are bundles."""
    found = {f["what"] for f in palpate("doctor", "--json").json["findings"]}
    extras = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert {f"extra {name}" for name in extras if name not in ("all", "test", "docs", "bench", "dev")} == {
        what for what in found if what.startswith("extra ")
    }


def test_doctor_tells_what_is_missing(palpate, monkeypatch: pytest.MonkeyPatch) -> None:
    import importlib.util

    find = importlib.util.find_spec

    def missing(name: str, *arguments):
        return None if name in ("mujoco", "pooch") else find(name, *arguments)

    monkeypatch.setattr(importlib.util, "find_spec", missing)
    monkeypatch.setattr("shutil.which", lambda *a, **k: None)
    done = palpate("doctor")
    assert done.code == 0 and pp.__version__ in done.out and "needs the extra sim" in done.out
    assert 'pip install "palpate[sim]"' in done.out and 'pip install "palpate[data]"' in done.out
    assert "C++ compiler" in done.out


# --- studies ------------------------------------------------------------------------------------------------


@pytest.fixture
def fake_studies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two studies that take no time: one holds, one misses."""

    def run(self: Study, progress=None, quick: bool = False, folder=None, hours=None) -> StudyResult:
        if progress is not None:
            progress(1, 2, float("inf"))
            progress(2, 2, 0.0)
        ok = None if quick else self.name != "misses"
        rows = (
            StudyRow("mass", 0.25, np.float64(0.251), 0.01, ok, "kg"),
            StudyRow("for information", ours=float("nan")),
        )
        return StudyResult(self.name, self.title, rows, {}, ("measured here",), 0.1)

    monkeypatch.setattr(Study, "run", run)
    fakes = {n: Study(n, f"It {n}", "bench", campaign=n == "holds") for n in ("holds", "misses")}
    monkeypatch.setattr(studies, "STUDIES", {**fakes, "paper": Study("paper", "A paper", "reproduce")})


def test_studies_print_write_and_judge(palpate, tmp_path: Path, fake_studies: None) -> None:
    done = palpate("reproduce")
    assert done.code == 0 and "1 of 1 rows hold" in done.out and "mass [kg]" in done.out
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == [
        "paper.html",
        "paper.json",
        "paper.md",
    ]
    assert palpate("bench", "holds", "--out", "other").code == 0
    done = palpate("bench")
    assert done.code == 1 and "0 of 1 rows hold" in done.out
    found = palpate("bench", "misses", "--json")
    assert found.code == 1 and found.json["ok"] is False
    (study,) = found.json["studies"]
    assert study["rows"][0]["ok"] is False and study["rows"][1]["ours"] is None
    quick = palpate("bench", "misses", "--quick", "--quiet")
    assert quick.code == 0 and quick.out == "misses: no row judged\n"
    listed = palpate("bench", "--list")
    assert [line.split()[0] for line in listed.out.splitlines()] == ["holds", "misses"]
    assert palpate("reproduce", "--list", "--json").json == {
        "studies": [{"name": "paper", "title": "A paper"}]
    }


def test_hours_are_for_campaigns(palpate, fake_studies: None) -> None:
    assert palpate("bench", "holds", "--hours", "2").code == 0
    done = palpate("bench", "--hours", "2")
    assert done.code == 2 and "misses runs for a fixed time; a campaign is: holds" in done.err
    assert "a number > 0" in palpate("bench", "holds", "--hours", "0").err
    assert "give one of them" in palpate("bench", "holds", "--hours", "2", "--quick").err


def test_the_real_studies_are_known(palpate) -> None:
    assert "mass-estimation" in palpate("reproduce", "--list").out
    assert "payload-filter" in palpate("bench", "--list").out


# --- help, speed, signals -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "verb",
    [
        *("", *VERBS, "arm show", "arm export", "arm list", "data get", "data list", "data path"),
        *("ros run", "ros launch", "ros list", "ros echo"),
        *("teleop run", "teleop slave", "teleop master", "teleop key", "teleop join"),
    ],
)
def test_every_verb_has_help_with_examples(verb: str, palpate) -> None:
    done = palpate(*verb.split(), "--help")
    assert done.code == 0 and done.err == ""
    assert done.out.startswith(f"Usage: palpate {verb}".rstrip())
    if verb not in ("", "arm", "data", "ros"):
        assert "Examples:\n    palpate " in done.out or "Examples:\n    ls $(palpate" in done.out
    assert "[dim]" not in done.out and "[bold]" not in done.out


def test_nothing_and_version(palpate) -> None:
    assert palpate().out == palpate("--help").out
    assert palpate("arm").out == palpate("arm", "--help").out
    assert palpate("--version").out == f"palpate {pp.__version__}\n"


def test_help_loads_nothing_heavy() -> None:
    code = "import sys; from palpate.cli import main; main(['weigh', '--help']); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    heavy = {"mujoco", "matplotlib", "palpate.report", "palpate.weigh", "palpate.studies", "rich.live"}
    assert not set(done.stderr.split()) & heavy


def test_ctrl_c_stops_the_arm_and_keeps_what_there_is(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "palpate.cli", "weigh", "--duration", "600", "--speed", "1"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        run = tmp_path / "run.mcap"
        for _ in range(400):
            time.sleep(0.05)
            if run.exists() and run.stat().st_size > 200_000:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130 and err == ""
    assert "! Stopped after " in out and (tmp_path / "report.html").exists()
    log = pp.Log.open(run, keep_invalid=True)
    assert len(log) > 20 and log.events[-1].kind == "stop"
    assert main(["replay", str(run), "--quiet"]) == 0


def test_a_closed_pipe_is_no_error(recording: Path) -> None:
    done = subprocess.run(
        f"{sys.executable} -m palpate.cli arm export justina_left_arm --card - | head -1; exit ${{PIPESTATUS[0]}}",
        shell=True,
        executable="/bin/bash",
        capture_output=True,
        text=True,
        env={**os.environ},
        check=False,
    )
    assert done.returncode == 0 and done.stderr == "" and len(done.stdout.splitlines()) == 1


def test_a_terminal_sees_the_table_while_the_arm_moves(tmp_path: Path) -> None:
    import pty

    master, slave = pty.openpty()
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "40"}
    command = [
        sys.executable,
        "-m",
        "palpate.cli",
        "weigh",
        "--duration",
        "1",
        "--speed",
        "10",
        "--no-report",
    ]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=slave, stderr=slave, env=environment)
    os.close(slave)
    seen = b""
    while True:
        try:
            part = os.read(master, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    assert process.wait(timeout=60) == 0
    os.close(master)
    text = seen.decode("utf-8", "replace")
    assert text.count("external torque N m") >= 5
    assert "justina_left_arm lifts an object" in text and "wanted rad" in text
    assert "run.mcap" in text
