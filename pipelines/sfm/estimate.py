"""Estimate of a reconstruction by COLMAP: mapper, chunks, time and memory for the photographs of a survey.

`jobs.costs` has the constants. The largest photographs of a survey have `photo_px` pixels, width and height.
"""

from dataclasses import dataclass

from pipelines.core.machine import chosen_threads, free_main_memory_bytes
from pipelines.core.sentences import about
from pipelines.jobs.costs import (
    MEASURED_CORES,
    ReconstructionCost,
    features_peak_bytes,
    mapping_peak_bytes,
    reconstruction_cost,
)
from pipelines.sfm.mapping import MapperName, chosen_mapper
from pipelines.sfm.options import SfmOptions

_USABLE = 0.9  # of the free memory: other programs grow, too


@dataclass(frozen=True)
class ReconstructionEstimate:
    """Estimate of a reconstruction."""

    photographs: int
    mapper: MapperName
    chunks: int  # of features; 1: the survey is worked in one process
    seconds: float
    peak_bytes: int  # predicted peak of the memory
    free_bytes: int | None  # memory that is free; None: unknown
    refusal: str  # reason why it would not fit; empty: it fits

    def sentences(self) -> list[str]:
        """Return the estimate for people: mapper, chunks, time and memory."""
        parts = "" if self.chunks == 1 else f", features and matches in {self.chunks} chunks each"
        free = "" if self.free_bytes is None else f" of {self.free_bytes / 2**30:.1f} GiB free"
        return [
            f"{self.photographs} photographs, {self.mapper} mapper{parts}",
            f"about {about(self.seconds)} on this machine; memory at most {self.peak_bytes / 2**30:.1f} GiB{free}",
        ]


def estimate_reconstruction(
    photographs: int, photo_px: tuple[int, int], options: SfmOptions
) -> ReconstructionEstimate:
    from pipelines.jobs.calibration import machine_factor  # and torch, which a reconstruction does not need

    free_bytes = free_main_memory_bytes()
    return ReconstructionEstimate(
        photographs=photographs,
        mapper=chosen_mapper(photographs, options),
        chunks=options.chunks(photographs),
        seconds=estimated_cost(photographs, photo_px, options).total_s / MEASURED_CORES * machine_factor(),
        peak_bytes=peak_bytes(photographs, photo_px, options),
        free_bytes=free_bytes,
        refusal=why_too_large(photographs, photo_px, options, free_bytes) or "",
    )


def estimated_cost(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> ReconstructionCost:
    """Return about how many seconds one core needs for each step."""
    every = photographs * (photographs - 1) / 2
    shrink = max(max(photo_px) / options.max_image_size, 1.0)  # by which features are detected on smaller images
    # Half of the largest number of neighbours: most pairs are chosen by both of their images.
    pairs = every if options.pairs == "exhaustive" else min(every, photographs * options.max_neighbors / 2)
    return reconstruction_cost(
        photographs,
        photo_px[0] * photo_px[1] / shrink**2 / 1e6,
        pairs,
        doubled=options.doubles(photo_px),
        max_features=options.max_features,
    )


def chunk_peak_bytes(photo_px: tuple[int, int], options: SfmOptions, threads: int = 1) -> int:
    """Return the peak of a process that detects or matches features in so many threads."""
    pixels, doubled = photo_px[0] * photo_px[1], options.doubles(photo_px)
    shrink = max(max(photo_px) / options.max_image_size, 1.0)
    return features_peak_bytes(pixels, shrink, doubled=doubled, threads=threads)


def peak_bytes(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> int:
    """Return the peak of the memory of a reconstruction on this machine."""
    features = chunk_peak_bytes(photo_px, options, chosen_threads(options.threads))
    return max(features, mapping_peak_bytes(photographs, options.max_features))


def why_too_large(
    photographs: int, photo_px: tuple[int, int], options: SfmOptions, free_bytes: int | None
) -> str | None:
    """Return why a reconstruction would not fit into the free memory, and what would; None: it fits.

    Into an unknown memory (None) everything fits.
    """
    needed = peak_bytes(photographs, photo_px, options)
    if free_bytes is None or needed <= _USABLE * free_bytes:
        return None

    def fits(max_features: int) -> bool:
        smaller = options.model_copy(update={"max_features": max_features})
        return peak_bytes(photographs, photo_px, smaller) <= _USABLE * free_bytes

    fewer = options.max_features
    while fewer > 1000 and not fits(fewer):
        fewer -= 500
    advice = f"Use --max-features {fewer}" if fits(fewer) else "Import a model made elsewhere with --import"
    mapper = chosen_mapper(photographs, options)
    return (
        f"SfM of {photographs} photographs needs about {needed / 2**30:.1f} GiB of memory ({mapper} mapper, "
        f"{options.max_features} features a photograph); {free_bytes / 2**30:.1f} GiB are free. {advice}, or a "
        "machine with more memory."
    )
