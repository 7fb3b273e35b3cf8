"""Arms from Denavit-Hartenberg tables, against the product of the textbook's elementary transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from palpate.arm import Arm, Effort
from palpate.errors import ArmError


def elementary(axis: str, turn: float, slide: float) -> np.ndarray:
    """Screw along x or z."""
    c, s = math.cos(turn), math.sin(turn)
    T = np.eye(4)
    if axis == "z":
        T[:2, :2] = [[c, -s], [s, c]]
        T[2, 3] = slide
    else:
        T[1:3, 1:3] = [[c, -s], [s, c]]
        T[0, 3] = slide
    return T


def textbook(
    table: dict[str, np.ndarray], q: np.ndarray, convention: str, prismatic: list[bool]
) -> list[np.ndarray]:
    """T_base_dh of every DH frame."""
    T, out = np.eye(4), []
    for a, alpha, d, theta, x, slides in zip(*table.values(), q, prismatic, strict=True):
        z = elementary("z", theta + (0 if slides else x), d + (x if slides else 0))
        cross = elementary("x", alpha, a)
        T = T @ (z @ cross if convention == "standard" else cross @ z)
        out.append(T)
    return out


@pytest.mark.parametrize("convention", ["standard", "modified"])
@pytest.mark.parametrize("seed", range(5))
def test_frames_are_where_the_textbook_puts_them(convention, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 8))
    table = dict(zip(("a", "alpha", "d", "theta0"), rng.uniform(-2, 2, (4, n)), strict=True))
    prismatic = [bool(x) for x in rng.random(n) < 0.3]
    arm = Arm.from_dh(**table, convention=convention, prismatic=prismatic)
    for q in rng.uniform(-3, 3, (5, n)):
        frames = textbook(table, q, convention, prismatic)
        assert np.allclose(arm.forward_kinematics(q), frames[-1], atol=1e-13)
        for i in range(n):
            link, T = arm.frames[f"dh_{i + 1}"]
            shorter = arm.replace(joints=arm.joints[: i + 1], T_last_tip=T, frames={})
            assert link == i and np.allclose(shorter.forward_kinematics(q[: i + 1]), frames[i], atol=1e-13)


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_dynamics_do_not_depend_on_where_the_link_frame_is(convention):
    # potential energy of the masses, put into the textbook's frames, must give the arm's gravity torque
    rng = np.random.default_rng(3)
    n = 4
    table = dict(zip(("a", "alpha", "d", "theta0"), rng.uniform(-1, 1, (4, n)), strict=True))
    masses, coms = rng.uniform(1, 3, n), rng.uniform(-0.3, 0.3, (n, 3))
    inertials = [(m, c, np.diag([0.02, 0.03, 0.04])) for m, c in zip(masses, coms, strict=True)]
    gravity = np.array([1.0, -2.0, -9.0])
    arm = Arm.from_dh(
        **table, convention=convention, inertials=inertials, gravity=gravity, effort=Effort.torque()
    )
    assert arm.has_dynamics and arm.effort == Effort.torque()
    q, step = rng.uniform(-1, 1, n), 1e-6

    def energy(q):
        frames = textbook(table, q, convention, [False] * n)
        return -sum(
            m * gravity @ (T[:3, :3] @ c + T[:3, 3]) for m, c, T in zip(masses, coms, frames, strict=True)
        )

    slope = [(energy(q + step * e) - energy(q - step * e)) / (2 * step) for e in np.eye(n)]
    assert np.allclose(arm.gravity_torque(q), slope, atol=1e-7)
    # the same link tensors, seen from the textbook's frames, give the kinetic energy
    dq = rng.normal(size=n)
    after = textbook(table, q + step * dq, convention, [False] * n)
    before = textbook(table, q - step * dq, convention, [False] * n)
    at = textbook(table, q, convention, [False] * n)
    kinetic = 0.0
    for m, c, T, Ta, Tb in zip(masses, coms, at, after, before, strict=True):
        dT = (Ta - Tb) / (2 * step)
        v = dT[:3, :3] @ c + dT[:3, 3]
        W = T[:3, :3].T @ dT[:3, :3]
        w = np.array([W[2, 1], W[0, 2], W[1, 0]])
        kinetic += 0.5 * m * v @ v + 0.5 * w @ np.diag([0.02, 0.03, 0.04]) @ w
    assert 0.5 * dq @ arm.mass_matrix(q) @ dq == pytest.approx(kinetic, rel=1e-8)


def test_two_ways_to_write_a_planar_arm():
    # standard DH carries a link's length in its own row, modified DH in the next one
    standard = Arm.from_dh([0.4, 0.3], [0, 0], [0, 0])
    modified = Arm.from_dh(
        [0, 0.4, 0.3], [0, 0, 0], [0, 0, 0], convention="modified", joint_names=["a", "b", "c"]
    )
    assert modified.joint_names == ("a", "b", "c") and standard.joint_names == ("joint_1", "joint_2")
    q = np.array([0.3, -0.5])
    assert np.allclose(standard.forward_kinematics(q), modified.forward_kinematics([*q, 0]))
    assert not standard.has_dynamics and standard.joints[0].link == "link_1"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"alpha": [0]}, r"DH alpha must have shape \(2,\), got \(1,\)"),
        ({"a": [1, "x"]}, "DH a must be numbers"),
        ({"a": [1, [2, 3]]}, "DH a must be numbers|DH a must have shape"),
        ({"a": []}, r"DH alpha must have shape \(0,\)"),
        ({"d": [0, np.nan]}, "DH d must be finite"),
        ({"theta0": [0]}, r"DH theta0 must have shape \(2,\)"),
        ({"convention": "craig"}, "convention must be 'standard' or 'modified', got 'craig'"),
        ({"joint_names": ["a"]}, "joint_names must have one entry per DH row, 2, got 1"),
        ({"joint_names": ["a", "a"]}, "joint name 'a' is used twice"),
        ({"prismatic": [True]}, "prismatic must have one entry per DH row"),
        ({"inertials": []}, "inertials must have one entry per DH row"),
        ({"inertials": [(1, (0, 0, 0), np.eye(3)), (0, (0, 0, 0), np.eye(3))]}, "mass of link 2 must be > 0"),
        ({"inertials": [(1, (0, 0), np.eye(3))] * 2}, r"com of link 1 must have shape \(3,\)"),
        ({"inertials": [(1, (0, 0, 0), -np.eye(3))] * 2}, "link 'link_1' .* not positive definite"),
    ],
)
def test_wrong_tables_are_refused_and_named(changes, message):
    with pytest.raises(ArmError, match=message):
        Arm.from_dh(**({"a": [0.4, 0.3], "alpha": [0, 0], "d": [0, 0]} | changes))
