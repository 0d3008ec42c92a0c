"""Times of a table's rows: seconds since 1970, ISO 8601, a date and a clock time, or GPS week and second."""

import re
from collections.abc import Collection, Sequence
from datetime import UTC, date, datetime

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats import tables
from pipelines.formats.gps_time import WEEK_S, unix_from_week

TIMES = {
    **dict.fromkeys(("timestamp", "time", "t", "datetime", "timeutc", "utctime", "utc", "unixtime"), "timestamp"),
    **dict.fromkeys(("date", "dateutc", "utcdate", "gpsdate", "day"), "date"),
    **dict.fromkeys(("week", "gpsweek", "weekno", "gpsweekno", "weeknumber"), "week"),
    **dict.fromkeys(("tow", "gpstow", "timeofweek", "secondsofweek", "secondofweek", "sow", "gpssow"), "tow"),
}
_LATEST_S = 1e11  # the year 5138; larger numbers are milliseconds or finer
_FIRST_WEEK, _LAST_WEEK = 1024.0, 5000.0  # from 1999 on, before which receivers count from zero again
_DATE_FIRST = re.compile(r"(\d{4})[-/:.](\d{1,2})[-/:.](\d{1,2})(?:[ T_]+(.+))?")
_DATE_LAST = re.compile(r"(\d{1,2})[-/.](\d{1,2})[-/.](\d{4})")
_CLOCK = re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:\.\d*)?)?\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?", re.IGNORECASE)


def has_times(columns: Collection[str]) -> bool:
    """Return whether a table with these columns states times."""
    return "timestamp" in columns or {"week", "tow"} <= set(columns)


def timestamps_of(table: tables.Table) -> tuple[FloatArray, bool]:
    """Return seconds since 1970 UTC (N,), and whether a time has no zone and is taken as UTC.

    Raises:
        InputError: no time, a date whose day and month may be exchanged, milliseconds, or no GPS week of our days.
    """
    if "week" in table.columns and _is_of_week(table):
        return _times_of_week(table), False
    dates = _dates(table) if "date" in table.columns else None
    moments = [_moment(row, None if dates is None else dates[at]) for at, row in enumerate(table.rows)]
    times = np.array([seconds for seconds, _ in moments])
    tables.refuse_first(
        np.abs(times) > _LATEST_S,
        "time-unit",
        lambda row: f"the time {times[row]:.0f} is probably in milliseconds or finer: give seconds since 1970",
        path=table.path,
        lines=table.lines,
        field="timestamp",
    )
    return times, any(zoneless for _, zoneless in moments)


def _is_of_week(table: tables.Table) -> bool:
    """Return whether the seconds of a GPS week stand beside it: as such, or as a time of at most a week."""
    if "tow" in table.columns:
        return True
    first = table.rows[0]
    stated = "timestamp" in table.columns and tables.is_number(first.text("timestamp"))
    return stated and abs(first.number("timestamp")) <= WEEK_S


def _times_of_week(table: tables.Table) -> FloatArray:
    second = "tow" if "tow" in table.columns else "timestamp"
    weeks, seconds = table.numbers(("week", second)).T
    tables.require_range(weeks, _FIRST_WEEK, _LAST_WEEK, path=table.path, lines=table.lines, field="week")
    tables.require_range(seconds, 0.0, WEEK_S, path=table.path, lines=table.lines, field=second)
    return unix_from_week(weeks, seconds)


def _dates(table: tables.Table) -> Sequence[date]:
    """Return the dates of the rows; day and month count as the whole column shows them."""
    texts = [row.text("date") for row in table.rows]
    last = [match for text in texts if (match := _DATE_LAST.fullmatch(text)) is not None]
    day_first, month_first = any(int(match[1]) > 12 for match in last), any(int(match[2]) > 12 for match in last)
    dates = []
    for row, text in zip(table.rows, texts, strict=True):
        match = _DATE_LAST.fullmatch(text)
        if match is not None and day_first == month_first and match[1] != match[2] and "." not in text:
            message = f"Whether {text!r} begins with the day or the month is not known."
            raise row.fault("date-ambiguous", message, "date", remedy="Write it as 2024-05-31.")
        try:
            if match is None:
                dates.append(_calendar(text))
            else:
                first, second, year = map(int, match.groups())
                dates.append(date(year, first, second) if month_first else date(year, second, first))
        except ValueError:
            raise row.fault("date-invalid", f"{text!r} is not a date such as 2024-05-31", "date") from None
    return dates


def _calendar(text: str) -> date:
    """Return the date of a text with the year first; a ValueError: it is none."""
    match = _DATE_FIRST.fullmatch(text)
    if match is not None and match[4] is None:
        return date(int(match[1]), int(match[2]), int(match[3]))
    if re.fullmatch(r"\d{8}", text):
        return date(int(text[:4]), int(text[4:6]), int(text[6:]))
    raise ValueError(text)


def _moment(row: tables.Row, day: date | None) -> tuple[float, bool]:
    """Return a row's time, and whether it has no zone."""
    text = row.text("timestamp")
    dated = _DATE_FIRST.fullmatch(text)
    if dated is not None and dated[4] is not None:
        text = f"{dated[1]}-{int(dated[2]):02d}-{int(dated[3]):02d}T{dated[4]}"
    elif _CLOCK.fullmatch(text) is not None:
        if day is None:
            message = f"{text!r} is a time without a date: add a column date, or write 2024-05-31T12:00:00"
            raise row.fault("time-without-date", message, "timestamp")
        text = f"{day.isoformat()}T{text if text[1:2] != ':' else '0' + text}"
    elif dated is None:
        return row.number("timestamp"), False
    try:
        moment = datetime.fromisoformat(re.sub(r"\s*(UTC|Z)$", "+00:00", text, flags=re.IGNORECASE))
    except ValueError:
        raise row.fault("time-invalid", f"{row.text('timestamp')!r} is not an ISO 8601 time", "timestamp") from None
    zoneless = moment.tzinfo is None
    return (moment.replace(tzinfo=UTC) if zoneless else moment).timestamp(), zoneless
