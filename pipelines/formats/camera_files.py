"""Cameras as files: nerfstudio's `transforms.json`, and a table as CSV.

`transforms.json` (nerfstudio's documentation, "Data conventions"): a frame has `transform_matrix`, world ← camera
with OpenGL's axes (x right, y up, z backward), and the intrinsics of its photograph in pixels, the centre of the
top-left pixel at (0.5, 0.5). One camera model serves all frames: `OPENCV` (k1, k2, k3, p1, p2) or `OPENCV_FISHEYE`
(k1 … k4). `ply_file_path` names points to begin with, in the same frame. Photographs are listed by split where
there are test views: nerfstudio takes the lists of all three splits, or divides the photographs itself.

The table has position, angles in both conventions, and σ; a σ that is not known is an empty cell. `read_trajectory`
reads position, yaw, pitch, roll and σ back, so that a table can be the input of another survey.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.files import replace_text
from pipelines.core.products import dump_json
from pipelines.core.types import FloatArray
from pipelines.formats.tables import table_text
from pipelines.geometry.cameras import Camera, distort, named_parameters, parameters_in, undistort
from pipelines.geometry.lens_fit import FISHEYE, ForeignLens, nearest_camera

CAM_FROM_GL = np.diag([1.0, -1.0, -1.0])
_LENS_SAMPLES = 25  # pixels along each side of an image that a lens is fitted to
_METRES, _DEGREES, _ANGLE = "%.4f", "%.9f", "%.6f"  # 0.1 mm; 0.1 mm on the ground; 1 cm at 500 km
_EASTING_NORTHING = ("x", "y", "z")
_GEOGRAPHIC = ("longitude", "latitude", "altitude")
_MAP_ANGLES = ("omega_deg", "phi_deg", "kappa_deg")
_GIMBAL = ("yaw_deg", "pitch_deg", "roll_deg")
_SIGMA = ("sigma_e_m", "sigma_n_m", "sigma_u_m")
_SIGMA_ANGLES = ("sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg")


@dataclass(frozen=True)
class Frame:
    """Photograph: its name and split, its lens, and its pose world ← camera (x right, y down, z forward)."""

    name: str
    split: str
    camera: Camera
    world_from_cam: FloatArray
    center_in_world: FloatArray


@dataclass(frozen=True)
class Lens:
    """Intrinsics by nerfstudio's names, and the largest distance in the image from the lens they stand for."""

    model: str
    intrinsics: dict[str, float | int]
    error_px: float


def lens_of(camera: Camera) -> Lens:
    """Return the intrinsics of a camera in nerfstudio's terms.

    A lens that is none of OpenCV's polynomials is replaced by the one that least squares fits to it: a fisheye by
    OPENCV_FISHEYE, a rational lens (FULL_OPENCV with k4, k5, k6) or any other by OPENCV with k3.
    """
    named, error = named_parameters(camera), 0.0
    size: dict[str, float | int] = {"w": camera.width, "h": camera.height}
    if camera.model.endswith("FISHEYE"):
        model, terms = FISHEYE, ["k1", "k2", "k3", "k4"]
        values = parameters_in(camera, FISHEYE)
        if values is None:
            start = np.array([*(named[name] for name in ("fx", "fy", "cx", "cy")), 0.0, 0.0, 0.0, 0.0])
            nearest = ForeignLens(replace(camera, model=FISHEYE, params=start), partial(distort, camera))
            fitted, error = nearest_camera(nearest)
            values = fitted.params
    else:
        model, terms = "OPENCV", ["k1", "k2", "p1", "p2", "k3"]
        full = parameters_in(camera, "FULL_OPENCV")
        if full is None or full[9:].any():
            values, error = _polynomial(camera, named)
        else:
            values = full[:9]
    names = ("fl_x", "fl_y", "cx", "cy", *terms)
    return Lens(model, {**size, **dict(zip(names, values.tolist(), strict=True))}, error)


def _polynomial(camera: Camera, named: dict[str, float]) -> tuple[FloatArray, float]:
    """Return fx, fy, cx, cy, k1, k2, p1, p2, k3 of the polynomial nearest to a lens, and its error in pixels."""
    x, y = (np.linspace(0.0, side, _LENS_SAMPLES) for side in (camera.width, camera.height))
    ray = undistort(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    ray = ray[np.isfinite(ray).all(axis=1)]
    x, y = ray.T
    r2, none = x * x + y * y, np.zeros(len(ray))
    # Linear in fx, fy, and each other term times the focal length, which differs little between the axes.
    by_x = np.column_stack([x, none, x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3])
    by_y = np.column_stack([none, y, y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3])
    focal = np.repeat([named["fx"], named["fy"]], len(ray))[:, None]
    target = (distort(camera, ray) - [named["cx"], named["cy"]]).T.ravel()
    solution = np.linalg.lstsq(focal * np.concatenate([by_x, by_y]), target, rcond=None)[0]
    gain, terms = solution[:2], solution[2:] / solution[:2].mean()
    model = np.repeat(gain, len(ray)) * (np.concatenate([x, y]) + np.concatenate([by_x, by_y])[:, 2:] @ terms)
    error = (focal[:, 0] * model - target).reshape(2, -1)
    lens = [*gain * [named["fx"], named["fy"]], named["cx"], named["cy"], *terms]
    return np.array(lens), float(np.hypot(*error).max())


def write_transforms(path: Path, frames: Sequence[Frame], lenses: Sequence[Lens], points: str) -> None:
    """Write `transforms.json` of photographs and their lenses; the file appears whole or not at all.

    `points` is the name of a PLY beside it.

    Raises:
        ValueError: the lenses have different models, or there is no frame.
    """
    models = {lens.model for lens in lenses}
    if len(models) != 1:
        raise ValueError(f"expected one camera model, got {sorted(models)}")
    listed: list[dict[str, Any]] = []
    for frame, lens in zip(frames, lenses, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = frame.world_from_cam @ CAM_FROM_GL, frame.center_in_world
        listed.append({"file_path": frame.name, **lens.intrinsics, "transform_matrix": matrix.tolist()})
    names = {split: [frame.name for frame in frames if frame.split == split] for split in ("train", "test")}
    lists = {"train": names["train"], "val": names["test"], "test": names["test"]} if names["test"] else {}
    splits = {f"{split}_filenames": listing for split, listing in lists.items()}
    document = {"camera_model": models.pop(), "ply_file_path": points, **splits, "frames": listed}
    replace_text(path, dump_json(document) + "\n")


@dataclass(frozen=True)
class CameraTable:
    """Cameras of n photographs."""

    name: tuple[str, ...]
    split: tuple[str, ...]  # of each, `train` or `test`
    position: FloatArray  # (n, 3) in a CRS: easting, northing, height, or longitude, latitude, height
    geographic: bool  # whether the first two are degrees
    omega_phi_kappa_deg: FloatArray  # (n, 3) against the axes of the CRS
    yaw_pitch_roll_deg: FloatArray  # (n, 3) against true north and the vertical
    sigma_enu_m: FloatArray  # (n, 3) along true east, north, up; NaN: not known
    sigma_angles_deg: FloatArray  # (n, 3) of ω, φ, κ; NaN: not known


def write_camera_table(path: Path, table: CameraTable) -> None:
    """Write the table; the file appears whole or not at all."""
    plan = _DEGREES if table.geographic else _METRES
    forms = [plan, plan, _METRES, *[_ANGLE] * 6, *[_METRES] * 3, *[_ANGLE] * 3]
    angles = (table.omega_phi_kappa_deg, table.yaw_pitch_roll_deg)
    numbers = np.concatenate([table.position, *angles, table.sigma_enu_m, table.sigma_angles_deg], axis=1)
    position = _GEOGRAPHIC if table.geographic else _EASTING_NORTHING
    header = ("name", "split", *position, *_MAP_ANGLES, *_GIMBAL, *_SIGMA, *_SIGMA_ANGLES)
    rows = (
        (name, split, *(form % value if np.isfinite(value) else "" for form, value in zip(forms, row, strict=True)))
        for name, split, row in zip(table.name, table.split, numbers, strict=True)
    )
    replace_text(path, table_text((header, *rows)))
