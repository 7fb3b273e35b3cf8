"""Drive gains K [N m per unit of effort] from free motion and one known load, jointly with the dynamics.

The effort is what is noisy (current ripple, friction that no model knows), kinematics and the known load are not.
Regressing the load's torque on the effort, K i = ..., therefore shrinks K. Here the effort stays on the left,

    i_j = (A_j phi + Y_j pi_load) / K_j + noise_j,

with the link parameters phi shared by all joints: a joint that hardly feels the load (a vertical first axis) gets
its gain through the links it has in common with joints that do. Of the load the mass is known, the rest of
pi_load may be free. Gauss-Newton on (phi, pi_load, 1/K); every step needs the joints' normal matrices only.

Friction is not the same in two logs: its changes are eliminated from the normal matrices beforehand. Rows count by
the memory of their residual. Neither is a drive's scale the same with the load and without it: that it may differ is
considered in the standard deviations, not estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.arm import Arm, Array, Effort
from palpate.errors import InputError
from palpate.identify._threads import one_thread
from palpate.identify.consistent import link_parameters, prior_links
from palpate.identify.data import prepare
from palpate.identify.fitting import (
    DRIFTING,
    FRICTION_DRIFT,
    GAIN_STD,
    LOAD_FRICTION_STD,
    check_joints,
    check_motion,
    friction_size,
)
from palpate.identify.friction import FrictionModel, FrictionShape
from palpate.identify.load import GYRATION
from palpate.identify.regress import HUBER, Builder, Problem, fastest, inflation, least_squares
from palpate.logs import Log
from palpate.logs.repair import BoolArray

STEPS = 200
REWEIGHTED = 6
"""rounds of robust weights"""


@dataclass(frozen=True, slots=True, eq=False)
class KnownLoad:
    """What is known of the load, in the last link's frame.

    Attributes:
        mass: [kg].
        com: (3,) [m]; None: found along with the gains.
        inertia: (3, 3) about the CoM [kg m^2]; None: found along with the gains.
    """

    mass: float
    com: Array | None = None
    inertia: Array | None = None

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mass) and self.mass > 0.0):
            raise InputError(f"the known load must have a positive mass [kg], got {self.mass!r}")
        if self.inertia is not None and self.com is None:
            raise InputError("a load whose inertia is known needs its centre of mass, too")
        for name, shape in (("com", (3,)), ("inertia", (3, 3))):
            value = getattr(self, name)
            if value is not None:
                array = np.array(value, dtype=np.float64)
                if array.shape != shape or not np.all(np.isfinite(array)):
                    raise InputError(f"the load's {name} must be {shape} finite numbers, got {value!r}")
                array.setflags(write=False)
                object.__setattr__(self, name, array)

    def parameters(self) -> tuple[Array, BoolArray]:
        """pi_load (10,), and which of its entries are known (10,) bool."""
        known = np.zeros(10, dtype=bool)
        known[0] = True
        if self.com is None:
            return np.array([self.mass, *np.zeros(9)]), known
        known[1:4] = True
        inertia = np.zeros((3, 3)) if self.inertia is None else self.inertia
        known[4:] = self.inertia is not None
        return link_parameters(self.mass, self.com, inertia), known


@dataclass(frozen=True, slots=True, eq=False)
class GainFit:
    """What :func:`fit_gains` found.

    Attributes:
        gain: (n,) K [N m per unit of effort]; std: (n,), from as many independent rows as the residual has
            and the doubt whether the drives' scales are the same with the load and without it. A model that is wrong
            alike in all logs is not in it.
        arm: the arm with these gains as its effort.
        load: (10,) the load's parameters in the last link's frame [kg, kg m, kg m^2].
        iterations: Gauss-Newton steps.
        rms: (n,) of the residual [N m].
        weakest: sentence on the gain known worst.
    """

    gain: Array
    std: Array
    arm: Arm
    load: Array
    iterations: int
    rms: Array
    weakest: str


@one_thread
def fit_gains(
    arm: Arm,
    free: Log | Sequence[Log],
    loaded: Log | Sequence[Log],
    load: KnownLoad,
    *,
    friction: str | FrictionModel = "stribeck+load",
    cutoff: float | None = None,
) -> GainFit:
    """Find the gains from free motion and motion with a known load.

    Args:
        arm: kinematics and gravity; its effort is ignored, its inertias only start the search.
        free: logs without load.
        loaded: logs with it, fixed to the last link.
        load: what is known of it.
        friction: as in :func:`palpate.identify.fit`.
        cutoff: parallel low-pass [Hz].

    Raises:
        InputError, LogError: as in :func:`palpate.identify.fit`.
    """
    model = friction if isinstance(friction, FrictionModel) else FrictionModel.named(friction)
    first = (free,) if isinstance(free, Log) else tuple(free)
    second = (loaded,) if isinstance(loaded, Log) else tuple(loaded)
    if not first or not second:
        raise InputError(
            "gains need logs without and logs with the known load: from free motion alone only the ratios of "
            "torques to gains are identifiable"
        )
    check_joints(arm, (*first, *second))
    data = prepare((*first, *second), cutoff=cutoff)
    check_motion(arm, data)
    carries = data.log >= len(first)
    builder = Builder(arm, data, data.effort)
    n = arm.n
    pi, known = load.parameters()
    known_mass = pi * known
    gain = _first_gains(arm, builder)
    middle = model.presliding[len(model.presliding) // 2]
    shape = FrictionShape((middle,) * n, tuple((0.1 * fastest(data)).tolist()))
    plain = replace(model, load=False, stribeck=False)
    state: _State | None = None
    for round_ in range(4):
        current = plain if state is None else model
        problem = _problem(builder, current, shape, state, carries, known_mass, gain)
        state = _solve(arm, problem, carries, known_mass, known, gain, state)
        gain = state.gain
        if round_ < 3:
            scaled = replace(problem, y=problem.y * gain - state.load_torque(problem, carries))
            solution = least_squares(scaled, phi0=state.phi, iterations=3)
            shape = builder.search_shape(replace(scaled, model=model), solution)
    assert state is not None
    std = state.std
    worst = int(np.argmax(std / gain))
    return GainFit(
        gain=gain,
        std=std,
        arm=arm.replace(effort=Effort.current([float(k) for k in gain])),
        load=state.load,
        iterations=state.iterations,
        rms=state.rms,
        weakest=f"{arm.joints[worst].name}: {gain[worst]:.4g} +- {2 * std[worst]:.2g} (95 %)",
    )


def _first_gains(arm: Arm, builder: Builder) -> Array:
    """Rough gains: the start arm's gravity against the effort; only the search starts there."""
    data = builder.data
    found = np.ones(arm.n)
    model = arm.gravity_torque(data.q) if arm.has_dynamics else np.ones_like(data.q)
    for j in range(arm.n):
        x = data.effort[:, j]
        size = float(np.sqrt(np.mean(np.square(x))))
        torque = float(np.sqrt(np.mean(np.square(model[:, j]))))
        found[j] = torque / size if size > 0.0 and torque > 0.0 else 1.0
    # joints that carry no weight get the middle of the others
    weighty = np.sqrt(np.mean(np.square(model), axis=0)) > 0.1 * np.sqrt(np.mean(np.square(model)))
    middle = float(np.median(found[weighty]))
    return np.where(weighty, found, middle)


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    phi: Array
    load: Array
    gain: Array
    std: Array
    rms: Array
    iterations: int
    parameters: tuple[str, ...]

    def load_torque(self, problem: Problem, carries: BoolArray) -> Array:
        """(M, n) [N m]."""
        n = problem.y.shape[1]
        part = np.column_stack([_last_link(problem, j) @ self.load for j in range(n)])
        return part * carries[:, None]


def _last_link(problem: Problem, joint: int) -> Array:
    """Columns of the last link (M, 10) in a joint's rows."""
    n = problem.y.shape[1]
    return problem.blocks[joint][1][:, 10 * (n - 1 - joint) : 10 * (n - joint)]


def _problem(
    builder: Builder,
    model: FrictionModel,
    shape: FrictionShape,
    state: _State | None,
    carries: BoolArray,
    pi: Array,
    gain: Array,
) -> Problem:
    phi = None
    if state is not None:
        n = builder.arm.n
        phi = state.phi
        loads = phi.copy()
        loads[10 * (n - 1) : 10 * n] += state.load
        free = builder.problem(model, shape, phi)
        carrying = builder.problem(model, shape, loads)
        # the friction's load torque differs with the load
        blocks = tuple(
            (at, np.where(carries[:, None], B, A))
            for (at, A), (_, B) in zip(free.blocks, carrying.blocks, strict=True)
        )
        return replace(free, blocks=blocks)
    return builder.problem(model, shape, phi)


def _solve(
    arm: Arm,
    problem: Problem,
    carries: BoolArray,
    pi: Array,
    known: BoolArray,
    gain: Array,
    before: _State | None,
) -> _State:
    n = arm.n
    p = len(problem.parameters)
    full = p + 10
    names = tuple(q.name for q in problem.parameters)
    wide = []
    for j in range(n):
        at, A = problem.blocks[j]
        wide.append((np.r_[at, p : p + 10], np.column_stack([A, _last_link(problem, j) * carries[:, None]])))
    y = problem.y
    phi = np.zeros(full)
    phi[: 10 * n] = prior_links(arm).ravel()
    phi[p:] = pi
    if before is not None:
        place = {name: k for k, name in enumerate(before.parameters)}
        for k, name in enumerate(names):
            if name in place:
                phi[k] = before.phi[place[name]]
        phi[p:] = before.load
    inverse = 1.0 / gain
    free = np.r_[np.arange(p), p + np.flatnonzero(~known)]
    penalty, centre = np.zeros(full), np.zeros(full)
    for k, q in enumerate(problem.parameters):
        if q.kind == "load":
            penalty[k] = 1.0 / LOAD_FRICTION_STD**2
    rows = problem.data.weight[:, None] * problem.known
    weights = rows / np.maximum(np.var(y, axis=0), 1e-12)
    iterations = 0
    covariance = np.zeros((n, n))
    residual = y
    memory = np.ones(n)
    doubt = np.array([j.sensing.torque_gain_std or GAIN_STD for j in arm.joints])
    for _ in range(REWEIGHTED):
        normals = [
            _normal(problem, wide, j, weights[:, j] / memory[j], phi, inverse[j], carries) for j in range(n)
        ]
        H, c = [parts[0] for parts in normals], [parts[1] for parts in normals]
        if not known[4:].any():
            # a load is no point and no dumb-bell: its inertia stays near that of a body of the usual size
            spread = phi[p] * GYRATION**2
            com = phi[p + 1 : p + 4] / phi[p]
            centre[p + 4 :] = link_parameters(phi[p], com, (2.0 / 3.0) * spread * np.eye(3))[4:]
            penalty[p + 4 :] = 1.0 / spread**2
        for _ in range(STEPS):
            iterations += 1
            J = np.zeros((full + n, full + n))
            g = np.zeros(full + n)
            for j, (at, _) in enumerate(wide):
                t = H[j] @ phi[at]
                lam = inverse[j]
                J[np.ix_(at, at)] += lam * lam * H[j]
                J[at, full + j] += lam * t
                J[full + j, at] += lam * t
                J[full + j, full + j] += phi[at] @ t
                g[at] += lam * (c[j] - lam * t)
                g[full + j] += phi[at] @ (c[j] - lam * t)
            J[np.arange(full), np.arange(full)] += penalty
            g[:full] += penalty * (centre - phi)
            use = np.r_[free, np.arange(full, full + n)]
            S = J[np.ix_(use, use)]
            d = np.sqrt(np.maximum(np.diag(S), 1e-300))
            values, vectors = np.linalg.eigh(S / np.outer(d, d))
            seen = values > 1e-10 * values[-1]
            step = (vectors[:, seen] @ ((vectors[:, seen].T @ (g[use] / d)) / values[seen])) / d
            change = step[len(free) :] / inverse
            scale = min(1.0, 0.3 / float(np.abs(change).max() + 1e-300))
            phi[free] += scale * step[: len(free)]
            inverse = inverse + scale * step[len(free) :]
            if float(np.abs(change).max()) < 1e-7:
                break
        inverse_S = ((vectors[:, seen] / values[seen]) @ vectors[:, seen].T) / np.outer(d, d)
        through = np.zeros((full + n, n))
        for j, (at, _) in enumerate(wide):
            scaled = normals[j][2]
            through[at, j], through[full + j, j] = inverse[j] * scaled, phi[at] @ scaled
        shift = inverse_S @ (through[use] * doubt)
        covariance = (inverse_S + shift @ shift.T)[len(free) :, len(free) :]
        predicted = np.column_stack([B @ phi[at] * inverse[j] for j, (at, B) in enumerate(wide)])
        residual = y - predicted
        moving = (problem.known > 0.0) & (problem.rest < 0.1)
        sigma = 1.4826 * np.array(
            [
                np.median(np.abs(r[m])) if m.any() else np.std(r)
                for r, m in zip(residual.T, moving.T, strict=True)
            ]
        )
        sigma = np.maximum(sigma, 1e-9 * (1e-9 + np.abs(y).max(axis=0)))
        level = np.array([abs(phi[problem.index("coulomb", j)]) for j in range(n)]) * inverse
        variance = np.square(sigma) + problem.rest * np.square(level) / 3.0
        weights = rows / variance / np.maximum(1.0, np.abs(residual) / (HUBER * np.sqrt(variance)))
        memory = inflation(problem, residual * np.sqrt(weights))
    gain = 1.0 / inverse
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * np.square(gain)
    rms = np.sqrt(np.mean(np.square(residual), axis=0)) * gain
    return _State(phi[:p].copy(), phi[p:].copy(), gain, std, rms, iterations, names)


def _normal(
    problem: Problem,
    wide: list[tuple[Array, Array]],
    joint: int,
    weights: Array,
    phi: Array,
    inverse: float,
    carries: BoolArray,
) -> tuple[Array, Array, Array]:
    """A joint's normal matrix, right-hand side, and the same for the torque of the loaded logs in the effort's place.

    The changes of its friction from log to log are eliminated.

    With D the columns of those changes, one set per log, and P their prior: W - W D (D^T W D + P)^-1 D^T W in the
    place of W.
    """
    at, B = wide[joint]
    y = problem.y[:, joint]
    columns, precision = [], []
    for k, i in enumerate(at[:-10]):
        if problem.parameters[i].kind not in DRIFTING:
            continue
        size = FRICTION_DRIFT * friction_size(problem, phi, int(i)) * abs(inverse)
        for log in np.unique(problem.data.log):
            columns.append(B[:, k] * (problem.data.log == log))
            precision.append(1.0 / max(size, 1e-9) ** 2)
    D = np.column_stack(columns)
    weighted, changed = B * weights[:, None], D * weights[:, None]
    loaded = (B @ phi[at]) * carries * inverse
    both = np.column_stack([B, y, loaded])
    between = np.linalg.solve(changed.T @ D + np.diag(precision), changed.T @ both)
    cross = weighted.T @ D
    found: Array = weighted.T @ both - cross @ between
    return found[:, :-2], found[:, -2], found[:, -1]
