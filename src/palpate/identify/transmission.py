"""Motor current to joint torque: what a drive loses between the motor and a joint torque sensor.

    K i = tau + I_a ddq + friction(dq, tau)

per joint, with tau from the sensor while fitting. Afterwards the current alone gives the joint torque.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from palpate.arm import Arm, Array
from palpate.errors import InputError, MissingExtraError
from palpate.identify._threads import one_thread
from palpate.identify.data import RegressionData, prepare
from palpate.identify.fitting import (
    LOAD_FRICTION_STD,
    POSITIVE,
    Estimate,
    Residuals,
    check_effort,
    check_joints,
)
from palpate.identify.friction import FrictionModel, FrictionShape
from palpate.identify.regress import Builder, Problem, Solution, fastest, least_squares
from palpate.logs import Log
from palpate.logs.repair import BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class TransmissionFit:
    """What :func:`fit_transmission` found.

    Attributes:
        parameters: rotor inertia and friction per joint.
        phi: the same as numbers.
        friction, shape: the friction model.
        reverses: (n,) whether the joint moved both ways: else Coulomb friction and offset are not told apart.
        residuals: of the joint torque on the fit's own data [N m].
        cutoff: parallel low-pass [Hz].
        arm: gains and joint names.
        reference: name of the sensor's signal.
    """

    parameters: tuple[Estimate, ...]
    phi: Array
    friction: FrictionModel
    shape: FrictionShape
    reverses: Array
    residuals: Residuals
    cutoff: float
    arm: Arm
    reference: str

    def test(self, log: Log) -> Residuals:
        """Joint torque from the current against the sensor in another log."""
        problem, tau, known = _problem(
            self.arm, (log,), self.reference, self.cutoff, self.friction, self.shape
        )
        seen = known.any(axis=1)
        torque = problem.y + tau - problem.predict(self.phi)
        return Residuals.of(tau[seen], torque[seen], "another log")


@one_thread
def fit_transmission(
    arm: Arm,
    logs: Log | Sequence[Log],
    *,
    reference: str,
    friction: str | FrictionModel = "stribeck+load",
    alike: Sequence[Sequence[int]] = (),
    cutoff: float | None = None,
) -> TransmissionFit:
    """Fit what the drives lose, from logs with the motor's effort and a joint torque sensor.

    Args:
        arm: its effort says what a unit of current is worth at the link side.
        logs: one or several.
        reference: name of the signal (M, n) with the sensor's torque [N m].
        friction: as in :func:`palpate.identify.fit`.
        alike: groups of joints, by index, that have the same drive: they share one rotor inertia. A motor and its
            gear are made alike; their friction is not.
        cutoff: parallel low-pass [Hz].

    Raises:
        InputError, LogError: as in :func:`palpate.identify.fit`; a joint is in two groups or does not exist.
    """
    model = friction if isinstance(friction, FrictionModel) else FrictionModel.named(friction)
    every = (logs,) if isinstance(logs, Log) else tuple(logs)
    n = arm.n
    groups = tuple(tuple(int(j) for j in group) for group in alike)
    members = [j for group in groups for j in group]
    if len(set(members)) < len(members) or not all(0 <= j < n for j in members):
        raise InputError(f"alike must be groups of different joints from 0 to {n - 1}, got {groups}")
    middle = model.presliding[len(model.presliding) // 2]
    data, builder, tau = _builder(arm, every, reference, cutoff)
    shape = FrictionShape((middle,) * n, tuple((0.1 * fastest(data)).tolist()))
    problem = builder.problem(replace(model, stribeck=False), shape)
    solution = least_squares(problem)
    for _ in range(2):
        shape = builder.search_shape(replace(problem, model=model), solution)
        problem = builder.problem(model, shape)
        solution = least_squares(problem)
    known = problem.known > 0.0
    phi, std = _bounded(problem, solution, groups)
    torque = problem.y + tau - problem.predict(phi)
    seen = known.any(axis=1)
    moving = 0.02 * fastest(data)
    return TransmissionFit(
        parameters=tuple(
            Estimate(p.name, float(v), float(s), float("nan"), p.unit)
            for p, v, s in zip(problem.parameters, phi, std, strict=True)
        ),
        phi=phi,
        friction=model,
        shape=shape,
        reverses=(data.dq > moving).any(axis=0)
        & (data.dq < -moving).any(axis=0)
        & (np.ptp(data.q, axis=0) > 0.05),
        residuals=Residuals.of(tau[seen], torque[seen], "the fit's own data"),
        cutoff=data.cutoff,
        arm=arm,
        reference=reference,
    )


def _bounded(problem: Problem, solution: Solution, groups: Sequence[tuple[int, ...]]) -> tuple[Array, Array]:
    """Weighted least squares with rotor inertia and frictions >= 0; values and standard deviations.

    A ridge of 1 % of each column keeps apart what one-way motion cannot (Coulomb friction and offset share the
    blame); where the motion tells them apart it moves them by 1e-4.
    """
    try:
        from scipy.optimize import lsq_linear
    except ImportError:
        raise MissingExtraError("identify", "identification") from None
    count = len(problem.parameters)
    leader = np.arange(count)
    for group in groups if problem.model.rotor_inertia else ():
        leader[[problem.index("rotor", j) for j in group]] = problem.index("rotor", group[0])
    rows, right = [], []
    for j, (at, A) in enumerate(problem.blocks):
        root = np.sqrt(solution.weights[:, j] / solution.inflation[j])
        wide = np.zeros((len(A), count))
        wide[:, leader[at]] = A * root[:, None]
        rows.append(wide)
        right.append(root * problem.y[:, j])
    used = np.unique(leader)
    B = np.vstack(rows)[:, used]
    size = np.linalg.norm(B, axis=0)
    ridge = 0.01 * np.where(size > 0.0, size, 1.0)
    kinds = [problem.parameters[i].kind for i in used]
    for k, kind in enumerate(kinds):
        if kind == "load":
            ridge[k] = max(ridge[k], 1.0 / LOAD_FRICTION_STD)
    scale = np.sqrt(np.square(size) + np.square(ridge))
    stacked = np.vstack([B, np.diag(ridge)]) / scale
    low = [0.0 if kind in POSITIVE else -np.inf for kind in kinds]
    found, std = np.zeros(count), np.zeros(count)
    found[used] = (
        lsq_linear(stacked, np.concatenate([*right, np.zeros(len(used))]), bounds=(low, np.inf)).x / scale
    )
    std[used] = np.sqrt(np.diag(np.linalg.inv(stacked.T @ stacked))) / scale
    return found[leader], std[leader]


def _builder(
    arm: Arm, logs: Sequence[Log], reference: str, cutoff: float | None
) -> tuple[RegressionData, Builder, Array]:
    """Data, equations of the loss, and the sensor's torque (M, n)."""
    check_joints(arm, logs)
    data = prepare(logs, cutoff=cutoff)
    sensor = prepare(logs, cutoff=data.cutoff, effort=reference)
    if len(sensor) != len(data):
        raise InputError(f"signal {reference!r} and the effort do not cover the same time")
    tau = sensor.effort
    y = data.effort * check_effort(arm, data) - tau
    return data, Builder(arm, data, y, tuple(s.effort for s in sensor.segments)), tau


def _problem(
    arm: Arm,
    logs: Sequence[Log],
    reference: str,
    cutoff: float,
    model: FrictionModel,
    shape: FrictionShape,
) -> tuple[Problem, Array, BoolArray]:
    _, builder, tau = _builder(arm, logs, reference, cutoff)
    problem = builder.problem(model, shape)
    return problem, tau, problem.known > 0.0
