"""Plane-sweep stereo: at which of many parallel planes does a photograph look like its neighbours?

After Collins (doi 10.1109/CVPR.1996.517097) and, for planes along a scene's dominant direction, Gallup et al.
(doi 10.1109/CVPR.2007.383245).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.stereo.matching import UNSEEN, Found, Matcher, MatchSettings, Peak

_ROWS = 8  # strips begin and end at multiples of so many
_CLEARLY = 0.05  # of the score: by so much other planes must fit better than the first


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

    def rows(self, part: slice) -> StereoCamera:
        """The camera of some rows of its pictures."""
        pinhole = replace(self.pinhole, height=part.stop - part.start, cy=self.pinhole.cy - part.start)
        return replace(self, pinhole=pinhole)


@dataclass(frozen=True)
class StereoView:
    """A photograph with its camera.

    Attributes:
        camera: of H × W pixels.
        grey: (H, W), 1 … 256; 0 where the photograph shows nothing.
    """

    camera: StereoCamera
    grey: Float32Array

    def rows(self, part: slice) -> StereoView:
        """Some rows of it."""
        return StereoView(self.camera.rows(part), self.grey[part])


@dataclass(frozen=True)
class Planes:
    """Parallel planes: normal · X = offset.

    Attributes:
        normal_in_world: (3,) unit vector.
        offset_m: (D,) monotonic, at least three.
        height_m: lowest and highest place of the scene; beyond, there is nothing to be found on a plane.
    """

    normal_in_world: FloatArray
    offset_m: FloatArray
    height_m: tuple[float, float] = (-math.inf, math.inf)


@dataclass(frozen=True)
class NormalMap:
    """Which way each pixel's surface is taken to face: offsets along that normal tell where it is.

    Attributes:
        normals_in_world: (F, 3) unit vectors.
        which: (H, W) the number of a pixel's own.
    """

    normals_in_world: FloatArray
    index: ByteArray

    @property
    def normal_in_world(self) -> FloatArray:
        """(H, W, 3)."""
        return self.normals_in_world[self.index]

    def offset_per_metre(self, camera: StereoCamera) -> FloatArray:
        """Offset (H, W) that a ray of a camera gains by a metre of depth."""
        return np.asarray(np.einsum("hwi,hwi->hw", camera.rays(), self.normal_in_world))

    def depth(self, camera: StereoCamera, offset_m: Float32Array) -> FloatArray:
        """Depth (H, W) along the optical axis at which the rays of a camera meet planes of offsets (H, W)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(
                (offset_m - self.normal_in_world @ camera.center_in_world) / self.offset_per_metre(camera)
            )

    def offset(self, camera: StereoCamera, depth: Float32Array) -> FloatArray:
        """Offsets (H, W) of the points at depths (H, W) of a camera: the inverse of `depth`."""
        return np.asarray(self.normal_in_world @ camera.center_in_world + depth * self.offset_per_metre(camera))


@dataclass(frozen=True)
class SweepResult:
    """The best plane at each pixel.

    Attributes:
        facing: the direction of that plane.
        offset_m: (H, W) between the planes where a parabola through the neighbouring scores says so; NaN where
            none lies in front of the camera.
        score: (H, W) correlation, −1 … 1.
        step_m: (H, W) distance between the planes there.
        sharpness: (H, W) 1/m², minus the second derivative of the score by the offset: small where neighbours look
            from nearly the same place, or see little texture. The σ of the offset goes with its inverse.
    """

    normals: NormalMap
    offset_m: Float32Array
    score: Float32Array
    step_m: Float32Array
    sharpness: Float32Array


def plane_sweep(
    reference: StereoView, neighbours: list[StereoView], sweeps: list[Planes], settings: MatchSettings
) -> SweepResult:
    """Compare a view with its neighbours on every plane, and keep at each pixel the best of all.

    A window fits best on the planes that face as its surface does: walls need others than the ground.

    Memory does not depend on the number of planes. Time: planes × neighbours × pixels, of those rows that see the
    scene on a plane.

    Args:
        reference: view to find the surface of.
        neighbours: one or more views of the same place from elsewhere.
        sweeps: hypotheses, by direction, the likelier ones first.
        settings: how to compare.

    Raises:
        ValueError: no neighbours, no sweep, or one of fewer than three planes.
    """
    fewest = min((len(planes.offset_m) for planes in sweeps), default=0)
    if not neighbours or fewest < 3:
        raise ValueError(f"{len(neighbours)} neighbours and {fewest} planes are too few to sweep")
    found = [_sweep(reference, neighbours, planes, settings) for planes in sweeps]
    best = np.argmax([each.score - (_CLEARLY if number else 0) for number, each in enumerate(found)], axis=0)
    normals = NormalMap(np.stack([planes.normal_in_world for planes in sweeps]), best.astype(np.uint8))
    offset, score, step, sharpness = (
        np.choose(best, [getattr(each, name) for each in found])
        for name in ("offset_m", "score", "step_m", "sharpness")
    )
    return SweepResult(normals, offset, score, step, sharpness)


def _sweep(
    reference: StereoView, neighbours: list[StereoView], planes: Planes, settings: MatchSettings
) -> SweepResult:
    """The best planes of one direction."""

    @lru_cache(maxsize=1)  # one plane is mostly seen in the rows of the one before
    def strip(first: int, last: int) -> tuple[StereoView, Matcher]:
        view = reference.rows(slice(first, last))
        return view, Matcher(view.grey, settings)

    peak = Peak(reference.grey.shape)
    for offset, there in zip(planes.offset_m, _scene_on(planes, reference.camera), strict=True):
        score = np.full(reference.grey.shape, UNSEEN, np.float32)
        if there.any():
            first, last = _rows(there, settings.support_px)
            view, matcher = strip(first, last)
            score[first:last] = matcher(_seen_on_plane(view, other, planes, offset) for other in neighbours)
            score[~there] = UNSEEN
        peak.add(score)
    found = peak.found()
    offset_m = np.interp(found.place, np.arange(len(planes.offset_m)), planes.offset_m)
    offset_m[found.score <= UNSEEN] = np.nan
    step_m = np.abs(np.gradient(planes.offset_m))[np.rint(found.place).astype(np.int64)]
    normals = NormalMap(planes.normal_in_world[None], np.zeros(offset_m.shape, np.uint8))
    return sweep_result(found, normals, offset_m, step_m)


def _scene_on(planes: Planes, camera: StereoCamera) -> Iterator[BoolArray]:
    """Where (H, W) a camera sees the scene if it lies on a plane, for each of them."""
    rays, center = camera.rays(), camera.center_in_world
    along, (lowest, highest) = rays @ planes.normal_in_world, planes.height_m
    climb = np.divide(rays[..., 2], along, out=np.zeros_like(along), where=along != 0)
    for gap in planes.offset_m - planes.normal_in_world @ center:
        height = center[2] + gap * climb
        # Rays meet a plane in front of the camera where both lie on one side of it.
        yield (gap * along > 0) & (height >= lowest) & (height <= highest)


def _rows(there: BoolArray, around_px: int) -> tuple[int, int]:
    """First row and the one after the last that show something or lie around, of (H, W)."""
    rows = np.flatnonzero(there.any(axis=1))
    first, last = rows[0] - around_px, rows[-1] + 1 + around_px
    return max(int(first) // _ROWS * _ROWS, 0), min(-int(-last // _ROWS) * _ROWS, len(there))


def sweep_result(
    found: Found, normals: NormalMap, offset_m: FloatArray, step_m: FloatArray | Float32Array
) -> SweepResult:
    """What was found, at these offsets (H, W), among hypotheses so far (H, W) apart."""
    sharpness = (found.curvature / step_m**2).astype(np.float32)
    return SweepResult(normals, offset_m.astype(np.float32), found.score, step_m.astype(np.float32), sharpness)


def _seen_on_plane(reference: StereoView, other: StereoView, planes: Planes, offset_m: float) -> Float32Array:
    """What `other` shows of the plane, at the pixels of `reference`; 0 where it shows nothing."""
    here, there, pinhole = reference.camera, other.camera, reference.camera.pinhole
    turn = there.cam_from_world @ here.cam_from_world.T
    shift = there.cam_from_world @ (here.center_in_world - there.center_in_world)
    normal_in_cam = here.cam_from_world @ planes.normal_in_world
    distance = offset_m - planes.normal_in_world @ here.center_in_world
    if abs(distance) < 1e-9:
        return np.zeros_like(reference.grey)
    by_ray = turn + np.outer(shift, normal_in_cam) / distance
    homography = calibration(there.pinhole) @ by_ray @ np.linalg.inv(calibration(pinhole))
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


def calibration(camera: Pinhole) -> FloatArray:
    """Calibration matrix (3, 3) that counts from the centre of the first pixel, as OpenCV does."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
