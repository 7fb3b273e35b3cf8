"""From logs to an identified arm: a frozen result, no prints, plots or files."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from palpate.arm import Arm, Array, Friction
from palpate.errors import InputError, LogError
from palpate.identify._threads import one_thread
from palpate.identify.checks import check_columns, not_shown
from palpate.identify.consistent import PRIOR, ConsistentSolution, body, consistent, prior_links
from palpate.identify.data import Origin, RegressionData, Segment, prepare
from palpate.identify.friction import (
    Coupling,
    FrictionModel,
    FrictionShape,
    columns,
    coupling_columns,
    remembered_sign,
)
from palpate.identify.regress import (
    Base,
    Builder,
    Problem,
    Solution,
    base_parameters,
    check_transmission,
    damped,
    fastest,
    inflation,
    least_squares,
    normal,
    parameters,
    structural_rank,
)
from palpate.logs import Log
from palpate.logs.noise import LEAST_VELOCITY, beside_rounding
from palpate.logs.repair import BoolArray

Method = Literal["consistent", "damped", "irls", "wls", "ols"]
METHODS: tuple[Method, ...] = ("consistent", "damped", "irls", "wls", "ols")
LOAD_FRICTION_STD = 0.1
"""prior of the load-dependent friction coefficient [1]: gears that lose more of what they carry are rare"""
ROUNDS = 3
"""rounds of friction shape, load torque and least squares; the third changes nothing that shows"""
FRICTION_DRIFT = 0.1
"""standard deviation of friction from log to log, as a part of its value [1], before any was compared (temperature,
wear, grease). Worth one log."""
GAIN_STD = 0.02
"""standard deviation of a drive's torque scale from log to log [1] before any was compared: magnets lose 0.1 to
0.2 % per kelvin, and friction in the gear is not the same under load. Worth one log."""
DRIFTING = ("coulomb", "viscous", "offset")
"""friction that differs from log to log"""
POSITIVE = ("rotor", "coulomb", "viscous", "load", "stiffness")


@dataclass(frozen=True, slots=True)
class Estimate:
    """One identified parameter."""

    name: str
    value: float
    std: float
    """standard deviation, in the unit of the value: data and prior together"""
    prior: float
    """what it was before; NaN where nothing was known"""
    unit: str
    seen: float = math.nan
    """part of what is known of it that the data say, not the prior [1]; NaN where there is no prior"""


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Measured minus predicted torque after the parallel filter, per joint.

    Attributes:
        rms: (n,) [N m].
        relative: (n,) |residual| / |torque| [1].
        overall: RMS over all joints [N m].
        relative_overall: |residual| / |torque| over all joints [1].
        rows: rows per joint.
        what: which data these are.
    """

    rms: Array
    relative: Array
    overall: float
    relative_overall: float
    rows: int
    what: str

    @classmethod
    def of(cls, measured: Array, predicted: Array, what: str) -> Residuals:
        """Figures of (M, n) torques [N m]."""
        error = measured - predicted
        size = np.linalg.norm(measured, axis=0)
        return cls(
            rms=np.sqrt(np.mean(np.square(error), axis=0)),
            relative=np.linalg.norm(error, axis=0) / np.where(size > 0.0, size, np.nan),
            overall=float(np.sqrt(np.mean(np.square(error)))),
            relative_overall=float(np.linalg.norm(error)) / max(float(np.linalg.norm(measured)), 1e-300),
            rows=len(error),
            what=what,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Torques of one log, after the parallel filter.

    Attributes:
        time: (M,) [s] since the log's first sample.
        measured: (M, n) effort times gain [N m].
        predicted: (M, n) [N m], friction included.
        dq: (M, n) [rad/s].
        known: (M, n) False before a joint's first motion, when its friction is anyone's guess.
    """

    time: Array
    measured: Array
    predicted: Array
    dq: Array
    known: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """What :func:`fit` found. Immutable.

    Attributes:
        arm: the identified arm: link inertias, friction, rotor inertias, gains, noise, provenance.
        parameters: table of all parameters with standard deviations.
        base: what the data alone can tell, from weighted least squares, with standard deviations.
        residuals: on the data of the fit.
        held_out: on data the fit has not seen: ``validate_on``, else each log (or each third of the only log)
            predicted from the others.
        friction: the friction model.
        shape: presliding distance and Stribeck velocity of each joint.
        unseen: sentences on what the data did not show.
        blind: indices of joints whose friction the data cannot tell; the arm keeps what it had for them.
        origins: what became of each log.
        phi: (p,) the parameters as numbers; covariance: (p, p).
        sigma: (n,) robust standard deviation of the residual [N m].
        inflation: (n,) regression rows per independent one [1].
        error_std: (n,) standard deviation of the prediction's error on data the fit has not seen, in motion
            [N m]; where nothing was held out, of the fit's own residual.
        error_inflation: (n,) rows per independent one of that error [1].
        scale_std: (n,) standard deviation of the drives' torque scale from log to log [1]: from each log's measured
            against its predicted torque where logs were held out, with 2 % for one log more; else 2 %.
        drift_std: (n,) standard deviation of friction from log to log, as a part of its value [1]: likewise, with
            10 % for one log more; else 10 %.
        seconds: time the fit took, least squares alone and in all [s].
    """

    arm: Arm
    parameters: tuple[Estimate, ...]
    base: Base
    residuals: Residuals
    held_out: Residuals | None
    friction: FrictionModel
    shape: FrictionShape
    unseen: tuple[str, ...]
    blind: tuple[int, ...]
    origins: tuple[Origin, ...]
    phi: Array
    covariance: Array
    sigma: Array
    inflation: Array
    error_std: Array
    error_inflation: Array
    scale_std: Array
    drift_std: Array
    cutoff: float
    method: Method
    seconds: tuple[float, float]
    start: Arm
    """the arm the fit started from"""
    transmission: Array | None = None
    """(n, n) B, motor speeds = B dq; then efforts, friction and rotor inertias are the motors'"""

    def predict(self, log: Log) -> Prediction:
        """Predict a log's torques with the full model (remembered friction sign, couplings).

        Raises:
            InputError, LogError: the log does not fit the arm or holds nothing usable.
        """
        data = prepare(log, cutoff=self.cutoff)
        problem = self._problem(data)
        return Prediction(
            time=data.time,
            measured=problem.y,
            predicted=problem.predict(self.phi),
            dq=data.dq,
            known=problem.known > 0.0,
        )

    def _problem(self, data: RegressionData) -> Problem:
        y = data.effort * self.arm.effort.gain(self.arm.n)
        builder = Builder(self.start, data, y, transmission=self.transmission)
        return builder.problem(self.friction, self.shape, self.phi)

    def torque(self, q: Array, dq: Array, ddq: Array, period: float) -> tuple[Array, Array]:
        """What the motors must give for a motion without anything in the hand, unfiltered and causal.

        Args:
            q, dq, ddq: (N, n) of the joints, rows `period` apart [rad, rad/s, rad/s^2].
            period: [s].

        Returns:
            (N, n) motor torque at the link side, friction included [N m], and (N, n) the remembered sign z of
            friction in [-1, 1]: between the ends, where it turns over, friction is known less well.
        """
        n = self.start.n
        time = np.arange(len(q), dtype=np.float64) * period
        motion = Segment(time, q, dq, ddq, np.zeros_like(q), 1.0 / period, 0)
        B = np.eye(n) if self.transmission is None else self.transmission
        rigid = self.start.regressor(q, dq, ddq) @ self.phi[: 10 * n] @ np.linalg.inv(B)
        motor = replace(motion, dq=dq @ B.T, ddq=ddq @ B.T)
        z = remembered_sign(motor.dq, period, np.array([self.shape.presliding]))[0]
        parts = columns(self.friction, motor, self.shape, rigid, z)
        torque = rigid + np.einsum("njk,jk->nj", parts, self._terms(self.friction.terms))
        if self.friction.rotor_inertia:
            torque += motor.ddq * self._terms(("rotor",))[:, 0]
        for c, coupling in enumerate(self.friction.couplings):
            lost = coupling_columns(coupling, motor, self.shape.presliding[coupling.joints[0]])
            at = [k for k, p in enumerate(self._kinds()) if p == ("coupling", c)]
            torque[:, list(coupling.joints)] += (lost @ self.phi[at])[:, None]
        return torque, z

    def _kinds(self) -> list[tuple[str, int]]:
        return [(p.kind, p.index) for p in parameters(self.start, self.friction)]

    def _terms(self, kinds: Sequence[str]) -> Array:
        """(n, len(kinds)) parameters of these kinds."""
        place = {key: k for k, key in enumerate(self._kinds())}
        return np.array([[self.phi[place[kind, j]] for kind in kinds] for j in range(self.start.n)])

    def summary(self) -> str:
        """Lines for people."""
        n = self.arm.n
        logs = f"{len(self.origins)} log" + ("s" if len(self.origins) > 1 else "")
        lines = [
            f"{self.arm.name}: {n} joints from {logs}, {self.residuals.rows} rows per joint, "
            f"{self.method} fit in {self.seconds[1]:.1f} s",
            f"base parameters: {self.base.rank} of {self.base.structural_rank} seen, "
            f"conditioning {self.base.conditioning:.3g}",
            "",
            f"{'joint':<24}{'residual':>18}{'held out':>18}{'coulomb':>16}{'viscous':>16}",
        ]
        std = np.sqrt(np.diag(self.covariance))
        names = {e.name: k for k, e in enumerate(self.parameters)}
        for j, joint in enumerate(self.arm.joints):
            held = self.held_out
            cells = [f"{self.residuals.rms[j]:.3g} N m {self.residuals.relative[j]:6.1%}"]
            cells.append("-" if held is None else f"{held.rms[j]:.3g} N m {held.relative[j]:6.1%}")
            row = f"{joint.name:<24}" + "".join(f"{c:>18}" for c in cells)
            for term in ("coulomb", "viscous"):
                k = names[f"{joint.name}.{term}"]
                row += f"{f'{self.phi[k]:.3g} ± {2 * std[k]:.2g}':>16}"
            lines.append(row)
        if self.held_out is not None:
            lines.append(
                f"overall {self.residuals.overall:.3g} N m ({self.residuals.relative_overall:.1%}), held out "
                f"{self.held_out.overall:.3g} N m ({self.held_out.relative_overall:.1%}, {self.held_out.what})"
            )
        lines += [f"not seen: {sentence}" for sentence in self.unseen]
        for k, origin in enumerate(self.origins):
            lines += [f"log {k}: {note}" for note in origin.notes]
        return "\n".join(lines)


@one_thread
def fit(
    arm: Arm,
    logs: Log | Sequence[Log],
    *,
    friction: str | FrictionModel = "stribeck+load",
    couplings: Sequence[Coupling] = (),
    method: Method = "consistent",
    cutoff: float | None = None,
    effort: Sequence[str] | str | None = None,
    weights: Sequence[float] | None = None,
    prior: float = PRIOR,
    validate_on: Log | Sequence[Log] | None = None,
    cross_validate: bool = True,
    transmission: Array | None = None,
) -> Fit:
    """Identify an arm's dynamics and friction from logs of free motion.

    Args:
        arm: kinematics, gravity, effort gains; its inertias are the prior.
        logs: free motion, one or several logs of the same arm.
        friction: ``coulomb``, ``stribeck``, ``load``, ``stribeck+load`` or a :class:`FrictionModel`.
        couplings: drives that turn with several joints (with ``friction`` as a name).
        method: ``consistent`` (links that can exist), ``damped`` (pulled to the arm's own figures, by one standard
            deviation of 1 SI unit over the root of ``prior``), or least squares ``irls``, ``wls``, ``ols``: then
            ``phi`` is the solution nearest to the prior; the arm gets the nearest links that can exist.
        cutoff: parallel low-pass [Hz]; default: from the motion, see :func:`palpate.identify.prepare`.
        effort: name of a signal to take instead of the logs' effort [N m], e.g. a joint torque sensor's.
        weights: per log, of its squared residuals.
        prior: weight of the prior [1]; 1 lets a link's mass deviate by 50 % (one standard deviation).
        validate_on: logs to report held-out residuals on.
        cross_validate: without ``validate_on``: hold out each log in turn (one log: each third).
        transmission: (n, n) B, motor speeds = B dq, where a motor turns with several joints (a parallelogram:
            [[1, 0], [1, 1]] for the two). The logs' effort is then the motors', at the link side, and so are the
            friction and the rotor inertias found. B must be lower triangular.

    Raises:
        InputError: arguments do not fit each other or the data say so (units, undeclared effort).
        LogError: the logs hold nothing usable, or no motion.
        MissingExtraError: without the extra ``identify``.
    """
    begin = time.perf_counter()
    model = friction if isinstance(friction, FrictionModel) else FrictionModel.named(friction, couplings)
    if method not in METHODS:
        raise InputError(f"method must be {', '.join(METHODS)}, got {method!r}")
    every = (logs,) if isinstance(logs, Log) else tuple(logs)
    check_joints(arm, every)
    data = prepare(every, cutoff=cutoff, effort=effort, weights=weights)
    gain = np.ones(arm.n) if effort is not None else check_effort(arm, data)
    if transmission is None:  # else a column is a motor's, not a joint's
        check_columns(arm, data, data.effort * gain)
    check_motion(arm, data)
    drives = check_transmission(transmission, arm.n)
    builder = Builder(arm, data, data.effort * gain, transmission=drives)
    data = builder.data
    problem, solution = solve_shape(builder, model, method=_least_squares(method))
    base = base_parameters(problem, solution, structural_rank=structural_rank(arm, model))
    least = time.perf_counter() - begin
    result = _consistent(arm, problem, solution, prior)
    links = result.phi
    phi, covariance, share = _final(arm, problem, solution, result, method, prior)
    predicted = problem.predict(phi)
    seen = (problem.known[:, problem.known.any(axis=0)] > 0.0).all(axis=1)
    residuals = Residuals.of(problem.y[seen], predicted[seen], "the fit's own data")
    took = time.perf_counter() - begin
    held, doubt = None, _doubt(problem, predicted, phi)
    if validate_on is not None:
        others = (validate_on,) if isinstance(validate_on, Log) else tuple(validate_on)
        unseen = _problem_of(arm, others, problem, phi, data.cutoff, effort, gain, drives)
        held, doubt = _held_out(unseen, unseen.predict(phi), "logs the fit has not seen", phi)
    elif cross_validate:
        held, doubt = _held_out(*_cross_validate(builder, problem, method, prior), phi)
    gaps = not_shown(arm, problem, base)
    return Fit(
        arm=_keep(arm, identified(arm, problem, links, data, gain), gaps.joints),
        parameters=_table(arm, problem, phi, covariance, share),
        base=base,
        residuals=residuals,
        held_out=held,
        friction=model,
        shape=problem.shape,
        unseen=gaps.sentences,
        blind=gaps.joints,
        origins=data.origins,
        phi=phi,
        covariance=covariance,
        sigma=solution.sigma,
        inflation=solution.inflation,
        error_std=doubt.error_std,
        error_inflation=doubt.error_inflation,
        scale_std=doubt.scale_std,
        drift_std=doubt.drift_std,
        cutoff=data.cutoff,
        method=method,
        seconds=(least, took),
        start=arm,
        transmission=drives,
    )


# -- checks -----------------------------------------------------------------------------------------------------------


def check_joints(arm: Arm, logs: Sequence[Log]) -> None:
    """Refuse logs of other joints, or of the same in another order.

    Raises:
        InputError: the numbers of joints differ, or the names are the arm's in another order.
    """
    for k, log in enumerate(logs):
        if not isinstance(log, Log):
            continue
        if log.n != arm.n:
            raise InputError(f"log {k} has {log.n} joints, arm {arm.name!r} has {arm.n}; use log.select(...)")
        if log.joint_names != arm.joint_names and set(log.joint_names) == set(arm.joint_names):
            raise InputError(
                f"log {k} has the arm's joints in another order; use log.select({list(arm.joint_names)})"
            )


def check_effort(arm: Arm, data: RegressionData) -> Array:
    """The gains (n,), after a look whether they can be meant.

    Raises:
        InputError: undeclared effort, or a unit that contradicts it.
    """
    if arm.effort.kind == "undeclared":
        raise InputError(
            f"arm {arm.name!r} does not say what its effort is: give Effort.torque() or "
            "Effort.current(k_t, gear); unknown gains are found by palpate.identify.fit_gains, which needs a "
            "log with a known load (from free motion only the ratios of torques to gains are identifiable)"
        )
    unit = data.effort_unit
    if unit == "A" and arm.effort.kind == "torque":
        raise InputError(
            "the logs' effort is a current [A], but the arm declares torque: give Effort.current(k_t, gear)"
        )
    if unit == "N m" and arm.effort.kind in ("current", "phase_currents"):
        raise InputError("the logs' effort is a torque [N m], but the arm declares a current")
    return arm.effort.gain(arm.n)


def check_motion(arm: Arm, data: RegressionData) -> None:
    """Refuse data without motion, and positions in degrees.

    Raises:
        LogError: no joint moves.
        InputError: positions far beyond every joint's range.
    """
    span = np.ptp(data.q, axis=0)
    if np.all(span < 1e-3):
        raise LogError(
            f"no joint of the {len(data.origins)} logs moves by more than 1 mrad: nothing can be identified "
            "at rest; record a motion of every joint in both directions"
        )
    revolute = np.array([j.kind == "revolute" for j in arm.joints])
    limits = np.array([max(abs(j.limits.lower), abs(j.limits.upper)) for j in arm.joints])
    beyond = revolute & (
        np.abs(data.q).max(axis=0) > 3.0 * np.where(np.isfinite(limits), limits, 4 * math.pi)
    )
    if beyond.any():
        worst = int(np.argmax(np.where(beyond, np.abs(data.q).max(axis=0), 0.0)))
        raise InputError(
            f"joint {arm.joints[worst].name} reaches {np.abs(data.q[:, worst]).max():.4g} rad, its limit is "
            f"{limits[worst]:.4g}: are the positions in degrees, or of the motor's side of the gear?"
        )


# -- solving ----------------------------------------------------------------------------------------------------------


def solve_shape(builder: Builder, model: FrictionModel, *, method: str = "irls") -> tuple[Problem, Solution]:
    """Friction shape, load torque and least squares in turn."""
    n = builder.arm.n
    middle = model.presliding[len(model.presliding) // 2]
    speed = 0.1 * fastest(builder.data)
    shape = FrictionShape((middle,) * n, tuple(speed.tolist()))
    # the load torque is not known yet
    problem = builder.problem(replace(model, load=False, stribeck=False), shape)
    solution = least_squares(problem, method=method, phi0=_start(builder.arm, problem))
    phi = solution.phi
    searched = problem
    for _ in range(ROUNDS):
        shape = builder.search_shape(replace(searched, model=model), solution)
        searched = builder.problem(model, shape, phi)
        solution = least_squares(searched, method=method, phi0=_start(builder.arm, searched))
        phi = solution.phi
    return searched, solution


def _start(arm: Arm, problem: Problem) -> Array:
    phi0 = np.zeros(len(problem.parameters))
    phi0[: 10 * arm.n] = prior_links(arm).ravel()
    return phi0


def information(problem: Problem, solution: Solution) -> tuple[Array, Array]:
    """Normal equations in units of independent residuals, with the prior of the load-dependent friction."""
    H, g = normal(problem, solution.weights / solution.inflation)
    for k, p in enumerate(problem.parameters):
        if p.kind == "load":
            H[k, k] += 1.0 / LOAD_FRICTION_STD**2
    return H, g


def _consistent(arm: Arm, problem: Problem, solution: Solution, prior: float) -> ConsistentSolution:
    H, g = information(problem, solution)
    kinds = [p.kind for p in problem.parameters]
    positive = [k for k, p in enumerate(problem.parameters) if p.kind in POSITIVE or p.kind == "coupling"]
    start = np.where(np.isin(kinds, ["load"]), 0.02, np.maximum(np.abs(solution.phi), 1e-3))
    return consistent(H, g, prior_links(arm), np.array(positive), start, gamma=prior)


def _least_squares(method: Method) -> str:
    """What finds weights and friction's shape for a method."""
    return "irls" if method in ("consistent", "damped") else method


def _final(
    arm: Arm,
    problem: Problem,
    solution: Solution,
    result: ConsistentSolution,
    method: Method,
    prior: float,
) -> tuple[Array, Array, Array]:
    """phi (p,), its covariance (p, p), and the part of each parameter's information that is the data's (p,)."""
    H, _ = information(problem, solution)
    covariance = result.covariance
    phi = result.phi if method == "consistent" else solution.phi
    if method == "damped":
        weights = solution.weights / solution.inflation
        phi = damped(problem, _start(arm, problem), math.sqrt(prior), weights=weights)
        covariance = np.asarray(np.linalg.inv(H + prior * np.eye(len(phi))), dtype=np.float64)
    share = np.einsum("ij,ji->i", covariance, H)
    return phi, covariance, share.clip(0.0, 1.0)


def _cross_validate(
    builder: Builder, problem: Problem, method: Method, prior: float
) -> tuple[Problem, Array, str]:
    """Predict each log (or third of the only one) from the others; the friction's shape is kept."""
    data = problem.data
    groups = np.unique(data.log)
    if len(groups) > 1:
        fold, what = data.log, f"each of {len(groups)} logs from the others"
    else:
        fold = np.minimum(3 * np.arange(len(data)) // max(1, len(data)), 2)
        groups, what = np.arange(3), "each third from the others"
    predicted = np.full_like(problem.y, np.nan)
    for k in groups:
        train = replace(problem, known=problem.known * (fold != k)[:, None])
        solution = least_squares(
            train,
            method=_least_squares(method),
            phi0=_start(builder.arm, train),
        )
        phi = solution.phi
        if method in ("consistent", "damped"):
            result = _consistent(builder.arm, train, solution, prior)
            phi = _final(builder.arm, train, solution, result, method, prior)[0]
        predicted[fold == k] = problem.predict(phi)[fold == k]
    return problem, predicted, what


def _problem_of(
    arm: Arm,
    logs: Sequence[Log],
    problem: Problem,
    phi: Array,
    cutoff: float,
    effort: Sequence[str] | str | None,
    gain: Array,
    transmission: Array | None,
) -> Problem:
    name = effort if effort is None or isinstance(effort, str) else effort[0]
    data = prepare(logs, cutoff=cutoff, effort=name)
    builder = Builder(arm, data, data.effort * gain, transmission=transmission)
    return builder.problem(problem.model, problem.shape, phi)


@dataclass(frozen=True, slots=True, eq=False)
class _Doubt:
    """How far a prediction may be off; see the attributes of :class:`Fit`."""

    error_std: Array
    error_inflation: Array
    scale_std: Array
    drift_std: Array


def _held_out(problem: Problem, predicted: Array, what: str, phi: Array) -> tuple[Residuals, _Doubt]:
    # a joint that never moves has no known friction; the others still count
    seen = (problem.known[:, problem.known.any(axis=0)] > 0.0).all(axis=1)
    if not seen.any():
        raise LogError(f"{what}: no joint moves, so friction is unknown throughout")
    return Residuals.of(problem.y[seen], predicted[seen], what), _doubt(problem, predicted, phi, held=True)


def _doubt(problem: Problem, predicted: Array, phi: Array, *, held: bool = False) -> _Doubt:
    """From the error in motion; scale and friction are compared where several logs were held out."""
    error = problem.y - predicted
    moving = problem.known * (problem.rest < 0.1)
    rows = np.maximum(1.0, moving.sum(axis=0))
    std = np.sqrt(np.sum(np.square(error) * moving, axis=0) / rows)
    memory = inflation(problem, error * moving)
    n = problem.y.shape[1]
    scale, drift = np.full(n, GAIN_STD**2), np.full(n, FRICTION_DRIFT**2)
    logs = np.unique(problem.data.log)
    compared = len(logs) if held and len(logs) > 1 else 0  # parts of one log share its temperature
    for log in logs[:compared]:
        for j in range(n):
            weight = moving[:, j] * (problem.data.log == log)
            size = float(weight @ np.square(predicted[:, j]))
            off = float(weight @ (predicted[:, j] * error[:, j])) / size if size > 0.0 else GAIN_STD
            scale[j] += off**2
            drift[j] += _change(problem, j, phi, error[:, j], weight / max(std[j] ** 2 * memory[j], 1e-300))
    return _Doubt(std, memory, np.sqrt(scale / (1 + compared)), np.sqrt(drift / (1 + compared)))


def _change(problem: Problem, joint: int, phi: Array, error: Array, weight: Array) -> float:
    """Mean square of a joint's change of friction in some rows, as a part of its value: estimate and its variance."""
    at, A = problem.blocks[joint]
    own = [k for k, i in enumerate(at) if problem.parameters[i].kind in DRIFTING]
    X = A[:, own] * [friction_size(problem, phi, int(at[k])) for k in own]
    inverse = np.linalg.inv((X * weight[:, None]).T @ X + np.eye(len(own)) / FRICTION_DRIFT**2)
    found = inverse @ (X.T @ (weight * error))
    return float(np.mean(np.square(found) + np.diag(inverse)))


def friction_size(problem: Problem, phi: Array, index: int) -> float:
    """What the changes of a friction parameter are measured by: its value, an offset's by the Coulomb friction."""
    p = problem.parameters[index]
    return float(abs(phi[problem.index("coulomb", p.index) if p.kind == "offset" else index]))


# -- results ----------------------------------------------------------------------------------------------------------


def _table(arm: Arm, problem: Problem, phi: Array, covariance: Array, share: Array) -> tuple[Estimate, ...]:
    prior = np.full(len(phi), np.nan)
    if arm.has_dynamics:
        prior[: 10 * arm.n] = prior_links(arm).ravel()
    std = np.sqrt(np.diag(covariance))
    return tuple(
        Estimate(p.name, float(v), float(s), float(b), p.unit, float(part))
        for p, v, s, b, part in zip(problem.parameters, phi, std, prior, share, strict=True)
    )


def _keep(arm: Arm, found: Arm, blind: Sequence[int]) -> Arm:
    """The arm found, with the friction and rotor of joints the data say nothing of as they were."""
    joints = [
        j.replace(friction=arm.joints[i].friction, rotor_inertia=arm.joints[i].rotor_inertia)
        if i in blind
        else j
        for i, j in enumerate(found.joints)
    ]
    return found.replace(joints=tuple(joints))


def identified(arm: Arm, problem: Problem, phi: Array, data: RegressionData, gain: Array) -> Arm:
    """The arm with the links, friction, rotor inertias and noise found."""
    joints = []
    for i, joint in enumerate(arm.joints):
        mass, com, inertia = body(phi[10 * i : 10 * i + 10])

        def value(kind: str, i: int = i) -> float:
            k = problem.index(kind, i)
            return float(phi[k]) if k >= 0 else 0.0

        coulomb = max(0.0, value("coulomb"))
        static: float | None = None
        velocity: float | None = None
        if problem.model.stribeck:
            static = max(0.0, coulomb + value("stribeck"))
            velocity = problem.shape.stribeck_velocity[i]
        # which speeds count as motion, as narrow as the filter allows; the sign itself is remembered
        sign = float(np.clip(problem.shape.presliding[i] * data.cutoff, 1e-3, 1e-2))
        joints.append(
            joint.replace(
                mass=mass,
                com=com,
                inertia=0.5 * (inertia + inertia.T),
                rotor_inertia=max(0.0, value("rotor"))
                if problem.model.rotor_inertia
                else joint.rotor_inertia,
                friction=Friction(
                    coulomb=coulomb,
                    viscous=max(0.0, value("viscous")),
                    offset=value("offset"),
                    static=static,
                    stribeck_velocity=velocity,
                    load=max(0.0, value("load")),
                    sign_velocity=sign,
                    presliding=problem.shape.presliding[i],
                ),
                sensing=replace(
                    joint.sensing,
                    position_resolution=float(data.resolution[i]),
                    position_std=beside_rounding(float(data.position_noise[i]), float(data.resolution[i])),
                    velocity_std=joint.sensing.velocity_std
                    if data.velocity_noise is None
                    else max(float(data.velocity_noise[i]), LEAST_VELOCITY),
                    torque_std=float(abs(gain[i]) * data.noise[i]),
                ),
            )
        )
    rows = sum(o.used for o in data.origins)
    provenance = dict(arm.provenance) | {
        "identified": f"{len(data.origins)} logs, {rows} samples, {data.cutoff:g} Hz",
        "friction": "+".join(problem.model.terms) + ", sign remembered over a presliding distance",
    }
    if problem.model.springs:
        stiffness = ", ".join(
            f"{arm.joints[j].name} {phi[problem.index('stiffness', j)]:.3g}" for j in problem.model.springs
        )
        provenance["springs"] = f"fitted and left out here, N m/rad: {stiffness}"
    return arm.replace(joints=tuple(joints), provenance=provenance)
