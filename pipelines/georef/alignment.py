"""The similarity `geo_from_local` from scratch: starts, robust adjustment, choice, and refusal.

What carries the information
    Camera centres against GNSS fixes, and control points against their survey: their errors are independent.
    The geolocated points are *not* a third source. Each is a function of the same few fixes and attitudes, so a
    hundred thousand of them know no more than the cameras do; counted as independent they would claim millimetres
    and let a compass error outweigh RTK. They serve as one start of the search and as a check.
    Attitudes enter only where centres and control points leave the rotation open (a single straight flight line).
    Their errors (boresight, compass) are mostly common to a flight and do not average out, so the mean of all is
    given the σ of one.

Fixes against control points
    Fixes of a flight often share an offset (base station, datum, antenna height). A solution in which the fixes
    have a common bias competes with one in which they have none, by likelihood, the bias costing as much as one
    outlier. So control points that agree with each other decide the position when the fixes contradict them by
    more than σ allow, and the fixes still give scale and rotation. A *single* contradicting control point is
    believed only while the bias stays within 5 σ of one fix; beyond that it is taken for a blunder.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.georef.adjustment import (
    BIAS_COST,
    OUTLIER_GATE,
    AdjustedSimilarity,
    Correspondences,
    RotationPrior,
    SimilarityState,
    adjust,
    residual_covariances,
    residuals,
)
from pipelines.robust.kernels import cauchy_weight
from pipelines.robust.ransac import RansacOptions, ransac
from pipelines.robust.statistics import median_chi2, squared_mahalanobis

_WORST_ROTATION_RAD = np.radians(5.0)  # beyond, the linear covariance says nothing
_LONE_BIAS_SIGMAS = 5.0
_FLAT = 0.02  # third extent of the layout over the first
_LOOSER = (1.0, 3.0, 10.0, 30.0, 100.0)

ADVICE = (
    "add control points that do not lie on that line (`georef ingest --gcp FILE`, at least 3), or attitudes "
    "(yaw, pitch, roll of the camera) in the trajectory"
)


@dataclass(frozen=True)
class Alignment:
    """The similarity, how it was found, and what contradicts it.

    Attributes:
        solution: parameters, covariance and residuals.
        layout: extent of the correspondences used: "volume", "plane", or "line" if attitude was needed.
        attitude: the recorded attitudes, where they resolved the rotation.
    """

    solution: AdjustedSimilarity
    layout: Literal["volume", "plane", "line"]
    attitude: RotationPrior | None

    @property
    def attitude_used(self) -> bool:
        """Whether recorded attitudes resolved the rotation."""
        return self.attitude is not None

    @property
    def geo_from_local(self) -> Similarity:
        """The similarity."""
        return self.solution.state.geo_from_local


def align(
    data: Correspondences,
    rng: np.random.Generator,
    *,
    attitude: RotationPrior | None = None,
    guesses: tuple[Similarity, ...] = (),
) -> Alignment:
    """Find the similarity that maps local onto geo.

    Args:
        data: camera centres with fixes and control points.
        attitude: rotation geo ← local from recorded attitudes, for layouts that need it.
        guesses: further starts, e.g. from geolocated points.

    Raises:
        DegenerateGeometryError: the correspondences leave the similarity open; says what to add.
    """
    if len(data) < 2 or (len(data) < 3 and attitude is None):
        raise DegenerateGeometryError(
            f"{len(data)} positions (fixes of registered images and control points) do not determine where the "
            f"model lies; 3 are needed: {ADVICE}"
        )
    candidates = _candidates(data, _starts(data, rng, guesses), None)
    firm = [candidate for candidate in candidates if candidate.rotation_sigma_rad <= _WORST_ROTATION_RAD]
    if firm:
        best = _choose(firm, data)
        return Alignment(best, layout_of(data.in_local[best.state.inlier]), None)
    worst = min((np.degrees(candidate.rotation_sigma_rad) for candidate in candidates), default=np.inf)
    if attitude is None:
        size = f"is known to {worst:.0f}° only" if worst < 90 else "is not determined"
        raise DegenerateGeometryError(f"the positions lie on one line: the rotation about it {size}; {ADVICE}")
    candidates = _candidates(data, [_start_with_rotation(data, attitude.rotation, rng)], attitude)
    return Alignment(_choose(candidates, data), "line", attitude)


def layout_of(positions: FloatArray) -> Literal["volume", "plane"]:
    """Whether positions (n, 3) fill a volume or lie in one plane."""
    extent = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return "plane" if len(extent) < 3 or extent[2] < _FLAT * extent[0] else "volume"


def mean_rotation(rotations: FloatArray, sigma_rad: FloatArray) -> RotationPrior:
    """Robust mean of rotations (k, 3, 3) that each estimate geo ← local with σ (k,), from recorded attitudes.

    The covariance is that of one of them (or their scatter, if larger), since attitude errors of a flight are
    mostly common to all its images.
    """
    mean = rotations[int(np.argmin(_spread(rotations)))]
    weight = np.ones(len(rotations))
    for _ in range(20):
        error = log_so3(rotations @ mean.T)
        weight = cauchy_weight((error**2).sum(axis=1) / sigma_rad**2, 3) / sigma_rad**2
        step = weight @ error / weight.sum()
        mean = exp_so3(step) @ mean
        if np.linalg.norm(step) < 1e-12:
            break
    scatter = float(np.median(np.linalg.norm(log_so3(rotations @ mean.T), axis=1)) / np.sqrt(median_chi2(3)))
    return RotationPrior(mean, max(float(np.median(sigma_rad)), scatter) ** 2 * np.eye(3))


def _spread(rotations: FloatArray) -> FloatArray:
    """Median angle of each rotation to all others, over at most 200 of them."""
    others = rotations[:: max(1, len(rotations) // 200)]
    cosine = (np.einsum("aij,bij->ab", rotations, others) - 1) / 2
    return np.asarray(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1))


def _starts(data: Correspondences, rng: np.random.Generator, guesses: tuple[Similarity, ...]) -> list[Similarity]:
    """Similarities to start from: of the fixes, of the control points, of both where neither suffices."""
    starts = list(guesses)
    for members in (~data.control, data.control):
        if members.sum() >= 3:
            starts += _ransac_start(data.part(members), rng)
    return starts or _ransac_start(data, rng)


def _ransac_start(data: Correspondences, rng: np.random.Generator) -> list[Similarity]:
    """The similarity most agree with, at the tightest gate that half of them pass; none if degenerate."""

    def fit(chosen: np.ndarray) -> Similarity:
        return umeyama(data.in_local[chosen], data.in_geo[chosen])

    starts = []
    for looser in _LOOSER:
        # The excess scatter of SfM is not known yet: stated σ may be far too tight.
        options = RansacOptions(3, OUTLIER_GATE * looser**2, max_draws=300)
        try:
            result = ransac(len(data), fit, lambda model: _squared(data, model), options, rng)
        except DegenerateGeometryError:
            return []
        starts = [result.model]
        if result.inlier.mean() > 0.5:
            with suppress(DegenerateGeometryError):
                starts = [umeyama(data.in_local[result.inlier], data.in_geo[result.inlier])]
            break
    return starts


def _start_with_rotation(data: Correspondences, rotation: FloatArray, rng: np.random.Generator) -> Similarity:
    """Scale and translation, robustly, with the rotation given."""
    turned = data.in_local @ rotation.T

    def fit(chosen: np.ndarray) -> Similarity:
        (a, b), (p, q) = turned[chosen], data.in_geo[chosen]
        scale = float((b - a) @ (q - p) / max((b - a) @ (b - a), np.finfo(float).tiny))
        if scale <= 0:
            raise DegenerateGeometryError("the two positions run against each other")
        return Similarity(scale, rotation, (p + q - scale * (a + b)) / 2)

    options = RansacOptions(2, OUTLIER_GATE * _LOOSER[-1] ** 2, max_draws=300)
    return ransac(len(data), fit, lambda model: _squared(data, model), options, rng).model


def _squared(data: Correspondences, model: Similarity) -> FloatArray:
    state = SimilarityState(model, np.ones(len(data), dtype=bool))
    return squared_mahalanobis(residuals(data, state), residual_covariances(data, state))


def _candidates(
    data: Correspondences, starts: list[Similarity], prior: RotationPrior | None
) -> list[AdjustedSimilarity]:
    everything = np.ones(len(data), dtype=bool)
    states = [SimilarityState(start, everything) for start in starts]
    if data.control.any() and not data.control.all():
        states += [_with_bias(data, state) for state in list(states)]
    return [adjust(data, state, prior) for state in states]


def _with_bias(data: Correspondences, state: SimilarityState) -> SimilarityState:
    """The state moved onto the control points, the fixes' offset from it taken as their bias."""
    missed = residuals(data, state)
    shift = np.median(missed[data.control], axis=0)
    model = state.geo_from_local
    onto = Similarity(model.scale, model.rotation, model.translation + shift)
    return replace(state, geo_from_local=onto, fix_bias_in_geo=np.median(missed[~data.control], axis=0) - shift)


def _choose(candidates: list[AdjustedSimilarity], data: Correspondences) -> AdjustedSimilarity:
    """The likeliest candidate, a bias of the fixes costing as much as an outlier."""

    def cost(candidate: AdjustedSimilarity) -> float:
        bias = candidate.state.fix_bias_in_geo
        if bias is None:
            return candidate.cost
        lone = int((data.control & candidate.state.inlier).sum()) <= 1
        allowed = data.cov_in_geo[~data.control].mean(axis=0)
        if lone and squared_mahalanobis(bias[None], allowed)[0] > _LONE_BIAS_SIGMAS**2:
            return np.inf
        return candidate.cost + BIAS_COST

    return min(candidates, key=cost)
