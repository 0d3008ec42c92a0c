"""Plane-sweep stereo: the plane, among many parallel planes, on which a photograph looks like its neighbours.

After Collins (doi 10.1109/CVPR.1996.517097) and, for planes along a scene's dominant direction, Gallup et al.
(doi 10.1109/CVPR.2007.383245). The SfM points that views share tell the views and planes to compare a view with.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import ViewPose
from pipelines.geometry.network import Network
from pipelines.surface.matching import (
    UNSEEN,
    Matcher,
    MatchSettings,
    StereoView,
    Winner,
    WinnerTakesAll,
    is_hypothesis,
)

_ROWS = 8  # strips begin and end at multiples of this number
_CLEARLY = 0.05  # of the score: margin by which planes of another direction must fit better than the first


@dataclass(frozen=True)
class SweepPlanes:
    """Parallel planes: normal · X = offset; parts outside the scene's lowest and highest place are not compared."""

    normal_in_model: FloatArray  # (3,) unit vector
    offset_m: FloatArray  # (D,) monotonic, at least three
    height_m: tuple[float, float] = (-math.inf, math.inf)


@dataclass(frozen=True)
class NormalMap:
    """Normal of each pixel's surface, one of few; offsets along it locate the surface."""

    normals_in_model: FloatArray  # (F, 3) unit vectors
    index: ByteArray  # (H, W) of each pixel's normal

    @property
    def normal_in_model(self) -> FloatArray:
        """Normals (H, W, 3) of the pixels, unit vectors."""
        return self.normals_in_model[self.index]

    def offset_per_metre(self, camera: ViewPose) -> FloatArray:
        """Return the offset (H, W) that a camera's ray gains by a metre of depth."""
        return np.asarray(np.choose(self.index, [camera.rays_along(normal) for normal in self.normals_in_model]))

    def depth(self, camera: ViewPose, offset_m: Float32Array) -> FloatArray:
        """Return depths (H, W) along the optical axis at which a camera's rays meet planes of offsets (H, W)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((offset_m - self._offset_of(camera)) / self.offset_per_metre(camera))

    def offset(self, camera: ViewPose, depth: Float32Array) -> FloatArray:
        """Return offsets (H, W) of the points at depths (H, W) of a camera: inverts `depth`."""
        return self._offset_of(camera) + depth * self.offset_per_metre(camera)

    def _offset_of(self, camera: ViewPose) -> FloatArray:
        return np.asarray((self.normals_in_model @ camera.center_in_model)[self.index])


@dataclass(frozen=True)
class SweepResult:
    """Best plane at each pixel of a view: its depths, by a sweep or its refinement."""

    camera: ViewPose
    normals: NormalMap  # direction of that plane
    # (H, W) refined between planes by a parabola through the neighbouring scores; NaN if no plane lies in front of
    # the camera
    offset_m: Float32Array
    score: Float32Array  # (H, W) correlation, −1 … 1
    step_m: Float32Array  # (H, W) distance between the planes there
    # (H, W) 1/m², minus the second derivative of the score by the offset: small where neighbours look from nearly
    # the same place, or see little texture. The σ of the offset goes with its inverse
    sharpness: Float32Array

    def depth(self) -> FloatArray:
        """Return the depth (H, W) along the optical axis."""
        return self.normals.depth(self.camera, self.offset_m)


def plane_sweep(
    reference: StereoView, neighbours: list[StereoView], sweeps: list[SweepPlanes], settings: MatchSettings
) -> SweepResult:
    """Compare a view with its neighbours on every plane, and keep the best plane at each pixel.

    A window fits best on planes with the normal of its surface: walls need other planes than the ground. Memory
    does not depend on the number of planes. Time: planes × neighbours × pixels, in the rows that see the scene on a
    plane.

    Args:
        neighbours: one or more views of the same place from elsewhere.
        sweeps: planes by direction, the likelier directions first.

    Raises:
        ValueError: no neighbours, no sweep, or one of fewer than three planes.
    """
    fewest = min((len(planes.offset_m) for planes in sweeps), default=0)
    if not neighbours or fewest < 3:
        raise ValueError(f"{len(neighbours)} neighbours and {fewest} planes are too few to sweep")
    matcher = Matcher(reference, neighbours, settings)
    results = [_sweep(reference.camera, planes, matcher, settings.support_px) for planes in sweeps]
    best = np.argmax([result.score - (_CLEARLY if number else 0) for number, result in enumerate(results)], axis=0)
    normals = NormalMap(np.stack([planes.normal_in_model for planes in sweeps]), best.astype(np.uint8))
    offset, score, step, sharpness = (
        np.choose(best, [getattr(result, name) for result in results])
        for name in ("offset_m", "score", "step_m", "sharpness")
    )
    return SweepResult(reference.camera, normals, offset, score, step, sharpness)


def _sweep(camera: ViewPose, planes: SweepPlanes, matcher: Matcher, support_px: int) -> SweepResult:
    shape = (camera.pinhole.height, camera.pinhole.width)
    search = WinnerTakesAll(shape)
    for depth, visible in _scene_on_planes(planes, camera):
        rows = _row_range(visible, support_px)
        search.add(matcher(depth, rows), visible, rows.start)
    winner = search.winner()
    offset_m = np.interp(winner.hypothesis, np.arange(len(planes.offset_m)), planes.offset_m)
    offset_m[winner.score <= UNSEEN] = np.nan
    step_m = np.abs(np.gradient(planes.offset_m))[np.rint(winner.hypothesis).astype(np.int64)]
    normals = NormalMap(planes.normal_in_model[None], np.zeros(offset_m.shape, np.uint8))
    return sweep_result(winner, camera, normals, offset_m, step_m)


def _scene_on_planes(planes: SweepPlanes, camera: ViewPose) -> Iterator[tuple[Float32Array, BoolArray]]:
    """Yield for each plane its depth (H, W), and the mask (H, W) of the pixels that see the scene on it."""
    center = camera.center_in_model
    with np.errstate(divide="ignore", invalid="ignore"):
        per_gap = (1 / camera.rays_along(planes.normal_in_model)).astype(np.float32)
        ends = (np.array(planes.height_m) - center[2]) / camera.rays_along(_UP)[..., None]
    nearest, furthest = ends.min(axis=-1).astype(np.float32), ends.max(axis=-1).astype(np.float32)
    for gap in planes.offset_m - planes.normal_in_model @ center:
        depth = np.float32(gap) * per_gap
        yield depth, is_hypothesis(depth) & (depth >= nearest) & (depth <= furthest)


def _row_range(visible: BoolArray, around_px: int) -> slice:
    """Return the rows with a visible pixel, widened by `around_px`; none if no pixel is."""
    flat, width = visible.reshape(-1), visible.shape[1]
    start = int(flat.argmax())
    if not flat[start]:
        return slice(0, 0)
    first, last = start // width - around_px, (flat.size - 1 - int(flat[::-1].argmax())) // width + 1 + around_px
    return slice(max(first // _ROWS * _ROWS, 0), min(-(-last // _ROWS) * _ROWS, len(visible)))


def sweep_result(
    winner: Winner, camera: ViewPose, normals: NormalMap, offset_m: FloatArray, step_m: FloatArray | Float32Array
) -> SweepResult:
    """Return the best hypotheses as a result, given their offsets (H, W) and the steps (H, W) between them."""
    sharpness, offset, step = winner.curvature / step_m**2, offset_m.astype(np.float32), step_m.astype(np.float32)
    return SweepResult(camera, normals, offset, winner.score, step, sharpness.astype(np.float32))


# Smaller angles give no depth, larger angles another picture of the same place. After Yao et al.,
# doi 10.1007/978-3-030-01237-3_47, section 4.1, adapted to the wider angles of flights.
_BEST_ANGLE_DEG, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG = 12.0, 4.0, 10.0
_MOST_POINTS = 400  # of a view
_LEAST_SHARED = 5

_UP = np.array([0.0, 0.0, 1.0])
_LEVEL = np.sin(np.radians(15.0))  # a view that looks down by less sees walls rather than ground
_NEAREST = 0.3  # of the distance of most points
_RANGE = (0.5, 99.5)  # percentiles of the points
_MARGIN = 0.25  # of their range, on either side: ground without texture has no points
_STEP_PX = 1.0  # between two planes in the neighbours
_LEAST_PLANES, _MOST_PLANES = 16, 256


def best_neighbours(network: Network, view: int, among: IntArray, count: int) -> list[int]:
    """Return at most `count` views that share most points with `view` under good angles, best first."""
    seen = np.unique(network.obs_point[network.obs_image == view])
    seen = seen[np.linspace(0, len(seen) - 1, min(len(seen), _MOST_POINTS)).astype(np.int64)]
    rows = np.isin(network.obs_point, seen) & np.isin(network.obs_image, among) & (network.obs_image != view)
    point, other = network.obs_point[rows], network.obs_image[rows]
    from_view = network.point_in_world[point] - network.cam_center_in_world[view]
    from_other = network.point_in_world[point] - network.cam_center_in_world[other]
    cosine = (from_view * from_other).sum(axis=1) / np.maximum(
        np.linalg.norm(from_view, axis=1) * np.linalg.norm(from_other, axis=1), 1e-12
    )
    away = np.degrees(np.arccos(np.clip(cosine, -1, 1))) - _BEST_ANGLE_DEG
    sigma = np.where(away < 0, _SIGMA_BELOW_DEG, _SIGMA_ABOVE_DEG)
    worth = np.bincount(other, np.exp(-0.5 * (away / sigma) ** 2), minlength=len(network.cam_center_in_world))
    worth[np.bincount(other, minlength=len(worth)) < _LEAST_SHARED] = 0
    order = np.argsort(-worth, kind="stable")[:count]
    return [int(index) for index in order if worth[index] > 0]


def planes_for(view: ViewPose, neighbours: list[ViewPose], points: FloatArray) -> list[SweepPlanes]:
    """Return planes through points (P, 3) that the view sees, by direction; none if the points are too few.

    Level planes suit ground and roofs; upright planes across the view suit walls. A view that hardly looks down
    needs planes across its axis alone.
    """
    if len(points) < _LEAST_SHARED:
        return []
    axis = view.cam_from_model[2]
    ahead = axis * [1.0, 1.0, 0.0]
    forward = float(np.linalg.norm(ahead))
    if -axis[2] <= _LEVEL:
        candidates = [_planes_across(view, neighbours, points, axis)]
    elif forward <= _LEVEL:  # from straight above walls are not seen
        candidates = [_level_planes(view, neighbours, points)]
    else:
        candidates = [
            _level_planes(view, neighbours, points),
            _planes_across(view, neighbours, points, ahead / forward, height_m=_range(points @ _UP)),
        ]
    return [planes for planes in candidates if planes is not None]


def _level_planes(view: ViewPose, neighbours: list[ViewPose], points: FloatArray) -> SweepPlanes | None:
    low, high = _range(points @ _UP)
    if not high > low:
        return None
    return SweepPlanes(_UP, np.linspace(low, high, _count(view, neighbours, points, _UP, high - low)))


def _planes_across(
    view: ViewPose,
    neighbours: list[ViewPose],
    points: FloatArray,
    normal: FloatArray,
    height_m: tuple[float, float] = (-np.inf, np.inf),
) -> SweepPlanes | None:
    """Return planes at distances with evenly spaced inverses, which are evenly spaced in pixels."""
    away = points @ normal - normal @ view.center_in_model
    low, high = _range(away)
    low = max(low, _NEAREST * float(np.median(away)))
    if not high > low > 0:
        return None
    count = _count(view, neighbours, points, normal, high - low)
    offset = normal @ view.center_in_model + 1 / np.linspace(1 / low, 1 / high, count)
    return SweepPlanes(normal, offset, height_m)


def _range(along: FloatArray) -> tuple[float, float]:
    low, high = np.percentile(along, _RANGE)
    margin = _MARGIN * (high - low)
    return float(low - margin), float(high + margin)


def _count(
    view: ViewPose, neighbours: list[ViewPose], points: FloatArray, normal: FloatArray, range_m: float
) -> int:
    """Return the number of planes that lie `_STEP_PX` apart in the neighbours."""
    middle = points[np.argsort(points @ normal)[len(points) // 2]]
    step = _STEP_PX / max(_pixels_a_metre(view, neighbours, middle, normal), 1e-9)
    return int(np.clip(np.ceil(range_m / step), _LEAST_PLANES, _MOST_PLANES))


def _pixels_a_metre(view: ViewPose, neighbours: list[ViewPose], point: FloatArray, normal: FloatArray) -> float:
    """Return the pixels by which a point moves in the neighbours (median) if its plane moves by a metre."""
    ray = point - view.center_in_model
    ray = ray / max(abs(float(normal @ ray)), 1e-9)
    speeds = []
    for other in neighbours:
        ends = (point + np.outer([-0.05, 0.05], ray) - other.center_in_model) @ other.cam_from_model.T
        if (ends[:, 2] > 0).all():
            on_image = ends[:, :2] / ends[:, 2:] * [other.pinhole.fx, other.pinhole.fy]
            speeds.append(float(np.linalg.norm(on_image[1] - on_image[0])) / 0.1)
    return float(np.median(speeds)) if speeds else 0.0
