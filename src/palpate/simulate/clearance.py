"""How far an arm is from touching itself or the floor, by MuJoCo's collision detection."""

from __future__ import annotations

import numpy as np

from ..arm import Arm, Array
from ..errors import InputError
from . import _model

ALWAYS = 0.5
"""links that touch in more than this part of random poses touch by the way they are drawn, not by the pose"""
POSES = 200
THIN = 0.5
"""part of the drawn thickness taken for links of unknown shape"""


class Clearance:
    """Distances between the links of an arm, as they are drawn, and from the floor.

    Links that follow each other are left out, as are pairs that touch in most poses. Links described by
    meshes alone, which palpate does not open, are taken as the capsules they are drawn as.

    Args:
        arm: the arm.
        floor: height of the floor in the base frame, against gravity [m]; None: no floor.
        reach: larger distances are not told apart [m].

    Raises:
        ArmError: the arm has no masses.
        MissingExtraError: mujoco is not installed.
    """

    def __init__(self, arm: Arm, *, floor: float | None = None, reach: float = 0.1) -> None:
        mj = self._mj = _model.mujoco()
        if not reach > 0.0:
            raise InputError(f"reach must be above 0 m, got {reach!r}")
        built = _model.build(arm, limits=False, contacts=True, scene=None)
        self._model, self._n, self._reach = built.model, arm.n, float(reach)
        model = self._model
        link = {body: k - 1 for k, body in enumerate(built.links)}
        self._link = np.full(model.ngeom, -2)
        for g in range(model.ngeom):
            self._link[g] = link.get(int(model.geom_bodyid[g]), -2)
        own = self._link >= -1
        plane = np.array([int(t) == int(mj.mjtGeom.mjGEOM_PLANE) for t in model.geom_type])
        model.geom_contype[:] = own
        model.geom_conaffinity[:] = own
        model.geom_margin[:] = 0.5 * self._reach
        # the tree of boxes inside bodies was built for what collided when the model was compiled
        model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_MIDPHASE)
        # nobody said how thick these are
        known = {s.link for s in arm.shapes if s.kind != "mesh"}
        stand_in = own & ~np.isin(self._link, list(known))
        model.geom_size[stand_in, 0] *= THIN
        if floor is not None:
            model.geom_contype[plane], model.geom_conaffinity[plane] = 2, 0
            model.geom_conaffinity[own & (self._link > 0)] |= 2
            model.geom_pos[plane, 2] = floor
            model.geom_sameframe[plane] = 0  # else a plane compiled at the origin stays there
            model.geom_margin[plane] = 0.5 * self._reach
        for body in range(model.nbody):  # what MuJoCo asks before it looks at a body's shapes
            mine = model.geom_bodyid == body
            model.body_contype[body] = np.bitwise_or.reduce(model.geom_contype[mine], initial=0)
            model.body_conaffinity[body] = np.bitwise_or.reduce(model.geom_conaffinity[mine], initial=0)
            model.body_margin[body] = 0.5 * self._reach
        self._names = (arm.base, *(j.link for j in arm.joints))
        self._data = mj.MjData(model)
        self._ignored: frozenset[tuple[int, int]] = frozenset()
        self._ignored = self._drawn_together(arm)

    @property
    def ignored(self) -> tuple[tuple[str, str], ...]:
        """Pairs of links that touch in most poses and are therefore not looked at."""
        return tuple((self._names[a + 1], self._names[b + 1]) for a, b in sorted(self._ignored))

    def __call__(self, q: Array) -> Array:
        """Least distance in each pose (N, n), at most ``reach``, < 0 where links enter each other, (N,) [m]."""
        poses = np.atleast_2d(np.asarray(q, dtype=np.float64))
        if poses.ndim != 2 or poses.shape[1] != self._n or not np.all(np.isfinite(poses)):
            raise InputError(f"q must be (N, {self._n}) finite numbers, got shape {poses.shape}")
        return np.array([min(self._pairs(pose).values(), default=self._reach) for pose in poses])

    def closest(self, q: Array) -> tuple[float, str, str]:
        """Distance and names of the nearest pair in a pose (n,); the floor is named ``floor``."""
        pairs = self._pairs(np.asarray(q, dtype=np.float64))
        if not pairs:
            return self._reach, "", ""
        a, b = min(pairs, key=lambda p: pairs[p])
        return pairs[a, b], "floor" if a == -2 else self._names[a + 1], self._names[b + 1]

    def _pairs(self, pose: Array) -> dict[tuple[int, int], float]:
        """Distances below reach by pair of links, -1 the base, -2 the floor."""
        mj, data = self._mj, self._data
        data.qpos[: self._n] = pose
        mj.mj_kinematics(self._model, data)
        mj.mj_comPos(self._model, data)
        mj.mj_collision(self._model, data)
        found: dict[tuple[int, int], float] = {}
        contact = data.contact
        for (first, second), distance in zip(contact.geom.tolist(), contact.dist.tolist(), strict=True):
            a, b = sorted((int(self._link[first]), int(self._link[second])))
            if b - a < 2 or (a, b) in self._ignored:
                continue
            found[a, b] = min(found.get((a, b), self._reach), distance)
        return found

    def _drawn_together(self, arm: Arm) -> frozenset[tuple[int, int]]:
        rng = np.random.default_rng(0)
        low = np.array([max(j.limits.lower, -np.pi) for j in arm.joints])
        high = np.array([min(j.limits.upper, np.pi) for j in arm.joints])
        count: dict[tuple[int, int], int] = {}
        for pose in low + rng.random((POSES, arm.n)) * (high - low):
            for pair, distance in self._pairs(pose).items():
                count[pair] = count.get(pair, 0) + (distance <= 0.0)
        return frozenset(pair for pair, times in count.items() if times > ALWAYS * POSES)
