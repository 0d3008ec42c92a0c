"""The state that measurements are compared with: cameras, similarity, constant errors and lens, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pipelines.georef.systematic import SystematicErrorValues


@dataclass(frozen=True)
class TensorSimilarity:
    """geo ← model: p_geo = scale · rotation p_model + translation; scale (), rotation (3, 3), float64."""

    scale: Tensor
    rotation: Tensor
    translation: Tensor

    def apply(self, points: Tensor) -> Tensor:
        """Map points (N, 3)."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True)
class Estimate:
    """Everything that the measurements are compared with.

    Attributes:
        rotation: (n, 3, 3) cam ← model.
        center: (n, 3) projection centres in `model`.
        geo_from_model: the similarity.
        errors: constant errors of the measurements.
        lens: (L,) change of the lens parameters; L = 0 where the lens stays.
    """

    rotation: Tensor
    center: Tensor
    geo_from_model: TensorSimilarity
    errors: SystematicErrorValues
    lens: Tensor

    def geo_from_cam(self, camera: Tensor) -> Tensor:
        """Return rotations (K, 3, 3) of cameras (K,)."""
        return self.geo_from_model.rotation @ self.rotation[camera].transpose(1, 2)
