"""Plane-sweep stereo: at which of many parallel planes does a photograph look like its neighbours?

After Collins (doi 10.1109/CVPR.1996.517097) and, for planes along a scene's dominant direction, Gallup et al.
(doi 10.1109/CVPR.2007.383245). Photographs are compared by normalised cross-correlation, which exposure does not
change. Only the neighbours that agree best count, as in Kang, Szeliski & Chai (doi 10.1109/CVPR.2001.990462),
since whatever stands in front of a place does so from some sides only. A guided filter averages the correlations of
each plane, but not across edges of the photograph (Rhemann et al., doi 10.1109/CVPR.2011.5995372): ground without
texture needs a wide window, and beside a roof's edge a wide window sees the roof.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry.cameras import Pinhole
from pipelines.products import FloatArray

FloatImage = NDArray[np.float32]

_NOISE_VARIANCE = 0.3  # grey levels²: what varies less than the sensor's noise does not correlate
_UNSEEN = -1.0  # correlation where a neighbour does not look


@dataclass(frozen=True)
class StereoCamera:
    """A camera in a frame `world` in metres.

    Attributes:
        pinhole: of H × W pixels.
        cam_from_world: (3, 3) rotation.
        center_in_world: (3,).
    """

    pinhole: Pinhole
    cam_from_world: FloatArray
    center_in_world: FloatArray

    def rays(self) -> FloatArray:
        """Viewing rays (H, W, 3) in `world`, of length one along the optical axis."""
        x, y = np.meshgrid(np.arange(self.pinhole.width) + 0.5, np.arange(self.pinhole.height) + 0.5)
        return np.asarray(self.pinhole.rays(np.stack([x, y], axis=-1)) @ self.cam_from_world)


@dataclass(frozen=True)
class StereoView:
    """A photograph with its camera.

    Attributes:
        camera: of H × W pixels.
        grey: (H, W), 1 … 256; 0 where the photograph shows nothing.
    """

    camera: StereoCamera
    grey: FloatImage


@dataclass(frozen=True)
class Planes:
    """Parallel planes: normal · X = offset.

    Attributes:
        normal_in_world: (3,) unit vector.
        offset_m: (D,) monotonic, at least three.
    """

    normal_in_world: FloatArray
    offset_m: FloatArray

    def depth(self, camera: StereoCamera, offset_m: FloatImage) -> FloatArray:
        """Depth (H, W) along the optical axis at which the rays of a camera meet planes of offsets (H, W)."""
        with np.errstate(divide="ignore"):
            distance = offset_m - self.normal_in_world @ camera.center_in_world
            return np.asarray(distance / (camera.rays() @ self.normal_in_world))


@dataclass(frozen=True)
class Swept:
    """The best plane at each pixel.

    Attributes:
        offset_m: (H, W) between the planes where a parabola through the neighbouring scores says so; NaN where
            none lies in front of the camera.
        score: (H, W) correlation, −1 … 1.
        step_m: (H, W) distance between the planes there.
        sharpness: (H, W) 1/m², minus the second derivative of the score by the offset: small where neighbours look
            from nearly the same place, or see little texture. The σ of the offset goes with its inverse.
    """

    offset_m: FloatImage
    score: FloatImage
    step_m: FloatImage
    sharpness: FloatImage


@dataclass(frozen=True)
class SweepSettings:
    """How to compare.

    Attributes:
        window_px: side of the window that is compared, odd.
        reach_px: correlations are averaged over so many pixels around,
        edge_grey: but not across edges of more than so many grey levels.
        views: of the neighbours, so many that agree best count.
    """

    window_px: int = 5
    reach_px: int = 6
    edge_grey: float = 10.0
    views: int = 3


def plane_sweep(
    reference: StereoView, neighbours: list[StereoView], planes: Planes, settings: SweepSettings
) -> Swept:
    """Compare a view with its neighbours on every plane.

    Memory does not depend on the number of planes. Time: planes × neighbours × pixels.

    Args:
        reference: view to find the surface of.
        neighbours: one or more views of the same place from elsewhere.
        planes: hypotheses.
        settings: how to compare.

    Raises:
        ValueError: no neighbours, or fewer than three planes.
    """
    if not neighbours or len(planes.offset_m) < 3:
        raise ValueError(f"{len(neighbours)} neighbours and {len(planes.offset_m)} planes are too few to sweep")
    correlation = _Correlation(reference.grey, settings.window_px)
    smooth = cv2.ximgproc.createGuidedFilter(reference.grey, settings.reach_px, settings.edge_grey**2)
    used = min(settings.views, len(neighbours))
    # Rays meet a plane in front of the camera where both lie on one side of it.
    sign = reference.camera.rays() @ planes.normal_in_world
    own = planes.normal_in_world @ reference.camera.center_in_world
    peak = _Peak(reference.grey.shape)
    for offset in planes.offset_m:
        scores = (correlation(_seen_on_plane(reference, view, planes, offset)) for view in neighbours)
        best = np.asarray(smooth.filter(_mean_of_best(scores, used)), dtype=np.float32)
        best[~(sign * (offset - own) > 0)] = _UNSEEN
        peak.add(best)
    return peak.result(planes.offset_m)


def _mean_of_best(scores: Iterable[FloatImage], count: int) -> FloatImage:
    """Mean (H, W) of the `count` largest scores at each pixel."""
    largest: list[FloatImage] = []
    for score in scores:
        rest = score
        for place, kept in enumerate(largest):
            largest[place], rest = np.maximum(kept, rest), np.minimum(kept, rest)
        if len(largest) < count:
            largest.append(rest)
    return np.asarray(sum(largest[1:], start=largest[0]) / np.float32(count))


def _seen_on_plane(reference: StereoView, other: StereoView, planes: Planes, offset_m: float) -> FloatImage:
    """What `other` shows of the plane, at the pixels of `reference`; 0 where it shows nothing."""
    here, there, pinhole = reference.camera, other.camera, reference.camera.pinhole
    turn = there.cam_from_world @ here.cam_from_world.T
    shift = there.cam_from_world @ (here.center_in_world - there.center_in_world)
    normal_in_cam = here.cam_from_world @ planes.normal_in_world
    distance = offset_m - planes.normal_in_world @ here.center_in_world
    if abs(distance) < 1e-9:
        return np.zeros_like(reference.grey)
    by_ray = turn + np.outer(shift, normal_in_cam) / distance
    homography = _matrix(there.pinhole) @ by_ray @ np.linalg.inv(_matrix(pinhole))
    image = cv2.warpPerspective(
        other.grey,
        homography,
        (pinhole.width, pinhole.height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    width, height = pinhole.width, pinhole.height
    corners = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]])
    if not (corners @ homography[2] > 0).all():  # part of the plane lies behind the other camera
        x, y = np.arange(width), np.arange(height)[:, None]
        image[homography[2, 0] * x + homography[2, 1] * y + homography[2, 2] <= 0] = 0
    return np.asarray(image, dtype=np.float32)


def _matrix(camera: Pinhole) -> FloatArray:
    """Calibration matrix that counts from the centre of the first pixel, as OpenCV does."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])


class _Correlation:
    """Normalised cross-correlation of one image with others, over square windows."""

    def __init__(self, image: FloatImage, window_px: int) -> None:
        self._image, self._window = image, (window_px, window_px)
        self._mean = self._smooth(image)
        variance = self._smooth(image * image) - self._mean * self._mean
        self._inverse_sigma = 1 / np.sqrt(np.maximum(variance, _NOISE_VARIANCE))

    def __call__(self, other: FloatImage) -> FloatImage:
        """Correlation (H, W); −1 where `other` is 0."""
        mean = self._smooth(other)
        variance = self._smooth(other * other)
        variance -= mean * mean
        np.maximum(variance, _NOISE_VARIANCE, out=variance)
        found = self._smooth(self._image * other)
        found -= self._mean * mean
        found *= self._inverse_sigma
        found /= np.sqrt(variance, out=variance)
        found[other == 0] = _UNSEEN
        return found

    def _smooth(self, image: FloatImage) -> FloatImage:
        return np.asarray(cv2.boxFilter(image, -1, self._window, borderType=cv2.BORDER_REFLECT), np.float32)


class _Peak:
    """The largest of a sequence of score images, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._place = np.zeros(shape, dtype=np.int64)
        self._best, self._before, self._after = (np.full(shape, -2.0, dtype=np.float32) for _ in range(3))
        self._last = np.full(shape, -2.0, dtype=np.float32)

    def add(self, score: FloatImage) -> None:
        """The next plane's scores."""
        follows = (self._place == self._count - 1) & (self._count > 0)
        np.copyto(self._after, score, where=follows)
        better = score > self._best
        np.copyto(self._before, self._last, where=better)
        np.copyto(self._after, np.float32(-2.0), where=better)
        np.copyto(self._best, score, where=better)
        self._place[better] = self._count
        self._last = score
        self._count += 1

    def result(self, offset_m: FloatArray) -> Swept:
        """Refine each peak by the parabola through it and its neighbours, where it has two."""
        inner = (self._before > _UNSEEN) & (self._after > _UNSEEN)
        curvature = np.minimum(self._before - 2 * self._best + self._after, -1e-6)
        shift = np.where(inner, 0.5 * (self._before - self._after) / curvature, 0.0).clip(-0.5, 0.5)
        offset = np.interp(self._place + shift, np.arange(len(offset_m)), offset_m).astype(np.float32)
        offset[self._best <= _UNSEEN] = np.nan
        step = np.abs(np.gradient(offset_m)).astype(np.float32)[self._place]
        return Swept(offset, self._best, step, np.where(inner, -curvature, 1e-6).astype(np.float32) / step**2)
