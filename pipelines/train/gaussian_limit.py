"""Default limit of Gaussians: by the pixels of the photographs, within what the preset and the memory allow."""

from __future__ import annotations

from dataclasses import replace

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.memory import TrainingSize, fitting_gaussians
from pipelines.train.crops import Crops
from pipelines.train.options import TrainOptions
from pipelines.train.presets import PRESETS

# Pixels of all photographs for each Gaussian: where eight photographs overlap, five pixels on the ground.
_PIXELS_EACH = 40


def training_size(options: TrainOptions, photographs: int, largest: Pinhole, beside: int = 0) -> TrainingSize:
    """Return the quantities that determine the memory of a training.

    Args:
        options: of the training.
        photographs: number of the photographs.
        largest: camera of the largest photograph at training size.
        beside: number of frozen Gaussians that are rendered too.
    """
    return TrainingSize(
        options.effort.max_gaussians + beside,
        Crops(options.crop_size).largest_of(largest),
        options.sh_degree,
        options.refined_cameras(photographs),
        largest.width * largest.height,
    )


def with_gaussian_limit(
    options: TrainOptions, photographs: int, largest: Pinhole, free_bytes: int | None
) -> TrainOptions:
    """Return options that state the limit of Gaussians; they are unchanged if the user states one.

    1. Photographs of the preset's size have the preset's limit.
    2. Larger ones have more, in proportion to their pixels, as far as all photographs together have 40 pixels for
       each, and as far as they fit into memory.

    Args:
        options: of the training.
        photographs: number of the photographs.
        largest: camera of the largest photograph at training size.
        free_bytes: memory that is free; None: unknown.
    """
    preset = PRESETS[options.preset]
    enlarged = max(largest.width, largest.height) / preset.max_image_size
    if options.max_gaussians is not None or enlarged <= 1:
        return options
    limits = [
        round(enlarged**2 * preset.max_gaussians),
        photographs * largest.width * largest.height // _PIXELS_EACH,
    ]
    if free_bytes is not None:
        size = replace(training_size(options, photographs, largest), gaussians=min(limits))
        limits.append(fitting_gaussians(size, free_bytes))
    return options.model_copy(update={"max_gaussians": max(preset.max_gaussians, min(limits))})
