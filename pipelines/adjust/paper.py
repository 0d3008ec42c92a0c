"""The similarity by the paper: plain least squares on the geolocated points (GeoRefGS section 2.4.1, eqs 16–21)."""

from __future__ import annotations

import numpy as np

from pipelines.adjust.alignment import layout_of
from pipelines.adjust.figures import counts_of, residuals_of, residuals_of_points
from pipelines.adjust.similarity_fit import Correspondences
from pipelines.core.errors import DegenerateGeometryError
from pipelines.geometry.similarity import jacobian_at, spread_ratio_similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.scene.geolocated import GeolocatedPoints
from pipelines.scene.initial_similarity import InitialSimilarity


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
            f"--method paper needs 3 geolocated points, there are {good.sum()}: use --method robust"
        )
    local, geo = model.point_in_local[good], points.position_in_geo[good]
    similarity = spread_ratio_similarity(local, geo)
    mapped = similarity.apply(local)
    pivot = mapped.mean(axis=0)
    jacobian = jacobian_at(mapped, pivot)
    normal = np.einsum("nia,nib->ab", jacobian, jacobian)
    variance = float(((geo - mapped) ** 2).mean()) * max(len(local) / len(model.image_name), 1.0)
    size = np.ones(7)
    size[:4] = np.sqrt(((mapped - pivot) ** 2).sum(axis=1).mean())
    return InitialSimilarity(
        geo_from_local=similarity.to_record(
            "local", "geo", covariance=variance * np.linalg.solve(normal, np.eye(7)), pivot=pivot
        ),
        method="paper",
        correspondences=counts_of(data.control[:0], good),
        inliers=counts_of(data.control[:0], good),
        residuals={
            **residuals_of(data, data.in_geo - similarity.apply(data.in_local)),
            "points": residuals_of_points(model, points, similarity),
        },
        condition_number=float(np.linalg.cond(normal / np.outer(size, size))),
        layout=layout_of(local),
        attitude_used=points.rotation_source == "recorded",
    )
