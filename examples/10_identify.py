"""Identify: an arm whose masses and friction nobody knows moves for 20 s, then its card predicts new motion.

Needs palpate[sim,identify]. Prints:

    conditioning 7.8, of random motion 12.3
    conditioning 6.1, of random motion 13.4
    as described: 29.1 % of the torque unexplained
    identified: 2.2 % of the torque unexplained
    A2 Coulomb friction: 4.00 N m, true 4.00 N m
"""

from __future__ import annotations

import numpy as np

import palpate as pp
from palpate.identify import excite, fit
from palpate.simulate import Clearance, rehearse

described = pp.robots.load("kuka_lbr_iiwa7").replace(effort=pp.Effort.torque())
wrong = np.random.default_rng(1).uniform(0.6, 1.4, described.n)  # nobody knows these
true_arm = described.replace(
    joints=tuple(
        j.replace(
            mass=f * j.mass,
            inertia=f * j.inertia,
            friction=pp.Friction(coulomb=8.0 / (i + 1), viscous=6.0 / (i + 1)),
        )
        for i, (j, f) in enumerate(zip(described.joints, wrong, strict=True))
    )
)


def move(seed: int) -> pp.Log:
    """A motion that shows much, and what encoders and torques say while the true arm follows it."""
    motion = excite(described, seed=seed, iterations=10, clearance=Clearance(described))
    print(f"conditioning {motion.conditioning:.1f}, of random motion {motion.random_conditioning:.1f}")
    return rehearse(true_arm, motion.time, motion.q, motion.dq, motion.ddq).log


first, second = move(seed=0), move(seed=2)
found = fit(described, first, friction="coulomb", validate_on=second)
before = described.inverse_dynamics(
    second.position, second.velocity, np.gradient(second.velocity, 0.01, axis=0)
)
unexplained = np.linalg.norm(second.effort - before) / np.linalg.norm(second.effort)
named = {e.name: e.value for e in found.parameters}
print(f"as described: {100 * unexplained:.1f} % of the torque unexplained")
print(f"identified: {100 * found.held_out.relative_overall:.1f} % of the torque unexplained")
print(
    f"A2 Coulomb friction: {named['A2.coulomb']:.2f} N m, true {true_arm.joints[1].friction.coulomb:.2f} N m"
)
