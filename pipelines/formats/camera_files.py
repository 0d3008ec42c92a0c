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
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.files import replace_text
from pipelines.core.products import dump_json
from pipelines.core.types import FloatArray
from pipelines.formats.tables import table_text
from pipelines.geometry.cameras import RATIONAL_MODELS, Camera, distort, named_parameters, parameters_in, undistort
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
    place = {"w": camera.width, "h": camera.height, "fl_x": named["fx"], "fl_y": named["fy"]}
    place |= {name: named[name] for name in ("cx", "cy")}
    if camera.model.endswith("FISHEYE"):
        same = parameters_in(camera, FISHEYE)
        if same is None:
            start = Camera(FISHEYE, camera.width, camera.height, np.array([*place.values()][2:] + [0.0] * 4))
            fitted, error = nearest_camera(ForeignLens(start, partial(distort, camera)))
            same = fitted.params
        names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")
        return Lens(FISHEYE, {**place, **dict(zip(names, same.tolist(), strict=True))}, error)
    terms = ("k1", "k2", "k3", "p1", "p2")
    if camera.model in RATIONAL_MODELS and not any(named.get(name) for name in ("k4", "k5", "k6")):
        return Lens("OPENCV", {**place, **{name: named.get(name, 0.0) for name in terms}}, 0.0)
    fitted, error = _polynomial(camera, named)
    return Lens("OPENCV", {**place, **dict(zip(("fl_x", "fl_y", *terms), fitted, strict=True))}, error)


def _polynomial(camera: Camera, named: dict[str, float]) -> tuple[list[float], float]:
    """Return fx, fy, k1, k2, k3, p1, p2 of the polynomial nearest to a lens, and its largest error in pixels."""
    x, y = (np.linspace(0.0, side, _LENS_SAMPLES) for side in (camera.width, camera.height))
    ray = undistort(camera, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    ray = ray[np.isfinite(ray).all(axis=1)]
    x, y = ray.T
    r2, none = x * x + y * y, np.zeros(len(ray))
    powers = np.stack([r2, r2**2, r2**3], axis=-1)
    # Linear in fx, fy, and the other terms times their mean.
    by_x = np.column_stack([x, none, x[:, None] * powers, 2 * x * y, r2 + 2 * x * x])
    by_y = np.column_stack([none, y, y[:, None] * powers, r2 + 2 * y * y, 2 * x * y])
    design = np.concatenate([by_x * named["fx"], by_y * named["fy"]])
    target = (distort(camera, ray) - [named["cx"], named["cy"]]).T.ravel()
    gain_x, gain_y, *terms = np.linalg.lstsq(design, target, rcond=None)[0].tolist()
    # The terms are multiplied by the fitted focal lengths where the file is read.
    gain = (gain_x + gain_y) / 2
    fitted = [gain_x * named["fx"], gain_y * named["fy"], *(term / gain for term in terms)]
    solution = np.array([gain_x, gain_y, *(term / gain for term in terms)])
    scale = np.repeat([gain_x, gain_y], len(ray))
    error = design[:, :2] @ solution[:2] + scale * (design[:, 2:] @ solution[2:]) - target
    return fitted, float(np.hypot(*error.reshape(2, -1)).max())


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
