"""Parts of reports: comparison with a reference cloud, LiDAR of a training, variance factors, systematic errors.

Lengths are metres. docs/formats.md explains the fields of what `evaluate` writes.
"""

from typing import Literal

import numpy as np

from pipelines.core.products import Covariance3, Product, Remark
from pipelines.core.types import Matrix3, Matrix34, Vector3
from pipelines.survey.survey import FixSession, Survey, SurveyedPoint, SurveyImage

Alignment = Literal["none", "shift", "similarity"]


class SurfaceScore(Product):
    """Shares of points that lie within a distance of the other cloud; None: there are no points.

    Precision is that of the model's points, where the reference covers the plan; recall that of the reference's
    points that photographs saw; F1 their harmonic mean.
    """

    threshold_m: float
    precision: float | None
    recall: float | None
    f1: float | None


class M3c2Figures(Product):
    """Distances model minus reference along the reference's normals (M3C2), positive on the cameras' side.

    They are measured at those of the core points, which photographs saw, that have points of both clouds nearby.
    """

    core_points: int
    measured: int
    median_m: float | None
    mean_m: float | None
    nmad_m: float | None
    rmse_m: float | None
    abs_95_m: float | None
    median_lod_m: float | None
    significant: float | None


class CloudDistances(Product):
    """Distances of the model's points from the nearest point of the reference (C2C), to the millimetre.

    They are taken where the reference covers the plan; those beyond 2 m count as 2 m.
    """

    count: int
    median_m: float | None
    mean_m: float | None
    abs_95_m: float | None


class ReferenceGroup(Product):
    """Figures of one part of the surface, of which photographs saw `seen_points` of the reference.

    Its name is `all`; a class (`ground`, `roof`, `wall`, `vegetation`, `other`); or a range of slopes.
    """

    name: str
    kind: Literal["all", "class", "slope"]
    seen_points: int
    m3c2: M3c2Figures
    c2c: CloudDistances
    scores: tuple[SurfaceScore, ...]


class ReferenceShift(Product):
    """Translation that moves the model onto the reference best, by points and planes.

    σ are from the spread between parts of the scene; `reference_from_model` has the rows of [sR | t] in geo.
    """

    enu_m: Vector3
    sigma_m: Vector3
    scale_ppm: float
    turn_deg: float
    reference_from_model: Matrix34
    points: int


class ReferenceComparison(Product):
    """Comparison of the surface with a reference cloud, from which a shift may have been removed (`aligned`).

    The level of detection holds `georeference_sigma_m`, but for None, which is not known.
    """

    name: str
    crs: tuple[str, ...]
    points: int
    seen: float
    spacing_m: float
    model_points: int
    model_spacing_m: float
    sigma_m: float
    georeference_sigma_m: float | None
    shift: ReferenceShift | None
    aligned: Alignment
    cylinder_m: float
    groups: tuple[ReferenceGroup, ...]


class LidarArea(Product):
    """Area where the LiDAR and the photographs disagree.

    Attributes:
        kind: `removed`: the photographs look through the LiDAR's points; `added`: they show a surface above them.
        area_m2: in plan.
        points: of the thinned cloud; their mean is `center_in_geo`, `lat_deg`, `lon_deg`.
    """

    kind: Literal["removed", "added"]
    area_m2: float
    points: int
    center_in_geo: Vector3
    lat_deg: float
    lon_deg: float


class LidarRegistration(Product):
    """Shift of the LiDAR against the surface of the photographs, axes of geo.

    Attributes:
        shift_m: LiDAR minus photographs.
        sigma_m: of the shift: comparison, georeference and stated σ of the LiDAR.
        sigma_comparison_m: of the comparison alone.
        points: compared, on planes.
        spread_m: robust σ of the distances that remain.
        wall_bias_m: surface of stereo outside the LiDAR's walls.
        removed: whether the shift was taken out, by `--lidar-register`.
    """

    shift_m: Vector3
    sigma_m: Vector3
    sigma_comparison_m: Vector3
    points: int
    spread_m: float
    wall_bias_m: float
    removed: bool


class LidarReport(Product):
    """LiDAR of a training.

    Attributes:
        read, noise, withheld, overlap, outside: numbers of points read, and dropped by reason.
        points: that remain after thinning, about `voxel_m` apart, and that the training was given.
        held_out: number of further ones that it was not given (`lidar_held_out`).
        rejected_share: of the points, which disagree with the photographs.
        confidence: median over the points.
        areas: that have changed, the largest first.
        assumptions: what the files do not say.
    """

    format_version: Literal[1] = 1
    crs: tuple[str, ...]
    read: int
    noise: int
    withheld: int
    overlap: int
    outside: int
    points: int
    held_out: int = 0
    voxel_m: float
    registration: LidarRegistration
    rejected_share: float
    confidence: float
    areas: tuple[LidarArea, ...]
    assumptions: tuple[Remark, ...] = ()


class DepthErrors(Product):
    """Errors of a surface at measured points, along their normals; above zero, it lies in front of them.

    Attributes:
        points: number of points.
        bias_m: median with sign.
        median_m, abs_90_m: median and 90th percentile of the magnitude.
    """

    points: int
    bias_m: float | None
    median_m: float | None
    abs_90_m: float | None


class HeldOutDepths(Product):
    """Errors of the surface at the measured points that the training was not given.

    Both are of the same points: where the depth maps of the photographs and the renders both show a surface, in the
    view that shows the point most closely.

    Attributes:
        share: of the squares of the plan that were held out.
        points: held-out points that a training view shows.
        changed, unseen: numbers of those that the photographs contradict, and that no training view shows.
        known_before, known_after: numbers of points at which depth maps and renders show a surface.
        before: of the photographs' depth maps, without measured geometry.
        after: of the trained model.
    """

    share: float
    points: int
    changed: int
    unseen: int
    known_before: int
    known_after: int
    before: DepthErrors
    after: DepthErrors


Group = Literal[
    "fixes",
    "horizontal drift",
    "vertical drift",
    "horizontal common error",
    "vertical common error",
    "control points",
    "marks",
    "attitudes",
    "tie points",
    "common points",
]
SigmaSource = Literal["stated", "default"]


class VarianceFactor(Product):
    """Test of the stated σ of one group of measurements, after a least-squares adjustment.

    Without redundancy, `estimated` is None and the probability is 1.
    """

    group: Group
    count: int
    used: int
    redundancy: float
    estimated: float | None
    probability: float
    applied: float
    sigma_source: SigmaSource


def applied_factors(factors: tuple[VarianceFactor, ...]) -> dict[Group, float]:
    """Return the applied factor by group, groups without one left out."""
    return {factor.group: factor.applied for factor in factors if factor.applied != 1.0}


def factor_of_check_points(factors: tuple[VarianceFactor, ...]) -> float:
    """Return the factor of check points whose σ nobody stated: that of control points by the same assumption.

    A factor below 1 says how well the solution fits its control, and nothing of points that it does not know.
    """
    control = next((factor for factor in factors if factor.group == "control points"), None)
    return max(control.applied, 1.0) if control is not None and control.sigma_source == "default" else 1.0


def with_variance_factors(survey: Survey, applied: dict[Group, float], *, of_assumed_checks: float = 1.0) -> Survey:
    """Return the survey with the covariances of each group multiplied by its factor.

    The σ of marks applies to check points too: the same person marks both. The surveyed positions of the check
    points keep their covariance; those with the σ of the control points get the factor `of_assumed_checks`.
    """
    if not applied:
        return survey
    of_marks = applied.get("marks", 1.0)
    return survey.model_copy(
        update={
            "images": tuple(_image(image, applied) for image in survey.images),
            "sessions": tuple(_session(session, applied) for session in survey.sessions),
            "common": None if survey.common is None else survey.common.scaled(applied.get("common points", 1.0)),
            "control_points": tuple(
                _point(point, applied.get("control points", 1.0), of_marks) for point in survey.control_points
            ),
            "check_points": tuple(
                _point(point, of_assumed_checks if _has_sigma_of(point, survey.control_points) else 1.0, of_marks)
                for point in survey.check_points
            ),
        }
    )


def _image(image: SurveyImage, applied: dict[Group, float]) -> SurveyImage:
    fix, attitude = image.fix, image.attitude
    if fix is not None:
        fix = fix.scaled(applied.get("fixes", 1.0))
    if attitude is not None:
        sigma_deg = attitude.sigma_deg * applied.get("attitudes", 1.0) ** 0.5
        attitude = attitude.model_copy(update={"sigma_deg": sigma_deg})
    return image.model_copy(update={"fix": fix, "attitude": attitude})


def _session(session: FixSession, applied: dict[Group, float]) -> FixSession:
    def scaled(sigma_m: Vector3, horizontal: Group, vertical: Group) -> Vector3:
        across, up = (applied.get(group, 1.0) ** 0.5 for group in (horizontal, vertical))
        return (across * sigma_m[0], across * sigma_m[1], up * sigma_m[2])

    return session.model_copy(
        update={
            "sigma_common_m": scaled(session.sigma_common_m, "horizontal common error", "vertical common error"),
            "sigma_drift_m": scaled(session.drift_m, "horizontal drift", "vertical drift"),
        }
    )


def _point(point: SurveyedPoint, of_survey: float, of_marks: float) -> SurveyedPoint:
    marks = tuple(mark.model_copy(update={"sigma_px": mark.sigma_px * of_marks**0.5}) for mark in point.marks)
    return point.model_copy(update={"cov_in_geo": _scaled(point.cov_in_geo, of_survey), "marks": marks})


def _has_sigma_of(point: SurveyedPoint, others: tuple[SurveyedPoint, ...]) -> bool:
    """Return whether a point has the σ of one of the others, but for the turn of the vertical between them."""
    return any(np.allclose(point.cov_in_geo, other.cov_in_geo, rtol=1e-3, atol=1e-9) for other in others)


def _scaled(covariance: Covariance3, factor: float) -> Matrix3:
    first, second, third = (factor * np.array(covariance)).tolist()
    return (tuple(first), tuple(second), tuple(third))


class EstimatedError(Product):
    """Systematic error of the measurements that the adjustment estimated, with its σ, by axis.

    Attributes:
        name: `bias`: fix minus truth, east, north, up, in m. `lever-arm`: antenna seen from the camera beyond the
            arm that the survey has applied, camera axes, in m. `boresight`: rotation vector from the true to the
            nominal camera axes, in degrees. `lidar-shift`: LiDAR minus its true place, east, north, up, in m.
            `earlier-date`: truth minus the places of the earlier date, east, north, up, in m.
        observed: σ is at most half of that of the prior, and of lever arm and boresight at most a tenth.
    """

    name: Literal["bias", "lever-arm", "boresight", "lidar-shift", "earlier-date"]
    session: int | None = None
    unit: Literal["m", "deg"]
    value: Vector3
    sigma: Vector3
    prior: Vector3
    observed: tuple[bool, bool, bool]

    @property
    def text(self) -> str:
        """Values with their σ: `(+0.251 ± 0.012, -0.098 ± 0.011, +0.150 ± 0.030) m right, down, forward`."""
        axes = "right, down, forward" if self.name in ("lever-arm", "boresight") else "east, north, up"
        values = (f"{value:+.3f} ± {sigma:.3f}" for value, sigma in zip(self.value, self.sigma, strict=True))
        return f"({', '.join(values)}) {self.unit} {axes}"
