"""RealityScan's (RealityCapture's) table of cameras: Registration ▸ Export ▸ "Internal/External camera parameters".

`#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`, in any order, with `f` in millimetres of a 36 mm wide
film, `px` and `py` as shares of the longer side from the middle of the image, and Brown's terms (t1, t2 in OpenCV's
order). From RealityScan 2 on, the same columns are called `yaw`, `f_35mm`, `px_norm` and `py_norm`. World ← camera
(x right, y up, z backward) is R_z(−heading) R_x(pitch) R_y(roll) with x east, y north, z up: pitch 0 looks straight
down. RealityScan's own templates (calibration.xml) multiply f / 36, px and py by one scale to pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats import column_names, tables
from pipelines.formats.camera_files import CAM_FROM_GL
from pipelines.formats.solved_cameras import PhotoSize, SolvedCameras, SolvedPhotograph, not_placed, solved_cameras
from pipelines.geometry.lens_fit import Brown, ForeignLens, brown_lens

PROGRAM = "RealityScan"
_FILM_MM = 36.0
_NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
_LENS = ("k1", "k2", "k3", "k4", "t1", "t2")
_VOCABULARY = {
    **dict.fromkeys(("name", "image", "filename", "imagename"), "name"),
    **{name: name for name in ("x", "y", "pitch", "roll", "f", "px", "py", *_LENS)},
    **dict.fromkeys(("alt", "z", "altitude"), "alt"),
    **dict.fromkeys(("heading", "yaw"), "heading"),
    **dict.fromkeys(("focal", "focallength", "f35mm"), "f"),
    "pxnorm": "px",
    "pynorm": "py",
}
_WIDEST_FLIGHT_DEG = 0.5


def header_line(lines: list[tuple[int, str]]) -> tuple[int, str] | None:
    """Return number and text of the line that names the columns, or None: this is no such table."""
    for number, text in lines[:5]:
        meanings = {column_names.meaning_of(cell, _VOCABULARY) for cell in text.lstrip("# ").split(",")}
        if {"heading", "pitch", "roll", "f"} <= meanings:
            return number, text
    return None


def read_camera_csv(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    r"""Read the cameras of a table; the photographs' own sizes make pixels of its shares.

    Raises:
        InputError: no such header, a column is missing, a cell is no number, or what `solved_cameras` refuses.

    Examples:
        >>> _ = Path("cameras.csv").write_text(
        ...     "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
        ...     "a.jpg,10,20,50,0,0,0,31.5,0,0,0,0,0,0,0,0\n"
        ... )
        >>> solved = read_camera_csv(Path("cameras.csv"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    lines = tables.numbered_lines(path)
    header = header_line(lines)
    if header is None:
        message = f"No line names the columns {', '.join(_NEEDED)}."
        remedy = "Export Internal/External camera parameters."
        raise InputError("header-missing", message, path=path, remedy=remedy)
    number, text = header
    cells = tables.split(text.lstrip("# "), ",", path=path, line=number)
    columns, _ = tables.named_columns(cells, _VOCABULARY, path, number)
    tables.require_columns(columns, _NEEDED, path, number)
    kept = [(at, line) for at, line in lines if at > number and not line.startswith("#")]
    rows = tables.table_rows(path, kept, ",", columns)
    tables.require_rows(rows, path)
    photographs, lenses = [], {}
    for row in rows:
        name = row.named("name")
        angles = [-row.finite("heading"), row.finite("pitch"), row.finite("roll")]
        world_from_gl = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        size = photo_size(name)
        values = {key: row.finite(key) if key in columns and row.text(key) else 0.0 for key in ("px", "py", *_LENS)}
        focal_mm = row.finite("f")
        key = repr((focal_mm, tuple(values.items()), size))
        if size is not None and key not in lenses:
            if not focal_mm > 0:
                raise row.fault(
                    "focal-length-impossible", f"a focal length of {focal_mm:g} mm is not above zero", "f"
                )
            lenses[key] = _lens(size, focal_mm, values)
        center = np.array([row.finite("x"), row.finite("y"), row.finite("alt")])
        photographs.append(SolvedPhotograph(name, key, world_from_gl @ CAM_FROM_GL.T, center))
    _refuse_degrees(np.array([photograph.center_in_world for photograph in photographs]), path)
    remarks = [not_placed(PROGRAM, "the coordinate system of its export")]
    return solved_cameras(path, PROGRAM, photographs, lenses, photo_size, remarks=remarks)


def _refuse_degrees(center: FloatArray, path: Path) -> None:
    """Refuse positions whose x and y are longitude and latitude: those are no coordinates of one unit with heights.

    Flights span less than half a degree, and heights of metres are far larger than such spans.
    """
    span = np.ptp(center, axis=0)
    within = (np.abs(center[:, :2]) <= (180.0, 90.0)).all() and span[:2].max() < _WIDEST_FLIGHT_DEG
    if within and (span[2] > 10 * span[:2].max() or np.abs(center[:, 2]).max() > 100 * span[:2].max() > 0):
        message = f"x and y span {span[:2].max():.2g}, heights {span[2]:.2g}: they are longitude and latitude."
        remedy = "Export the cameras in a projected or local coordinate system."
        raise InputError("positions-in-degrees", message, path=path, field="x, y", remedy=remedy)


def _lens(size: tuple[int, int], focal_mm: float, values: dict[str, float]) -> ForeignLens:
    side = max(size)
    focal = focal_mm / _FILM_MM * side
    return brown_lens(
        Brown(
            size,
            (focal, focal),
            (size[0] / 2 + values["px"] * side, size[1] / 2 + values["py"] * side),
            radial=(values["k1"], values["k2"], values["k3"], values["k4"]),
            tangential=(values["t1"], values["t2"]),
        )
    )
