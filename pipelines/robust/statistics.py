"""Statistics of residuals: robust scale, consistency, and the figures of reports."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.products import Product
from pipelines.core.types import FloatArray

_NORMAL_MAD = 1.4826  # σ / MAD of a normal distribution
_RAYLEIGH_MEDIAN = 1.1774  # median length of a residual with σ = 1 in either coordinate
_WEISZFELD_STEPS = 50
_WEISZFELD_NEAR = 1e-6  # lower limit of a distance, so that a point at the median keeps a finite weight


def chi2_quantile(probability: float, degrees: ArrayLike) -> FloatArray:
    """Return the quantile of χ² with `degrees` (…) of freedom; 0 for zero degrees."""
    from scipy.stats import chi2  # loads for a second, which an import of the types below must not cost

    dof = np.asarray(degrees)
    distinct, place = np.unique(dof, return_inverse=True)
    values = np.where(distinct > 0, chi2.ppf(probability, np.maximum(distinct, 1)), 0.0)
    return np.asarray(values[place].reshape(dof.shape), dtype=np.float64)


def chi2_probability_above(value: float, degrees: float) -> float:
    """Return the probability that χ² with `degrees` of freedom, a real number, exceeds `value`."""
    from scipy.stats import chi2

    return float(chi2.sf(value, degrees))


@cache
def outlier_gate(dimension: int) -> float:
    """Return the χ² beyond which a residual of a dimension is an outlier: 99.9 % of plain noise stays below."""
    return float(chi2_quantile(0.999, dimension))


@cache
def median_chi2(dimension: int) -> float:
    """Return the median of χ² for residuals of a dimension: half of plain noise stays below."""
    return float(chi2_quantile(0.5, dimension))


def mad_sigma(values: ArrayLike) -> float:
    """Return the σ of values (N,) from their median absolute deviation; up to half may be outliers."""
    array = np.asarray(values, dtype=np.float64)
    return float(_NORMAL_MAD * np.median(np.abs(array - np.median(array))))


def rayleigh_sigma(lengths: ArrayLike) -> float:
    """Return the σ of either coordinate of planar residuals, from the median of their lengths (N,) without NaN."""
    return float(np.nanmedian(np.asarray(lengths, dtype=np.float64))) / _RAYLEIGH_MEDIAN


def spatial_median(points: ArrayLike) -> FloatArray:
    """Return the point (3,) with the least sum of distances to points (N, 3), N ≥ 1, by Weiszfeld's iteration.

    Up to half of the points may be outliers. The result does not depend on the axes, unlike the median of each
    coordinate.
    """
    array = np.asarray(points, dtype=np.float64)
    place = np.median(array, axis=0)
    for _ in range(_WEISZFELD_STEPS):
        weight = 1.0 / np.maximum(np.linalg.norm(array - place, axis=1), _WEISZFELD_NEAR)
        place = weight @ array / weight.sum()
    return np.asarray(place)


def squared_mahalanobis(residuals: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """Return rᵀ Σ⁻¹ r (N,) of residuals (N, d) with covariances (N, d, d) or (d, d)."""
    r = np.asarray(residuals, dtype=np.float64)
    solved = np.linalg.solve(np.asarray(covariances, dtype=np.float64), r[..., None])[..., 0]
    return np.asarray((r * solved).sum(axis=-1))


def typical_sigma(covariances: ArrayLike) -> float:
    """Return the typical σ per axis of covariances (N, 3, 3)."""
    return float(np.sqrt(np.median(np.trace(np.asarray(covariances), axis1=1, axis2=2)) / 3))


def residual_stats(residuals_in_geo: ArrayLike) -> ResidualStats:
    """Return the figures of residuals (N, 3), East-North-Up in metres; all but the count are None if N is 0."""
    r = np.asarray(residuals_in_geo, dtype=np.float64).reshape(-1, 3)
    if len(r) == 0:
        empty = dict.fromkeys(name for name in ResidualStats.model_fields if name != "count")
        return ResidualStats(count=0, **empty)
    mean_square = (r**2).mean(axis=0)
    horizontal = np.hypot(r[:, 0], r[:, 1])
    return ResidualStats(
        count=len(r),
        mean_h_m=float(horizontal.mean()),
        rmse_e_m=float(np.sqrt(mean_square[0])),
        rmse_n_m=float(np.sqrt(mean_square[1])),
        rmse_h_m=float(np.sqrt(mean_square[0] + mean_square[1])),
        rmse_v_m=float(np.sqrt(mean_square[2])),
        rmse_3d_m=float(np.sqrt(mean_square.sum())),
        max_3d_m=float(np.sqrt((r**2).sum(axis=1).max())),
    )


class ResidualStats(Product):
    """Figures of the residuals of a fit, in metres. These are no accuracy."""

    count: int
    mean_h_m: float | None
    rmse_e_m: float | None
    rmse_n_m: float | None
    rmse_h_m: float | None
    rmse_v_m: float | None
    rmse_3d_m: float | None
    max_3d_m: float | None
