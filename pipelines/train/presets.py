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
        """Return the effort as `800 iterations, 480 px, 80000 Gaussians`."""
        return f"{self.iterations} iterations, {self.max_image_size} px, {self.max_gaussians} Gaussians"


PRESETS = {
    "smoke": Preset(200, 320, 20_000),
    "fast": Preset(800, 480, 80_000),
    "standard": Preset(1_500, 800, 150_000),
    "high": Preset(2_000, 2_000, 300_000),
}
# Of `georef run` with 48 photographs of a megapixel, kernels compiled, on 2 idle cores of an AMD EPYC
# (docs/benchmarks.md, Presets).
RUN_MINUTES = {"smoke": 1, "fast": 2, "standard": 4, "high": 10}


def described() -> str:
    """Return all presets, each with its effort and the time of a run."""
    efforts = (f"{name}: {preset}, about {RUN_MINUTES[name]} min" for name, preset in PRESETS.items())
    return f"{'; '.join(efforts)} (for 48 photographs on 2 cores)."
