"""A recorded session once more: the same samples through the same pipeline, compared bit for bit."""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .._core import __version__
from ..arm import Arm
from ..errors import LogError
from ..logs import Log
from ..pipeline import Pipeline, Touch
from .trial import arm_of


@dataclass(frozen=True, slots=True)
class Difference:
    """An output that came out otherwise."""

    quantity: str
    rows: int
    """how many samples differ"""
    first: int
    """the first of them, from 0"""
    time_s: float
    """its time since the first sample [s]"""
    recorded: float
    replayed: float


@dataclass(frozen=True, slots=True)
class Replay:
    """What a replay found."""

    arm: Arm
    touch: Touch
    """replayed, one row per sample"""
    samples: int
    compared: int
    """samples that have recorded outputs; fewer than samples if the recording was cut short"""
    quantities: tuple[str, ...]
    differences: tuple[Difference, ...]
    version: str
    """of palpate, when it was recorded"""

    @property
    def same(self) -> bool:
        """Everything that was recorded came out again, bit for bit."""
        return not self.differences and self.compared > 0

    @property
    def same_version(self) -> bool:
        """Recorded by this version of palpate."""
        return self.version == __version__


def pipeline_of(log: Log, arm: Arm) -> Pipeline:
    """The pipeline that a recording of palpate was made with, fresh.

    Raises:
        LogError: the log does not say, or says it in a way this version does not understand.
    """
    text = log.meta.get("pipeline")
    if text is None:
        raise LogError(
            "the log does not say which pipeline it was made with: no recording of palpate weigh or simulate"
        )
    try:
        options = json.loads(text)
    except ValueError as error:
        raise LogError(f"the log's pipeline options are damaged: {error}") from None
    if not isinstance(options, dict):
        raise LogError(f"the log's pipeline options are damaged: expected an object, got {text:.60}")
    return Pipeline.from_options(arm, options)


def outputs(touch: Touch) -> dict[str, npt.NDArray[np.float64]]:
    """What a recording holds of a Touch, by the names of its signals, (N,) or (N, k) float64."""
    external, payload = touch.external, touch.payload
    status = np.column_stack((touch.status, external.status, payload.status))
    values = {
        "estimated_position": touch.q,
        "estimated_velocity": touch.dq,
        "external_torque": external.torque,
        "external_torque_std": external.std,
        "payload_mass": payload.mass,
        "payload_mass_std": payload.mass_std,
        "first_moment": payload.first_moment,
        "changes": payload.changes,
        "change_time": payload.change_time_ns,
        "touch_status": status,
    }
    return {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in values.items()}


def replay(log: Log) -> Replay:
    """Run a recorded session's pipeline over its recorded inputs and compare with its recorded outputs.

    Args:
        log: opened with ``keep_invalid=True``, so that the pipeline sees what it saw then.

    Raises:
        LogError: no recording of a palpate session.
    """
    arm = arm_of(log)
    touch = pipeline_of(log, arm).run(log)
    names, differences = [], []
    compared = len(log)
    for name, ours in outputs(touch).items():
        signal = log.signals.get(name)
        if signal is None:
            continue
        names.append(name)
        rows = min(len(signal), len(log))
        compared = min(compared, rows)
        theirs = np.ascontiguousarray(signal.value[:rows], dtype=np.float64)
        ours = ours[:rows]
        if theirs.shape != ours.shape:
            raise LogError(f"recorded {name} has shape {theirs.shape}, expected {ours.shape}")
        # bits, so that NaN equals itself and -0.0 differs from 0.0
        other = theirs.view(np.int64) != ours.view(np.int64)
        wrong = other if other.ndim == 1 else other.any(axis=1)
        if wrong.any():
            row = int(np.argmax(wrong))
            column = () if other.ndim == 1 else (int(np.argmax(other[row])),)
            differences.append(
                Difference(
                    name if not column else f"{name}[{column[0]}]",
                    int(np.count_nonzero(wrong)),
                    row,
                    float(log.seconds[row]),
                    float(theirs[(row, *column)]),
                    float(ours[(row, *column)]),
                )
            )
    if not names:
        raise LogError(
            "the log holds no recorded outputs to compare with: no recording of palpate weigh or simulate"
        )
    return Replay(
        arm,
        touch,
        len(log),
        compared,
        tuple(names),
        tuple(differences),
        log.meta.get("palpate_version", "unknown"),
    )
