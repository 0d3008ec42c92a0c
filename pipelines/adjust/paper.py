"""The similarity by the paper, and the figures of an initial similarity, which both methods state alike.

The paper's method is plain least squares on the geolocated points (GeoRefGS section 2.4.1, eqs 16–21).
"""

from __future__ import annotations

import numpy as np

from pipelines.adjust.alignment import OUTLIER_GATE, Correspondences, covariance_of, layout_of
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.similarity import Similarity, jacobian_at, spread_ratio_similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.robust.statistics import ResidualStats, residual_stats, squared_mahalanobis
from pipelines.survey.adjustment import GeolocatedPoints, InitialSimilarity


def similarity_by_paper(model: SparseModel, points: GeolocatedPoints, data: Correspondences) -> InitialSimilarity:
    """Return the paper's similarity (eqs 16–21) of the geolocated points, with equal weights.

    The paper gives no covariance. Here the covariance follows from the scatter of the points, counted as only one
    point for each image, because the points share the errors of the images.

    Raises:
        DegenerateGeometryError: fewer than three points.
    """
    good = points.inlier
    if good.sum() < 3:
        raise DegenerateGeometryError(
            "too-few-geolocated-points",
            f"--method paper needs at least three geolocated points; there are {good.sum()}. Use --method robust.",
        )
    local, geo = model.point_in_local[good], points.position_in_geo[good]
    similarity = spread_ratio_similarity(local, geo)
    mapped = similarity.apply(local)
    pivot = mapped.mean(axis=0)
    variance = float(((geo - mapped) ** 2).mean()) * max(len(local) / len(model.image_name), 1.0)
    unit = np.ones(7)
    unit[:4] = ((mapped - pivot) ** 2).sum(axis=1).mean() ** -0.5
    covariance = covariance_of(jacobian_at(mapped, pivot).reshape(-1, 7), unit)
    return InitialSimilarity(
        geo_from_local=similarity.to_record("local", "geo", covariance=variance * covariance, pivot=pivot),
        method="paper",
        correspondences=counts_of(data.control[:0], good),
        inliers=counts_of(data.control[:0], good),
        residuals={
            **residuals_of(data, data.in_geo - similarity.apply(data.in_local)),
            "points": residuals_of_points(model, points, similarity),
        },
        condition_number=float(np.linalg.cond(covariance / np.outer(unit, unit))),
        layout=layout_of(local),
        attitude_used=points.rotation_source == "recorded",
    )


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
