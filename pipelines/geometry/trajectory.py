"""A recorded track at times between its samples: where it is known, and what it says there."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3


def covered(clock_s: FloatArray, time_s: FloatArray, max_gap_s: float) -> BoolArray:
    """Which of the times (n,) lie between samples (k,) that are at most `max_gap_s` apart; NaN does not."""
    if len(clock_s) < 2:
        return np.zeros(len(time_s), dtype=bool)
    after = np.clip(np.searchsorted(clock_s, time_s), 1, len(clock_s) - 1)
    near = clock_s[after] - clock_s[after - 1] <= max_gap_s
    return np.asarray((time_s >= clock_s[0]) & (time_s <= clock_s[-1]) & near)


def places_at(clock_s: FloatArray, places: FloatArray, time_s: FloatArray) -> FloatArray:
    """Places (n, 3) at times (n,), linearly between samples (k, 3)."""
    return np.stack([np.interp(time_s, clock_s, places[:, axis]) for axis in range(3)], axis=1)


def turns_at(clock_s: FloatArray, rotations: FloatArray, time_s: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) at times (n,), on the shortest arc between samples (k, 3, 3)."""
    after = np.clip(np.searchsorted(clock_s, time_s), 1, len(clock_s) - 1)
    before = after - 1
    part = (time_s - clock_s[before]) / (clock_s[after] - clock_s[before])
    arc = log_so3(np.swapaxes(rotations[before], 1, 2) @ rotations[after])
    return rotations[before] @ exp_so3(part[:, None] * arc)
