"""Rasteriser backends by name."""

from __future__ import annotations

from typing import Literal

import torch

from pipelines.core.errors import BackendUnavailableError
from pipelines.splat.rasterizer.api import Rasterizer

BackendName = Literal["auto", "cpu", "cuda"]
BACKENDS: tuple[BackendName, ...] = ("cpu", "cuda")


def rasterizer(name: BackendName) -> Rasterizer:
    """Return the backend of that name; `auto` takes cuda if a device and gsplat are present.

    Raises:
        BackendUnavailableError: `cuda` without a device or without gsplat.
    """
    from pipelines.splat.rasterizer.cuda import CudaRasterizer, cuda_available

    if name == "cuda" or (name == "auto" and cuda_available()):
        return CudaRasterizer()
    if name not in ("auto", "cpu"):
        raise BackendUnavailableError(f"no rasteriser is called {name!r}: use auto, cpu or cuda")
    from pipelines.splat.rasterizer.cpu import CpuRasterizer

    return CpuRasterizer()


def device_of(backend: Rasterizer) -> torch.device:
    """Return where the tensors of a backend live."""
    return torch.device("cuda" if backend.name == "cuda" else "cpu")
