"""What an identified arm carries: mass, CoM and inertia from the torque the free model does not explain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from palpate.arm import Array
from palpate.errors import InputError, LogError
from palpate.identify._threads import one_thread
from palpate.identify.consistent import link_parameters
from palpate.identify.data import prepare
from palpate.identify.fitting import DRIFTING, Fit, check_joints, friction_size
from palpate.identify.regress import HUBER, Builder, IndexArray, Problem
from palpate.logs import Log

GYRATION = 0.1
"""radius of gyration of a load [m] that its inertia is expected to stay near"""
MASS_RANGE, MOMENT_RANGE = 50.0, 25.0
"""standard deviations of a load's mass [kg] and first moment [kg m] before anything is measured: no information"""
ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class LoadEstimate:
    """What :func:`estimate_load` found, in the last link's frame.

    Attributes:
        mass: [kg]; mass_std: standard deviation [kg].
        interval: 95 % interval of the mass [kg].
        first_moment: (3,) m c [kg m].
        com: (3,) [m]; NaN where the mass is not distinguishable from zero.
        parameters: (10,) m, m c, I about the frame [kg, kg m, kg m^2]; covariance: (10, 10).
        residual: (n,) RMS of what neither arm nor load explains [N m].
        rows: regression rows per joint.
    """

    mass: float
    mass_std: float
    interval: tuple[float, float]
    first_moment: Array
    com: Array
    parameters: Array
    covariance: Array
    residual: Array
    rows: int


@one_thread
def estimate_load(fit: Fit, log: Log, *, parameters: int = 10, drift: float | None = None) -> LoadEstimate:
    """Weigh what the arm carries in a log.

    The torque the free model leaves is fitted by the load's parameters, robustly, and by changes of friction of
    the size it had between the free logs. The inertia is expected near that of a body of 0.1 m radius of gyration.
    The error of the free model enters with the size and the memory it had on data held out, and the drives' scale
    with the doubt the arm states, or else with what it differed by between the free logs (see
    :attr:`Fit.scale_std`): that, and not the number of rows, makes the interval.

    Args:
        fit: from free motion.
        log: motion with a load fixed to the last link, or without one (then the mass is about 0).
        parameters: 10; 4: mass and first moment, the inertia being a point's; 1: mass at the grasp point.
        drift: by which part friction may have changed, one standard deviation [1]; None: :attr:`Fit.drift_std`.

    Raises:
        InputError: another number of parameters; a log of another arm.
        LogError: no usable motion.
    """
    if parameters not in (10, 4, 1):
        raise InputError(f"a load has 10, 4 or 1 parameters, got {parameters!r}")
    if drift is not None and not (np.isfinite(drift) and drift >= 0.0):
        raise InputError(f"drift must be >= 0, got {drift!r}")
    arm = fit.arm
    check_joints(arm, (log,))
    data = prepare(log, cutoff=fit.cutoff)
    builder = Builder(fit.start, data, data.effort * arm.effort.gain(arm.n))
    return LoadProblem(fit, builder).solve(slice(None), parameters, drift)


class LoadProblem:
    """The equations of one log; windows of it are solved without preparing it again."""

    def __init__(self, fit: Fit, builder: Builder) -> None:
        self.fit = fit
        self.builder = builder
        self.problem = self._with(np.zeros(10))

    def _with(self, load: Array) -> Problem:
        """The free model's equations; the friction's load torque includes the load."""
        phi = self.fit.phi.copy()
        n = self.builder.arm.n
        phi[10 * (n - 1) : 10 * n] += load
        return self.builder.problem(self.fit.friction, self.fit.shape, phi)

    def solve(
        self, rows: slice | IndexArray, parameters: int = 10, drift: float | None = None
    ) -> LoadEstimate:
        """See :func:`estimate_load`; ``rows`` picks a window of the regression rows.

        Raises:
            LogError: no usable row in the window.
        """
        fit, problem = self.fit, self.problem
        used = self.problem.known[rows]
        if not used.any():
            raise LogError("no joint moves before or in this stretch: its friction is unknown")
        drifts = fit.drift_std if drift is None else np.full(self.builder.arm.n, drift)
        estimate, covariance = np.zeros(10), np.diag([MASS_RANGE**2, *[MOMENT_RANGE**2] * 3, *[1.0] * 6])
        residual = problem.y[rows]
        for round_ in range(ROUNDS):
            if fit.friction.load and round_ in (1, 3):
                problem = self._with(estimate)
            estimate, covariance, residual = self._step(problem, rows, estimate, residual, parameters, drifts)
        mass, std = float(estimate[0]), float(np.sqrt(covariance[0, 0]))
        first = estimate[1:4].copy()
        return LoadEstimate(
            mass=mass,
            mass_std=std,
            interval=(mass - 1.96 * std, mass + 1.96 * std),
            first_moment=first,
            com=first / mass if abs(mass) > 2.0 * std else np.full(3, np.nan),
            parameters=estimate,
            covariance=covariance,
            residual=np.sqrt(np.mean(np.square(residual), axis=0)),
            rows=int(used.shape[0]),
        )

    def _step(
        self,
        problem: Problem,
        rows: slice | IndexArray,
        before: Array,
        last: Array,
        parameters: int,
        drift: Array,
    ) -> tuple[Array, Array, Array]:
        """One robust Gauss step: estimate (10,), covariance (10, 10), residual (M, n)."""
        fit = self.fit
        n = self.builder.arm.n
        terms = [(k, p) for k, p in enumerate(problem.parameters) if p.kind in DRIFTING]
        place = {k: 10 + i for i, (k, _) in enumerate(terms)}
        size = 10 + len(terms)
        scaled = np.zeros((size, n))
        H, g = np.zeros((size, size)), np.zeros(size)
        left = problem.y[rows] - problem.predict(fit.phi)[rows]
        wide = []
        for j in range(n):
            at, A = problem.blocks[j]
            A = A[rows]
            own = [i for i, k in enumerate(at) if int(k) in place]
            Y = A[:, 10 * (n - 1 - j) : 10 * (n - j)]
            B = np.column_stack([Y, A[:, own]])
            to = np.r_[np.arange(10), [place[int(at[i])] for i in own]]
            level = abs(fit.phi[problem.index("coulomb", j)])
            variance = fit.error_std[j] ** 2 + problem.rest[rows, j] * level**2 / 3.0
            weight = problem.known[rows, j] / variance
            # the first round has no residual of its own yet
            if np.any(before):
                weight = weight / np.maximum(1.0, np.abs(last[:, j]) / (HUBER * np.sqrt(variance)))
            weight = weight / fit.error_inflation[j]
            H[np.ix_(to, to)] += (B * weight[:, None]).T @ B
            g[to] += (B * weight[:, None]).T @ left[:, j]
            scaled[to, j] = (B * weight[:, None]).T @ (Y @ before)
            wide.append((to, B))
        centre, precision = self._prior(before, parameters)
        for k, p in terms:
            precision[place[k]] = 1.0 / max(drift[p.index] * friction_size(problem, fit.phi, k), 1e-6) ** 2
        H[np.arange(size), np.arange(size)] += precision
        g += precision * centre
        d = np.sqrt(np.diag(H))
        inverse = np.linalg.inv(H / np.outer(d, d)) / np.outer(d, d)
        x = inverse @ g
        if parameters == 1:
            # the rest follows the mass exactly
            x[:10] = x[0] * self._unit_point()
        # the drives' scales are considered, not estimated: a window cannot tell them from the load
        stated = np.array([j.sensing.torque_gain_std for j in self.builder.arm.joints])
        doubt = np.where(stated > 0.0, stated, fit.scale_std)
        through = (inverse @ scaled) * doubt
        inverse = inverse + through @ through.T
        residual = left - np.column_stack([B @ x[to] for to, B in wide])
        return x[:10], inverse[:10, :10], residual

    def _unit_point(self) -> Array:
        arm = self.builder.arm
        grasp = arm.T_last_tip[:3, :3] @ arm.grasp + arm.T_last_tip[:3, 3]
        return link_parameters(1.0, grasp, np.zeros((3, 3)))

    def _prior(self, before: Array, parameters: int) -> tuple[Array, Array]:
        """Where the load's parameters are expected, and how firmly: (p,), (p,) 1/variance."""
        drifting = sum(p.kind in DRIFTING for p in self.problem.parameters)
        size = 10 + drifting
        centre, precision = np.zeros(size), np.zeros(size)
        mass = float(before[0])
        com = before[1:4] / mass if abs(mass) > 1e-3 else np.zeros(3)
        com = np.clip(com, -1.0, 1.0)
        spread = max(abs(mass), 0.1) * GYRATION**2
        if parameters == 1:
            centre[:10] = mass * self._unit_point()
            precision[:10] = 1e12
            precision[0] = 1.0 / MASS_RANGE**2
            return centre, precision
        shape = np.zeros((3, 3)) if parameters == 4 else (2.0 / 3.0) * mass * GYRATION**2 * np.eye(3)
        centre[4:10] = link_parameters(mass, com, shape)[4:]
        precision[0] = 1.0 / MASS_RANGE**2
        precision[1:4] = 1.0 / MOMENT_RANGE**2
        precision[4:10] = 1e12 if parameters == 4 else 1.0 / spread**2
        return centre, precision
