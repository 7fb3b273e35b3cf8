"""A real NEURA LARA 8 holds 5.26 kg; its log tells the motor torques and the controller's own model of the bare arm.

The log is not ours to pass on: `palpate data get lara8` fetches it (needs palpate[data]). Writes report.html if
matplotlib is there. Prints:

    1247 samples, 5.0 s
    motor torques: 6.14 ± 1.20 kg (95 %), ok
    wrist sensor:  5.26 kg, inside the interval
    joint_2 alone: 5.22 kg
    joint_3 alone: 7.09 kg
"""

from __future__ import annotations

import importlib.util

import numpy as np

import palpate as pp
from palpate import data
from palpate.studies.lara8 import lara8_arm, wrist_sensor

arm = lara8_arm()  # a DH table, friction, and what the torque readings are worth: no masses
path = data.find("lara8", "jogging_linear_mass.csv")
log = pp.Log.open(
    path, pp.ColumnMap.named("lara8")
)  # your own file: pp.ColumnMap(time=..., position=..., ...)
print(f"{len(log)} samples, {log.duration:.1f} s")

# No masses are needed where the controller tells its model's torque: the external torque is model minus measured
observer = pp.ModelResidualObserver(cutoff=30.0)
pipeline = pp.Pipeline(arm, observer=observer, payload=pp.Regression(lag=1 / 30.0))
held = pipeline.run(log).payload
truth = wrist_sensor(arm, log).mass
mass, half = held.mass[-1], 1.96 * held.mass_std[-1]
print(f"motor torques: {mass:.2f} ± {half:.2f} kg (95 %), {pp.Status(held.status[-1]).name}")
print(f"wrist sensor:  {truth:.2f} kg, {'inside' if abs(mass - truth) < half else 'outside'} the interval")

# Why so wide: two joints feel the load, and they disagree
torque = np.mean(log.model_torque - log.effort, axis=0)
per_kg = np.mean(np.einsum("nij,i->nj", arm.jacobian(log.position)[:, :3], arm.gravity), axis=0)
for i in (1, 2):
    print(f"{arm.joint_names[i]} alone: {torque[i] / per_kg[i]:.2f} kg")

if importlib.util.find_spec("matplotlib"):
    from palpate.report import write_weigh_report
    from palpate.weigh import weigh_log

    write_weigh_report(weigh_log(log, arm).report(), "report.html")
