"""When photographs were taken: by the camera's clock and the receiver's time, or by the events of a shutter.

The rule, for the photographs of one camera:

1. Where one of the two is missing, the other counts.
2. GPSTimeStamp is UTC: it says by how many quarters of an hour, or days, the camera's clock is off.
3. Where the two then agree within their last digits, the finer one counts.
4. Where they do not, whole seconds lose to fractions, and a GPSTimeStamp that repeats or jumps against the clock,
   as one of the last fix does, loses. Of two times with fractions GPSTimeStamp counts, because positions have its
   clock. The difference is said with both values, and half of it is a σ: only the photographs' own motion decides.

The step of a time is part of its σ. Clocks cut digits off: a time in whole seconds is 0.29 s about the middle of a
second, which is half a second from what is written.

A receiver with a hot shoe writes one row for each shutter event, on its own clock and without names (RTKLIB's
`_events.pos`). Events belong to photographs by the numbers in their names, or by order and intervals: the clock of
the camera may be hours off, but runs evenly, so that intervals between photographs are those between their events.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.exif_time import TimeSource
from pipelines.formats.gnss_logs import CameraEvents
from pipelines.formats.trajectory_csv import PoseTable
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


_EVENT_NUMBER = re.compile(r"(?<!\d)\d{4}(?!\d)")  # DJI_20240501120000_0007_V, DJI_0007, 100_0042_0007
_LENSES = range(6)  # last digits of a Phantom 4 Multispectral's photographs: colour, and five bands
_ONE_EXPOSURE_S = 1.5  # between the times of its photographs, which have whole seconds
_CLEARLY_S = 0.5
# Largest distance of a photograph's time from its event, once the clocks are compared: half of a whole second and
# the lag of a shutter, or that lag alone where times have fractions.
_WHOLE_SECONDS_S, _FRACTIONS_S = 0.75, 0.3
_MOST_PAIRS = 4_000_000
_NEARLY_ALL, _RUNNER_UP = 0.8, 0.7
_LEAST_TIED = 3
_REGULAR = 1.2  # largest interval of a track over its median, where it has a rate


def event_numbers(events: CameraEvents, photos: Sequence[Photo], remarks: Remarks) -> list[int | None]:
    """Return the number of each photograph's event by its name; None: the name has none.

    A multispectral drone writes several photographs an exposure, and the last digit of their numbers is the lens:
    DJI_0010.JPG and DJI_0011.TIF are event 1. Times decide between both readings, else the names' own pattern.
    """
    four_digits = [_EVENT_NUMBER.findall(PurePosixPath(photo.name).stem) for photo in photos]
    plain = [int(numbers[-1]) if numbers else None for numbers in four_digits]
    if not _last_digit_is_lens(events, photos, plain):
        return plain
    of_lens = [None if number is None else number // 10 for number in plain]
    example = next(
        photo.name for photo, number in zip(photos, of_lens, strict=True) if number in events.number.tolist()
    )
    remarks.assume(
        "event-numbers-of-lenses",
        f"The last digit in the names of the photographs is the lens: {example} is event "
        f"{of_lens[[photo.name for photo in photos].index(example)]} of {events.path.name}.",
    )
    return of_lens


def _last_digit_is_lens(events: CameraEvents, photos: Sequence[Photo], plain: Sequence[int | None]) -> bool:
    numbered = [(photo, number) for photo, number in zip(photos, plain, strict=True) if number is not None]
    known = set(events.number.tolist())
    if not numbered or any(number % 10 not in _LENSES for _, number in numbered):
        return False
    if not any(number // 10 in known for _, number in numbered):
        return False
    as_plain = _spread_s(events, [(photo, number) for photo, number in numbered])
    as_lens = _spread_s(events, [(photo, number // 10) for photo, number in numbered])
    if as_lens is not None and as_lens > _ONE_EXPOSURE_S:
        return False
    if as_lens is not None and as_plain is not None and abs(as_lens - as_plain) > _CLEARLY_S:
        return as_lens < as_plain
    colour = [PurePosixPath(photo.name).suffix.lower() in (".jpg", ".jpeg") for photo, _ in numbered]
    by_suffix = all((number % 10 == 0) == jpeg for (_, number), jpeg in zip(numbered, colour, strict=True))
    return by_suffix and len(numbered) >= _LEAST_TIED


def _spread_s(events: CameraEvents, numbered: Sequence[tuple[Photo, int]]) -> float | None:
    """Return by how much the offset between the clocks differs among photographs; None: fewer than two tell."""
    time_of = dict(zip(events.number.tolist(), events.time_s.tolist(), strict=True))
    offset = [
        time_of[number] - photo.tags.timestamp_s
        for photo, number in numbered
        if number in time_of and photo.tags.timestamp_s is not None
    ]
    return max(offset) - min(offset) if len(offset) > 1 else None


@dataclass(frozen=True)
class _Fit:
    """Tie of photographs to rows: the row of each (N,), −1 without one; the clocks' difference, the next fit."""

    row: IntArray
    offset_s: float
    worst_s: float
    runner_up: int  # photographs that the next best offset would tie

    @property
    def tied(self) -> int:
        return int((self.row >= 0).sum())


def rows_by_order(table: PoseTable, photos: Sequence[Photo], remarks: Remarks) -> PoseTable | None:
    """Return a table of events with the names of their photographs, tied by order and intervals.

    None: the table has names or no times, or is a track, whose rows are not one for each photograph.

    Raises:
        InputError: a table of events that fits the photographs in no way, or in several.
    """
    if table.names is not None or table.time_s is None:
        return None
    time_s = np.array([np.nan if photo.tags.timestamp_s is None else photo.tags.timestamp_s for photo in photos])
    named = "event" in table.path.name.lower()
    if not named and not (len(table.lines) == len(photos) and _irregular(table.time_s)):
        return None
    if not np.isfinite(time_s).all() or not np.isfinite(table.time_s).all():
        if not named:
            return None
        raise _refusal(
            table, photos, "Not all photographs have a time in EXIF, so that intervals cannot be compared."
        )
    fit = _fit(time_s, table.time_s, whole=bool((time_s % 1 == 0).all()))
    count, shorter = len(photos), min(len(photos), len(table.lines))
    whole = fit is not None and fit.tied == count == len(table.lines)
    likely = fit is not None and fit.tied >= max(_LEAST_TIED, _NEARLY_ALL * shorter)
    if fit is None or not (whole or (likely and fit.runner_up <= _RUNNER_UP * fit.tied)):
        if not named:
            return None
        ways = "in no way" if fit is None or not likely else "in several ways"
        best = "" if fit is None else f" (the best ties {fit.tied}, the next {fit.runner_up} photographs)"
        raise _refusal(table, photos, f"By order and intervals they fit {ways}{best}.")
    tied = np.flatnonzero(fit.row >= 0)
    remarks.assume(
        "rows-tied-by-order",
        f"The {len(table.lines)} rows of {table.path.name} name no photographs: by order and intervals they are "
        f"tied to {fit.tied} of {count} photographs, whose clock is {-fit.offset_s:+.1f} s ahead. Intervals agree "
        f"within {fit.worst_s:.2f} s; the next best order would tie {fit.runner_up} photographs.",
    )
    rows = table.take(fit.row[tied])
    return replace(rows, names=tuple(photos[at].name for at in tied.tolist()))


def _refusal(table: PoseTable, photos: Sequence[Photo], why: str) -> InputError:
    return InputError(
        "events-not-tied",
        f"The file has {len(table.lines)} events without names, the folder {len(photos)} photographs. {why} Remove "
        "photographs or rows that have no partner, add a column image, or give --time-offset with the whole track.",
        path=table.path,
    )


def _irregular(time_s: FloatArray) -> bool:
    """Return whether the intervals between rows are those of no steady rate."""
    steps = np.diff(np.sort(time_s))
    return len(steps) > 1 and bool(steps.max() > _REGULAR * np.median(steps))


def _fit(photo_s: FloatArray, event_s: FloatArray, *, whole: bool) -> _Fit | None:
    """Return the best tie of photographs (N,) to events (M,) by one difference of the clocks; None: none is."""
    reach = _WHOLE_SECONDS_S if whole else _FRACTIONS_S
    if len(photo_s) * len(event_s) > _MOST_PAIRS:
        return None
    apart = np.sort((event_s[None, :] - photo_s[:, None]).ravel())
    inside = np.searchsorted(apart, apart + 2 * reach, side="right") - np.arange(len(apart))
    best = int(inside.argmax())
    same_clock = np.abs(apart + reach) <= reach
    if same_clock.any() and inside[same_clock].max() >= _NEARLY_ALL * min(len(photo_s), len(event_s)):
        best = int(np.flatnonzero(same_clock)[inside[same_clock].argmax()])
    other = np.abs(apart - apart[best]) > 2 * reach
    runner_up = min(int(inside[other].max(initial=0)), len(photo_s))
    photo_order, event_order = np.argsort(photo_s, kind="stable"), np.argsort(event_s, kind="stable")
    row = np.full(len(photo_s), -1)
    if len(photo_s) == len(event_s):
        offset = event_s[event_order] - photo_s[photo_order]
        if np.ptp(offset) <= 2 * reach:  # photographs of one second keep their order
            row[photo_order] = event_order
            middle = float(offset.max() + offset.min()) / 2
            return _Fit(row, middle, float(np.ptp(offset)) / 2, runner_up)
    window = apart[best : best + int(inside[best])]
    middle = float(window[0] + window[-1]) / 2
    sorted_s = event_s[event_order]
    after = np.clip(np.searchsorted(sorted_s, photo_s + middle), 1, len(sorted_s) - 1)
    nearest = np.where(
        np.abs(sorted_s[after - 1] - photo_s - middle) < np.abs(sorted_s[after] - photo_s - middle),
        after - 1,
        after,
    )
    off = np.abs(sorted_s[nearest] - photo_s - middle)
    row = np.where(off <= reach, event_order[nearest], -1)
    used = row[row >= 0]
    if len(np.unique(used)) != len(used) or not len(used):
        return None
    return _Fit(row, middle, float(off[row >= 0].max()), runner_up)
