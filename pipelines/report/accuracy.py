"""Accuracy: CE90 and LE90 of the check points, predicted against measured σ, and the map of the predicted σ."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from pipelines.core.figures import CELLS, ERRORS, WAYS, Figure
from pipelines.core.stages import ACCURACY_MAP
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.report.page import Picture, picture_of_png, png_file
from pipelines.report.plots.charts import predicted_against_measured
from pipelines.survey.report import CheckPointErrors, EvaluationReport, PredictedPointError
from pipelines.survey.survey import SurveyedPoint

# Of a circular normal distribution in plan, and of a normal one in height, both without bias: 90 % lie within.
CE90_OF_AXIS_RMSE = 2.1460
LE90_OF_RMSE = 1.6449
_LEAST_FOR_QUANTILE = 10
_LEAST_FOR_CHART = 3
# Line of a table of errors: name, key in the report, form and unit.
FigureLine = tuple[str, str, str, str]
_CROSSED = ("count", "rmse_h_m", "rmse_v_m", "mean_u_m")
_SURVEYED = ("rmse_h_m", "rmse_v_m", "rmse_3d_m")


@dataclass(frozen=True)
class NinetyPercent:
    """Radii within which 90 % of the errors are expected, and within which 90 % of those measured are."""

    way: str
    ce90_m: float | None  # from the RMSE; None without check points
    le90_m: float | None  # likewise
    measured_h_m: float | None  # empirical 90 % quantile; None with fewer than ten points
    measured_v_m: float | None  # likewise
    count: int


@dataclass(frozen=True)
class AccuracyFacts:
    """Accuracy of an evaluated survey."""

    figures: tuple[FigureLine, ...]  # of the check points
    ninety: tuple[NinetyPercent, ...]  # CE90 and LE90, triangulated and on the rendered surface
    ways: dict[str, str]  # words of the ways that have measured points
    surface: bool  # the rendered surface may be one
    chart: Picture | None  # predicted against measured σ; None: fewer than three points have both
    # share of the points within 1 σ and 2 σ of the prediction, horizontal and vertical; empty likewise
    within: tuple[tuple[str, float, float], ...]
    map: Picture | None  # of the predicted σ; None: there is none
    crossed: bool  # control points were cross-validated
    crossed_reason: str  # why not; empty: they were not to be
    crossed_figures: tuple[FigureLine, ...]  # of the control points that were left out
    check_points: int
    # what is told of the map, by the beginning of its fields
    cells: Mapping[str, Figure] = field(default_factory=lambda: CELLS)
    ce90_factor: float = CE90_OF_AXIS_RMSE
    le90_factor: float = LE90_OF_RMSE
    quantile_points: int = _LEAST_FOR_QUANTILE  # fewest points with an empirical quantile


def accuracy_facts(
    workspace: Workspace, report: EvaluationReport, check_points: tuple[SurveyedPoint, ...]
) -> AccuracyFacts:
    """Return what the section on accuracy shows: errors beside predicted σ (metres), and their shares within σ."""
    by_way = report.checkpoints.by_way
    sigma, error = _compared(report.checkpoints.triangulated, check_points)
    enough = len(sigma) >= _LEAST_FOR_CHART
    within: list[tuple[str, float, float]] = []
    for name, ratio in zip(("horizontal", "vertical"), (error / np.maximum(sigma, 1e-12)).T, strict=True):
        if enough:
            within.append((name, float((ratio <= 1).mean()), float((ratio <= 2).mean())))
    crossed = report.cross_validation
    return AccuracyFacts(
        figures=(
            *_lines("", tuple(ERRORS)),
            *_lines("with_survey.", _SURVEYED, " with the points' own survey"),
            *_lines("without_blunders.", ("count", "rmse_h_m", "rmse_v_m"), " without blunders"),
        ),
        ninety=tuple(ninety_percent(way, errors) for way, errors in by_way.items()),
        ways={way: WAYS[way] for way, errors in by_way.items() if errors.count},
        chart=picture_of_png(predicted_against_measured(sigma, error)) if enough else None,
        within=tuple(within),
        map=png_file(workspace.root / ACCURACY_MAP),
        surface="surface" in by_way,
        crossed=crossed is not None and crossed.count > 0,
        crossed_reason="" if crossed is None or crossed.reason is None else crossed.reason,
        crossed_figures=_lines("cross_validation.", _CROSSED),
        check_points=len(check_points),
    )


def ninety_percent(way: str, errors: CheckPointErrors) -> NinetyPercent:
    """Return CE90 and LE90 of check points.

    CE90 = 2.1460 · (RMSE_E + RMSE_N) / 2 and LE90 = 1.6449 · RMSE_V, for normal errors without bias.
    """
    rows = [row.error_m for row in errors.points if row.error_m is not None]
    table = np.array(rows, dtype=np.float64).reshape(-1, 3)
    ce90 = le90 = measured_h = measured_v = None
    if len(table) >= _LEAST_FOR_QUANTILE:
        measured_h = float(np.quantile(np.hypot(table[:, 0], table[:, 1]), 0.9))
        measured_v = float(np.quantile(np.abs(table[:, 2]), 0.9))
    if errors.rmse_e_m is not None and errors.rmse_n_m is not None and errors.rmse_v_m is not None:
        ce90 = CE90_OF_AXIS_RMSE * (errors.rmse_e_m + errors.rmse_n_m) / 2
        le90 = LE90_OF_RMSE * errors.rmse_v_m
    return NinetyPercent(way, ce90, le90, measured_h, measured_v, errors.count)


def _lines(group: str, names: tuple[str, ...], ending: str = "") -> tuple[FigureLine, ...]:
    """Return the lines of a table of errors: all errors, or those of a group."""
    return tuple(
        (figure.meaning + ending, group + name, "metres" if figure.unit else "whole", figure.unit)
        for name in names
        for figure in (ERRORS[name],)
    )


def _compared(errors: CheckPointErrors, points: tuple[SurveyedPoint, ...]) -> tuple[FloatArray, FloatArray]:
    """Return predicted σ with the survey's (J, 2) and measured errors (J, 2), horizontal and vertical."""
    surveyed = {point.name: np.diag(np.array(point.cov_in_geo)) for point in points}
    sigma, error = [], []
    for row in errors.points:
        if not isinstance(row, PredictedPointError) or row.name not in surveyed:
            continue
        if row.sigma_m is None or row.error_m is None:
            continue
        variance, off = np.square(row.sigma_m) + surveyed[row.name], row.error_m
        sigma.append([np.sqrt(variance[0] + variance[1]), np.sqrt(variance[2])])
        error.append([np.hypot(off[0], off[1]), abs(off[2])])
    return np.array(sigma).reshape(-1, 2), np.array(error).reshape(-1, 2)
