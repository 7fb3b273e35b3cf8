"""The linear problem tau = A phi and its least-squares solutions (MATH.md section 6).

phi = (per link m, m c, I about the joint frame; rotor inertias; per joint Coulomb, viscous, offset and what else
the friction model has; couplings). Rows of joint j hold its own friction and the links it carries only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from palpate.arm import Arm, Array
from palpate.errors import InputError
from palpate.identify.data import KINEMATIC_RATIO, RegressionData, Segment
from palpate.identify.friction import (
    FrictionModel,
    FrictionShape,
    columns,
    coupling_columns,
    remembered_sign,
)

IndexArray: TypeAlias = npt.NDArray[np.intp]

LINK_TERMS = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
_LINK_UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
_FRICTION_UNITS = {
    "coulomb": "N m",
    "viscous": "N m s/rad",
    "offset": "N m",
    "stribeck": "N m",
    "load": "1",
    "stiffness": "N m/rad",
}
HUBER = 1.345
"""residuals beyond this many standard deviations count linearly: 95 % efficient on normal noise"""
KNOWN_AFTER = 0.03
"""path [rad] after which a joint's remembered friction no longer depends on what was before the log"""
REST = 0.01
"""a joint slower than this part of its fastest speed counts as at rest: friction is anywhere within +-F_c"""
FELT = 1e-3
"""a parameter whose column, over the noise, is shorter than this [1/unit] has no effect: it was rounding"""
RANK = 1e-5
"""singular values of the column-scaled regressor below this part of the largest are not seen"""

ROUNDING = 1e-9
"""a column shorter than this part of the longest holds rounding errors only"""


@dataclass(frozen=True, slots=True)
class Parameter:
    """What one entry of phi is."""

    name: str
    unit: str
    kind: str
    """``link``, ``rotor``, ``coulomb``, ``viscous``, ``offset``, ``stribeck``, ``load`` or ``coupling``"""
    index: int
    """of the joint or link; of the coupling"""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """y = A phi, joint by joint.

    Attributes:
        parameters: p of them.
        blocks: per joint the indices of its parameters (p_j,) and the regressor (M, p_j).
        y: (M, n) torque [N m], or the driver's effort.
        known: (M, n) 1 where the joint's friction state is known, else 0: such rows have no weight.
        rest: (M, n) how much of each row is at rest, 0..1.
        data: what it was made of.
        model, shape: the friction behind the columns.
    """

    parameters: tuple[Parameter, ...]
    blocks: tuple[tuple[IndexArray, Array], ...]
    y: Array
    known: Array
    rest: Array
    data: RegressionData
    model: FrictionModel
    shape: FrictionShape

    def predict(self, phi: Array) -> Array:
        """A phi, (M, n)."""
        return np.column_stack([A @ phi[at] for at, A in self.blocks])

    def index(self, kind: str, joint: int) -> int:
        """Where the parameter of this kind and joint is; -1 if the model has none."""
        for k, p in enumerate(self.parameters):
            if p.kind == kind and p.index == joint:
                return k
        return -1


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """What a solver found.

    Attributes:
        phi: (p,).
        sigma: (n,) robust standard deviation of the residual [as y].
        weights: (M, n) of the squared residuals: 1/sigma^2, less where Huber's rule bounds a row.
        inflation: (n,) rows per independent one, from the residual's autocorrelation [1].
    """

    phi: Array
    sigma: Array
    weights: Array
    inflation: Array


def parameters(arm: Arm, model: FrictionModel, *, links: bool = True) -> tuple[Parameter, ...]:
    """The entries of phi, in order; without the links if the torque at the link side is measured."""
    found = [
        Parameter(f"{j.link}.{term}", unit, "link", i)
        for i, j in enumerate(arm.joints)
        for term, unit in zip(LINK_TERMS, _LINK_UNITS, strict=True)
        if links
    ]
    if model.rotor_inertia:
        found += [
            Parameter(f"{j.name}.rotor_inertia", "kg m^2", "rotor", i) for i, j in enumerate(arm.joints)
        ]
    for i, j in enumerate(arm.joints):
        found += [Parameter(f"{j.name}.{t}", _FRICTION_UNITS[t], t, i) for t in model.terms]
    for c, coupling in enumerate(model.couplings):
        if max(coupling.joints) >= arm.n:
            raise InputError(f"coupling {coupling.joints}: the arm has joints 0 to {arm.n - 1}")
        name = "+".join(arm.joints[j].name for j in coupling.joints)
        for term, unit in (("rotor_inertia", "kg m^2"), ("viscous", "N m s/rad"), ("coulomb", "N m")):
            found.append(Parameter(f"{name}.{term}", unit, "coupling", c))
    if model.springs and model.springs[-1] >= arm.n:
        raise InputError(f"springs {model.springs}: the arm has joints 0 to {arm.n - 1}")
    found += [
        Parameter(f"{arm.joints[j].name}.stiffness", _FRICTION_UNITS["stiffness"], "stiffness", j)
        for j in model.springs
    ]
    return tuple(found)


class Builder:
    """Makes problems of the same data with different friction; what does not change is computed once.

    Args:
        arm: kinematics.
        data: kinematics of the logs.
        y: (M, n) left-hand side.
        transmitted: torque at the link side (N, n) per segment where it is measured: then y is what the drive
            loses, and the problems have no links.
        transmission: (n, n) B, motor speeds = B dq, where motors turn with several joints; y, friction and rotor
            inertia are then the motors', and "joint" below reads "motor".
    """

    def __init__(
        self,
        arm: Arm,
        data: RegressionData,
        y: Array,
        transmitted: tuple[Array, ...] | None = None,
        transmission: Array | None = None,
    ) -> None:
        if data.n != arm.n:
            raise InputError(f"the logs have {data.n} joints, arm {arm.name!r} has {arm.n}")
        self.arm = arm
        self.y = y
        self.links = transmitted is None
        self._signs: dict[tuple[int, tuple[float, ...]], Array] = {}
        raw = [arm.regressor(s.q, s.dq, s.ddq) for s in data.segments] if transmitted is None else []
        if transmission is not None:
            # virtual work: tau_motor = B^-T tau_joint
            raw = [np.einsum("mj,njp->nmp", np.linalg.inv(transmission).T, r) for r in raw]
            data = at_motors(data, transmission)
        self.data = data
        self.raw = {id(s): r for s, r in zip(data.segments, raw, strict=transmitted is None)}
        self.transmitted = {
            id(s): t for s, t in zip(data.segments, transmitted or (), strict=transmitted is not None)
        }
        n = arm.n
        # until a joint has moved, nobody knows what friction it stopped with before the log
        moved = data.reduce(lambda s: (np.cumsum(np.abs(s.dq), axis=0) / s.rate > KNOWN_AFTER).astype(float))
        self.known = (moved > 0.99).astype(np.float64)
        slow = slowest(data)
        self.rest = data.reduce(lambda s: 1.0 - np.square(np.tanh(s.dq / slow))).clip(0.0, 1.0)
        self.rigid: list[Array] = []
        for j in range(n):
            # joint j bears the links from j on; the others' columns are zero
            def part(s: Segment, j: int = j) -> Array:
                if not self.links:
                    return s.ddq[:, j : j + 1]
                return np.column_stack([self.raw[id(s)][:, j, 10 * j :], s.ddq[:, j]])

            self.rigid.append(data.reduce(part))

    def load_torque(self, segment: Segment, phi: Array) -> Array:
        """Torque the gears transmit, measured or by the rigid parameters of phi, (N, n)."""
        if not self.links:
            return self.transmitted[id(segment)]
        return self.raw[id(segment)] @ phi[: 10 * self.arm.n]

    def signs(self, segment: Segment, model: FrictionModel) -> Array:
        """Remembered signs at every distance the model tries, (K, N, n); computed once."""
        key = (id(segment), model.presliding)
        if key not in self._signs:
            reach = np.array(model.presliding)
            self._signs[key] = remembered_sign(segment.dq, 1.0 / segment.rate, reach)
        return self._signs[key]

    def risen(self, segment: Segment, model: FrictionModel, bumps: Array) -> Array:
        """The Stribeck term of every distance and velocity the model tries, (N, n, K, V); computed once."""
        key = (id(segment), (*model.presliding, *model.velocities))
        if key not in self._signs:
            reach, period = np.array(model.presliding), 1.0 / segment.rate
            table = [remembered_sign(segment.dq, period, reach, b) for b in np.moveaxis(bumps, 2, 0)]
            self._signs[key] = np.array(table).transpose(2, 3, 1, 0)
        return self._signs[key]

    def _sign(self, segment: Segment, model: FrictionModel, shape: FrictionShape) -> Array | None:
        """The remembered sign of the shape, (N, n), if its distances are among the model's."""
        if not set(shape.presliding) <= set(model.presliding):
            return None
        pick = [model.presliding.index(x) for x in shape.presliding]
        return self.signs(segment, model)[pick, :, np.arange(len(pick))].T

    def problem(self, model: FrictionModel, shape: FrictionShape, phi: Array | None = None) -> Problem:
        """The problem with this friction; phi gives the load torque where the model wants it."""
        n = self.arm.n
        entries = parameters(self.arm, model, links=self.links)
        width = 10 * n if self.links else 0

        def friction(s: Segment) -> Array:
            known = phi if phi is not None or self.links else np.zeros(0)
            torque = self.load_torque(s, known) if model.load and known is not None else None
            return columns(model, s, shape, torque, self._sign(s, model, shape))

        reduced = self.data.reduce(friction)
        couplings = [
            self.data.reduce(lambda s, c=c: coupling_columns(c, s, shape.presliding[c.joints[0]]))  # type: ignore[misc]
            for c in model.couplings
        ]
        turned = self.data.reduce(lambda s: s.q) if model.springs else self.data.q
        start = width + (n if model.rotor_inertia else 0)
        terms = len(model.terms)
        blocks = []
        for j in range(n):
            at = [*range(10 * j, 10 * n)] if self.links else []
            parts = [self.rigid[j] if model.rotor_inertia else self.rigid[j][:, :-1], reduced[:, j]]
            if model.rotor_inertia:
                at.append(width + j)
            at += range(start + terms * j, start + terms * (j + 1))
            for c, (coupling, part) in enumerate(zip(model.couplings, couplings, strict=True)):
                if j in coupling.joints:
                    at += range(start + terms * n + 3 * c, start + terms * n + 3 * c + 3)
                    parts.append(part)
            if j in model.springs:
                at.append(len(entries) - len(model.springs) + model.springs.index(j))
                parts.append(turned[:, j])
            blocks.append((np.array(at, dtype=np.intp), np.column_stack(parts)))
        return Problem(entries, tuple(blocks), self.y, self.known, self.rest, self.data, model, shape)

    def search_shape(self, problem: Problem, solution: Solution) -> FrictionShape:
        """x_0 and v_s per joint that leave the least (weighted) residual beside the solution's rigid torque."""
        model, data, n = problem.model, self.data, self.arm.n
        reach = np.array(model.presliding)
        parts = np.array(model.velocities if model.stribeck else ())
        speeds = fastest(data)[:, None] * parts  # (n, V)

        def candidates(s: Segment) -> Array:
            z = self.signs(s, model).transpose(1, 2, 0)  # (N, n, K)
            if not len(parts):
                return z[..., None]
            bumps = np.exp(-np.square(s.dq[:, :, None] / speeds))  # (N, n, V)
            risen = self.risen(s, model, bumps) if model.memory else z[..., None] * bumps[:, :, None, :]
            both: Array = np.concatenate([z[..., None], risen], axis=3)
            return both

        table = data.reduce(candidates)  # (M, n, K, 1 + V)
        distances, velocities = [], []
        for j in range(n):
            at, A = problem.blocks[j]
            own = [k for k, i in enumerate(at) if problem.parameters[i].kind in _FRICTION_UNITS]
            kept = [
                k for k in own if problem.parameters[at[k]].kind in ("viscous", "offset", "load", "stiffness")
            ]
            root = np.sqrt(solution.weights[:, j])
            rest = (problem.y[:, j] - A @ solution.phi[at] + A[:, own] @ solution.phi[at[own]]) * root
            fixed = A[:, kept] * root[:, None]
            best = (np.inf, reach[0], np.inf)
            for k, distance in enumerate(reach):
                sign = table[:, j, k, :1] * root[:, None]
                for v in range(max(1, len(parts))):
                    bump = table[:, j, k, v + 1 : v + 2] * root[:, None] if len(parts) else sign[:, :0]
                    X = np.column_stack([fixed, sign, bump])
                    left = rest - X @ np.linalg.lstsq(X, rest, rcond=None)[0]
                    best = min(best, (float(left @ left), distance, speeds[j, v] if len(parts) else np.inf))
            distances.append(float(best[1]))
            velocities.append(float(best[2]))
        return FrictionShape(tuple(distances), tuple(velocities))


def at_motors(data: RegressionData, transmission: Array) -> RegressionData:
    """The data with the motors' positions, speeds and accelerations B q, B dq, B ddq at the link side."""
    B = transmission.T
    segments = tuple(replace(s, q=s.q @ B, dq=s.dq @ B, ddq=s.ddq @ B) for s in data.segments)
    return replace(data, segments=segments, q=data.q @ B, dq=data.dq @ B, ddq=data.ddq @ B)


def check_transmission(transmission: Array | None, n: int) -> Array | None:
    """A read-only (n, n) matrix whose motor k turns with joints from k on or before it, else an error.

    Raises:
        InputError: wrong shape, not finite, not invertible, or the torque of motor k would bear links before k.
    """
    if transmission is None:
        return None
    B = np.array(transmission, dtype=np.float64)
    if B.shape != (n, n) or not np.isfinite(B).all() or abs(np.linalg.det(B)) < 1e-9:
        raise InputError(f"transmission must be an invertible ({n}, {n}) matrix, motor speeds = B dq")
    if np.any(np.abs(np.tril(np.linalg.inv(B).T, -1)) > 1e-12):
        raise InputError(
            "transmission: motor k may turn with joint k and with joints before it only, so B must be lower triangular"
        )
    B.setflags(write=False)
    return B


def fastest(data: RegressionData) -> Array:
    """(n,) largest speed of each joint in the data [rad/s], at least 1e-6."""
    return np.maximum(np.abs(data.dq).max(axis=0), 1e-6)


def slowest(data: RegressionData) -> Array:
    """(n,) speed below which a joint counts as at rest [rad/s].

    A part of its fastest speed, but no less than what one step of the encoder looks like after the kinematic
    low-pass: a peak of twice the cutoff times the step.
    """
    step: Array = 2.0 * KINEMATIC_RATIO * data.cutoff * data.resolution
    return np.maximum(REST * fastest(data), step)


def normal(problem: Problem, weights: Array) -> tuple[Array, Array]:
    """A^T W A (p, p) and A^T W y (p,)."""
    p = len(problem.parameters)
    H, g = np.zeros((p, p)), np.zeros(p)
    for j, (at, A) in enumerate(problem.blocks):
        weighted = A * weights[:, j : j + 1]
        H[np.ix_(at, at)] += weighted.T @ A
        g[at] += weighted.T @ problem.y[:, j]
    return H, g


def minimum_change(H: Array, g: Array, phi0: Array) -> Array:
    """The least-squares solution nearest to phi0 (columns scaled to unit length) where the data say nothing."""
    scale = np.sqrt(np.diag(H))
    felt = scale > FELT
    scale = np.where(felt, scale, np.inf)
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    seen = values > RANK**2 * values[-1]
    along = vectors[:, seen].T @ ((g - H @ phi0) / scale)
    found: Array = phi0 + vectors[:, seen] @ (along / values[seen]) / scale
    return found


def least_squares(
    problem: Problem,
    *,
    method: str = "irls",
    phi0: Array | None = None,
    iterations: int = 8,
) -> Solution:
    """OLS, WLS per joint, or IRLS with Huber's weights on top of WLS.

    Args:
        problem: the equations.
        method: ``ols``, ``wls`` or ``irls``.
        phi0: (p,) where the data say nothing; default 0.
        iterations: rounds of weights.

    Raises:
        InputError: another method.
    """
    if method not in ("ols", "wls", "irls"):
        raise InputError(f"method must be ols, wls or irls, got {method!r}")
    start = np.zeros(len(problem.parameters)) if phi0 is None else np.asarray(phi0, dtype=np.float64)
    rows = problem.data.weight[:, None] * problem.known
    weights = rows
    phi = minimum_change(*normal(problem, weights), start)
    for _ in range(0 if method == "ols" else iterations):
        weights, sigma = _weights(problem, phi, rows, robust=method == "irls")
        before, phi = phi, minimum_change(*normal(problem, weights), start)
        moved = np.abs(problem.predict(phi - before)).max(axis=0)
        if np.all(moved <= 1e-3 * sigma):
            break
    _, sigma = _weights(problem, phi, rows, robust=method == "irls")
    return Solution(
        phi, sigma, weights, inflation(problem, (problem.y - problem.predict(phi)) * np.sqrt(weights))
    )


def _weights(problem: Problem, phi: Array, rows: Array, *, robust: bool) -> tuple[Array, Array]:
    residual = (problem.y - problem.predict(phi)) * np.sqrt(rows)
    seen = (problem.known > 0.0) & (problem.rest < 0.1)
    level = np.array([abs(phi[problem.index("coulomb", j)]) for j in range(problem.y.shape[1])])
    if robust:
        # the median keeps outliers out of the scale
        sizes = np.where(seen, np.abs(residual), np.nan)
        sigma = np.array(
            [1.4826 * np.nanmedian(c) if s.any() else 0.0 for c, s in zip(sizes.T, seen.T, strict=True)]
        )
    else:
        sigma = np.sqrt(np.sum(np.square(residual) * seen, axis=0) / np.maximum(1, seen.sum(axis=0)))
    # the floor serves noise-free synthetic data
    sigma = np.maximum(sigma, 1e-9 * (1e-9 + np.abs(problem.y).max(axis=0)))
    # at rest friction is uniform within +-F_c, as the core's Friction::uncertainty has it
    variance = np.square(sigma) + problem.rest * np.square(problem.model.stiction * level) / 3.0
    weights = rows / variance
    if robust:
        weights = weights / np.maximum(1.0, np.abs(residual) / (HUBER * np.sqrt(variance)))
    return weights, sigma


def inflation(problem: Problem, residual: Array) -> Array:
    """Rows per independent row of each joint: 1 + 2 sum of the autocorrelations until they fall below 0.05."""
    data = problem.data
    n = residual.shape[1]
    most = int(5.0 * data.rate) + 1
    products = np.zeros((most, n))
    pairs = np.zeros(most)
    for number in np.unique(data.log):
        part = residual[data.log == number]
        part = part - part.mean(axis=0)
        for lag in range(min(most, len(part) // 2)):
            products[lag] += np.sum(part[: len(part) - lag] * part[lag:], axis=0)
            pairs[lag] += len(part) - lag
    known = pairs > 0
    correlation = products[known] / pairs[known, None]
    correlation = correlation / np.maximum(correlation[:1], 1e-300)
    found = np.ones(n)
    for j in range(n):
        below = np.flatnonzero(correlation[:, j] < 0.05)
        end = int(below[0]) if len(below) else len(correlation)
        found[j] = 1.0 + 2.0 * float(correlation[1:end, j].sum())
    return found


def damped(problem: Problem, phi0: Array, damping: float, *, weights: Array | None = None) -> Array:
    """phi0 + (A^T W A + lambda^2 I)^-1 A^T W (y - A phi0) (MATH.md section 6).

    Args:
        problem: the equations.
        phi0: (p,) prior.
        damping: lambda, in the units of sqrt(W) A.
        weights: (M, n); default 1.

    Raises:
        InputError: phi0 has the wrong shape, or the damping is not positive.
    """
    p = len(problem.parameters)
    prior = np.asarray(phi0, dtype=np.float64)
    if prior.shape != (p,):
        raise InputError(f"phi0 must have shape ({p},), got {prior.shape}")
    if not (np.isfinite(damping) and damping > 0.0):
        raise InputError(f"damping must be positive, got {damping!r}")
    H, g = normal(problem, np.ones_like(problem.y) if weights is None else weights)
    found: Array = prior + np.linalg.solve(H + damping**2 * np.eye(p), g - H @ prior)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Base parameters: what the data can tell, by pivoted QR of the weighted, column-scaled regressor.

    Attributes:
        names: (r,) the leading parameter of each group.
        index: (r,) where it is in phi.
        value: (r,) in its unit: phi of the leader plus the combination of dependent parameters.
        std: (r,) standard deviation, residual autocorrelation included.
        combination: (r, p) with value = combination phi.
        rank: r.
        structural_rank: what random motion would show.
        conditioning: of the column-scaled base regressor.
    """

    names: tuple[str, ...]
    index: tuple[int, ...]
    value: Array
    std: Array
    combination: Array
    rank: int
    structural_rank: int
    conditioning: float


def base_parameters(problem: Problem, solution: Solution, *, structural_rank: int) -> Base:
    """Group the parameters, and give the solution's groups with their standard deviations."""
    p = len(problem.parameters)
    stacked = np.zeros((problem.y.size, p))
    count = len(problem.y)
    for j, (at, A) in enumerate(problem.blocks):
        stacked[j * count : (j + 1) * count, at] = A * np.sqrt(solution.weights[:, j : j + 1])
    scale = np.linalg.norm(stacked, axis=0)
    scale = np.where(scale > FELT, scale, np.inf)
    from scipy.linalg import qr

    R, pivots = qr(stacked / scale, mode="r", pivoting=True)
    R = R[:p]
    diagonal = np.abs(np.diag(R))
    rank = int(np.count_nonzero(diagonal > RANK * diagonal[0]))
    lead, rest = pivots[:rank], pivots[rank:]
    combination = np.zeros((rank, p))
    combination[np.arange(rank), lead] = 1.0
    tail = np.linalg.solve(R[:rank, :rank], R[:rank, rank:])
    # what is not felt at all belongs to no group
    tail = tail * np.where(np.isfinite(scale[rest]), scale[rest], 0.0) / scale[lead][:, None]
    tail[np.abs(tail) < 1e-9] = 0.0
    combination[:, rest] = tail
    order = np.argsort(lead)
    lead, combination = lead[order], combination[order]
    singular = np.linalg.svd(R[:rank, :rank], compute_uv=False)
    covariance = _sandwich(problem, solution, lead)
    return Base(
        names=tuple(problem.parameters[k].name for k in lead),
        index=tuple(int(k) for k in lead),
        value=combination @ solution.phi,
        std=np.sqrt(np.diag(covariance)),
        combination=combination,
        rank=rank,
        structural_rank=structural_rank,
        conditioning=float(singular[0] / singular[-1]),
    )


def _sandwich(problem: Problem, solution: Solution, lead: IndexArray) -> Array:
    """Covariance of the base parameters that owes nothing to independent rows.

    Scores are summed over blocks longer than the residual's memory; their scatter is the true spread of the
    normal equations' right-hand side. With too few blocks the textbook covariance is widened by the inflation.
    """
    data = problem.data
    H = normal(problem, solution.weights)[0][np.ix_(lead, lead)]
    inverse = np.linalg.pinv(H, rcond=1e-14, hermitian=True)
    residual = problem.y - problem.predict(solution.phi)
    rows = max(int(np.ceil(3.0 * solution.inflation.max())), int(data.rate))
    block = np.concatenate(
        [np.arange(np.count_nonzero(data.log == k)) // rows + 1_000_000 * k for k in np.unique(data.log)]
    )
    names, block = np.unique(block, return_inverse=True)
    place = {int(k): i for i, k in enumerate(lead)}
    scores = np.zeros((len(names), len(lead)))
    widened = np.zeros_like(H)
    for j, (at, A) in enumerate(problem.blocks):
        own = [k for k, i in enumerate(at) if int(i) in place]
        to = [place[int(at[k])] for k in own]
        weighted = A[:, own] * (solution.weights[:, j] * residual[:, j])[:, None]
        part = np.zeros((len(names), len(own)))
        np.add.at(part, block, weighted)
        scores[:, to] += part
        squared = A[:, own] * solution.weights[:, j : j + 1]
        size = np.square(solution.sigma[j]) * solution.inflation[j]
        widened[np.ix_(to, to)] += size * (squared.T @ squared)
    if len(names) > 2 * len(lead):
        widened = scores.T @ scores * (len(names) / (len(names) - len(lead)))
    covariance: Array = inverse @ widened @ inverse
    return covariance


def structural_rank(arm: Arm, model: FrictionModel) -> int:
    """Base parameters that unlimited motion would show: rank over random poses, velocities, accelerations."""
    rng = np.random.default_rng(0)
    count = 40 * arm.n
    q = rng.uniform(-np.pi, np.pi, (count, arm.n))
    dq, ddq = rng.standard_normal((2, count, arm.n))
    p = len(parameters(arm, model))
    A = np.zeros((count, arm.n, p))
    A[:, :, : 10 * arm.n] = arm.regressor(q, dq, ddq)
    if model.rotor_inertia:
        A[:, np.arange(arm.n), 10 * arm.n + np.arange(arm.n)] = ddq
    stacked = A.reshape(-1, p)
    scale = np.linalg.norm(stacked, axis=0)
    # a column of rounding errors is no parameter
    stacked = stacked[:, scale > ROUNDING * scale.max()]
    singular = np.linalg.svd(stacked / np.linalg.norm(stacked, axis=0), compute_uv=False)
    friction = p - 10 * arm.n - (arm.n if model.rotor_inertia else 0)
    return int(np.count_nonzero(singular > RANK * singular[0])) + friction
