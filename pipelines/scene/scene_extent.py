"""Extent of the scene that files cover: that of the SfM points, without those at its rim."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.scene.trained_survey import SolvedSurvey

_RIM = 0.002  # fraction of the SfM points outside the extent on each side


def scene_points(solved: SolvedSurvey) -> FloatArray:
    """Return the SfM points (P, 3) in `geo` that lie within the scene: those at its rim are left out.

    Raises:
        DegenerateGeometryError: the SfM model has no points.
    """
    if not len(solved.sfm.point_in_local):
        raise DegenerateGeometryError("the SfM model has no points: nothing says where the scene ends")
    points = solved.geo_from_model.apply(solved.point_in_model)
    low, high = np.quantile(points[:, :2], [_RIM, 1 - _RIM], axis=0)
    return np.asarray(points[((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)])


def scene_area_km2(solved: SolvedSurvey) -> float | None:
    """Return the area of the convex hull of the scene's points in plan; None: too few points, or all on a line."""
    try:
        return float(ConvexHull(scene_points(solved)[:, :2]).volume) / 1e6  # in the plane, the volume is the area
    except (DegenerateGeometryError, QhullError, ValueError):
        return None


def corners(points: FloatArray) -> FloatArray:
    """Return the corners (8, 3) of the box around points."""
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    return np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
