"""The product of `init-sim3`: the similarity from the SfM model to the Earth, with its covariance."""

from __future__ import annotations

from typing import Literal

from pipelines.core.products import Covariance3, Product, Rotation
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.robust.statistics import ResidualStats


class AttitudeRecord(Product):
    """Rotation `to ← from` of a similarity as recorded attitudes have it: covariance in rad² along target axes."""

    quat_xyzw: Rotation
    cov_rad2: Covariance3


class InitialSimilarity(Product):
    """Product of `init-sim3`: `geo_from_local`, how it was found and how well it is determined."""

    format_version: Literal[1] = 1
    geo_from_local: SimilarityRecord
    method: Literal["robust", "paper", "adjusted"]
    correspondences: dict[str, int]
    inliers: dict[str, int]
    gnss_outliers: tuple[str, ...] = ()
    residuals: dict[str, ResidualStats]
    condition_number: float
    layout: Literal["volume", "plane", "line"]
    attitude_used: bool
    attitude: AttitudeRecord | None = None
