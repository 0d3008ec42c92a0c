"""Distances between two clouds along the normals of one of them (M3C2), by py4dgeo.

Lague, Brodu and Leroux 2013, doi 10.1016/j.isprsjprs.2013.04.009.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.core.errors import BackendUnavailableError
from pipelines.core.types import FloatArray

LEAST_POINTS = 4  # in the cylinder, of each cloud
CONFIDENCE_95 = 1.96


@dataclass(frozen=True)
class M3c2Distances:
    """Distances at C core points.

    Attributes:
        distance_m: (C,) second cloud minus first along the normals; NaN where one has too few points.
        noise_m: (C,) σ of the distance that the roughness of both clouds causes.
    """

    distance_m: FloatArray
    noise_m: FloatArray


def require_m3c2() -> None:
    """Import py4dgeo, so that its absence is told before work starts.

    Raises:
        BackendUnavailableError: py4dgeo is not installed.
    """
    _py4dgeo()


def m3c2(
    first: FloatArray,
    second: FloatArray,
    core: FloatArray,
    normal: FloatArray,
    *,
    radius_m: float,
    reach_m: float,
) -> M3c2Distances:
    """Return the distances of two clouds at core points.

    Args:
        first: (P, 3) metres.
        second: (Q, 3) metres.
        core: (C, 3) places.
        normal: (C, 3) unit vectors.
        radius_m: of the cylinders.
        reach_m: half the length of the cylinders: the largest distance that is found.
    """
    nothing = np.full(len(core), np.nan)
    if not (len(core) and len(first) and len(second)):
        return M3c2Distances(nothing, nothing.copy())
    py4dgeo = _py4dgeo()
    middle = core.mean(axis=0)
    algorithm = py4dgeo.M3C2(
        epochs=(py4dgeo.Epoch(first - middle), py4dgeo.Epoch(second - middle)),
        corepoints=np.ascontiguousarray(core - middle),
        corepoint_normals=np.ascontiguousarray(normal, dtype=np.float64),
        cyl_radius=radius_m,
        max_distance=reach_m,
    )
    distance, uncertainty = algorithm.run()
    known = (uncertainty["num_samples1"] >= LEAST_POINTS) & (uncertainty["num_samples2"] >= LEAST_POINTS)
    known &= np.isfinite(distance)
    with np.errstate(invalid="ignore"):
        noise = uncertainty["lodetection"] / CONFIDENCE_95
    return M3c2Distances(np.where(known, distance, np.nan), np.where(known, noise, np.nan))


def _py4dgeo() -> Any:
    try:
        import py4dgeo
    except ImportError as error:
        message = "--reference needs py4dgeo: pip install 'georefgs[reference]'"
        raise BackendUnavailableError(message) from error
    # It logs to stdout, which belongs to our results, and into a file of the current folder.
    log = logging.getLogger("py4dgeo")
    for handler in list(log.handlers):
        log.removeHandler(handler)
    log.setLevel(logging.WARNING)
    return py4dgeo
