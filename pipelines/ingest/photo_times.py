"""When photographs were taken: one time for each from the camera's clock and the receiver's time, and its σ.

The rule, for the photographs of one camera:

1. Where one of the two is missing, the other counts.
2. GPSTimeStamp is UTC: it says by how many quarters of an hour, or days, the camera's clock is off.
3. Where the two then agree within their last digits, the finer one counts.
4. Where they do not, whole seconds lose to fractions, and a GPSTimeStamp that repeats or jumps against the clock,
   as one of the last fix does, loses. Of two times with fractions GPSTimeStamp counts, because positions have its
   clock. The difference is said with both values, and half of it is a σ: only the photographs' own motion decides.

The step of a time is part of its σ. Clocks cut digits off: a time in whole seconds is 0.29 s about the middle of a
second, which is half a second from what is written.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.exif_time import TimeSource
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

_QUARTER_S = 900.0  # zones are multiples of it
_LEAST_SAME = 4  # photographs, from which times that are all multiples of a coarse step have that step
# Of receivers with one to ten fixes a second, whose time is that of the last fix.
_RECEIVER_STEPS_S = (1.0, 0.5, 0.25, 0.2, 0.1)
_MOST_DRIFT = 1e-3  # of a clock, seconds a second
_MOST_ZONE_S = 14 * 3600.0
_ROLLOVER_S = 1024 * 7 * 86_400.0  # receivers that count weeks in ten bits fall back by so much
_JITTER_S = 0.02  # between two times of one moment, beside their digits
_LEAP_S, _MOST_LEAP_S = 18.0, 0.7  # GPS time is ahead of UTC
_SAME_S = 1e-6
_FINE_S = 0.1  # step of a receiver's time up to which its digits are no reason against it
_STUCK_S = 5.0  # of the camera's clock, beyond a fix that is old
_CUT, _CUT_COMMON = 12.0**-0.5, 0.5  # σ and mean of what is cut off at a step of 1


@dataclass(frozen=True)
class _Times:
    """Times of n photographs of one camera, NaN where there is none, and which of them count."""

    clock_s: FloatArray  # (n,) UTC as far as the zone is known
    clock_step_s: FloatArray  # (n,)
    gps_s: FloatArray  # (n,)
    gps_step_s: FloatArray  # (n,)


def with_times(photos: Sequence[Photo], remarks: Remarks) -> list[Photo]:
    """Return the photographs with the time that counts, its source and its σ; differences are noted."""
    result = list(photos)
    groups: dict[str, list[int]] = {}
    for row, photo in enumerate(photos):
        times = photo.tags.times
        if times.clock_s is not None or times.gps_s is not None:
            groups.setdefault(photo.tags.make_model, []).append(row)
    for rows in groups.values():
        chosen = [photos[row] for row in rows]
        for row, photo in zip(rows, _decided(chosen, remarks), strict=True):
            result[row] = photo
    return result


def _decided(photos: Sequence[Photo], remarks: Remarks) -> list[Photo]:
    """Return the photographs of one camera with the time that counts."""
    tags = [photo.tags.times for photo in photos]
    zone_s = _numbers([one.zone_s for one in tags])
    clock_s = _numbers([one.clock_s for one in tags]) - np.nan_to_num(zone_s)
    gps_s = _numbers([one.gps_s for one in tags])
    steps = (
        _step(clock_s, np.array([one.clock_step_s for one in tags]), (1.0,)),
        _step(gps_s, np.array([one.gps_step_s for one in tags]), _RECEIVER_STEPS_S),
    )
    both = np.isfinite(clock_s) & np.isfinite(gps_s)
    if both.any():
        gps_s = _without_rollover(gps_s, clock_s, both, remarks)
        if _is_stuck(gps_s[both], clock_s[both]):
            remarks.assume(
                "gps-time-stuck",
                f"GPSTimeStamp is the same in all {int(both.sum())} photographs, and is not used: the zone of the "
                "camera's clock is known from OffsetTime only.",
            )
            gps_s, both = np.full_like(gps_s, np.nan), np.zeros_like(both)
    if both.any():
        offset_s = round(float(np.median((gps_s - clock_s)[both])) / _QUARTER_S) * _QUARTER_S
        if offset_s and np.isfinite(zone_s[both]).any():
            remarks.assume(
                "time-zone-of-gps",
                f"By the zone in OffsetTime of {photos[0].name} … the camera's clock is {abs(offset_s) / 3600:.4g} "
                f"h {'before' if offset_s > 0 else 'after'} GPSTimeStamp, which is UTC and counts.",
            )
        clock_s = clock_s + offset_s
    times = _Times(clock_s, steps[0], gps_s, steps[1])
    by_gps, common_s = _choice(times, both, photos, remarks)
    time_s = np.where(by_gps, gps_s, clock_s)
    step_s = np.where(by_gps, times.gps_step_s, times.clock_step_s)
    result = []
    for row, photo in enumerate(photos):
        source: TimeSource = "gps" if both.any() or by_gps[row] else "assumed UTC"
        source = "offset" if not by_gps[row] and np.isfinite(zone_s[row]) else source
        known = bool(np.isfinite(time_s[row]))
        tagged = replace(
            photo.tags,
            timestamp_s=float(time_s[row]) if known else None,
            time_source=source if known else None,
            time_sigma_s=_CUT * float(step_s[row]) if known else 0.0,
            time_common_s=float(np.hypot(_CUT_COMMON * step_s[row], common_s)) if known else 0.0,
        )
        result.append(replace(photo, tags=tagged))
    return result


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values])


def _step(time_s: FloatArray, written_s: FloatArray, coarse_s: Sequence[float]) -> FloatArray:
    """Return the steps (n,) of times (n,): as written, or the coarse one that several are all multiples of."""
    known = time_s[np.isfinite(time_s)] % 1.0
    if len(known) >= _LEAST_SAME:
        for step_s in coarse_s:
            if np.abs(known - np.round(known / step_s) * step_s).max() < _SAME_S:
                return np.maximum(written_s, step_s)
    return written_s


def _without_rollover(gps_s: FloatArray, clock_s: FloatArray, both: BoolArray, remarks: Remarks) -> FloatArray:
    """Return the receiver's times with the 1024 weeks that it has lost."""
    behind_s = float(np.median((clock_s - gps_s)[both]))
    weeks = round(behind_s / _ROLLOVER_S)
    if weeks == 0 or abs(behind_s - weeks * _ROLLOVER_S) > _MOST_ZONE_S:
        return gps_s
    remarks.assume(
        "gps-week-rollover",
        f"GPSDateStamp is {1024 * abs(weeks)} weeks off the camera's date, as of a receiver that counts weeks in "
        "ten bits. The camera's date counts.",
    )
    return gps_s + weeks * _ROLLOVER_S


def _is_stuck(gps_s: FloatArray, clock_s: FloatArray) -> bool:
    """Return whether a receiver's times (n,) stand while the camera's clock (n,) goes on."""
    return bool(np.ptp(gps_s) < _SAME_S and np.ptp(clock_s) > _STUCK_S)


def _choice(times: _Times, both: BoolArray, photos: Sequence[Photo], remarks: Remarks) -> tuple[BoolArray, float]:
    """Return for which photographs (n,) the receiver's time counts, and the σ of an error that all times share."""
    by_gps = ~np.isfinite(times.clock_s)
    if not both.any():
        return by_gps, 0.0
    apart_s = (times.gps_s - times.clock_s)[both]
    gps_step_s, clock_step_s = float(np.median(times.gps_step_s[both])), float(np.median(times.clock_step_s[both]))
    finer_gps = gps_step_s < clock_step_s or (gps_step_s == clock_step_s and gps_step_s < 1.0)
    within = (apart_s > -gps_step_s - _JITTER_S) & (apart_s < clock_step_s + _JITTER_S)
    if within.all():
        return by_gps | (both & finer_gps), 0.0
    middle_s = float(np.median(apart_s))
    steady = _spread(apart_s, times.clock_s[both]) <= max(gps_step_s, clock_step_s) + 10.0 * _JITTER_S
    leaps = abs(middle_s - _LEAP_S) < _MOST_LEAP_S
    gps_counts = steady and gps_step_s <= max(_FINE_S, 0.999 * clock_step_s) and not leaps
    if leaps:
        which = f"the camera's clock counts, because GPSTimeStamp is {_LEAP_S:.0f} s ahead, as GPS time is of UTC"
    elif gps_counts:
        which = "GPSTimeStamp counts, because it has fractions and the clock of the positions"
    elif steady:
        which = f"the camera's clock counts, because GPSTimeStamp has steps of {gps_step_s:.3g} s"
    else:
        which = "the camera's clock counts, because GPSTimeStamp jumps against it, as one of the last fix does"
    values = f"{apart_s.min():+.2f} to {apart_s.max():+.2f} s"
    first = int(np.flatnonzero(both)[0])
    remarks.assume(
        "photo-times-differ",
        f"GPSTimeStamp and DateTimeOriginal of {int(both.sum())} photographs are apart by {middle_s:+.2f} s "
        f"(median; {values}), more than their digits explain: {which}. In {photos[first].name} they are "
        f"{_of_day(times.gps_s[first])} and {_of_day(times.clock_s[first])} UTC.",
    )
    return by_gps | (both & gps_counts), abs(middle_s) / 2.0


def _spread(apart_s: FloatArray, clock_s: FloatArray) -> float:
    """Return the range of differences (n,) of two clocks about a drift that clocks can have."""
    if len(apart_s) < _LEAST_SAME or np.ptp(clock_s) < 1.0:
        return float(np.ptp(apart_s))
    since_s = clock_s - clock_s.mean()
    drift = float(np.clip(since_s @ apart_s / (since_s @ since_s), -_MOST_DRIFT, _MOST_DRIFT))
    return float(np.ptp(apart_s - drift * since_s))


def _of_day(time_s: float) -> str:
    of_day = time_s % 86_400.0
    return f"{int(of_day // 3600):02d}:{int(of_day % 3600 // 60):02d}:{of_day % 60:06.3f}"
