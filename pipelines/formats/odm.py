"""OpenDroneMap's text files: `geo.txt` (image positions) and `gcp_list.txt` (ground points and their marks).

Both begin with a CRS and have x (longitude or easting) first. Marks are in pixels of the full image; here the
centre of the top-left pixel is (0.5, 0.5), and marks are taken as given in that convention.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.ground_points import GroundPoints, ListedMark, ListedPoint, without_repeats
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.formats.text import number, read_lines
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix

KIND = "OpenDroneMap's gcp_list.txt"
_GEO_COUNTS = "image x y [z] [yaw pitch roll] [h_acc v_acc]"
_GCP_FORM = "x y z px py image [name]"
# OpenDroneMap's pitch is 0 straight down, the gimbal's −90.
_GIMBAL_FROM_ODM_PITCH_DEG = -90.0


def read_geo(path: Path) -> PoseTable:
    """Read `geo.txt`. A position without z has NaN height.

    Raises:
        InputError: no CRS line, no row, a wrong number of columns, or a cell that is no number.
    """
    crs_text, rows = _rows(path)
    names, lines, values = [], [], []
    for line, cells in rows:
        texts = cells[1:9] if len(cells) >= 10 else cells[1:]
        if len(texts) not in (2, 3, 6, 8):
            message = f"has {len(cells)} columns, expected 3, 4, 7 or 9: {_GEO_COUNTS}{_comma_hint(cells)}"
            raise InputError(message, path=path, line=line)
        fields = ("x", "y", "z", "yaw", "pitch", "roll", "h_acc", "v_acc")
        numbers = [
            number(text, path=path, line=line, field=field) for text, field in zip(texts, fields, strict=False)
        ]
        names.append(cells[0])
        lines.append(line)
        values.append(numbers + [np.nan] * (8 - len(numbers)))
    table = np.array(values, dtype=np.float64)
    return PoseTable(
        path=path,
        source="geo.txt",
        lines=np.array(lines, dtype=np.int64),
        names=tuple(names),
        time_s=None,
        xyz=table[:, :3],
        geographic=None,
        quat_xyzw=_quaternions(table[:, 3:6]),
        sigma_enu_m=_sigmas(table[:, 6:8], path, lines),
        crs_text=crs_text,
    )


def read_ground_points(path: Path) -> GroundPoints:
    """Read `gcp_list.txt`. Points without a name are named by their place in the file.

    Raises:
        InputError: no CRS line, too few columns, a cell that is no number or NaN, no line at all, or one point at
            two places.
    """
    crs_text, rows = _rows(path)
    points, marks = [], []
    unnamed: dict[tuple[float, float, float], str] = {}
    for line, cells in rows:
        if len(cells) < 6:
            message = f"has {len(cells)} columns, expected at least 6: {_GCP_FORM}{_comma_hint(cells)}"
            raise InputError(message, path=path, line=line)
        fields = ("x", "y", "z", "px", "py")
        values = [
            number(text, path=path, line=line, field=field) for text, field in zip(cells, fields, strict=False)
        ]
        for value, field in zip(values, fields, strict=True):
            if np.isnan(value):
                raise InputError("is not a number", path=path, line=line, field=field)
        xyz = (values[0], values[1], values[2])
        name = cells[6] if len(cells) > 6 else unnamed.setdefault(xyz, f"point-{len(unnamed) + 1}")
        points.append(ListedPoint(line, name, xyz))
        marks.append(ListedMark(line, name, cells[5], values[3], values[4]))
    return GroundPoints(path, KIND, without_repeats(points, path), tuple(marks), crs_text)


def _rows(path: Path) -> tuple[str, list[tuple[int, list[str]]]]:
    """Return the CRS, and line number and cells of each further line but blank ones and comments."""
    lines = [(at, text.strip()) for at, text in enumerate(read_lines(path), start=1)]
    lines = [(at, text) for at, text in lines if text and not text.startswith("#")]
    if not lines:
        raise InputError("is empty", path=path)
    first, crs_text = lines[0]
    rows = [(at, text.split()) for at, text in lines[1:]]
    if len(crs_text.split()) >= 3 and _is_number(crs_text.split()[1]) and not crs_text.startswith("+"):
        raise InputError(
            "the first line must be the CRS, e.g. EPSG:4326 or WGS84 UTM 16N; this is a row", path=path, line=first
        )
    if not rows:
        raise InputError("has a CRS but no rows", path=path)
    return crs_text, rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _comma_hint(cells: list[str]) -> str:
    return "; separate columns by spaces or tabs" if any("," in cell or ";" in cell for cell in cells) else ""


def _quaternions(yaw_pitch_roll_deg: FloatArray) -> FloatArray | None:
    known = complete(yaw_pitch_roll_deg)
    if not known.any():
        return None
    result = np.full((len(known), 4), np.nan)
    gimbal = yaw_pitch_roll_deg[known] + np.array([0.0, _GIMBAL_FROM_ODM_PITCH_DEG, 0.0])
    result[known] = quat_xyzw_from_matrix(geo_from_cam(gimbal))
    return result


def _sigmas(accuracy_m: FloatArray, path: Path, lines: list[int]) -> FloatArray | None:
    bad = np.flatnonzero((accuracy_m <= 0.0).any(axis=1))
    if len(bad):
        raise InputError("must be above zero", path=path, line=lines[bad[0]], field="h_acc, v_acc")
    if not np.isfinite(accuracy_m).any():
        return None
    return accuracy_m[:, [0, 0, 1]]
