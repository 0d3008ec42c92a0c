"""RANSAC with an adaptive number of draws and a truncated loss (MSAC, doi 10.1006/cviu.1999.0832)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.types import BoolArray, FloatArray, IntArray

ModelT = TypeVar("ModelT")


@dataclass(frozen=True)
class RansacOptions:
    """Sample size, gate and number of draws.

    Attributes:
        sample_size: observations that determine a model.
        gate: largest squared whitened residual of an inlier.
        max_draws: limit of draws.
        confidence: required probability of at least one draw without outliers.
    """

    sample_size: int
    gate: float
    max_draws: int = 500
    confidence: float = 0.9999


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
        count: number of observations.
        fit: makes a model from the chosen indices; may raise `DegenerateGeometryError`.
        squared_residuals: whitened squared residuals (count,) of a model.
        options: sample size, gate and number of draws.
        rng: draws the samples.

    Raises:
        DegenerateGeometryError: too few observations, or no draw gave a model.
    """
    if count < options.sample_size:
        raise DegenerateGeometryError(f"{options.sample_size} observations are needed, there are {count}")
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
        raise DegenerateGeometryError(f"none of {draws} random samples determines a model")
    return best


def draws_needed(inlier_share: float, options: RansacOptions) -> float:
    """Return the number of draws that contain one without outliers at the required confidence."""
    clean = inlier_share**options.sample_size
    if clean >= 1.0:
        return 1.0
    if clean <= 0.0:
        return math.inf
    return math.log(1.0 - options.confidence) / math.log1p(-clean)
