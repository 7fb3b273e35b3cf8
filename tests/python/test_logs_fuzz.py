"""Damaged files: each gives a log with a report or a LogError; none hangs, fills the memory or raises otherwise."""

from __future__ import annotations

import gzip
import random
import resource
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.errors import LogError
from palpate.logs import ColumnMap, Event, Log, Recorder, Signal, messages

ROWS = 60
NAMES = ("a", "b", "c")
FILES_PER_KIND = 250


def whole() -> Log:
    rng = np.random.default_rng(0)
    time_ns = 10**9 + np.arange(ROWS) * 10**6
    arrays = {
        name: rng.standard_normal((ROWS, 3)) for name in ("position", "velocity", "effort", "model_torque")
    }
    signals = {
        "wrench": Signal(time_ns[::3], rng.standard_normal((ROWS // 3, 6)), "N"),
        "mass": Signal(time_ns[::3], rng.standard_normal(ROWS // 3), "kg"),
        "external_torque": Signal(time_ns, rng.standard_normal((ROWS, 3)), "N m"),
    }
    events = (Event(10**9 + 5, "grasp", "x"),)
    return Log(
        time_ns=time_ns, joint_names=NAMES, signals=signals, events=events, meta={"card": "x"}, **arrays
    )


def table() -> str:
    names = [f"{field}_{k}" for field in ("position", "velocity", "effort") for k in (1, 2, 3)]
    lines = ["time_ns," + ",".join(names)]
    for sample in whole():
        numbers = np.concatenate((sample.position, sample.velocity, sample.effort)).tolist()
        lines.append(",".join(map(repr, [sample.time_ns, *numbers])))
    return "\n".join(lines) + "\n"


def saved(path: Path) -> None:
    whole().save(path)


def streamed(path: Path) -> None:
    with Recorder(path, NAMES, flush_s=0.0) as recorder:
        for sample in whole():
            recorder.sample(*sample)
            recorder.command(sample.time_ns, sample.effort)
            recorder.payload(sample.time_ns, 1.0, 2.0)
            recorder.status(sample.time_ns, payload="ok" if sample.time_ns % 7 else "gap")


def compressed(path: Path) -> None:
    writer = pytest.importorskip(
        "mcap_ros2.writer",
        reason="palpate[test] is not installed",
    )
    from mcap.writer import CompressionType

    with path.open("wb") as file:
        kind = CompressionType.LZ4 if "lz4" in path.name else CompressionType.ZSTD
        out = writer.Writer(file, compression=kind, chunk_size=4000)
        schema = out.register_msgdef(messages.JOINT_STATE, messages.DEFINITIONS[messages.JOINT_STATE].text)
        for sample in whole():
            fields = {name: getattr(sample, name).tolist() for name in ("position", "velocity", "effort")}
            header = {"stamp": {"sec": 1, "nanosec": sample.time_ns - 10**9}, "frame_id": ""}
            content = {"header": header, "name": NAMES, **fields}
            out.write_message("/joint_states", schema, content, log_time=sample.time_ns, publish_time=0)
        out.finish()


def foreign(path: Path) -> None:
    log = whole()
    np.savez_compressed(
        path, t=log.time_ns * 1e-9, q=log.position, f=log.signals["wrench"].value[:, 0].repeat(3)
    )


KINDS: dict[str, Callable[[Path], object]] = {
    "a.csv": lambda path: path.write_text(table()),
    "a.csv.gz": lambda path: path.write_bytes(gzip.compress(table().encode())),
    "a.npz": saved,
    "foreign.npz": foreign,
    "a.mcap": saved,
    "stream.mcap": streamed,
    "lz4.mcap": compressed,
    "zstd.mcap": compressed,
    "a.db3": saved,
}
FOREIGN = ColumnMap(time="t", position="q", signals={"f": "f"})


def damage(data: bytes, rng: random.Random) -> bytes:
    """Cut the file, flip bits, overwrite bytes, insert or repeat some."""
    found = bytearray(data)
    at = rng.randrange(len(found))
    kind = rng.random()
    if kind < 0.25:
        return bytes(found[:at])
    if kind < 0.65:
        for _ in range(rng.choice((1, 1, 2, 5, 50))):
            found[rng.randrange(len(found))] ^= 1 << rng.randrange(8)
    elif kind < 0.8:
        found[at : at + rng.choice((1, 4, 8, 100))] = bytes([rng.choice((0, 255, 10, 34, 44))]) * rng.choice(
            (1, 4, 8)
        )
    elif kind < 0.9:
        found[at:at] = rng.randbytes(rng.choice((1, 3, 8, 64)))
    else:
        other = rng.randrange(len(found))
        found[at : at + 200] = found[other : other + 200]
    return bytes(found)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files(tmp_path, kind):
    path = tmp_path / kind
    KINDS[kind](path)
    columns = FOREIGN if kind == "foreign.npz" else None
    data = path.read_bytes()
    assert len(Log.open(path, columns)) == ROWS
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    outcomes = {"log": 0, "error": 0}
    for seed in range(FILES_PER_KIND):
        path.write_bytes(damage(data, random.Random(f"{kind} {seed}")))
        try:
            log = Log.open(path, columns, keep_invalid=bool(seed % 2))
        except LogError as error:
            outcomes["error"] += 1
            assert str(path) in str(error), f"seed {seed}: the message does not name the file: {error}"
        else:
            outcomes["log"] += 1
            assert len(log) >= 1
            assert str(log.repair)
            assert log.summary()
    assert min(outcomes.values()) > 0, outcomes
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory
    assert grown < 300 * 1024, f"{grown} kB more memory"


@pytest.mark.parametrize("kind", ["a.csv", "a.mcap", "a.db3", "a.npz"])
def test_noise_under_a_good_name(tmp_path, kind):
    rng = random.Random(kind)
    good = tmp_path / f"good{kind}"
    KINDS[kind](good)
    start = good.read_bytes()[:40]
    for size in (1, 10, 1000, 100_000):
        for head in (b"", start):
            (tmp_path / kind).write_bytes(head + rng.randbytes(size))
            with pytest.raises(LogError, match=kind):
                Log.open(tmp_path / kind)
