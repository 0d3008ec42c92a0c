"""Options of `georef train`: of the splat, of the geographic losses, and of the run."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from pipelines.core.options import StageOptions
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.train.lidar.options import LidarOptions
from pipelines.train.presets import PRESETS, Preset, described


class SplatOptions(StageOptions):
    """Options of the splat: effort, backend, density control, exposure and surface."""

    preset: Literal["smoke", "fast", "standard", "high"] = Field("standard", description=f"Effort. {described()}")
    iterations: int | None = Field(None, ge=1, description="Iterations (default: the preset's).")
    max_image_size: int | None = Field(
        None, ge=32, description="Longest image side for training in pixels (default: the preset's)."
    )
    max_gaussians: int | None = Field(None, ge=100, description="Limit of Gaussians (default: the preset's).")
    backend: Literal["auto", "cpu", "cuda"] = Field("auto", description="Rasteriser.")
    sh_degree: int = Field(3, ge=0, le=3, description="Degree of the spherical harmonics.")
    strategy: Literal["default", "mcmc", "fast"] = Field(
        "default", description="Where Gaussians are added and removed: as 3DGS, by MCMC, or as several views agree."
    )
    coarse_to_fine: bool = Field(True, description="Start with shrunken photographs.")
    exposure: bool = Field(True, description="Fit the exposure of each training photograph.")
    dense: bool = Field(True, description="Find the scene's surface by multi-view stereo first, to start from.")
    faithful_surface: bool = Field(True, description="Hold the Gaussians to the surface, for depths to measure in.")

    @property
    def effort(self) -> Preset:
        """Effort of the preset, with the values that the user set instead."""
        preset = PRESETS[self.preset]
        return Preset(
            self.iterations or preset.iterations,
            self.max_image_size or preset.max_image_size,
            self.max_gaussians or preset.max_gaussians,
        )


class BlockOptions(StageOptions):
    """Options of a training in blocks."""

    blocks: int | None = Field(
        None,
        ge=1,
        description="Train in so many blocks (default: one run, or as many blocks as needed to fit into memory). "
        "Iterations are those of each block, the limit of Gaussians is that of the whole.",
    )
    block_overlap: float = Field(
        0.15, ge=0, le=1, description="Overlap of blocks on each side, as a share of a block's width."
    )
    block_memory: float | None = Field(
        None, gt=0, description="Memory of a worker in GiB, for the number of blocks (default: what is free here)."
    )


class TrainOptions(GeographicOptions, SplatOptions, BlockOptions, LidarOptions):
    """Options of the joint optimisation of Gaussians, similarity and camera corrections."""

    checkpoint_every: int = Field(500, ge=1, description="Iterations between checkpoints.")
    log_every: int = Field(10, ge=1, description="Iterations between lines of metrics.jsonl.")
    seed: int = Field(0, ge=0, description="Seed of every random choice.")

    @model_validator(mode="after")
    def _lidar_needs_a_surface(self) -> TrainOptions:
        if self.lidar is not None and not (self.dense and self.faithful_surface):
            raise ValueError(
                "--lidar is compared with the surface of the photographs: it needs --dense and --faithful-surface"
            )
        return self


class SolutionOptions(GeographicOptions):
    """Options of the solution that all blocks share.

    Attributes:
        max_image_size: longest side in pixels of the photographs whose colours give the exposures.
        exposure: whether to estimate exposures.
        seed: seed of every random choice.
    """

    max_image_size: int = Field(ge=1)
    exposure: bool = True
    seed: int = Field(0, ge=0)


class SeamOptions(TrainOptions):
    """Options of the training across the seams.

    Attributes:
        trained: SHA-256 of the Gaussians of each block, in the order of their numbers.
    """

    trained: tuple[str, ...] = ()


class BlockTrainOptions(TrainOptions):
    """Options of the training of one block.

    Attributes:
        id: number of the block in the plan.
    """

    id: int = Field(ge=0)
