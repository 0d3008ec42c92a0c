"""Errors at check points, stated after the ASPRS Positional Accuracy Standards for Digital Geospatial Data.

Edition 2 (2023, doi 10.14358/PERS.89.10.581) measures by RMSE alone, horizontally in both axes together, names an
accuracy class after the RMSE in centimetres that it allows, adds the check points' own survey error to the
measured one in quadrature, and asks for at least 30 check points.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import BoolArray, FloatArray

LEAST_POINTS = 30
BLUNDER_FACTOR = 3.0
# RMSE over median of |error|, horizontal and vertical: of a Rayleigh and of a half normal distribution.
_RMSE_OF_MEDIAN = np.array([1.2011, 1.4826])
_MOST_ROUNDS = 20


@dataclass(frozen=True)
class ErrorStats:
    """Figures of errors (measured in the model minus surveyed) in metres; None where there are none.

    `mean_e_m`, `mean_n_m`, `mean_u_m` are signed (the bias), all others are lengths.
    """

    count: int
    mean_e_m: float | None = None
    mean_n_m: float | None = None
    mean_u_m: float | None = None
    mean_h_m: float | None = None
    median_h_m: float | None = None
    rmse_e_m: float | None = None
    rmse_n_m: float | None = None
    rmse_h_m: float | None = None
    rmse_v_m: float | None = None
    rmse_3d_m: float | None = None
    max_h_m: float | None = None
    max_v_m: float | None = None
    max_3d_m: float | None = None


@dataclass(frozen=True)
class Rmse:
    """Horizontal (east and north together) and vertical root mean square in metres."""

    rmse_h_m: float
    rmse_v_m: float

    @property
    def rmse_3d_m(self) -> float:
        """Both together."""
        return math.hypot(self.rmse_h_m, self.rmse_v_m)

    @property
    def classes_cm(self) -> tuple[int, int]:
        """The smallest horizontal and vertical class in whole centimetres; the standard allows any number."""
        return _class_cm(self.rmse_h_m), _class_cm(self.rmse_v_m)


@dataclass(frozen=True)
class Assessment:
    """What N check points say of a product.

    Attributes:
        stats: of the errors as they are, blunders included.
        survey: of the check points' own survey (RMSE_H2, RMSE_V2 of the standard); None without points.
        with_survey: errors and survey in quadrature: the accuracy that the standard states.
        blunder: (N,) errors beyond three times the class that the other points meet.
        without_blunders: figures of the others.
    """

    stats: ErrorStats
    survey: Rmse | None
    with_survey: Rmse | None
    blunder: BoolArray
    without_blunders: ErrorStats

    @property
    def statement(self) -> str | None:
        """The result in a sentence, with the count against the minimum; None without check points."""
        tested = self.with_survey
        if tested is None:
            return None
        count, (horizontal, vertical) = self.stats.count, tested.classes_cm
        on = f"tested on {count} check points: " if count >= LEAST_POINTS else f"{few_points(count)}. "
        return (
            f"{on}RMSE_H {100 * tested.rmse_h_m:.1f} cm, "
            f"RMSE_V {100 * tested.rmse_v_m:.1f} cm, the check points' survey included: horizontal accuracy class "
            f"{horizontal} cm, vertical accuracy class {vertical} cm (ASPRS, 2nd ed.)"
        )

    def document(self) -> dict[str, Any]:
        """As plain values; docs/formats.md has their meaning."""
        tested = self.with_survey
        horizontal, vertical = (None, None) if tested is None else tested.classes_cm
        return {
            **asdict(self.stats),
            "survey": None if self.survey is None else asdict(self.survey),
            "with_survey": None if tested is None else {**asdict(tested), "rmse_3d_m": tested.rmse_3d_m},
            "asprs": {
                "horizontal_class": None if horizontal is None else f"{horizontal} cm",
                "vertical_class": None if vertical is None else f"{vertical} cm",
                "least_points": LEAST_POINTS,
                "enough_points": self.stats.count >= LEAST_POINTS,
                "statement": self.statement,
            },
            "without_blunders": asdict(self.without_blunders) if self.blunder.any() else None,
        }


def few_points(count: int) -> str:
    """What to say of fewer check points than the standard asks for."""
    return f"{count} check points; ASPRS 2nd ed. asks for at least {LEAST_POINTS}: the class is indicative"


def _class_cm(rmse_m: float) -> int:
    return max(math.ceil(100 * rmse_m - 1e-9), 1)


def error_stats(error_in_geo: ArrayLike) -> ErrorStats:
    """Figures of errors (N, 3), east, north, up in metres."""
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    if len(error) == 0:
        return ErrorStats(0)
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


def assess(error_in_geo: ArrayLike, cov_survey: ArrayLike) -> Assessment:
    """Assess errors (N, 3) at check points that were surveyed with covariances (N, 3, 3), both in metres.

    The errors are distances from the surveyed positions; the standard adds how far these may be from the datum.
    """
    error = np.asarray(error_in_geo, dtype=np.float64).reshape(-1, 3)
    variance = np.diagonal(np.asarray(cov_survey, dtype=np.float64).reshape(-1, 3, 3), axis1=1, axis2=2)
    if len(error) == 0:
        return Assessment(ErrorStats(0), None, None, np.zeros(0, dtype=bool), ErrorStats(0))
    blunder = _blunders(error, variance)
    return Assessment(
        error_stats(error), _rmse(variance), _rmse(error**2 + variance), blunder, error_stats(error[~blunder])
    )


def _rmse(square: FloatArray) -> Rmse:
    """Of squares (N, 3), east, north and up."""
    east, north, up = square.mean(axis=0).tolist()
    return Rmse(math.sqrt(east + north), math.sqrt(up))


def _blunders(error: FloatArray, variance: FloatArray) -> BoolArray:
    """Which errors (N,) exceed three times the class that the others meet, horizontally or vertically.

    Against the class of *all* points a blunder among nine or fewer would hide itself. The first class is of the
    medians, which half of the points may spoil.
    """
    size = np.column_stack([np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])])
    horizontal, vertical = (np.median(size, axis=0) * _RMSE_OF_MEDIAN).tolist()
    own = _rmse(variance)
    start = Rmse(math.hypot(horizontal, own.rmse_h_m), math.hypot(vertical, own.rmse_v_m))
    first = found = _beyond(size, start)
    for _ in range(_MOST_ROUNDS):
        if found.all():
            break
        before, found = found, _beyond(size, _rmse((error**2 + variance)[~found]))
        if np.array_equal(before, found):
            return found
    return first


def _beyond(size: FloatArray, others: Rmse) -> BoolArray:
    allowed_m = BLUNDER_FACTOR * np.array(others.classes_cm) / 100
    return np.asarray((size > allowed_m).any(axis=1))
