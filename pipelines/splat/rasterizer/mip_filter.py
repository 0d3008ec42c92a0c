"""Rasteriser whose renders all have the mip filter, as the training of a model had it."""

from dataclasses import replace

from torch import Tensor

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Render


class MipFiltered:
    """Another backend, whose opacities make up for the dilation (`RasterSettings.mip_filter`)."""

    def __init__(self, backend: Rasterizer) -> None:
        self._backend = backend
        self.name, self.device = backend.name, backend.device

    def render(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Render:
        """See `Rasterizer.render`."""
        return self._backend.render(gaussians, cam_from_model, camera, replace(settings, mip_filter=True))

    def candidates(
        self, gaussians: Gaussians, cam_from_model: Tensor, camera: Pinhole, settings: RasterSettings
    ) -> Tensor | None:
        """See `Rasterizer.candidates`."""
        return self._backend.candidates(gaussians, cam_from_model, camera, replace(settings, mip_filter=True))
