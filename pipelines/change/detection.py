"""Noise, level of detection and significance of a difference of heights, and the σ of volumes.

Three kinds of error stay apart. That of the datum is common to all cells of a region: a volume takes all of it.
That of the cells is correlated over a short length, which the unchanged ground shows: a volume takes the part that
an effective number of independent cells leaves (Rolstad et al. 2009, doi:10.3189/002214309789470950). That of a
height step is the place of a wall within its neighbourhood, common to the cells along the wall.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label, uniform_filter

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.geometry.statistics import huber_weight, mad_sigma

QUANTILE_95 = 1.96
LAGS = (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90)  # cells between the members of a pair
STEEPEST = 1.0  # slope of ground that noise and shift are estimated on
_CLIPPED = 3.0  # σ beyond which ground counts as changed
_PASSES = 12
_LEAST_STABLE = 500  # cells
_LEAST_PAIRS = 200
_UNCORRELATED = 0.05
_BLOCKS = 6  # along a side, whose medians show errors of long range
_LEAST_IN_BLOCK = 30
_MAJORITY = 0.5  # of the neighbours that change in the same way
_LEAST_VOTERS = 0.1  # of the neighbours
_FLOOR_M2 = 1e-8


@dataclass(frozen=True)
class Cells:
    """Difference of two epochs in cells (…,), later minus earlier, in metres; NaN: not known in both.

    Attributes:
        difference_m: of the heights.
        variance_m2: of the errors by cell.
        datum_m: σ of the error that neighbours share.
        slope: (…, 2) of the earlier surface, east and north.
        step_m2: variance of cells beside height steps and of interpolated ones; 0: others.
        is_measured: whether both epochs have measured the cell; else one of them has interpolated it.
    """

    difference_m: FloatArray
    variance_m2: FloatArray
    datum_m: FloatArray
    slope: FloatArray
    step_m2: FloatArray
    is_measured: BoolArray

    @property
    def is_certain(self) -> BoolArray:
        """Whether (…,) a cell tells a change by itself: it is measured, and no step near it decides its error."""
        known = np.isfinite(self.difference_m) & self.is_measured
        return np.asarray(known & (self.step_m2 <= self.variance_m2))


@dataclass(frozen=True)
class Samples:
    """N cells all over the raster, and pairs of cells by their distance, as normalised differences (K, 2).

    `place_m` (N, 2) counts from the middle of the raster. Pairs have the steepness of their cells (K,).
    """

    cells: Cells
    place_m: FloatArray
    pairs: dict[int, FloatArray]
    pair_designs: dict[int, FloatArray]


@dataclass(frozen=True)
class Noise:
    """Errors of the difference, as the unchanged ground shows them.

    Attributes:
        shift_m: (3,) east, north, up of the later epoch against the earlier on that ground.
        shift_cov_m2: (3, 3) its covariance.
        tilt: (2,) rise of the later epoch to the east and to the north; zero without `with_tilt`.
        tilt_sigma: (2,)
        scatter: of the cells over their predicted σ.
        correlated_m2: area over which errors of cells are one error.
        length_m: distance at which the correlation has fallen below 5 %.
        long_range_m: σ of the errors that vary slowly over the scene, of which a region has one.
        cells, share: number of sampled cells that are unchanged, and their share of the ground that counts.
        lags_m, correlation: (L,) of the errors by distance.
    """

    shift_m: FloatArray
    shift_cov_m2: FloatArray
    tilt: FloatArray
    tilt_sigma: FloatArray
    scatter: float
    correlated_m2: float
    length_m: float
    long_range_m: float
    cells: int
    share: float
    lags_m: FloatArray
    correlation: FloatArray

    @property
    def factor(self) -> float:
        """Factor of the variance of the cells that decides what has changed.

        It only ever raises them: level ground that scatters less than predicted says nothing of what lies beside
        objects and at the rim, where cells scatter more and false changes are.
        """
        return max(self.scatter**2, 1.0)

    def moved_by(self, slope: FloatArray, place_m: FloatArray) -> FloatArray:
        """Return the part (…,) of differences that shift and tilt explain, at slopes and places (…, 2)."""
        return np.asarray(self.shift_m[2] - slope @ self.shift_m[:2] + place_m @ self.tilt)


def unchanged_ground(
    samples: Samples, cell_m: float, prior_h_m: float, *, with_tilt: bool, slow_m: float = 0.0
) -> Noise:
    """Return the errors of the difference on the ground that most of the samples show as unchanged.

    The later surface, shifted by t, is z₂(x) = z₁(x − t_h) + t_v: the difference is t_v − t_h·∇z (Nuth, Kääb 2011).
    What does not fit shift and noise has changed. `prior_h_m` keeps a horizontal shift small that no slope shows.
    `slow_m` is the σ of slow errors that unchanged ground may hide, as both surfaces share them there.

    Raises:
        DegenerateGeometryError: too little ground is left, or both surfaces are one.
    """
    cells = samples.cells
    ground = (np.linalg.norm(cells.slope, axis=1) < STEEPEST) & cells.is_certain
    design = _design(cells.slope, samples.place_m, with_tilt=with_tilt)
    difference, sigma = cells.difference_m, np.sqrt(cells.variance_m2)
    prior = np.zeros(design.shape[1])
    prior[1:3] = 1.0 / max(prior_h_m, cell_m) ** 2
    fit, kept = np.zeros(design.shape[1]), ground
    if ground.sum() >= _LEAST_STABLE:
        fit[0] = np.median(difference[ground])
    scale, normal = 1.0, np.diag(prior + 1e-12)
    for _ in range(_PASSES):
        residual = (difference - design @ fit) / sigma
        scale = mad_sigma(residual[kept]) if kept.sum() >= _LEAST_STABLE else np.nan
        if scale == 0:
            message = "The surfaces of both epochs are equal, cell by cell: they are of one flight."
            raise DegenerateGeometryError("same-surface", message)
        kept = ground & (np.abs(residual) < _CLIPPED * scale)
        if kept.sum() < _LEAST_STABLE:
            raise DegenerateGeometryError(
                "no-stable-ground",
                (
                    f"Only {int(kept.sum())} cells of level, measured and unchanged ground are common to both "
                    f"epochs; {_LEAST_STABLE} are needed."
                ),
                remedy="Give polygons of unchanged ground with --stable, or smaller cells.",
            )
        weight = huber_weight((residual[kept] / scale) ** 2) / (scale * sigma[kept]) ** 2
        rows = design[kept]
        normal = rows.T @ (rows * weight[:, None]) + np.diag(prior)
        fit = np.linalg.solve(normal, rows.T @ (weight * difference[kept]))
    lags_m, correlation = _correlation(samples, fit, scale, cell_m)
    correlated_m2, length_m = _correlated(lags_m, correlation, cell_m)
    residual_m = (difference - design @ fit)[kept]
    extent_m2 = float(np.prod(np.ptp(samples.place_m[ground], axis=0)))
    area_m2 = extent_m2 * kept.sum() / max(len(ground), 1)
    # The samples are as many as they are, but hold no more than so many independent errors.
    independent = max(min(area_m2 / correlated_m2, float(kept.sum())), 1.0)
    covariance = np.linalg.inv(normal) * kept.sum() / independent
    order = [1, 2, 0]
    tilt_sigma = np.sqrt(np.diag(covariance)[3:]) if with_tilt else np.zeros(2)
    return Noise(
        shift_m=fit[order],
        shift_cov_m2=covariance[np.ix_(order, order)],
        tilt=fit[3:] if with_tilt else np.zeros(2),
        tilt_sigma=tilt_sigma,
        scatter=scale,
        correlated_m2=correlated_m2,
        length_m=length_m,
        long_range_m=max(
            slow_error_m(
                samples.place_m[kept],
                residual_m,
                np.ptp(samples.place_m[kept], axis=0) / _BLOCKS,
                apart=independent / kept.sum(),
            ),
            slow_m,
        ),
        cells=int(kept.sum()),
        share=float(kept.sum() / ground.sum()),
        lags_m=lags_m,
        correlation=correlation,
    )


def _design(slope: FloatArray, place_m: FloatArray, *, with_tilt: bool) -> FloatArray:
    return np.column_stack([np.ones(len(slope)), -slope, *([place_m] if with_tilt else [])])


def _correlation(samples: Samples, fit: FloatArray, scale: float, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Return distances (L,) in metres, and the correlation (L,) of the errors of cells that lie so far apart.

    From medians of squared differences of unchanged pairs, which few changes among them do not move.
    """
    lags, values = [], []
    for lag, pairs in samples.pairs.items():
        moved = samples.pair_designs[lag][..., : len(fit)] @ fit
        # The last column of a design is the σ of its cell, by which all is normalised.
        error = (pairs - moved / samples.pair_designs[lag][..., -1]) / scale
        error = error[(np.abs(error) < _CLIPPED).all(axis=1)]
        if len(error) < _LEAST_PAIRS:
            continue
        sill = mad_sigma(error.ravel()) ** 2
        gamma = mad_sigma(error[:, 0] - error[:, 1]) ** 2 / 2
        lags.append(lag * cell_m)
        values.append(1.0 - gamma / sill)
    return np.array(lags), np.array(values)


def _correlated(lags_m: FloatArray, correlation: FloatArray, cell_m: float) -> tuple[float, float]:
    """Return the integral of the correlation over the plane in m², at least a cell, and its length in metres."""
    gone = np.flatnonzero(correlation < _UNCORRELATED)
    count = int(gone[0]) if len(gone) else len(lags_m)
    radius = np.concatenate([[0.0], lags_m[: count + 1]])
    value = np.concatenate([[1.0], np.maximum(correlation[: count + 1], 0.0)])
    area = float(np.trapezoid(2 * np.pi * radius * value, radius))
    return max(area, cell_m**2), float(radius[-1]) if count else cell_m


def slow_error_m(place_m: FloatArray, error_m: FloatArray, block_m: FloatArray, *, apart: float = 1.0) -> float:
    """Return the σ of errors that vary slowly: the scatter of the medians of blocks beyond that of their noise.

    Args:
        place_m: (K, 2)
        error_m: (K,)
        block_m: (2,) sides of a block.
        apart: independent errors of a short range for each of the K.
    """
    column, row = ((place_m - place_m.min(axis=0)) // np.maximum(block_m, 1e-9)).astype(np.int64).T
    block = row * (column.max() + 1) + column
    medians, expected = [], []
    for one in np.unique(block):
        inside = error_m[block == one]
        if len(inside) >= _LEAST_IN_BLOCK:
            medians.append(np.median(inside))
            expected.append(np.pi / 2 * mad_sigma(inside) ** 2 / max(apart * len(inside), 1.0))
    if len(medians) < 4:
        return 0.0
    return float(np.sqrt(max(float(np.var(medians, ddof=1)) - float(np.mean(expected)), 0.0)))


def level_of_detection(cells: Cells, factor: float) -> FloatArray:
    """Return the 95 % level of detection of cells: of the datum, of the cell and of a height step beside it."""
    noise_m2 = np.maximum(factor * cells.variance_m2, _FLOOR_M2)
    return np.asarray(QUANTILE_95 * np.sqrt(cells.datum_m**2 + noise_m2 + cells.step_m2))


def significant_change(cells: Cells, factor: float, reach: int) -> NDArray[np.int8]:
    """Return −1 lowered, 1 raised, 0 neither (H, W): beyond the level of detection, as most certain neighbours are.

    Neighbours lie within `reach` cells. One cell in twenty is beyond its level by chance; half of its neighbours
    hardly ever are. Cells beside a height step have no vote: they follow their neighbours, if they differ too.
    Interpolated cells have neither.
    """
    certain = cells.is_certain
    noise_m = QUANTILE_95 * np.sqrt(cells.datum_m**2 + np.maximum(factor * cells.variance_m2, _FLOOR_M2))
    level, noise = np.nan_to_num(level_of_detection(cells, factor), nan=np.inf), np.nan_to_num(noise_m, nan=np.inf)
    size = 2 * reach + 1
    voters = uniform_filter(certain.astype(np.float32), size, mode="constant")
    sign = np.zeros(certain.shape, dtype=np.int8)
    for direction in (-1, 1):
        change = direction * np.nan_to_num(cells.difference_m)
        beyond: BoolArray = certain & (change > level)
        share = uniform_filter(beyond.astype(np.float32), size, mode="constant") / np.maximum(voters, 1e-6)
        may = certain | (cells.is_measured & (change > noise))
        sign[may & (voters > _LEAST_VOTERS) & (share > _MAJORITY)] = direction
    return sign


@dataclass(frozen=True)
class Volume:
    """Sums over the cells of a region, from which its volumes follow: all in metres, before the cells' area.

    `steps` is the variance of the sum that the places of walls and the interpolated parts leave; `missing` counts
    cells without a height of both dates.
    """

    cells: int = 0
    cut: float = 0.0
    fill: float = 0.0
    datum: float = 0.0
    variance: float = 0.0
    steps: float = 0.0
    lowest: float = 0.0
    highest: float = 0.0
    missing: int = field(default=0, kw_only=True)

    def __add__(self, other: Volume) -> Volume:
        return Volume(
            self.cells + other.cells,
            self.cut + other.cut,
            self.fill + other.fill,
            self.datum + other.datum,
            self.variance + other.variance,
            self.steps + other.steps,
            min(self.lowest, other.lowest),
            max(self.highest, other.highest),
            missing=self.missing + other.missing,
        )

    @property
    def known_share(self) -> float:
        """Share of the cells that have a height of both dates."""
        return self.cells / max(self.cells + self.missing, 1)

    def sigma_m3(self, noise: Noise, cell_m2: float, *, to_detect: bool = False) -> float:
        """Return the σ of the net volume: the datum's in full, and of the cells by their number that counts.

        The cells scatter as unchanged ground does, or by what decides whether something has changed.
        """
        joined = min(max(noise.correlated_m2 / cell_m2, 1.0), max(self.cells, 1))
        factor = noise.factor if to_detect else noise.scatter**2
        return float(cell_m2 * np.sqrt(self.datum**2 + factor * self.variance * joined + self.steps))


def region_volumes(number: IntArray | NDArray[np.int32], cells: Cells, count: int) -> list[Volume]:
    """Return the sums of regions 1 … `count`, by the number (H, W) of each cell; 0: no region.

    A wall lies in the neighbourhood of the cells on both of its sides: its error in a volume is half their sum, and
    one along a connected row of such cells. The error of a connected interpolated part is one, too.
    """
    known = (number > 0) & np.isfinite(cells.difference_m)
    of, difference = number[known], cells.difference_m[known]

    def total(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(of, values, count + 1)[1:], dtype=np.float64)

    wall, walls = label(known & (cells.step_m2 > 0), structure=np.ones((3, 3)), output=np.int32)
    pair, member = np.unique(of.astype(np.int64) * (walls + 1) + wall[known], return_inverse=True)
    own_m = np.sqrt(cells.step_m2[known]) * np.where(cells.is_measured[known], 0.5, 1.0)
    moved = np.bincount(member, own_m, len(pair))
    steps = np.bincount(pair // (walls + 1), moved**2, count + 1)[1:]
    low, high = np.zeros(count + 1), np.zeros(count + 1)
    np.minimum.at(low, of, difference)
    np.maximum.at(high, of, difference)
    columns = (
        np.bincount(of, minlength=count + 1)[1:],
        total(np.maximum(-difference, 0.0)),
        total(np.maximum(difference, 0.0)),
        total(cells.datum_m[known]),
        total(cells.variance_m2[known]),
        steps,
        low[1:],
        high[1:],
    )
    return [Volume(int(one[0]), *map(float, one[1:])) for one in zip(*columns, strict=True)]
