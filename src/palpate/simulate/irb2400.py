"""The ABB IRB 2400-16 of the sensorless-force paper as it is: its drives, and the current sensors around its cables."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .. import robots
from ..arm import Arm, Array
from ..logs import Sample
from .drives import Drives
from .sensing import SensorModel

B = np.eye(6)
B[2, 1] = 1.0
"""speeds of the motors = B dq: the parallelogram turns motor 3 with joints 2 and 3"""

# --- what no source states: typical of such robots --------------------------------------------------------------------

K_T = np.array([1.2, 1.2, 1.1, 0.8, 0.8, 0.8])
"""torque constants per ampere of peak current [N m/A]"""
GEAR = np.array([125.0, 125.0, 110.0, 60.0, 60.0, 50.0])
POLE_PAIRS = 4
ROTORS = np.array([10.0, 10.0, 10.0, 2.5, 2.5, 1.5])
"""inertia of the rotors at the link side [kg m^2]"""
PRESLIDING = 5e-4
"""[rad]; lies between the distances that identification tries"""
RIPPLE = 0.02
"""of the friction with the motor's position, which no model here knows, part of Coulomb friction [1]"""
ENCODER = 1.5e-5
"""one count at the link [rad]"""
NOMINAL = np.array([3.0, 5.0, 3.0, 3.0, 3.0, 3.0])
"""of the current sensors TH3A and TH5A [A]"""
OFFSET, GAIN_MISMATCH, NOISE = 0.02, 0.02, 0.005
"""offset, gain error and noise of a sensor: largest, largest, standard deviation; part of nominal, of reading,
of nominal [1]"""
GLITCH = 0.04
"""how long the change of the phase order leaves no sine when a motor turns back [s]"""
TURNING = 1e-3
"""speed from which on a motor counts as turning [rad/s]"""


def truth_arm() -> Arm:
    """The robot as it is: Table 1 of the paper, decoded, and published friction."""
    return robots.load("abb_irb2400_16")


def truth_drives(arm: Arm) -> Drives:
    """Its motors with the published friction of Obal and Gierlak, which was measured at the motors."""
    friction = [joint.friction for joint in arm.joints]
    return Drives(
        B=B,
        inertia=ROTORS,
        coulomb=np.array([f.coulomb for f in friction]),
        static=np.array([f.static for f in friction]),
        viscous=np.array([f.viscous for f in friction]),
        stribeck_velocity=np.array([f.stribeck_velocity for f in friction]),
        presliding=np.full(6, PRESLIDING),
        ripple=np.full(6, RIPPLE),
        ripple_period=2.0 * math.pi / GEAR,
    )


def phase_waves(i_q: Array, theta: Array, glitch: Array) -> tuple[Array, Array]:
    """Currents of phases a and b [A] for a q-axis current [A] at an electrical angle [rad], any shape.

    Args:
        glitch: how far the two have passed into one another [1], 0 to 1.
    """
    a = -i_q * np.sin(theta)
    b = 0.5 * (math.sqrt(3.0) * i_q * np.cos(theta) - a)
    return a + glitch * (b - a), b + glitch * (a - b)


def glitch_pulse(rate: float) -> Array:
    """How far the phases pass into one another after a reversal, sample by sample at `rate` [Hz]: a half sine [1]."""
    length = round(GLITCH * rate)
    found: Array = np.sin(np.pi * (np.arange(length) + 0.5) / length)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class CurrentSensors:
    """Two sensors for every motor, as they came.

    Attributes:
        offset: (n, 2) [A].
        gain: (n, 2) [1].
        angle: (n,) electrical angle at position 0 [rad].
    """

    offset: Array
    gain: Array
    angle: Array

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> CurrentSensors:
        """Any six motors' sensors within their tolerances."""
        offset = OFFSET * NOMINAL[:, None] * rng.uniform(-1.0, 1.0, (6, 2))
        gain = 1.0 + GAIN_MISMATCH * rng.uniform(-1.0, 1.0, (6, 2))
        return cls(offset, gain, rng.uniform(-math.pi, math.pi, 6))

    def measured(
        self, torque: Array, position: Array, glitch: Array, rng: np.random.Generator
    ) -> tuple[Array, Array]:
        """(..., n) readings of phases a and b [A].

        Args:
            torque: (..., n) of the motors at the link side [N m].
            position: (..., n) of the motors at the link side [rad].
            glitch: (..., n) see :func:`phase_waves`.
            rng: of the noise.
        """
        a, b = phase_waves(torque / (K_T * GEAR), POLE_PAIRS * GEAR * position + self.angle, glitch)
        noise = NOISE * NOMINAL * rng.standard_normal((2, *a.shape))
        return (
            a * self.gain[:, 0] + self.offset[:, 0] + noise[0],
            b * self.gain[:, 1] + self.offset[:, 1] + noise[1],
        )


class PhaseSensors(SensorModel):
    """What is measured of the robot live: encoder counts, and as effort (6, 2) two phase currents per motor.

    Args:
        arm: the robot.
        sensors: the current sensors.
        rate: readings per second [Hz].
        seed: of the noise.
    """

    def __init__(self, arm: Arm, sensors: CurrentSensors, *, rate: float = 1000.0, seed: int = 0) -> None:
        self._sensors = sensors
        self._pulse = np.append(glitch_pulse(rate), 0.0)
        super().__init__(arm, rate=rate, seed=seed)

    def reset(self) -> None:
        """Back to the first reading."""
        super().reset()
        self._way = np.zeros(self.n)
        self._age = np.full(self.n, len(self._pulse) - 1)

    def read(self, time_ns: int, q: npt.ArrayLike, dq: npt.ArrayLike, torque: npt.ArrayLike) -> Sample:
        """The reading of an instant; arguments as of :meth:`palpate.simulate.SensorModel.read`."""
        w = B @ np.asarray(dq)
        way = np.where(np.abs(w) > TURNING, np.sign(w), self._way)
        self._age = np.where(way * self._way < 0.0, 0, np.minimum(self._age + 1, len(self._pulse) - 1))
        self._way = way
        motor: Array = np.linalg.solve(B.T, np.asarray(torque)).astype(np.float64)
        position = np.asarray(q)
        phases = self._sensors.measured(motor, B @ position, self._pulse[self._age], self._rng)
        return Sample(time_ns, np.round(position / ENCODER) * ENCODER, None, np.column_stack(phases))
