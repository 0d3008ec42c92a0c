"""Peak memory of a training, predicted before it starts, and compared with the free memory of the machine."""

from dataclasses import dataclass, replace

import torch

from pipelines.core.errors import ResourceError
from pipelines.core.machine import free_main_memory_bytes
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.sparse_cholesky import predicted_factor_bytes
from pipelines.splat.sh import coefficient_count

_FLOAT = 4
# Copies of all parameters that exist at once while density control rearranges them: the old parameters, their
# gradients, two moments and their successors (two more), and the new parameters in parts, joined, in spatial order,
# and as leaves.
_COPIES = 10
# Photograph, mask, render, loss, their gradients and the exposure's: floats a pixel.
_IMAGE_FLOATS = 45
# A photograph before the training: decoded, shrunken, undistorted, its mask and the place of each pixel.
_UNDISTORTED_BYTES = 24
_ROW_BYTES = 40  # counters, keys of the spatial order
_FIXED_BYTES = 150 * 2**20  # compiled kernels and reserves of the allocators
USABLE = 0.9  # of the free memory: other programs grow, too


@dataclass(frozen=True)
class TrainingSize:
    """Sizes on which the memory of a training depends."""

    gaussians: int  # largest number
    camera: Pinhole  # of the largest image that is rendered: a photograph, or a crop of it
    sh_degree: int
    cameras: int  # those whose poses training refines together
    photograph_px: int = 0  # of the largest photograph at its training size; 0: no larger than `camera`


def predicted_peak_bytes(size: TrainingSize) -> int:
    """Return the bytes that training adds to the process at its peak, assuming that a view sees all Gaussians."""
    from pipelines.splat.rasterizer.cpu import predicted_bytes

    width = 11 + 3 * coefficient_count(size.sh_degree)
    poses = predicted_factor_bytes(size.cameras)
    images = size.camera.width * size.camera.height * _IMAGE_FLOATS * _FLOAT
    # Of the CPU rasteriser, for one visible Gaussian on six tiles; the GPU's needs less.
    raster = predicted_bytes(1000, Pinhole(1, 1, 1.0, 1.0, 0.5, 0.5), 0) // 1000
    per_gaussian = max(_COPIES * width * _FLOAT, 4 * width * _FLOAT + raster) + _ROW_BYTES
    training = size.gaussians * per_gaussian + images + poses
    return max(training, size.photograph_px * _UNDISTORTED_BYTES) + _FIXED_BYTES


def require_memory(size: TrainingSize, free_bytes: int | None) -> None:
    """Refuse a training that will not fit into the memory of `free_memory_bytes`; None: none is refused.

    Raises:
        ResourceError: states the memory needed, and a number of Gaussians that would fit.
    """
    needed = predicted_peak_bytes(size)
    if free_bytes is None or needed <= USABLE * free_bytes:
        return
    fitting = fitting_gaussians(size, free_bytes)
    advice = "a smaller --max-image-size and a smaller --max-gaussians"
    if fitting >= 1000:
        advice = f"--max-gaussians {fitting} or a smaller --max-image-size"
    message = (
        f"Training needs about {_gib(needed)} of memory at its peak ({size.gaussians} Gaussians, images of "
        f"{size.camera.width}×{size.camera.height} pixels); {_gib(free_bytes)} are free."
    )
    remedy = f"Use {advice}, or close other programs."
    raise ResourceError("training-memory", message, remedy=remedy)


def fitting_gaussians(size: TrainingSize, free_bytes: int) -> int:
    """Return a number of Gaussians, in thousands, that fits into the free memory at a training of others."""
    fixed = predicted_peak_bytes(replace(size, gaussians=0, photograph_px=0))
    each = (predicted_peak_bytes(replace(size, photograph_px=0)) - fixed) / max(size.gaussians, 1)
    return max(int((USABLE * free_bytes - fixed) / each), 0) // 1000 * 1000


def free_memory_bytes(device: torch.device) -> int | None:
    """Return the memory that a training on `device` may still take; None if the system does not state it."""
    if device.type == "cuda":
        return int(torch.cuda.mem_get_info(device)[0])
    return free_main_memory_bytes()


def _gib(size: float) -> str:
    return f"{size / 2**30:.1f} GiB"
