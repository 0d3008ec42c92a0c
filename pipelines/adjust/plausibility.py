"""Plausibility of a solution: cameras that hang upside down, or that look at the sky."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel

# Median of (up component of the image's upward direction) + (down component of the view) below which cameras hang
# upside down: level and nadir cameras have 1, and oblique ones up to 1.4.
_UPSIDE_DOWN = -0.2
_AT_SKY = 0.3  # median up component of the view


def hangs_upside_down(model: SparseModel, geo_from_local: Similarity) -> bool:
    """Return whether most cameras hang upside down."""
    up_in_cam = _up_in_cam(model, geo_from_local)
    return float(np.median(-up_in_cam[:, 1] - up_in_cam[:, 2])) < _UPSIDE_DOWN


def looks_at_sky(model: SparseModel, geo_from_local: Similarity) -> bool:
    """Return whether most cameras look upward."""
    return float(np.median(_up_in_cam(model, geo_from_local)[:, 2])) > _AT_SKY


def _up_in_cam(model: SparseModel, geo_from_local: Similarity) -> FloatArray:
    """Return the vertical (n, 3) in the axes of each camera."""
    return np.asarray(model.rotation_cam_from_local @ geo_from_local.rotation.T @ np.array([0.0, 0.0, 1.0]))
