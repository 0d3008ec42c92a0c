"""Parts of the solution, the verdict on measurements and the similarity before it; and SfM points on Earth."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.products import ArrayProduct, Product, Remark
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.geometry.statistics import ResidualStats
from pipelines.survey.report_parts import (
    VarianceFactor,
    applied_factors,
    factor_of_check_points,
    with_variance_factors,
)
from pipelines.survey.survey import Survey


class MeasurementVerdict(Product):
    """What `init-sim3` has decided of the measurements, which every later stage keeps.

    Attributes:
        gnss_outliers, control_outliers, distance_outliers: names of the images whose fixes, of the control points
            and of the distances that were rejected, or that their marks do not determine: they enter no solution.
        variance_factors: tests of the stated σ, with the factors that apply to all later stages.
        tied: whether points in common with an earlier date take part.
        common_outliers: COLMAP's ids of those that were rejected.
        cautions: limits of the solution.
    """

    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    distance_outliers: tuple[str, ...] = ()
    variance_factors: tuple[VarianceFactor, ...] = ()
    tied: bool = False
    common_outliers: tuple[int, ...] = ()
    cautions: tuple[Remark, ...] = ()

    @property
    def verdict(self) -> dict[str, Any]:
        """Values of these fields, for another product that keeps them."""
        return {name: getattr(self, name) for name in MeasurementVerdict.model_fields}

    def weighted(self, survey: Survey) -> Survey:
        """Return a survey with the applied variance factors in its covariances."""
        factors = self.variance_factors
        of_checks = factor_of_check_points(factors)
        return with_variance_factors(survey, applied_factors(factors), of_assumed_checks=of_checks)

    def rejected(self, survey: Survey) -> Survey | None:
        """Return a survey with the rejected measurements alone; None: there are none."""
        outliers = self.gnss_outliers or self.control_outliers or self.distance_outliers
        return self.in_use(survey, used=False) if outliers else None

    def in_use(self, survey: Survey, *, used: bool = True) -> Survey:
        """Return a survey without the measurements that were rejected, or else with these alone."""
        bad_fixes, bad_points = set(self.gnss_outliers), set(self.control_outliers)
        images = tuple(
            image if (image.name not in bad_fixes) == used else image.model_copy(update={"fix": None})
            for image in survey.images
        )
        control = tuple(point for point in survey.control_points if (point.name not in bad_points) == used)
        bad_distances = set(self.distance_outliers)
        distances = tuple(
            distance
            for distance in survey.distances
            if distance.use == "check" or (distance.name not in bad_distances) == used
        )
        common = None
        if used and self.tied and survey.common is not None:
            common = survey.common.without(self.common_outliers)
        return survey.model_copy(
            update={"images": images, "control_points": control, "distances": distances, "common": common}
        )


class SimilarityEstimate(Product):
    """How `init-sim3` has found the similarity of the SfM model, and how well its correspondences agree with it.

    Attributes:
        geo_from_local: of a joint adjustment, that of its solution.
        method: `robust` or `paper`, the option of `init-sim3`; `adjusted` by the bundle adjustment of the baseline.
        correspondences, inliers: numbers by kind, of all and of those that agree with the similarity: `gnss`
            (camera centres with fixes), `gcp` (control points), `points` (intersected points).
        condition_number: of the normal matrix, with angles and ln s scaled by the size of the layout.
        layout: extent of the correspondences: they fill a volume, lie in a plane, or on a line.
    """

    geo_from_local: SimilarityRecord
    method: Literal["robust", "paper", "adjusted"]
    correspondences: dict[str, int]
    inliers: dict[str, int]
    residuals: dict[str, ResidualStats]
    condition_number: float
    layout: Literal["volume", "plane", "line"]
    attitude_used: bool


@dataclass(frozen=True)
class GeolocatedPoints(ArrayProduct):
    """Product of `geolocate`: N SfM points intersected in the geo frame.

    Attributes:
        point_id: of the COLMAP model.
        position_in_geo, cov_in_geo: metres, m²; NaN where rays did not intersect.
        ray_count: int32, rays in use.
        max_angle_deg: largest angle between two of its rays.
        condition: condition number of the normal matrix.
        rotation_source: source of the rays' rotations: "recorded" attitudes or "sfm".
    """

    FORMS: ClassVar = {
        "point_id": ("i", "N"),
        "position_in_geo": ("f", "N", 3),
        "cov_in_geo": ("f", "N", 3, 3),
        "ray_count": ("i", "N"),
        "max_angle_deg": ("f", "N"),
        "condition": ("f", "N"),
        "inlier": ("b", "N"),
        "rotation_source": None,
    }

    point_id: IntArray
    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    inlier: BoolArray
    rotation_source: str
