"""Time left of a whole run, from the forecast of its stages and the pace of those that are done."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping


class RunTimeLeft:
    """Time that the remaining stages of a run will take.

    Stages that the forecast knows no time for count as nothing: they take seconds. Stages that are done correct the
    forecast of the others, because one machine is slower than another by a factor.

    Args:
        seconds: forecast by stage, of those that take long; None: not known.
        clock: returns seconds.
    """

    def __init__(self, seconds: Mapping[str, float | None], clock: Callable[[], float] = time.monotonic) -> None:
        self._unknown = any(value is None for value in seconds.values())
        self._left = {stage: value for stage, value in seconds.items() if value is not None}
        self._clock, self._began = clock, clock()
        self._forecast_s = self._took_s = 0.0

    def begin(self) -> None:
        """Begin to measure a stage."""
        self._began = self._clock()

    def end(self, stage: str) -> None:
        """Note the end of a stage."""
        forecast_s = self._left.pop(stage, 0.0)
        if forecast_s:
            self._forecast_s += forecast_s
            self._took_s += self._clock() - self._began

    @property
    def seconds(self) -> float | None:
        """Seconds that the stages not yet done will take; None: not known."""
        if self._unknown:
            return None
        return sum(self._left.values()) * (self._took_s / self._forecast_s if self._forecast_s else 1.0)
