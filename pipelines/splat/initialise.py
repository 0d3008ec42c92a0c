"""Initial Gaussians: one at each SfM point, as large as the gaps between the points."""

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray, IntArray
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.sh import coefficient_count, sh_from_rgb
from pipelines.splat.spatial import morton_order

log = logging.getLogger(__name__)

_NEIGHBOURS = 3
# Two points at almost one place have no gap, and a lone point in the sky has no size. The scales of both are
# clipped to those of the cloud, which spread over some two orders of magnitude.
_SCALE_SPREAD = 10.0
# Of Gaussians with a normal: their place is known, and they need not make room for others.
_DISC_OPACITY = 0.5
_DISC_THICKNESS = 0.1  # relative to the standard deviation across it
_FAR = 50.0  # median distances from the cloud's median centre: points beyond are mismatches, or sky


@dataclass(frozen=True)
class InitialisationOptions:
    """Settings of the initial Gaussians."""

    sh_degree: int = 3  # of the harmonics, of which all but the constant start at zero
    opacity: float = 0.1  # of Gaussians without a normal
    max_gaussians: int | None = None  # a larger cloud is thinned evenly; None: no limit


def gaussians_from_points(
    points_in_model: ArrayLike,
    colours: ArrayLike,
    options: InitialisationOptions | None = None,
    normals_in_model: ArrayLike | None = None,
) -> Gaussians:
    """Return at most N Gaussians, in spatial order, as 3DGS starts (doi 10.1145/3592433, section 5.1).

    A Gaussian's standard deviation is the mean distance to the three nearest other points. Points that are not
    finite, repeated or far out are left out. Without a normal, Gaussians are isotropic; with a normal, they are
    discs, because a ball as wide as the gaps between points would extend as far in front of and behind the surface.

    Args:
        points_in_model: (N, 3) metres.
        colours: (N, 3) uint8, or floats from 0 to 1.
        normals_in_model: (N, 3) unit vectors, NaN if unknown; None: all are unknown.

    Raises:
        DegenerateGeometryError: fewer than two different points.
        ValueError: shapes do not agree.
    """
    options = options or InitialisationOptions()
    points, rgb = _checked(points_in_model, colours)
    keep = _usable(points)
    if len(keep) < len(points):
        log.info("left out %d of %d points: repeated, far out or not finite", len(points) - len(keep), len(points))
    if len(keep) < 2:
        message = f"At least 2 usable SfM points are needed to initialise Gaussians; there are {len(keep)}."
        raise DegenerateGeometryError("too-few-points", message)
    order = keep[morton_order(torch.as_tensor(points[keep])).numpy()]
    if options.max_gaussians is not None and len(order) > options.max_gaussians:
        order = order[np.linspace(0, len(order) - 1, max(options.max_gaussians, 2)).astype(np.int64)]
        log.info("thinned %d SfM points to %d", len(keep), len(order))
    gaussians = gaussians_of_size(points[order], rgb[order], _gap(points[order]), options)
    if normals_in_model is not None:
        _make_discs(gaussians, np.asarray(normals_in_model, dtype=np.float64)[order])
    return gaussians


def scene_extent(camera_centers: ArrayLike) -> float:
    """Return 1.1 times the largest distance in metres of the cameras (N, 3) from their mean, as in 3DGS.

    Raises:
        DegenerateGeometryError: all cameras are at one place.
    """
    centers = np.asarray(camera_centers, dtype=np.float64).reshape(-1, 3)
    radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0)) if len(centers) else 0.0
    if not radius > 0:
        raise DegenerateGeometryError(
            "cameras-at-one-place", "All cameras are at one place: the scene has no size."
        )
    return 1.1 * radius


def gaussians_of_size(
    points_in_model: ArrayLike, colours: ArrayLike, sigma_m: ArrayLike, options: InitialisationOptions | None = None
) -> Gaussians:
    """Return isotropic Gaussians of given standard deviations (N,) in metres, else as `gaussians_from_points`."""
    options = options or InitialisationOptions()
    points, rgb = _checked(points_in_model, colours)
    count = len(points)
    sh = torch.zeros(count, coefficient_count(options.sh_degree), 3)
    sh[:, 0] = sh_from_rgb(torch.as_tensor(rgb)).float()
    return Gaussians(
        means=torch.as_tensor(points, dtype=torch.float32),
        quats_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.as_tensor(np.asarray(sigma_m)).log().float()[:, None].repeat(1, 3),
        logit_opacities=torch.logit(torch.full((count,), options.opacity)),
        sh=sh,
    )


def _make_discs(gaussians: Gaussians, normals: FloatArray) -> None:
    """Turn the third axis of Gaussians to their normals (N, 3), if known, and shorten that axis."""
    rows = np.flatnonzero(np.isfinite(normals).all(axis=1))
    normal = torch.as_tensor(normals[rows] * np.where(normals[rows, 2:] < 0, -1.0, 1.0)).float()
    # The shortest turn from z to n is about z × n. The sign that makes n point upwards avoids the opposite of z.
    quats = torch.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], torch.zeros(len(rows))], dim=1)
    gaussians.quats_wxyz[rows] = torch.nn.functional.normalize(quats, dim=1)
    gaussians.log_scales[rows, 2] += math.log(_DISC_THICKNESS)
    gaussians.logit_opacities[rows] = math.log(_DISC_OPACITY / (1 - _DISC_OPACITY))


def _gap(points: FloatArray) -> FloatArray:
    """Return the mean distance (N,) to the nearest other points, clipped to `_SCALE_SPREAD` about the median."""
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    distance, _ = cKDTree(points).query(points, k=neighbours + 1)
    gap = np.asarray(distance)[:, 1:].mean(axis=1)
    median = float(np.median(gap))
    return np.asarray(np.clip(gap, median / _SCALE_SPREAD, median * _SCALE_SPREAD))


def _usable(points: FloatArray) -> IntArray:
    """Return rows of points that are finite, not far, and no repetition (in float32, as Gaussians are kept)."""
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if len(rows) == 0:
        return rows
    _, first = np.unique(points[rows].astype(np.float32), axis=0, return_index=True)
    rows = rows[np.sort(first)]
    distance = np.linalg.norm(points[rows] - np.median(points[rows], axis=0), axis=1)
    return np.asarray(rows[distance <= _FAR * np.median(distance)])


def _checked(points_in_model: ArrayLike, colours: ArrayLike) -> tuple[FloatArray, FloatArray]:
    points, rgb = np.asarray(points_in_model, dtype=np.float64), np.asarray(colours)
    if points.ndim != 2 or points.shape[1] != 3 or rgb.shape != points.shape:
        raise ValueError(f"expected points and colours (N, 3), got {points.shape} and {rgb.shape}")
    return points, rgb / 255.0 if rgb.dtype == np.uint8 else rgb.astype(np.float64)
