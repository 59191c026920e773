"""Keeping up with a camera that does not wait: when frames are due, and what mapping may cost.

Where time runs short, mapping gives way first: a keyframe gets as many optimisation steps as there
is time for, then none, and is left out unless the sub-map no longer explains what is seen. Only
when tracking alone is too slow do frames wait until the queue is full, and are dropped.
"""

from __future__ import annotations

import time
from collections.abc import Callable

_NEWEST_SHARE = 0.2
"""Weight of the newest frame in the mean tracking time."""


class Pace:
    """The clock of one live camera. Frame n is due n / rate after the first."""

    def __init__(
        self, rate_hz: float, *, queue_frames: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._period_s = 1.0 / rate_hz
        # Half the queue may be used up by mapping; the rest is for what nobody foresees.
        self._allowed_s = 0.5 * queue_frames * self._period_s
        self._clock = clock
        self._first: tuple[int, float] | None = None
        self._tracking_s = 0.0

    def wait_s(self, number: int) -> float:
        """Seconds until frame `number` is due, at least 0; the first frame asked for is due now."""
        return max(0.0, -self.late_s(number))

    def late_s(self, number: int) -> float:
        """Seconds since frame `number` was due; negative before."""
        if self._first is None:
            self._first = (number, self._clock())
        first, started = self._first
        return self._clock() - started - (number - first) * self._period_s

    def mapping_s(self, number: int) -> float:
        """Seconds that mapping may take at frame `number`, about to be tracked, so that the next
        one is late by no more than half the queue; 0 or less where there is no time."""
        return self._allowed_s + self._period_s - self._tracking_s - max(0.0, self.late_s(number))

    def note_tracking(self, seconds: float) -> None:
        """Learn how long tracking takes."""
        first = self._tracking_s == 0.0
        self._tracking_s += (1.0 if first else _NEWEST_SHARE) * (seconds - self._tracking_s)
