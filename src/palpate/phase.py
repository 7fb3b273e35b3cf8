"""Joint torque from two measured phase currents per motor, sample by sample (MATH.md section 7)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ._core import PhaseCurrents as CorePhaseCurrents
from ._core import Status
from .arm import Arm, Array
from .errors import ArmError, InputError
from .logs import Log, Sample

PHASE_A, PHASE_B = "phase_a", "phase_b"
"""names of a log's signals with the readings of the two sensors (N, n) [A]"""

Numbers = float | Iterable[float]


@dataclass(frozen=True, slots=True, eq=False)
class PhaseTorque:
    """What :meth:`PhaseCurrents.run` gives, one row per sample.

    Attributes:
        torque: (N, n) of the motors at the link side [N m].
        current: (N, n) signed peak current [A].
        sign_probability: (N, n) that the sign is right [1].
        source: (N, n) uint8, where the sign is from: 0 electrical angle, 1 controller current, 2 model torque,
            3 published.
        status: (N, n) uint8, palpate.Status: ``ok``; ``held`` while the readings are no sine (the last good
            torque is repeated); ``warming`` while the sign is not known; ``non_finite``.
    """

    torque: Array
    current: Array
    sign_probability: Array
    source: npt.NDArray[np.uint8]
    status: npt.NDArray[np.uint8]


class PhaseCurrents:
    """tau = k_t G I with its sign, from two phase currents per motor: I = (2/sqrt 3) sqrt(i_a^2 + i_a i_b + i_b^2).

    The sign is taken from the electrical angle (Park's transformation) where `pole_pairs` and the position are
    known, else from the controller's current, else from a filter on the torque that a model asks for. With the
    electrical angle, readings that are no sine (the change of the phase order at a reversal) show as a d-axis
    current and are ``held``.

    Args:
        n: number of motors.
        k_t: torque constants, per ampere of peak phase current [N m/A].
        gear: ratios, motor turns per joint turn [1].
        pole_pairs: electrical turns per motor turn; 0: the electrical angle is not known.
        angle_offset: electrical angle at position 0 [rad], see :func:`palpate.identify.calibrate_phases`.
        offset, gain: (n, 2) of the sensors a and b, see :func:`palpate.identify.calibrate_phases` [A, 1].
        amplitude_std: noise of the amplitude [A].
        direct_share: largest d-axis current that is believed, part of the amplitude [1].
        current_rate: fastest change of the torque-making current that is believed, beside noise [A/s];
            infinite: any.
        settle_time: after readings that were not believed, they count again so much later [s].
        flip_rate: sign changes to be expected near zero torque [1/s].
        model_std: error of the model torque that tells the sign [N m].
        model_time: how long such an error lasts [s].
        published: the published form with its errata (del Sol et al. 2014, eq. 5), for reproduction only.

    Raises:
        InputError: a value is out of range.
    """

    def __init__(
        self,
        n: int,
        *,
        k_t: Numbers,
        gear: Numbers = 1.0,
        pole_pairs: Numbers = 0,
        angle_offset: Numbers = 0.0,
        offset: npt.ArrayLike = 0.0,
        gain: npt.ArrayLike = 1.0,
        amplitude_std: Numbers = 0.05,
        direct_share: float = 0.2,
        current_rate: float = math.inf,
        settle_time: float = 0.02,
        flip_rate: float = 5.0,
        model_std: Numbers = 1.0,
        model_time: float = 0.1,
        published: bool = False,
    ) -> None:
        self.n = n
        try:
            self._core = CorePhaseCurrents(
                k_t=_each(k_t, n),
                gear=_each(gear, n),
                pole_pairs=_each(pole_pairs, n),
                angle_offset=_each(angle_offset, n),
                offset=np.array(np.broadcast_to(np.asarray(offset, dtype=np.float64), (n, 2))),
                gain=np.array(np.broadcast_to(np.asarray(gain, dtype=np.float64), (n, 2))),
                amplitude_std=_each(amplitude_std, n),
                direct_share=float(direct_share),
                current_rate=float(current_rate),
                settle_time=float(settle_time),
                flip_rate=float(flip_rate),
                model_std=_each(model_std, n),
                model_time=float(model_time),
                published=bool(published),
            )
        except (ValueError, TypeError) as error:
            raise InputError(f"PhaseCurrents: {str(error).splitlines()[0]}") from None

    @classmethod
    def of(cls, arm: Arm, **options: Any) -> PhaseCurrents:
        """For an arm whose effort is :meth:`palpate.Effort.phase_currents`; options as of the class.

        Raises:
            ArmError: the arm declares another effort.
        """
        effort = arm.effort
        if effort.kind != "phase_currents":
            raise ArmError(f"arm {arm.name!r} does not declare phase currents, its effort is {effort.kind}")
        return cls(
            arm.n,
            k_t=effort.k_t,
            gear=effort.gear,
            pole_pairs=effort.pole_pairs,
            angle_offset=effort.angle_offset,
            **options,
        )

    def run(
        self,
        time_ns: npt.ArrayLike,
        phase_a: npt.ArrayLike,
        phase_b: npt.ArrayLike,
        *,
        position: npt.ArrayLike | None = None,
        controller_current: npt.ArrayLike | None = None,
        model_torque: npt.ArrayLike | None = None,
    ) -> PhaseTorque:
        """Readings to torque; continues from the rows before (:meth:`reset` for a fresh start).

        Args:
            time_ns: (N,) [ns].
            phase_a, phase_b: (N, n) readings [A].
            position: (N, n) of the motors at the link side [rad].
            controller_current: (N, n) on any positive scale.
            model_torque: (N, n) that a model asks of the motors [N m].

        Raises:
            InputError: a shape is wrong. Bad numbers are no error: the status says so.
        """

        def rows(x: npt.ArrayLike | None) -> Array | None:
            return None if x is None else np.ascontiguousarray(x, dtype=np.float64)

        try:
            found = self._core.run(
                np.ascontiguousarray(time_ns, dtype=np.int64),
                rows(phase_a),
                rows(phase_b),
                rows(position),
                rows(controller_current),
                rows(model_torque),
            )
        except (ValueError, TypeError) as error:
            raise InputError(f"PhaseCurrents: {str(error).splitlines()[0]}") from None
        return PhaseTorque(**found)

    def step(self, sample: Sample) -> Array:
        """(n,) torque [N m] of one sample whose effort is (n, 2), the readings of both phases [A]; NaN while
        it is not known.

        Raises:
            InputError: the effort has another shape.
        """
        readings = np.asarray(sample.effort, dtype=np.float64)
        if readings.shape != (self.n, 2):
            raise InputError(
                f"phase currents: the sample's effort must be ({self.n}, 2), two phases per motor, got "
                f"{readings.shape}"
            )
        model = None if sample.model_torque is None else sample.model_torque[None]
        found = self.run(
            [sample.time_ns],
            readings[None, :, 0],
            readings[None, :, 1],
            position=np.asarray(sample.position)[None],
            model_torque=model,
        )
        return np.where(_known(found.status[0]), found.torque[0], np.nan)

    def convert(self, log: Log) -> Log:
        """The log with the motors' torque [N m] as its effort, from its signals ``phase_a`` and ``phase_b``.

        NaN where the sign is not known, so that such a sample is not used.

        Position and the log's own effort (if it holds the controller's current) help with the sign.

        Raises:
            InputError: the log lacks the signals, or they are not sampled with it.
        """
        readings = []
        for name in (PHASE_A, PHASE_B):
            if name not in log.signals:
                raise InputError(f"the log has no signal {name!r}; it has {', '.join(log.signals) or 'none'}")
            signal = log.signals[name]
            if signal.value.shape != log.position.shape or not np.array_equal(signal.time_ns, log.time_ns):
                raise InputError(
                    f"signal {name!r} must be {log.position.shape}, sampled with the log, got {signal.value.shape}"
                )
            readings.append(signal.value)
        found = self.run(
            log.time_ns,
            *readings,
            position=log.position,
            controller_current=log.effort if log.has_effort else None,
            model_torque=log.model_torque,
        )
        torque = np.where(_known(found.status), found.torque, np.nan)
        return replace(log, effort=torque, meta={**log.meta, "effort_unit": "N m"})

    def reset(self) -> None:
        """Back to the state before the first sample."""
        self._core.reset()


def _known(status: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_]:
    """Where the torque means something: ``ok``, or the last good one during a glitch."""
    found: npt.NDArray[np.bool_] = (status == Status.ok) | (status == Status.held)
    return found


def _each(value: Numbers, n: int) -> Array:
    return np.array(
        np.broadcast_to(
            np.asarray(value if isinstance(value, int | float) else list(value), dtype=np.float64), (n,)
        )
    )
