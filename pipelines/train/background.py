"""Background points for parts of the photographs without known points: sky, horizon, bare ground around the scene.

Floaters would fill these parts if they started empty: Gaussians of the scene that grow in mid-air until they cover
the gap, in front of everything else. Rays through such parts therefore start with a Gaussian of the pixel's colour:
on the ground, or far away if the ray does not meet the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import ByteArray, FloatArray
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.thinning import thin_to_voxels
from pipelines.scene.photographs import ImageCache
from pipelines.scene.scene import Scene

_COLUMNS = 24  # cells across an image
_MOST_VIEWS = 120
_GROUND_SHARE = 0.1  # of the points lie below the ground
_STEEPEST = 0.5  # largest slope of the ground; a steeper plane was fitted to walls
_GROUND_REACH = 6.0  # in scene radii: beyond, the ground counts as infinitely far
_SKY_RADIUS = 12.0  # in scene radii


@dataclass(frozen=True)
class Background:
    """B points on rays that meet no known point.

    Attributes:
        point_in_model: (B, 3) metres.
        rgb: (B, 3) uint8.
        sigma_m: (B,) half the width of the image cell, at the distance of the point.
    """

    point_in_model: FloatArray
    rgb: ByteArray
    sigma_m: FloatArray


def background(scene: Scene, images: ImageCache, points: FloatArray) -> Background:
    """Return points on the rays of all image cells of the training views that show none of the known points.

    The z axis of `model` points up, and the ground is a plane below most of the points.

    Args:
        scene: cameras.
        images: undistorted photographs, for the colours.
        points: (N, 3) known points in `model`, metres.
    """
    middle = np.median(points, axis=0)
    radius = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90))
    ground = ground_plane(points)
    points_beyond, colours, sigmas = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros(0)]
    step = max(1, len(scene.train) // _MOST_VIEWS)
    for index in map(int, scene.train[::step]):
        camera, center = images.pinhole(index), scene.poses.cam_center_in_model[index]
        cells = _empty_cells(scene, index, camera, points)
        pixel = (cells + 0.5) * (camera.width / _COLUMNS)
        ray = _rays(pixel, camera) @ scene.poses.cam_from_model[index]
        distance = _distance(ray, center, ground, radius)
        points_beyond.append(center + distance[:, None] * ray)
        colours.append(_colours(images.image(index), pixel))
        sigmas.append(0.5 * distance * camera.width / (_COLUMNS * camera.fx))
    return _thinned(Background(np.concatenate(points_beyond), np.concatenate(colours), np.concatenate(sigmas)))


def _empty_cells(scene: Scene, index: int, camera: Pinhole, points: FloatArray) -> FloatArray:
    """Return the cells (E, 2), as column and row, that have no point in them or in a cell beside them."""
    rows = max(1, round(_COLUMNS * camera.height / camera.width))
    in_cam = (points - scene.poses.cam_center_in_model[index]) @ scene.poses.cam_from_model[index].T
    xy = camera.project(in_cam)
    shown = xy[camera.holds(xy)]
    occupied = np.zeros((rows + 2, _COLUMNS + 2), dtype=bool)
    column, row = (shown * [_COLUMNS / camera.width, rows / camera.height]).astype(int).T
    for shift_row in (0, 1, 2):
        for shift_column in (0, 1, 2):
            occupied[row + shift_row, column + shift_column] = True
    empty_row, empty_column = np.nonzero(~occupied[1:-1, 1:-1])
    return np.stack([empty_column, empty_row], axis=1).astype(np.float64)


def _rays(pixel: FloatArray, camera: Pinhole) -> FloatArray:
    ray = camera.rays(pixel)
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True))


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


def _colours(image: ByteArray, pixel: FloatArray) -> ByteArray:
    row = np.clip(pixel[:, 1].astype(int), 0, image.shape[0] - 1)
    column = np.clip(pixel[:, 0].astype(int), 0, image.shape[1] - 1)
    return np.asarray(image[row, column])


def _thinned(all_points: Background) -> Background:
    """Return one point in each cube of its own size, because neighbouring views see the same places."""
    first = thin_to_voxels(all_points.point_in_model, 2 * all_points.sigma_m)
    return Background(all_points.point_in_model[first], all_points.rgb[first], all_points.sigma_m[first])
