"""Errors at check points, stated after the ASPRS Positional Accuracy Standards for Digital Geospatial Data.

Edition 2 (2023, doi 10.14358/PERS.89.10.581) demands:

1. The RMSE alone states the accuracy. The horizontal RMSE takes both axes together.
2. An accuracy class is named after the RMSE in centimetres that it allows.
3. The survey error of the check points is added to the measured error in quadrature.
4. There are at least 30 check points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import BoolArray, FloatArray
from pipelines.scene.report import AsprsStatement, ErrorStats, Rmse, TotalRmse

LEAST_POINTS = 30
BLUNDER_FACTOR = 3.0
# Ratio of RMSE to median of |error|: horizontal by a Rayleigh, vertical by a half-normal distribution.
_RMSE_OF_MEDIAN = np.array([1.2011, 1.4826])
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class Assessment:
    """Accuracy of a product at N check points.

    Attributes:
        stats: figures of all errors, blunders included.
        survey: RMSE of the check points' own survey (RMSE_H2, RMSE_V2 of the standard); None without points.
        with_survey: errors and survey in quadrature, the accuracy after the standard; None without points.
        asprs: classes that `with_survey` meets.
        blunder: (N,) mask of the errors beyond three times the class that the other points meet.
        without_blunders: figures of the other points; None without blunders.
    """

    stats: ErrorStats
    survey: Rmse | None
    with_survey: TotalRmse | None
    asprs: AsprsStatement
    blunder: BoolArray
    without_blunders: ErrorStats | None


def assess(error_in_geo: ArrayLike, cov_survey: ArrayLike) -> Assessment:
    """Return the accuracy after the standard, from the errors at check points.

    The errors count from the surveyed positions; the standard adds the error of these positions in the datum.

    Args:
        error_in_geo: (N, 3) metres.
        cov_survey: (N, 3, 3) m², of the surveyed positions.
    """
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    variance = np.diagonal(np.asarray(cov_survey, dtype=np.float64).reshape(-1, 3, 3), axis1=1, axis2=2)
    stats = error_stats(error)
    if len(error) == 0:
        return Assessment(stats, None, None, _statement(0, None), np.zeros(0, dtype=bool), None)
    total, blunder = _rmse(error**2 + variance), _blunders(error, variance)
    with_survey = TotalRmse(**total.model_dump(), rmse_3d_m=math.hypot(total.rmse_h_m, total.rmse_v_m))
    without_blunders = error_stats(error[~blunder]) if blunder.any() else None
    statement = _statement(len(error), with_survey)
    return Assessment(stats, _rmse(variance), with_survey, statement, blunder, without_blunders)


def error_stats(error_in_geo: ArrayLike) -> ErrorStats:
    """Return the figures of errors (N, 3), east, north, up in metres."""
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    if len(error) == 0:
        return ErrorStats(count=0, **dict.fromkeys(name for name in ErrorStats.model_fields if name != "count"))
    mean, square = error.mean(axis=0).tolist(), (error**2).mean(axis=0)
    horizontal, vertical = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    return ErrorStats(
        count=len(error),
        mean_e_m=mean[0],
        mean_n_m=mean[1],
        mean_u_m=mean[2],
        mean_h_m=float(horizontal.mean()),
        median_h_m=float(np.median(horizontal)),
        rmse_e_m=float(np.sqrt(square[0])),
        rmse_n_m=float(np.sqrt(square[1])),
        rmse_h_m=float(np.sqrt(square[0] + square[1])),
        rmse_v_m=float(np.sqrt(square[2])),
        rmse_3d_m=float(np.sqrt(square.sum())),
        max_h_m=float(horizontal.max()),
        max_v_m=float(vertical.max()),
        max_3d_m=float(np.sqrt((error**2).sum(axis=1).max())),
    )


def classes_cm(rmse: Rmse) -> tuple[int, int]:
    """Return the smallest class, horizontal and vertical, in whole centimetres; the standard allows any number."""
    horizontal, vertical = (max(math.ceil(100 * rmse_m - 1e-9), 1) for rmse_m in (rmse.rmse_h_m, rmse.rmse_v_m))
    return horizontal, vertical


def few_points(count: int) -> str:
    """Return the warning of fewer check points than the standard demands."""
    return f"{count} check points; ASPRS 2nd ed. asks for at least {LEAST_POINTS}: the class is indicative"


def _statement(count: int, tested: Rmse | None) -> AsprsStatement:
    """Return the classes that check points meet, with a sentence that names their number and the minimum."""
    enough = count >= LEAST_POINTS
    if tested is None:
        return AsprsStatement(
            horizontal_class=None,
            vertical_class=None,
            least_points=LEAST_POINTS,
            enough_points=enough,
            statement=None,
        )
    horizontal, vertical = (f"{class_cm} cm" for class_cm in classes_cm(tested))
    sample = f"tested on {count} check points: " if enough else f"{few_points(count)}. "
    return AsprsStatement(
        horizontal_class=horizontal,
        vertical_class=vertical,
        least_points=LEAST_POINTS,
        enough_points=enough,
        statement=f"{sample}RMSE_H {100 * tested.rmse_h_m:.1f} cm, RMSE_V {100 * tested.rmse_v_m:.1f} cm, "
        f"the check points' survey included: horizontal accuracy class {horizontal}, "
        f"vertical accuracy class {vertical} (ASPRS, 2nd ed.)",
    )


def _rmse(square: FloatArray) -> Rmse:
    """Return the RMSE of squared errors (N, 3) east, north and up."""
    east, north, up = square.mean(axis=0).tolist()
    return Rmse(rmse_h_m=math.sqrt(east + north), rmse_v_m=math.sqrt(up))


def _blunders(error: FloatArray, variance: FloatArray) -> BoolArray:
    """Return the mask (N,) of errors beyond three times the class of the other points, horizontally or vertically.

    1. The class of *all* points would hide a blunder among nine or fewer. The first class therefore follows from
       the medians, which tolerate blunders in up to half of the points.
    2. The class of the remaining points gives the next mask, until the mask stays the same.
    3. If the mask never stays the same, or if all points are blunders, the first mask counts.
    """
    size = np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])])
    horizontal, vertical = (np.median(size, axis=0) * _RMSE_OF_MEDIAN).tolist()
    survey = _rmse(variance)
    robust = Rmse(rmse_h_m=math.hypot(horizontal, survey.rmse_h_m), rmse_v_m=math.hypot(vertical, survey.rmse_v_m))
    first = blunder = _beyond(size, robust)
    for _ in range(_MOST_ROUNDS):
        if blunder.all():
            break
        previous, blunder = blunder, _beyond(size, _rmse((error**2 + variance)[~blunder]))
        if np.array_equal(previous, blunder):
            return blunder
    return first


def _beyond(size: FloatArray, others: Rmse) -> BoolArray:
    """Return the mask (N,) of errors (N, 2), horizontal and vertical, beyond three times the class of `others`."""
    allowed_m = BLUNDER_FACTOR * np.array(classes_cm(others)) / 100
    return np.asarray((size > allowed_m).any(axis=1))
