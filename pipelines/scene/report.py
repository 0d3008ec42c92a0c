"""The product of `evaluate`: how good a trained survey is, as `evaluate/report.json` states it.

Lengths are metres, axes those of `geo` (east, north, up), errors measured minus surveyed. docs/formats.md explains
the fields to people. None stands for a figure that does not exist, such as a mean over no points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, model_serializer

from pipelines.core.errors import InputError
from pipelines.core.products import ImageName, Product, dump_json, load_json
from pipelines.core.types import Vector3
from pipelines.robust.statistics import ResidualStats


class _OptionalKeys(Product):
    """Base of parts with optional keys: a field with the default None is written only where it has a value."""

    @model_serializer(mode="wrap")
    def _existing_keys(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        document: dict[str, Any] = serialise(self)
        return {key: value for key, value in document.items() if value is not None or fields[key].is_required()}


class ViewFigures(Product):
    """Photometric figures of one test view: PSNR in dB, SSIM, LPIPS."""

    image: ImageName
    psnr: float
    psnr_compensated: float
    ssim: float
    lpips: float | None


class PhotometricFigures(_OptionalKeys):
    """Means over the test views, and each view.

    `psnr_compensated` comes after an affine change of colour that is fitted to the photograph itself.
    `lpips_reason` says why there is no LPIPS.
    """

    views: int
    psnr: float | None
    psnr_compensated: float | None
    ssim: float | None
    lpips: float | None
    lpips_reason: str | None = None
    per_view: tuple[ViewFigures, ...]


class Photometric(Product):
    """Photometric figures by split."""

    test: PhotometricFigures


class ErrorStats(Product):
    """Figures of errors. `mean_e_m`, `mean_n_m`, `mean_u_m` are signed (the bias), all others are lengths."""

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
    """The same, and both together."""

    rmse_3d_m: float


class AsprsStatement(Product):
    """The accuracy classes of ASPRS, 2nd edition, and a sentence to quote; None without check points."""

    horizontal_class: str | None
    vertical_class: str | None
    least_points: int
    enough_points: bool
    statement: str | None


class ByAxis(Product):
    """A figure for each axis."""

    e: float | None
    n: float | None
    u: float | None


class RmsSigma(Product):
    """Root mean square over `count` points of σ, horizontal and vertical."""

    count: int
    rms_h_m: float | None
    rms_v_m: float | None


class PredictedSigma(RmsSigma):
    """Predicted σ, and the mean of error² / (predicted + survey variance): 1 if both are true."""

    normalised_error_squared: ByAxis


class PointResidual(Product):
    """A surveyed point: its number of rays, and its error, None where it was not measured."""

    name: str
    rays: int
    de_m: float | None
    dn_m: float | None
    du_m: float | None


class PointError(PointResidual):
    """A point that entered no solution. `blunder`: beyond three times the class that the other points meet."""

    blunder: bool


class PredictedPointError(PointError):
    """The same with its predicted σ, None where the rays do not determine the point."""

    sigma_e_m: float | None
    sigma_n_m: float | None
    sigma_u_m: float | None


PointRows = tuple[PredictedPointError | PointError, ...]


class StatedErrors(ErrorStats):
    """Errors, the points' own survey, and both in quadrature (`with_survey`)."""

    survey: Rmse | None
    with_survey: TotalRmse | None


class CheckPointErrors(StatedErrors):
    """Check points measured in one way: statement, prediction, Cramér–Rao bound, a row a point."""

    asprs: AsprsStatement
    without_blunders: ErrorStats | None
    blunders: tuple[str, ...]
    predicted: PredictedSigma | None
    cramer_rao: RmsSigma | None
    points: PointRows


class CheckPoints(Product):
    """The check points by camera (rays of their marks) and by model (surface behind their marks)."""

    camera: CheckPointErrors
    model: CheckPointErrors


class CrossValidation(StatedErrors):
    """Control points, each measured by a solution without it. `reason`: why there is none."""

    without_blunders: ErrorStats | None
    blunders: tuple[str, ...]
    predicted: PredictedSigma | None
    points: PointRows
    reason: str | None


class NoCrossValidation(Product):
    """A cross-validation that was asked for and is not possible."""

    count: Literal[0]
    reason: str


class AccuracySummary(_OptionalKeys):
    """Predicted σ over `cells` of the scene; `reason`: why there are none; `cautions`: limits of the prediction."""

    cells: int
    cell_m: float | None = None
    least_sigma_h_m: float | None = None
    median_sigma_h_m: float | None = None
    largest_sigma_h_m: float | None = None
    least_sigma_v_m: float | None = None
    median_sigma_v_m: float | None = None
    largest_sigma_v_m: float | None = None
    reason: str | None
    cautions: tuple[str, ...]


class FixResiduals(ResidualStats):
    """Residuals of the training cameras' fixes; `outliers` of them were left out."""

    outliers: int


class ControlResiduals(ResidualStats):
    """Residuals of the control points."""

    points: tuple[PointResidual, ...]


class Fit(Product):
    """Residuals of what entered the solution. Not an accuracy."""

    gnss: FixResiduals
    gcp: ControlResiduals


class SimilaritySigma(Product):
    """σ of the trained similarity: of ln(scale), and of the translation along east, north, up."""

    sigma_ln_scale: float
    sigma_translation_m: Vector3


class PointCoordinates(Product):
    """A check point in a CRS, as surveyed and as measured; None where it was not measured."""

    name: str
    surveyed: Vector3
    camera: Vector3 | None
    model: Vector3 | None


class Coordinates(Product):
    """The check points and the origin of `geo` in a CRS: easting or longitude first, height last."""

    crs: str
    units: tuple[str, str, str]
    heights: str
    operation: str
    operation_accuracy_m: float | None
    origin: Vector3
    points: tuple[PointCoordinates, ...]


class EvaluationReport(_OptionalKeys):
    """Product of `evaluate`. `cross_validation` is None and `coordinates` absent unless asked for."""

    format_version: Literal[1] = 1
    photometric: Photometric
    checkpoints: CheckPoints
    cross_validation: CrossValidation | NoCrossValidation | None
    accuracy: AccuracySummary
    fit: Fit
    similarity: SimilaritySigma
    coordinates: Coordinates | None = None


def write_report(report: EvaluationReport, path: Path) -> None:
    """Write a report as JSON."""
    path.write_text(dump_json(report.model_dump(mode="json")) + "\n", encoding="utf-8")


def read_report(path: Path) -> EvaluationReport:
    """Return the report at `path`.

    Raises:
        InputError: it cannot be read, or is not a report; names the field at fault.
    """
    try:
        return load_json(EvaluationReport, path)
    except InputError as error:
        if not isinstance(error.__cause__, ValueError):  # the file system refuses, not the content
            raise
        message = "not a report: make it again with `georef evaluate --force`"
        raise InputError(message, path=path, field=error.field) from error
