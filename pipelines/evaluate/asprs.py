"""Errors at check points, stated after the ASPRS Positional Accuracy Standards for Digital Geospatial Data.

Edition 2, Version 2 (ASPRS, 2024) demands:

1. The RMSE alone states the accuracy. The horizontal RMSE takes both axes together; the three-dimensional one is
   RMSE_3D = √(RMSE_H² + RMSE_V²).
2. An accuracy class is named after the RMSE in centimetres that it allows.
3. The survey error of the check points is added to the measured error in quadrature.
4. The vertical accuracy is that of points outside vegetation (NVA), and classes are theirs. The accuracy under
   vegetation (VVA) is stated beside it, without a class.
5. There are at least 30 check points, and more for a project beyond 1000 km².
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.figures import ToleranceTest, length_text
from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.statistics import residual_stats
from pipelines.survey.report import AsprsStatement, ErrorStats, Rmse, TotalRmse, VegetatedAccuracy

STANDARD = "ASPRS, Edition 2, Version 2, 2024"
# Check points by the area of the project: so many up to the first area, ten more for each further one, and no more
# than the most.
_LEAST_POINTS, _MORE_POINTS, _MOST_POINTS, _AREA_KM2 = 30, 10, 120, 1000.0
BLUNDER_FACTOR = 3.0
# Ratio of RMSE to median of |error|: horizontal by a Rayleigh, vertical by a half-normal distribution.
_RMSE_OF_MEDIAN = np.array([1.2011, 1.4826])
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class Assessment:
    """Accuracy of a product at N check points."""

    stats: ErrorStats  # figures of all errors, blunders and points under vegetation included
    # RMSE of the check points' own survey (RMSE_H2, RMSE_V2 of the standard); None without points
    survey: Rmse | None
    # Errors and survey in quadrature, the accuracy after the standard; both are of the points outside vegetation
    with_survey: TotalRmse | None
    asprs: AsprsStatement  # classes that `with_survey` meets, and the accuracy under vegetation
    # (N,) mask of the errors beyond three times the class that the other points meet, of which none is under
    # vegetation, and of those that their prediction accuses
    blunder: BoolArray
    without_blunders: ErrorStats | None  # figures of the other points; None without blunders
    # As `with_survey`, without the accused points; None: none is accused, or all are
    with_survey_without_refuted: TotalRmse | None = None


def assess(
    error_in_geo: ArrayLike,
    cov_survey: ArrayLike,
    vegetated: ArrayLike | None = None,
    area_km2: float | None = None,
    *,
    accused: ArrayLike | None = None,
) -> Assessment:
    """Return the accuracy after the standard, from the errors at check points.

    The errors count from the surveyed positions; the standard adds the error of these positions in the datum.

    Args:
        error_in_geo: (N, 3) metres.
        cov_survey: (N, 3, 3) m², of the surveyed positions.
        vegetated: (N,) mask of the points under vegetation; None: none is.
        area_km2: of the project; None: not known, and taken for a small one.
        accused: (N,) mask of the points that count as blunders whatever the class of the others; None: none does.
    """
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    variance = np.diagonal(np.asarray(cov_survey, dtype=np.float64).reshape(-1, 3, 3), axis1=1, axis2=2)
    covered = np.zeros(len(error), dtype=bool) if vegetated is None else np.asarray(vegetated, dtype=bool)
    square, stats = error**2 + variance, error_stats(error)
    under = None
    if covered.any():
        under = VegetatedAccuracy(count=int(covered.sum()), rmse_v_m=_rmse(square[covered]).rmse_v_m)
    blunder = np.zeros(len(error), dtype=bool)
    survey, with_survey, of_others = None, None, None
    if not covered.all():
        survey, total = _rmse(variance[~covered]), _rmse(square[~covered])
        with_survey = _total(total)
        blunder[~covered] = _blunders(error[~covered], variance[~covered])
    blunder |= False if accused is None else np.asarray(accused, dtype=bool)
    if accused is not None and np.any(accused) and (others := ~covered & ~np.asarray(accused, dtype=bool)).any():
        of_others = _total(_rmse(square[others]))
    statement = _statement(int((~covered).sum()), with_survey, under, area_km2)
    without_blunders = error_stats(error[~blunder]) if blunder.any() else None
    return Assessment(stats, survey, with_survey, statement, blunder, without_blunders, of_others)


def error_stats(error_in_geo: ArrayLike) -> ErrorStats:
    """Return the figures of errors (N, 3), east, north, up in metres."""
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    if len(error) == 0:
        return ErrorStats(count=0, **dict.fromkeys(name for name in ErrorStats.model_fields if name != "count"))
    (east, north, up), size = error.mean(axis=0).tolist(), np.abs(error)
    horizontal = np.hypot(error[:, 0], error[:, 1])
    return ErrorStats(
        **residual_stats(error).model_dump(),
        mean_e_m=east,
        mean_n_m=north,
        mean_u_m=up,
        median_h_m=float(np.median(horizontal)),
        max_h_m=float(horizontal.max()),
        max_v_m=float(size[:, 2].max()),
    )


def classes_cm(*rmse_m: float) -> list[int]:
    """Return the smallest class of each RMSE in whole centimetres; the standard allows any number."""
    return [max(math.ceil(100 * value - 1e-9), 1) for value in rmse_m]


def _class_text(class_cm: int) -> str:
    return f"{class_cm} cm" if class_cm < 100 else f"{class_cm / 100:.2f} m"


def least_points(area_km2: float | None) -> int:
    """Return the number of check points that the standard demands for a project of an area in km²."""
    further = math.ceil((area_km2 or 0.0) / _AREA_KM2) - 1
    return min(_LEAST_POINTS + _MORE_POINTS * max(further, 0), _MOST_POINTS)


def tolerance_test(
    of: str, tolerance_m: float, rmse_m: float | None, check_points: int, area_km2: float | None
) -> ToleranceTest:
    """Return whether an RMSE at check points passes a required one: at most so large, at enough points."""
    least = least_points(area_km2)
    verdict: Literal["pass", "fail", "met", "untested"] = "untested"
    if rmse_m is not None:
        verdict = "fail" if rmse_m > tolerance_m else "pass" if check_points >= least else "met"
    return ToleranceTest(
        of=of,
        tolerance_m=tolerance_m,
        rmse_m=rmse_m,
        check_points=check_points,
        least_points=least,
        verdict=verdict,
    )


def few_points(asprs: AsprsStatement) -> str:
    """Return the warning of fewer check points than the standard demands."""
    return (
        f"{asprs.points} check points are fewer than the {asprs.least_points} that the standard ({STANDARD}) "
        "demands; the class is indicative."
    )


def _statement(
    count: int, tested: TotalRmse | None, vegetated: VegetatedAccuracy | None, area_km2: float | None
) -> AsprsStatement:
    """Return the classes that `count` check points outside vegetation meet, and a sentence with their number."""
    least, under = least_points(area_km2), ""
    if vegetated is not None:
        under = f"RMSE_V {length_text(vegetated.rmse_v_m)} at {vegetated.count} points under vegetation (VVA)"
    asprs = AsprsStatement(
        points=count,
        horizontal_class=None,
        vertical_class=None,
        class_3d=None,
        vegetated=vegetated,
        area_km2=area_km2,
        least_points=least,
        enough_points=count >= least,
        statement=under or None,
    )
    if tested is None:
        return asprs
    classes_of = classes_cm(tested.rmse_h_m, tested.rmse_v_m, tested.rmse_3d_m)
    horizontal, vertical, class_3d = (_class_text(class_cm) for class_cm in classes_of)
    sample = f"tested on {count} check points: " if asprs.enough_points else f"{few_points(asprs)} "
    classes = {"horizontal_class": horizontal, "vertical_class": vertical, "class_3d": class_3d}
    statement = (
        f"{sample}RMSE_H {length_text(tested.rmse_h_m)}, RMSE_V {length_text(tested.rmse_v_m)} outside vegetation "
        f"(NVA), RMSE_3D {length_text(tested.rmse_3d_m)}, the check points' survey included: horizontal accuracy "
        f"class {horizontal}, vertical accuracy class {vertical}, three-dimensional accuracy class {class_3d} "
        f"({STANDARD})" + (under and f"; {under}, without a class")
    )
    return asprs.model_copy(update={**classes, "statement": statement})


def _total(rmse: Rmse) -> TotalRmse:
    return TotalRmse(**rmse.model_dump(), rmse_3d_m=math.hypot(rmse.rmse_h_m, rmse.rmse_v_m))


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
    allowed_m = BLUNDER_FACTOR * np.array(classes_cm(others.rmse_h_m, others.rmse_v_m)) / 100
    return np.asarray((size > allowed_m).any(axis=1))
