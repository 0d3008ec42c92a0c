"""Cameras with lens distortion: pixels ↔ rays, for COLMAP's camera models."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.products import FloatArray


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a COLMAP camera model.

    Attributes:
        model: COLMAP's name of the model, e.g. "OPENCV".
        width, height: image size in pixels.
        params: (P,) float64, COLMAP's parameters of that model, in pixels where they are lengths.
    """

    model: str
    width: int
    height: int
    params: FloatArray
