"""Committed outputs of every observer and estimator on one committed log: a change of behaviour becomes a visible diff.

After a wanted change: ``python tests/python/test_golden.py`` rewrites tests/golden/outputs.json; the diff of that file
belongs into the commit that caused it.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import palpate as pp

GOLDEN = Path(__file__).resolve().parent.parent / "golden" / "outputs.json"
ROWS = (50, 200, 400, 599)

PIPELINES = {
    "inverse-dynamics + joint-formula": lambda arm: pp.Pipeline(
        arm, observer=pp.InverseDynamicsObserver(), payload=pp.JointFormula()
    ),
    "sliding-mode + joint-formula": lambda arm: pp.Pipeline(
        arm, observer=pp.SlidingModeObserver(cutoff=10.0), payload=pp.JointFormula(joint=5)
    ),
    "momentum + regression": lambda arm: pp.Pipeline(
        arm, observer=pp.MomentumObserver(), payload=pp.Regression(lag=1 / 30)
    ),
    "super-twisting + regression m, mc": lambda arm: pp.Pipeline(
        arm, observer=pp.MomentumSuperTwisting(), payload=pp.Regression(first_moment=True)
    ),
    "disturbance-kalman, wrench, contact": lambda arm: pp.Pipeline(
        arm,
        observer=pp.DisturbanceKalman(),
        payload=None,
        wrench=pp.WrenchEstimator(),
        contact=pp.ContactDetector(),
    ),
    "extended-kalman": lambda arm: pp.Pipeline(arm, observer=pp.ExtendedKalman(), payload=None),
    "payload-filter m": lambda arm: pp.Pipeline(arm, payload=pp.PayloadFilter()),
    "payload-filter m, mc": lambda arm: pp.Pipeline(arm),
}


def golden_log() -> tuple[pp.Arm, pp.Log]:
    """Justina with 0.2 kg, by the core's own inverse dynamics: no simulator whose update could change it."""
    arm = pp.robots.load("justina_left_arm")
    t = np.arange(600) * 0.004
    phase = np.arange(7) * 0.7
    amplitude, speed = 0.4, 1.3
    q = amplitude * (1 - np.cos(speed * t))[:, None] * np.cos(phase)
    dq = amplitude * speed * np.sin(speed * t)[:, None] * np.cos(phase)
    ddq = amplitude * speed**2 * np.cos(speed * t)[:, None] * np.cos(phase)
    last = arm.joints[-1]
    c = arm.T_last_tip[:3, :3] @ arm.grasp + arm.T_last_tip[:3, 3]
    mass = last.mass + 0.2
    com = (last.mass * last.com + 0.2 * c) / mass

    def spread(m: float, r: np.ndarray) -> np.ndarray:
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    inertia = last.inertia + spread(last.mass, last.com - com) + spread(0.2, c - com)
    loaded = arm.replace(joints=(*arm.joints[:-1], last.replace(mass=mass, com=com, inertia=inertia)))
    noise = np.random.Generator(np.random.PCG64(7))
    tau = loaded.inverse_dynamics(q, dq, ddq) + arm.friction_torque(dq)
    log = pp.Log(
        time_ns=(t * 1e9).round().astype(np.int64),
        position=q + noise.normal(0.0, 1e-4, q.shape),
        effort=tau + noise.normal(0.0, 1e-2, q.shape),
        joint_names=arm.joint_names,
    )
    return arm, log


def outputs() -> dict[str, dict[str, list[float]]]:
    """Rows ROWS of what every pipeline says."""
    arm, log = golden_log()
    out = {}
    for name, make in PIPELINES.items():
        touch = make(arm).run(log)
        out[name] = {
            "mass": [float(touch.payload.mass[r]) for r in ROWS],
            "mass_std": [float(touch.payload.mass_std[r]) for r in ROWS],
            "torque": [float(x) for r in ROWS for x in touch.external.torque[r]],
            "torque_std": [float(x) for r in ROWS for x in touch.external.std[r]],
            "status": [int(touch.payload.status[r]) for r in ROWS],
            "q": [float(x) for r in ROWS for x in touch.q[r]],
        }
        if touch.wrench is not None and touch.contact is not None:
            out[name]["force"] = [float(x) for r in ROWS for x in touch.wrench.force[r]]
            out[name]["force_std"] = [float(x) for r in ROWS for x in touch.wrench.force_std[r]]
            out[name]["level"] = [float(x) for r in ROWS for x in touch.contact.level[r]]
    return out


@pytest.mark.parametrize("name", PIPELINES)
def test_outputs_are_the_committed_ones(name):
    expected = json.loads(GOLDEN.read_text())[name]
    got = outputs()[name]
    assert list(got) == list(expected)
    for what, numbers in expected.items():
        for k, (a, b) in enumerate(zip(got[what], numbers, strict=True)):
            # Other compilers and libm's exp, tanh may round the last digits otherwise.
            assert math.isclose(a, b, rel_tol=1e-7, abs_tol=1e-10), (
                f"{what}[{k}]: {a!r} is not the committed {b!r}"
            )


if __name__ == "__main__":
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_text(json.dumps(outputs(), indent=1) + "\n")
