"""Similarity `geo_from_local` without an initial value: starts, robust adjustment, and choice of the solution.

Sources of information:

1. Camera centres against GNSS fixes, and control points against their survey. Their errors are independent.
2. Attitudes, only if centres and control points leave the rotation open (a single straight flight line). Their
   errors (boresight, compass) are mostly common to a flight and do not average out. The mean of all attitudes
   therefore has the σ of one.

The geolocated points are *not* a third source. Each is a function of the same few fixes and attitudes: a hundred
thousand points have no more information than the cameras. Counted as independent, they would claim σ of
millimetres, and an error of the compass would outweigh RTK. Nor are they a start of their own, because the same
fixes and attitudes give starts. They serve as a check.

Fixes against control points:

1. Fixes of a flight often share an offset (base station, datum, antenna height). A solution with a common bias of
   the fixes therefore competes by likelihood with one without. The bias costs as much as one outlier.
2. If the fixes contradict control points that agree with each other by more than σ allow, the control points
   determine the position. The fixes still determine scale and rotation.
3. A *single* contradicting control point stays an outlier, because a bias costs no less. Only the joint
   adjustment, with its prior of common errors, can decide between the two.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipelines.adjust.similarity_fit import (
    OUTLIER_GATE,
    AdjustedSimilarity,
    Correspondences,
    RotationPrior,
    SimilarityState,
    adjust,
    residual_covariances,
    residuals,
)
from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity, umeyama
from pipelines.robust.statistics import RansacOptions, cauchy_weight, median_chi2, ransac, squared_mahalanobis

_WORST_ROTATION_RAD = np.radians(5.0)  # beyond, the linear covariance is not valid
_FLAT = 0.02  # third extent of the layout over the first
_GATE_FACTORS = (1.0, 3.0, 10.0, 30.0, 100.0)  # of the stated σ

_ADVICE = (
    "add control points that do not lie on that line (`georef ingest --gcp FILE`, at least 3), or attitudes "
    "(yaw, pitch, roll of the camera) in the trajectory"
)


@dataclass(frozen=True)
class Alignment:
    """Similarity, with the layout that determines it and the attitude in use.

    Attributes:
        layout: extent of the correspondences used: "volume", "plane", or "line" if attitude was needed.
        attitude: mean of the recorded attitudes, if it resolved the rotation.
    """

    solution: AdjustedSimilarity
    layout: Literal["volume", "plane", "line"]
    attitude: RotationPrior | None

    @property
    def attitude_used(self) -> bool:
        return self.attitude is not None

    @property
    def geo_from_local(self) -> Similarity:
        return self.solution.state.geo_from_local


def align(data: Correspondences, rng: np.random.Generator, *, attitude: RotationPrior | None = None) -> Alignment:
    """Return the similarity that maps local onto geo.

    Args:
        data: camera centres with fixes, and control points.
        rng: draws the samples of RANSAC.
        attitude: rotation geo ← local from recorded attitudes, for layouts that need it.

    Raises:
        DegenerateGeometryError: the correspondences leave the similarity open; the message advises measurements to
            add.
    """
    if len(data) < 2 or (len(data) < 3 and attitude is None):
        raise DegenerateGeometryError(
            f"{len(data)} positions (fixes of registered images and control points) do not determine where the "
            f"model lies; 3 are needed: {_ADVICE}"
        )
    candidates = _candidates(data, _starts(data, rng), None)
    firm = [candidate for candidate in candidates if candidate.rotation_sigma_rad <= _WORST_ROTATION_RAD]
    prior = None
    if not firm:
        if attitude is None:
            worst = min((np.degrees(candidate.rotation_sigma_rad) for candidate in candidates), default=np.inf)
            size = f"is known to {worst:.0f}° only" if worst < 90 else "is not determined"
            raise DegenerateGeometryError(f"the positions lie on one line: the rotation about it {size}; {_ADVICE}")
        prior, firm = attitude, _candidates(data, [_start_with_rotation(data, attitude.rotation, rng)], attitude)
    # A bias of the fixes costs as much as an outlier.
    best = min(firm, key=lambda one: one.cost + OUTLIER_GATE * (one.state.fix_bias_in_geo is not None))
    return Alignment(best, "line" if prior else layout_of(data.in_local[best.state.inlier]), prior)


def layout_of(positions: FloatArray) -> Literal["volume", "plane"]:
    """Return whether positions (n, 3) fill a volume or lie in one plane."""
    extent = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return "plane" if len(extent) < 3 or extent[2] < _FLAT * extent[0] else "volume"


def mean_rotation(rotations: FloatArray, sigma_rad: FloatArray) -> RotationPrior:
    """Return the robust mean of rotations (k, 3, 3) geo ← local of recorded attitudes, with σ (k,) per axis.

    Attitude errors of a flight are mostly common to all its images. The covariance is therefore that of one
    rotation, or the scatter if it is larger.
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
    """Return the median angle (k,) of each rotation to a sample of all rotations."""
    others = rotations[:: max(1, len(rotations) // 200)]
    cosine = (np.einsum("aij,bij->ab", rotations, others) - 1) / 2
    return np.asarray(np.median(np.arccos(np.clip(cosine, -1, 1)), axis=1))


def _starts(data: Correspondences, rng: np.random.Generator) -> list[Similarity]:
    """Return the similarities to start from: of the fixes and of the control points, else of both together."""
    starts: list[Similarity] = []
    for members in (~data.control, data.control):
        if members.sum() >= 3:
            starts += _ransac_start(data.part(members), rng)
    return starts or _ransac_start(data, rng)


def _ransac_start(data: Correspondences, rng: np.random.Generator) -> list[Similarity]:
    """Return the similarity of RANSAC at the tightest gate that half of the points pass; none if degenerate."""
    starts = []
    for factor in _GATE_FACTORS:
        # The excess scatter of SfM is not known yet: the stated σ may be far too small.
        options = RansacOptions(3, OUTLIER_GATE * factor**2, max_draws=300)
        try:
            result = ransac(
                len(data),
                lambda chosen: umeyama(data.in_local[chosen], data.in_geo[chosen]),
                lambda model: _squared(data, model),
                options,
                rng,
            )
        except DegenerateGeometryError:
            return []
        starts = [result.model]
        if result.inlier.mean() > 0.5:
            with suppress(DegenerateGeometryError):
                starts = [umeyama(data.in_local[result.inlier], data.in_geo[result.inlier])]
            break
    return starts


def _start_with_rotation(data: Correspondences, rotation: FloatArray, rng: np.random.Generator) -> Similarity:
    turned = data.in_local @ rotation.T

    def fit(chosen: np.ndarray) -> Similarity:
        (a, b), (p, q) = turned[chosen], data.in_geo[chosen]
        scale = float((b - a) @ (q - p) / max((b - a) @ (b - a), np.finfo(float).tiny))
        if scale <= 0:
            raise DegenerateGeometryError("the two positions run against each other")
        return Similarity(scale, rotation, (p + q - scale * (a + b)) / 2)

    options = RansacOptions(2, OUTLIER_GATE * _GATE_FACTORS[-1] ** 2, max_draws=300)
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
    """Return the state shifted onto the control points, with the remaining offset of the fixes as bias."""
    residual = residuals(data, state)
    shift = np.median(residual[data.control], axis=0)
    model = state.geo_from_local
    onto = Similarity(model.scale, model.rotation, model.translation + shift)
    return replace(state, geo_from_local=onto, fix_bias_in_geo=np.median(residual[~data.control], axis=0) - shift)
