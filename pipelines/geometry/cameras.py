"""Cameras with lens distortion: pixels ↔ rays, by COLMAP's camera models.

Pixels have the centre of the top-left pixel at (0.5, 0.5). Rays are normalised coordinates (x/z, y/z) in the
camera frame: x right, y down, z forward. The models are those of COLMAP's library. `Lenses` holds the cameras of
all images with their parameters as one vector, which an adjustment changes.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray

# Parameters of COLMAP's camera models in its order; `f` is the focal length of both axes. Its panoramas have none.
_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "THIN_PRISM_FISHEYE": "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1",
    "RAD_TAN_THIN_PRISM_FISHEYE": "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3",
    "FOV": "fx fy cx cy omega",
    "SIMPLE_DIVISION": "f cx cy k",
    "DIVISION": "fx fy cx cy k",
    "EUCM": "fx fy cx cy alpha beta",
}
MODELS = tuple(_PARAMETERS)
# Models of one family are special cases of its last.
RATIONAL_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE_MODELS = ("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
LENGTHS = frozenset({"f", "fx", "fy", "cx", "cy"})  # parameters in pixels; all others have no unit

_MISSED_PX = (
    1e-3  # between a pixel and its ray's, beyond which the ray is another's; COLMAP's iteration leaves 1e-6
)

# Classes of pycolmap, by name: a file that mentions one does not load the library.
Reconstruction = Any
ColmapDatabase = Any
ColmapCamera = Any
ColmapImage = Any
BundleOptions = Any  # pycolmap.BundleAdjustmentOptions
BundleConfig = Any  # pycolmap.BundleAdjustmentConfig


def pycolmap_module() -> Any:
    """Return pycolmap, imported so that the process's signals stay as they are.

    On import, pycolmap handles SIGTERM by a stack trace and the end of the process: an interrupted stage would not
    end cleanly.
    """
    import pycolmap

    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGTERM)  # Python's own record, which the import has not changed
        signal.signal(signal.SIGTERM, signal.SIG_DFL if handler is None else handler)
    return pycolmap


@dataclass(frozen=True)
class Pinhole:
    """Undistorted camera: size and intrinsics in pixels; the centre of the top-left pixel is (0.5, 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def limited(self, max_size_px: int) -> Pinhole:
        """Return the camera of the same view, scaled down to `max_size_px` along the longer side at most."""
        scale = min(1.0, max_size_px / max(self.width, self.height))
        width, height = max(1, round(self.width * scale)), max(1, round(self.height * scale))
        sx, sy = width / self.width, height / self.height
        return Pinhole(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def slopes(self) -> tuple[FloatArray, FloatArray]:
        """Return x/z (W,) of the columns and y/z (H,) of the rows, at the centres of pixels."""
        x = (np.arange(self.width, dtype=np.float64) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height, dtype=np.float64) + 0.5 - self.cy) / self.fy
        return np.asarray(x), np.asarray(y)

    def rays(self, xy_px: ArrayLike) -> FloatArray:
        """Return viewing rays (…, 3) of pixels (…, 2) in the camera frame, with z = 1."""
        slope = (np.asarray(xy_px, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        return np.concatenate([slope, np.ones((*slope.shape[:-1], 1))], axis=-1)

    def project(self, in_cam: ArrayLike) -> FloatArray:
        """Return the pixels (…, 2) of points (…, 3) in the camera frame; NaN for points that are not before it."""
        point = np.asarray(in_cam, dtype=np.float64)
        depth = np.where(point[..., 2:] > 0, point[..., 2:], np.nan)
        return np.asarray(point[..., :2] / depth * [self.fx, self.fy] + [self.cx, self.cy])

    def contains(self, xy_px: ArrayLike) -> BoolArray:
        """Return whether pixels (…, 2) lie within the image, as (…,); NaN does not."""
        xy = np.asarray(xy_px, dtype=np.float64)
        return np.asarray(((xy >= 0) & (xy < (self.width, self.height))).all(axis=-1))

    def points_at(self, depth_m: ArrayLike) -> FloatArray:
        """Return the points (H W, 3) in the camera frame, row by row, of depths (H, W) in metres along z."""
        depth = np.asarray(depth_m, dtype=np.float64)
        row, column = np.divmod(np.arange(depth.size), self.width)
        return depth.reshape(-1, 1) * self.rays(np.stack([column, row], axis=1) + 0.5)


@dataclass(frozen=True)
class ViewPose:
    """Undistorted camera of H × W pixels, with its rotation (3, 3) and centre (3,), metres in `model`."""

    pinhole: Pinhole
    cam_from_model: FloatArray
    center_in_model: FloatArray

    def rays(self) -> FloatArray:
        """Return viewing rays (H, W, 3) along the axes of `model`, of length one along the optical axis."""
        (x, y), (right, down, ahead) = self.pinhole.slopes(), self.cam_from_model
        return np.asarray(y[:, None, None] * down + (x[:, None] * right + ahead))

    def rays_along(self, direction_in_model: FloatArray) -> FloatArray:
        """Return the components (H, W) of the `rays` along a direction (3,)."""
        (x, y), (right, down, ahead) = self.pinhole.slopes(), self.cam_from_model @ direction_in_model
        return np.asarray(y[:, None] * down + (x * right + ahead))


def pose_matrix(cam_from_world: FloatArray, cam_center_in_world: FloatArray) -> FloatArray:
    """Return the pose (4, 4) cam ← world of a camera with a rotation (3, 3) and a centre (3,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = cam_from_world
    matrix[:3, 3] = -cam_from_world @ cam_center_in_world
    return matrix


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a COLMAP camera model such as OPENCV, with its parameters (P,); lengths are in pixels."""

    model: str
    width: int
    height: int
    params: FloatArray

    @property
    def mean_focal_px(self) -> float:
        return float(focal_and_center(self)[:2].mean())


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of a camera's parameters in COLMAP's order; `f` is the focal length of both axes.

    Raises:
        InputError: unknown camera model, a wrong number of parameters, or a focal length that is not positive.
    """
    listed = _PARAMETERS.get(camera.model)
    if listed is None:
        message = f"The camera model {camera.model} is not supported."
        remedy = f"Use one of {', '.join(MODELS)}."
        raise InputError("camera-model-unknown", message, remedy=remedy)
    names = tuple(listed.split())
    if len(camera.params) != len(names):
        message = f"The camera model {camera.model} has {len(names)} parameters, not {len(camera.params)}."
        raise InputError("camera-parameters", message)
    for name, value in zip(names, camera.params, strict=True):
        if name.startswith("f") and not value > 0:
            raise InputError("focal-length", f"The focal length of {value:g} px is not positive.")
    return names


def named_parameters(camera: Camera) -> dict[str, float]:
    """Return a camera's parameters by name, `fx` and `fy` in place of `f`; raises as `parameter_names`."""
    named = dict(zip(parameter_names(camera), camera.params.tolist(), strict=True))
    focal = named.pop("f", None)
    return named if focal is None else {"fx": focal, "fy": focal, **named}


def focal_and_center(camera: Camera) -> FloatArray:
    """Return fx, fy, cx, cy in pixels; raises as `parameter_names`."""
    named = named_parameters(camera)
    return np.array([named[name] for name in ("fx", "fy", "cx", "cy")])


def parameters_in(camera: Camera, model: str) -> FloatArray | None:
    """Return a camera's parameters in the order of another model; None between lenses of two families.

    What the other model lacks is dropped, and what it has besides is zero. Raises as `parameter_names`.
    """
    if camera.model != model and not any(
        {camera.model, model} <= set(family) for family in (RATIONAL_MODELS, FISHEYE_MODELS)
    ):
        return None
    named = named_parameters(camera)
    return np.array([named["fx"] if name == "f" else named.get(name, 0.0) for name in _PARAMETERS[model].split()])


def undistort(camera: Camera, xy_px: ArrayLike) -> FloatArray:
    """Return rays (…, 2) as (x/z, y/z) of pixels (…, 2); NaN where the lens model maps no ray to the pixel.

    Raises:
        InputError: unknown camera model, a wrong number of parameters, or a focal length that is not positive.
    """
    pixel = np.asarray(xy_px, dtype=np.float64)
    flat, lens = pixel.reshape(-1, 2), _colmap_camera(camera)
    ray = np.array(lens.cam_from_img(flat)).reshape(-1, 2)
    # Of a pixel at 90° or more from the axis, which no (x/z, y/z) has, COLMAP returns some other ray.
    missed = ~(np.abs(lens.img_from_cam(_ahead(ray)) - flat) <= _MISSED_PX).all(axis=1)
    ray[missed] = np.nan
    return ray.reshape(pixel.shape)


def project(camera: Camera, point_in_cam: ArrayLike) -> FloatArray:
    """Return pixels (…, 2) of points (…, 3) in the camera frame; NaN behind the camera; raises as `undistort`."""
    point = np.asarray(point_in_cam, dtype=np.float64)
    pixel = np.array(_colmap_camera(camera).img_from_cam(point.reshape(-1, 3))).reshape(*point.shape[:-1], 2)
    pixel[~(point[..., 2] > 0)] = np.nan
    return pixel


def project_each(cameras: dict[int, Camera], camera_of: IntArray, points_in_cam: FloatArray) -> FloatArray:
    """Return pixels (M, 2) of points (M, 3), each in the frame of its camera (M,), a key; NaN as in `project`."""
    pixels = np.empty((len(points_in_cam), 2))
    for key, camera in cameras.items():
        rows = np.flatnonzero(camera_of == key)
        pixels[rows] = project(camera, points_in_cam[rows])
    return pixels


def distort(camera: Camera, ray: ArrayLike) -> FloatArray:
    """Return pixels (…, 2) of rays (…, 2) given as (x/z, y/z); raises as `undistort`."""
    return project(camera, _ahead(np.asarray(ray, dtype=np.float64)))


def _ahead(ray: FloatArray) -> FloatArray:
    """Return the points (…, 3) of rays (…, 2) at z = 1."""
    return np.concatenate([ray, np.ones((*ray.shape[:-1], 1))], axis=-1)


def _colmap_camera(camera: Camera) -> Any:
    """Return COLMAP's own camera; raises as `parameter_names`."""
    parameter_names(camera)
    size = {"width": camera.width, "height": camera.height}
    return pycolmap_module().Camera(model=camera.model, params=camera.params, **size)


@dataclass(frozen=True)
class CameraPoses:
    """Poses of n cameras in the frame `model`: rotations (n, 3, 3) and centres (n, 3) in metres."""

    cam_from_model: FloatArray
    cam_center_in_model: FloatArray


_STEP = 1e-5  # of a central difference, relative as in `parameter_derivative`
_GRID = 24  # rays along each side of an image that a pinhole is fitted to
_LEAST_RAYS = 8


@dataclass(frozen=True)
class Lenses:
    """Cameras of n images: `camera_id` (n,) are keys of `cameras`.

    Changes of their parameters form one vector (L,): a parameter list for each of `cameras`, in their order. All
    lists have the length of the longest, with zeros beyond a shorter one.
    """

    cameras: dict[int, Camera]
    camera_id: IntArray

    @property
    def longest(self) -> int:
        """Number of parameters of the camera that has most."""
        return max((len(camera.params) for camera in self.cameras.values()), default=0)

    def of(self, image: int) -> Camera:
        return self.cameras[int(self.camera_id[image])]

    def moved(self, change: FloatArray) -> Lenses:
        """Return the lenses with parameters changed by (L,)."""
        rows = np.asarray(change, dtype=np.float64).reshape(len(self.cameras), self.longest)
        cameras = {
            key: replace(camera, params=camera.params + row[: len(camera.params)])
            for (key, camera), row in zip(self.cameras.items(), rows, strict=True)
        }
        return Lenses(cameras, self.camera_id)

    def change_to(self, other: Lenses) -> FloatArray:
        """Return the change (L,) by which `moved` reaches the parameters of another state of the same cameras."""
        change = np.zeros((len(self.cameras), self.longest))
        for row, (key, camera) in zip(change, self.cameras.items(), strict=True):
            row[: len(camera.params)] = other.cameras[key].params - camera.params
        return change.ravel()

    def bearing_jacobian(self, image: IntArray, xy_px: FloatArray) -> FloatArray:
        """Return the derivatives (K, 3, L) of `bearings` of pixels (K, 2) in images (K,) by all parameters.

        The ray of a pixel moves against the pixel of the ray: ∂ray/∂p = −(∂pixel/∂ray)⁻¹ ∂pixel/∂p.
        """
        image, longest = np.asarray(image, dtype=np.int64), self.longest
        jacobian = np.zeros((len(image), 3, len(self.cameras), longest))
        for slot, (key, camera) in enumerate(self.cameras.items()):
            rows = np.flatnonzero(self.camera_id[image] == key)
            ray = undistort(camera, xy_px[rows])
            a, b, c, d = _pixel_by_ray(camera, ray)
            determinant = a * d - b * c
            bearing = _ahead(ray)
            length = np.linalg.norm(bearing, axis=1, keepdims=True)
            bearing /= length
            for index in range(len(camera.params)):
                u, v = parameter_derivative(partial(distort, ray=ray), camera, index, _STEP).T
                moved = np.column_stack([b * v - d * u, c * u - a * v, np.zeros(len(ray))]) / determinant[:, None]
                along = (bearing * moved).sum(axis=1, keepdims=True)
                jacobian[rows, :, slot, index] = (moved - along * bearing) / length
        return jacobian.reshape(len(image), 3, -1)


def _pixel_by_ray(camera: Camera, ray: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the derivatives (K,) ∂u/∂x, ∂u/∂y, ∂v/∂x, ∂v/∂y of the pixels (u, v) of rays (K, 2)."""
    by_x, by_y = (
        (distort(camera, ray + _STEP * axis) - distort(camera, ray - _STEP * axis)) / (2 * _STEP)
        for axis in np.eye(2)
    )
    return by_x[:, 0], by_y[:, 0], by_x[:, 1], by_y[:, 1]


def parameter_derivative(
    function: Callable[[Camera], FloatArray], camera: Camera, index: int, step: float
) -> FloatArray:
    """Return the central difference of a function of a camera by parameter `index`.

    The step is relative to the larger of the parameter's magnitude and 1.
    """
    shift = np.zeros(len(camera.params))
    shift[index] = step * max(1.0, abs(float(camera.params[index])))
    ahead, behind = (function(replace(camera, params=camera.params + sign * shift)) for sign in (1, -1))
    return np.asarray((ahead - behind) / (2 * shift[index]))


def bearings(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Return unit vectors (K, 3) in the camera's frame towards pixels (K, 2); NaN as in `undistort`."""
    ray = _ahead(undistort(camera, xy_px))
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def refit_pinhole(pinhole: Pinhole, before: Camera, after: Camera) -> Pinhole:
    """Return the camera of an image that the lens `before` undistorted to `pinhole`, if the lens is `after`.

    The lens `after` gives each pixel another ray. Least squares in pixels along each axis fits a pinhole to these
    rays, over the part of the image that the photograph covers. The fit is exact for another focal length or
    principal point. Of another distortion, the part beyond the linear stays in the image.
    """
    if before.model == after.model and np.array_equal(before.params, after.params):
        return pinhole
    x, y = ((np.arange(_GRID) + 0.5) * side / _GRID for side in (pinhole.width, pinhole.height))
    pixel = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    raw = distort(before, pinhole.rays(pixel)[:, :2])
    ray = undistort(after, raw)
    covered = ((raw >= 0) & (raw <= [before.width, before.height])).all(axis=1) & np.isfinite(ray).all(axis=1)
    if covered.sum() < _LEAST_RAYS:
        return pinhole
    fitted = [np.polynomial.polynomial.polyfit(ray[covered, k], pixel[covered, k], 1) for k in (0, 1)]
    (cx, fx), (cy, fy) = ((float(offset), float(slope)) for offset, slope in fitted)
    return replace(pinhole, fx=fx, fy=fy, cx=cx, cy=cy)
