"""Plane-sweep stereo: the plane, among many parallel planes, on which a photograph looks like its neighbours.

After Collins (doi 10.1109/CVPR.1996.517097) and, for planes along a scene's dominant direction, Gallup et al.
(doi 10.1109/CVPR.2007.383245).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray
from pipelines.stereo.matching import UNSEEN, Matcher, MatchSettings, Winner, WinnerTakesAll
from pipelines.stereo.views import StereoCamera, StereoView

_ROWS = 8  # strips begin and end at multiples of this number
_CLEARLY = 0.05  # of the score: margin by which planes of another direction must fit better than the first


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
    matcher = Matcher(reference, neighbours, settings)
    results = [_sweep(reference.camera, planes, matcher, settings.support_px) for planes in sweeps]
    best = np.argmax([result.score - (_CLEARLY if number else 0) for number, result in enumerate(results)], axis=0)
    normals = NormalMap(np.stack([planes.normal_in_world for planes in sweeps]), best.astype(np.uint8))
    offset, score, step, sharpness = (
        np.choose(best, [getattr(result, name) for result in results])
        for name in ("offset_m", "score", "step_m", "sharpness")
    )
    return SweepResult(normals, offset, score, step, sharpness)


def _sweep(camera: StereoCamera, planes: Planes, matcher: Matcher, support_px: int) -> SweepResult:
    """Return the best planes of one direction."""
    shape = (camera.pinhole.height, camera.pinhole.width)
    search = WinnerTakesAll(shape)
    for depth, visible in _scene_on_planes(planes, camera):
        score = np.full(shape, UNSEEN, np.float32)
        if visible.any():
            rows = _row_range(visible, support_px)
            score[rows] = matcher(depth, rows)
            score[~visible] = UNSEEN
        search.add(score)
    winner = search.winner()
    offset_m = np.interp(winner.hypothesis, np.arange(len(planes.offset_m)), planes.offset_m)
    offset_m[winner.score <= UNSEEN] = np.nan
    step_m = np.abs(np.gradient(planes.offset_m))[np.rint(winner.hypothesis).astype(np.int64)]
    normals = NormalMap(planes.normal_in_world[None], np.zeros(offset_m.shape, np.uint8))
    return sweep_result(winner, normals, offset_m, step_m)


def _scene_on_planes(planes: Planes, camera: StereoCamera) -> Iterator[tuple[Float32Array, BoolArray]]:
    """Yield for each plane its depth (H, W), and the mask (H, W) of the pixels that see the scene on it."""
    rays, center = camera.rays(), camera.center_in_world
    along, (lowest, highest) = rays @ planes.normal_in_world, planes.height_m
    with np.errstate(divide="ignore"):
        per_gap = (1 / along).astype(np.float32)
    rise = rays[..., 2].astype(np.float32)
    for gap in planes.offset_m - planes.normal_in_world @ center:
        depth = np.float32(gap) * per_gap
        height = np.float32(center[2]) + depth * rise
        yield depth, (depth > 0) & (height >= lowest) & (height <= highest)


def _row_range(visible: BoolArray, around_px: int) -> slice:
    """Return the rows with a visible pixel, widened by `around_px`."""
    rows = np.flatnonzero(visible.any(axis=1))
    first, last = rows[0] - around_px, rows[-1] + 1 + around_px
    return slice(max(int(first) // _ROWS * _ROWS, 0), min(-int(-last // _ROWS) * _ROWS, len(visible)))


def sweep_result(
    winner: Winner, normals: NormalMap, offset_m: FloatArray, step_m: FloatArray | Float32Array
) -> SweepResult:
    """Return the best hypotheses as a result, given their offsets (H, W) and the steps (H, W) between them."""
    sharpness = (winner.curvature / step_m**2).astype(np.float32)
    return SweepResult(normals, offset_m.astype(np.float32), winner.score, step_m.astype(np.float32), sharpness)
