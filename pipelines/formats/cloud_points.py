"""Points of a cloud, as its file formats write them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import ByteArray, Float32Array, FloatArray


@dataclass(frozen=True)
class CloudPoints:
    """P points in a CRS.

    Attributes:
        position: (P, 3) in the CRS, easting or longitude first.
        normal: (P, 3) unit vectors along the axes of the CRS.
        rgb: (P, 3) uint8.
        cov_m2: (P, 3, 3) covariance in m², axes east, north, up; NaN: unknown.
    """

    position: FloatArray
    normal: Float32Array
    rgb: ByteArray
    cov_m2: Float32Array

    @property
    def sigma_h_m(self) -> Float32Array:
        """Horizontal σ (P,) in metres: √(σ_E² + σ_N²); NaN: unknown."""
        return np.asarray(np.sqrt(self.cov_m2[:, 0, 0] + self.cov_m2[:, 1, 1]))

    @property
    def sigma_v_m(self) -> Float32Array:
        """Vertical σ (P,) in metres; NaN: unknown."""
        return np.asarray(np.sqrt(self.cov_m2[:, 2, 2]))

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position)
