"""Counts and residuals of an initial similarity, by kind of correspondence."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.similarity_fit import OUTLIER_GATE, Correspondences
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.robust.statistics import ResidualStats, residual_stats, squared_mahalanobis
from pipelines.scene.geolocated import GeolocatedPoints


def counts_of(control: BoolArray, points: BoolArray) -> dict[str, int]:
    """Return the numbers of camera centres and control points, from the mask of the latter, and of points."""
    return {"gnss": int((~control).sum()), "gcp": int(control.sum()), "points": int(points.sum())}


def agreeing_points(model: SparseModel, points: GeolocatedPoints, similarity: Similarity) -> BoolArray:
    """Return the mask (N,) of the geolocated points that agree with a similarity within their covariance."""
    good = points.inlier.copy()
    missed = points.position_in_geo[good] - similarity.apply(model.point_in_local[good])
    good[good] = squared_mahalanobis(missed, points.cov_in_geo[good]) <= OUTLIER_GATE
    return np.asarray(good)


def residuals_of_points(model: SparseModel, points: GeolocatedPoints, similarity: Similarity) -> ResidualStats:
    """Return the figures of the geolocated points' residuals."""
    good = points.inlier
    return residual_stats(points.position_in_geo[good] - similarity.apply(model.point_in_local[good]))


def residuals_of(data: Correspondences, missed: FloatArray) -> dict[str, ResidualStats]:
    """Return the figures of residuals (n, 3) of camera centres and control points."""
    return {"gnss": residual_stats(missed[~data.control]), "gcp": residual_stats(missed[data.control])}
