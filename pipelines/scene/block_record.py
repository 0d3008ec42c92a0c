"""Records of a training in blocks: of one block, and of the merged model with the disagreement of neighbours."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from pipelines.core.products import Product
from pipelines.scene.block_plan import BlockCell


class BlockTraining(Product):
    """Training of one block, as measured: for the merged product, and to fit the model of time and memory.

    Attributes:
        id: number of the block.
        iterations: of the training.
        gaussians: at its end, those of the overlap among them.
        gaussians_in_cell: those that the merged model takes.
        photographs: trained on.
        seconds: of the iterations.
        processor_s: of all processors together, for one iteration; None: unknown.
        mean_gaussians: mean number during the training.
        mean_visible: mean number in a view, those that stood in for the rest among them.
        mean_px: mean number of the pixels of a view that were rendered.
        surroundings: Gaussians that stood in for the rest.
        peak_bytes: peak of the process's memory; None: not measured on this system.
        threads: that the training computed with.
        backend: rasteriser of the training.
        train_psnr: mean of the last iterations, decibels.
    """

    id: int = Field(ge=0)
    iterations: int
    gaussians: int
    gaussians_in_cell: int
    photographs: int
    seconds: float
    processor_s: float | None
    mean_gaussians: float
    mean_visible: float
    mean_px: float
    surroundings: int
    peak_bytes: int | None
    threads: int
    backend: Literal["cpu", "cuda"]
    train_psnr: float


class Seam(Product):
    """Disagreement of two neighbouring blocks in their overlap, which both have trained.

    Attributes:
        blocks: their numbers.
        views: number of the views that were rendered by both.
        pixels: number of pixels compared.
        depth_median_m: median of the difference in depth, second less first.
        depth_nmad_m: 1.4826 × the median absolute deviation of the differences in depth.
        colour_rms: root mean square of the differences in colour, of colours from 0 to 1.
    """

    blocks: tuple[int, int]
    views: int
    pixels: int
    depth_median_m: float
    depth_nmad_m: float
    colour_rms: float


class MergedBlock(Product):
    """Block of a merged model: its cell in `model`, and its training."""

    cell: BlockCell
    training: BlockTraining


class BlockRecord(Product):
    """Record of a model that was trained in blocks.

    Attributes:
        format_version: version of the format.
        blocks: in the order of their numbers.
        seams: of neighbours whose overlap some view shows.
    """

    format_version: Literal[1] = 1
    blocks: tuple[MergedBlock, ...]
    seams: tuple[Seam, ...]
