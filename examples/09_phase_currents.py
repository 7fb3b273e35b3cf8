"""Joint torque from two current sensors per motor that nobody calibrated: offsets, gains, electrical angle, sign.

Needs palpate[identify]. Prints:

    offset of phase a: 0.050 A, was 0.050 A
    electrical angle:  1.200 rad, was 1.200 rad
    as they are: torque off by 4.8 N m at most
    calibrated:  torque off by 0.0 N m at most
"""

from __future__ import annotations

import math

import numpy as np

import palpate as pp
from palpate.identify import calibrate_phases

K_T, GEAR, POLE_PAIRS = 0.8, 100.0, 4  # from the data sheet [N m/A], [1], [1]

# What the two clamps read while the joint goes and comes back: your log, made up here
time = np.arange(0.0, 8.0, 1e-3)
position = 0.4 * (1.0 - np.cos(0.5 * np.pi * time))
torque = 60.0 * np.cos(position) + 20.0 * np.tanh(np.gradient(position, time) / 0.01)
angle = POLE_PAIRS * GEAR * position + 1.2
i_q = torque / (K_T * GEAR)
i_a = -i_q * np.sin(angle)
i_b = 0.5 * (math.sqrt(3.0) * i_q * np.cos(angle) - i_a)
phase_a, phase_b = 1.01 * i_a + 0.05, i_b / 1.01 - 0.03

# A field-oriented drive has no current along its field: that tells all
found = calibrate_phases(position, phase_a, phase_b, POLE_PAIRS * GEAR)
print(f"offset of phase a: {found.offset[0]:.3f} A, was 0.050 A")
print(f"electrical angle:  {found.angle_offset:.3f} rad, was 1.200 rad")

effort = pp.Effort.phase_currents(K_T, GEAR, POLE_PAIRS, found.angle_offset)  # belongs into the arm's card
readings = (np.rint(time * 1e9), phase_a[:, None], phase_b[:, None])
for name, sensors in (
    ("as they are:", {}),
    ("calibrated: ", {"offset": [found.offset], "gain": [found.gain]}),
):
    drive = pp.PhaseCurrents(
        1,
        k_t=effort.k_t,
        gear=effort.gear,
        pole_pairs=effort.pole_pairs,
        angle_offset=effort.angle_offset,
        **sensors,
    )
    given = drive.run(*readings, position=position[:, None]).torque[:, 0]
    print(f"{name} torque off by {np.abs(given - torque).max():.1f} N m at most")
