"""Recordings of a KUKA LBR iiwa under the whiteboard project's velocity controller, and how noise and lag are measured.

The repository github.com/denizsoysal/ARCS has no licence: the files are looked at, never passed on.
"""

from __future__ import annotations

import gzip
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from .. import data
from ..arm import Array
from ..errors import LogError

FOLDER = "iiwa_whiteboard_logs"
_FILES: Mapping[str, tuple[str, str, str, str]] = MappingProxyType(
    {
        "log 1": (
            "iiwase_log_1.csv.gz",
            "b7fafce248f2c19b902d43a5492f004d70dd72aa33e6d8dad199ab6a8166a2eb",
            "iiwa_controller",
            "meas_jnt_pos[{}]",
        ),
        "no_avg": (
            "iiwase_log_no_avg.csv.gz",
            "9c0f05b67d382edeb55376d3efef254bc48801ad3b8236c95538a5c10b51d2e1",
            "estimation",
            "local_meas_jnt_pos{}",
        ),
        "lp_1_11": (
            "iiwase_log_lp_1_11.csv.gz",
            "23eb5e8c83e46c9cd9abc93a010cf895d75afc95f275dadb653c2fab11e2ad06",
            "estimation",
            "local_meas_jnt_pos{}",
        ),
    }
)
NAMES = tuple(_FILES)
JOINTS = 7

WINDOW = 15
"""rows of the centred mean that noise is measured against: 0.12 s"""
MOVING = 0.05
"""noise is measured while that mean is faster [rad/s]"""


@dataclass(frozen=True, slots=True, eq=False)
class IiwaLog:
    """One recording; a row is one pass of the program's loop."""

    name: str
    time_ns: npt.NDArray[np.int64]
    """(N,) wall clock of the logging call, whole milliseconds [ns]"""
    position: Array
    """(N, 7) as received [rad]"""
    gain: Array
    """(M,) of the ABAG that was running [1]"""

    @property
    def period(self) -> float:
        """Of the loop, mean [s]."""
        return float(self.time_ns[-1] - self.time_ns[0]) * 1e-9 / (len(self.time_ns) - 1)

    @property
    def real(self) -> int:
        """First row that holds a measurement; those before repeat memory that nobody had written to."""
        same = np.all(self.position == self.position[0], axis=1)
        return int(np.argmin(same)) if same[1] else 0


def load(name: str) -> IiwaLog:
    """A recording by name.

    Raises:
        LogError: it is not on this machine, or not the published file.
    """
    file, sha256, logger, pattern = _FILES[name]
    folder = data.local(FOLDER)
    if folder is None or not (folder / file).is_file():
        raise LogError(
            f"{FOLDER}/{file} is not on this machine: gzip the file of github.com/denizsoysal/ARCS into a folder "
            f"{FOLDER} and let {data.VARIABLE} name the folder above it"
        )
    raw = gzip.decompress((folder / file).read_bytes())
    if hashlib.sha256(raw).hexdigest() != sha256:
        raise LogError(f"{folder / file} is not the published file: expected the SHA-256 {sha256[:16]}...")
    wanted = [pattern.format(j) for j in range(JOINTS)]
    columns: dict[str, list[float]] = {signal: [] for signal in (*wanted, "gain")}
    stamps: list[str] = []
    for line in raw.decode().splitlines():
        stamp, source, _, signal, value = (part.strip() for part in line.split(","))
        if signal in columns and (source == logger or signal == "gain"):
            columns[signal].append(float(value))
            if signal == wanted[0]:
                stamps.append(stamp.replace(" ", "T"))
    rows = min(len(columns[signal]) for signal in wanted)
    return IiwaLog(
        name,
        np.array(stamps[:rows], dtype="datetime64[ns]").astype(np.int64),
        np.array([columns[signal][:rows] for signal in wanted]).T.copy(),
        np.array(columns["gain"]),
    )


def centred(values: Array) -> Array:
    """Mean over :data:`WINDOW` rows about each: no lag; the edges are short of it."""
    mean: Array = np.convolve(values, np.full(WINDOW, 1.0 / WINDOW), "same")
    return mean


def noise(velocity: Array, first: int) -> Array:
    """(K,) difference from the centred mean while the joint moves, from row `first` on [rad/s]."""
    mean = centred(velocity)
    keep = np.abs(mean) > MOVING
    keep[: first + WINDOW] = False
    keep[-WINDOW:] = False
    difference: Array = (velocity - mean)[keep]
    return difference


def added_lag(time: Array, velocity: Array, plain: Array, first: int) -> float:
    """How much later than `plain` a velocity is [s]: the shift that leaves the least mean square difference.

    Both are smoothed by the centred mean, three times, which adds no lag: else the steps of the noise decide, not the
    motion.
    """
    inside = slice(first + 3 * WINDOW, len(time) - 3 * WINDOW)
    t, v, reference = time[inside], _smooth(velocity)[inside], _smooth(plain)
    shifts = np.arange(-0.02, 0.15, 0.001)
    cost = [float(np.mean((v - np.interp(t - s, time, reference)) ** 2)) for s in shifts]
    i = min(max(int(np.argmin(cost)), 1), len(shifts) - 2)
    low, mid, high = cost[i - 1 : i + 2]
    return float(shifts[i] + 0.0005 * (low - high) / (low - 2.0 * mid + high))


def _smooth(values: Array) -> Array:
    return centred(centred(centred(values)))


def normality(values: Array) -> tuple[float, float, float]:
    """Skewness, excess kurtosis, and the p-value of the Jarque-Bera test that the values are normal."""
    z = (values - values.mean()) / values.std()
    skewness, kurtosis = float(np.mean(z**3)), float(np.mean(z**4)) - 3.0
    return skewness, kurtosis, math.exp(-len(z) / 12.0 * (skewness**2 + kurtosis**2 / 4.0))
