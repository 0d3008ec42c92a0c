"""RTKLIB's solution (`.pos`): positions of an antenna by time, with σ.

The header, in lines that begin with %, states the clock (GPST, UTC or JST), the form of the coordinates and the
surface of the heights. Rows have the time in two cells, as a date or as GPS week and second of the week. Source:
RTKLIB's manual, appendix B.1.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.gps_time import WEEK_S, unix_from_gps, unix_from_week
from pipelines.formats.pose_table import PoseTable
from pipelines.formats.text import number, read_lines
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef

_JST_S = 9 * 3600.0
_EARTH_M = (5e6, 8e6)  # distances from its centre
# By the quality Q of a solution; 3 is with SBAS, 4 with code corrections, 5 without any.
_RECEIVER = {1: "RTK fixed", 2: "RTK float", **dict.fromkeys((3, 4, 5), "single-frequency")}
_Form = Literal["degrees", "sexagesimal", "ecef"]


@dataclass(frozen=True)
class _Header:
    line: int
    clock: str
    form: _Form
    above_geoid: bool


def read_pos(path: Path) -> PoseTable:
    """Read a solution.

    Raises:
        InputError: no header, a baseline instead of positions, no row, too few cells, a cell that is no number, or
            a value out of range.
    """
    lines = [(at, text.strip()) for at, text in enumerate(read_lines(path), start=1) if text.strip()]
    header = _header([(at, text) for at, text in lines if text.startswith("%")], path)
    rows = [(at, re.split(r"[\s,;]+", text.strip(",;"))) for at, text in lines if not text.startswith("%")]
    if not rows:
        raise InputError("has a header but no rows", path=path)
    places = 7 if header.form == "sexagesimal" else 3
    table = np.array([_numbers(cells[2:], places, path, at) for at, cells in rows])
    if header.form == "ecef":
        xyz, sigma = table[:, :3], _sigma_of_ecef(table)
    else:
        # σ are those of north, east, up.
        xyz, sigma = table[:, [1, 0, 2]], np.where(table[:, 5:8] > 0, table[:, 5:8], np.nan)[:, [1, 0, 2]]
    _check(xyz, header.form, path, [at for at, _ in rows])
    return PoseTable(
        path=path,
        source="pos",
        lines=np.array([at for at, _ in rows], dtype=np.int64),
        names=None,
        time_s=_times(header.clock, [(at, cells[:2]) for at, cells in rows], path),
        xyz=xyz,
        geographic=header.form != "ecef",
        receiver=np.array(
            [_RECEIVER.get(int(quality), "unknown receiver") for quality in np.nan_to_num(table[:, 3])]
        ),
        sigma_enu_m=sigma if np.isfinite(sigma).any() else None,
        assumed_crs="EPSG:4978" if header.form == "ecef" else "EPSG:4326" if header.above_geoid else "EPSG:4979",
        heights_above_geoid=header.above_geoid,
        header_line=header.line,
    )


def _header(comments: Sequence[tuple[int, str]], path: Path) -> _Header:
    above_geoid = any("height=" in text and "/geodetic" in text for _, text in comments)
    for line, text in reversed(comments):
        words = text.lstrip("% ").split()
        clock = words[0].upper() if words else ""
        if clock not in ("GPST", "UTC", "JST"):
            continue
        if "baseline" in text:
            raise InputError(
                "has baselines from the base station, not positions: let RTKLIB write Lat/Lon/Height",
                path=path,
                line=line,
            )
        form: _Form | None = None
        if "x-ecef" in text:
            form = "ecef"
        elif "latitude" in text:
            form = "degrees" if "(deg)" in text else "sexagesimal"
        if form is not None:
            return _Header(line, clock, form, above_geoid and form != "ecef")
    raise InputError(
        "has no header of RTKLIB: let it be written (Output Header), it states clock and coordinates", path=path
    )


def _numbers(cells: Sequence[str], places: int, path: Path, line: int) -> list[float]:
    """Return three coordinates, quality, satellites, three σ and three correlated σ; NaN for what is missing."""
    if len(cells) < places:
        raise InputError(f"has {len(cells) + 2} cells, expected time, position, quality …", path=path, line=line)
    values = [number(text, path=path, line=line, field="position") for text in cells[:places]]
    if places == 7:
        values = [_degrees(cells[0], values[:3]), _degrees(cells[3], values[3:6]), values[6]]
    rest = [number(text, path=path, line=line, field="quality and σ") for text in cells[places : places + 8]]
    return values + rest + [np.nan] * (8 - len(rest))


def _degrees(text: str, parts: Sequence[float]) -> float:
    """Return degrees, minutes and seconds as degrees; the sign of −0° counts."""
    sign = -1.0 if text.startswith("-") else 1.0
    return sign * (abs(parts[0]) + parts[1] / 60 + parts[2] / 3600)


def _sigma_of_ecef(table: FloatArray) -> FloatArray:
    """Return σ east, north, up (N, 3) of rows with σ x, y, z, xy, yz, zx; NaN where they are unknown.

    RTKLIB writes a covariance as its root with its sign.
    """
    x, y, z, xy, yz, zx = (np.sign(column) * column**2 for column in table[:, 5:11].T)
    cov = np.stack([np.stack([x, xy, zx], -1), np.stack([xy, y, yz], -1), np.stack([zx, yz, z], -1)], -2)
    ecef_from_enu = ecef_from_enu_rotation(lla_from_ecef(table[:, :3]))
    variance = np.einsum("nji,njk,nki->ni", ecef_from_enu, cov, ecef_from_enu)
    return np.sqrt(np.where(variance > 0, variance, np.nan))


def _check(xyz: FloatArray, form: _Form, path: Path, lines: Sequence[int]) -> None:
    if form == "ecef":
        distance = np.linalg.norm(xyz, axis=1)
        good = ~((distance < _EARTH_M[0]) | (distance > _EARTH_M[1]))
    else:
        good = ~((np.abs(xyz[:, 1]) > 90) | (np.abs(xyz[:, 0]) > 360))
    bad = np.flatnonzero(~good)
    if len(bad):
        raise InputError("is no place on Earth", path=path, line=lines[bad[0]], field="position")


def _times(clock: str, rows: Sequence[tuple[int, list[str]]], path: Path) -> FloatArray:
    """Return seconds since 1970 UTC (N,)."""
    by_week = "/" not in rows[0][1][0]
    if by_week:
        table = np.array([[number(text, path=path, line=at, field="time") for text in cells] for at, cells in rows])
        bad = np.flatnonzero(
            ~((table[:, 0] >= 0) & (table[:, 0] < 1e5) & (table[:, 1] >= 0) & (table[:, 1] <= WEEK_S))
        )
        if len(bad):
            raise InputError("is no GPS week and second", path=path, line=rows[bad[0]][0], field="time")
        return unix_from_week(table[:, 0], table[:, 1])
    time_s = np.array([_date(cells, path, at) for at, cells in rows])
    if clock == "GPST":
        return unix_from_gps(time_s)
    return time_s - _JST_S if clock == "JST" else time_s


def _date(cells: Sequence[str], path: Path, line: int) -> float:
    """Return the seconds since 1970 of a date, counted without leap seconds."""
    text = " ".join(cells)
    match = re.fullmatch(r"(\d{4})/(\d{1,2})/(\d{1,2}) (\d{1,2}):(\d{1,2}):(\d{1,2})(\.\d*)?", text)
    try:
        if match is None:
            raise ValueError(text)
        year, month, day, hour, minute, second = (int(part) for part in match.groups()[:6])
        # RTKLIB rounds seconds, and writes 60.000.
        start = datetime(year, month, day, hour, minute, tzinfo=UTC).timestamp()
        if second > 60:
            raise ValueError(text)
    except ValueError:
        message = f"{text[:40]!r} is no time like 2024/05/01 12:00:00.000"
        raise InputError(message, path=path, line=line, field="time") from None
    return start + second + float(f"0{match[7] or ''}")
