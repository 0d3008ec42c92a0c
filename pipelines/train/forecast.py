"""Forecast of a training: size, time and memory for the photographs of a survey, before it starts."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.sentences import about
from pipelines.core.threads import thread_count
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.memory import TrainingSize, free_memory_bytes, predicted_peak_bytes
from pipelines.splat.rasterizer.backends import device_of, rasterizer
from pipelines.train.options import TrainOptions
from pipelines.train.pace import MEASURED_CORES, iteration_seconds
from pipelines.train.schedule import COARSE

# Stereo of all photographs, by megapixels at training size: seven runs on the machine of `MEASURED_ON`, 2026-11-22,
# took 5 … 12 s a megapixel beside other programs.
_STEREO_MEGAPIXEL_S = 8.0
# Beyond so many cores the kernels gain little; not measured beyond two.
_MOST_CORES = 16


@dataclass(frozen=True)
class TrainingForecast:
    """Forecast of a training.

    Attributes:
        preset: name of the preset.
        photographs: number of photographs.
        photo_px: width and height of the largest photograph.
        training_px: width and height at which it is trained.
        iterations: length of the training.
        max_gaussians: limit of the Gaussians.
        backend: `cpu` or `cuda`.
        threads: that the CPU backend uses.
        seconds: about; None on a GPU, where nothing was measured.
        peak_bytes: predicted peak of the memory.
        free_bytes: memory that is free; None: unknown.
    """

    preset: str
    photographs: int
    photo_px: tuple[int, int]
    training_px: tuple[int, int]
    iterations: int
    max_gaussians: int
    backend: str
    threads: int
    seconds: float | None
    peak_bytes: int
    free_bytes: int | None

    @property
    def reduction(self) -> float:
        """Ratio of the longer sides of photograph and training image."""
        return max(self.photo_px) / max(self.training_px)

    def sentences(self) -> list[str]:
        """Return the forecast for people: effort, size of the images, time and memory."""
        effort = f"{self.preset}: {self.iterations} iterations, at most {self.max_gaussians} Gaussians"
        (width, height), (small_width, small_height) = self.photo_px, self.training_px
        size = f"{self.photographs} photographs of {width}×{height} px are trained at {small_width}×{small_height}"
        if self.reduction > 1.05:
            size += f", 1/{self.reduction:.1f} of their side (--max-image-size)"
        took = "time not measured on a GPU"
        if self.seconds is not None:
            took = f"about {about(self.seconds)} on {self.threads} threads of this machine"
        free = "" if self.free_bytes is None else f" of {self.free_bytes / 2**30:.1f} GiB free"
        return [effort, size, f"{took}; memory about {self.peak_bytes / 2**30:.1f} GiB{free}"]


def forecast(photographs: int, photo_px: tuple[int, int], options: TrainOptions) -> TrainingForecast:
    """Return the forecast of a training.

    The time is that of the machine of `MEASURED_ON`, divided by the ratio of the threads.

    Args:
        photographs: number of photographs.
        photo_px: width and height of the largest.
        options: of the training.

    Raises:
        BackendUnavailableError: `--backend cuda` without a GPU or without gsplat.
    """
    effort, (width, height) = options.effort, photo_px
    camera = Pinhole(width, height, width, width, width / 2, height / 2).limited(effort.max_image_size)
    backend = rasterizer(options.backend)
    device = device_of(backend)
    size = TrainingSize(effort.max_gaussians, camera, options.sh_degree, options.refined_cameras(photographs))
    return TrainingForecast(
        preset=options.preset,
        photographs=photographs,
        photo_px=photo_px,
        training_px=(camera.width, camera.height),
        iterations=effort.iterations,
        max_gaussians=effort.max_gaussians,
        backend=backend.name,
        threads=thread_count(),
        seconds=_seconds(photographs, camera, options) if device.type == "cpu" else None,
        peak_bytes=predicted_peak_bytes(size),
        free_bytes=free_memory_bytes(device),
    )


def _seconds(photographs: int, camera: Pinhole, options: TrainOptions) -> float:
    """Return the seconds of stereo and of all iterations on this machine."""
    pixels, effort = camera.width * camera.height, options.effort
    seconds, begun = 0.0, 0.0
    for shrink, until in (*(COARSE if options.coarse_to_fine else ()), (1, 1.0)):
        one = iteration_seconds(pixels / shrink**2, effort.max_gaussians, surface=options.faithful_surface)
        seconds += (until - begun) * effort.iterations * one
        begun = until
    if options.dense:
        seconds += _STEREO_MEGAPIXEL_S * photographs * pixels / 1e6
    return seconds * MEASURED_CORES / min(thread_count(), _MOST_CORES)
