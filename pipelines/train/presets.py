"""Presets of effort: iterations, size of the photographs and number of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass


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

    def __str__(self) -> str:
        """Return the effort as `2000 iterations, 480 px, 60000 Gaussians`."""
        return f"{self.iterations} iterations, {self.max_image_size} px, {self.max_gaussians} Gaussians"


PRESETS = {
    "smoke": Preset(200, 320, 20_000),
    "fast": Preset(2_000, 480, 60_000),
    "standard": Preset(7_000, 640, 120_000),
    "high": Preset(30_000, 1_600, 1_000_000),
}
