"""Can an arm make the strokes of a plan? Inverse kinematics along the way, away from limits and singular poses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array
from ..errors import InputError
from .strokes import Leg, Plan

STEP = 0.03
"""way between two looks [m]"""
CLOSE = (5e-4, 2e-3)
"""a pose is reached within [m] and [rad]"""
SEEDS = 48
"""poses from which the first point is sought"""
ROUNDS = 150
DAMPING = 0.02
"""of the least squares, while far from the goal"""
JUMP = 0.6
"""no joint turns further between two looks [rad]"""
FRICTION = 0.5
"""of felt on a board, at most"""
RESERVE = 0.3
"""part of the bounds that is left for the controller when a leg asks for its largest acceleration"""


@dataclass(frozen=True, slots=True, eq=False)
class Reach:
    """Whether the tool gets everywhere, how, or why not."""

    ok: bool
    reason: str
    """one sentence; empty if ok"""
    q: Array
    """(N, n) joint positions along the way as far as it goes [rad]"""
    points: Array
    """(N, 3) board coordinates of the eraser's centre, z the height above the board [m]"""
    turn: float
    """tool about the board's normal, beside the plan's angle: 0 or pi [rad]"""
    manipulability: float
    """least sqrt(det(J J^T)) on the way (Yoshikawa 1985); NaN if nothing was reached"""


def tool_poses(points: Array, T_base_board: Array, angle: float) -> Array:
    """T_base_tool (N, 4, 4) over board points (N, 3), z the height above the board; the tool's z points into it."""
    c, s = math.cos(angle), math.sin(angle)
    T = np.tile(np.asarray(T_base_board, dtype=np.float64), (len(points), 1, 1))
    T[:, :3, 3] += (points * [1.0, 1.0, -1.0]) @ T[0, :3, :3].T
    T[:, :3, :3] = T[0, :3, :3] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return T


def reachable(
    arm: Arm,
    plan: Plan,
    T_base_board: npt.ArrayLike,
    *,
    q: npt.ArrayLike | None = None,
    margin: float = 0.05,
    manipulability: float = 0.01,
) -> Reach:
    """Follow a plan with the inverse kinematics of an arm.

    Args:
        arm: with the eraser's centre as its grasp point; the tool's x axis along the eraser's width, z into the board.
        plan: of :func:`plan`.
        T_base_board: (4, 4) board coordinates in the arm's base frame (z into the board) [m].
        q: (n,) where the arm is; None: anywhere.
        margin: distance to keep from the joints' limits [rad].
        manipulability: least sqrt(det(J J^T)).

    Raises:
        InputError: something has the wrong shape, or the arm has fewer than 6 joints.
    """
    T = np.asarray(T_base_board, dtype=np.float64)
    if T.shape != (4, 4) or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6):
        raise InputError(f"T_base_board must be a (4, 4) rigid transform, got shape {T.shape}")
    if arm.n < 6:
        raise InputError(f"arm {arm.name!r} has {arm.n} joints: wiping needs at least 6")
    points = _samples(plan)
    if not len(points):
        return Reach(True, "", np.zeros((0, arm.n)), points, 0.0, math.nan)
    lower, upper, seeds = _limits(arm, q, margin)
    best: Reach | None = None
    for turn in (0.0, math.pi):
        poses = tool_poses(points, T, plan.angle + turn)
        first = _solve(arm, np.repeat(poses[:1], len(seeds), 0), seeds, lower, upper)
        good = np.flatnonzero(_near(arm, first, poses[:1]))
        if q is None:  # the most freedom first
            good = good[np.argsort(-_manipulability(arm, first[good]), kind="stable")]
        for k in good[:6]:
            found = _follow(arm, poses, points, first[k], lower, upper, manipulability, turn)
            if found.ok:
                return found
            if best is None or len(found.q) > len(best.q):
                best = found
    if best is None:
        x, y = points[0, :2]
        return Reach(
            False,
            f"no pose of the arm puts the eraser at ({x:.3f}, {y:.3f}) m on the board",
            np.zeros((0, arm.n)),
            points[:0],
            0.0,
            math.nan,
        )
    return best


def paced(
    arm: Arm,
    plan: Plan,
    reach: Reach,
    T_base_board: npt.ArrayLike,
    *,
    max_force: float,
    max_torque: float,
    normal_force: float,
) -> tuple[Leg, ...]:
    """The legs of a plan with no more acceleration than bounded forces can give the arm where it then is.

    What an arm sets against the tool's acceleration in a direction e is Lambda e, Lambda = (J M^-1 J^T)^-1 (Khatib
    1987): force and moment. A reference that asks for more runs away from the tool, which then overshoots.

    Args:
        arm: the arm.
        plan: of :func:`plan`.
        reach: of :func:`reachable` for it, ok.
        T_base_board: (4, 4) [m].
        max_force: bound of the force [N].
        max_torque: bound of the moment [N m].
        normal_force: by which the eraser is pressed on [N].

    Raises:
        InputError: the arm does not reach.
    """
    if not reach.ok:
        raise InputError(f"paced: the arm does not get everywhere: {reach.reason}")
    R = np.asarray(T_base_board, dtype=np.float64)[:3, :3]
    sliding = math.sqrt(max(max_force**2 - normal_force**2, 0.0)) - FRICTION * normal_force
    legs, first = [], 0
    for leg in plan.legs:
        count = _count(leg)
        poses, first = reach.q[first : first + count], first + count
        inertia = tool_inertia(arm, poses)
        way = R @ ((leg.end - leg.start) * [1.0, 1.0, -1.0] / max(leg.length, 1e-9))
        force = np.linalg.norm(inertia[:, :3, :3] @ way, axis=1).max()
        moment = np.linalg.norm(inertia[:, 3:, :3] @ way, axis=1).max()
        # a leg that friction alone would stop is tried all the same, slowly
        free = max(sliding, 0.1 * max_force) if leg.phase == "slide" else max_force
        most = (1.0 - RESERVE) * min(free / max(force, 1e-9), max_torque / max(moment, 1e-9))
        legs.append(replace(leg, acceleration=min(leg.acceleration, float(most))))
    return tuple(legs)


def tool_inertia(arm: Arm, q: npt.ArrayLike) -> Array:
    """Lambda = (J M^-1 J^T)^-1 at the grasp point, (N, 6, 6), base axes, for joint positions (N, n) [rad].

    Force [N] and moment [N m] that its acceleration [m/s^2], [rad/s^2] takes (Khatib 1987).
    """
    J = arm.jacobian(q, arm.grasp)
    return np.linalg.inv(J @ np.linalg.solve(arm.mass_matrix(q), J.swapaxes(1, 2)))


def inverse_kinematics(
    arm: Arm, T_base_tool: npt.ArrayLike, *, q: npt.ArrayLike | None = None, margin: float = 0.05
) -> Array | None:
    """Joint positions (n,) [rad] that bring the grasp point to a pose (4, 4); None: no pose of the arm was found.

    Args:
        arm: the arm.
        T_base_tool: of the grasp point, axes of the tip frame [m].
        q: (n,) to be near to; None: as far from singular poses as can be.
        margin: distance to keep from the joints' limits [rad].

    Raises:
        InputError: something has the wrong shape.
    """
    pose = np.asarray(T_base_tool, dtype=np.float64)
    if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
        raise InputError(f"T_base_tool must be (4, 4) and finite, got shape {pose.shape}")
    lower, upper, seeds = _limits(arm, q, margin)
    found = _solve(arm, np.repeat(pose[None], len(seeds), 0), seeds, lower, upper)
    found = found[_near(arm, found, pose[None])]
    if not len(found):
        return None
    if q is None:
        return found[int(np.argmax(_manipulability(arm, found)))]
    return found[int(np.argmin(np.linalg.norm(found - np.asarray(q, dtype=np.float64), axis=1)))]


def _limits(arm: Arm, q: npt.ArrayLike | None, margin: float) -> tuple[Array, Array, Array]:
    """Limits with a margin, and poses to start from; the one that the arm is in is the first."""
    lower = np.array([j.limits.lower for j in arm.joints]) + margin
    upper = np.array([j.limits.upper for j in arm.joints]) - margin
    low, high = np.clip(lower, -math.pi, math.pi), np.clip(upper, -math.pi, math.pi)
    rng = np.random.default_rng(0)
    seeds = low + rng.random((SEEDS, arm.n)) * (high - low)
    if q is not None:
        here = np.asarray(q, dtype=np.float64)
        if here.shape != (arm.n,) or not np.all(np.isfinite(here)):
            raise InputError(f"q must be ({arm.n},) and finite, got shape {here.shape}")
        seeds = np.concatenate((here[None], seeds))
    return lower, upper, seeds


def _samples(plan: Plan) -> Array:
    """Points (N, 3) along all legs, at most STEP apart."""
    rows = [np.zeros((0, 3))]
    for leg in plan.legs:
        rows.append(np.linspace(leg.start, leg.end, _count(leg)))
    return np.concatenate(rows)


def _count(leg: Leg) -> int:
    """Points along a leg."""
    return max(2, math.ceil(leg.length / STEP) + 1)


def _follow(
    arm: Arm, poses: Array, points: Array, q: Array, lower: Array, upper: Array, least: float, turn: float
) -> Reach:
    way: list[Array] = []
    worst, reason = math.inf, ""
    for pose, (x, y, _) in zip(poses, points, strict=True):
        there = f"at ({x:.3f}, {y:.3f}) m on the board"
        new = _solve(arm, pose[None], q[None], lower, upper)
        if not _near(arm, new, pose[None])[0]:
            at_limit = np.flatnonzero((new[0] <= lower + 1e-6) | (new[0] >= upper - 1e-6))
            names = ", ".join(arm.joint_names[i] for i in at_limit)
            reason = f"{there} the arm reaches no further: " + (
                f"limit of {names}" if names else "it is stretched out"
            )
            break
        if way and float(np.abs(new[0] - q).max()) > JUMP:
            reason = f"{there} the arm would have to turn over"
            break
        w = float(_manipulability(arm, new)[0])
        if w < least:
            reason = (
                f"{there} the arm is nearly singular (manipulability {w:.4f}, at least {least:g} is wanted)"
            )
            break
        worst, q = min(worst, w), new[0]
        way.append(q)
    return Reach(
        not reason,
        reason,
        np.array(way).reshape(-1, arm.n),
        points[: len(way)],
        turn,
        worst if way else math.nan,
    )


def _solve(arm: Arm, poses: Array, q: Array, lower: Array, upper: Array) -> Array:
    """Joint positions (N, n) that bring the grasp point to poses (N, 4, 4), by damped least squares from q (N, n).

    A redundant arm drifts to the middle of its limits where that moves no tool (Liegeois 1977).
    """
    q = np.clip(q, lower, upper)
    bounded = np.isfinite(lower) & np.isfinite(upper)
    middle = np.where(bounded, 0.5 * (np.nan_to_num(lower) + np.nan_to_num(upper)), 0.0)
    for _ in range(ROUNDS):
        error = _error(arm, q, poses)
        if np.all((np.abs(error[:, :3]) < 1e-6) & (np.abs(error[:, 3:]) < 1e-6)):
            break
        J = arm.jacobian(q, arm.grasp)
        Jt = J.swapaxes(1, 2)
        size = np.linalg.norm(error, axis=1)
        damp = (DAMPING * np.minimum(1.0, size)) ** 2 + 1e-9
        inverse = Jt @ np.linalg.inv(J @ Jt + damp[:, None, None] * np.eye(6))
        rest = 0.05 * np.minimum(1.0, size)[:, None] * np.where(bounded, middle - q, 0.0)
        step = np.einsum("nij,nj->ni", inverse, error) + rest - np.einsum("nij,njk,nk->ni", inverse, J, rest)
        step *= np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(1), 1e-12))[:, None]
        q = np.clip(q + step, lower, upper)
    return q


def _error(arm: Arm, q: Array, poses: Array) -> Array:
    """(N, 6) position [m] and rotation vector [rad] from where the tool is to where it should be, base axes."""
    T = arm.forward_kinematics(q)
    at = T[:, :3, :3] @ arm.grasp + T[:, :3, 3]
    R = poses[:, :3, :3] @ T[:, :3, :3].swapaxes(1, 2)
    axis = 0.5 * np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), 1)
    sine = np.linalg.norm(axis, axis=1)
    cosine = 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0)
    angle = np.arctan2(sine, cosine)
    # half a turn has no axis here; any will do, the next step sees further
    axis = np.where(sine[:, None] > 1e-9, axis, [1e-9, 0.0, 0.0])
    turn = axis * (angle / np.maximum(sine, 1e-9))[:, None]
    return np.concatenate((poses[:, :3, 3] - at, turn), axis=1)


def _near(arm: Arm, q: Array, poses: Array) -> Array:
    error = _error(arm, q, np.broadcast_to(poses, (len(q), 4, 4)))
    return (np.linalg.norm(error[:, :3], axis=1) < CLOSE[0]) & (
        np.linalg.norm(error[:, 3:], axis=1) < CLOSE[1]
    )


def _manipulability(arm: Arm, q: Array) -> Array:
    J = arm.jacobian(q, arm.grasp)
    return np.sqrt(np.maximum(np.linalg.det(J @ J.swapaxes(1, 2)), 0.0))
