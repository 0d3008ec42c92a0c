"""Clocks of a bag's topics that are a known number of seconds apart: GPS time, atomic time (TAI), time zones.

Messages of one moment are recorded at one moment, so that the recorder's clock tells how far the stamps of two
topics are apart, but for the time that a message takes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pipelines.formats.gps_time import unix_from_gps

# Atomic time is ahead of GPS time, by definition.
_TAI_FROM_GPS_S = 19.0
# Receivers and cameras hand over a message this long after its moment, or sooner.
_LATENCY_S = 0.6
# Topics that are further apart have different clocks.
_APART_S = 1.0
_QUARTER_S, _ZONE_S = 900.0, 14 * 3600.0


@dataclass(frozen=True)
class ClockShift:
    """How a topic's stamps are brought to the clock of the others: `shift_s` is subtracted."""

    shift_s: float
    code: Literal["stamps-in-gps-time", "stamps-in-tai", "stamps-in-local-time", "topic-clocks-differ"]
    sentence: str


def clock_shifts(ahead_s: Mapping[str, float], at_s: float) -> dict[str, ClockShift]:
    """Return the shifts of topics whose stamps are on another clock than those nearest to the recorder's.

    `ahead_s` has by how much the stamps of each topic are ahead of the times of recording (median), `at_s` a stamp.
    Differences that no known clock explains are named and left: their shift is 0.
    """
    if not ahead_s:
        return {}
    nearest = min(ahead_s, key=lambda topic: (abs(ahead_s[topic]), topic))
    found = {}
    for topic, ahead in ahead_s.items():
        apart = ahead - ahead_s[nearest]
        if abs(apart) > _APART_S:
            found[topic] = _explained(topic, nearest, apart, at_s + apart)
    return found


def _explained(topic: str, other: str, apart_s: float, at_s: float) -> ClockShift:
    leap_s = round(at_s - float(unix_from_gps(at_s)))
    side = "ahead of" if apart_s > 0 else "behind"
    for size, code, name in (
        (float(leap_s), "stamps-in-gps-time", f"as GPS time from UTC ({leap_s} leap seconds at that date)"),
        (leap_s + _TAI_FROM_GPS_S, "stamps-in-tai", "as atomic time (TAI) from UTC"),
        (round(abs(apart_s) / _QUARTER_S) * _QUARTER_S, "stamps-in-local-time", "as the time of a zone from UTC"),
    ):
        if 0 < size <= _ZONE_S and abs(abs(apart_s) - size) < _LATENCY_S:
            shift = float(np.copysign(size, apart_s))
            sentence = (
                f"Stamps of {topic} are {abs(apart_s):.2f} s {side} those of {other}, {name}: {size:.0f} s are "
                f"{'subtracted' if shift > 0 else 'added'}."
            )
            return ClockShift(shift, code, sentence)  # type: ignore[arg-type]
    sentence = (
        f"Stamps of {topic} are {abs(apart_s):.2f} s {side} those of {other}, by the recorder's clock, and no "
        "known clock explains it: positions may belong to other moments. State the difference with --time-offset."
    )
    return ClockShift(0.0, "topic-clocks-differ", sentence)
