"""Logs in layouts that no single table has: motor-side pairs of files, the recordings of the bam project."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from palpate.errors import InputError, LogError
from palpate.logs.columns import ColumnMap
from palpate.logs.log import Log, Signal
from palpate.logs.repair import (
    BAD_TIME,
    NON_FINITE,
    NOT_A_NUMBER,
    POSITION_LIMIT,
    TIME_LIMIT_NS,
    VALUE_LIMIT,
    FloatArray,
    IntArray,
    RepairReport,
    Tally,
    require_rows,
)

_JSON_LIMIT = 256 << 20  # [bytes]; a recording of minutes takes one or two MB
_LEAST_ROWS = 16  # fewer show no derivative
_TX40_RATIO = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
_TX40_RATIO[5, 4] = 32.0  # motor 6 turns with joint 5, too
_TX40_RATIO.setflags(write=False)


def open_known(path: str | PathLike[str], joints: int) -> tuple[Log, str | None]:
    """A log in palpate's own layout, or in that of a known data set, found out by what is in it.

    Args:
        path: the file.
        joints: how many joints the log must have.

    Returns:
        the log, and the name of the column map where one was needed.

    Raises:
        LogError: the file cannot be read, or no layout fits.
    """
    try:
        return Log.open(path), None
    except LogError:
        if not Path(path).is_file():
            raise
        for name in ColumnMap.names():
            try:
                log = Log.open(path, ColumnMap.named(name))
            except LogError:
                continue
            if log.n != joints:
                continue
            if len(log) < _LEAST_ROWS:
                raise LogError(f"{path}: {len(log)} rows: too few to tell what its columns are") from None
            if _moves_as_it_says(log):
                return log, name
        raise


def _moves_as_it_says(log: Log) -> bool:
    """Whether time runs and the velocity is the derivative of the position: columns of another layout are not."""
    if log.velocity is None:
        return False
    time = log.seconds
    good = np.r_[np.diff(time) > 0.0, False]
    if np.count_nonzero(good) < 0.9 * len(log):
        return False
    travelled = np.diff(log.position, axis=0)[good[:-1]]
    told = (0.5 * (log.velocity[1:] + log.velocity[:-1]) * np.diff(time)[:, None])[good[:-1]]
    size = float(np.linalg.norm(told))
    return bool(size > 0.0 and np.linalg.norm(travelled - told) < 0.5 * size)


def read_motor_pair(
    position: str | PathLike[str],
    torque: str | PathLike[str],
    *,
    ratio: npt.ArrayLike,
    period: float,
    offset: npt.ArrayLike | None = None,
    column: str = "Joint_{joint}",
) -> Log:
    """A log from two tables of the same rows: motor positions [rad] and motor torques [N m].

    With the gear matrix R, q_motor = R q, and since both sides carry the same power tau = R^T tau_motor.

    Args:
        position: table of motor positions, one column per motor.
        torque: table of motor torques, the same columns.
        ratio: (n, n) R [1]; off the diagonal where a motor turns with another joint, too.
        period: time between rows [s].
        offset: (n,) joint position where R^-1 q_motor is zero [rad]; default 0.
        column: name of the columns, with ``{joint}`` for the number.

    Returns:
        joint positions [rad] and joint torques [N m].

    Raises:
        LogError: a table cannot be read, or they do not hold the same rows.
        InputError: the ratio is not (n, n) or singular.
    """
    columns = ColumnMap(position=column, time=None, period=period)
    # every row must keep its partner: broken rows stay in place, then go from both
    first, second = (Log.open(path, columns, keep_invalid=True) for path in (position, torque))
    if first.position.shape != second.position.shape or np.any(first.time_ns != second.time_ns):
        raise LogError(
            f"{position} holds {len(first)} rows of {first.n} and {torque} {len(second)} of {second.n}; "
            "expected the same rows"
        )
    n = first.n
    R = np.asarray(ratio, dtype=np.float64)
    if R.shape != (n, n) or not np.all(np.isfinite(R)) or np.linalg.matrix_rank(R) < n:
        raise InputError(f"ratio must be a regular ({n}, {n}) matrix, got {R.tolist()!r:.200}")
    zero = np.zeros(n) if offset is None else np.asarray(offset, dtype=np.float64)
    if zero.shape != (n,):
        raise InputError(f"offset must have shape ({n},), got {zero.shape}")
    motor, torques = first.position, second.position
    # False for NaN, too
    good = np.asarray(
        (np.abs(motor) <= POSITION_LIMIT).all(axis=1) & (np.abs(torques) <= VALUE_LIMIT).all(axis=1)
    )
    tally = Tally()
    tally.add(NON_FINITE, np.flatnonzero(~good).tolist())
    require_rows(f"{position} and {torque}", len(first), int(good.sum()), tally)
    time_ns = first.time_ns[good]
    return Log(
        time_ns=time_ns,
        position=np.linalg.solve(R, motor[good].T).T + zero,
        effort=torques[good] @ R,
        joint_names=first.joint_names,
        meta={"effort_unit": "N m"},
        repair=tally.report(len(first), time_ns),
    )


def read_tx40(position: str | PathLike[str], torque: str | PathLike[str]) -> Log:
    """The Staubli TX40 recording of figaroh-examples (5 kHz, motor side; motor 6 turns with joint 5, too).

    Args:
        position: ``pos_read_data.csv``.
        torque: ``curr_data.csv``; its name says current, it holds motor torque [N m].

    Raises:
        LogError: as in :func:`read_motor_pair`.
    """
    offset = [0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0]
    return read_motor_pair(position, torque, ratio=_TX40_RATIO, period=2e-4, offset=offset)


def read_bam(path: str | PathLike[str]) -> Log:
    """A recording of one servo with a pendulum by the bam project (JSON).

    The effort is the servo's present-current register, made signed [A]; on an XL330 it follows the supply
    current, not the motor's. Signals: ``voltage`` [V], ``goal`` [rad], ``enabled`` [1], ``temperature`` [degC].
    Mass, length and the servo's settings are in ``meta``.

    Raises:
        LogError: no such file, or not such a recording.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _JSON_LIMIT:
            raise LogError(f"{path}: {path.stat().st_size >> 20} MiB, too much for a recording in JSON")
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise LogError(f"{path}: not readable as JSON: {error}") from None
    entries = data.get("entries") if isinstance(data, dict) else None
    if not isinstance(entries, list) or not entries:
        raise LogError(f"{path}: expected a recording with a list of entries")
    names = (
        "timestamp",
        "position",
        "speed",
        "load",
        "input_volts",
        "goal_position",
        "torque_enable",
        "temp",
    )
    table = np.full((len(entries), len(names)), np.nan)
    tally = Tally()
    for k, entry in enumerate(entries):
        try:
            table[k] = [float(entry[name]) for name in names]
        except (TypeError, KeyError, ValueError, OverflowError):
            tally.add(NOT_A_NUMBER, [k])
    limits = np.array([TIME_LIMIT_NS * 1e-9, POSITION_LIMIT, *[VALUE_LIMIT] * 6])
    within = np.abs(table) < limits  # False for NaN, too
    readable = ~np.isnan(table).all(axis=1)
    tally.add(BAD_TIME, np.flatnonzero(readable & ~within[:, 0]).tolist())
    tally.add(NON_FINITE, np.flatnonzero(readable & within[:, 0] & ~within.all(axis=1)).tolist())
    good = within.all(axis=1)
    require_rows(str(path), len(entries), int(good.sum()), tally)
    table = table[good]
    time_ns: IntArray = np.rint(table[:, 0] * 1e9).astype(np.int64)
    register = table[:, 3]
    current = np.where(register > 32767.0, register - 65536.0, register) * 1e-3
    return _bam_log(data, time_ns, table, current, tally.report(len(entries), time_ns))


def _bam_log(
    data: dict[str, Any], time_ns: IntArray, table: FloatArray, current: FloatArray, repair: RepairReport
) -> Log:
    signals = {
        "voltage": Signal(time_ns, table[:, 4], "V"),
        "goal": Signal(time_ns, table[:, 5], "rad"),
        "enabled": Signal(time_ns, table[:, 6], "1"),
        "temperature": Signal(time_ns, table[:, 7], "degC"),
    }
    meta = {key: str(value) for key, value in data.items() if isinstance(value, str | int | float)}
    return Log(
        time_ns=time_ns,
        position=table[:, 1:2],
        velocity=table[:, 2:3],
        effort=current[:, None],
        joint_names=("joint_1",),
        signals=signals,
        meta=meta | {"effort_unit": "A"},
        repair=repair,
    )
