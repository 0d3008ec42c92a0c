"""GPS time as seconds since 1970 UTC: weeks since 1980, and leap seconds."""

from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray

WEEK_S = 604_800.0
_EPOCH_S = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
# Days at whose beginning (UTC) GPS time has come to be one second more ahead; none has been announced since 2017.
_LEAP_DAYS = (
    (1981, 7), (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7), (1994, 7),
    (1996, 1), (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
)  # fmt: skip
_LEAPS_S = np.array([datetime(year, month, 1, tzinfo=UTC).timestamp() for year, month in _LEAP_DAYS])


def unix_from_gps(gps_s: ArrayLike) -> FloatArray:
    """Return seconds since 1970 UTC of GPS times (N,), given as seconds since 1970 by a clock without leap seconds.

    A time in the inserted second itself is that of the second after it.
    """
    clock = np.asarray(gps_s, dtype=np.float64)
    # GPS time at each leap: that of UTC, and the seconds inserted by then.
    at_leaps = _LEAPS_S + np.arange(1, len(_LEAPS_S) + 1)
    return np.asarray(clock - np.searchsorted(at_leaps, clock, side="right"))


def unix_from_week(week: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return seconds since 1970 UTC of GPS weeks (N,), counted since 1980, and seconds of the week (N,)."""
    weeks, seconds = np.asarray(week, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return unix_from_gps(_EPOCH_S + WEEK_S * weeks + seconds)
