"""Estimate of a training: size, time and memory for the photographs of a survey, before it starts.

Default effort: by number and pixels of the photographs, within what the memory allows.
"""

from dataclasses import dataclass, replace

import torch

from pipelines.core.machine import thread_count
from pipelines.core.sentences import about
from pipelines.geometry.cameras import Pinhole
from pipelines.jobs.costs import BUSY_CORES, COSTS, Work, cores_factor, iteration_seconds
from pipelines.splat.memory import USABLE, TrainingSize, fitting_gaussians, free_memory_bytes, predicted_peak_bytes
from pipelines.splat.rasterizer.backends import chosen_backend
from pipelines.surface.depth_maps import FINE
from pipelines.survey.block_plan import BlockPlan
from pipelines.survey.options import NOT_IN_BLOCKS
from pipelines.train.options import MOST_LOOKS, PRESETS, TrainOptions, surveys_of
from pipelines.train.schedule import COARSE, pyramid
from pipelines.train.target_images import Crops

# Pixels of all photographs for each Gaussian: where eight photographs overlap, five pixels on the ground.
_PIXELS_EACH = 40


def training_size(options: TrainOptions, photographs: int, largest: Pinhole, beside: int = 0) -> TrainingSize:
    """Return what determines the memory of a training at its size, with `beside` frozen Gaussians rendered too."""
    gaussians, cameras = options.effort.max_gaussians + beside, options.refined_cameras(photographs)
    crop, whole_px = Crops(options.crop_size).largest_of(largest), largest.width * largest.height
    return TrainingSize(gaussians, crop, options.sh_degree, cameras, whole_px)


def with_effort(options: TrainOptions, photographs: int, largest: Pinhole, free_bytes: int | None) -> TrainOptions:
    """Return options that state iterations and the limit of Gaussians, unless the user states them.

    1. Up to a hundred photographs of the preset's size have the preset's effort.
    2. More photographs have more of both, in proportion: each is seen as often, and shows a place of its own.
       Few have fewer iterations, as none is seen more than 30 times.
    3. Larger ones have more Gaussians, in proportion to their pixels, as far as all photographs together have 40
       pixels for each, and as far as they fit into `free_bytes` of memory; None: unknown.
    """
    preset, more = PRESETS[options.preset], surveys_of(photographs)
    iterations = min(round(more * preset.iterations), MOST_LOOKS * photographs)
    if options.iterations is None and iterations != preset.iterations:
        options = options.model_copy(update={"iterations": iterations})
    enlarged = more**0.5 * max(max(largest.width, largest.height) / preset.max_image_size, 1.0)
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


@dataclass(frozen=True)
class TrainingEstimate:
    """Estimate of a training."""

    preset: str
    photographs: int
    photo_px: tuple[int, int]  # width and height of the largest photograph
    training_px: tuple[int, int]  # width and height at which it is trained
    crops: int  # in which it is seen, one at an iteration, when it is not shrunken further
    iterations: int
    max_gaussians: int
    backend: str
    threads: int
    seconds: float | None  # about; None on a GPU, where nothing was measured
    peak_bytes: int  # predicted
    free_bytes: int | None  # None: unknown
    blocks: int | None = None  # asked for; None: as many as fit
    lidar: bool = False

    @property
    def in_blocks(self) -> bool:
        """Whether the survey is trained in blocks."""
        if self.blocks is not None:
            return self.blocks > 1
        return self.free_bytes is not None and self.peak_bytes > USABLE * self.free_bytes

    @property
    def refusal(self) -> str:
        """Reason why the training would be refused; empty: it would not."""
        return NOT_IN_BLOCKS if self.lidar and self.in_blocks else ""

    def sentences(self) -> list[str]:
        """Return the estimate for people: effort, size of the images, time and memory."""
        looks = self.iterations / self.photographs
        effort = f"{self.preset}: {self.iterations} iterations, {looks:.0f} a photograph, at most "
        effort += f"{self.max_gaussians} Gaussians"
        (width, height), (small_width, small_height) = self.photo_px, self.training_px
        size = f"{self.photographs} photographs of {width}×{height} px are trained at {small_width}×{small_height}"
        reduction = max(self.photo_px) / max(self.training_px)
        if reduction > 1.05:
            size += f", 1/{reduction:.1f} of their side (--max-image-size)"
        if self.crops > 1:
            size += f", each in {self.crops} crops (--crop-size)"
        took = "time not measured on a GPU"
        if self.seconds is not None:
            took = f"about {about(self.seconds)} on {self.threads} threads of this machine"
        free = "" if self.free_bytes is None else f" of {self.free_bytes / 2**30:.1f} GiB free"
        memory = f"memory about {self.peak_bytes / 2**30:.1f} GiB{free}"
        if not self.in_blocks:
            return [effort, size, f"{took}; {memory}"]
        many = "as many blocks as fit" if self.blocks is None else f"{self.blocks} blocks"
        return [effort, size, f"in {many}; one run would take {took.removeprefix('about ')}, {memory}"]


def estimate_training(photographs: int, photo_px: tuple[int, int], options: TrainOptions) -> TrainingEstimate:
    """Return the estimate of a training; a BackendUnavailableError names each missing part of `--backend cuda`.

    The time is that of the machine of `MEASURED_ON`, with the cores of this one.
    """
    camera, backend = training_pinhole(photo_px, options), chosen_backend(options.backend)
    free_bytes = free_memory_bytes(torch.device(backend))
    options = with_effort(options, photographs, camera, free_bytes)
    effort, size = options.effort, training_size(options, photographs, camera)
    pixels = camera.width * camera.height
    seconds = cores_factor() * _seconds(options, camera, photographs, pixels=pixels, gaussians=effort.max_gaussians)
    return TrainingEstimate(
        preset=options.preset,
        photographs=photographs,
        photo_px=photo_px,
        training_px=(camera.width, camera.height),
        crops=Crops(options.crop_size).count(camera.width, camera.height),
        iterations=effort.iterations,
        max_gaussians=effort.max_gaussians,
        backend=backend,
        threads=thread_count(),
        seconds=seconds if backend == "cpu" else None,
        peak_bytes=predicted_peak_bytes(size),
        free_bytes=free_bytes,
        blocks=options.blocks,
        lidar=options.lidar is not None,
    )


def block_processor_s(plan: BlockPlan, photo_px: tuple[int, int], options: TrainOptions) -> dict[int, float]:
    """Return the processor seconds that the CPU backend needs for each block of a plan, by number, on one core."""
    camera = training_pinhole(photo_px, options)
    return {
        block.id: BUSY_CORES
        * _seconds(
            options,
            camera,
            len(block.cameras),
            pixels=block.view_px,
            gaussians=block.gaussians + plan.scaffold_gaussians,
            visible=block.visible,
        )
        for block in plan.blocks
    }


def training_pinhole(photo_px: tuple[int, int], options: TrainOptions) -> Pinhole:
    """Return the camera of training photographs, with a lens as wide as many."""
    width, height = photo_px
    whole = Pinhole(width, height, width, width, width / 2, height / 2)
    return whole.limited(options.effort.max_image_size)


def _seconds(
    options: TrainOptions,
    camera: Pinhole,
    photographs: int,
    *,
    pixels: float,
    gaussians: int,
    visible: float | None = None,
) -> float:
    """Return the seconds of stereo and of all iterations on the machine of `MEASURED_ON`.

    Pixels are those that count of a photograph at its whole size, visible Gaussians those in it (None: unknown).
    """
    seconds, begun, surface = 0.0, 0.0, options.geometry_regularisation
    coarse, crops = COARSE if options.coarse_to_fine else (), Crops(options.crop_size)
    for shrink, until in pyramid(camera.width, camera.height, coarse, crops):
        side = (pixels / (camera.width * camera.height)) ** 0.5 / shrink
        parts = crops.count(max(int(side * camera.width), 1), max(int(side * camera.height), 1))
        seconds += (
            (until - begun)
            * options.effort.iterations
            * iteration_seconds(
                pixels / shrink**2, gaussians, photographs, surface=surface, crops=parts, visible=visible
            )
        )
        begun = until
    if not options.dense:
        return seconds
    maps = camera.limited(FINE.longest_px)
    megapixels = photographs * maps.width * maps.height / 1e6
    return seconds + COSTS["stereo"].of(Work(photographs=photographs, megapixels=megapixels))
