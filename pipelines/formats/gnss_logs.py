"""Logs of GNSS receivers: DJI's timestamp file of a camera's events, and RTKLIB's solution of an antenna.

`…_Timestamp.MRK`: a line has, between tabs: number, second, [week], north,N east,E down,V latitude,Lat
longitude,Lon height,Ellh, three σ (N, E, V), flag,Q. Position and ellipsoidal height are those of the camera;
north, east and down in millimetres lead there from the antenna (DJI's manuals of Phantom 4 RTK and Zenmuse P1).

`.pos`: the header, in lines that begin with %, states the clock (GPST, UTC or JST), the form of the coordinates and
the surface of the heights. Rows have the time in two cells, as a date or as GPS week and second of the week.
Source: RTKLIB's manual, appendix B.1.

GPS time: weeks since 1980-01-06 and seconds, ahead of UTC by the leap seconds since then (IERS Bulletin C).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray
from pipelines.formats.exif import RTK_FIXED, RTK_FLOAT
from pipelines.formats.gps_time import WEEK_S, unix_from_gps, unix_from_week
from pipelines.formats.tables import cell_number, numbered_lines, refuse_first, require_range, require_rows
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef

_NUMBER = r"([-+]?\d+(?:\.\d*)?)"
FIRST_LINE = re.compile(rf"\s*\d+\s+{_NUMBER}\s+\[\d+\]\s+{_NUMBER}\s*,\s*N\b")
_LINE = re.compile(
    rf"(\d{{1,9}})\s+{_NUMBER}\s+\[(\d{{1,5}})\]\s+{_NUMBER}\s*,\s*N\s+{_NUMBER}\s*,\s*E\s+{_NUMBER}\s*,\s*V\s+"
    rf"{_NUMBER}\s*,\s*Lat\s+{_NUMBER}\s*,\s*Lon\s+{_NUMBER}\s*,\s*Ellh\s+"
    rf"{_NUMBER}\s*,\s*{_NUMBER}\s*,\s*{_NUMBER}\s+(\d{{1,3}})\s*,\s*Q"
)
_LAYOUT = "number, second, [week], n,N e,E v,V, lat,Lat lon,Lon h,Ellh, three σ, flag,Q"
_EVENT_RANGES = (
    (1, 0.0, WEEK_S, "second of week"), (6, -90.0, 90.0, "Lat"), (7, -180.0, 180.0, "Lon"),
    (8, -1000.0, 20_000.0, "Ellh"), (9, 0.0, 1e6, "σ"), (10, 0.0, 1e6, "σ"), (11, 0.0, 1e6, "σ"),
)  # fmt: skip
_NO_POSITION = 0
_DJI_RECEIVER = {RTK_FIXED: "RTK fixed", RTK_FLOAT: "RTK float"}


@dataclass(frozen=True)
class CameraEvents:
    """N events of a camera."""

    path: Path
    lines: IntArray  # (N,)
    number: IntArray  # (N,) of the photograph
    time_s: FloatArray  # (N,) seconds since 1970 UTC
    lon_lat_alt: FloatArray  # (N, 3) of the camera, degrees and ellipsoidal metres; NaN without a position
    sigma_enu_m: FloatArray  # (N, 3); NaN where unknown
    receiver: NDArray[np.str_]  # (N,) as of `PoseTable`
    camera_from_antenna_enu_m: FloatArray  # (N, 3) from the antenna to the camera


def read_mrk(path: Path) -> CameraEvents:
    r"""Read a timestamp file.

    Raises:
        InputError: no event, a line of another layout, a coordinate out of range, or one number twice.

    Examples:
        >>> _ = Path("flight.MRK").write_text(
        ...     "1\t302418.500000\t[2312]\t-66,N\t10,E\t194,V\t46.80000000,Lat\t7.10000000,Lon\t512.000,Ellh\t"
        ...     "0.011, 0.012, 0.025\t50,Q\n"
        ... )
        >>> events = read_mrk(Path("flight.MRK"))
        >>> events.lon_lat_alt.tolist(), events.camera_from_antenna_enu_m.tolist(), events.receiver.tolist()
        ([[7.1, 46.8, 512.0]], [[0.01, -0.066, -0.194]], ['RTK fixed'])
    """
    lines: list[int] = []
    values: list[list[float]] = []
    line_of: dict[int, int] = {}
    for line, text in numbered_lines(path):
        match = _LINE.fullmatch(text)
        if match is None:
            message = f"The line is not that of a DJI timestamp file: {_LAYOUT}"
            raise InputError("line-layout", message, path=path, line=line)
        number = int(match[1])
        if number in line_of:
            message = f"Event {number} is in line {line_of[number]} already."
            raise InputError("event-twice", message, path=path, line=line)
        line_of[number] = line
        lines.append(line)
        values.append([float(value) for value in match.groups()])
    table = np.array(values)
    for column, low, high, field in _EVENT_RANGES:
        require_range(table[:, column], low, high, path=path, lines=lines, field=field)
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
        receiver=np.array([_DJI_RECEIVER.get(int(flag), "single-frequency") for flag in table[:, 12]]),
        camera_from_antenna_enu_m=north_east_down_m[:, [1, 0, 2]] * np.array([1.0, 1.0, -1.0]),
    )


_JST_S = 9 * 3600.0
_EARTH_M = (5e6, 8e6)  # distances from its centre
# By the quality Q of a solution; 3 is with SBAS, 4 with code corrections, 5 without any.
_RTKLIB_RECEIVER = {1: "RTK fixed", 2: "RTK float", **dict.fromkeys((3, 4, 5), "single-frequency")}
_Form = Literal["degrees", "sexagesimal", "ecef"]


@dataclass(frozen=True)
class _Header:
    line: int
    clock: str
    form: _Form
    above_geoid: bool


def read_pos(path: Path) -> PoseTable:
    r"""Read a solution.

    Raises:
        InputError: no header, a baseline instead of positions, no row, too few cells, a cell that is no number, or
            a value out of range.

    Examples:
        >>> _ = Path("camera.pos").write_text(
        ...     "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,5:single,ns=# of satellites)\n"
        ...     "%  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m)\n"
        ...     "2024/05/01 12:00:18.000 46.8 7.1 512.0 1 9 0.008 0.007 0.015\n"
        ... )
        >>> solution = read_pos(Path("camera.pos"))
        >>> solution.xyz.tolist()  # longitude, latitude, ellipsoidal height
        [[7.1, 46.8, 512.0]]
        >>> solution.sigma_enu_m.tolist(), solution.receiver.tolist()
        ([[0.007, 0.008, 0.015]], ['RTK fixed'])
    """
    lines = numbered_lines(path)
    header = _header([(at, text) for at, text in lines if text.startswith("%")], path)
    rows = [(at, re.split(r"[\s,;]+", text.strip(",;"))) for at, text in lines if not text.startswith("%")]
    at_lines = np.array([at for at, _ in rows], dtype=np.int64)
    require_rows(rows, path)
    places = 7 if header.form == "sexagesimal" else 3
    table = np.array([_numbers(cells[2:], places, path, at) for at, cells in rows])
    if header.form == "ecef":
        xyz, sigma = table[:, :3], _sigma_of_ecef(table)
    else:
        # σ are those of north, east, up.
        xyz, sigma = table[:, [1, 0, 2]], np.where(table[:, 5:8] > 0, table[:, 5:8], np.nan)[:, [1, 0, 2]]
    off_earth = (np.abs(xyz[:, 1]) > 90) | (np.abs(xyz[:, 0]) > 360)
    if header.form == "ecef":
        distance = np.linalg.norm(xyz, axis=1)
        off_earth = (distance < _EARTH_M[0]) | (distance > _EARTH_M[1])
    outside = "the position is not on Earth"
    refuse_first(off_earth, "position-off-earth", lambda _: outside, path=path, lines=at_lines, field="position")
    return PoseTable(
        path=path,
        source="pos",
        lines=at_lines,
        names=None,
        time_s=_times(header.clock, [(at, cells[:2]) for at, cells in rows], path),
        xyz=xyz,
        geographic=header.form != "ecef",
        receiver=np.array(
            [_RTKLIB_RECEIVER.get(int(quality), "unknown receiver") for quality in np.nan_to_num(table[:, 3])]
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
            message = (
                "The rows are baselines from the base station, not positions: let RTKLIB write Lat/Lon/Height."
            )
            raise InputError("baselines", message, path=path, line=line)
        form: _Form | None = None
        if "x-ecef" in text:
            form = "ecef"
        elif "latitude" in text:
            form = "degrees" if "(deg)" in text else "sexagesimal"
        if form is not None:
            return _Header(line, clock, form, above_geoid and form != "ecef")
    message = "The file has no header of RTKLIB, which states clock and coordinates: switch Output Header on."
    raise InputError("header-missing", message, path=path)


def _numbers(cells: Sequence[str], places: int, path: Path, line: int) -> list[float]:
    """Return three coordinates, quality, satellites, three σ and three correlated σ; NaN for what is missing."""
    if len(cells) < places:
        message = f"The line has {len(cells) + 2} cells, expected time, position, quality …"
        raise InputError("wrong-columns", message, path=path, line=line)
    values = [cell_number(text, path=path, line=line, field="position") for text in cells[:places]]
    if places == 7:
        values = [_degrees(cells[0], values[:3]), _degrees(cells[3], values[3:6]), values[6]]
    rest = [cell_number(text, path=path, line=line, field="quality and σ") for text in cells[places : places + 8]]
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


def _times(clock: str, rows: Sequence[tuple[int, list[str]]], path: Path) -> FloatArray:
    """Return seconds since 1970 UTC (N,)."""
    if "/" in rows[0][1][0]:
        time_s = np.array([_date(cells, path, at) for at, cells in rows])
        if clock == "GPST":
            return unix_from_gps(time_s)
        return time_s - _JST_S if clock == "JST" else time_s
    week, second = np.array(
        [[cell_number(text, path=path, line=at, field="time") for text in cells] for at, cells in rows]
    ).T
    good = (week >= 0) & (week < 1e5) & (second >= 0) & (second <= WEEK_S)
    lines = [at for at, _ in rows]
    message = "The time is not a GPS week and second of the week."
    refuse_first(~good, "time-invalid", lambda _: message, path=path, lines=lines, field="time")
    return unix_from_week(week, second)


def _date(cells: Sequence[str], path: Path, line: int) -> float:
    """Return the seconds since 1970 of a date, counted without leap seconds."""
    text = " ".join(cells)
    minute, _, second = text.rpartition(":")
    try:
        start = datetime.strptime(minute, "%Y/%m/%d %H:%M").replace(tzinfo=UTC).timestamp()
        if not re.fullmatch(r"([0-5]?\d|60)(\.\d*)?", second):  # RTKLIB rounds seconds, and writes 60.000
            raise ValueError(text)
    except ValueError:
        message = f"{text[:40]!r} is not a time like 2024/05/01 12:00:00.000."
        raise InputError("time-invalid", message, path=path, line=line, field="time") from None
    return start + float(second)


@dataclass(frozen=True)
class VideoPositions:
    """Positions that a camera recorded with a video."""

    path: Path
    source: str  # kind of record, as fixes of the survey state it
    lines: IntArray  # (N,) of the file; of telemetry the numbers of the payloads
    time_s: FloatArray  # (N,) since the beginning of the video, rising
    lon_lat_height: FloatArray  # (N, 3) degrees and metres; NaN without a fix
    heights_above_geoid: bool  # or a datum that the file does not name
    utc_from_video_s: float | None = None  # added to times in the video: seconds since 1970 UTC
    receiver: str = "unknown receiver"  # as of `PoseTable`


_FROM_TO = re.compile(r"(\d{1,3}):(\d\d):(\d\d)[,.](\d{3})\s*-->.*")
_NUMBER_AFTER = r"\s*:\s*(-?\d{1,7}(?:\.\d{1,12})?)"
_LATITUDE, _LONGITUDE, _HEIGHT = (
    re.compile(rf"\b{name}{_NUMBER_AFTER}") for name in ("latitude", "long?t?itude", "abs_alt")
)


def read_subtitles(path: Path) -> VideoPositions:
    r"""Read the `.SRT` that DJI's drones write beside a video: `[latitude: …] [longitude: …] [… abs_alt: …]`.

    Raises:
        InputError: no subtitle has a position, or a coordinate is out of range.

    Examples:
        >>> _ = Path("video.SRT").write_text(
        ...     "1\n00:00:00,000 --> 00:00:00,033\n"
        ...     "[latitude: 46.8] [longitude: 7.1] [rel_alt: 50.0 abs_alt: 512.0]\n"
        ... )
        >>> positions = read_subtitles(Path("video.SRT"))
        >>> positions.time_s.tolist(), positions.lon_lat_height.tolist(), positions.heights_above_geoid
        ([0.0], [[7.1, 46.8, 512.0]], True)
    """
    lines: list[int] = []
    values: list[list[float]] = []
    time_s = 0.0
    for line, text in numbered_lines(path):
        if begins := _FROM_TO.fullmatch(text.strip()):
            hours, minutes, seconds, thousandths = map(int, begins.groups())
            time_s = 3600 * hours + 60 * minutes + seconds + thousandths / 1000
            continue
        matches = [pattern.search(text) for pattern in (_LONGITUDE, _LATITUDE, _HEIGHT)]
        if all(matches) and (not values or time_s > values[-1][0]):
            lines.append(line)
            values.append([time_s, *(float(match[1]) for match in matches if match)])
    if not values:
        message = "No subtitle has latitude, longitude and abs_alt, as DJI's drones write them."
        raise InputError("subtitles-without-positions", message, path=path)
    table = np.array(values)
    for column, limit, field in ((1, 180.0, "longitude"), (2, 90.0, "latitude")):
        require_range(table[:, column], -limit, limit, path=path, lines=lines, field=field)
    has_fix = (table[:, 1:3] != 0).any(axis=1, keepdims=True)
    return VideoPositions(
        path=path,
        source="video subtitles",
        lines=np.array(lines),
        time_s=table[:, 0],
        lon_lat_height=np.where(has_fix, table[:, 1:], np.nan),
        heights_above_geoid=True,
    )
