"""What is reported of surveyed points: errors, accuracy after ASPRS, and what was predicted of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.core.types import FloatArray, IntArray
from pipelines.evaluate.asprs import assess
from pipelines.evaluate.points import Sights
from pipelines.scene.survey import SurveyedPoint


def point_report(
    error_in_geo: FloatArray,
    points: tuple[SurveyedPoint, ...],
    *,
    rays: IntArray,
    predicted: FloatArray | None = None,
    bound: FloatArray | None = None,
) -> dict[str, Any]:
    """Statistics and rows of errors (J, 3), measured minus surveyed in metres, NaN for what was not measured.

    Args:
        points: J surveyed points.
        rays: (J,) marks in registered images.
        predicted: (J, 3, 3) m², expected of the measured positions; None where it is not known.
        bound: (J, 3, 3) m², the least that is possible.
    """
    error = error_in_geo.reshape(-1, 3)
    measured = np.isfinite(error).all(axis=1)
    survey = np.array([point.cov_in_geo for point in points]).reshape(-1, 3, 3)
    found = assess(error[measured], survey[measured])
    blunder = np.zeros(len(points), dtype=bool)
    blunder[measured] = found.blunder
    rows = point_rows(error, points, rays)
    for row, bad in zip(rows, blunder.tolist(), strict=True):
        row["blunder"] = bad
    if predicted is not None:
        sigma = np.sqrt(np.diagonal(predicted, axis1=1, axis2=2))
        for row, axes in zip(rows, sigma, strict=True):
            row.update(_axes(("sigma_e_m", "sigma_n_m", "sigma_u_m"), axes))
    return {
        **found.document(),
        "blunders": [point.name for point, bad in zip(points, blunder, strict=True) if bad],
        "predicted": None if predicted is None else _predicted(error, predicted, survey),
        "cramer_rao": None if bound is None else _rms(bound),
        "points": rows,
    }


def point_rows(error_in_geo: FloatArray, points: tuple[SurveyedPoint, ...], rays: IntArray) -> list[dict[str, Any]]:
    """A row for each point: name, marks, error (3,) in metres or null."""
    return [
        {"name": point.name, "rays": int(count), **_axes(("de_m", "dn_m", "du_m"), error)}
        for point, count, error in zip(points, rays, error_in_geo, strict=True)
    ]


def ray_counts(seen: Sights, count: int) -> IntArray:
    """Marks (J,) of each of `count` points."""
    return np.bincount(seen.point, minlength=count).astype(np.int64)


def _axes(names: tuple[str, str, str], values: FloatArray) -> dict[str, float | None]:
    known = bool(np.isfinite(values).all())
    return {name: float(value) if known else None for name, value in zip(names, values, strict=True)}


def _rms(cov: FloatArray) -> dict[str, Any]:
    """Root mean square of the standard deviations of points (J, 3, 3), as far as they are known."""
    known = cov[np.isfinite(cov).all(axis=(1, 2))]
    if not len(known):
        return {"count": 0, "rms_h_m": None, "rms_v_m": None}
    east, north, up = np.diagonal(known, axis1=1, axis2=2).mean(axis=0).tolist()
    return {"count": len(known), "rms_h_m": float(np.sqrt(east + north)), "rms_v_m": float(np.sqrt(up))}


def _predicted(error: FloatArray, predicted: FloatArray, survey: FloatArray) -> dict[str, Any]:
    """What was predicted, and errors squared over their variances (survey included): 1 on the average if true."""
    variance = np.diagonal(predicted + survey, axis1=1, axis2=2)
    known = np.isfinite(error).all(axis=1) & np.isfinite(variance).all(axis=1)
    normalised: dict[str, float | None] = dict.fromkeys("enu")
    if known.any():
        normalised = dict(zip("enu", (error[known] ** 2 / variance[known]).mean(axis=0).tolist(), strict=True))
    return {**_rms(predicted[known]), "normalised_error_squared": normalised}
