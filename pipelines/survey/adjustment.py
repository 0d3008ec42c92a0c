"""Product of `init-sim3`: the similarity from the SfM model to the Earth, with its covariance.

Product of `geolocate`: SfM points on Earth, each with its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.files import read_npz
from pipelines.core.products import Caution, Covariance3, Product, Rotation, save_npz
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.similarity import SimilarityRecord
from pipelines.robust.statistics import ResidualStats
from pipelines.survey.report_parts import VarianceFactor, applied_factors, with_variance_factors
from pipelines.survey.survey import Survey


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


@dataclass(frozen=True)
class GeolocatedPoints:
    """Product of `geolocate`: N SfM points intersected in the geo frame.

    Attributes:
        point_id: (N,) int64, ids in the COLMAP model.
        position_in_geo: (N, 3) float64, metres; NaN where rays did not intersect.
        cov_in_geo: (N, 3, 3) float64, m².
        ray_count: (N,) int32, rays in use.
        max_angle_deg: (N,) float64, largest angle between two of its rays.
        condition: (N,) float64, condition number of the normal matrix.
        inlier: (N,) bool.
        rotation_source: source of the rays' rotations: "recorded" attitudes or "sfm".
    """

    point_id: IntArray
    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    inlier: BoolArray
    rotation_source: str

    def save(self, path: Path) -> None:
        """Write the points as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> GeolocatedPoints:
        """Read points from NPZ.

        Raises:
            InputError: the file is no NPZ file with these arrays.
        """
        arrays = read_npz(path, tuple(field.name for field in fields(cls)))
        for name, (kind, shape) in _POINT_ARRAYS.items():
            array = arrays[name]
            if array.dtype.kind not in kind or array.shape != (len(arrays["point_id"].ravel()), *shape):
                raise InputError(f"has the form {array.shape} {array.dtype}", path=path, field=name)
        source = str(arrays.pop("rotation_source"))
        return cls(**arrays, rotation_source=source)


# Kind of number, and shape of one point's entry.
_POINT_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "point_id": ("i", ()),
    "position_in_geo": ("f", (3,)),
    "cov_in_geo": ("f", (3, 3)),
    "ray_count": ("i", ()),
    "max_angle_deg": ("f", ()),
    "condition": ("f", ()),
    "inlier": ("b", ()),
}
