"""A simulated arm behind the driver contract: MuJoCo moves it, the sensor model spoils what it reports."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..arm import Arm, Array, Effort
from ..errors import DriverError
from ..logs import Sample
from ..simulate import Load, Plant, Schedule, SensorModel
from .driver import Driver, Pace


class MujocoDriver(Driver):
    """Reads and commands a simulated arm.

    Time is simulated: it advances by one period in every read() but the first, which gives the start pose at time 0
    with zero effort. A command holds until the next one. With the drives off the torque is zero, the safe torque
    here: the arm is limp and sinks, held by nothing but its friction. Effort is in the arm's own unit
    (``arm.effort``; link-side N m where the arm declares nothing).

    Args:
        arm: the arm, or a Plant of it with options of its own. connect() resets the plant.
        payload: what is held from the start; a number is a point mass [kg].
        sensor: what the drives report; None: ideal but for the resolutions and deviations in the arm, 250 Hz.
        schedule: objects taken and released, pushes; each happens at its own instant, also within a period.
        q: (n,) start pose [rad]; None: zero.
        dq: (n,) start velocity [rad/s]; None: zero.
        seed: of the sensor model that is made when `sensor` is None.
        pace: simulated seconds per wall second; None: as fast as it goes.

    Raises:
        ArmError: the arm has no masses.
        DriverError: both a sensor and a seed are given; the sensor is of another arm; the pace is not positive.
        MissingExtraError: mujoco is not installed.
    """

    def __init__(
        self,
        arm: Arm | Plant,
        *,
        payload: Load | float | None = None,
        sensor: SensorModel | None = None,
        schedule: Schedule | None = None,
        q: npt.ArrayLike | None = None,
        dq: npt.ArrayLike | None = None,
        seed: int | None = None,
        pace: float | None = None,
    ) -> None:
        if sensor is not None and seed is not None:
            raise DriverError("give the seed to the sensor model, or leave the sensor out")
        self._plant = arm if isinstance(arm, Plant) else Plant(arm)
        model = self._plant.arm
        self._sensor = SensorModel(model, seed=seed or 0) if sensor is None else sensor
        if self._sensor.n != model.n:
            raise DriverError(
                f"the sensor model is of {self._sensor.n} joints, arm {model.name!r} has {model.n}"
            )
        effort = Effort.torque() if model.effort.kind == "undeclared" else model.effort
        super().__init__(model.joint_names, self._sensor.period_ns, effort)
        self._payload = payload
        self._schedule = schedule or Schedule()
        self._start_q, self._start_dq = q, dq
        self._pace = Pace(pace)
        self._command: Array = np.zeros(self.n)
        self._first = True

    @property
    def plant(self) -> Plant:
        """The plant, for the truth; its present is the latest read()'s."""
        return self._plant

    @property
    def sensor(self) -> SensorModel:
        """The sensor model."""
        return self._sensor

    def _connect(self) -> None:
        self._plant.reset(self._start_q, self._start_dq)
        if self._payload is not None:
            self._plant.attach(self._payload)
        for _, event in self._schedule.between(-1, 0):
            event.apply(self._plant)
        self._sensor.reset()
        self._command = np.zeros(self.n)
        self._first = True
        self._pace.start(0)

    def _read(self) -> Sample | None:
        plant = self._plant
        if self._first:
            self._first = False
        else:
            end = plant.time_ns + self._period_ns
            for time_ns, event in self._schedule.between(plant.time_ns, end):
                if time_ns > plant.time_ns:
                    plant.step(self._command, time_ns - plant.time_ns)
                event.apply(plant)
            if end > plant.time_ns:
                plant.step(self._command, end - plant.time_ns)
        self._pace.wait(plant.time_ns)
        return self._sensor.read(plant.time_ns, plant.q, plant.dq, plant.torque)

    def _write(self, torque: Array) -> Array:
        self._command = self._sensor.drive(torque)
        return self._command.copy()

    def _enable(self) -> None:
        """Connecting and disabling left the command at zero."""

    def _disable(self) -> None:
        self._command = np.zeros(self.n)

    def _close(self) -> None:
        self._plant.close()
