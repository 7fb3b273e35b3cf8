"""Physically consistent fit: every link a body that can exist, by Newton's method on a convex function.

    f(phi) = 1/2 (phi^T H phi - 2 g^T phi) + gamma sum_i D(P_i || P0_i) + mu sum_k (x_k/x0_k - log x_k)

H, g: normal equations in units of independent residuals. P_i: pseudo-inertia of link i (4x4, linear in the link's
parameters, >= 0 exactly for bodies that can exist). D = tr(P0^-1 P) - log det P + const is the log-det divergence
from the prior: it keeps P_i > 0, so no separate barrier is needed, and is independent of units and frames. The
last sum keeps frictions and rotor inertias x_k positive. f is convex (self-concordant plus quadratic): Newton
steps with a line search reach its only minimum in some tens of p x p solves; no solver package is involved.
P. Wensing, S. Kim, J.-J. Slotine, IEEE RA-L 3(1), 2018; T. Lee, P. Wensing, F. Park, IEEE T-RO 36(4), 2020.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from palpate.arm import Arm, Array
from palpate.errors import InputError

PRIOR = 1.0
"""gamma: a prior of this weight allows a link's mass a standard deviation of 50 % (D = 2 eps^2 for a scale 1+eps)"""
BARRIER = 0.01
"""mu: weight of staying positive; biases a well-seen parameter by a hundredth of its standard deviation"""
SETTLED = 1e-6
"""Newton decrement to stop at: a millionth of the change of f that one standard deviation makes"""
THINNEST = 0.03
"""smallest radius of gyration of a prior [m]: the shape of a link is not known to better"""


def _elements() -> Array:
    """E_k with P = sum_k pi_k E_k, (10, 4, 4); pi as in Arm.regressor."""
    E = np.zeros((10, 4, 4))
    E[0, 3, 3] = 1.0
    for axis in range(3):
        E[1 + axis, axis, 3] = E[1 + axis, 3, axis] = 1.0
    # Sigma = 1/2 tr(I) 1 - I
    for k, (a, b) in enumerate(((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))):
        if a == b:
            E[4 + k, :3, :3] = 0.5 * np.eye(3)
            E[4 + k, a, a] -= 1.0
        else:
            E[4 + k, a, b] = E[4 + k, b, a] = -1.0
    return E


ELEMENTS = _elements()
ELEMENTS.setflags(write=False)


def pseudo_inertia(pi: Array) -> Array:
    """P (4, 4) of a link's parameters (10,)."""
    P: Array = np.tensordot(pi, ELEMENTS, 1)
    return P


def link_parameters(mass: float, com: Array, inertia: Array) -> Array:
    """(10,) m, m c, I about the frame, of mass [kg], CoM [m] and inertia about the CoM [kg m^2]."""
    about = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.array([mass, *(mass * com), *about[0], *about[1, 1:], about[2, 2]])


def body(pi: Array) -> tuple[float, Array, Array]:
    """Mass [kg], CoM (3,) [m], inertia about the CoM (3, 3) [kg m^2] of a link's parameters (10,)."""
    mass = float(pi[0])
    com = pi[1:4] / mass
    xx, xy, xz, yy, yz, zz = pi[4:]
    about = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return mass, com, about - mass * (com @ com * np.eye(3) - np.outer(com, com))


def prior_links(arm: Arm) -> Array:
    """(n, 10) of the arm's links, none thinner than :data:`THINNEST`; 1 kg balls where the arm has no masses."""
    found = []
    for j in arm.joints:
        mass = j.mass if j.mass > 0.0 else 1.0
        inertia = j.inertia if j.mass > 0.0 else np.eye(3) * 0.4 * mass * 0.1**2
        spread = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        values, vectors = np.linalg.eigh(spread)
        spread = vectors @ np.diag(np.maximum(values, mass * THINNEST**2)) @ vectors.T
        found.append(link_parameters(mass, j.com, np.trace(spread) * np.eye(3) - spread))
    return np.array(found)


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentSolution:
    """The minimum.

    Attributes:
        phi: (p,).
        covariance: (p, p) inverse Hessian: data, prior and barrier together.
        iterations: Newton steps taken.
        divergence: (n,) D(P_i || P0_i) of each link [1]: how far the data moved it from the prior.
    """

    phi: Array
    covariance: Array
    iterations: int
    divergence: Array


def consistent(
    H: Array,
    g: Array,
    prior: Array,
    positive: npt.NDArray[np.intp],
    start: Array,
    *,
    gamma: float = PRIOR,
    barrier: float = BARRIER,
    most: int = 200,
) -> ConsistentSolution:
    """Minimise f.

    Args:
        H: (p, p), g: (p,): normal equations in units of independent residuals; links first, 10 each.
        prior: (n, 10) link parameters of the prior.
        positive: indices of parameters that must stay positive.
        start: (p,) first guess of the parameters beyond the links (those of ``positive`` > 0).
        gamma: weight of the prior [1].
        barrier: mu [1].
        most: Newton steps before giving up.

    Raises:
        InputError: the prior is no body, gamma is not positive, or the steps run out.
    """
    if not (np.isfinite(gamma) and gamma > 0.0):
        raise InputError(f"the prior's weight must be positive, got {gamma!r}")
    n = len(prior)
    P0 = np.tensordot(prior, ELEMENTS, 1)
    if np.linalg.eigvalsh(P0).min() <= 0.0:
        raise InputError("a link of the prior is no body: its pseudo-inertia is not positive definite")
    inverse0 = np.linalg.inv(P0)
    pull = np.einsum("nab,kba->nk", inverse0, ELEMENTS)
    x = np.array(start, dtype=np.float64)
    x[: 10 * n] = prior.ravel()
    guess = np.maximum(np.abs(x[positive]), 1e-6)
    x[positive] = guess
    slope = barrier / guess  # where the data say nothing the first guess stays
    ridge = 1e-12 * np.diag(H).max() * np.eye(len(x))

    def value(at: Array) -> float:
        P = np.tensordot(at[: 10 * n].reshape(n, 10), ELEMENTS, 1)
        if np.any(at[positive] <= 0.0):
            return np.inf
        try:
            root = np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            return np.inf
        log_det = 2.0 * np.sum(np.log(np.diagonal(root, axis1=1, axis2=2)))
        divergence = float(np.sum(pull * at[: 10 * n].reshape(n, 10))) - float(log_det)
        keep = float(slope @ at[positive] - barrier * np.sum(np.log(at[positive])))
        return float(0.5 * at @ H @ at - g @ at) + gamma * divergence + keep

    now = value(x)
    hessian = H
    steps = 0
    for _ in range(most):
        steps += 1
        inverse = np.linalg.inv(np.tensordot(x[: 10 * n].reshape(n, 10), ELEMENTS, 1))
        product = np.einsum("nab,kbc->nkac", inverse, ELEMENTS)
        gradient = H @ x - g
        gradient[: 10 * n] += gamma * (pull - np.einsum("nkaa->nk", product)).ravel()
        gradient[positive] += slope - barrier / x[positive]
        hessian = H + ridge
        for i in range(n):
            part = slice(10 * i, 10 * i + 10)
            hessian[part, part] += gamma * np.einsum("kab,lba->kl", product[i], product[i])
        hessian[positive, positive] += barrier / np.square(x[positive])
        d = np.sqrt(np.diag(hessian))
        move = -np.linalg.solve(hessian / np.outer(d, d), gradient / d) / d
        decrement = float(-gradient @ move)
        if decrement < SETTLED:
            break
        length = 1.0
        while length > 1e-12 and not (value(x + length * move) <= now - 1e-4 * length * decrement):
            length *= 0.5
        if length <= 1e-12:  # rounding: no smaller value can be represented
            break
        x = x + length * move
        now = value(x)
    else:
        raise InputError(f"the consistent fit did not settle within {most} steps (decrement {decrement:.3g})")
    d = np.sqrt(np.diag(hessian))
    covariance = np.linalg.inv(hessian / np.outer(d, d)) / np.outer(d, d)
    P = np.tensordot(x[: 10 * n].reshape(n, 10), ELEMENTS, 1)
    divergence = (
        np.einsum("nab,nba->n", inverse0, P) - 4.0 - np.linalg.slogdet(P)[1] + np.linalg.slogdet(P0)[1]
    )
    return ConsistentSolution(x, covariance, steps, divergence)
