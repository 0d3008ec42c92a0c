"""Points of a cloud, as its file formats write them."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.types import ByteArray, Float32Array, FloatArray


@dataclass(frozen=True)
class CloudPoints:
    """P points in a CRS.

    Attributes:
        position: (P, 3) in the CRS, easting or longitude first.
        normal: (P, 3) unit vectors along the axes of the CRS.
        rgb: (P, 3) uint8.
        sigma_h_m: (P,) horizontal σ in metres; NaN: unknown.
        sigma_v_m: (P,) vertical σ in metres; NaN: unknown.
    """

    position: FloatArray
    normal: Float32Array
    rgb: ByteArray
    sigma_h_m: Float32Array
    sigma_v_m: Float32Array

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position)
