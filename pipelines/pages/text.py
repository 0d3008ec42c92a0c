"""Figures as text: decimals that fit their size, a true minus, a dash for what does not exist."""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import datetime
from math import isnan
from typing import Any

from pipelines.core.figures import ACCURACY_H, MISSING


def number(value: float | None, decimals: int = 2) -> str:
    """Return a number with fixed decimals: `−0.12`; a dash for None and NaN."""
    if value is None or isnan(value):
        return MISSING
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.removeprefix("-")
    return text.replace("-", "−")


def metres(value: float | None) -> str:
    """Return metres without their unit: millimetres below 10 m, tenths of them below 1 cm, else centimetres."""
    if value is None or isnan(value):
        return MISSING
    return "0" if value == 0 else number(value, 4 if abs(value) < 0.00995 else 3 if abs(value) < 9.9995 else 2)


def in_metres(value: float | None) -> str:
    """Return metres with their unit."""
    return MISSING if value is None or isnan(value) else f"{metres(value)} m"


def accuracy(value: float | None) -> str:
    """Return a figure of the headline, given in metres, with its unit."""
    return ACCURACY_H.with_unit(value)


def signed(value: float | None) -> str:
    """Return millimetre-fine metres without their unit, with a sign: a column of errors."""
    text = number(value, 3)
    return text if text == MISSING or text.startswith("−") else f"+{text}"


def share(value: float | None) -> str:
    """Return a share of one as per cent: `97.5 %`."""
    return MISSING if value is None or isnan(value) else f"{number(100 * value, 1).removesuffix('.0')} %"


def ratio(value: float | None) -> str:
    """Return a ratio with two decimals."""
    return number(value, 2)


def square_km(value: float | None) -> str:
    """Return an area in square kilometres, with its unit."""
    return MISSING if value is None else f"{number(value, 3)} km²"


def decibel(value: float | None) -> str:
    """Return decibels with their unit."""
    return MISSING if value is None else f"{number(value, 2)} dB"


def similarity(value: float | None) -> str:
    """Return a figure between 0 and 1 with four decimals (SSIM, LPIPS)."""
    return number(value, 4)


def parts_per_million(value: float | None) -> str:
    """Return a relative quantity in parts per million, or per cent from one per mille on: `96.4 ppm`, `1.86 %`."""
    if value is None:
        return MISSING
    return f"{number(1e6 * value, 1)} ppm" if abs(value) < 1e-3 else f"{number(100 * value, 2)} %"


def whole(value: int | None) -> str:
    """Return a whole number with thin spaces between thousands."""
    return MISSING if value is None else f"{value:,}".replace(",", "\u2009").replace("-", "−")


def plain(value: object) -> str:
    """Return any value as text; a dash for None."""
    return MISSING if value is None else str(value)


def duration(seconds: float | None) -> str:
    """Return a duration: `48 s`, `12 min 3 s`, `2 h 5 min`."""
    if seconds is None:
        return MISSING
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def moment(value: datetime | None) -> str:
    """Return a time in UTC, to the minute."""
    return MISSING if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def as_json(value: object) -> str:
    """Return a value of a JSON document in full, for programs that read the page."""
    return json.dumps(value, allow_nan=False)


FORMS: dict[str, Callable[..., str]] = {
    "accuracy": accuracy,
    "as_json": as_json,
    "whole": whole,
    "decibel": decibel,
    "duration": duration,
    "in_metres": in_metres,
    "metres": metres,
    "moment": moment,
    "number": number,
    "parts_per_million": parts_per_million,
    "plain": plain,
    "ratio": ratio,
    "share": share,
    "signed": signed,
    "similarity": similarity,
    "square_km": square_km,
}


def formatted(value: Any, form: str) -> str:
    """Return a value in one of the forms."""
    return FORMS[form](value)
