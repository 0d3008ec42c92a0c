"""DJI's timestamp file (`…_Timestamp.MRK`): time, position and σ of the camera at each event of a flight.

A line has, between tabs: number, second, [week], north,N east,E down,V latitude,Lat longitude,Lon height,Ellh,
three σ (N, E, V), flag,Q. Position and ellipsoidal height are those of the camera; north, east and down in
millimetres lead there from the antenna (DJI's manuals of Phantom 4 RTK and Zenmuse P1).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.gps_time import WEEK_S, unix_from_week
from pipelines.formats.text import read_lines
from pipelines.formats.xmp import RTK_FIXED, RTK_FLOAT

_NUMBER = r"([-+]?\d+(?:\.\d*)?)"
FIRST_LINE = re.compile(rf"\s*\d+\s+{_NUMBER}\s+\[\d+\]\s+{_NUMBER}\s*,\s*N\b")
_LINE = re.compile(
    rf"(\d{{1,9}})\s+{_NUMBER}\s+\[(\d{{1,5}})\]\s+{_NUMBER}\s*,\s*N\s+{_NUMBER}\s*,\s*E\s+{_NUMBER}\s*,\s*V\s+"
    rf"{_NUMBER}\s*,\s*Lat\s+{_NUMBER}\s*,\s*Lon\s+{_NUMBER}\s*,\s*Ellh\s+"
    rf"{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s+(\d{{1,3}})\s*,\s*Q"
)
_LAYOUT = "number, second, [week], n,N e,E v,V, lat,Lat lon,Lon h,Ellh, three σ, flag,Q"
_NO_POSITION = 0
_RECEIVER = {RTK_FIXED: "RTK fixed", RTK_FLOAT: "RTK float"}


@dataclass(frozen=True)
class CameraEvents:
    """N events of a camera.

    Attributes:
        path: their file.
        lines: (N,) line of each.
        number: (N,) of the photograph.
        time_s: (N,) seconds since 1970 UTC.
        lon_lat_alt: (N, 3) of the camera, degrees and ellipsoidal metres; NaN without a position.
        sigma_enu_m: (N, 3); NaN where unknown.
        receiver: (N,) kind of receiver, as of `PoseTable`.
        camera_from_antenna_enu_m: (N, 3) from the antenna to the camera.
    """

    path: Path
    lines: IntArray
    number: IntArray
    time_s: FloatArray
    lon_lat_alt: FloatArray
    sigma_enu_m: FloatArray
    receiver: NDArray[np.str_]
    camera_from_antenna_enu_m: FloatArray


def read_mrk(path: Path) -> CameraEvents:
    """Read a timestamp file.

    Raises:
        InputError: no event, a line of another layout, a coordinate out of range, or one number twice.
    """
    lines: list[int] = []
    values: list[list[float]] = []
    line_of: dict[int, int] = {}
    for line, text in enumerate(read_lines(path), start=1):
        if not text.strip():
            continue
        match = _LINE.fullmatch(text.strip())
        if match is None:
            raise InputError(f"is no line of a DJI timestamp file: {_LAYOUT}", path=path, line=line)
        number = int(match[1])
        if number in line_of:
            message = f"event {number} stands in line {line_of[number]} already"
            raise InputError(message, path=path, line=line)
        line_of[number] = line
        lines.append(line)
        values.append([float(text) for text in match.groups()])
    table = np.array(values)
    _check(table, path, lines)
    known = table[:, 12] != _NO_POSITION
    north_east_down_m = table[:, 3:6] / 1000
    sigma = table[:, [10, 9, 11]]
    return CameraEvents(
        path=path,
        lines=np.array(lines, dtype=np.int64),
        number=table[:, 0].astype(np.int64),
        time_s=unix_from_week(table[:, 2], table[:, 1]),
        lon_lat_alt=np.where(known[:, None], table[:, [7, 6, 8]], np.nan),
        sigma_enu_m=np.where((sigma > 0).all(axis=1, keepdims=True), sigma, np.nan),
        receiver=np.array([_RECEIVER.get(int(flag), "single-frequency") for flag in table[:, 12]]),
        camera_from_antenna_enu_m=north_east_down_m[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]),
    )


def _check(table: FloatArray, path: Path, lines: list[int]) -> None:
    """Raise for the first value out of range."""
    for column, low, high, field in (
        (1, 0, WEEK_S, "second of week"), (6, -90, 90, "Lat"), (7, -180, 180, "Lon"), (8, -1000, 20_000, "Ellh"),
        (9, 0, 1e6, "σ"), (10, 0, 1e6, "σ"), (11, 0, 1e6, "σ"),
    ):  # fmt: skip
        bad = np.flatnonzero((table[:, column] < low) | (table[:, column] > high))
        if len(bad):
            message = f"{table[bad[0], column]:g} is out of range {low:g} … {high:g}"
            raise InputError(message, path=path, line=lines[bad[0]], field=field)
