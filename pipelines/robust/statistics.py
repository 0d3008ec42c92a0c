"""Statistics of residuals: robust scale, consistency, and the figures that reports print."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.products import Product
from pipelines.core.types import FloatArray

_NORMAL_MAD = 1.4826  # σ / MAD of a normal distribution
_RAYLEIGH_MEDIAN = 1.1774  # of the length of a residual, of σ = 1 in either coordinate
_WEISZFELD_STEPS = 50
_WEISZFELD_NEAR = 1e-6  # a point that is met weighs no more than this distance


def chi2_quantile(probability: float, degrees: ArrayLike) -> FloatArray:
    """Quantile of χ² with `degrees` (…) of freedom; 0 where there are none."""
    from scipy.stats import chi2  # takes a second to load, which the types below need not cost

    dof = np.asarray(degrees)
    distinct, place = np.unique(dof, return_inverse=True)
    values = np.where(distinct > 0, chi2.ppf(probability, np.maximum(distinct, 1)), 0.0)
    return np.asarray(values[place].reshape(dof.shape), dtype=np.float64)


@cache
def outlier_gate(dimension: int) -> float:
    """Return the χ² beyond which a residual of a dimension is an outlier: plain noise is within in 99.9 %."""
    return float(chi2_quantile(0.999, dimension))


@cache
def median_chi2(dimension: int) -> float:
    """Return the median of χ²: what half of the squared residuals of plain noise stay below."""
    return float(chi2_quantile(0.5, dimension))


def mad_sigma(values: ArrayLike) -> float:
    """σ of values (N,) from the median absolute deviation: half of them may be outliers."""
    array = np.asarray(values, dtype=np.float64)
    return float(_NORMAL_MAD * np.median(np.abs(array - np.median(array))))


def rayleigh_sigma(lengths: ArrayLike) -> float:
    """σ of either coordinate of residuals of lengths (N,), from their median. NaN is left out."""
    return float(np.nanmedian(np.asarray(lengths, dtype=np.float64))) / _RAYLEIGH_MEDIAN


def spatial_median(points: ArrayLike) -> FloatArray:
    """The place (3,) with the least sum of distances to points (N, 3), N ≥ 1, by Weiszfeld's iteration.

    Half of the points may be anywhere; and unlike the median of each coordinate it does not depend on the axes.
    """
    array = np.asarray(points, dtype=np.float64)
    place = np.median(array, axis=0)
    for _ in range(_WEISZFELD_STEPS):
        weight = 1.0 / np.maximum(np.linalg.norm(array - place, axis=1), _WEISZFELD_NEAR)
        place = weight @ array / weight.sum()
    return np.asarray(place)


def squared_mahalanobis(residuals: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """rᵀ Σ⁻¹ r (N,) of residuals (N, d) with covariances (N, d, d) or (d, d)."""
    r = np.asarray(residuals, dtype=np.float64)
    solved = np.linalg.solve(np.asarray(covariances, dtype=np.float64), r[..., None])[..., 0]
    return np.asarray((r * solved).sum(axis=-1))


def residual_stats(residuals_in_geo: ArrayLike) -> ResidualStats:
    """Figures of residuals (N, 3), East-North-Up in metres; null where N is 0."""
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
    """Residuals of a fit in metres. Not an accuracy."""

    count: int
    mean_h_m: float | None
    rmse_e_m: float | None
    rmse_n_m: float | None
    rmse_h_m: float | None
    rmse_v_m: float | None
    rmse_3d_m: float | None
    max_3d_m: float | None
