"""Registration of clouds by points of one and planes of the other.

A LiDAR cloud has its shift against the surface of the photographs, with its σ:

1. The photographs' surface near a LiDAR point is read off the depth maps that show it. Its distance to the point
   along the point's normal is an observation of the shift along that normal.
2. Only planes count: ground, roofs and walls without plants. Stereo has a bias on walls, outwards or inwards: a
   further unknown, the same for all walls.
3. Cauchy's weights bound the effect of what has changed since. σ is that of clusters of 5 m (sandwich estimator,
   doi 10.1093/biomet/73.1.13), because errors of neighbouring points are not independent.

The model has a shift or a similarity against a reference, by the reference's planes, with the same weights and σ.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, rows_of
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.geometry.statistics import cauchy_weight, mad_sigma
from pipelines.surface.lidar_cloud import LidarCloud
from pipelines.surface.visibility import DepthViews, Support, support
from pipelines.survey.reference_comparison import Alignment, ReferenceShift

UP = np.array([0.0, 0.0, 1.0])
PLANTS = (3, 4, 5)
_CAPTURES = (0.015, 0.005, 0.005, 0.003)  # largest distance along a ray, as a part of it, in each round
_LEAST_VIEWS = 2
_FLAT = 0.25  # limit of the roughness, in distances between points
_WALL = 0.35  # limit of the normal's upward component on a wall
_CLUSTER_M = 5.0
_MOST_POINTS = 200_000
_LEAST_POINTS = 200
_ITERATIONS = 30


@dataclass(frozen=True)
class PlaneMatches:
    """M points on planes that the photographs show."""

    point_in_model: FloatArray  # (M, 3) of the cloud
    normal_in_model: FloatArray  # (M, 3) towards the photographs
    distance_m: FloatArray  # (M,) surface of the photographs minus the point, along the normal
    wall: BoolArray  # (M,) whether the plane is upright


@dataclass(frozen=True)
class Registration:
    """Shift of a cloud."""

    shift_m: FloatArray  # (3,) cloud minus surface of the photographs
    covariance_m2: FloatArray  # (3, 3) of the comparison alone
    wall_bias_m: float  # surface of the photographs minus the cloud on walls, outwards
    spread_m: float  # robust σ of the distances that remain
    matches: PlaneMatches  # the points, at the shift of the last round


def registration(cloud: LidarCloud, views: DepthViews, seed: int) -> Registration:
    """Return a cloud's shift against the depth maps; a DegenerateGeometryError: too few planes or directions."""
    plane = (cloud.roughness_m < _FLAT * cloud.voxel_m + 0.05) & ~np.isin(cloud.classification, PLANTS)
    rows = np.flatnonzero(plane)
    if len(rows) > _MOST_POINTS:
        rows = np.sort(np.random.default_rng(seed).choice(rows, _MOST_POINTS, replace=False))
    planes = rows_of(cloud, rows)
    total = np.zeros(3)
    for capture in _CAPTURES:
        matches = _matches(planes.moved(-total), views, capture)
        if len(matches.distance_m) < _LEAST_POINTS:
            raise DegenerateGeometryError(
                "no-overlap",
                f"Only {len(matches.distance_m)} LiDAR points lie within {capture:.1%} of the camera's distance "
                "from the surface of the photographs, too few for a comparison.",
            )
        values, covariance, spread = _solved(matches)
        total = total + values[:3]
    return Registration(total, covariance[:3, :3], float(values[3]), spread, matches)


def _matches(planes: LidarCloud, views: DepthViews, capture: float) -> PlaneMatches:
    seen: Support = support(planes.position_in_model, views, UP, capture, planes.normal_in_model)
    good = np.flatnonzero(
        (seen.views >= _LEAST_VIEWS) & (seen.seen_through < seen.views) & np.isfinite(seen.mean_normal_m)
    )
    normal = planes.normal_in_model[good]
    away = np.einsum("pi,pi->p", normal, seen.mean_ray[good]) > 0
    sign = np.where(away, -1.0, 1.0)
    return PlaneMatches(
        planes.position_in_model[good],
        sign[:, None] * normal,
        sign * seen.mean_normal_m[good],
        np.abs(normal[:, 2]) < _WALL,
    )


def _solved(matches: PlaneMatches) -> tuple[FloatArray, FloatArray, float]:
    """Return shift and bias of walls (4,), their covariance (4, 4), and the robust σ of the distances."""
    # distance = surface − point = −n · shift + bias on walls
    design = np.column_stack([-matches.normal_in_model, matches.wall.astype(np.float64)])
    if not matches.wall.any():
        design[:, 3] = 0.0
    prior = np.diag([0.0, 0.0, 0.0, 1.0])  # of 1 m, so that a scene without walls is no singular case
    value = np.zeros(4)
    for _ in range(_ITERATIONS):
        residual = matches.distance_m - design @ value
        weight, spread = _weights(residual)
        normal = design.T @ (weight[:, None] * design) / spread**2 + prior
        step = np.linalg.solve(normal, design.T @ (weight * residual) / spread**2 - prior @ value)
        value = value + step
        if np.abs(step).max() < 1e-6:
            break
    if np.linalg.eigvalsh(normal[:3, :3])[0] * spread**2 < 1e-3 * len(matches.distance_m):
        raise DegenerateGeometryError(
            "planes-parallel", "All planes of the LiDAR face one direction, which leaves its shift undetermined."
        )
    residual = matches.distance_m - design @ value
    score = _summed_by_cell((weight * residual)[:, None] * design / spread**2, matches.point_in_model, _CLUSTER_M)
    inverse = np.linalg.inv(normal)
    return value, np.asarray(inverse @ (score.T @ score) @ inverse), spread


def _weights(residual: FloatArray) -> tuple[FloatArray, float]:
    """Return Cauchy's weights (M,) of residuals in metres, and their robust σ."""
    spread = max(mad_sigma(residual), 1e-4)
    return cauchy_weight((residual / spread) ** 2, 1), spread


def _summed_by_cell(scores: FloatArray, position: FloatArray, side_m: float) -> FloatArray:
    """Return the sums (C, k) of scores (M, k) over the cells of a grid in which points (M, 2 or 3) lie."""
    _, cell = np.unique(np.floor(position / side_m).astype(np.int64), axis=0, return_inverse=True)
    return np.stack([np.bincount(cell.ravel(), column) for column in scores.T], axis=1)


_ALIGNMENT_ITERATIONS = 40
_FIRST_TRIM_M, _SHRINK = 50.0, 0.8  # farthest neighbours, and what becomes of that limit in an iteration
_LEAST_TRIM_SPACINGS = 2.0
_PART_M = 10.0  # side of the parts of the scene whose errors are taken as independent
_LEAST_PAIRS = 100
_MOST_CONDITION = 1e10  # of the normal matrix: beyond, nothing fixes an axis, as on a plane


def fit_alignment(
    model: FloatArray, reference: FloatArray, normal: FloatArray, spacing_m: float, kind: Alignment
) -> tuple[Similarity, ReferenceShift] | None:
    """Return the similarity reference ← model in geo, and its figures.

    None: the clouds have too little in common, or nothing fixes an axis. They are (M, 3) and (P, 3), the latter
    with unit normals (P, 3), NaN if unknown, and a mean spacing.
    """
    planar = np.isfinite(normal).all(axis=1)
    reference, normal = reference[planar], normal[planar]
    if min(len(model), len(reference)) < _LEAST_PAIRS:
        return None
    tree, pivot = cKDTree(reference), model.mean(axis=0)
    free = slice(None) if kind == "similarity" else slice(4, 7)
    placed, trim_m = Similarity(), _FIRST_TRIM_M
    for _ in range(_ALIGNMENT_ITERATIONS):
        points = placed.apply(model)
        distance, row = tree.query(points, distance_upper_bound=trim_m)
        near = np.isfinite(distance)
        if near.sum() < _LEAST_PAIRS:
            return None
        n, arm = normal[row[near]], reference[row[near]] - points[near]
        residual = np.einsum("ni,ni->n", n, arm)
        weight, _ = _weights(residual)
        design = np.einsum("ni,nij->nj", n, jacobian_at(points[near], pivot))[:, free]
        normal_matrix = (design * weight[:, None]).T @ design
        if np.linalg.cond(normal_matrix) > _MOST_CONDITION:
            return None
        delta = np.zeros(7)
        delta[free] = np.linalg.solve(normal_matrix, design.T @ (weight * residual))
        placed = perturbation(delta, pivot) @ placed
        scores, used = design * (weight * residual)[:, None], points[near]
        trim_m = max(_SHRINK * trim_m, _LEAST_TRIM_SPACINGS * spacing_m)
    # One part alone may fix an axis, as with a single wall, and its scores sum up to zero: points are the least σ.
    by_part = _summed_by_cell(scores, used[:, :2], _PART_M)
    spreads = [np.linalg.norm(np.linalg.solve(normal_matrix, each.T), axis=1) for each in (by_part, scores)]
    east, north, up = (placed.apply(pivot) - pivot).tolist()
    cosine, similar = (np.trace(placed.rotation) - 1) / 2, kind == "similarity"
    return placed, ReferenceShift(
        enu_m=(east, north, up),
        sigma_m=tuple(np.maximum(*spreads)[-3:].tolist()),
        scale_ppm=1e6 * (placed.scale - 1) if similar else 0.0,
        turn_deg=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) if similar else 0.0,
        reference_from_model=tuple(tuple(row) for row in placed.matrix()[:3].tolist()),
        points=len(used),
    )
