"""The shortest way through things that each have two ends: which one next, and from which end.

Every thing is entered at one end and left at the other, so the way between the things is a perfect matching of ends. An
integer programme finds the cheapest one (HiGHS, through scipy); where it falls apart into closed rings, each ring is
forbidden and it is solved again (Dantzig, Fulkerson and Johnson 1954).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ..arm import Array
from ..errors import PalpateError

GAP = 1e-3
"""the way found is at most this much longer than the shortest, relative"""
ALL = 30
"""so many things at most are solved with every way from end to end"""
NEIGHBOURS = 8
"""beyond that only ways to so many nearest ends are looked at"""
NODES = 2000
"""branches that HiGHS looks at, at most: a count, not a time, so that every run gives the same"""


def order(ends: Array, start: Array) -> list[tuple[int, bool]]:
    """The order of things with ends (n, 2, 2), from `start` (2,) on: index, and whether it is gone through backwards.

    Raises:
        PalpateError: the solver found no way.
    """
    n = len(ends)
    if n == 0:
        return []
    if n == 1:
        return [(0, bool(np.linalg.norm(ends[0, 1] - start) < np.linalg.norm(ends[0, 0] - start)))]
    # thing n begins at the start; its other end is nowhere, so that the way may end anywhere
    points = np.concatenate((ends.reshape(-1, 2), np.stack((start, np.full(2, np.nan)))))
    a, b = np.triu_indices(2 * n + 2, 1)
    other = a // 2 != b // 2
    a, b = a[other], b[other]
    cost = np.nan_to_num(np.linalg.norm(points[a] - points[b], axis=1))
    rank = np.full((2 * n + 2, 2 * n + 2), np.inf)
    rank[a, b] = rank[b, a] = cost
    rank = rank.argsort(axis=1, kind="stable").argsort(axis=1, kind="stable")
    rank = np.minimum(rank, rank.T)[a, b]
    neighbours = 2 * n if n <= ALL else NEIGHBOURS
    while True:
        likely = (rank < neighbours) | (b == 2 * n + 1)
        way = _solve(n, a[likely], b[likely], cost[likely])
        if way is not None:
            return way
        if neighbours >= 2 * n:
            raise PalpateError(f"no order of {n} strokes was found")
        neighbours *= 2


def _solve(n: int, a: Array, b: Array, cost: Array) -> list[tuple[int, bool]] | None:
    """The cheapest way that uses the links a-b only; None: there is none, or it was not found."""
    columns = np.arange(len(a))
    degree = csr_array(
        (np.ones(2 * len(a)), (np.concatenate((a, b)), np.tile(columns, 2))), shape=(2 * n + 2, len(a))
    )
    rules = [LinearConstraint(degree, 1.0, 1.0)]
    for _ in range(4 * n):
        found = milp(
            cost,
            integrality=np.ones(len(a)),
            bounds=Bounds(0.0, 1.0),
            constraints=rules,
            options={"mip_rel_gap": GAP, "node_limit": NODES},
        )
        if found.x is None:
            return None
        chosen = found.x > 0.5
        links = csr_array((np.ones(chosen.sum()), (a[chosen] // 2, b[chosen] // 2)), shape=(n + 1, n + 1))
        rings, ring = connected_components(links, directed=False)
        if rings == 1:
            return _walk(n, a[chosen], b[chosen])
        for r in range(rings):
            leaves = (ring[a // 2] == r) != (ring[b // 2] == r)
            rules.append(LinearConstraint(csr_array(leaves.astype(float)[None]), 2.0, np.inf))
    return None


def _walk(n: int, a: Array, b: Array) -> list[tuple[int, bool]]:
    partner = dict(zip([*a.tolist(), *b.tolist()], [*b.tolist(), *a.tolist()], strict=True))
    way, end = [], 2 * n
    while (end := partner[end]) // 2 != n:
        way.append((end // 2, bool(end % 2)))
        end ^= 1
    return way
