"""Plane-sweep stereo: the plane, among many parallel planes, on which a photograph looks like its neighbours.

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
from pipelines.stereo.matching import UNSEEN, Matcher, MatchSettings, Winner, WinnerTakesAll

_ROWS = 8  # strips begin and end at multiples of this number
_CLEARLY = 0.05  # of the score: margin by which planes of another direction must fit better than the first


@dataclass(frozen=True)
class StereoCamera:
    """Undistorted camera in a metric frame `world`.

    Attributes:
        pinhole: of H × W pixels.
        cam_from_world: (3, 3) rotation.
        center_in_world: (3,).
    """

    pinhole: Pinhole
    cam_from_world: FloatArray
    center_in_world: FloatArray

    def rays(self) -> FloatArray:
        """Return viewing rays (H, W, 3) in `world`, of length one along the optical axis."""
        x, y = np.meshgrid(np.arange(self.pinhole.width) + 0.5, np.arange(self.pinhole.height) + 0.5)
        return np.asarray(self.pinhole.rays(np.stack([x, y], axis=-1)) @ self.cam_from_world)

    def rows(self, part: slice) -> StereoCamera:
        """Return the camera of some rows of its images."""
        pinhole = replace(self.pinhole, height=part.stop - part.start, cy=self.pinhole.cy - part.start)
        return replace(self, pinhole=pinhole)


@dataclass(frozen=True)
class StereoView:
    """Photograph with its camera.

    Attributes:
        camera: of H × W pixels.
        grey: (H, W), 1 … 256; 0 outside the photograph's valid part.
    """

    camera: StereoCamera
    grey: Float32Array

    def rows(self, part: slice) -> StereoView:
        """Return some rows of the view."""
        return StereoView(self.camera.rows(part), self.grey[part])


@dataclass(frozen=True)
class Planes:
    """Parallel planes: normal · X = offset.

    Attributes:
        normal_in_world: (3,) unit vector.
        offset_m: (D,) monotonic, at least three.
        height_m: lowest and highest place of the scene; the parts of planes beyond are not compared.
    """

    normal_in_world: FloatArray
    offset_m: FloatArray
    height_m: tuple[float, float] = (-math.inf, math.inf)


@dataclass(frozen=True)
class NormalMap:
    """Normal of each pixel's surface, one of few; offsets along it locate the surface.

    Attributes:
        normals_in_world: (F, 3) unit vectors.
        index: (H, W) of each pixel's normal.
    """

    normals_in_world: FloatArray
    index: ByteArray

    @property
    def normal_in_world(self) -> FloatArray:
        """Normals (H, W, 3) of the pixels, unit vectors."""
        return self.normals_in_world[self.index]

    def offset_per_metre(self, camera: StereoCamera) -> FloatArray:
        """Return the offset (H, W) that a camera's ray gains by a metre of depth."""
        return np.asarray(np.einsum("hwi,hwi->hw", camera.rays(), self.normal_in_world))

    def depth(self, camera: StereoCamera, offset_m: Float32Array) -> FloatArray:
        """Return depths (H, W) along the optical axis at which a camera's rays meet planes of offsets (H, W)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(
                (offset_m - self.normal_in_world @ camera.center_in_world) / self.offset_per_metre(camera)
            )

    def offset(self, camera: StereoCamera, depth: Float32Array) -> FloatArray:
        """Return offsets (H, W) of the points at depths (H, W) of a camera: inverts `depth`."""
        return np.asarray(self.normal_in_world @ camera.center_in_world + depth * self.offset_per_metre(camera))


@dataclass(frozen=True)
class SweepResult:
    """Best plane at each pixel.

    Attributes:
        normals: direction of that plane.
        offset_m: (H, W) refined between planes by a parabola through the neighbouring scores; NaN if no plane lies
            in front of the camera.
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
    """Compare a view with its neighbours on every plane, and keep the best plane at each pixel.

    A window fits best on planes with the normal of its surface: walls need other planes than the ground. Memory
    does not depend on the number of planes. Time: planes × neighbours × pixels, in the rows that see the scene on a
    plane.

    Args:
        reference: view whose surface is wanted.
        neighbours: one or more views of the same place from elsewhere.
        sweeps: planes by direction, the likelier directions first.
        settings: of the comparison.

    Raises:
        ValueError: no neighbours, no sweep, or one of fewer than three planes.
    """
    fewest = min((len(planes.offset_m) for planes in sweeps), default=0)
    if not neighbours or fewest < 3:
        raise ValueError(f"{len(neighbours)} neighbours and {fewest} planes are too few to sweep")
    results = [_sweep(reference, neighbours, planes, settings) for planes in sweeps]
    best = np.argmax([result.score - (_CLEARLY if number else 0) for number, result in enumerate(results)], axis=0)
    normals = NormalMap(np.stack([planes.normal_in_world for planes in sweeps]), best.astype(np.uint8))
    offset, score, step, sharpness = (
        np.choose(best, [getattr(result, name) for result in results])
        for name in ("offset_m", "score", "step_m", "sharpness")
    )
    return SweepResult(normals, offset, score, step, sharpness)


def _sweep(
    reference: StereoView, neighbours: list[StereoView], planes: Planes, settings: MatchSettings
) -> SweepResult:
    """Return the best planes of one direction."""

    @lru_cache(maxsize=1)  # the rows of a plane are mostly those of the plane before
    def strip(first: int, last: int) -> tuple[StereoView, Matcher]:
        view = reference.rows(slice(first, last))
        return view, Matcher(view.grey, settings)

    search = WinnerTakesAll(reference.grey.shape)
    for offset, visible in zip(planes.offset_m, _visible_scene(planes, reference.camera), strict=True):
        score = np.full(reference.grey.shape, UNSEEN, np.float32)
        if visible.any():
            first, last = _row_range(visible, settings.support_px)
            view, matcher = strip(first, last)
            score[first:last] = matcher(_warp_by_plane(view, other, planes, offset) for other in neighbours)
            score[~visible] = UNSEEN
        search.add(score)
    winner = search.winner()
    offset_m = np.interp(winner.hypothesis, np.arange(len(planes.offset_m)), planes.offset_m)
    offset_m[winner.score <= UNSEEN] = np.nan
    step_m = np.abs(np.gradient(planes.offset_m))[np.rint(winner.hypothesis).astype(np.int64)]
    normals = NormalMap(planes.normal_in_world[None], np.zeros(offset_m.shape, np.uint8))
    return sweep_result(winner, normals, offset_m, step_m)


def _visible_scene(planes: Planes, camera: StereoCamera) -> Iterator[BoolArray]:
    """Yield for each plane the mask (H, W) of the pixels that see the scene on it."""
    rays, center = camera.rays(), camera.center_in_world
    along, (lowest, highest) = rays @ planes.normal_in_world, planes.height_m
    climb = np.divide(rays[..., 2], along, out=np.zeros_like(along), where=along != 0)
    for gap in planes.offset_m - planes.normal_in_world @ center:
        height = center[2] + gap * climb
        # A ray meets a plane in front of the camera if gap and slope have one sign.
        yield (gap * along > 0) & (height >= lowest) & (height <= highest)


def _row_range(visible: BoolArray, around_px: int) -> tuple[int, int]:
    """Return the first row with a visible pixel and the row after the last, widened by `around_px`."""
    rows = np.flatnonzero(visible.any(axis=1))
    first, last = rows[0] - around_px, rows[-1] + 1 + around_px
    return max(int(first) // _ROWS * _ROWS, 0), min(-int(-last // _ROWS) * _ROWS, len(visible))


def sweep_result(
    winner: Winner, normals: NormalMap, offset_m: FloatArray, step_m: FloatArray | Float32Array
) -> SweepResult:
    """Return the best hypotheses as a result, given their offsets (H, W) and the steps (H, W) between them."""
    sharpness = (winner.curvature / step_m**2).astype(np.float32)
    return SweepResult(normals, offset_m.astype(np.float32), winner.score, step_m.astype(np.float32), sharpness)


def _warp_by_plane(reference: StereoView, other: StereoView, planes: Planes, offset_m: float) -> Float32Array:
    """Return `other`, warped by the plane's homography to the pixels of `reference`; 0 outside its image."""
    reference_camera, other_camera, pinhole = reference.camera, other.camera, reference.camera.pinhole
    turn = other_camera.cam_from_world @ reference_camera.cam_from_world.T
    shift = other_camera.cam_from_world @ (reference_camera.center_in_world - other_camera.center_in_world)
    normal_in_cam = reference_camera.cam_from_world @ planes.normal_in_world
    distance = offset_m - planes.normal_in_world @ reference_camera.center_in_world
    if abs(distance) < 1e-9:
        return np.zeros_like(reference.grey)
    by_ray = turn + np.outer(shift, normal_in_cam) / distance
    homography = opencv_camera_matrix(other_camera.pinhole) @ by_ray @ np.linalg.inv(opencv_camera_matrix(pinhole))
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


def opencv_camera_matrix(camera: Pinhole) -> FloatArray:
    """Return the camera matrix (3, 3) with pixels counted from the centre of the first, as OpenCV does."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
