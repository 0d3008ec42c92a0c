"""Product of `init-sim3`: the similarity from the SfM model to the Earth, with its covariance."""

from __future__ import annotations

from typing import Literal

from pipelines.core.cautions import Caution
from pipelines.core.products import Covariance3, Product, Rotation
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.robust.statistics import ResidualStats
from pipelines.scene.survey import Survey
from pipelines.scene.variance_factors import VarianceFactor, applied_factors, with_variance_factors


class AttitudeRecord(Product):
    """Rotation geo ← local that the recorded attitudes give.

    Attributes:
        quat_xyzw: rotation geo ← local.
        cov_rad2: 3×3 covariance in rad², axes of geo.
    """

    quat_xyzw: Rotation
    cov_rad2: Covariance3


class InitialSimilarity(Product):
    """Product of `init-sim3`: `geo_from_local`, its estimation and its precision.

    Attributes:
        format_version: version of the format.
        geo_from_local: the similarity with its covariance.
        method: `robust` or `paper`, the option of `init-sim3`; `adjusted` by the bundle adjustment of the baseline.
        correspondences: number by kind: `gnss` (camera centres with fixes), `gcp` (control points), `points`
            (geolocated points).
        inliers: number by kind that agrees with the similarity.
        gnss_outliers: names of the images whose fixes were rejected: they enter no later solution.
        control_outliers: names of the control points that were rejected, or that their marks do not determine:
            they enter no later solution.
        residuals: figures by kind.
        condition_number: of the normal matrix, with angles and ln s scaled by the size of the layout.
        layout: extent of the correspondences: they fill a volume, lie in a plane, or on a line.
        attitude_used: whether recorded attitudes contributed to the rotation.
        attitude: rotation of the recorded attitudes, if the robust method needed it.
        variance_factors: tests of the stated σ, with the factors that apply to all later stages.
        cautions: limits of the result.
    """

    format_version: Literal[1] = 1
    geo_from_local: SimilarityRecord
    method: Literal["robust", "paper", "adjusted"]
    correspondences: dict[str, int]
    inliers: dict[str, int]
    gnss_outliers: tuple[str, ...] = ()
    control_outliers: tuple[str, ...] = ()
    residuals: dict[str, ResidualStats]
    condition_number: float
    layout: Literal["volume", "plane", "line"]
    attitude_used: bool
    attitude: AttitudeRecord | None = None
    variance_factors: tuple[VarianceFactor, ...] = ()
    cautions: tuple[Caution, ...] = ()

    def weighted(self, survey: Survey) -> Survey:
        """Return a survey with the applied variance factors in its covariances."""
        return with_variance_factors(survey, applied_factors(self.variance_factors))

    def in_use(self, survey: Survey) -> Survey:
        """Return a survey without the measurements that were rejected."""
        return self._part(survey, used=True)

    def rejected(self, survey: Survey) -> Survey | None:
        """Return a survey with the rejected measurements alone; None: there are none."""
        return self._part(survey, used=False) if self.gnss_outliers or self.control_outliers else None

    def _part(self, survey: Survey, *, used: bool) -> Survey:
        bad_fixes, bad_points = set(self.gnss_outliers), set(self.control_outliers)
        images = tuple(
            image if (image.name not in bad_fixes) == used else image.model_copy(update={"fix": None})
            for image in survey.images
        )
        control = tuple(point for point in survey.control_points if (point.name not in bad_points) == used)
        return survey.model_copy(update={"images": images, "control_points": control})
