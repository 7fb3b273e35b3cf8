"""Real time for what is simulated: people take part in it."""

from __future__ import annotations

import math
import time

from .ends import PERIOD

_BEHIND_S = 0.1
"""a computer that is later than this is not made to catch up [s]"""


class Pace:
    """Waits until a period is due; where the computer is too slow, time passes slowly."""

    def __init__(self) -> None:
        self._begin = math.nan

    def wait(self, k: int) -> float:
        """Wait for period `k`.

        Returns:
            what time it is [s].
        """
        now = time.monotonic()
        if math.isnan(self._begin):
            self._begin = now - k * PERIOD
        ahead = self._begin + k * PERIOD - now
        if ahead > 0.0:
            time.sleep(ahead)
        elif ahead < -_BEHIND_S:
            self._begin -= ahead
        return now
