"""Options of the division of a survey into blocks; the options of `georef train` give them."""

from __future__ import annotations

from pydantic import Field

from pipelines.core.options import StageOptions


class PlanOptions(StageOptions):
    """Options of the plan.

    Attributes:
        blocks: number of blocks; None: as many as fit into the memory of a worker.
        block_overlap: width of the overlap on each side of a block, as a share of the block's width.
        block_memory: memory of a worker in GiB; None: what is free on this machine.
        max_gaussians: limit of the Gaussians of the whole.
        max_image_size: longest side of a training photograph in pixels.
        sh_degree: degree of the spherical harmonics.
    """

    blocks: int | None = Field(None, ge=1)
    block_overlap: float = Field(0.15, ge=0, le=1)
    block_memory: float | None = Field(None, gt=0)
    max_gaussians: int = Field(ge=1)
    max_image_size: int = Field(ge=1)
    sh_degree: int = Field(ge=0, le=3)
