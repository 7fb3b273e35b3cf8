"""Arms of Dynamixel servos with Protocol 2.0: current control, position, velocity and current in one sync read.

Registers, units and model numbers: ROBOTIS e-Manual, https://emanual.robotis.com/docs/en/dxl/ (X series and MX(2.0)
share the addresses used here). That one silent servo silences those behind it in a sync read: ROBOTIS-GIT/DynamixelSDK
issue 364.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from ..arm import Arm, Array
from ..errors import DriverError, InputError, MissingExtraError, suggest
from ..logs import Sample
from .bus import COUNTS_PER_TURN, Bus, Servo
from .servos import Reading, ServoDriver

_MODEL_NUMBER = 0
_RETURN_DELAY = 9
_OPERATING_MODE = 11
_CURRENT_LIMIT = 38
_TORQUE_ENABLE = 64
_HARDWARE_ERROR = 70
_WATCHDOG = 98
_GOAL_CURRENT = 102
_PRESENT = (126, 10)
"""current (2 bytes), velocity (4), position (4)"""
_POSITION = (132, 4)
_CURRENT_CONTROL = 0
_WATCHDOG_UNIT_S = 0.02
_DELAY_UNIT_S = 2e-6
_SPEED_UNIT = 0.229 * 2.0 * math.pi / 60.0
"""[rad/s]"""
_ALERT = 0x80
_REFUSALS = MappingProxyType(
    {
        1: "it failed",
        2: "no such instruction",
        3: "it arrived damaged",
        4: "out of range",
        5: "wrong length",
        6: "beyond a limit that is set in the servo",
        7: "not accessible now",
    }
)
_HARDWARE = MappingProxyType(
    {
        0x01: "input voltage",
        0x04: "overheating",
        0x08: "motor encoder",
        0x10: "electrical shock or too little power",
        0x20: "overload",
    }
)


@dataclass(frozen=True, slots=True)
class Model:
    """One model of servo."""

    number: int
    current_unit: float | None
    """of goal and present current [A]; None: it measures load, not current"""
    stall: float | None = None
    """stall torque / stall current that the e-Manual states at 12 V (24 V for V) [N m/A]: a first guess at
    the torque constant, friction and the offset of the current not taken into account"""
    supply: bool = False
    """the current is that of the servo's supply, not of its motor: it is no measure of torque. Seen in recordings of
    XL330; the other servos of that size are taken to be alike"""


_X, _V, _330, _MX = 2.69e-3, 1.34e-3, 1.0e-3, 3.36e-3
MODELS = MappingProxyType(
    {
        "XL330-M077": Model(1190, _330, supply=True),
        "XL330-M288": Model(1200, _330, supply=True),
        "XC330-T181": Model(1210, _330, supply=True),
        "XC330-T288": Model(1220, _330, supply=True),
        "XC330-M181": Model(1230, _330, supply=True),
        "XC330-M288": Model(1240, _330, supply=True),
        "XM430-W210": Model(1030, _X, 3.0 / 2.3),
        "XM430-W350": Model(1020, _X, 4.1 / 2.3),
        "XM540-W150": Model(1130, _X, 7.3 / 4.4),
        "XM540-W270": Model(1120, _X, 10.6 / 4.4),
        "XD430-T210": Model(1011, _X),
        "XD430-T350": Model(1001, _X),
        "XD540-T150": Model(1111, _X),
        "XD540-T270": Model(1101, _X),
        "XH430-W210": Model(1010, _X),
        "XH430-W350": Model(1000, _X),
        "XH430-V210": Model(1050, _V, 2.6 / 0.7),
        "XH430-V350": Model(1040, _V, 3.3 / 0.7),
        "XH540-W150": Model(1110, _X),
        "XH540-W270": Model(1100, _X),
        "XH540-V150": Model(1150, _X, 6.4 / 2.4),
        "XH540-V270": Model(1140, _X, 9.2 / 2.4),
        "XW540-T140": Model(1180, _X, 6.9 / 4.9),
        "XW540-T260": Model(1170, _X, 9.5 / 4.9),
        "MX-64(2.0)": Model(311, _MX, 6.0 / 4.1),
        "MX-106(2.0)": Model(321, _MX, 8.4 / 5.2),
        "MX-28(2.0)": Model(30, None),
        "XL430-W250": Model(1060, None),
        "2XL430-W250": Model(1090, None),
        "XC430-W150": Model(1070, None),
        "XC430-W240": Model(1080, None),
        "2XC430-W250": Model(1160, None),
    }
)


class DynamixelDriver(ServoDriver):
    """Reads and commands Dynamixel servos; the SDK is the extra ``dynamixel``.

    Effort is the present current [A], mean of a period, with the joint's sign. connect() switches the torque of
    every servo off: hold the arm. enable() puts them into current control, a setting that stays in the servo, and
    sets their watchdog: so long after the last packet they stop by themselves, whatever has become of this program.
    A hardware error of any servo stops all.

    Args:
        arm, port, bus, rate, patience: see :class:`~palpate.drivers.servos.ServoDriver`.
        watchdog: 0.02 to 2.54 s, rounded to 0.02 s.
    """

    _block = _PRESENT
    _model_number = _MODEL_NUMBER
    _torque_enable = _TORQUE_ENABLE
    _goal = _GOAL_CURRENT
    _id_at, _error_at, _trailer = 4, 8, 2

    def __init__(
        self,
        arm: Arm,
        port: str,
        *,
        bus: Bus | None = None,
        rate: float = 250.0,
        patience: int = 2,
        watchdog: float = 0.2,
    ) -> None:
        if not 0.02 <= watchdog <= 2.54:
            raise InputError(f"watchdog must be from 0.02 to 2.54 s, got {watchdog!r}")
        try:
            import dynamixel_sdk
        except ImportError:
            raise MissingExtraError("dynamixel", "driving Dynamixel servos") from None
        for servo in (bus or Bus.of(arm)).servos:
            if servo.model is not None:
                _known(servo.model, f"bus: servo {servo.id}", InputError)
        super().__init__(arm, port, sdk=dynamixel_sdk, protocol=2.0, bus=bus, rate=rate, patience=patience)
        count = len(self._ids)
        self._unit: Array = np.zeros(count)
        self._limit: Array = np.zeros(count)
        self._watchdog = round(watchdog / _WATCHDOG_UNIT_S)
        self._heard = 0.0

    @property
    def resolution(self) -> tuple[Array, Array]:
        """See :attr:`ServoDriver.resolution`."""
        return self._map.steps(self._unit)

    @staticmethod
    def _hint(servo: Servo) -> str:
        model = MODELS.get(servo.model or "")
        field = "a torque_constant_Nm_A"
        if model is None or model.stall is None:
            return field
        return f"{field} (the maker's stall torque and current make {model.stall:.3g}: a first guess)"

    @staticmethod
    def _length(packet: Sequence[int]) -> int:
        # counts instruction and error too
        return packet[5] + (packet[6] << 8) - 2

    def _meet(self, index: int, number: int) -> None:
        servo = self._servos[index]
        name = next((name for name, m in MODELS.items() if m.number == number), None)
        who = self._who(servo.id)
        if name is None:
            raise DriverError(f"{who} is of model number {number}, which is not known here")
        if servo.model is not None and servo.model != name:
            raise DriverError(f"{who} is a {name}; the bus file says {servo.model}")
        self._unit[index] = _known(name, who, DriverError)
        if MODELS[name].supply:
            self._doubts[servo.id] = (
                f"{who}, a {name}, reports the current of its supply, not of its motor: it is no measure of torque; "
                "record it and see palpate.identify.servo"
            )

    def _prepare(self) -> None:
        count, delay = len(self._ids), 0.0
        for i, servo in enumerate(self._ids):
            most = self._ask(servo, _CURRENT_LIMIT, 2)
            # a goal beyond this is dropped without a word in a sync write
            self._limit[i] = min(float(most), float(np.floor(self._bus_limits[i] / self._unit[i] + 1e-9)))
            if self._limit[i] < 1.0:
                raise DriverError(
                    f"{self._who(servo)}: its current limit is below one step: it can move nothing"
                )
            delay += _DELAY_UNIT_S * self._ask(servo, _RETURN_DELAY, 1)
        self._port.grace_ms += 1e3 * delay
        self._port.gap_ms += 1e3 * delay
        wire = 10.0 / self._baud * ((14 + count) + count * (11 + _PRESENT[1]) + (14 + 3 * count))
        if wire + delay > 1e-9 * self._period_ns:
            raise DriverError(
                f"{self._path}: {1e9 / self._period_ns:g} Hz cannot be reached: {count} servos take {1e3 * wire:.2g} "
                f"ms on the wire and wait {1e3 * delay:.2g} ms before they answer; ask for a lower rate, a higher baud "
                f"rate, or set their Return Delay Time (register {_RETURN_DELAY}) to 0"
            )

    def _decode(self, servo: int, data: bytes) -> Reading | None:
        current, speed, position = struct.unpack("<hii", data)
        return Reading(position, _SPEED_UNIT * speed, self._unit[self._ids.index(servo)] * current)

    def _judge(self, servo: int, error: int) -> None:
        if not error & _ALERT:
            return
        with self._talking():
            bits, result, _ = self._packets.read1ByteTxRx(self._port, servo, _HARDWARE_ERROR)
        words = [word for bit, word in _HARDWARE.items() if bits & bit]
        if result != self._sdk.COMM_SUCCESS or not words:
            words = [f"not told, register {_HARDWARE_ERROR} is {bits:#04x}"]
        raise DriverError(
            f"{self._who(servo)} reports a hardware error: {', '.join(words)}; it must be restarted"
        )

    def _check_refusal(self, servo: int, address: int, value: int, error: int) -> None:
        refusal = error & ~_ALERT
        if refusal:
            raise DriverError(
                f"{self._who(servo)} refuses {value} in register {address}: "
                f"{_REFUSALS.get(refusal, f'error {refusal}')}"
            )
        if address != _TORQUE_ENABLE or value:
            self._judge(servo, error)

    def _switch_on(self, index: int) -> None:
        servo = self._ids[index]
        self._tell(servo, _WATCHDOG, 1, 0)  # a watchdog that has struck lets nothing be commanded
        if self._ask(servo, _OPERATING_MODE, 1) != _CURRENT_CONTROL:
            before = self._ask(servo, *_POSITION)
            self._tell(servo, _OPERATING_MODE, 1, _CURRENT_CONTROL)
            turns = (self._ask(servo, *_POSITION) - before + 2**31) % 2**32 - 2**31
            if abs(turns) > COUNTS_PER_TURN // 2:
                raise DriverError(
                    f"{self._who(servo)} counts other turns in current control: its position went by {turns} counts; "
                    "it is in current control now, so begin again, and check where the joint reads"
                )
        self._tell(servo, _GOAL_CURRENT, 2, 0)
        self._tell(servo, _TORQUE_ENABLE, 1, 1)
        self._tell(servo, _WATCHDOG, 1, self._watchdog)
        self._heard = time.monotonic()

    def _read(self) -> Sample | None:
        self._check_watchdog()
        return super()._read()

    def _check_watchdog(self) -> None:
        """The servos drop commands without a word once their watchdog has struck."""
        now = time.monotonic()
        if self.state == "enabled" and now - self._heard > self._watchdog * _WATCHDOG_UNIT_S:
            raise DriverError(
                f"{1e3 * (now - self._heard):.0f} ms without a packet: the watchdogs have stopped the servos"
            )
        self._heard = now

    def _write(self, torque: Array) -> Array:
        self._check_watchdog()
        counts = np.rint(np.clip(self._map.currents(torque) / self._unit, -self._limit, self._limit))
        self._send(self._goals, [tuple(struct.pack("<h", int(c))) for c in counts])
        return self._map.torque(counts * self._unit)


def _known(name: str, where: str, error: type[DriverError] | type[InputError]) -> float:
    """The current unit [A] of a model."""
    model = MODELS.get(name)
    if model is None:
        raise error(f"{where}: no model {name!r}; {suggest(name, MODELS, 'models')}")
    if model.current_unit is None:
        raise error(f"{where}: a {name} measures no current: palpate cannot tell its torque")
    return model.current_unit
