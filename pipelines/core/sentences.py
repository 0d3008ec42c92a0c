"""Parts of sentences for people."""

from __future__ import annotations

from collections.abc import Sequence

_SHOWN = 8


def listed(names: Sequence[str]) -> str:
    """Return the first eight names with commas between them, and an ellipsis if there are more."""
    return ", ".join(names[:_SHOWN]) + (" …" if len(names) > _SHOWN else "")


def duration(seconds: float | None) -> str:
    """Return a duration as `0.4 s`, `12 s`, `3 min 20 s` or `1 h 05 min`; empty for None."""
    if seconds is None:
        return ""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def about(seconds: float | None) -> str:
    """Return an estimated duration: `43 s`, `2 min 50 s`, `36 min`, `7 h 30 min`; empty for None."""
    if seconds is None or seconds < 60:
        return duration(seconds)
    unit = 10 if seconds < 600 else 60 if seconds < 3600 else 600
    text = duration(round(seconds / unit) * unit)
    return text.removesuffix(" 00 s")
