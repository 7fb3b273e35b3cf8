"""The channel: what is refused and why, clocks, a bad network, two real sockets, two real processes."""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("cryptography", reason="palpate[teleop] is not installed")

from palpate.errors import InputError
from palpate.teleop import ChannelError, Faults, FaultyLine, Message, Sealer, UdpChannel, make_key, read_key
from palpate.teleop import channel as module

KEY = bytes(range(32))
MS = 1_000_000


def message(sequence: int, session: int = 1, n: int = 3, value: float = 0.5) -> Message:
    return Message(
        session, sequence, 0, np.full(n, value), np.zeros(n), np.full(n, -value), 0.1, 0.15, 0.2, True
    )


class Two:
    """Master and slave on a perfect line, clocks of their own."""

    def __init__(self, key: bytes = KEY, ahead_ns: int = 0, n: int = 3) -> None:
        self.master = Sealer(KEY, "master", 100, n, salt=b"masterrr")
        self.slave = Sealer(key, "slave", 200, n, salt=b"slaveeee")
        self.now, self.ahead, self.count = 10**18, ahead_ns, 0

    def exchange(self, times: int = 1, way_ns: int = 2 * MS) -> list[Message | None]:
        found: list[Message | None] = []
        for _ in range(times):
            self.count += 1
            packet = self.master.seal(message(self.count), self.now)
            self.now += way_ns
            found.append(self.slave.open(packet, self.now + self.ahead))
            packet = self.slave.seal(message(self.count), self.now + self.ahead)
            self.now += way_ns
            found.append(self.master.open(packet, self.now))
        return found


def test_the_two_meet_and_every_number_arrives_bit_for_bit() -> None:
    two = Two()
    assert two.exchange(2)[-1] is not None
    got = two.exchange()[0]
    assert got is not None and got.sequence == 3 and got.session == 100 and got.engaged
    assert np.array_equal(got.position, np.full(3, 0.5)) and np.array_equal(got.force, np.full(3, -0.5))
    assert (got.energy, got.booked, got.level) == (0.1, 0.15, 0.2)
    assert not two.master.refusals() and not two.slave.refusals()


@pytest.mark.parametrize("ahead", [-5.0, -0.1, 0.0, 0.0123, 20.0])
def test_the_clocks_offset_is_known_to_half_the_round_trip(ahead: float) -> None:
    two = Two(ahead_ns=round(ahead * 1e9))
    rng = np.random.default_rng(1)
    for _ in range(50):
        two.exchange(1, int(rng.uniform(1, 20)) * MS)
    clock = two.master.clock
    assert abs(clock.offset - ahead) <= 0.5 * clock.round_trip + 1e-9
    assert clock.round_trip <= 0.041
    assert abs(two.slave.clock.offset + ahead) <= 0.5 * two.slave.clock.round_trip + 1e-9


@pytest.mark.parametrize("ahead", [-120.0, 45.0, 3600.0])
def test_clocks_minutes_apart_are_refused_with_the_reason(ahead: float) -> None:
    two = Two(ahead_ns=round(ahead * 1e9))
    assert all(m is None for m in two.exchange(10)[4:])
    assert two.master.refusals()["clocks"] > 0
    assert f"differ by {ahead:+.0f} s" in two.master.reason


def test_a_wrong_key_is_refused_with_the_reason() -> None:
    two = Two(key=bytes(32))
    assert two.exchange(5) == [None] * 10
    assert two.master.refusals() == {"forged": 5}
    assert "key" in two.master.reason


def test_another_version_is_refused_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    two = Two()
    two.exchange(3)
    packet = two.master.seal(message(50), two.now)
    assert two.slave.open(packet[:2] + bytes([9]) + packet[3:], two.now) is None
    assert "version 9" in two.slave.reason and two.slave.refusals() == {"version": 1}


def test_both_the_same_role_or_other_axes_are_refused() -> None:
    two, other = Two(), Sealer(KEY, "master", 300, 3)
    assert two.master.open(other.seal(message(1), 0), 0) is None
    assert "both sides" in two.master.reason
    wide = Sealer(KEY, "slave", 300, 6)
    assert two.master.open(wide.seal(message(1, n=6), 0), 0) is None
    assert "6 axes" in two.master.reason


def test_nothing_is_taken_twice() -> None:
    two = Two()
    two.exchange(3)
    packets = [two.master.seal(message(k), two.now) for k in range(10, 30)]
    rng = np.random.default_rng(2)
    taken = [two.slave.open(packets[k], two.now) for k in rng.permutation(np.repeat(np.arange(20), 3))]
    assert sorted(m.sequence for m in taken if m is not None) == list(range(10, 30))
    assert two.slave.refusals()["replayed"] == 40


def test_what_was_recorded_in_an_earlier_run_is_refused_by_the_next() -> None:
    first = Two()
    first.exchange(3)
    recorded = [first.master.seal(message(k), first.now) for k in range(10, 30)]
    slave = Sealer(KEY, "slave", 300, 3)  # started anew, remembers nothing
    assert [slave.open(p, first.now) for p in recorded] == [None] * 20
    assert not slave.met
    # and the real master, started anew, is met all the same
    master = Sealer(KEY, "master", 400, 3)
    for k in range(1, 6):
        got = slave.open(master.seal(message(k), first.now), first.now)
        master.open(slave.seal(message(k), first.now), first.now)
        slave.open(recorded[k], first.now)  # somebody keeps playing the old ones
    assert got is not None and slave.met and master.met


def test_a_side_that_starts_anew_is_met_again_and_a_recorded_greeting_disturbs_nobody() -> None:
    two = Two()
    greeting = two.master.seal(message(1), two.now)
    two.count = 1
    two.exchange(4)
    assert two.slave.open(greeting, two.now) is None
    assert two.exchange(3)[-1] is not None
    two.now += 3_000_000_000
    two.master, two.count = Sealer(KEY, "master", 1000, 3), 10
    assert two.exchange(4)[-2] is not None
    assert two.slave.open(greeting, two.now) is None
    assert two.exchange(2)[-1] is not None


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_no_changed_packet_passes(data: st.DataObject) -> None:
    two = Two()
    two.exchange(2)
    packet = bytearray(two.master.seal(message(5), two.now))
    place = data.draw(st.integers(0, len(packet) - 1))
    change = data.draw(st.integers(1, 255))
    packet[place] ^= change
    assert two.slave.open(bytes(packet), two.now) is None
    cut = data.draw(st.integers(0, len(packet) - 1))
    packet[place] ^= change
    assert two.slave.open(bytes(packet[:cut]), two.now) is None
    assert two.slave.open(bytes(packet), two.now) is not None


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=700), st.booleans())
def test_noise_is_refused(noise: bytes, like_ours: bool) -> None:
    sealer = Sealer(KEY, "slave", 1, 3)
    assert sealer.open(b"PT\x02\x01" + noise if like_ours else noise, 0) is None
    assert sealer.reason


def test_a_number_is_never_sealed_twice() -> None:
    sealer = Sealer(KEY, "slave", 1, 3)
    sealer.seal(message(1), 0)
    with pytest.raises(InputError, match="never used twice"):
        sealer.seal(message(1), 0)
    with pytest.raises(InputError, match="axes"):
        sealer.seal(dataclasses.replace(message(2), position=np.zeros(2)), 0)


def test_keys_are_for_their_owner_alone(tmp_path: Path) -> None:
    path = make_key(tmp_path / "key")
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(read_key(path)) == 32 and read_key(path) != read_key(make_key(tmp_path / "other"))
    with pytest.raises(ChannelError, match="never overwritten"):
        make_key(path)
    path.chmod(0o640)
    with pytest.raises(ChannelError, match="chmod 600"):
        read_key(path)
    path.chmod(0o600)
    path.write_text("nonsense")
    with pytest.raises(ChannelError, match="64 hexadecimal digits"):
        read_key(path)
    with pytest.raises(ChannelError, match="cannot be read"):
        read_key(tmp_path / "none")


def test_a_faulty_line_does_what_it_is_told() -> None:
    line = FaultyLine(Faults(delay=0.1, jitter=0.05, loss=0.2, reorder=0.01, duplicate=0.1), 3)
    sent, found = 5000, []
    for k in range(sent + 200):
        if k < sent:
            line.send(k.to_bytes(4, "big"), k * MS)
        found += [(k, int.from_bytes(p, "big")) for p in line.receive(k * MS)]
    late = np.array([k - p for k, p in found])
    assert np.count_nonzero(late == 0) == pytest.approx(0.01 * len(late), rel=0.4)
    assert late[late > 0].min() >= 100 and late.max() <= 151
    assert len(found) == pytest.approx(0.8 * 1.1 * sent, rel=0.05)
    assert any(a > b for (_, a), (_, b) in itertools.pairwise(found))
    line.cut = True
    line.send(b"x", 0)
    assert line.receive(10**12) == []
    with pytest.raises(InputError, match="loss"):
        Faults(loss=1.5)


def wait_for(what: object, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not what():  # type: ignore[operator]
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.001)


def test_two_sockets_meet_on_this_machine() -> None:
    with UdpChannel(KEY, "slave", 3) as slave, UdpChannel(KEY, "master", 3, peer=slave.address) as master:
        assert slave.address[0] == "127.0.0.1"
        got: list[Message] = []
        count = 0

        def round_trip() -> bool:
            nonlocal count
            count += 1
            master.send(message(count))
            got.extend(slave.receive())
            slave.send(message(count))
            master.receive()
            return len(got) >= 20

        wait_for(round_trip)
        assert [m.sequence for m in got] == sorted({m.sequence for m in got})
        assert abs(slave.sealer.clock.offset) < 1.0
        assert master.bandwidth()[0] > 0.0
        with pytest.raises(ChannelError, match="cannot listen"):
            UdpChannel(KEY, "slave", 3, local=slave.address)


OTHER = """
import sys, time
import numpy as np
from palpate.teleop import Message, UdpChannel
port = int(sys.argv[1])
with UdpChannel(bytes(range(32)), "master", 3, peer=("127.0.0.1", port)) as channel:
    end, count, heard = time.monotonic() + 60.0, 0, 0
    while heard < 50 and time.monotonic() < end:
        count += 1
        nothing = np.zeros(3)
        channel.send(Message(channel.session, count, 0, np.full(3, count), nothing, nothing, 0.0, 0.0, 0.0, True))
        heard += len(channel.receive())
        time.sleep(0.001)
print(heard)
"""


def test_two_processes_meet() -> None:
    with UdpChannel(KEY, "slave", 3) as slave:
        other = subprocess.Popen(
            [sys.executable, "-c", OTHER, str(slave.address[1])], stdout=subprocess.PIPE, text=True
        )
        count = 0
        try:
            while other.poll() is None:
                count += 1
                slave.receive()
                slave.send(message(count))
                time.sleep(0.001)
        finally:
            other.kill()
        assert other.stdout is not None and int(other.stdout.read()) >= 50
        assert slave.sealer.met and not slave.sealer.refusals()


def test_the_packet_says_what_the_module_says() -> None:
    packet = Sealer(KEY, "slave", 1, 3).seal(message(1), 0)
    assert packet[:4] == b"PT\x03\x02" and len(packet) == 28 + 60 + 72 + 16
    assert module.LONGEST >= len(Sealer(KEY, "slave", 1, 16).seal(message(1, n=16), 0))


UNDER_NETEM = """
import time
import numpy as np
from palpate.teleop import Message, UdpChannel
key = bytes(range(32))
with UdpChannel(key, "slave", 3) as slave, UdpChannel(key, "master", 3, peer=slave.address) as master:
    end, count, heard = time.monotonic() + 60.0, 0, 0
    while heard < 100 and time.monotonic() < end:
        count += 1
        for side in (master, slave):
            nothing = np.zeros(3)
            side.send(Message(side.session, count, 0, nothing, nothing, nothing, 0.0, 0.0, 0.0, True))
        heard += len(slave.receive())
        master.receive()
        time.sleep(0.001)
    print(heard, master.sealer.clock.round_trip)
"""


def test_the_kernels_bad_network() -> None:
    """``tc netem`` in a network namespace of its own, where the kernel has it and lets us."""
    setup = "ip link set lo up && tc qdisc add dev lo root netem delay 10ms 3ms loss 10% duplicate 5%"
    try:
        tried = subprocess.run(
            ["unshare", "-rn", "sh", "-c", setup], capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        pytest.skip("unshare is not installed: no network namespace to be had")
    if tried.returncode != 0:
        reason = (tried.stderr.strip().splitlines() or ["no reason given"])[-1]
        pytest.skip(f"no netem here ({reason}): the fault layer of the process is tested instead")
    run = subprocess.run(
        ["unshare", "-rn", "sh", "-c", f'{setup} && exec "$0" -c "$1"', sys.executable, UNDER_NETEM],
        capture_output=True,
        text=True,
        check=True,
    )
    heard, trip = run.stdout.split()
    assert int(heard) >= 100 and float(trip) >= 0.01
