"""What the drivers of servo buses share: one block read per period, second tries, counted failures, a sure stop."""

from __future__ import annotations

import inspect
import math
import termios
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..arm import Arm, Array
from ..errors import DriverError, InputError
from ..logs import Sample
from ._port import open_port
from .bus import RAD_PER_COUNT, Bus, JointMap, Servo
from .driver import Driver

_TRIES = 5
"""how often one servo is asked or told outside the control loop"""
_ROUNDS = 3
"""how often all are told to switch off, as long as one has not confirmed it"""
_SURE = 2
"""how often a servo is asked alone before its silence counts"""
_CALM = 50
"""periods until a delay of the bus is forgotten"""
_LATEST_NS = 10_000_000
"""a servo that answers so much later than the rest is of another moment [ns]: at 10 rad/s^2 it errs by 0.5 mrad"""


class _NoAnswer(DriverError):
    """A servo does not answer, or not so that it can be understood."""


class Reading(NamedTuple):
    """What one servo says of itself."""

    position: float
    """[counts]"""
    speed: float
    """of the horn [rad/s]"""
    current: float
    """[A]"""

    def before(self, duration: float) -> Reading:
        """Where it was `duration` [s] ago, by its speed."""
        return self._replace(position=self.position - self.speed * duration / RAD_PER_COUNT)


@dataclass(frozen=True, slots=True)
class BusStatistics:
    """What happened on the bus since connect()."""

    periods: int = 0
    """read() calls"""
    lost: int = 0
    """periods without a sample"""
    corrupt: int = 0
    """answers that were damaged, too short, implausible or from a servo that was not asked"""
    unanswered: int = 0
    """questions to one servo that got no answer at all"""
    repeated: int = 0
    """servos that had to be asked again within a period"""
    late: int = 0
    """periods that were skipped because the one before took too long"""


class ServoDriver(Driver):
    """An arm of bus servos.

    A period is one question to all servos and their answers, in the order of the bus. Answers that are damaged are
    thrown away and those servos asked once more, their positions taken back to the moment of the rest by their speeds;
    where one does not answer then, or too late for that, the sample is lost: read() returns None and
    :attr:`statistics` counts it. A servo that is asked alone is waited for as long as the bus needed of late; as soon
    as a second one is silent too, for 10 ms.

    A servo is dead that leaves the question to all and two to itself without any answer while another servo answers a
    later question: a bus keeps the order, so the line is well, and no delay of this computer looks like that. So is
    one without a good answer for `patience` periods in a row. Either is a DriverError with its id, and the drives are
    stopped.

    The time of a sample is that of the question and half of what the answers usually take, however late a busy computer
    looks at them. The effort of a sample is the mean of its period: what flowed at the sample before until the command
    was sent, what flows now from then on, however late it was sent. Velocity is in the samples if the arm's card states
    its deviation for every joint; servos filter it.

    Args:
        arm: the arm.
        port: serial port, e.g. /dev/ttyUSB0.
        bus: its servos; None: :meth:`Bus.of` the arm.
        rate: of the control loop [Hz].
        patience: periods.

    Raises:
        InputError: bus and arm do not fit, or a number is out of range.
        MissingExtraError: the SDK is not installed.
    """

    effort_of_period = True

    _block: tuple[int, int]
    """address and length [bytes] of what is read in every period"""
    _model_number: int
    _torque_enable: int
    """addresses"""
    _goal: int
    """address of the two bytes that are commanded in every period"""
    _id_at: int
    _error_at: int
    """places in an answer; what was asked for follows the error"""
    _trailer: int
    """bytes behind that"""

    def __init__(
        self,
        arm: Arm,
        port: str,
        *,
        sdk: Any,
        protocol: float,
        bus: Bus | None = None,
        rate: float = 250.0,
        patience: int = 2,
    ) -> None:
        if not 1.0 <= rate <= 1000.0:
            raise InputError(f"rate must be from 1 to 1000 Hz, got {rate!r}")
        if patience < 1:
            raise InputError(f"patience must be at least 1 period, got {patience!r}")
        bus = bus or Bus.of(arm)
        self._map = JointMap(arm, bus, self._hint)
        super().__init__(arm.joint_names, round(1e9 / rate), self._map.effort)
        self._servos: tuple[Servo, ...] = bus.servos
        self._ids = [s.id for s in bus.servos]
        self._path, self._baud, self._patience = port, bus.baud, int(patience)
        self._bus_limits = self._map.current_limits(arm)
        self._measures_velocity = all(j.sensing.velocity_std is not None for j in arm.joints)
        self._sdk = sdk
        self._packets = sdk.PacketHandler(protocol)
        self._port: Any = None
        self._doubts: dict[int, str] = {}
        self._complaints: dict[int, int] = {}
        self._forget()

    def _forget(self) -> None:
        """Begin as if nothing had happened on the bus."""
        self._statistics = BusStatistics()
        self._silent = dict.fromkeys(self._ids, 0)
        self._timed_out = self._unsettled = False
        self._delay_ms = self._usual_ns = math.inf
        self._sample: tuple[int, Array] | None = None
        self._sent_ns = 0
        self._complaints.clear()
        self._doubts.clear()

    @property
    def statistics(self) -> BusStatistics:
        """What happened on the bus since connect()."""
        return self._statistics

    @property
    def bus(self) -> tuple[Servo, ...]:
        """The servos, in the order of the bus file."""
        return self._servos

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the effort of this arm is not its torque, one sentence per servo; empty: it is. Once connected."""
        return tuple(self._doubts.values())

    @property
    @abstractmethod
    def resolution(self) -> tuple[Array, Array]:
        """Steps of position [rad] and of reported torque [N m] of the joints, (n,) each; once connected."""

    # --- the verbs ------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        self._port = open_port(self._sdk.PortHandler, self._path, self._baud)
        self._receive = _receiver(self._packets, self._port)
        address, length = self._block
        self._answer_length = self._error_at + 1 + length + self._trailer
        self._everybody = self._sdk.GroupSyncRead(self._port, self._packets, address, length)
        for servo in self._ids:
            self._everybody.addParam(servo)
        self._goals = self._sdk.GroupSyncWrite(self._port, self._packets, self._goal, 2)
        self._enables = self._sdk.GroupSyncWrite(self._port, self._packets, self._torque_enable, 1)
        self._forget()
        self._start = self._due = self._heard_ns = time.monotonic_ns()
        try:
            self._find_servos()
            self._prepare()
            self._disable()
        except BaseException:
            self._close()
            raise
        self._due = time.monotonic_ns() - self._period_ns

    def _close(self) -> None:
        port, self._port = self._port, None
        if port is None:
            return
        try:
            port.closePort()
        except (OSError, termios.error) as error:
            raise DriverError(f"{self._path}: cannot be closed: {_words(error)}") from None

    def _enable(self) -> None:
        for i in range(len(self._servos)):
            self._switch_on(i)
        self._due = time.monotonic_ns() - self._period_ns  # the loop was not late: it has not begun

    def _disable(self) -> None:
        """Goal zero and torque off: to all at once, then to each until it confirms; a dead one holds up nobody."""
        on, failed = list(self._servos), list[str]()
        for _ in range(_ROUNDS):
            failed.clear()
            try:
                self._send(self._goals, [(0, 0)] * len(self._ids))
                self._send(self._enables, [(0,)] * len(self._ids))
            except DriverError as error:
                failed.append(str(error))
            asked, on = on, []
            for servo in asked:
                try:
                    # switching off must work in any state: what the servo complains of does not matter
                    self._tell(servo.id, self._torque_enable, 1, 0, tries=1)
                except DriverError as error:
                    on.append(servo)
                    failed.append(str(error))
            if not on:
                return
        raise DriverError("; ".join(dict.fromkeys(failed)))

    def _read(self) -> Sample | None:
        if self._unsettled:
            self._unsettled = False
            self._settle()
        self._wait()
        begin, behind = time.monotonic_ns(), 0
        with self._talking():
            self._everybody.txPacket()
            found = self._collect(self._ids)
            took = self._heard_ns - begin
            self._unsettled = self._timed_out
            if not self._timed_out:
                self._learn_delay(1e-6 * took)
            self._hear_complaints(found)
            again = [i for i in self._ids if i not in found]
            if not again:
                self._usual_ns = min(took, self._usual_ns * (1.0 + 1.0 / _CALM))
            middle = begin + round(0.5 * min(took, self._usual_ns))
            if again:
                found |= self._ask_again(again, sorted(found), middle)
                behind = self._heard_ns - middle
            self._count(periods=1, repeated=len(again))
        for servo in self._ids:
            self._silent[servo] = 0 if servo in found else self._silent[servo] + 1
        dead = [s for s in self._servos if self._silent[s.id] >= self._patience]
        if dead:
            raise DriverError(self._obituary(dead))
        if len(found) < len(self._ids) or len(again) == len(self._ids) or behind > _LATEST_NS:
            self._count(lost=1)
            return None
        position, speed, current = np.array([found[i] for i in self._ids]).T
        velocity = self._map.velocity(speed) if self._measures_velocity else None
        effort = self._map.effort_of(self._mean_current(middle, current))
        return Sample(middle - self._start, self._map.position(position), velocity, effort)

    def _mean_current(self, now: int, current: Array) -> Array:
        """(S,) of the period that ends now [ns], in which a command took the place of the one before."""
        last, self._sample = self._sample, (now, current)
        if last is None or not last[0] < self._sent_ns < now:
            return current
        before = (self._sent_ns - last[0]) / (now - last[0])
        return before * last[1] + (1.0 - before) * current

    # --- the bus --------------------------------------------------------------------------------------------

    def _count(self, **more: int) -> None:
        now = self._statistics
        self._statistics = replace(now, **{k: getattr(now, k) + v for k, v in more.items()})

    def _wait(self) -> None:
        """Until the next period begins; those that have passed already are skipped and counted."""
        self._due += self._period_ns
        rest = self._due - time.monotonic_ns()
        if rest > 0:
            time.sleep(rest * 1e-9)
        elif rest < -self._period_ns:
            skipped = -rest // self._period_ns
            self._due += skipped * self._period_ns
            if self._statistics.periods:
                self._count(late=skipped)

    @contextmanager
    def _talking(self) -> Iterator[None]:
        # an exchange that was broken off leaves the SDK's port busy for ever, and stop() unsent
        self._port.is_using = False
        try:
            yield
        except (OSError, termios.error) as error:
            raise DriverError(f"{self._path}: the connection is gone: {_words(error)}") from None

    def _learn_delay(self, took_ms: float) -> None:
        """What the bus needs beyond the bytes' time on the wire [ms]: the longest of late."""
        count = len(self._ids)
        delay = took_ms - self._port.tx_time_per_byte * (14 + count + count * self._answer_length)
        self._delay_ms = max(delay, min(self._delay_ms, self._port.grace_ms) * (1.0 - 1.0 / _CALM))

    def _ask_again(self, again: Sequence[int], well: Sequence[int], middle: int) -> dict[int, Reading]:
        """The servos that gave no good answer to the question to all, one by one; positions as of `middle` [ns].

        Raises:
            DriverError: one is dead.
        """
        found: dict[int, Reading] = {}
        queue = deque(again)
        out: list[int] = []  # asked, and not a byte heard since
        patient = ended = False
        while queue:
            servo = queue.popleft()
            unread = self._port.unread
            self._packets.readTx(self._port, servo, *self._block)
            if not patient:
                self._hurry()
            if self._port.unread > unread:
                out.clear()  # late answers, whoever's, were thrown away before the question
            out.append(servo)
            only = out.count(servo) == 1  # what it answers is this question, not one before
            answers = self._collect(out)
            self._hear_complaints(answers)
            found |= {i: r.before(1e-9 * (self._heard_ns - middle)) for i, r in answers.items()}
            # what was damaged may have been anybody's answer
            out = [i for i in out if i not in answers] if answers or self._timed_out else []
            if servo not in answers:
                self._unsettled = True
                self._count(unanswered=1)
                # a second silent one: the line may be late, and more questions would make it later
                patient = patient or len(set(out)) > 1
                if 0 < out.count(servo) < _SURE:
                    queue.appendleft(servo)
            elif out and only:
                dead = [s for s in self._servos if out.count(s.id) >= _SURE]
                if dead:
                    raise DriverError(
                        f"{self._path}: {_names(dead)} did not answer {_SURE + 1} times, and then servo {servo} did"
                    )
                queue.extendleft(i for i in dict.fromkeys(out) if i not in queue)
            if out and not queue and not ended:
                # one that is well shows whether the line is
                queue.extend([*[*well, *found][:1], *(() if patient else again)])
                patient = ended = True
        return {i: reading for i, reading in found.items() if i in again}

    def _hurry(self) -> None:
        """Wait for the answer just asked for no longer than the bus needed of late."""
        self._port.packet_timeout += min(max(1.25 * self._delay_ms, 1.0) - self._port.grace_ms, 0.0)

    def _collect(self, wanted: Sequence[int]) -> dict[int, Reading]:
        """The good answers to a question, by id. They come in the order of `wanted`: none follows the last one's."""
        found: dict[int, Reading] = {}
        self._timed_out = False
        for left in range(len(wanted) - 1, -1, -1):
            packet, result = self._receive()
            if result == self._sdk.COMM_RX_TIMEOUT:
                self._timed_out = True
                break
            self._port.expect(
                min(left, 2) * self._answer_length
            )  # the next one may be damaged, and be passed over
            servo, reading = -1, None
            if result == self._sdk.COMM_SUCCESS:
                servo = packet[self._id_at]
                if servo in wanted and self._length(packet) == self._block[1] + self._trailer:
                    first = self._error_at + 1
                    reading = self._decode(servo, bytes(packet[first : first + self._block[1]]))
            if reading is None:
                self._count(corrupt=1)
            else:
                found[servo] = reading
                if packet[self._error_at]:
                    self._complaints[servo] = packet[self._error_at]
                self._heard_ns = time.monotonic_ns()
            if servo == wanted[-1]:
                break
        return found

    def _hear_complaints(self, found: dict[int, Reading]) -> None:
        """Raise if a servo is not well; answers that only seem to say so are taken out of `found`."""
        while self._complaints:
            servo, error = self._complaints.popitem()
            self._judge(servo, error)
            self._count(corrupt=1)
            found.pop(servo, None)

    def _settle(self) -> None:
        """Let answers that are late come, and throw them away: they must not pass for answers to the next question."""
        with self._talking():
            time.sleep(1e-3 * self._port.grace_ms)
            self._port.clearPort()

    def _find_servos(self) -> None:
        """Every servo is there and is of a known model."""
        missing, there = [], []
        for i, servo in enumerate(self._servos):
            try:
                number = self._ask(servo.id, self._model_number, 2)
            except _NoAnswer:
                missing.append(servo)
            else:
                self._meet(i, number)
                there.append(servo.id)
        if missing:
            raise DriverError(
                f"{self._path}: {_names(missing)} {'does' if len(missing) == 1 else 'do'} not answer at {self._baud} "
                f"bit/s; "
                + (
                    f"those that do: {', '.join(map(str, there))}"
                    if there
                    else "no servo does: check power, cable, ids and baud rate"
                )
            )

    def _ask(self, servo: int, address: int, size: int) -> int:
        """One register, little-endian.

        Raises:
            DriverError: no good answer, or the servo is not well.
        """
        why = ""
        for _ in range(_TRIES):
            with self._talking():
                data, result, error = self._packets.readTxRx(self._port, servo, address, size)
            if result == self._sdk.COMM_SUCCESS and len(data) == size:
                self._judge(servo, error)
                return int.from_bytes(bytes(data), "little")
            why = self._packets.getTxRxResult(result)
            self._settle()
        raise _NoAnswer(f"{self._who(servo)}: register {address} cannot be read: {why}")

    def _tell(self, servo: int, address: int, size: int, value: int, *, tries: int = _TRIES) -> None:
        """Write one register and wait until the servo confirms it.

        Raises:
            DriverError: no confirmation, or a refusal.
        """
        why = ""
        for _ in range(tries):
            with self._talking():
                result, error = self._packets.writeTxRx(
                    self._port, servo, address, size, list(value.to_bytes(size, "little"))
                )
            if result == self._sdk.COMM_SUCCESS:
                self._check_refusal(servo, address, value, error)
                return
            why = self._packets.getTxRxResult(result)
            self._settle()
        raise _NoAnswer(f"{self._who(servo)}: register {address} cannot be written: {why}")

    def _send(self, group: Any, values: Sequence[tuple[int, ...]]) -> None:
        """Bytes to all servos at once; none of them answers."""
        group.clearParam()
        for servo, value in zip(self._ids, values, strict=True):
            group.addParam(servo, list(value))
        with self._talking():
            result = group.txPacket()
        self._sent_ns = time.monotonic_ns()
        if result != self._sdk.COMM_SUCCESS:
            raise DriverError(f"{self._path}: cannot be written: {self._packets.getTxRxResult(result)}")

    def _who(self, servo: int) -> str:
        return _names([s for s in self._servos if s.id == servo])

    def _obituary(self, dead: Sequence[Servo]) -> str:
        periods = "" if self._patience == 1 else f" {self._patience} periods in a row"
        if len(dead) == len(self._servos) > 1:
            return f"{self._path}: no servo answers{periods}: power or cable?"
        return f"{self._path}: {_names(dead)} gave no good answer{periods}"

    # --- what each make does its own way --------------------------------------------------------------------

    @staticmethod
    @abstractmethod
    def _hint(servo: Servo) -> str:
        """How the bus file names a torque constant, with a first guess where its maker states one."""

    @staticmethod
    @abstractmethod
    def _length(packet: Sequence[int]) -> int:
        """What the answer says of its own length behind the error byte."""

    @abstractmethod
    def _meet(self, index: int, number: int) -> None:
        """A servo says its model number."""

    @abstractmethod
    def _prepare(self) -> None:
        """All servos are there: learn what must be known of them."""

    @abstractmethod
    def _decode(self, servo: int, data: bytes) -> Reading | None:
        """What a block says; None: no servo can mean that."""

    @abstractmethod
    def _judge(self, servo: int, error: int) -> None:
        """Raise DriverError if the servo is not well, as an error in an answer says; asks it if that is in doubt."""

    @abstractmethod
    def _check_refusal(self, servo: int, address: int, value: int, error: int) -> None:
        """Raise DriverError if the answer to a write says that it was refused."""

    @abstractmethod
    def _switch_on(self, index: int) -> None:
        """Torque on, at the safe command."""


def _receiver(packets: Any, port: Any) -> Callable[[], tuple[list[int], int]]:
    """The SDK's function that receives one packet; some versions want to know whether a fast read was asked."""
    fast = [False] if "fast_option" in inspect.signature(packets.rxPacket).parameters else []
    return lambda: packets.rxPacket(port, *fast)


def _names(servos: Sequence[Servo]) -> str:
    kind = "servo" if len(servos) == 1 else "servos"
    return f"{kind} " + ", ".join(f"{s.id} (joint {s.joint})" for s in servos)


def _words(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
