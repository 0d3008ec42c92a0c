"""Presets of effort: iterations, size of the photographs and number of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.train.options import TrainOptions


@dataclass(frozen=True)
class Preset:
    """Effort of a training.

    Attributes:
        iterations: length of the training.
        max_image_size: longest side of a photograph in pixels.
        max_gaussians: limit of the Gaussians.
    """

    iterations: int
    max_image_size: int
    max_gaussians: int


PRESETS = {
    "smoke": Preset(200, 320, 20_000),
    "fast": Preset(2_000, 480, 60_000),
    "standard": Preset(7_000, 640, 120_000),
    "high": Preset(30_000, 1_600, 1_000_000),
}


def effort(options: TrainOptions) -> Preset:
    """Return the effort of the preset, with the values that the user set instead."""
    preset = PRESETS[options.preset]
    return Preset(
        options.iterations or preset.iterations,
        options.max_image_size or preset.max_image_size,
        options.max_gaussians or preset.max_gaussians,
    )
