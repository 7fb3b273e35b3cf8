"""Messages between two processes over UDP: encrypted, authenticated, numbered, with the clocks compared.

A packet is a header in the clear and a body sealed with ChaCha20-Poly1305 (RFC 8439), whose tag covers both::

    "PT"  version u8  role u8 | salt 8 bytes | session u64 | sequence u64 | sealed body | tag 16 bytes
    body: echo 8 bytes | time i64 | echo_time i64 | echo_age i64 | n u8 | flags u8 | shown u16
          | energy, booked, level f64 | 3 n f64 | reason

The key of a direction in a run is HKDF-SHA256(shared key, salt, role), so a sequence number, which is the nonce,
never meets a key
twice. ``echo`` is the salt that was heard from the other side: a packet that does not echo the salt of *this* run
is a greeting and carries
no motion, so what was recorded in an earlier run cannot be played back. Within a run a window refuses what came before.
"""

from __future__ import annotations

import heapq
import math
import os
import secrets
import socket
import stat
import struct
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from ..arm import Array
from ..errors import InputError, MissingExtraError, PalpateError

VERSION = 3
"""of the packets; a side with another one is refused"""
MAX_CLOCK_OFFSET = 30.0
"""clocks further apart than this are refused [s]: the recording of both sides would make no sense"""
WINDOW = 1024
"""how far behind the newest a number may be to be taken"""

Role: TypeAlias = Literal["master", "slave"]

_HEADER = struct.Struct(">2sBB8sQQ")
_BODY = struct.Struct(">8sqqqBBHddd")
_TAG = 16
_NOBODY = bytes(8)
_SILENCE_NS = 1_000_000_000
_MOST_AXES = 16
_MOST_WORDS = 120
LONGEST = _HEADER.size + _BODY.size + 24 * _MOST_AXES + _MOST_WORDS + _TAG
"""[byte]"""


class ChannelError(PalpateError):
    """A key cannot be read, a socket cannot be opened, or the other side must be refused."""


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What one side tells the other; the master's axes and scale. See ``palpate/teleop/message.hpp``."""

    session: int
    """of the sender: the time it was started [ns]"""
    sequence: int
    """counts up from 1 within a session"""
    time_ns: int
    """sender's clock [ns]"""
    position: Array
    """(n,) [m] or [rad]"""
    velocity: Array
    """(n,) [m/s] or [rad/s]"""
    force: Array
    """(n,) [N] or [N m]"""
    energy: float
    """sent since the session began [J]"""
    booked: float
    """of what the other side has sent: the rest is still on its way [J]"""
    level: float
    """of the sender's tank [J]"""
    engaged: bool
    """the sender wants to be coupled"""
    reason: str = ""
    """what holds the sender or slows it down, for people; cut at 120 bytes"""
    shown: int = 0xFFFF
    """bit i: the sender's axis i has a motor"""


# --- keys -------------------------------------------------------------------------------------------------------------


def make_key(path: str | os.PathLike[str]) -> Path:
    """Write a new shared key, readable by its owner alone; copy the file to the other machine by a safe way.

    Raises:
        ChannelError: the file is there already, or cannot be written.
    """
    target = Path(path)
    try:
        handle = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        raise ChannelError(f"{target} is there: a key is never overwritten; choose another name") from None
    except OSError as error:
        raise ChannelError(f"{target}: cannot be written: {error.strerror or error}") from None
    with os.fdopen(handle, "w", encoding="ascii") as out:
        out.write(secrets.token_hex(32) + "\n")
    return target


def read_key(path: str | os.PathLike[str]) -> bytes:
    """The shared key of a file.

    Raises:
        ChannelError: others may read the file, or it holds no key.
    """
    target = Path(path)
    try:
        mode = target.stat().st_mode
        text = target.read_text(encoding="ascii").strip()
    except OSError as error:
        raise ChannelError(
            f"{target}: cannot be read: {error.strerror or error}; palpate teleop key FILE makes one"
        ) from None
    except UnicodeDecodeError:
        text = ""
    if stat.S_IMODE(mode) & 0o077:
        raise ChannelError(
            f"{target}: others may read this key (mode {stat.S_IMODE(mode):04o}): chmod 600 {target}, or make a new one"
        )
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ChannelError(
            f"{target}: expected a key of 64 hexadecimal digits; palpate teleop key FILE makes one"
        )
    return key


# --- packets ----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Clock:
    """The other side's clock against ours, from packets that went there and back (D. L. Mills, RFC 5905)."""

    offset: float = math.nan
    """theirs less ours [s]; NaN: not known yet"""
    round_trip: float = math.nan
    """of the packet the offset is taken from, the quickest of late [s]: the offset is known to half of it"""
    last_round_trip: float = math.nan
    """of the newest packet [s]"""
    _recent: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=256))

    def take(self, sent: int, heard: int, answered: int, received: int) -> None:
        """Our clock at sending, theirs at hearing and answering, ours at receiving [ns]."""
        trip = ((received - sent) - (answered - heard)) * 1e-9
        if trip < 0.0:
            return
        offset = ((heard - sent) + (answered - received)) * 0.5e-9
        self.last_round_trip = trip
        self._recent.append((trip, offset))
        self.round_trip, self.offset = min(self._recent)


class Sealer:
    """Messages to packets and back; no sockets, no clock of its own.

    Args:
        key: the shared key, 32 bytes.
        role: which side this is.
        session: number of this run, larger than of any earlier: the time it began [ns].
        n: axes, 1 to 16.
        salt: 8 random bytes of this run; None: new ones.

    Raises:
        InputError: the key or the number of axes is wrong.
        MissingExtraError: cryptography is not installed.
    """

    def __init__(self, key: bytes, role: Role, session: int, n: int, *, salt: bytes | None = None) -> None:
        if len(key) != 32:
            raise InputError(f"key: expected 32 bytes, got {len(key)}")
        if role not in ("master", "slave"):
            raise InputError(f"role must be master or slave, got {role!r}")
        if not 1 <= n <= _MOST_AXES:
            raise InputError(f"n must be 1 to {_MOST_AXES} axes, got {n!r}")
        self.role: Role = role
        self.session, self.n = session, n
        self.salt = secrets.token_bytes(8) if salt is None else salt
        self._shared = key
        self._out = _cipher(key, self.salt, role)
        self._sent = 0
        self._echo = _NOBODY
        self._peer_salt = _NOBODY
        self._peer_session = 0
        self._ciphers: dict[bytes, Any] = {}
        self._newest, self._seen = 0, 0
        self._first, self._taken = 1, 0
        self._heard: tuple[int, int] | None = None
        self.clock = Clock()
        self.refused: Counter[str] = Counter()
        """packets that were not taken, by reason"""
        self.reason = ""
        """why the last packet was refused, one line for people"""

    @property
    def met(self) -> bool:
        """The other side has answered this very run."""
        return self._heard is not None

    def seal(self, message: Message, now_ns: int) -> bytes:
        """A packet; the message's sequence must be larger than that of the one before.

        Raises:
            InputError: it is not, or the number of axes is wrong.
        """
        if message.sequence <= self._sent:
            raise InputError(f"sequence {message.sequence} after {self._sent}: a number is never used twice")
        self._sent = message.sequence
        echo_time, echo_age = (self._heard[0], now_ns - self._heard[1]) if self._heard else (0, -1)
        rows = np.concatenate((message.position, message.velocity, message.force)).astype(">f8")
        if rows.shape != (3 * self.n,):
            raise InputError(f"message: expected {self.n} axes, got {len(rows)} numbers in all")
        body = _BODY.pack(
            self._echo,
            now_ns,
            echo_time,
            echo_age,
            self.n,
            int(message.engaged),
            message.shown,
            message.energy,
            message.booked,
            message.level,
        )
        header = _HEADER.pack(b"PT", VERSION, _number(self.role), self.salt, self.session, message.sequence)
        body += rows.tobytes() + message.reason.encode()[:_MOST_WORDS]
        return header + self._out.encrypt(_nonce(message.sequence), body, header)

    def open(self, packet: bytes, now_ns: int) -> Message | None:
        """The message of a packet that came; None if it is refused (see :attr:`refused`) or a greeting."""
        if len(packet) < _HEADER.size + _TAG or packet[:2] != b"PT" or len(packet) > LONGEST:
            return self._refused("not ours", f"{len(packet)} bytes that are no packet of palpate")
        header = packet[: _HEADER.size]
        _, version, role, salt, session, sequence = _HEADER.unpack(header)
        if version != VERSION:
            return self._refused(
                "version",
                f"the other side speaks protocol version {version}, this one {VERSION}: install the same palpate on "
                "both",
            )
        if role == _number(self.role):
            return self._refused("role", f"both sides say they are the {self.role}")
        if session < self._peer_session:
            return self._refused("replayed", "of an earlier run: replayed, or very late")
        cipher = self._cipher(salt)
        try:
            body = cipher.decrypt(_nonce(sequence), packet[_HEADER.size :], header)
        except _invalid_tag():
            return self._refused(
                "forged", "another key, or changed on the way: the two sides need the same key file"
            )
        if len(body) < _BODY.size:
            return self._refused("length", f"a body of {len(body)} bytes")
        echo, sent_ns, echo_time, echo_age, n, flags, shown, energy, booked, level = _BODY.unpack(
            body[: _BODY.size]
        )
        end = _BODY.size + 24 * n
        if n != self.n or not end <= len(body) <= end + _MOST_WORDS:
            return self._refused("axes", f"the other side has {n} axes, this one {self.n}")
        if echo != self.salt:
            # Whoever is there now will hear our salt and echo it; what was recorded never will. A live side is not
            # left for it.
            if self._heard is None or now_ns - self._heard[1] > _SILENCE_NS:
                self._echo = salt
            return self._refused("greeting", "a greeting, or of an earlier run: it does not know this one")
        if salt != self._peer_salt:
            self._peer_salt, self._peer_session, self._echo = salt, session, salt
            self._newest, self._seen, self._heard = 0, 0, None
            self._first, self._taken = sequence, 0
            self.clock = Clock()
        if not self._fresh(sequence):
            return self._refused(
                "replayed", f"number {sequence} has come before, or is far behind: replayed or repeated"
            )
        self._taken += 1
        if echo_age >= 0:
            self.clock.take(echo_time, sent_ns - echo_age, sent_ns, now_ns)
        self._heard = (sent_ns, now_ns)
        if not abs(self.clock.offset) <= MAX_CLOCK_OFFSET and not math.isnan(self.clock.offset):
            return self._refused(
                "clocks",
                f"the clocks differ by {self.clock.offset:+.0f} s: set them (chrony, NTP); at most "
                f"{MAX_CLOCK_OFFSET:g} s are allowed",
            )
        values = np.frombuffer(body[:end], dtype=">f8", offset=_BODY.size).astype(np.float64)
        if not (np.isfinite(values).all() and all(map(math.isfinite, (energy, booked, level)))):
            return self._refused("not finite", "a number is not finite")
        return Message(
            session,
            sequence,
            sent_ns,
            values[:n],
            values[n : 2 * n],
            values[2 * n :],
            energy,
            booked,
            level,
            bool(flags & 1),
            "".join(c for c in body[end:].decode(errors="ignore") if c.isprintable()),
            shown,
        )

    def _cipher(self, salt: bytes) -> Any:
        """Of what the other side sends in the run with this salt."""
        if salt not in self._ciphers:
            while len(self._ciphers) >= 4:
                self._ciphers.pop(next(k for k in self._ciphers if k != self._peer_salt))
            self._ciphers[salt] = _cipher(self._shared, salt, "slave" if self.role == "master" else "master")
        return self._ciphers[salt]

    def _fresh(self, sequence: int) -> bool:
        """The number has not come before; it is noted."""
        if sequence > self._newest:
            shift = min(sequence - self._newest, WINDOW)
            self._seen = ((self._seen << shift) | 1) & ((1 << WINDOW) - 1)
            self._newest = sequence
            return True
        behind = self._newest - sequence
        if sequence == 0 or behind >= WINDOW or self._seen >> behind & 1:
            return False
        self._seen |= 1 << behind
        return True

    def _refused(self, kind: str, reason: str) -> Message | None:
        """No message, and why."""
        self.refused[kind] += 1
        if kind != "greeting":
            self.reason = reason
        return None

    def lost(self) -> float:
        """Part of the other side's packets of this run that have not come [1]; NaN: it has not been met."""
        if not self._taken:
            return math.nan
        return max(0.0, 1.0 - self._taken / max(1, self._newest - self._first + 1))

    def refusals(self) -> dict[str, int]:
        """Packets that were refused, by reason; greetings are none."""
        return {kind: count for kind, count in self.refused.items() if kind != "greeting"}


def _number(role: Role) -> int:
    return 1 if role == "master" else 2


def _nonce(sequence: int) -> bytes:
    return bytes(4) + sequence.to_bytes(8, "big")


def _cryptography() -> Any:
    try:
        import cryptography.exceptions
        import cryptography.hazmat.primitives.ciphers.aead
        import cryptography.hazmat.primitives.hashes
        import cryptography.hazmat.primitives.kdf.hkdf
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("cryptography"):
            raise
        raise MissingExtraError("teleop", "an encrypted channel") from None
    return cryptography


def _cipher(shared: bytes, salt: bytes, role: Role) -> Any:
    primitives = _cryptography().hazmat.primitives
    kdf = primitives.kdf.hkdf.HKDF(
        algorithm=primitives.hashes.SHA256(),
        length=32,
        salt=salt,
        info=f"palpate teleop {VERSION} {role}".encode(),
    )
    return primitives.ciphers.aead.ChaCha20Poly1305(kdf.derive(shared))


def _invalid_tag() -> Any:
    return _cryptography().exceptions.InvalidTag


# --- a bad network, on purpose ----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Faults:
    """What a network does to packets, one way.

    Raises:
        InputError: a number is out of range.
    """

    delay: float = 0.0
    """[s]"""
    jitter: float = 0.0
    """uniform, on top of the delay; packets overtake one another [s]"""
    loss: float = 0.0
    """probability [1]"""
    reorder: float = 0.0
    """probability that a packet takes no delay at all and overtakes [1]"""
    duplicate: float = 0.0
    """probability that a packet comes twice [1]"""

    def __post_init__(self) -> None:
        for name, most in (
            ("delay", 60.0),
            ("jitter", 60.0),
            ("loss", 1.0),
            ("reorder", 1.0),
            ("duplicate", 1.0),
        ):
            value = getattr(self, name)
            if not 0.0 <= value <= most:
                raise InputError(f"faults: {name} must be 0 to {most:g}, got {value!r}")


class FaultyLine:
    """One direction of a network with faults, in this process; the same seed does the same to the same packets.

    Args:
        faults: what it does.
        seed: of the random numbers.
    """

    def __init__(self, faults: Faults = Faults(), seed: int = 0) -> None:
        self.faults = faults
        self._rng = np.random.default_rng(seed)
        self._way: list[tuple[int, int, bytes]] = []
        self._count = 0
        self.cut = False
        """nothing passes while True"""

    def send(self, packet: bytes, now_ns: int) -> None:
        """Put a packet in."""
        f, rng = self.faults, self._rng
        copies = 2 if rng.random() < f.duplicate else 1
        for _ in range(copies):
            lost, late, hurry = (
                rng.random() < f.loss,
                f.delay + f.jitter * rng.random(),
                rng.random() < f.reorder,
            )
            if lost or self.cut:
                continue
            self._count += 1
            heapq.heappush(self._way, (now_ns + (0 if hurry else round(late * 1e9)), self._count, packet))

    def receive(self, now_ns: int) -> list[bytes]:
        """What has come by now, in order of arrival."""
        found = []
        while self._way and self._way[0][0] <= now_ns:
            packet = heapq.heappop(self._way)[2]
            if not self.cut:
                found.append(packet)
        return found


# --- sockets ----------------------------------------------------------------------------------------------------------


class UdpChannel:
    """One side's socket: :meth:`send` a message, :meth:`receive` what has come; nothing waits.

    Args:
        key: the shared key, see :func:`read_key`.
        role: which side this is.
        n: axes.
        local: address and port to listen at; port 0: any. The default takes packets from this machine alone.
        peer: address and port of the other side; None: whoever sends the first packet with the right key.
        faults: what to do to the packets that are sent, to try a bad network.
        seed: of those faults.
        clock: the time [ns].

    Raises:
        ChannelError: the socket cannot be opened.
    """

    def __init__(
        self,
        key: bytes,
        role: Role,
        n: int,
        *,
        local: tuple[str, int] = ("127.0.0.1", 0),
        peer: tuple[str, int] | None = None,
        faults: Faults | None = None,
        seed: int = 0,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._clock = clock
        self.sealer = Sealer(key, role, clock(), n)
        self._peer = peer
        self._line = None if faults is None else FaultyLine(faults, seed)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(local)
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            raise ChannelError(
                f"{local[0]}:{local[1]}: cannot listen there: {error.strerror or error}"
            ) from None
        self._begin = clock()
        self.sent_bytes = self.received_bytes = 0

    @property
    def address(self) -> tuple[str, int]:
        """Where this side listens."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def session(self) -> int:
        """Number of this run."""
        return self.sealer.session

    def send(self, message: Message) -> None:
        """Send it; nobody there to take it is no error, silence is noticed by the other side."""
        now = self._clock()
        packet = self.sealer.seal(message, now)
        if self._line is None:
            self._put(packet)
            return
        self._line.send(packet, now)
        self.flush()

    def flush(self) -> None:
        """Send what the fault layer has held back long enough."""
        for packet in [] if self._line is None else self._line.receive(self._clock()):
            self._put(packet)

    def _put(self, packet: bytes) -> None:
        if self._peer is None:
            return
        try:
            self._socket.sendto(packet, self._peer)
            self.sent_bytes += len(packet) + 28  # with the headers of IP and UDP
        except (BlockingIOError, ConnectionRefusedError):
            pass
        except OSError as error:
            raise ChannelError(
                f"{self._peer[0]}:{self._peer[1]}: cannot be sent to: {error.strerror or error}"
            ) from None

    def receive(self) -> list[Message]:
        """All messages that have come since the last call, in order of arrival."""
        found: list[Message] = []
        self.flush()
        while True:
            try:
                packet, sender = self._socket.recvfrom(2 * LONGEST)
            except (BlockingIOError, ConnectionRefusedError):
                return found
            self.received_bytes += len(packet) + 28
            before = self.sealer.refused["forged"] + self.sealer.refused["not ours"]
            message = self.sealer.open(packet, self._clock())
            if (
                self._peer is None
                and self.sealer.refused["forged"] + self.sealer.refused["not ours"] == before
            ):
                self._peer = (str(sender[0]), int(sender[1]))
            if message is not None:
                found.append(message)

    def bandwidth(self) -> tuple[float, float]:
        """Sent and received [bit/s], headers of IP and UDP included, mean since the start."""
        seconds = max(1e-9, (self._clock() - self._begin) * 1e-9)
        return 8.0 * self.sent_bytes / seconds, 8.0 * self.received_bytes / seconds

    def close(self) -> None:
        """Let go of the socket. Again is harmless."""
        self._socket.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
