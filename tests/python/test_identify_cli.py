"""``palpate identify``: what it writes, and what it says of logs that are wrong."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest

import palpate as pp
from palpate import Arm, Effort, Friction, Log
from palpate.cli import main
from palpate.errors import InputError, LogError
from palpate.identify import fit
from palpate.logs import open_known
from recordings import recording

pytest.importorskip("scipy", reason="palpate[identify] is not installed")

RATE = 100.0
GAIN = np.array([11.976, 11.976, 9.839, 10.763, 10.763, 10.763])


def truth() -> Arm:
    """Four joints: a vertical one, two that lift, one that turns the hand about its own axis."""
    masses, lengths = (6.0, 5.0, 3.0, 1.0), (0.0, 0.5, 0.4, 0.0)
    inertials = [
        (
            m,
            (-0.5 * a, 0.02, -0.03 if a == 0.0 else 0.01),
            m * np.diag([0.004, 0.006 + 0.1 * a * a, 0.005 + 0.1 * a * a]),
        )
        for m, a in zip(masses, lengths, strict=True)
    ]
    arm = Arm.from_dh(
        lengths,
        (math.pi / 2, 0.0, math.pi / 2, 0.0),
        (0.3, 0.0, 0.0, 0.2),
        inertials=inertials,
        joint_names=("waist", "shoulder", "elbow", "wrist"),
        effort=Effort.torque(),
    )
    joints = [
        j.replace(
            rotor_inertia=0.2 / (i + 1),
            friction=Friction(coulomb=3.0 / (i + 1), viscous=2.0 / (i + 1), offset=0.2, sign_velocity=1e-3),
        )
        for i, j in enumerate(arm.joints)
    ]
    return arm.replace(joints=tuple(joints))


def known(arm: Arm) -> Arm:
    """What a URDF says: masses that are a fifth off, no friction."""
    joints = [
        j.replace(mass=f * j.mass, inertia=f * j.inertia, rotor_inertia=0.0, friction=Friction())
        for j, f in zip(arm.joints, (1.2, 0.8, 1.2, 0.8), strict=True)
    ]
    return arm.replace(joints=tuple(joints))


def motion(seconds: float = 16.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 1.0 / RATE)
    q, dq, ddq = np.zeros((3, len(t), 4))
    for k in range(1, 6):
        w = 2 * np.pi * 0.12 * k
        a, b = rng.normal(0.0, 0.6 / k, (2, 4))
        angle = (w * t)[:, None]
        q += a * np.sin(angle) + b * np.cos(angle)
        dq += w * (a * np.cos(angle) - b * np.sin(angle))
        ddq -= w * w * (a * np.sin(angle) + b * np.cos(angle))
    return t, q, dq, ddq


def log_of(arm: Arm, moved: tuple[np.ndarray, ...], *, load: float = 0.0, noise: float = 0.02) -> Log:
    t, q, dq, ddq = moved
    torque = arm.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    held = np.r_[load, load * np.array([0.0, 0.0, 0.1]), load * 0.01 * np.array([1, 0, 0, 1, 0, 0.1])]
    torque += arm.regressor(q, dq, ddq)[:, :, -10:] @ held
    torque += noise * np.random.default_rng(1).standard_normal(torque.shape)
    return Log(
        time_ns=np.rint(t * 1e9).astype(np.int64),
        position=q,
        velocity=dq,
        effort=torque / arm.effort.gain(arm.n),
        joint_names=arm.joint_names,
        meta={"effort_unit": "N m" if arm.effort.kind == "torque" else "A"},
    )


def changed(
    log: Log, *, joints: list[int] | None = None, effort_only: bool = False, **factors: object
) -> Log:
    """The log with columns in another order or multiplied."""
    at = list(range(log.n)) if joints is None else joints
    position, velocity = log.position, log.velocity
    if not effort_only:
        position, velocity = position[:, at], velocity[:, at]
    moved = np.asarray(factors.get("position", 1.0))
    return dataclasses.replace(
        log,
        position=position * moved,
        velocity=velocity * moved,
        effort=log.effort[:, at] * np.asarray(factors.get("effort", 1.0)),
    )


def save(log: Log, path: Path) -> Path:
    """As a table with palpate's column names."""
    n = log.n
    names = [f"{what}_{j + 1}" for what in ("position", "velocity", "effort") for j in range(n)]
    rows = np.column_stack([log.seconds, log.position, log.velocity, log.effort])
    lines = [",".join(["time_s", *names]), *(",".join(f"{v:.12g}" for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the arm's card and logs of it, free and with 2 kg in the hand."""
    folder = tmp_path_factory.mktemp("identify")
    known(truth()).save(folder / "arm.yaml")
    save(log_of(truth(), motion()), folder / "free.csv")
    save(log_of(truth(), motion(seed=1)), folder / "other.csv")
    save(log_of(truth(), motion(seed=2), load=2.0), folder / "loaded.csv")
    return folder


@pytest.fixture
def palpate(capsys: pytest.CaptureFixture[str], world: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(world)

    def run(*arguments: object) -> tuple[int, str, str]:
        code = main([str(a) for a in arguments])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


def test_card_urdf_and_report(palpate, world: Path) -> None:
    arguments = (
        "free.csv",
        "--arm",
        "arm.yaml",
        "--test",
        "other.csv",
        "--load",
        "2@loaded.csv",
        "--urdf",
        "new.urdf",
    )
    code, out, err = palpate("identify", *arguments, "-o", "new.yaml", "--report", "report.html")
    assert (code, err) == (0, "")
    assert out.splitlines()[-3:] == ["new.yaml", "new.urdf", "report.html"]
    assert "held out" in out and "logs the fit has not seen" in out
    found, real = Arm.from_card(world / "new.yaml"), truth()
    from_urdf = Arm.from_urdf(world / "new.urdf")
    _, q, dq, ddq = motion(seed=3)
    torque = real.inverse_dynamics(q, dq, ddq)
    for arm in (found, from_urdf):
        error = arm.inverse_dynamics(q, dq, ddq) - torque
        assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(torque**2))
    for new, old in zip(found.joints, real.joints, strict=True):
        assert new.friction.coulomb == pytest.approx(old.friction.coulomb, rel=0.05)
    assert "sha256" in found.provenance["log 1"] and found.provenance["method"].startswith("consistent")
    page = (world / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 8 and "http://" not in page.replace("http://www.w3.org", "")
    for heading in (
        "Residuals",
        "Torques: other.csv",
        "Residual spectra",
        "Friction and rotors",
        "Base parameters",
    ):
        assert heading in page
    assert "weighs 2.0" in page
    # the same command writes the same bytes
    before = (world / "new.yaml").read_bytes(), (world / "report.html").read_bytes()
    assert palpate("identify", *arguments, "-o", "new.yaml", "--report", "report.html", "--quiet")[0] == 0
    assert before == ((world / "new.yaml").read_bytes(), (world / "report.html").read_bytes())


def test_json_says_which_parameters_the_data_know(palpate) -> None:
    code, out, _ = palpate(
        "identify", "free.csv", "--arm", "arm.yaml", "-o", "j.yaml", "--no-report", "--json"
    )
    assert code == 0
    result = json.loads(out)
    sources = {p["name"]: p["source"] for p in result["parameters"]}
    assert sources["shoulder.coulomb"] == "data"
    assert sources["link_1.m"] == "prior"  # it turns about a vertical axis: nobody can weigh it
    assert result["rank"] == result["structural_rank"]
    assert result["held_out"]["what"] == "each third from the others"


@pytest.mark.parametrize("method", ["damped", "irls", "wls", "ols"])
def test_methods(method: str) -> None:
    log = log_of(truth(), motion())
    found = fit(
        known(truth()), log, method=method, friction="coulomb", validate_on=log_of(truth(), motion(seed=1))
    )
    assert found.held_out.relative_overall < 0.01
    assert all(0.0 <= e.seen <= 1.0 for e in found.parameters)


def test_gains_from_a_known_load(palpate, world: Path) -> None:
    gain = np.array([10.0, 12.0, 9.0, 7.0])
    arm = truth().replace(effort=Effort.current(gain))
    save(log_of(arm, motion()), world / "free_a.csv")
    save(log_of(arm, motion(seed=2), load=2.0), world / "loaded_a.csv")
    code, out, err = palpate(
        "identify", "free_a.csv", "--arm", "arm.yaml", "--gains", "--load", "2@loaded_a.csv", "-o", "g.yaml",
        "--no-report", "--json",
    )  # fmt: skip
    assert code == 0, err
    found = json.loads(out)["gains"]
    assert np.all(np.abs(np.array(found["value"]) - gain) < 4.0 * np.array(found["std"]) + 0.01 * gain)
    code, _, err = palpate("identify", "free_a.csv", "--arm", "arm.yaml", "--gains", "-o", "g.yaml")
    assert code == 2 and "only the ratios of torques to gains are identifiable" in err


# -- logs that are wrong ----------------------------------------------------------------------------------------------

ALPHABET = [2, 1, 0, 3]  # elbow, shoulder, waist, wrist


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": 180.0 / math.pi}, "look like degrees: give the column map the unit"),
        ({"effort": 1000.0}, "may be in mA or mN m"),
        ({"effort": 0.01}, "motor's side of the gear"),
        ({"effort": 0.0}, "the effort is zero throughout"),
        ({"effort": -1.0}, "opposite sign of the arm's on every joint"),
        ({"effort": [1.0, 1.0, -1.0, 1.0]}, "the effort of elbow has the opposite sign"),
        ({"position": [1.0, -1.0, 1.0, 1.0]}, "the position of shoulder has the opposite sign"),
        ({"joints": ALPHABET}, "the log's columns look ordered elbow, shoulder, waist, wrist"),
        ({"joints": [0, 2, 1, 3]}, "the log's columns look ordered waist, elbow, shoulder, wrist"),
        (
            {"joints": [1, 0, 2, 3], "effort_only": True},
            "the columns of the effort, but not those of the position, look ordered shoulder, waist, elbow, wrist",
        ),
    ],
)
@pytest.mark.parametrize("seed", [0, 5])
def test_mistakes_in_the_columns_are_named(change: dict, message: str, seed: int) -> None:
    arm = known(truth())
    log = log_of(truth(), motion(seed=seed))
    with pytest.raises(InputError, match=message):
        fit(arm, changed(log, **change), cross_validate=False)


def test_a_small_motion_in_degrees_is_found_by_its_torque() -> None:
    """It stays within what the limits allow in rad. Below some ten degrees nothing tells it."""
    t, q, dq, ddq = motion()
    log = log_of(truth(), (t, 0.3 * q, 0.3 * dq, 0.3 * ddq))
    with pytest.raises(InputError, match="degrees"):
        fit(known(truth()), changed(log, position=180.0 / math.pi), cross_validate=False)


@pytest.mark.parametrize("seed", range(4))
def test_right_logs_pass(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, q, dq, ddq = motion(10.0, seed)
    size = rng.uniform(0.1, 1.0, 4)
    log = log_of(truth(), (t, q * size, dq * size, ddq * size), noise=rng.uniform(0.0, 1.0))
    assert fit(known(truth()), log, friction="coulomb", cross_validate=False).residuals.overall < 1.2


def test_a_joint_that_rests_or_never_reverses_gets_no_number(palpate, world: Path) -> None:
    t, q, dq, ddq = motion()
    q[:, 3], dq[:, 3], ddq[:, 3] = 0.2, 0.0, 0.0
    q[:, 1], dq[:, 1], ddq[:, 1] = 0.1 * t, 0.1, 0.0
    save(log_of(truth(), (t, q, dq, ddq)), world / "poor.csv")
    arguments = ("identify", "poor.csv", "--arm", "arm.yaml", "--no-report")
    code, out, err = palpate(*arguments, "-o", "poor.yaml")
    assert code == 2 and out == "" and not (world / "poor.yaml").exists()
    assert "wrist moves by 0 rad only, so wrist.rotor_inertia, wrist.coulomb, wrist.viscous" in err
    assert "shoulder never reverses, so shoulder.coulomb and shoulder.offset cannot be told apart" in err
    assert "no effect in this motion; to see" in err
    code, out, _ = palpate(*arguments, "-o", "poor.yaml", "--partial", "--json")
    assert code == 0
    values = {p["name"]: p["value"] for p in json.loads(out)["parameters"]}
    assert values["wrist.coulomb"] is None and values["shoulder.coulomb"] is None
    assert values["elbow.coulomb"] == pytest.approx(1.0, rel=0.1)
    # the card keeps what it had
    assert Arm.from_card(world / "poor.yaml").joints[3].friction == Friction()


def test_the_motion_proposed_shows_what_was_missing() -> None:
    t, q, dq, ddq = motion()
    for j in (0, 2, 3):
        q[:, j], dq[:, j], ddq[:, j] = 0.3, 0.0, 0.0
    found = fit(known(truth()), log_of(truth(), (t, q, dq, ddq)), friction="coulomb", cross_validate=False)
    assert found.blind == (0, 2, 3)
    assert "combinations of rigid parameters" in found.unseen[-1]
    for name in ("waist", "elbow", "wrist"):
        assert name in found.unseen[-1].split("to see them")[1]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "empty"),
        ("time_s,position_1,effort_1\n", "no rows"),
        ("row", "1 rows"),
        ("still", "no joint"),
    ],
)
def test_logs_without_content(palpate, world: Path, content: str, message: str) -> None:
    path = world / "bad.csv"
    log = log_of(truth(), motion())
    if content == "row":
        save(log[:1], path)
    elif content == "still":
        save(changed(log, position=0.0), path)
    else:
        path.write_text(content, encoding="utf-8")
    code, out, err = palpate("identify", path, "--arm", "arm.yaml", "-o", "bad.yaml", "--no-report")
    assert code == 2 and out == "" and message in err, err
    assert not (world / "bad.yaml").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--load", "two@loaded.csv"), "--load: expected KG@LOG"),
        (("--coupling", "elbow+wirst"), "did you mean 'wrist'"),
        (("--method", "magic"), "method must be consistent, damped"),
        (("--columns", "tx40"), "POSITIONS,CURRENTS"),
        (("--gains", "--load", "2@loaded.csv", "--load", "3@loaded.csv"), "one and the same load"),
    ],
)
def test_wrong_options(palpate, arguments: tuple[str, ...], message: str) -> None:
    code, _, err = palpate(
        "identify", "free.csv", "--arm", "arm.yaml", "-o", "bad.yaml", "--no-report", *arguments
    )
    assert code == 2 and message in err


def test_an_undeclared_effort_is_asked_for(palpate, world: Path) -> None:
    known(truth()).replace(effort=Effort.undeclared()).save(world / "bare.yaml")
    (world / "amperes.yaml").write_text(
        "time: time_s\nposition: position_{joint}\nvelocity: velocity_{joint}\neffort: effort_{joint}\neffort_unit: A\n"
    )
    arguments = ("identify", "free.csv", "--arm", "bare.yaml", "-o", "bad.yaml", "--no-report", "--quiet")
    code, _, err = palpate(*arguments, "--columns", "amperes.yaml")
    assert code == 2 and "a current [A]" in err and "--effort torque" in err and "only the ratios" in err
    assert palpate(*arguments)[0] == 0  # palpate's own tables hold N m


def test_identify_is_there_when_asked_for() -> None:
    assert pp.identify.fit is fit
    with pytest.raises(AttributeError, match="no attribute 'identity'"):
        pp.identity  # noqa: B018


# -- a real robot -----------------------------------------------------------------------------------------------------


def test_a_ur10e_log_is_recognised_and_refused_when_mixed_up(tmp_path: Path) -> None:
    path = recording("ur10e_innopolis", "identification_data/ur-20_02_12-40sec_12harm.csv")
    log, name = open_known(path, 6)
    assert name == "ur10e" and len(log) == 4639
    with pytest.raises(LogError):
        open_known(path, 7)
    arm = Arm.from_urdf(path.parents[1] / "ur10e.urdf", tip="tool0", effort=Effort.current(GAIN))
    part = log.between(5.0, 30.0)
    assert fit(arm, part, cross_validate=False).residuals.relative_overall < 0.03
    with pytest.raises(InputError, match="look ordered elbow_joint, shoulder_lift_joint, shoulder_pan_joint"):
        fit(arm, changed(part, joints=[2, 1, 0, 3, 4, 5]), cross_validate=False)
    with pytest.raises(InputError, match="the effort of wrist_1_joint has the opposite sign"):
        fit(arm, changed(part, effort=[1, 1, 1, -1, 1, 1]), cross_validate=False)
