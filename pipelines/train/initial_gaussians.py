"""Initial Gaussians of a training, and the points of its depth loss.

Beside the surface, three parts of the photographs need Gaussians to start from:

- Sky, horizon and bare ground around the scene (`background`): Gaussians of the scene would grow in mid-air until
  they cover them. Each ray starts with a Gaussian of the pixel's colour, on the ground, or far away if the ray does
  not meet the ground.
- Crowns in wind, water and smooth ground, whose depth stereo does not know (`fallback_points`): density control
  would have to split the few Gaussians that reach into them, again and again. Points at the height of the SfM
  points around them start as dense as the surface.
- Gaps that no photograph shows, such as narrow yards (`background_plane`): with nothing behind it, a gap is a black
  hole, and whatever Gaussian is near grows over it. Flat Gaussians in the colours of the ground end each ray that
  looks down. They lie only where a known surface hides them from photographs, or none looks: elsewhere
  photographs decide what is there, and the plane would count as a surface.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree

from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray, joined_rows, rows_of
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.footprints import PointSurface, ground_points, thin_to_voxels
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.initialise import InitialisationOptions, gaussians_from_points, gaussians_of_size
from pipelines.splat.surface import ObservedPoints
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.area import Area
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import SparseScene
from pipelines.train.region import TrainingRegion
from pipelines.train.surface import SceneSurface, SurfacePoints, spread_evenly

_BACKGROUND_COLUMNS = 24  # cells across an image
_MOST_VIEWS = 120
_GROUND_SHARE = 0.1  # of the points lie below the ground
_STEEPEST = 0.5  # largest slope of the ground; a steeper plane was fitted to walls
_GROUND_REACH = 6.0  # in scene radii: beyond, the ground counts as infinitely far
_SKY_RADIUS = 12.0  # in scene radii


@dataclass(frozen=True)
class Background:
    """B points on rays that meet no known point; σ (B,) is half the width of an image cell at their distance."""

    point_in_model: FloatArray
    rgb: ByteArray
    sigma_m: FloatArray


def background(scene: SparseScene, images: ImageCache, points: FloatArray) -> Background:
    """Return points on the rays of all image cells of the training views that show none of the known points (N, 3).

    The z axis of `model` points up, and the ground is a plane below most of the points.
    """
    middle = np.median(points, axis=0)
    radius = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90))
    ground = ground_plane(points)
    points_beyond, colours, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0)]
    step = max(1, len(scene.train) // _MOST_VIEWS)
    for index in map(int, scene.train[::step]):
        camera, center = images.pinhole(index), scene.poses.cam_center_in_model[index]
        cells = _empty_cells(scene, index, camera, points)
        pixel = (cells + 0.5) * (camera.width / _BACKGROUND_COLUMNS)
        ray = camera.rays(pixel)
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ scene.poses.cam_from_model[index]
        distance = _distance(ray, center, ground, radius)
        points_beyond.append(center + distance[:, None] * ray)
        image = images.image(index)
        row = np.clip(pixel[:, 1].astype(int), 0, image.shape[0] - 1)
        column = np.clip(pixel[:, 0].astype(int), 0, image.shape[1] - 1)
        colours.append(np.asarray(image[row, column]))
        sigmas.append(0.5 * distance * camera.width / (_BACKGROUND_COLUMNS * camera.fx))
    place, rgb, sigma_m = np.concatenate(points_beyond), np.concatenate(colours), np.concatenate(sigmas)
    # One point in each cube of its own size, because neighbouring views see the same places.
    first = thin_to_voxels(place, 2 * sigma_m)
    return Background(place[first], rgb[first], sigma_m[first])


def _empty_cells(scene: SparseScene, index: int, camera: Pinhole, points: FloatArray) -> FloatArray:
    """Return the cells (E, 2), as column and row, that have no point in them or in a cell beside them."""
    rows = max(1, round(_BACKGROUND_COLUMNS * camera.height / camera.width))
    in_cam = (points - scene.poses.cam_center_in_model[index]) @ scene.poses.cam_from_model[index].T
    xy = camera.project(in_cam)
    in_image = xy[camera.contains(xy)]
    occupied = np.zeros((rows + 2, _BACKGROUND_COLUMNS + 2), dtype=bool)
    column, row = (in_image * [_BACKGROUND_COLUMNS / camera.width, rows / camera.height]).astype(int).T
    for shift_row in (0, 1, 2):
        for shift_column in (0, 1, 2):
            occupied[row + shift_row, column + shift_column] = True
    empty_row, empty_column = np.nonzero(~occupied[1:-1, 1:-1])
    return np.stack([empty_column, empty_row], axis=1).astype(np.float64)


def ground_plane(points: FloatArray) -> FloatArray:
    """Return (a, b, c) of the plane z = a x + b y + c below which a tenth of points (N, 3) lies.

    The method is quantile regression (doi 10.2307/1913643) by reweighted least squares. The plane is level if the
    points determine no slope, or a slope that is too steep for ground.
    """
    center = np.median(points, axis=0)
    spread = max(float(np.abs(points - center).mean()), 1e-9)
    arm = (points - center) / spread
    near = (np.abs(arm) < _GROUND_REACH).all(axis=1)  # a wrong match far out would tilt the plane
    design, height = np.column_stack([arm[near, :2], np.ones(near.sum())]), arm[near, 2]
    plane = np.array([0.0, 0.0, float(np.quantile(height, _GROUND_SHARE))])
    for _ in range(50):
        residual = height - design @ plane
        weight = np.where(residual > 0, _GROUND_SHARE, 1 - _GROUND_SHARE) / np.maximum(np.abs(residual), 1e-4)
        plane = np.linalg.lstsq(np.sqrt(weight)[:, None] * design, np.sqrt(weight) * height, rcond=None)[0]
    if not np.hypot(plane[0], plane[1]) < _STEEPEST:
        plane = np.array([0.0, 0.0, float(np.quantile(height, _GROUND_SHARE))])
    return np.array([plane[0], plane[1], spread * plane[2] + center[2] - plane[:2] @ center[:2]])


def _distance(ray: FloatArray, center: FloatArray, ground: FloatArray, radius: float) -> FloatArray:
    """Return distances (E,) along rays (E, 3): to the ground if the ray meets it within reach, else to the sky."""
    height = center[2] - ground[:2] @ center[:2] - ground[2]
    fall = ground[:2] @ ray[:, :2].T - ray[:, 2]
    to_ground = height / np.maximum(fall, 1e-6)
    meets = (fall > 0) & (to_ground > 0) & (to_ground < _GROUND_REACH * radius)
    return np.where(meets, to_ground, _SKY_RADIUS * radius)


_CANDIDATES = 4  # drawn for each wanted point
_RAY_COLUMNS = 64  # along the longer side of a view: neighbouring rays meet neighbouring ground


def fallback_points(
    scene: SparseScene,
    maps: DepthMaps,
    count: int,
    seed: int,
    inside: Callable[[FloatArray], BoolArray],
) -> SurfacePoints:
    """Return points, without normals, at pixels of the training views whose depth is not known.

    Each lies where the ray of its pixel meets the surface through the SfM points, z up. Sky has none. At most
    `count` of those that are `inside` are kept, spread as evenly as the photographs resolve them.
    """
    if count < 1:
        return SurfacePoints(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))
    ground, random = PointSurface(scene.point_in_model), np.random.default_rng(seed)
    each = -(-_CANDIDATES * count // max(len(scene.train), 1))
    points, colours, sizes = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0)]
    for index in map(int, scene.train):
        camera = maps.camera(index)
        unknown = maps.depth(index) == 0
        depth = _ground_depth(scene, index, camera, ground, unknown)
        rows, columns = np.nonzero(unknown & np.isfinite(depth))
        chosen = random.permutation(len(rows))[:each]
        rows, columns = rows[chosen], columns[chosen]
        in_cam = depth[rows, columns, None] * camera.rays(np.stack([columns, rows], axis=1) + 0.5)
        points.append(in_cam @ scene.poses.cam_from_model[index] + scene.poses.cam_center_in_model[index])
        colours.append(maps.rgb(index)[rows, columns])
        sizes.append(depth[rows, columns] / camera.fx)
    place, rgb, size_m = np.concatenate(points), np.concatenate(colours), np.concatenate(sizes)
    counted = np.flatnonzero(inside(place))
    kept = counted[spread_evenly(place[counted], size_m[counted], count)]
    return SurfacePoints(place[kept], rgb[kept], np.full((len(kept), 3), np.nan))


def _ground_depth(
    scene: SparseScene, index: int, camera: Pinhole, ground: PointSurface, wanted: BoolArray
) -> FloatArray:
    """Return the depth (H, W) of the ground in a view, in metres, from a few rays around the wanted pixels.

    It is NaN where a ray meets no ground, and away from the wanted pixels.
    """
    center, coarse = scene.poses.cam_center_in_model[index], camera.limited(_RAY_COLUMNS)
    around = cv2.resize(wanted.astype(np.float32), (coarse.width, coarse.height), interpolation=cv2.INTER_AREA) > 0
    near = cv2.dilate(around.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0  # pixels are between four rays
    rays = coarse.points_at(np.ones(near.shape))[near.ravel()] @ scene.poses.cam_from_model[index]
    place = ground_points(rays, center, ground)
    along = np.full(near.shape, np.nan)
    along[near] = np.linalg.norm(place - center, axis=1) / np.linalg.norm(rays, axis=1)
    size = camera.width, camera.height
    return np.asarray(cv2.resize(along, size, interpolation=cv2.INTER_LINEAR))


_STRAY = 0.01  # of the points at either end of an axis lie outside of the plane
_LOW = 0.05  # of the points of a cell may lie below it: stereo errs
_ROOF_REACH_M = 20.0  # a cell whose points lie on a roof has ground within this distance
_DEPTH = 0.5  # below the ground, in cells
_LOOKED_AT = 16  # points near a place whose mean colour it has
_HIDDEN_SHARE = 0.5  # of the views that face a place: some know no depth before it
_COLOUR_POINTS = 40_000
_UPRIGHT = 3.0  # factor on heights, when points near a place of the plane are looked for: not those of roofs


def background_plane(points: SurfacePoints, count: int, seed: int) -> tuple[SurfacePoints, float]:
    """Return places on a plane beneath the points, on a square grid with z up, and the side of its cells in metres.

    Each place lies half a side below the lowest ground that points show within 20 m, smoothed but never above them.
    There are `count` places at most, and at least one point; the seed is that of the points for the colours.
    """
    place = points.point_in_model
    low, high = np.quantile(place[:, :2], [_STRAY, 1 - _STRAY], axis=0)
    side_m = float(np.sqrt(np.prod(high - low) / max(count, 1)))
    if count < 1 or not side_m > 0:
        return rows_of(points, np.zeros(0, dtype=np.int64)), 0.0
    columns, rows = (int(n) for n in np.maximum((high - low) // side_m, 1))
    cell = np.floor((place[:, :2] - low) / side_m).astype(np.int64)
    inside = np.flatnonzero(((cell >= 0) & (cell < (columns, rows))).all(axis=1))
    lowest = _low_heights(cell[inside, 1] * columns + cell[inside, 0], place[inside, 2], columns * rows)
    lowest = lowest.reshape(rows, columns)
    # Cells without a point take the height of the nearest that has one.
    nearest = ndimage.distance_transform_edt(np.isnan(lowest), return_distances=False, return_indices=True)
    known = lowest[tuple(nearest)]
    reach = 2 * int(np.ceil(_ROOF_REACH_M / side_m)) + 1
    smooth = ndimage.uniform_filter(ndimage.minimum_filter(known, size=reach, mode="nearest"), 3, mode="nearest")
    height = np.minimum(smooth, known) - _DEPTH * side_m
    row, column = np.divmod(np.arange(columns * rows), columns)
    plane = np.column_stack([low + side_m * (np.stack([column, row], axis=1) + 0.5), height.ravel()])[:count]
    normal = np.broadcast_to([0.0, 0.0, 1.0], plane.shape)
    return SurfacePoints(plane, _colours(points, plane, seed), normal), side_m


def hidden(points: FloatArray, scene: SparseScene, maps: DepthMaps) -> BoolArray:
    """Return which of points (K, 3) in `model` lie behind known depths in most of the training views facing them.

    A point that no view faces is hidden, too.
    """
    facing, behind = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
    for index in map(int, scene.train):
        camera = maps.camera(index)
        in_cam = (points - scene.poses.cam_center_in_model[index]) @ scene.poses.cam_from_model[index].T
        xy = camera.project(in_cam)
        in_image = np.flatnonzero(camera.contains(xy))
        column, row = xy[in_image].astype(np.int64).T
        depth = maps.depth(index)[row, column]
        facing[in_image] += 1
        behind[in_image] += (depth > 0) & (depth < in_cam[in_image, 2])
    return np.asarray(behind >= _HIDDEN_SHARE * facing)


def _low_heights(cell: IntArray, height: FloatArray, count: int) -> FloatArray:
    """Return the height (count,) of each cell that few of its points lie below; NaN without a point."""
    order = np.lexsort((height, cell))
    number = np.bincount(cell, minlength=count)
    first = np.cumsum(number) - number
    low = np.full(count, np.nan)
    filled = number > 0
    low[filled] = height[order[(first + (_LOW * number).astype(np.int64))[filled]]]
    return low


def _colours(points: SurfacePoints, plane: FloatArray, seed: int) -> ByteArray:
    """Return the mean colour (K, 3) of the points near each place of the plane."""
    drawn = np.random.default_rng(seed).permutation(len(points.rgb))[:_COLOUR_POINTS]
    stretch = np.array([1.0, 1.0, _UPRIGHT])
    tree = cKDTree(points.point_in_model[drawn] * stretch)
    _, near = tree.query(plane * stretch, k=min(_LOOKED_AT, len(drawn)))
    return np.asarray(points.rgb[drawn][near.reshape(len(plane), -1)].mean(axis=1).round().astype(np.uint8))


_SURFACE_SHARE = 0.8  # of the limit of Gaussians starts on the surface; density control places the others
_AROUND_SHARE = 0.1  # of the limit on the surface starts around the area that must be sharp
_MOSTLY_KNOWN = 0.6  # of the pixels: with fewer known depths, more Gaussians are needed off the surface
_UNKNOWN_SHARE = 0.05  # of the limit starts where no depth is known, at least: density control finds corners late
_BENEATH_SHARE = 0.02  # of the limit lies beneath the scene
_BENEATH_SIGMA = 0.6  # in cells of the plane: it has no gaps
_BENEATH_THICKNESS = 0.2
_BENEATH_OPACITY = 0.7
_STRIDE = 3  # of rows and columns of a depth map: Gaussians are wider than its pixels
_KEPT_VIEWS = 128  # views whose points stay on the device
_OFF_SURFACE = 3.0  # gaps between points of the surface: an SfM point nearer than that lies on it


@dataclass(frozen=True)
class TrainingScene:
    """Cameras and SfM points of a training, its undistorted photographs, and, if any, known surface and region.

    `area` is what must be sharp; None: everything.
    """

    scene: SparseScene
    images: ImageCache
    surface: SceneSurface | None = None
    region: TrainingRegion | None = None
    area: Area | None = None

    def in_area(self, points: FloatArray) -> BoolArray:
        """Return which of points (N, 3) in `model` must be sharp, as a mask (N,)."""
        if self.area is None:
            return np.ones(len(points), dtype=bool)
        return self.area.contains(self.scene.geo_from_model.apply(points))

    def in_region(self, points: FloatArray) -> BoolArray:
        """Return which of points (N, 3) in `model` are trained, as a mask (N,)."""
        return np.ones(len(points), dtype=bool) if self.region is None else self.region.cell.contains(points)


def initial_gaussians(training: TrainingScene, options: InitialisationOptions, most: int, seed: int) -> Gaussians:
    """Return at most `most` Gaussians to start from; a DegenerateGeometryError: fewer than two different points.

    1. Discs lie on the surface, as dense as the photographs resolve it.
    2. Balls lie at SfM points where no surface is known. On a surface discs are better: an SfM point has no normal,
       and a ball reaches as far behind a wall as the gap to the wall's next point.
    3. Balls lie at the height of the SfM points where photographs show no known surface: the more of it, the more.
    4. A background plane lies beneath the surface: what photographs do not show is no hole.
    5. Balls lie in the background, as far as the limit leaves room. In a region, the sky is that of the model which
       stands in for the rest: all blocks of a survey then have the same.
    """
    scene = training.scene
    start = SurfacePoints(scene.point_in_model, scene.sparse.point_rgb, np.full_like(scene.point_in_model, np.nan))
    if training.surface is not None:
        share = _SURFACE_SHARE * min(1.0, training.surface.known_share() / _MOSTLY_KNOWN)
        surface = training.surface.sample(
            int(share * most), seed, lambda at: training.in_region(at) & training.in_area(at)
        )
        if training.area is not None:
            around = training.surface.sample(
                int(_AROUND_SHARE * share * most), seed, lambda at: training.in_region(at) & ~training.in_area(at)
            )
            surface = joined_rows([surface, around])
        start = joined_rows([rows_of(start, _off_surface(start, surface)), surface])
        unknown = int(max(_SURFACE_SHARE - share, _UNKNOWN_SHARE) * most)
        fallback = fallback_points(scene, training.surface.maps, unknown, seed, training.in_region)
        start = joined_rows([start, fallback])
    behind = background(scene, training.images, start.point_in_model)
    beneath = _flat_gaussians(training, start, options, int(_BENEATH_SHARE * most), seed)
    start = rows_of(start, np.flatnonzero(training.in_region(start.point_in_model)))
    near = gaussians_from_points(start.point_in_model, start.rgb, options, start.normal_in_model)
    far = gaussians_of_size(behind.point_in_model, behind.rgb, behind.sigma_m, options)
    if training.region is not None:
        within = training.in_region(behind.point_in_model) & training.region.box.contains(behind.point_in_model)
        far = Gaussians.concatenate([far.select(torch.from_numpy(within)), training.region.sky])
    if len(near) + len(beneath) <= most:
        near = Gaussians.concatenate([near, beneath])
    room = max(most - len(near), 0)
    keep = torch.linspace(0, max(len(far) - 1, 0), min(room, len(far))).long()
    return Gaussians.concatenate([near, far.select(keep)])


def _flat_gaussians(
    training: TrainingScene, start: SurfacePoints, options: InitialisationOptions, count: int, seed: int
) -> Gaussians:
    """Return flat Gaussians beneath the points that a training starts from; none where no surface hides them."""
    plane, side_m = background_plane(start, count, seed)
    kept = np.zeros(len(plane.rgb), dtype=bool)
    if training.surface is not None:
        place = plane.point_in_model
        kept = training.in_region(place) & hidden(place, training.scene, training.surface.maps)
    plane = rows_of(plane, np.flatnonzero(kept))
    sigma_m = np.full(len(plane.rgb), _BENEATH_SIGMA * side_m)
    discs = gaussians_of_size(plane.point_in_model, plane.rgb, sigma_m, replace(options, opacity=_BENEATH_OPACITY))
    discs.log_scales[:, 2] += math.log(_BENEATH_THICKNESS)
    return discs


def _off_surface(points: SurfacePoints, surface: SurfacePoints) -> IntArray:
    """Return the rows of the points that are not near any point of the surface."""
    if len(surface.rgb) < 2:
        return np.arange(len(points.rgb))
    tree = cKDTree(surface.point_in_model)
    gap, _ = tree.query(surface.point_in_model, k=2)
    distance, nearest = tree.query(points.point_in_model)
    return np.flatnonzero(distance > _OFF_SURFACE * gap[nearest, 1])


def depth_loss_points(training: TrainingScene, device: torch.device) -> Callable[[int], ObservedPoints]:
    """Return a function of an image's index that gives the points in `model`, float32, that the image shows.

    These are SfM points and, in training images, points of the surface.
    """
    scene = training.scene
    training_views = set(map(int, scene.train))

    @lru_cache(maxsize=_KEPT_VIEWS)
    def points(index: int) -> ObservedPoints:
        seen = np.unique(scene.sparse.obs_point[scene.sparse.obs_image == index])
        known = scene.point_in_model[seen]
        weight = np.ones(len(known), dtype=np.float32)
        if training.surface is not None and index in training_views:
            of_surface, its_weight = training.surface.depth_loss_points(index, _STRIDE)
            known, weight = np.concatenate([known, of_surface]), np.concatenate([weight, its_weight])
        inside = training.in_region(known)
        known, weight = known[inside], weight[inside]
        return ObservedPoints(torch.from_numpy(known).float().to(device), torch.from_numpy(weight).to(device))

    return points
