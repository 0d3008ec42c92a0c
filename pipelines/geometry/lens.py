"""Lenses whose parameters change: their parameter vector, its effect on bearings and on undistorted images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.geometry.cameras import Camera, Pinhole, distort, undistort

_STEP = 1e-5  # of a parameter, or of 1 where that is less
_GRID = 24  # rays along each side of an image that a pinhole is fitted to
_LEAST_RAYS = 8


@dataclass(frozen=True)
class Lenses:
    """Cameras of n images.

    Changes of their parameters form one vector (L,): a parameter list for each of `cameras`, in their order. All
    lists have the length of the longest, with zeros beyond a shorter one.

    Attributes:
        cameras: by camera id.
        camera_id: (n,) keys of `cameras`.
    """

    cameras: dict[int, Camera]
    camera_id: IntArray

    @property
    def longest(self) -> int:
        """Number of parameters of the camera that has most."""
        return max((len(camera.params) for camera in self.cameras.values()), default=0)

    def of(self, image: int) -> Camera:
        """Return the camera of an image."""
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
    """Return the central difference of a function of a camera by one of its parameters.

    Args:
        function: of the camera.
        camera: where to differentiate.
        index: of the parameter.
        step: of the parameter, relative to the larger of its magnitude and 1.
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
