"""Cameras with lens distortion: pixels ↔ rays, for COLMAP's camera models.

Pixels have the centre of the top-left pixel at (0.5, 0.5). Rays are normalised coordinates (x/z, y/z) in the
camera frame: x right, y down, z forward. Every model is brought into one of two forms, OpenCV's rational lens
(FULL_OPENCV, of which the simpler models are special cases) or the equidistant fisheye. `Lenses` holds the cameras
of all images with their parameters as one vector, which an adjustment changes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray

# Slots of each of COLMAP's parameters: fx fy cx cy | k1 k2 p1 p2 k3 k4 k5 k6 (fisheye: k1 k2 k3 k4).
_LAYOUT: dict[str, tuple[tuple[int, ...], ...]] = {
    "SIMPLE_PINHOLE": ((0, 1), (2,), (3,)),
    "PINHOLE": ((0,), (1,), (2,), (3,)),
    "SIMPLE_RADIAL": ((0, 1), (2,), (3,), (4,)),
    "RADIAL": ((0, 1), (2,), (3,), (4,), (5,)),
    "OPENCV": tuple((slot,) for slot in range(8)),
    "FULL_OPENCV": tuple((slot,) for slot in range(12)),
    "OPENCV_FISHEYE": tuple((slot,) for slot in range(8)),
}
MODELS = tuple(_LAYOUT)
_SLOT_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_SLOT_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")
LENGTHS = frozenset({"f", "fx", "fy", "cx", "cy"})  # parameters in pixels; all others have no unit

_MAX_NEWTON_STEPS = 30
_TOLERANCE = 1e-11  # of normalised coordinates: 1e-8 px at f = 1000 px


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
        x, y = np.meshgrid(np.arange(self.pinhole.width) + 0.5, np.arange(self.pinhole.height) + 0.5)
        return self.pinhole.rays(np.stack([x, y], axis=-1)) @ self.cam_from_model


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
        return float(full_parameters(self)[:2].mean())


def parameter_names(camera: Camera) -> tuple[str, ...]:
    """Return the names of a camera's parameters in COLMAP's order; `f` is the focal length of both axes."""
    names = _FISHEYE_SLOT_NAMES if _is_fisheye(camera) else _SLOT_NAMES
    return tuple("f" if len(slots) > 1 else names[slots[0]] for slots in _LAYOUT[camera.model])


def parameters_in(camera: Camera, model: str) -> FloatArray | None:
    """Return a camera's parameters in the order of another model; None between a fisheye and other lenses.

    What the other model lacks is dropped, and what it has besides is zero. Raises as `undistort`.
    """
    full = full_parameters(camera)
    if _is_fisheye(camera) != (model == "OPENCV_FISHEYE"):
        return None
    return np.asarray(full[[slots[0] for slots in _LAYOUT[model]]])


def undistort(camera: Camera, xy_px: ArrayLike) -> FloatArray:
    """Return rays (…, 2) as (x/z, y/z) of pixels (…, 2); NaN where the lens model maps no ray to the pixel.

    Newton's method inverts the distortion, with its analytic derivative. A solution beyond the fold of the radial
    polynomial (where the polynomial stops being one to one) is refused.

    Raises:
        InputError: unknown camera model, or a wrong number of parameters.
    """
    focal, center, distortion = np.split(full_parameters(camera), [2, 4])
    target = (np.asarray(xy_px, dtype=np.float64) - center) / focal
    if not distortion.any() and camera.model != "OPENCV_FISHEYE":
        return target
    flat = target.reshape(-1, 2)
    rays = _undistort_fisheye(flat, distortion) if _is_fisheye(camera) else _undistort_rational(flat, distortion)
    return rays.reshape(target.shape)


def project(camera: Camera, point_in_cam: ArrayLike) -> FloatArray:
    """Return pixels (…, 2) of points (…, 3) in the camera frame; NaN behind the camera; raises as `undistort`."""
    point = np.asarray(point_in_cam, dtype=np.float64)
    depth = np.where(point[..., 2:] > 0, point[..., 2:], np.nan)
    return distort(camera, point[..., :2] / depth)


def project_each(cameras: dict[int, Camera], camera_of: IntArray, points_in_cam: FloatArray) -> FloatArray:
    """Return pixels (M, 2) of points (M, 3), each in the frame of its camera (M,), a key; NaN as in `project`."""
    pixels = np.empty((len(points_in_cam), 2))
    for key, camera in cameras.items():
        rows = np.flatnonzero(camera_of == key)
        pixels[rows] = project(camera, points_in_cam[rows])
    return pixels


def distort(camera: Camera, ray: ArrayLike) -> FloatArray:
    """Return pixels (…, 2) of rays (…, 2) given as (x/z, y/z); raises as `undistort`."""
    focal, center, distortion = np.split(full_parameters(camera), [2, 4])
    normalised = np.asarray(ray, dtype=np.float64)
    flat = normalised.reshape(-1, 2)
    bent = _distort_fisheye(flat, distortion) if _is_fisheye(camera) else _distort_rational(flat, distortion)[0]
    return bent.reshape(normalised.shape) * focal + center


def _is_fisheye(camera: Camera) -> bool:
    return camera.model == "OPENCV_FISHEYE"


def full_parameters(camera: Camera) -> FloatArray:
    """Return fx fy cx cy, then k1 k2 p1 p2 k3 k4 k5 k6 (fisheye: k1 k2 k3 k4), zero for terms that the model lacks.

    Raises as `undistort`.
    """
    layout = _LAYOUT.get(camera.model)
    if layout is None:
        message = f"The camera model {camera.model} is not supported. Use one of {', '.join(MODELS)}."
        raise InputError("camera-model-unknown", message)
    if len(camera.params) != len(layout):
        message = f"The camera model {camera.model} has {len(layout)} parameters, not {len(camera.params)}."
        raise InputError("camera-parameters", message)
    full = np.zeros(12)
    for value, slots in zip(camera.params, layout, strict=True):
        full[list(slots)] = value
    if not (full[:2] > 0).all():
        raise InputError("focal-length", f"The focal length of {full[0]:g} px is not positive.")
    return full


def _distort_rational(ray: FloatArray, lens: FloatArray) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return distorted rays (N, 2) and the derivative's entries (du/dx, du/dy = dv/dx, dv/dy), each (N,)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens
    x, y = ray[:, 0], ray[:, 1]
    r2 = x * x + y * y
    numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    gain = numerator / denominator
    slope = (k1 + r2 * (2 * k2 + r2 * 3 * k3) - gain * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator
    u = x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * gain + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    du_dx = gain + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
    dv_dy = gain + 2 * slope * y * y + 2 * p2 * x + 6 * p1 * y
    mixed = 2 * slope * x * y + 2 * p1 * x + 2 * p2 * y
    return np.stack([u, v], axis=-1), (du_dx, mixed, dv_dy)


def _undistort_rational(target: FloatArray, lens: FloatArray) -> FloatArray:
    ray = target.copy()
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            bent, (a, b, c) = _distort_rational(ray, lens)
            residual = target - bent
            if not (np.abs(residual) > _TOLERANCE).any():
                break
            determinant = a * c - b * b
            ray[:, 0] += (c * residual[:, 0] - b * residual[:, 1]) / determinant
            ray[:, 1] += (a * residual[:, 1] - b * residual[:, 0]) / determinant
        bent, (a, b, c) = _distort_rational(ray, lens)
        solved = (np.abs(target - bent) <= 10 * _TOLERANCE).all(axis=1) & (a * c - b * b > 0) & (a + c > 0)
    return np.where(solved[:, None], ray, np.nan)


def _fisheye_angle(theta: FloatArray, lens: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distorted angle and its derivative; `lens` holds k1 … k4."""
    t2 = theta * theta
    k1, k2, k3, k4 = lens[:4]
    bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return bent, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _distort_fisheye(ray: FloatArray, lens: FloatArray) -> FloatArray:
    radius = np.hypot(ray[:, 0], ray[:, 1])
    bent, _ = _fisheye_angle(np.arctan(radius), lens)
    return ray * np.where(radius > 1e-12, bent / np.maximum(radius, 1e-12), 1.0)[:, None]


def _undistort_fisheye(target: FloatArray, lens: FloatArray) -> FloatArray:
    bent = np.hypot(target[:, 0], target[:, 1])
    theta = np.minimum(bent, 1.5)
    with np.errstate(all="ignore"):
        for _ in range(_MAX_NEWTON_STEPS):
            value, slope = _fisheye_angle(theta, lens)
            if not (np.abs(value - bent) > _TOLERANCE).any():
                break
            theta = theta + (bent - value) / slope
        value, slope = _fisheye_angle(theta, lens)
        # A ray at or beyond 90° has no (x/z, y/z).
        solved = (np.abs(value - bent) <= 10 * _TOLERANCE) & (slope > 0) & (theta >= 0) & (theta < np.pi / 2)
        stretch = np.where(bent > 1e-12, np.tan(theta) / np.maximum(bent, 1e-12), 1.0)
    return np.where(solved[:, None], target * stretch[:, None], np.nan)


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
        """Return the derivatives (K, 3, L) of `bearings` of pixels (K, 2) in images (K,) by all parameters."""
        image, longest = np.asarray(image, dtype=np.int64), self.longest
        jacobian = np.zeros((len(image), 3, len(self.cameras), longest))
        for slot, (key, camera) in enumerate(self.cameras.items()):
            rows = np.flatnonzero(self.camera_id[image] == key)
            for index in range(len(camera.params)):
                bearings_of = partial(bearings, xy_px=xy_px[rows])
                jacobian[rows, :, slot, index] = parameter_derivative(bearings_of, camera, index, _STEP)
        return jacobian.reshape(len(image), 3, -1)


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
    ray = undistort(camera, xy_px)
    ray = np.concatenate([ray, np.ones((len(ray), 1))], axis=1)
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
