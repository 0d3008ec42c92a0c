"""Rasteriser backends by name, and the one whose renders all have the mip filter."""

import logging
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from pipelines.core.errors import BackendUnavailableError
from pipelines.core.progress import SILENT, Progress
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import BackendName, Rasterizer, RasterSettings, Render

BACKENDS: tuple[BackendName, ...] = ("cpu", "cuda")

log = logging.getLogger(__name__)


def chosen_backend(name: Literal["auto", "cpu", "cuda"]) -> BackendName:
    """Return the backend that a name stands for, not loaded; a BackendUnavailableError names each missing part.

    `auto` stands for cuda if nothing that it needs is missing. If there is a GPU, the log says what is missing.
    """
    if name not in ("auto", *BACKENDS):
        message = f"The rasteriser {name!r} is unknown."
        remedy = "Use auto, cpu or cuda."
        raise BackendUnavailableError("rasteriser-unknown", message, remedy=remedy)
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return "cpu"
    from pipelines.splat.rasterizer.cuda_kernels import missing_for_cuda

    missing = missing_for_cuda()
    if missing is None:
        return "cuda"
    if name == "cuda":
        message = f"The cuda backend cannot be used: {missing}. Or use the cpu backend."
        raise BackendUnavailableError("cuda-unavailable", message)
    log.warning("the GPU is not used: %s", missing)
    return "cpu"


def rasterizer(
    name: Literal["auto", "cpu", "cuda"], progress: Progress = SILENT, *, mip_filter: bool = False
) -> Rasterizer:
    """Return the backend that a name stands for, see `chosen_backend`, with the mip filter in all renders or not.

    Raises:
        BackendUnavailableError: `cuda`, and a part that it needs is missing, or its kernels cannot be compiled;
            `progress` shows their compilation before their first use on a machine.
    """
    backend = _plain(name, progress)
    return MipFiltered(backend) if mip_filter else backend


def _plain(name: Literal["auto", "cpu", "cuda"], progress: Progress) -> Rasterizer:
    if chosen_backend(name) == "cuda":
        from pipelines.splat.rasterizer.cuda import CudaRasterizer

        return CudaRasterizer(progress)
    from pipelines.splat.rasterizer.cpu import CpuRasterizer

    return CpuRasterizer()


class MipFiltered:
    """Another backend with the mip filter (`RasterSettings.mip_filter`) in all renders, as a training had it."""

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
