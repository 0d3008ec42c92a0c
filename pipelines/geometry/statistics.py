"""Statistics of residuals, robust kernels, and RANSAC with a truncated loss (MSAC, doi 10.1006/cviu.1999.0832).

Also patterns of differences between positions: one shift, two shifts, blunders among good ones, or noise.

The argument of a kernel is r² (any shape), the squared length of a residual in units of its σ. A weight ρ'(r²) in
(0, 1] is the derivative of its loss ρ, which is r² for small residuals. Tuning constants by dimension:

- Huber in one dimension: 95 % efficiency for Gaussian errors (Huber 1964, doi 10.1214/aoms/1177703732).
- Cauchy in two dimensions (image residuals): 95 % efficiency of one coordinate (Holland and Welsch 1977,
  doi 10.1080/03610927708827533), as in COLMAP's adjustments.
- Cauchy in one and in three dimensions (distances, positions, attitudes): the 95 % quantile of χ², COLMAP's scale
  for position priors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.products import Product
from pipelines.core.types import BoolArray, FloatArray, IntArray

HUBER_95 = 1.345
CAUCHY_95 = 2.385
# Cauchy's c² by the dimension of the residual.
CAUCHY_SCALE2 = {1: 3.841, 2: CAUCHY_95**2, 3: 7.815}
# E[w χ²] under Gaussian noise of the stated σ, with Cauchy's weight w = 1 / (1 + χ²/c²).
MEAN_WEIGHTED_CHI2 = {1: 0.6208, 2: 1.2604, 3: 1.9279}
# Cauchy's weight also lowers plain noise. Weights divided by this factor give the covariance that the estimator has
# under Gaussian noise of the stated σ: E[w] E[w² χ²/d] / E[∂(w r)/∂r]² for χ² with d degrees of freedom.
NOISE_WEIGHT = {1: 0.9087, 2: 0.8265, 3: 0.7886}


def huber_weight(squared: ArrayLike, scale: float = HUBER_95) -> FloatArray:
    """Return Huber's weight: 1 up to `scale` σ, where the loss is r²; then scale / r, where the loss is linear."""
    r2 = np.asarray(squared, dtype=np.float64)
    return scale / np.sqrt(np.maximum(r2, scale**2))


def cauchy_weight(squared: ArrayLike, dimension: int) -> FloatArray:
    """Return Cauchy's weight 1 / (1 + r²/c²); it redescends: the start must be near the solution."""
    return 1.0 / (1.0 + np.asarray(squared, dtype=np.float64) / CAUCHY_SCALE2[dimension])


def cauchy_loss(squared: ArrayLike, dimension: int) -> FloatArray:
    """Return Cauchy's loss c² ln(1 + r²/c²)."""
    scale2 = CAUCHY_SCALE2[dimension]
    return np.asarray(scale2 * np.log1p(np.asarray(squared, dtype=np.float64) / scale2))


NORMAL_MAD = 1.4826  # σ / MAD of a normal distribution
_RAYLEIGH_MEDIAN = 1.1774  # median length of a residual with σ = 1 in either coordinate
_WEISZFELD_STEPS = 50
_WEISZFELD_NEAR = 1e-6  # lower limit of a distance, so that a point at the median keeps a finite weight


def chi2_quantile(probability: float, degrees: ArrayLike) -> FloatArray:
    """Return the quantile of χ² with `degrees` (…) of freedom; 0 for zero degrees."""
    # scipy.stats, which says the same by name, takes a second to load; nor must an import of the types below wait.
    from scipy.special import gammaincinv

    dof = np.asarray(degrees)
    distinct, index = np.unique(dof, return_inverse=True)
    values = np.where(distinct > 0, 2.0 * gammaincinv(np.maximum(distinct, 1) / 2.0, probability), 0.0)
    return np.asarray(values[index].reshape(dof.shape), dtype=np.float64)


def chi2_probability_above(value: float, degrees: float) -> float:
    """Return the probability that χ² with `degrees` of freedom, a real number, exceeds `value`."""
    from scipy.special import chdtrc

    return float(chdtrc(degrees, value))


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
    return float(NORMAL_MAD * np.median(np.abs(array - np.median(array))))


def rayleigh_sigma(lengths: ArrayLike) -> float:
    """Return the σ of either coordinate of planar residuals, from the median of their lengths (N,) without NaN."""
    return float(np.nanmedian(np.asarray(lengths, dtype=np.float64))) / _RAYLEIGH_MEDIAN


def spatial_median(points: ArrayLike) -> FloatArray:
    """Return the point (3,) with the least sum of distances to points (N, 3), N ≥ 1, by Weiszfeld's iteration.

    Up to half of the points may be outliers. The result does not depend on the axes, unlike the median of each
    coordinate.
    """
    array = np.asarray(points, dtype=np.float64)
    median = np.median(array, axis=0)
    for _ in range(_WEISZFELD_STEPS):
        weight = 1.0 / np.maximum(np.linalg.norm(array - median, axis=1), _WEISZFELD_NEAR)
        median = weight @ array / weight.sum()
    return np.asarray(median)


def squared_mahalanobis(residuals: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """Return rᵀ Σ⁻¹ r (N,) of residuals (N, d) with covariances (N, d, d) or (d, d)."""
    r = np.asarray(residuals, dtype=np.float64)
    solved = np.linalg.solve(np.asarray(covariances, dtype=np.float64), r[..., None])[..., 0]
    return np.asarray((r * solved).sum(axis=-1))


def covariance_root(covariances: ArrayLike) -> FloatArray:
    """Return L (…, d, d) with L Lᵀ = Σ, lower triangles, of covariances Σ (…, d, d)."""
    return np.asarray(np.linalg.cholesky(np.asarray(covariances, dtype=np.float64)))


def root_information(covariances: ArrayLike) -> FloatArray:
    """Return W (…, d, d) with WᵀW = Σ⁻¹, which whitens residuals of covariances Σ (…, d, d)."""
    return np.asarray(np.linalg.inv(covariance_root(covariances)))


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
    """Figures of the residuals of a fit, in metres; they do not measure accuracy."""

    count: int
    mean_h_m: float | None
    rmse_e_m: float | None
    rmse_n_m: float | None
    rmse_h_m: float | None
    rmse_v_m: float | None
    rmse_3d_m: float | None
    max_3d_m: float | None


ModelT = TypeVar("ModelT")


@dataclass(frozen=True)
class RansacOptions:
    sample_size: int  # observations that determine a model
    gate: float  # largest squared whitened residual of an inlier
    max_draws: int = 500
    confidence: float = 0.9999  # probability of at least one draw without outliers


@dataclass(frozen=True)
class RansacResult(Generic[ModelT]):
    """Best model, its inliers (N,) and its truncated cost."""

    model: ModelT
    inlier: BoolArray
    cost: float


def ransac(
    count: int,
    fit: Callable[[IntArray], ModelT],
    squared_residuals: Callable[[ModelT], FloatArray],
    options: RansacOptions,
    rng: np.random.Generator,
) -> RansacResult[ModelT]:
    """Return the model with the smallest truncated cost over `count` observations.

    Args:
        fit: makes a model from the chosen indices; may raise `DegenerateGeometryError`.
        squared_residuals: whitened squared residuals (count,) of a model.

    Raises:
        DegenerateGeometryError: too few observations, or no draw gave a model.
    """
    if count < options.sample_size:
        raise DegenerateGeometryError(
            "too-few-observations", f"{options.sample_size} observations are needed, there are {count}."
        )
    best: RansacResult[ModelT] | None = None
    needed = float(options.max_draws)
    draws = 0
    while draws < min(needed, options.max_draws):
        draws += 1
        try:
            model = fit(rng.choice(count, options.sample_size, replace=False))
        except DegenerateGeometryError:
            continue
        squared = squared_residuals(model)
        cost = float(np.minimum(squared, options.gate).sum())
        if best is None or cost < best.cost:
            best = RansacResult(model, squared <= options.gate, cost)
            needed = draws_needed(float(best.inlier.mean()), options)
    if best is None:
        raise DegenerateGeometryError("no-model-found", f"None of {draws} random samples determines a model.")
    return best


def draws_needed(inlier_share: float, options: RansacOptions) -> float:
    """Return the number of draws that contain one without outliers at the required confidence."""
    clean = inlier_share**options.sample_size
    if clean >= 1.0:
        return 1.0
    if clean <= 0.0:
        return math.inf
    return math.log(1.0 - options.confidence) / math.log1p(-clean)


LEAST_GROUP = 3  # members of a group, of which one would be a blunder
_LEAST_SHARE = 0.15  # of all, below which the smaller group counts as blunders
_APART = 5.0  # least distance of the groups' middles, in units of the scatter within the wider group
_GROUPING_STEPS = 20  # of k-means


@dataclass(frozen=True)
class TwoGroups:
    """Two groups of offsets (n, d), in the unit of the offsets."""

    second: BoolArray  # (n,) the smaller group
    apart: FloatArray  # (d,) middle of the smaller group minus that of the larger


def scatter_about_median(offsets: ArrayLike) -> float:
    """Return the robust σ per axis of offsets (n, d) about the median of each axis, up to half of them blunders."""
    array = np.asarray(offsets, dtype=np.float64)
    squared = ((array - np.median(array, axis=0)) ** 2).sum(axis=1)
    return float(np.sqrt(np.median(squared) / median_chi2(array.shape[1])))


def median_spacing(places: ArrayLike) -> float:
    """Return the median distance of n ≥ 2 places (n, d) from the nearest other one."""
    from scipy.spatial import KDTree

    array = np.asarray(places, dtype=np.float64)
    return float(np.median(KDTree(array).query(array, k=2)[0][:, 1]))


def two_groups(offsets: ArrayLike) -> TwoGroups | None:
    """Return the two groups into which offsets (n, d) fall, or None if they do not.

    The best split along the axis of the largest extent is refined by k-means. One normal distribution, cut in two,
    is no such mixture: its halves lie 2.7 of their own σ apart.
    """
    array = np.asarray(offsets, dtype=np.float64)
    least = max(LEAST_GROUP, int(np.ceil(_LEAST_SHARE * len(array))))
    if len(array) < 2 * least:
        return None
    axis = np.linalg.svd(array - np.median(array, axis=0), full_matrices=False)[2][0]
    along = array @ axis
    order = np.argsort(along, kind="stable")
    ranked = along[order]
    count = np.arange(least, len(array) - least + 1)
    total, squares = np.cumsum(ranked), np.cumsum(ranked**2)
    left = squares[count - 1] - total[count - 1] ** 2 / count
    right = (squares[-1] - squares[count - 1]) - (total[-1] - total[count - 1]) ** 2 / (len(array) - count)
    second = np.ones(len(array), dtype=bool)
    second[order[: count[np.argmin(left + right)]]] = False
    for _ in range(_GROUPING_STEPS):
        middles = [np.median(array[mask], axis=0) for mask in (~second, second)]
        distance = [np.linalg.norm(array - middle, axis=1) for middle in middles]
        nearer = distance[1] < distance[0]
        if min(nearer.sum(), (~nearer).sum()) < least:
            return None
        if np.array_equal(nearer, second):
            break
        second = nearer
    if second.sum() > len(array) / 2:
        second, middles = ~second, middles[::-1]
    apart = middles[1] - middles[0]
    within = max(scatter_about_median(array[mask]) for mask in (~second, second))
    if np.linalg.norm(apart) < _APART * within:
        return None
    return TwoGroups(second, apart)


def blunders_among(offsets: ArrayLike, sigma: float) -> BoolArray | None:
    """Return the mask (n,) of the blunders among n ≥ 1 offsets (n, d) whose majority agrees; None: none stands out.

    `sigma` is that of a good offset per axis; the robust scatter of the offsets replaces it if it is larger.
    """
    array = np.asarray(offsets, dtype=np.float64)
    scale = max(scatter_about_median(array), sigma)
    squared = ((array - np.median(array, axis=0)) ** 2).sum(axis=1)
    bad = squared > 4.0 * outlier_gate(array.shape[1]) * scale**2
    return bad if bad.any() else None
