"""Which shutter event belongs to which photograph: by the numbers in names, or by order and intervals.

A receiver with a hot shoe writes one row for each shutter, on its own clock and without names (RTKLIB's
`_events.pos`). The clock of the camera may be hours off, but runs evenly: the intervals between photographs are
those between their events.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.gnss_logs import CameraEvents
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

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
    found = [_EVENT_NUMBER.findall(PurePosixPath(photo.name).stem) for photo in photos]
    plain = [int(numbers[-1]) if numbers else None for numbers in found]
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
