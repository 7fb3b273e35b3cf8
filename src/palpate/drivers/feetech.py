"""Arms of Feetech STS3215 servos (SO-100, SO-101): position, speed, load and current in one block read.

Registers and units: Feetech's memory table of the STS series; signs as in Feetech's own C++ library (SMS_STS.cpp).
The servo has no current control. Torque is commanded through the voltage at its motor (PWM mode) by the straight line
between stall torque and no-load speed that its data sheet states: that is coarse, and what was really applied is what
the current tells.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..arm import Arm, Array
from ..errors import DriverError, InputError, MissingExtraError, suggest
from .bus import COUNTS_PER_TURN, RAD_PER_COUNT, Bus, Servo
from .servos import Reading, ServoDriver

_MODEL = 777
_MODEL_NUMBER = 3
_RESPONSE_LEVEL = 8
_PHASE = 18
_MODE = 33
_TORQUE_ENABLE = 40
_GOAL_PWM = 44
_STATUS = 65
_PRESENT = (56, 15)
"""position (2), speed (2), load (2), voltage, temperature, -, status, moving, goal (2), current (2)"""
_PWM_MODE = 2
_PHASE_COARSE_SPEED, _PHASE_MULTI_TURN = 0x04, 0x10
_CURRENT_UNIT = 6.5e-3
"""[A]"""
_MOST_CURRENT = 2047
"""largest that can be set as a limit [6.5 mA]"""
_FULL = 1000
"""of load and PWM"""
_FASTEST = 3.0 * COUNTS_PER_TURN
"""no servo of the series turns so fast [counts/s]"""
_WELL = MappingProxyType(
    {0x01: "input voltage", 0x02: "encoder", 0x04: "overheating", 0x08: "overcurrent", 0x20: "overload"}
)


@dataclass(frozen=True, slots=True)
class Model:
    """One version of the servo; they do not say which they are."""

    voltage: float
    """at which the rest is stated [V]"""
    stall_torque: float
    """[N m]"""
    no_load_speed: float
    """[rad/s]"""


MODELS = MappingProxyType(
    {
        # 19.5 kg cm and 52 rpm at 7.4 V; 30 kg cm and 45 rpm at 12 V: data sheets of the 1:345 versions
        "STS3215-C001": Model(7.4, 19.5 * 9.80665e-2, 52.0 * math.pi / 30.0),
        "STS3215-C018": Model(12.0, 30.0 * 9.80665e-2, 45.0 * math.pi / 30.0),
    }
)


@dataclass(frozen=True, slots=True)
class Feedback:
    """One block, in the servo's own units."""

    position: int
    """[counts]"""
    speed: int
    """[1 or 50 counts/s, see Phase]"""
    load: int
    """duty of the motor's voltage [0.1 %]"""
    voltage: float
    """[V]"""
    temperature: int
    """[degree Celsius]"""
    status: int
    current: int
    """[6.5 mA]"""

    @classmethod
    def of(cls, block: bytes) -> Feedback:
        """Registers 56 to 70. Signs are bits of their own: 15, for the load 10."""
        word = [int.from_bytes(block[i : i + 2], "little") for i in range(len(block) - 1)]
        return cls(
            position=signed(word[0], 15),
            speed=signed(word[2], 15),
            load=signed(word[4], 10),
            voltage=0.1 * block[6],
            temperature=block[7],
            status=block[9],
            current=signed(word[13], 15),
        )

    def plausible(self) -> bool:
        """Whether a servo can mean this; the sum that protects an answer lets one damaged answer in 256 through."""
        return (
            abs(self.load) <= _FULL
            and abs(self.speed) <= _FASTEST
            and abs(self.current) <= _MOST_CURRENT
            and 3.0 <= self.voltage <= 20.0
            and self.temperature <= 125
        )


def signed(word: int, bit: int) -> int:
    """A number of two bytes whose sign is a bit; the bits below it are the magnitude."""
    magnitude = word & ((1 << bit) - 1)
    return -magnitude if word >> bit & 1 else magnitude


class FeetechDriver(ServoDriver):
    """Reads and commands STS3215 servos; the SDK is the extra ``feetech``.

    Effort is the present current [A], mean of a period, with the joint's sign. connect() switches the torque of
    every servo off: hold the arm. enable() puts them into PWM mode until they lose power. They have no watchdog: a
    program that is killed leaves them pushing with the last command. The bus file must name each servo's model. An
    error in a servo's status stops all. An answer is protected by one byte only, so that one in 256 damaged answers
    looks good: positions that jump are asked for again.

    Args:
        arm, port, bus, rate, patience: see :class:`~palpate.drivers.servos.ServoDriver`.
    """

    _block = _PRESENT
    _model_number = _MODEL_NUMBER
    _torque_enable = _TORQUE_ENABLE
    _goal = _GOAL_PWM
    _id_at, _error_at, _trailer = 2, 4, 1

    def __init__(self, arm: Arm, port: str, *, bus: Bus, rate: float = 250.0, patience: int = 2) -> None:
        try:
            import scservo_sdk
        except ImportError:
            raise MissingExtraError("feetech", "driving Feetech servos") from None
        for servo in bus.servos:
            if servo.model not in MODELS:
                raise InputError(
                    f"bus: servo {servo.id}: model must be given, one of {', '.join(MODELS)}"
                    if servo.model is None
                    else f"bus: servo {servo.id}: no model {servo.model!r}; {suggest(servo.model, MODELS, 'models')}"
                )
        super().__init__(arm, port, sdk=scservo_sdk, protocol=0, bus=bus, rate=rate, patience=patience)
        models = [MODELS[s.model or ""] for s in bus.servos]
        self._stall_per_volt = np.array([m.stall_torque / m.voltage for m in models])
        self._damping = np.array([m.stall_torque / m.no_load_speed for m in models])
        count = len(models)
        self._speed_unit: Array = np.zeros(count)
        self._multi_turn = [False] * count
        self._speed: Array = np.zeros(count)
        self._voltage: Array = np.array([m.voltage for m in models])
        self._turned: list[tuple[float, float] | None] = [None] * count
        """time [s] and position, turns counted, of the last good answer"""
        self._doubted: list[float | None] = [None] * count

    @property
    def resolution(self) -> tuple[Array, Array]:
        """See :attr:`ServoDriver.resolution`."""
        return self._map.steps(np.full(len(self._ids), _CURRENT_UNIT))

    @staticmethod
    def _hint(servo: Servo) -> str:
        return "a torque_constant_Nm_A, measured with a known load"

    @staticmethod
    def _length(packet: Sequence[int]) -> int:
        return packet[3] - 1

    def _meet(self, index: int, number: int) -> None:
        if number != _MODEL:
            raise DriverError(
                f"{self._who(self._ids[index])} is of model number {number}; an STS3215 says {_MODEL}"
            )

    def _prepare(self) -> None:
        for i, servo in enumerate(self._ids):
            if self._ask(servo, _RESPONSE_LEVEL, 1) != 1:
                raise DriverError(
                    f"{self._who(servo)} does not confirm what it is told: set its register {_RESPONSE_LEVEL} to 1"
                )
            phase = self._ask(servo, _PHASE, 1)
            self._speed_unit[i] = (1.0 if phase & _PHASE_COARSE_SPEED else 50.0) * RAD_PER_COUNT
            self._multi_turn[i] = bool(phase & _PHASE_MULTI_TURN)
            self._turned[i] = self._doubted[i] = None

    def _decode(self, servo: int, data: bytes) -> Reading | None:
        seen = Feedback.of(data)
        i = self._ids.index(servo)
        if not seen.plausible():
            return None
        if seen.status:
            self._complaints[servo] = seen.status
        position = self._count_turns(i, seen.position)
        if position is None:
            return None
        self._speed[i], self._voltage[i] = seen.speed * self._speed_unit[i], seen.voltage
        return Reading(position, self._speed[i], _CURRENT_UNIT * seen.current)

    def _count_turns(self, i: int, position: int) -> float | None:
        """Position with its turns counted; None the first time that it is where the servo cannot have come to."""
        now, last = time.monotonic(), self._turned[i]
        found = float(position)
        if last is not None:
            step = position - last[1]
            if not self._multi_turn[i]:
                step = (step + COUNTS_PER_TURN / 2) % COUNTS_PER_TURN - COUNTS_PER_TURN / 2
            found = last[1] + step
            doubted, self._doubted[i] = self._doubted[i], None
            if abs(step) > _FASTEST * (now - last[0]) + 8.0 and (
                doubted is None or abs(found - doubted) > 8.0 + _FASTEST * 1e-2
            ):
                self._doubted[i] = found
                return None
        self._turned[i] = (now, found)
        return found

    def _judge(self, servo: int, error: int) -> None:
        """One damaged answer in 256 looks good: an error counts if the servo says so again."""
        if not error:
            return
        with self._talking():
            status, result, _ = self._packets.read1ByteTxRx(self._port, servo, _STATUS)
        words = [word for bit, word in _WELL.items() if error & status & bit]
        if result == self._sdk.COMM_SUCCESS and words:
            raise DriverError(f"{self._who(servo)} reports an error: {', '.join(words)}")

    def _check_refusal(self, servo: int, address: int, value: int, error: int) -> None:
        if address != _TORQUE_ENABLE or value:
            self._judge(servo, error)

    def _switch_on(self, index: int) -> None:
        servo = self._ids[index]
        self._tell(servo, _MODE, 1, _PWM_MODE)
        self._tell(servo, _GOAL_PWM, 2, 0)
        self._tell(servo, _TORQUE_ENABLE, 1, 1)

    def _write(self, torque: Array) -> Array:
        currents = np.clip(self._map.currents(torque), -self._bus_limits, self._bus_limits)
        stall = self._stall_per_volt * self._voltage
        braking = self._damping * self._speed
        duty = np.clip(np.rint((self._map.horn_torque(currents) + braking) / stall * _FULL), -_FULL, _FULL)
        self._send(
            self._goals, [((word := abs(int(d)) | (0x400 if d < 0 else 0)) & 0xFF, word >> 8) for d in duty]
        )
        return self._map.torque(self._map.horn_current(duty / _FULL * stall - braking))
