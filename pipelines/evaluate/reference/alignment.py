"""Shift or similarity between the model and a reference, by points of one and planes of the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import FloatArray, Matrix34
from pipelines.geometry.similarity import Similarity, jacobian_at, perturbation
from pipelines.robust.kernels import cauchy_weight
from pipelines.robust.statistics import mad_sigma
from pipelines.scene.reference_report import Alignment, ReferenceShift

_ITERATIONS = 40
_FIRST_TRIM_M, _SHRINK = 50.0, 0.8  # farthest neighbours, and what becomes of that limit in an iteration
_LEAST_TRIM_SPACINGS = 2.0
_PART_M = 10.0  # side of the parts of the scene whose errors are taken as independent
_LEAST_POINTS = 100
_MOST_CONDITION = 1e10  # of the normal matrix: beyond, nothing fixes an axis, as on a plane


@dataclass(frozen=True)
class Fit:
    """Placement of the model on the reference.

    Attributes:
        reference_from_model: similarity in geo.
        shift: it as figures.
    """

    reference_from_model: Similarity
    shift: ReferenceShift


def fit_alignment(
    model: FloatArray, reference: FloatArray, normal: FloatArray, spacing_m: float, kind: Alignment
) -> Fit | None:
    """Return the placement of the model on the reference.

    None: the clouds have too little in common, or nothing fixes an axis.

    Args:
        model: (M, 3) points.
        reference: (P, 3) points.
        normal: (P, 3) unit normals of the reference; NaN: not known.
        spacing_m: between neighbours in the reference.
        kind: `similarity`, or a shift.
    """
    planar = np.isfinite(normal).all(axis=1)
    reference, normal = reference[planar], normal[planar]
    if min(len(model), len(reference)) < _LEAST_POINTS:
        return None
    tree, pivot = cKDTree(reference), model.mean(axis=0)
    free = slice(None) if kind == "similarity" else slice(4, 7)
    placed, trim_m = Similarity(), _FIRST_TRIM_M
    for _ in range(_ITERATIONS):
        points = placed.apply(model)
        distance, row = tree.query(points, distance_upper_bound=trim_m)
        near = np.isfinite(distance)
        if near.sum() < _LEAST_POINTS:
            return None
        n, arm = normal[row[near]], reference[row[near]] - points[near]
        residual = np.einsum("ni,ni->n", n, arm)
        weight = cauchy_weight((residual / max(float(mad_sigma(residual)), 1e-4)) ** 2, 1)
        design = np.einsum("ni,nij->nj", n, jacobian_at(points[near], pivot))[:, free]
        normal_matrix = (design * weight[:, None]).T @ design
        if np.linalg.cond(normal_matrix) > _MOST_CONDITION:
            return None
        delta = np.zeros(7)
        delta[free] = np.linalg.solve(normal_matrix, design.T @ (weight * residual))
        placed = perturbation(delta, pivot) @ placed
        scores, used = design * (weight * residual)[:, None], points[near]
        trim_m = max(_SHRINK * trim_m, _LEAST_TRIM_SPACINGS * spacing_m)
    return Fit(placed, _shift(placed, pivot, kind, normal_matrix=normal_matrix, scores=scores, points=used))


def _shift(
    placed: Similarity,
    pivot: FloatArray,
    kind: Alignment,
    *,
    normal_matrix: FloatArray,
    scores: FloatArray,
    points: FloatArray,
) -> ReferenceShift:
    """Return the figures of a placement.

    Its σ is that of the spread of the scores between parts of the scene, and never less than that of their spread
    between points: if one part alone fixes an axis, as with a single wall, its scores sum up to zero.
    """
    _, part = np.unique(np.floor(points[:, :2] / _PART_M), axis=0, return_inverse=True)
    sums = np.stack([np.bincount(part.ravel(), column) for column in scores.T], axis=1)
    spreads = [np.linalg.norm(np.linalg.solve(normal_matrix, each.T), axis=1) for each in (sums, scores)]
    sigma = np.maximum(*spreads)[-3:]
    east, north, up = (placed.apply(pivot) - pivot).tolist()
    cosine = (np.trace(placed.rotation) - 1) / 2
    return ReferenceShift(
        enu_m=(east, north, up),
        sigma_m=tuple(sigma.tolist()),
        scale_ppm=1e6 * (placed.scale - 1) if kind == "similarity" else 0.0,
        turn_deg=float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))) if kind == "similarity" else 0.0,
        reference_from_model=_rows(placed),
        points=len(points),
    )


def _rows(placed: Similarity) -> Matrix34:
    """Return the rows of [sR | t]."""
    first, second, third = ((a, b, c, d) for a, b, c, d in placed.matrix()[:3].tolist())
    return first, second, third
