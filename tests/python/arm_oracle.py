"""Pinocchio as the judge of arms read from URDF, and a generator of random robots."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from palpate.arm import Arm


class Oracle:
    """Pinocchio's reading of a URDF: everything but the arm's own joints locked at zero, gravity as in the arm."""

    def __init__(self, urdf: str, arm: Arm) -> None:
        full = pin.buildModelFromXML(urdf)
        locked = [i for i in range(1, full.njoints) if full.names[i] not in arm.joint_names]
        self.arm = arm
        self.model = pin.buildReducedModel(full, locked, pin.neutral(full)) if locked else full
        assert list(self.model.names[1:]) == list(arm.joint_names)
        self.data = self.model.createData()
        self.frames = {f.name: i for i, f in enumerate(self.model.frames) if f.type != pin.FrameType.JOINT}
        pin.framesForwardKinematics(self.model, self.data, pin.neutral(self.model))
        self.T_root_base = self.data.oMf[self.frames[arm.base]].homogeneous
        self.model.gravity.linear = self.T_root_base[:3, :3] @ arm.gravity
        self.model.armature = np.array([j.rotor_inertia for j in arm.joints])

    def q(self, q: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration: endless joints are held as cosine and sine there."""
        out = []
        for i, x in enumerate(q, start=1):
            out += [x] if self.model.joints[i].nq == 1 else [np.cos(x), np.sin(x)]
        return np.array(out)

    def T_base_frame(self, q: np.ndarray, frame: str) -> np.ndarray:
        pin.framesForwardKinematics(self.model, self.data, self.q(q))
        return np.linalg.solve(self.T_root_base, self.data.oMf[self.frames[frame]].homogeneous)

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        """Of the tip's origin, in base axes, linear first."""
        J = pin.computeFrameJacobian(
            self.model,
            self.data,
            self.q(q),
            self.frames[self.arm.tip],
            pin.ReferenceFrame.LOCAL_WORLD_ALIGNED,
        )
        J = J.reshape(6, -1)  # one column comes as a vector
        R = self.T_root_base[:3, :3].T
        return np.vstack([R @ J[:3], R @ J[3:]])

    def inverse_dynamics(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
        return pin.rnea(self.model, self.data, self.q(q), dq, ddq)

    def mass_matrix(self, q: np.ndarray) -> np.ndarray:
        M = pin.crba(self.model, self.data, self.q(q))
        return np.triu(M) + np.triu(M, 1).T

    def lumped(self, i: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Mass, centre of mass and inertia about it of link i, in the joint frame."""
        body = self.model.inertias[i + 1]
        return body.mass, body.lever, body.inertia


def local_forward_kinematics(arm: Arm, q: np.ndarray) -> list[np.ndarray]:
    """T_base_link of the base and of every link, written down again from the meaning of the fields."""
    T = np.eye(4)
    out = [T]
    for joint, x in zip(arm.joints, q, strict=True):
        motion = np.eye(4)
        if joint.kind == "prismatic":
            motion[:3, 3] = x * joint.axis
        else:
            motion[:3, :3] = pin.exp3(x * joint.axis)
        T = T @ joint.T_parent_joint @ motion
        out.append(T)
    return out


def random_inertial(rng: np.random.Generator) -> str:
    """<inertial> of a random box, its axes turned."""
    mass = rng.uniform(0.05, 8.0)
    x, y, z = rng.uniform(0.02, 0.4, 3)
    R = pin.rpy.rpyToMatrix(*rng.uniform(-3, 3, 3))
    inertia = R @ np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) @ R.T * mass / 12
    return (
        (
            f'<inertial><origin xyz="{words(rng.uniform(-0.3, 0.3, 3))}" rpy="{words(rng.uniform(-3, 3, 3))}"/>'
            f'<mass value="{mass!r}"/><inertia ixx="{inertia[0, 0]!r}" ixy="{inertia[0, 1]!r}" ixz="{inertia[0, 2]!r}" '
            f'iyy="{inertia[1, 1]!r}" iyz="{inertia[1, 2]!r}" izz="{inertia[2, 2]!r}"/></inertial>'
        )
        .replace("np.float64(", "")
        .replace(")", "")
    )


def words(values: np.ndarray) -> str:
    return " ".join(repr(float(v)) for v in values)


def random_robot(seed: int) -> tuple[str, str, str]:
    """A URDF tree with side branches, fixed and moving, and a chain through it: (text, base, tip)."""
    rng = np.random.default_rng(seed)
    parts = ["<robot name='random'>", f"<link name='l0'>{random_inertial(rng)}</link>"]
    trunk = ["l0"]
    count = 0

    def grow(parent: str, kind: str) -> str:
        nonlocal count
        count += 1
        name = f"l{count}"
        # fixed links may be frames without mass, moving ones must not
        body = random_inertial(rng) if kind != "fixed" or rng.random() < 0.7 else ""
        axis = rng.normal(size=3)
        limit = "<limit lower='-2' upper='2' velocity='3' effort='50'/>"
        parts.append(
            f"<link name='{name}'>{body}</link><joint name='j{count}' type='{kind}'>"
            f"<origin xyz='{words(rng.uniform(-0.5, 0.5, 3))}' rpy='{words(rng.uniform(-3, 3, 3))}'/>"
            f"<parent link='{parent}'/><child link='{name}'/>"
            f"<axis xyz='{words(axis / np.linalg.norm(axis))}'/>{limit}</joint>"
        )
        return name

    kinds = ["revolute", "continuous", "prismatic", "fixed"]
    moving = 0
    while moving < rng.integers(1, 8):
        kind = str(rng.choice(kinds, p=[0.5, 0.1, 0.15, 0.25]))
        moving += kind != "fixed"
        trunk.append(grow(trunk[-1], kind))
        for _ in range(rng.integers(0, 3)):
            side = trunk[-1]
            for _ in range(rng.integers(1, 3)):
                side = grow(side, str(rng.choice(["revolute", "prismatic", "fixed"])))
    return "".join([*parts, "</robot>"]), "l0", trunk[-1]
