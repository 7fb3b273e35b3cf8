"""What is wrong with a log before it is fitted, and what its motion did not show.

A wrong unit, order or sign of columns leaves torques that no arm of this kinematics can need. The measure is the
torque that links which can exist and friction that only brakes leave unexplained on blocks of rows kept out of the
fit; a supposed mistake is named when undoing it explains much more. A mistake that changes nothing in the torques
(a first joint turned about its vertical axis the other way) cannot be found, and does no harm to the fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from palpate.arm import Arm, Array
from palpate.errors import InputError
from palpate.identify.consistent import consistent, prior_links
from palpate.identify.data import RegressionData
from palpate.identify.regress import LINK_TERMS, RANK, ROUNDING, Base, IndexArray, Problem

ROWS = 300
"""rows looked at, at most"""
BLOCKS = 10
"""stretches of the data; every other one is kept out"""
DOUBTFUL = 0.3
"""a joint whose unexplained torque is a larger part than this of the torque's own variation is looked into"""
EXPLAINED = 0.1
"""a joint with less than this unexplained is in its place: the torque of another joint would not be explained so"""
BETTER = 1.5
"""natural logarithm of the unexplained torque, summed over the joints, by which undoing a mistake must lower it:
recordings that are right stay below 0.8 for every mistake supposed"""
FACTOR = 30.0
"""torques so many times larger or smaller than the arm's masses need are of another unit"""
RELATIVE = 0.1
"""relative standard deviation supposed of each joint's torque"""
MEMORY = 5.0
"""rows per independent one supposed"""
STILL = 0.05
"""a joint that moves by less [rad] is not excited"""
SLOW = 0.01
"""[rad/s] a joint must reach in both directions"""
SWING = 0.5
"""amplitude of the motions proposed [rad]"""


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Some rows of the data, as they are or with a supposed mistake undone."""

    q: Array
    dq: Array
    ddq: Array
    torque: Array


@dataclass(frozen=True, slots=True)
class _Mistake:
    """A supposed mistake: what to say, which joints it is about, how to undo it."""

    text: str
    joints: tuple[int, ...]
    undo: Callable[[_Rows], _Rows]


def check_columns(arm: Arm, data: RegressionData, torque: Array) -> None:
    """Refuse data in another unit, with joints in another order, or with a joint's sign turned.

    Args:
        arm: kinematics; its masses, if it has any, tell the size of torque to expect.
        data: kinematics of the logs.
        torque: (M, n) measured [N m].

    Raises:
        InputError: names the mistake and what to do.
    """
    step = max(1, -(-len(data) // ROWS))
    rows = _Rows(data.q[::step], data.dq[::step], data.ddq[::step], torque[::step])
    if len(rows.q) < 4 * BLOCKS or np.all(np.ptp(rows.q, axis=0) < STILL):
        return
    if not np.any(rows.torque):
        raise InputError("the effort is zero throughout: is it the column of the motor's torque or current?")
    prior = prior_links(arm)
    left = _unexplained(arm, rows, prior)
    doubtful = {j for j in range(arm.n) if not left[j] < DOUBTFUL}
    size = _wrong_size(arm, rows)
    if not doubtful and size is None:
        return
    best, what, gain = left, "", -BETTER
    for mistake in _mistakes(arm):
        if size is None and doubtful.isdisjoint(mistake.joints):
            continue
        after = _unexplained(arm, mistake.undo(rows), prior)
        found = float(np.sum(np.log(after / left)))
        if found < gain:
            best, what, gain = after, mistake.text, found
    for effort_only in (False, True):
        order, after = _better_order(arm, rows, prior, left, effort_only=effort_only)
        found = float(np.sum(np.log(after / left)))
        if found < gain:
            best, what, gain = after, _order_text(arm, order, effort_only=effort_only), found
    if what:
        j = int(np.argmin(best / left))
        raise InputError(
            f"{what}: undone, this leaves {best[j]:.0%} instead of {left[j]:.0%} of the torque of "
            f"{arm.joints[j].name} unexplained"
        )
    if size is not None:
        raise InputError(size)


def _wrong_size(arm: Arm, rows: _Rows) -> str | None:
    """Complaint about torques far from what the arm's masses need."""
    if not arm.has_dynamics:
        return None
    needed = np.sqrt(np.mean(np.square(arm.inverse_dynamics(rows.q, rows.dq, rows.ddq)), axis=0))
    given = np.sqrt(np.mean(np.square(rows.torque), axis=0))
    factor = float(np.linalg.norm(given) / max(float(np.linalg.norm(needed)), 1e-300))
    if 1.0 / FACTOR < factor < FACTOR:
        return None
    heavy = (needed > 0.1 * needed.max()) & (given > 0.0)
    ratios = ", ".join(
        f"{j.name} {b / a:.3g}" for j, a, b, h in zip(arm.joints, given, needed, heavy, strict=True) if h
    )
    if factor > 1.0:
        guess = "the effort may be in mA or mN m: give the column map the unit (effort_unit: mA)"
    else:
        guess = (
            "the effort may be a torque of the motor's side of the gear, or a current without its gain: give "
            "Effort.current(k_t, gear)"
        )
    return (
        f"the torques are {factor:.3g} times what the arm's masses need; {guess}; needed over given: {ratios}"
    )


def _mistakes(arm: Arm) -> Iterator[_Mistake]:
    n = arm.n
    names = arm.joint_names
    revolute = np.array([j.kind == "revolute" for j in arm.joints])
    every = tuple(range(n))

    def scaled(factor: Array) -> Callable[[_Rows], _Rows]:
        return lambda r: _Rows(r.q * factor, r.dq * factor, r.ddq * factor, r.torque)

    if revolute.any():
        degrees = np.where(revolute, math.pi / 180.0, 1.0)
        yield _Mistake(
            "the positions look like degrees: give the column map the unit (position_unit: deg)",
            every,
            scaled(degrees),
        )
    yield _Mistake(
        "the effort has the opposite sign of the arm's on every joint: torque must be positive where the motor "
        "drives the joint in its positive direction (a negative gain turns it)",
        every,
        lambda r: _Rows(r.q, r.dq, r.ddq, -r.torque),
    )
    for j in range(n):
        turn = np.ones(n)
        turn[j] = -1.0
        yield _Mistake(
            f"the effort of {names[j]} has the opposite sign of the arm's (a negative gain turns it)",
            (j,),
            lambda r, f=turn: _Rows(r.q, r.dq, r.ddq, r.torque * f),  # type: ignore[misc]
        )
        yield _Mistake(
            f"the position of {names[j]} has the opposite sign of the arm's: turn its axis or its column",
            (j,),
            scaled(turn),
        )
        yield _Mistake(
            f"position and effort of {names[j]} have the opposite sign of the arm's: turn its axis",
            (j,),
            lambda r, f=turn: _Rows(r.q * f, r.dq * f, r.ddq * f, r.torque * f),  # type: ignore[misc]
        )


def _better_order(
    arm: Arm, rows: _Rows, prior: Array, left: Array, *, effort_only: bool
) -> tuple[IndexArray, Array]:
    """The best order found by exchanging two columns at a time (n,), and what it leaves unexplained (n,)."""

    def ordered(order: IndexArray) -> _Rows:
        if effort_only:
            return _Rows(rows.q, rows.dq, rows.ddq, rows.torque[:, order])
        return _Rows(rows.q[:, order], rows.dq[:, order], rows.ddq[:, order], rows.torque[:, order])

    alphabet = np.argsort(np.argsort(arm.joint_names))
    tried = {tuple(alphabet.tolist()): _unexplained(arm, ordered(alphabet), prior)}
    tried[tuple(range(arm.n))] = left
    best = min(tried, key=lambda o: float(np.sum(np.log(tried[o]))))
    for _ in range(arm.n):
        at = best
        for a, b in combinations(range(arm.n), 2):
            if max(tried[at][a], tried[at][b]) < DOUBTFUL or min(tried[at][a], tried[at][b]) < EXPLAINED:
                continue
            swapped = list(at)
            swapped[a], swapped[b] = swapped[b], swapped[a]
            key = tuple(swapped)
            if key not in tried:
                tried[key] = _unexplained(arm, ordered(np.array(key)), prior)
        best = min(tried, key=lambda o: float(np.sum(np.log(tried[o]))))
        if best == at:
            break
    return np.array(best), tried[best]


def _order_text(arm: Arm, order: IndexArray, *, effort_only: bool) -> str:
    """The log's columns, named by the arm's joints they hold."""
    holds = [arm.joint_names[int(k)] for k in np.argsort(order)]
    what = "the columns of the effort, but not those of the position," if effort_only else "the log's columns"
    return f"{what} look ordered {', '.join(holds)}; the arm's order is {', '.join(arm.joint_names)}"


def _unexplained(arm: Arm, rows: _Rows, prior: Array) -> Array:
    """Residual over variation of the torque on the rows kept out, (n,) [1]; 10 where no fit is found."""
    n = arm.n
    size = np.std(rows.torque, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    speed = np.maximum(np.abs(rows.dq).max(axis=0), 1e-9)
    push = np.maximum(np.abs(rows.ddq).max(axis=0), 1e-9)
    A = np.zeros((len(rows.q), n, 14 * n))
    A[:, :, : 10 * n] = arm.regressor(rows.q, rows.dq, rows.ddq)
    at = np.arange(n)
    A[:, at, 10 * n + at] = rows.ddq
    A[:, at, 11 * n + at] = np.tanh(rows.dq / (0.02 * speed))
    A[:, at, 12 * n + at] = rows.dq
    A[:, at, 13 * n + at] = 1.0
    kept = (np.arange(len(rows.q)) * BLOCKS // len(rows.q)) % 2 == 0
    weight = 1.0 / (RELATIVE * size * math.sqrt(MEMORY))
    weighted = (A[kept] * weight[:, None]).reshape(-1, 14 * n)
    H = weighted.T @ weighted
    g = weighted.T @ (rows.torque[kept] * weight).ravel()
    start = np.r_[np.zeros(10 * n), 0.1 * size / push, 0.2 * size, 0.2 * size / speed, np.zeros(n)]
    try:
        phi = consistent(H, g, prior, np.arange(10 * n, 13 * n), start).phi
    except InputError:  # what no arm could need has no minimum that is reached
        return np.full(n, 10.0)
    error = rows.torque[~kept] - A[~kept] @ phi
    return np.maximum(np.sqrt(np.mean(np.square(error), axis=0)) / size, 1e-3)


# -- what the motion did not show -------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Unseen:
    """What the data did not show.

    Attributes:
        sentences: one for each gap, with the motion that would close it.
        joints: indices of joints whose friction cannot be told: they do not move, or move one way only.
    """

    sentences: tuple[str, ...]
    joints: tuple[int, ...]


def not_shown(arm: Arm, problem: Problem, base: Base) -> Unseen:
    """What the data of a problem did not show, in words."""
    data = problem.data
    sentences, blind = [], []
    for j, joint in enumerate(arm.joints):
        span = float(np.ptp(data.q[:, j]))
        unit = "rad" if joint.kind == "revolute" else "m"
        own = ", ".join(f"{joint.name}.{t}" for t in ("rotor_inertia", *problem.model.terms))
        if span < STILL:
            blind.append(j)
            sentences.append(
                f"{joint.name} moves by {round(span, 4):g} {unit} only, so {own} are not seen; swing it by "
                f"{SWING:g} {unit} and more, both ways"
            )
        elif not (np.any(data.dq[:, j] > SLOW) and np.any(data.dq[:, j] < -SLOW)):
            blind.append(j)
            sentences.append(
                f"{joint.name} never reverses, so {joint.name}.coulomb and {joint.name}.offset cannot be told "
                "apart; record it in both directions"
            )
    lost = [
        p.name
        for k, p in enumerate(problem.parameters)
        if p.kind in problem.model.terms and p.index not in blind and k not in base.index
    ]
    if lost and base.rank < base.structural_rank:
        sentences.append(
            f"{', '.join(lost)} cannot be told from the rest: the speeds of this motion vary too little for the "
            "friction model; record slow and fast motion, or choose a simpler --friction"
        )
    sentences += _missing_links(arm, problem)
    if not sentences and base.rank < base.structural_rank:
        sentences.append(
            f"{base.structural_rank - base.rank} of {base.structural_rank} base parameters are too faint in this "
            "motion; faster and more varied motion would show them"
        )
    return Unseen(tuple(sentences), tuple(blind))


def _missing_links(arm: Arm, problem: Problem) -> list[str]:
    """Sentences on combinations of rigid parameters that torques of this motion do not depend on."""
    n = arm.n
    rng = np.random.default_rng(0)
    count = 40 * n
    random = (rng.uniform(-np.pi, np.pi, (count, n)), *rng.standard_normal((2, count, n)))
    everything = _gram(arm, *random)
    scale = np.sqrt(np.diag(everything))
    felt = scale > ROUNDING * scale.max()
    inverse = np.where(felt, 1.0 / np.where(felt, scale, 1.0), 0.0)
    values, vectors = np.linalg.eigh(everything * np.outer(inverse, inverse))
    basis = vectors[:, values > RANK**2 * values[-1]]
    data = problem.data
    step = max(1, len(data) // 1000)
    seen = _gram(arm, data.q[::step], data.dq[::step], data.ddq[::step])
    values, vectors = np.linalg.eigh(basis.T @ (seen * np.outer(inverse, inverse)) @ basis)
    gone = basis @ vectors[:, values <= RANK**2 * max(values[-1], 1e-300)]
    if not gone.shape[1]:
        return []
    from scipy.linalg import qr

    _, _, pivots = qr(gone.T, mode="economic", pivoting=True)
    lead = sorted(int(k) for k in pivots[: gone.shape[1]])
    names = [
        f"{arm.joints[k // 10].link}.{LINK_TERMS[k % 10]}"
        if k < 10 * n
        else f"{arm.joints[k - 10 * n].name}.rotor_inertia"
        for k in lead
    ]
    listed = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    motion = _motion(arm, data, gone * inverse[:, None])
    what = (
        f"{listed} has"
        if len(names) == 1
        else f"{len(names)} combinations of rigid parameters, led by {listed}, have"
    )
    return [f"{what} no effect in this motion; to see {'it' if len(names) == 1 else 'them'} {motion}"]


def _rigid(arm: Arm, q: Array, dq: Array, ddq: Array) -> Array:
    """Regressor of links and rotors, (N n, 11 n)."""
    n = arm.n
    A = np.zeros((len(q), n, 11 * n))
    A[:, :, : 10 * n] = arm.regressor(q, dq, ddq)
    A[:, np.arange(n), 10 * n + np.arange(n)] = ddq
    return A.reshape(-1, 11 * n)


def _gram(arm: Arm, q: Array, dq: Array, ddq: Array) -> Array:
    A = _rigid(arm, q, dq, ddq)
    return A.T @ A / len(q)


def _motion(arm: Arm, data: RegressionData, gone: Array) -> str:
    """The fewest joints whose swinging shows the directions (11 n, k)."""
    t = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    middle = data.q.mean(axis=0)

    def shown(joints: tuple[int, ...]) -> int:
        q, dq, ddq = (np.zeros((len(t), arm.n)) for _ in range(3))
        for i, j in enumerate(joints):
            w = i + 1.0  # each at its own frequency, so that all pairs of poses occur
            q[:, j], dq[:, j], ddq[:, j] = np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)
        values = np.linalg.svd(
            _rigid(arm, middle + SWING * q, SWING * dq, SWING * ddq) @ gone, compute_uv=False
        )
        # columns are in units of what random motion gives: less than a thousandth of it is not shown
        return int(np.count_nonzero(values > 1e-3 * np.sqrt(len(t))))

    chosen: tuple[int, ...] = ()
    best = 0
    while best < gone.shape[1] and len(chosen) < arm.n:
        rest = [j for j in range(arm.n) if j not in chosen]
        found = [shown((*chosen, j)) for j in rest]
        if max(found) <= best and chosen:
            break
        best = max(found)
        chosen = (*chosen, rest[int(np.argmax(found))])
    names = [arm.joints[j].name for j in sorted(chosen)]
    if len(names) == 1:
        return f"swing {names[0]} by {SWING:g} and more, quickly enough to feel its inertia"
    together = f"{', '.join(names[:-1])} and {names[-1]}"
    return f"swing {together} at the same time, at different frequencies, by {SWING:g} and more"
