"""Lenses whose parameters change: as one vector, what that does to rays, and to undistorted images."""

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
    """The cameras of n images.

    Changes of their parameters make one vector (L,): a list for each of `cameras`, in their order, and each as long
    as the longest, zero beyond a shorter one.

    Attributes:
        cameras: by camera id.
        camera_id: (n,) keys of `cameras`.
    """

    cameras: dict[int, Camera]
    camera_id: IntArray

    @property
    def longest(self) -> int:
        """Parameters of the camera that has most."""
        return max((len(camera.params) for camera in self.cameras.values()), default=0)

    def of(self, image: int) -> Camera:
        """The camera of an image."""
        return self.cameras[int(self.camera_id[image])]

    def moved(self, change: FloatArray) -> Lenses:
        """With parameters changed by (L,)."""
        rows = np.asarray(change, dtype=np.float64).reshape(len(self.cameras), self.longest)
        cameras = {
            key: replace(camera, params=camera.params + row[: len(camera.params)])
            for (key, camera), row in zip(self.cameras.items(), rows, strict=True)
        }
        return Lenses(cameras, self.camera_id)

    def change_to(self, other: Lenses) -> FloatArray:
        """What `moved` would have to be given (L,) to make the parameters those of another state of the same."""
        change = np.zeros((len(self.cameras), self.longest))
        for row, (key, camera) in zip(change, self.cameras.items(), strict=True):
            row[: len(camera.params)] = other.cameras[key].params - camera.params
        return change.ravel()

    def bearings_by_parameters(self, image: IntArray, xy_px: FloatArray) -> FloatArray:
        """Derivatives (K, 3, L) of `bearings` of pixels (K, 2) in images (K,) by all parameters."""
        image, longest = np.asarray(image, dtype=np.int64), self.longest
        found = np.zeros((len(image), 3, len(self.cameras), longest))
        for slot, (key, camera) in enumerate(self.cameras.items()):
            rows = np.flatnonzero(self.camera_id[image] == key)
            for index in range(len(camera.params)):
                towards = partial(bearings, xy_px=xy_px[rows])
                found[rows, :, slot, index] = by_parameter(towards, camera, index, _STEP)
        return found.reshape(len(image), 3, -1)


def by_parameter(function: Callable[[Camera], FloatArray], camera: Camera, index: int, step: float) -> FloatArray:
    """Central difference of a function of a camera by one of its parameters.

    Args:
        step: of the parameter, as a part of it, or of 1 where that is more.
    """
    shift = np.zeros(len(camera.params))
    shift[index] = step * max(1.0, abs(float(camera.params[index])))
    ahead, behind = (function(replace(camera, params=camera.params + sign * shift)) for sign in (1, -1))
    return np.asarray((ahead - behind) / (2 * shift[index]))


def bearings(camera: Camera, xy_px: FloatArray) -> FloatArray:
    """Unit vectors (K, 3) in the camera towards pixels (K, 2); NaN as in `undistort`."""
    ray = undistort(camera, xy_px)
    ray = np.concatenate([ray, np.ones((len(ray), 1))], axis=1)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def pinhole_through(pinhole: Pinhole, before: Camera, after: Camera) -> Pinhole:
    """Camera of an image that was undistorted to `pinhole` with the lens `before`, if the lens is `after`.

    The rays that the pixels then truly have are fitted, over the part of the image that the photograph covers, by
    least squares in pixels along each axis. Exact for another focal length or principal point; what another
    distortion adds beyond the linear stays in the image.
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
