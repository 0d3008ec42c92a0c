"""nerfstudio's `transforms.json`, also in the forms of instant-ngp and of Blender's synthetic scenes.

A frame has `transform_matrix`, camera → world with OpenGL's axes (x right, y up, z backward). Intrinsics stand at
the frame or, for all frames, at the top; a focal length that is missing follows from `camera_angle_x`. k1 … k4 are
factors of r² … r⁸, of a fisheye those of the angle. `camera_files.py` writes the file.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.products import load_json
from pipelines.formats.camera_files import CAM_FROM_GL
from pipelines.formats.solved_cameras import Foreign, PhotoSize, SolvedCameras, SolvedPhotograph, solved_cameras
from pipelines.geometry.lens_fit import FISHEYE, Brown, ForeignLens, brown_lens, fisheye_lens

PROGRAM = "nerfstudio"
_PERSPECTIVE = frozenset({"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"})
_FISHEYES = frozenset({FISHEYE, "FISHEYE"})
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")


class _Intrinsics(Foreign):
    camera_model: str | None = None
    is_fisheye: bool | None = None
    w: float | None = None
    h: float | None = None
    fl_x: float | None = None
    fl_y: float | None = None
    cx: float | None = None
    cy: float | None = None
    camera_angle_x: float | None = None
    camera_angle_y: float | None = None
    k1: float | None = None
    k2: float | None = None
    k3: float | None = None
    k4: float | None = None
    p1: float | None = None
    p2: float | None = None
    distortion_params: list[float] | None = None


class _Frame(_Intrinsics):
    file_path: str
    transform_matrix: list[list[float]]


class _Transforms(_Intrinsics):
    frames: list[_Frame]


def read_transforms(path: Path, photo_size: PhotoSize) -> SolvedCameras:
    """Read the frames of a `transforms.json`; the size of a photograph stands for one that the file lacks.

    Raises:
        InputError: unreadable, not of that form, no focal length, an unknown camera model, or what `solved_cameras`
            refuses.

    Examples:
        >>> import json
        >>> pose = [[1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]]
        >>> frame = {"file_path": "a.jpg", "transform_matrix": pose}
        >>> _ = Path("transforms.json").write_text(json.dumps({"fl_x": 350, "w": 400, "h": 300, "frames": [frame]}))
        >>> solved = read_transforms(Path("transforms.json"), lambda name: (400, 300))
        >>> solved.model.image_name, solved.model.focal_px.tolist()
        (('a.jpg',), [350.0])
    """
    document = load_json(_Transforms, path)
    common = _stated(document)
    photographs, lenses = [], {}
    for number, frame in enumerate(document.frames):
        rows = frame.transform_matrix
        if len(rows) not in (3, 4) or any(len(row) != 4 for row in rows):
            message = f"The matrix of {frame.file_path!r} is not of 4×4 numbers."
            raise InputError("matrix-form", message, path=path, field=f"frames.{number}.transform_matrix")
        matrix = np.array(rows)
        stated = {**common, **_stated(frame)}
        size = photo_size(frame.file_path)
        key = repr((sorted(stated.items(), key=lambda entry: entry[0]), size))
        if key not in lenses and size is not None:
            lenses[key] = _lens(_Intrinsics.model_validate(stated), size, frame.file_path, path)
        photographs.append(SolvedPhotograph(frame.file_path, key, matrix[:3, :3] @ CAM_FROM_GL.T, matrix[:3, 3]))
    return solved_cameras(path, PROGRAM, photographs, lenses, photo_size)


def _stated(intrinsics: _Intrinsics) -> dict[str, object]:
    found = {name: getattr(intrinsics, name) for name in _Intrinsics.model_fields}
    return {name: value for name, value in found.items() if value is not None}


def _lens(stated: _Intrinsics, size: tuple[int, int], name: str, path: Path) -> ForeignLens:
    def fault(code: str, message: str, field: str) -> InputError:
        return InputError(code, f"{message} (photograph {name!r}).", path=path, field=field)

    width = size[0] if stated.w is None else stated.w
    height = size[1] if stated.h is None else stated.h
    if width != round(width) or height != round(height):
        raise fault("lens-impossible", f"A picture has no {width:g}×{height:g} pixels", "w, h")
    across = _focal(stated.fl_x, stated.camera_angle_x, width)
    along = _focal(stated.fl_y, stated.camera_angle_y, height)
    focal = (across if across is not None else along), (along if along is not None else across)
    if focal[0] is None or focal[1] is None or not min(focal[0], focal[1]) > 0:
        raise fault("focal-length-impossible", "There is no focal length above zero", "fl_x")
    listed = dict(zip(_DISTORTION, stated.distortion_params or (), strict=False))
    of = {
        key: next((v for v in (getattr(stated, key), listed.get(key)) if v is not None), 0.0) for key in _DISTORTION
    }
    brown = Brown(
        (round(width), round(height)),
        (focal[0], focal[1]),
        (width / 2 if stated.cx is None else stated.cx, height / 2 if stated.cy is None else stated.cy),
        radial=(of["k1"], of["k2"], of["k3"], of["k4"]),
        tangential=(of["p1"], of["p2"]),
    )
    model = (stated.camera_model or "OPENCV").upper()
    if model in _FISHEYES or stated.is_fisheye:
        return fisheye_lens(brown)
    if model not in _PERSPECTIVE:
        raise fault(
            "lens-not-convertible", f"The camera model {model[:40]!r} has no like in COLMAP", "camera_model"
        )
    return brown_lens(brown)


def _focal(focal: float | None, angle: float | None, side: float) -> float | None:
    """Return the focal length in pixels as stated, or by the angle of view in radians; None: neither is known."""
    if focal is not None or angle is None or not 0 < angle < math.pi:
        return focal
    return side / 2 / math.tan(angle / 2)
