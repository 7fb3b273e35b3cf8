"""Cards: exact round trips, messages that name the field, and no YAML that gives anything but an arm or an ArmError."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from arm_oracle import random_robot
from palpate import robots
from palpate.arm import Arm, Effort, Friction, Joint, Limits, Sensing, Shape
from palpate.errors import ArmError, MissingExtraError

pytest.importorskip("pydantic", reason="palpate[card] is not installed")
yaml = pytest.importorskip("yaml", reason="palpate[card] is not installed")

numbers = st.floats(-1e8, 1e8, allow_nan=False)
positive = st.floats(0, 1e8, allow_nan=False)
above = st.floats(1e-300, 1e8)
texts = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=8)


@st.composite
def arms(draw) -> Arm:
    """Arms with arbitrary numbers in all fields."""
    seed = draw(st.integers(0, 10**9))
    urdf, base, tip = random_robot(seed)
    arm = Arm.from_urdf(urdf, base=base, tip=tip, gravity=draw(st.tuples(numbers, numbers, numbers)))
    rng = np.random.default_rng(seed)
    names = draw(st.lists(texts, min_size=2 * arm.n + 2, max_size=2 * arm.n + 2, unique=True))
    joints = []
    for i, joint in enumerate(arm.joints):
        stribeck = draw(st.none() | st.tuples(positive, above))
        lower, upper = sorted(draw(st.tuples(numbers, numbers)))
        joints.append(
            joint.replace(
                name=names[2 * i],
                link=names[2 * i + 1],
                rotor_inertia=draw(positive),
                friction=Friction(
                    *draw(st.tuples(positive, positive, numbers)),
                    *(stribeck or (None, None)),
                    load=draw(positive),
                    sign_velocity=draw(above),
                    presliding=draw(above),
                ),
                limits=draw(
                    st.just(Limits()) | st.builds(Limits, st.just(lower), st.just(upper), above, above)
                ),
                sensing=draw(
                    st.builds(Sensing, positive, positive, st.none() | positive, positive, positive, positive)
                ),
            )
        )
    shape = Shape(
        "mesh", (1, 1, -1), arm.joints[0].T_parent_joint, -1, (0, 0.1, 0.2, 1), filename=draw(texts)
    )
    gains = draw(st.tuples(st.lists(above, min_size=arm.n, max_size=arm.n), st.just(-100.0)))
    return Arm(
        name=draw(texts),
        joints=joints,
        gravity=arm.gravity,
        T_last_tip=arm.T_last_tip,
        grasp=rng.normal(size=3),
        effort=draw(st.sampled_from([Effort.undeclared(), Effort.torque(), Effort.current(*gains)])),
        shapes=(shape, *arm.shapes),
        base=names[-1],
        tip=names[-2],
        frames={f"{names[-1]}{k}": (link, T) for k, (link, T) in arm.frames.items()},
        provenance=draw(st.dictionaries(texts, st.text(max_size=30), max_size=3)),
    )


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(arms())
def test_round_trip_is_exact_to_the_bit(tmp_path_factory, arm):
    path = tmp_path_factory.mktemp("cards") / "arm.yaml"
    try:
        arm.save(path)
    except ArmError as e:  # surrogates in a provenance text cannot be written as UTF-8
        assert "cannot write" in str(e)
        return
    back = Arm.from_card(path)
    assert back == arm
    for a, b in zip(arm.joints, back.joints, strict=True):
        for field in ("T_parent_joint", "axis", "com", "inertia"):
            assert np.array_equal(np.signbit(getattr(a, field)), np.signbit(getattr(b, field)))
    # any YAML reader must see the same numbers
    plain = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert plain["palpate_card"] == 1 and plain["name"] == arm.name
    assert [j["rotor_inertia_kg_m2"] for j in plain["joints"]] == [j.rotor_inertia for j in arm.joints]
    assert plain["grasp_m"] == arm.grasp.tolist()


@pytest.mark.parametrize("name", robots.names())
def test_reference_arms_round_trip(tmp_path, name):
    arm = robots.load(name)
    arm.save(tmp_path / "card.yaml")
    assert Arm.from_card(str(tmp_path / "card.yaml")) == arm


def test_negative_zero_survives(tmp_path):
    arm = robots.load("katana_300_6m180")
    joint = arm.joints[0].replace(friction=Friction(offset=-0.0))
    arm.replace(joints=(joint, *arm.joints[1:])).save(tmp_path / "c.yaml")
    assert math.copysign(1, Arm.from_card(tmp_path / "c.yaml").joints[0].friction.offset) == -1


def test_kinematics_only_round_trip(tmp_path):
    arm = Arm.from_dh([0.1, 0.2], [0.3, 0.4], [0.5, 0.6])
    arm.save(tmp_path / "c.yaml")
    text = (tmp_path / "c.yaml").read_text()
    assert Arm.from_card(tmp_path / "c.yaml") == arm and "mass" not in text and "limits" not in text


CARD = """
palpate_card: 1
name: stick
gravity_m_s2: [0, 0, -9.81]
effort: {kind: current, k_t_Nm_A: [1e-1], gear: [50]}
provenance: {date: 2024-05-06, by: yes}
joints:
  - name: hinge
    link: stick
    T_parent_joint_m: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5]]
    axis: [0, 1, 0]
    mass_kg: 1.5
    com_m: [.25, 0, 0]
    inertia_kg_m2: {xx: 1.0e-4, yy: 1e-2, zz: 1E-2}
    friction: {coulomb_Nm: 010}
    limits: {lower_rad: -.inf, upper_rad: 1.5, effort_Nm: +2}
frames:
  camera: {link: base, T_link_frame_m: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1]]}
"""


def read(tmp_path, text: str) -> Arm:
    path = tmp_path / "card.yaml"
    path.write_text(text, encoding="utf-8")
    return Arm.from_card(path)


def test_a_card_written_by_hand(tmp_path):
    arm = read(tmp_path, CARD)
    (hinge,) = arm.joints
    assert (hinge.mass, hinge.kind, hinge.friction.coulomb) == (1.5, "revolute", 10)
    assert hinge.inertia.tolist() == [[1e-4, 0, 0], [0, 1e-2, 0], [0, 0, 1e-2]]
    assert hinge.limits == Limits(upper=1.5, effort=2) and arm.effort.gain(1).tolist() == [5]
    assert arm.provenance == {"date": "2024-05-06", "by": "yes"}
    assert arm.frames["camera"][0] == -1 and arm.tip == "tip"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("palpate_card: 1", "palpate_card: 2", "card.yaml: palpate_card: version must be 1, got 2"),
        ("palpate_card: 1", "", "card.yaml: not a palpate card"),
        (CARD, "", "card.yaml: not a palpate card"),
        (CARD, "[1, 2]", "card.yaml: not a palpate card"),
        ("name: stick\n", "", "card.yaml: name: field required"),
        ("mass_kg", "mas_kg", r"card.yaml: joints\[0\].mas_kg: unknown key; did you mean 'mass_kg'"),
        ("coulomb_Nm", "coulomb", r"joints\[0\].friction.coulomb: unknown key; did you mean 'coulomb_Nm'"),
        ("upper_rad", "uper_rad", r"joints\[0\].limits.uper_rad: unknown key; did you mean 'upper_rad'"),
        ("link: base", "lnk: base", r"frames.camera.link: field required .and 1 more"),
        (
            "kind: current",
            "kind: amps",
            r"effort.kind: input should be 'torque', 'current', 'phase_currents' or 'undeclared', got 'amps'",
        ),
        (
            "mass_kg: 1.5",
            "mass_kg: heavy",
            r"joints\[0\].mass_kg: input should be a valid number.* got 'heavy'",
        ),
        ("mass_kg: 1.5", "mass_kg: .nan", r"joints\[0\].mass_kg: input should be a finite number"),
        ("mass_kg: 1.5", "mass_kg: .inf", r"joints\[0\].mass_kg: input should be a finite number"),
        ("mass_kg: 1.5", "mass_kg: -1.5", r"card.yaml: joints\[0\]: joint 'hinge': mass must be >= 0"),
        ("mass_kg: 1.5", "mass_kg: 1e200", r"joint 'hinge': mass must be finite and below 1e\+09"),
        (
            "yy: 1e-2",
            "yy: 1e-5",
            "card.yaml: .*joint 'hinge': link 'stick' with mass 1.5 kg: inertia breaks the triangle",
        ),
        ("axis: [0, 1, 0]", "axis: [0, 2, 0]", "joint 'hinge': axis must be a unit vector"),
        ("axis: [0, 1, 0]", "axis: [0, 1]", r"joints\[0\].axis\[2\]: field required"),
        ("axis: [0, 1, 0]", "axis: [0, 1, 0, 0]", r"joints\[0\].axis: "),
        ("[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5]]", "[[1, 0, 0, 0]]", r"joints\[0\].T_parent_joint_m"),
        ("link: base", "link: floor", "frames.camera.link: no link 'floor'; links: base, stick"),
        ("upper_rad: 1.5", "upper_rad: -.inf", "limits: lower must not exceed upper"),
        ("gear: [50]", "gear: [0]", "card.yaml: effort gear must be numbers other than 0"),
        ("gear: [50]", "gear: [1, 2]", "effort gear must hold 1 or 1 numbers, got 2"),
        ("joints:", "joints: []\nrest:", r"card.yaml: rest: unknown key|must have 1 to 16"),
        (
            "name: stick\n",
            "name: stick\nname: stock\n",
            "card.yaml:4: malformed YAML: key 'name' appears twice",
        ),
        (
            "name: stick\n",
            "name: &a stick\ntip: *a\n",
            "card.yaml:4: malformed YAML: aliases are not allowed",
        ),
        ("name: stick\n", "? [a]\n: b\n", "card.yaml:3: malformed YAML: a key must be plain text"),
        ("name: stick\n", "name: 2024\n", "card.yaml: name: input should be a valid string, got 2024"),
        ("name: stick\n", "name: [\n", r"card.yaml:\d+: malformed YAML"),
        (
            "name: stick\n",
            "name: !!python/object/apply:os.getcwd []\n",
            "malformed YAML: could not determine a constructor",
        ),
        ("name: stick\n", "name: \0\n", "malformed YAML: .*special characters are not allowed"),
        ("name: stick\n", "<<: {name: stick}\n", "card.yaml: <<: unknown key|name: field required"),
        ("name: stick\n", "name: " + "[" * 100, "nested deeper than 16"),
        ("mass_kg: 1.5", "mass_kg: " + "9" * 5000, r"joints\[0\].mass_kg: input should be a finite number"),
    ],
)
def test_wrong_cards_are_refused_with_their_place(tmp_path, old, new, message):
    assert old in CARD
    with pytest.raises(ArmError, match=message) as caught:
        read(tmp_path, CARD.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_or_written(tmp_path):
    arm = robots.load("kuka_lbr_iiwa7")
    for wrong in (tmp_path, tmp_path / "none" / "x.yaml", "x\0y", None):
        with pytest.raises(ArmError, match="cannot write the card"):
            arm.save(wrong)
    for wrong in (tmp_path, tmp_path / "none.yaml", "x\0y", None):
        with pytest.raises(ArmError, match="cannot read the card"):
            Arm.from_card(wrong)
    huge = tmp_path / "huge.yaml"
    with huge.open("wb") as file:
        file.truncate(5 * 2**20)
    with pytest.raises(ArmError, match="huge.yaml: larger than 4 MiB"):
        Arm.from_card(huge)


@pytest.mark.parametrize("package", ["pydantic", "yaml"])
def test_without_the_extra(monkeypatch, tmp_path, package):
    monkeypatch.delitem(sys.modules, "palpate._card", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    for call in (
        lambda: robots.load("kuka_lbr_iiwa7").save(tmp_path / "x.yaml"),
        lambda: Arm.from_card("x.yaml"),
    ):
        with pytest.raises(MissingExtraError, match=r'an arm\'s card needs `pip install "palpate\[card\]"`'):
            call()


JUNK = [
    "",
    ".nan",
    ".inf",
    "-1",
    "1e308",
    "1e-400",
    "[]",
    "{}",
    "~",
    "&a",
    "*a",
    "!!int",
    "'",
    '"',
    "\n",
    "- ",
    "? ",
    ": ",
    "0x1F",
    "\t",
]


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_cards_give_an_arm_or_an_arm_error(tmp_path_factory, data):
    text = CARD
    for _ in range(data.draw(st.integers(1, 4))):
        start = data.draw(st.integers(0, len(text)))
        end = min(len(text), start + data.draw(st.integers(0, 10)))
        text = text[:start] + data.draw(st.sampled_from(JUNK) | st.text(max_size=4)) + text[end:]
    path = tmp_path_factory.mktemp("noise") / "c.yaml"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        assert isinstance(Arm.from_card(path).joints[0], Joint)
    except ArmError as e:
        assert "\n" not in str(e)
