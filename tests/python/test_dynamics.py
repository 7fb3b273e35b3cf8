"""The recursions against Pinocchio and MuJoCo, each reading the same URDF with its own parser.

Every reference arm at 1000 random states; a quantity must agree to 1e-10 of the largest entry it has in that state.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import resources

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from arm_oracle import Oracle
from palpate import robots
from palpate.arm import Arm

STATES = 1000
TOLERANCE = 1e-10

each_arm = pytest.mark.parametrize("name", robots.names())


def source(name: str) -> str:
    return resources.files("palpate.robots").joinpath(f"{name}.urdf").read_text(encoding="utf-8")


@dataclass(frozen=True)
class States:
    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    tau: np.ndarray  # of the size of the arm's own torques


@cache
def states(name: str) -> States:
    rng = np.random.default_rng(11)
    arm = robots.load(name)
    q, dq, ddq = rng.uniform(-3, 3, (3, STATES, arm.n))
    size = np.abs(arm.gravity_torque(q)).max()
    return States(q, dq, ddq, rng.uniform(-size, size, (STATES, arm.n)))


def assert_agrees(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Both (STATES, ...); relative to the largest entry of each state."""
    assert ours.shape == theirs.shape and len(ours) == STATES
    rows, expected = ours.reshape(STATES, -1), theirs.reshape(STATES, -1)
    worst = np.max(np.abs(rows - expected).max(axis=1) / np.abs(expected).max(axis=1))
    assert worst < TOLERANCE, f"differs by {worst:.2e} of the largest entry"


class MujocoOracle:
    """MuJoCo's reading of a URDF: joints that are not the arm's fixed at zero, gravity as in the arm."""

    def __init__(self, urdf: str, arm: Arm) -> None:
        spec = mujoco.MjSpec.from_string(urdf)
        spec.compiler.fusestatic = False
        for joint in [j for j in spec.joints if j.name not in arm.joint_names]:
            spec.delete(joint)
        self.model = m = spec.compile()
        self.data = mujoco.MjData(m)
        assert tuple(m.joint(i).name for i in range(m.njnt)) == arm.joint_names
        mujoco.mj_kinematics(m, self.data)
        self.R = self.data.body(arm.base).xmat.reshape(3, 3).copy()
        m.opt.gravity[:] = self.R @ arm.gravity
        m.dof_armature[:] = [j.rotor_inertia for j in arm.joints]
        self.tip = m.body(arm.tip).id
        self.n = arm.n

    def move(self, q: np.ndarray, dq: np.ndarray) -> None:
        m, d = self.model, self.data
        d.qpos[:], d.qvel[:] = q, dq
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)

    def inverse_dynamics(self, ddq: np.ndarray) -> np.ndarray:
        out = np.empty(self.n)
        self.data.qacc[:] = ddq
        mujoco.mj_rne(self.model, self.data, 1, out)
        return out + self.model.dof_armature * ddq

    def mass_matrix(self) -> np.ndarray:
        M = np.empty((self.n, self.n))
        mujoco.mj_fullM(self.model, self.data, M)
        return M

    def forward_dynamics(self, tau: np.ndarray) -> np.ndarray:
        bias, out = np.empty(self.n), np.empty((1, self.n))
        mujoco.mj_rne(self.model, self.data, 0, bias)
        mujoco.mj_solveM(self.model, self.data, out, (tau - bias)[None])
        return out[0]

    def jacobian(self) -> np.ndarray:
        J = np.empty((6, self.n))
        mujoco.mj_jac(self.model, self.data, J[:3], J[3:], self.data.xpos[self.tip], self.tip)
        return np.vstack([self.R.T @ J[:3], self.R.T @ J[3:]])


@cache
def mujoco_oracle(name: str) -> MujocoOracle:
    return MujocoOracle(source(name), robots.load(name))


@cache
def pinocchio_oracle(name: str) -> Oracle:
    oracle = Oracle(source(name), robots.load(name))
    assert oracle.model.nq == oracle.model.nv  # so that a configuration is the joint angles
    return oracle


@each_arm
def test_against_mujoco(name):
    arm, oracle, s = robots.load(name), mujoco_oracle(name), states(name)
    tau, M, ddq, J, power, g = [], [], [], [], [], []
    zero = np.zeros(arm.n)
    for k in range(STATES):
        oracle.move(s.q[k], s.dq[k])
        tau.append(oracle.inverse_dynamics(s.ddq[k]))
        M.append(oracle.mass_matrix())
        ddq.append(oracle.forward_dynamics(s.tau[k]))
        J.append(oracle.jacobian())
        bias = oracle.inverse_dynamics(zero)
        oracle.move(s.q[k], zero)
        g.append(oracle.inverse_dynamics(zero))
        power.append(s.dq[k] @ (bias - g[k]))
    p, Ct_dq, gravity = arm.momentum_terms(s.q, s.dq)
    assert_agrees(arm.inverse_dynamics(s.q, s.dq, s.ddq), np.array(tau))
    assert_agrees(arm.mass_matrix(s.q), np.array(M))
    assert_agrees(arm.forward_dynamics(s.q, s.dq, s.tau), np.array(ddq))
    assert_agrees(arm.jacobian(s.q), np.array(J))
    assert_agrees(gravity, np.array(g))
    assert_agrees(arm.gravity_torque(s.q), np.array(g))
    assert_agrees(p, np.einsum("kij,kj->ki", M, s.dq))
    # MuJoCo has no C; what it has says what power C^T dq takes: dq . C^T dq = dq . C dq
    size = np.abs(s.dq * Ct_dq).sum(axis=1)
    assert np.max(np.abs(np.sum(s.dq * Ct_dq, axis=1) - power) / size) < TOLERANCE


@each_arm
def test_against_pinocchio(name):
    arm, oracle, s = robots.load(name), pinocchio_oracle(name), states(name)
    model, data = oracle.model, oracle.data
    tau, M, ddq, J, g, Ct_dq = [], [], [], [], [], []
    for q, dq, a, t in zip(s.q, s.dq, s.ddq, s.tau, strict=True):
        tau.append(pin.rnea(model, data, q, dq, a).copy())
        M.append(oracle.mass_matrix(q))
        ddq.append(pin.aba(model, data, q, dq, t).copy())
        J.append(oracle.jacobian(q))
        g.append(pin.computeGeneralizedGravity(model, data, q).copy())
        Ct_dq.append(pin.computeCoriolisMatrix(model, data, q, dq).T @ dq)
    p, ours_Ct_dq, gravity = arm.momentum_terms(s.q, s.dq)
    assert_agrees(arm.inverse_dynamics(s.q, s.dq, s.ddq), np.array(tau))
    assert_agrees(arm.mass_matrix(s.q), np.array(M))
    assert_agrees(arm.forward_dynamics(s.q, s.dq, s.tau), np.array(ddq))
    assert_agrees(arm.jacobian(s.q), np.array(J))
    assert_agrees(gravity, np.array(g))
    assert_agrees(arm.gravity_torque(s.q), np.array(g))
    assert_agrees(p, np.einsum("kij,kj->ki", M, s.dq))
    assert_agrees(ours_Ct_dq, np.array(Ct_dq))


@each_arm
def test_regressor_against_pinocchio(name):
    arm, oracle, s = robots.load(name), pinocchio_oracle(name), states(name)
    Y = arm.regressor(s.q, s.dq, s.ddq)
    # Pinocchio orders a link's inertia xx xy yy xz yz zz
    order = [10 * j + c for j in range(arm.n) for c in (0, 1, 2, 3, 4, 5, 7, 6, 8, 9)]
    theirs = [
        pin.computeJointTorqueRegressor(oracle.model, oracle.data, *state).copy()
        for state in zip(s.q, s.dq, s.ddq, strict=True)
    ]
    assert_agrees(Y[:, :, order], np.array(theirs))

    parameters = []
    for joint in arm.joints:
        c, m = joint.com, joint.mass
        about_joint = joint.inertia + m * (c @ c * np.eye(3) - np.outer(c, c))
        parameters += [m, *(m * c), *about_joint[np.triu_indices(3)]]
    rotors = np.array([j.rotor_inertia for j in arm.joints])
    assert_agrees(Y @ np.array(parameters) + rotors * s.ddq, arm.inverse_dynamics(s.q, s.dq, s.ddq))


@each_arm
def test_momentum_terms_obey_the_passivity_identity(name):
    """dp/dt = M ddq + C dq + C^T dq, hence C^T dq = d/dt(M) dq - C dq, with the derivative along the motion."""
    arm, s = robots.load(name), states(name)
    h = 3e-3
    # eighth-order central differences, the step where truncation and rounding are both smallest
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    dM_dq = np.zeros_like(s.q)
    for k, w in weights.items():
        ahead = arm.momentum_terms(s.q + k * h * s.dq, s.dq)[0]
        behind = arm.momentum_terms(s.q - k * h * s.dq, s.dq)[0]
        dM_dq += w * (ahead - behind) / h
    _, Ct_dq, gravity = arm.momentum_terms(s.q, s.dq)
    C_dq = arm.inverse_dynamics(s.q, s.dq, np.zeros_like(s.q)) - gravity
    assert_agrees(dM_dq - C_dq, Ct_dq)
