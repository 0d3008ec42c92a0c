"""Estimate that the measurements are compared with: cameras, similarity, constant errors and lens, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pipelines.adjust.systematic import SystematicErrorValues


@dataclass(frozen=True)
class TensorSimilarity:
    """Similarity geo ← model: p_geo = scale · rotation p_model + translation, in float64.

    Attributes:
        scale: scalar ().
        rotation: (3, 3).
        translation: (3,) metres.
    """

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Return the mapped points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class Estimate:
    """Values of all unknowns that the measurements depend on.

    Attributes:
        rotation: (n, 3, 3) cam ← model.
        center: (n, 3) projection centres in `model`, metres.
        geo_from_model: the similarity.
        errors: constant errors of the measurements.
        lens: (L,) change of the lens parameters; L = 0: none.
    """

    rotation: Tensor
    center: Tensor
    geo_from_model: TensorSimilarity
    errors: SystematicErrorValues
    lens: Tensor

    def geo_from_cam(self, camera: Tensor) -> Tensor:
        """Return the rotations geo ← cam (K, 3, 3) of cameras with indices (K,)."""
        return self.geo_from_model.rotation @ self.rotation[camera].transpose(1, 2)
