"""Product of `evaluate`: quality and accuracy of a trained survey, stored as `evaluate/report.json`.

Lengths are metres, axes those of `geo` (east, north, up). An error is the measured minus the surveyed position. A
figure that does not exist, such as a mean over no points, is None. docs/formats.md explains every field.
"""

from pathlib import Path
from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer

from pipelines.core.errors import InputError
from pipelines.core.figures import Headline, ToleranceTest
from pipelines.core.products import ImageName, Product, Remark, load_json
from pipelines.core.types import Vector3
from pipelines.geometry.statistics import ResidualStats
from pipelines.survey.lidar_report import HeldOutDepths
from pipelines.survey.measurement_errors import VarianceFactor
from pipelines.survey.reference_comparison import ReferenceComparison


class _OptionalKeys(Product):
    """Base of parts with optional keys: a field with the default None is written only if it has a value."""

    @model_serializer(mode="wrap")
    def _existing_keys(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        document: dict[str, Any] = serialise(self)
        return {key: value for key, value in document.items() if value is not None or fields[key].is_required()}


class ViewFigures(Product):
    """Photometric figures of one test view: PSNR in dB, SSIM, LPIPS.

    `psnr_covered` is taken over the `covered_share` of the pixels whose ground at least two training views show.
    """

    image: ImageName
    psnr: float
    psnr_compensated: float
    ssim: float
    lpips: float | None
    covered_share: float | None = None
    psnr_covered: float | None = None
    psnr_over_white: float | None = None


class PhotometricFigures(_OptionalKeys):
    """Photometric figures of all test views: means, and the figures of each view.

    `psnr_compensated` follows an affine change of colour that is fitted to each photograph; `psnr_covered` is the
    mean over the views that have covered pixels. `psnr` is that of renders over black, `psnr_over_white` of renders
    over white. LPIPS is None without weights of its network, as its reason says.
    """

    views: int
    psnr: float | None
    psnr_compensated: float | None
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None = None
    psnr_covered: float | None = None
    psnr_over_white: float | None = None
    covered_share: float | None = None
    per_view: tuple[ViewFigures, ...]


class Photometric(Product):
    """Photometric figures by split."""

    test: PhotometricFigures


class ErrorStats(Product):
    """Figures of errors; `mean_e_m`, `mean_n_m`, `mean_u_m` are signed (the bias), all others are lengths."""

    count: int
    mean_e_m: float | None
    mean_n_m: float | None
    mean_u_m: float | None
    mean_h_m: float | None
    median_h_m: float | None
    rmse_e_m: float | None
    rmse_n_m: float | None
    rmse_h_m: float | None
    rmse_v_m: float | None
    rmse_3d_m: float | None
    max_h_m: float | None
    max_v_m: float | None
    max_3d_m: float | None


class Rmse(Product):
    """Horizontal (east and north together) and vertical root mean square."""

    rmse_h_m: float
    rmse_v_m: float


class TotalRmse(Rmse):
    """Horizontal, vertical and three-dimensional root mean square."""

    rmse_3d_m: float


class VegetatedAccuracy(Product):
    """Vertical accuracy under vegetation (VVA), the points' own survey included; the standard gives it no class."""

    count: int
    rmse_v_m: float


class AsprsStatement(Product):
    """Classes of the ASPRS standard, edition 2, version 2 (2024), met by the points outside vegetation ("5 cm")."""

    points: int
    horizontal_class: str | None
    vertical_class: str | None
    class_3d: str | None
    vegetated: VegetatedAccuracy | None
    area_km2: float | None
    least_points: int
    enough_points: bool
    statement: str | None


class ByAxis(Product):
    """Figure by axis: east, north, up."""

    e: float | None
    n: float | None
    u: float | None


class RmsSigma(Product):
    """Root mean square of σ over `count` points, horizontal and vertical."""

    count: int
    rms_h_m: float | None
    rms_v_m: float | None


class PredictedSigma(RmsSigma):
    """Predicted σ, and the mean of error² / (predicted + survey variance): 1 if both variances are true."""

    normalised_error_squared: ByAxis


class PointResidual(Product):
    """Error of a surveyed point with marks in `rays` registered images; None: not measured."""

    name: str
    rays: int
    de_m: float | None
    dn_m: float | None
    du_m: float | None

    @property
    def error_m(self) -> Vector3 | None:
        """Error east, north, up; None: the point was not measured."""
        east, north, up = self.de_m, self.dn_m, self.du_m
        return None if east is None or north is None or up is None else (east, north, up)


class PointError(PointResidual):
    """Error of a point that entered no solution.

    That of a blunder is thrice the class that the others meet, or five times what σ and the others let expect.
    """

    blunder: bool


class PredictedPointError(PointError):
    """Error of a point that entered no solution, with its σ; None: the rays do not determine the point."""

    sigma_e_m: float | None
    sigma_n_m: float | None
    sigma_u_m: float | None

    @property
    def sigma_m(self) -> Vector3 | None:
        """σ east, north, up; None: there is no prediction."""
        east, north, up = self.sigma_e_m, self.sigma_n_m, self.sigma_u_m
        return None if east is None or north is None or up is None else (east, north, up)


PointRows = tuple[PredictedPointError | PointError, ...]


class StatedErrors(ErrorStats):
    """Figures of errors; with σ of the points' own survey, and both in quadrature.

    Points under vegetation count in the errors alone, and neither in `survey` nor in `with_survey`. Of the
    blunders, `refuted` are those that σ and the other points refute, and `with_survey_without_refuted` is the
    accuracy without these. None: there are no such points, or there is no prediction.
    """

    survey: Rmse | None
    with_survey: TotalRmse | None
    without_blunders: ErrorStats | None
    with_survey_without_refuted: TotalRmse | None = None
    blunders: tuple[str, ...]
    refuted: tuple[str, ...] = ()
    predicted: PredictedSigma | None
    points: PointRows


class CheckPointErrors(StatedErrors):
    """Errors of the check points, measured in one way."""

    asprs: AsprsStatement


class SurfaceHeight(Product):
    """Height of the surface straight below or above a check point, minus the surveyed one; None: not measured.

    `place`: on the `ground`, `raised` (roofs), at an `edge` (walls) or `covered` by another surface, both without a
    difference, or None where the ground is not known.
    """

    name: str
    du_m: float | None
    place: Literal["ground", "raised", "edge", "covered"] | None


class CheckPoints(Product):
    """Check points, `triangulated`, and on the rendered `surface` behind their marks; its `heights` from above.

    Without training, `surface` is None. Points under vegetation have no height of the surface.
    """

    triangulated: CheckPointErrors
    surface: CheckPointErrors | None
    heights: tuple[SurfaceHeight, ...] = ()

    @property
    def by_way(self) -> dict[Literal["triangulated", "surface"], CheckPointErrors]:
        if self.surface is None:
            return {"triangulated": self.triangulated}
        return {"triangulated": self.triangulated, "surface": self.surface}


class CrossValidation(StatedErrors):
    """Errors of the control points, each measured by a solution without it; or the reason why there are none."""

    reason: str | None


class AccuracySummary(_OptionalKeys):
    """Predicted σ over the cells of the scene, or the reason why there are no cells.

    The root mean square of σ is the RMSE that the prediction lets expect.
    """

    cells: int
    cell_m: float | None = None
    least_sigma_h_m: float | None = None
    median_sigma_h_m: float | None = None
    largest_sigma_h_m: float | None = None
    least_sigma_v_m: float | None = None
    median_sigma_v_m: float | None = None
    largest_sigma_v_m: float | None = None
    rms_sigma_h_m: float | None = None
    rms_sigma_v_m: float | None = None
    reason: str | None


class FixResiduals(ResidualStats):
    """Residuals of the training cameras' fixes; `outliers` is the number of those left out."""

    outliers: int


class ControlResiduals(ResidualStats):
    """Residuals of the control points: figures of the used ones; `outliers` is the number of the others."""

    outliers: int = 0
    points: tuple[PointResidual, ...]


class Fit(Product):
    """Residuals of the observations that entered the solution. These are no accuracy."""

    gnss: FixResiduals
    gcp: ControlResiduals


class DistanceError(Product):
    """Distance between two marked points, measured in the solution; None: its ends are not measured.

    `sigma_m` is the predicted σ of the measured distance, `stated_sigma_m` that of the given one. A control
    distance entered the solution: its error is a residual, unless `rejected`.
    """

    name: str
    use: Literal["control", "check"]
    rejected: bool
    distance_m: float
    stated_sigma_m: float
    measured_m: float | None
    error_m: float | None
    sigma_m: float | None


class SimilaritySigma(Product):
    """σ of the trained similarity: of ln(scale), and of the translation along east, north, up."""

    sigma_ln_scale: float
    sigma_translation_m: Vector3


class PointCoordinates(Product):
    """Coordinates of a check point in a CRS, as surveyed and as measured; None: not measured."""

    name: str
    surveyed: Vector3
    triangulated: Vector3 | None
    surface: Vector3 | None


class Coordinates(Product):
    """Check points and origin of `geo` in a CRS: easting or longitude first, height last.

    `heights` is the surface that these count from, `operation` the published one between WGS84 and the CRS.
    """

    crs: str
    units: tuple[str, str, str]
    heights: str
    operation: str
    operation_accuracy_m: float | None
    origin: Vector3
    points: tuple[PointCoordinates, ...]

    def texts(self, xyz: Vector3 | None) -> tuple[str, str, str]:
        """Return coordinates as texts to a tenth of a millimetre; empty ones for None."""
        if xyz is None:
            return "", "", ""
        first, second, third = (
            f"{value:.{9 if 'degree' in unit or 'grad' in unit else 4}f}"
            for value, unit in zip(xyz, self.units, strict=True)
        )
        return first, second, third


class EvaluationReport(_OptionalKeys):
    """Product of `evaluate`; the cautions are those of the model, then those that `evaluate` found."""

    format_version: Literal[1] = 1
    headline: Headline
    area_ha: float | None = None  # of interest; None: no ground is seen by enough photographs
    area_measured: float | None = None  # share of it that the training views measure; None: not trained
    photometric: Photometric | None
    checkpoints: CheckPoints
    cross_validation: CrossValidation | None
    accuracy: AccuracySummary
    fit: Fit
    cameras: RmsSigma | None
    similarity: SimilaritySigma
    coordinates: Coordinates | None = None
    reference: ReferenceComparison | None = None
    held_out: HeldOutDepths | None = None  # None: not trained with measured geometry, or none was held out
    distances: tuple[DistanceError, ...] = ()
    tolerances: tuple[ToleranceTest, ...] = ()
    variance_factors: tuple[VarianceFactor, ...] = ()
    cautions: tuple[Remark, ...] = ()

    @property
    def test_views(self) -> PhotometricFigures | None:
        return None if self.photometric is None else self.photometric.test


def read_report(path: Path) -> EvaluationReport:
    """Return the report at `path`.

    Raises:
        InputError: the file cannot be read or is no report; names the field at fault.
    """
    try:
        return load_json(EvaluationReport, path)
    except InputError as error:
        if not isinstance(error.__cause__, ValueError):  # The file cannot be read: its content is not at fault.
            raise
        message = "is not a report."
        remedy = "Make it again with `georef evaluate --force`."
        raise InputError("report-invalid", message, path=path, field=error.field, remedy=remedy) from error
