"""Estimate of a reconstruction by COLMAP: mapper, chunks, time and memory for the photographs of a survey.

The largest photographs of a survey have `photo_px` pixels, width and height.
"""

from dataclasses import dataclass
from typing import NamedTuple

from pipelines.core.machine import chosen_threads, free_main_memory_bytes
from pipelines.core.sentences import about
from pipelines.jobs.costs import COSTS, MEASURED_CORES, Work, cores_factor
from pipelines.sfm.mapping import MapperName, chosen_mapper
from pipelines.sfm.options import SfmOptions

_USABLE = 0.9  # of the free memory: other programs grow, too
# Features a megapixel of aerial photographs, about, of doubled ones and of others, and their number for which the
# cost of a pair holds: matching compares each feature with those near where it is expected.
_FEATURES_MEGAPIXEL, _OWN_SIZE_FEATURES_MEGAPIXEL, _PAIR_FEATURES = 6000, 3000, 5000
_FIXED_BYTES = 300 << 20  # interpreter, libraries, reserves of the allocator
# Bytes a pixel of the photograph, and of the image that features are detected in, by thread: measured with
# photographs of 2.3 and 20.9 megapixels at 600, 1200 and 2400 px, where they are 1.04 to 1.28 times the growth.
# Photographs that are not doubled: 79 to 91 bytes at 1200, 1600 and 3200 px.
_PHOTO_BYTES_PX, _DETECTION_BYTES_PX, _OWN_SIZE_DETECTION_BYTES_PX = 4.0, 310.0, 95.0
# Mapping and the adjustments after it, of the global mapper, which needs more than the incremental one
# (`examples/benchmarks/many_photographs.py`; its results/scale.md has the runs).
_FEATURE_BYTES, _OBSERVATION_BYTES = 133.0, 2500.0
# Features that COLMAP finds and observations of points, as multiples of `--max-features`: eight surveys had up to
# 1.5 and, with real photographs, 0.14 to 0.32.
_FOUND, _OBSERVED = 1.5, 0.35


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
    """Return time (seconds) and memory (bytes) of a reconstruction on this machine, and why it is refused, if so.

    `photo_px` is the photographs' width and height.
    """
    free_bytes = free_main_memory_bytes()
    return ReconstructionEstimate(
        photographs=photographs,
        mapper=chosen_mapper(photographs, options),
        chunks=options.chunks(photographs),
        seconds=sum(estimated_cost(photographs, photo_px, options)) / MEASURED_CORES * cores_factor(),
        peak_bytes=peak_bytes(photographs, photo_px, options),
        free_bytes=free_bytes,
        refusal=why_too_large(photographs, photo_px, options, free_bytes) or "",
    )


class ReconstructionCost(NamedTuple):
    """Seconds of one core for the steps of a reconstruction."""

    features_s: float
    matching_s: float
    mapping_s: float


def estimated_cost(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> ReconstructionCost:
    """Return about how many seconds one core needs for each step."""
    doubled = options.doubles(photo_px)
    megapixels = photo_px[0] * photo_px[1] / _shrink(photo_px, options) ** 2 / 1e6
    every = photographs * (photographs - 1) / 2
    # Half of the largest number of neighbours: most pairs are chosen by both of their images.
    pairs = every if options.pairs == "exhaustive" else min(every, photographs * options.max_neighbors / 2)
    found = megapixels * (_FEATURES_MEGAPIXEL if doubled else _OWN_SIZE_FEATURES_MEGAPIXEL)
    compared = pairs * min(found, options.max_features) / _PAIR_FEATURES
    work = Work(photographs=photographs, megapixels=photographs * megapixels, pairs=compared)
    steps = ("features" if doubled else "features at own size", "matching", "mapping")
    return ReconstructionCost(*(MEASURED_CORES * COSTS[step].of(work) for step in steps))


def _shrink(photo_px: tuple[int, int], options: SfmOptions) -> float:
    """Return the factor, at least 1, by which the images are smaller that features are detected in."""
    return max(max(photo_px) / options.max_image_size, 1.0)


def chunk_peak_bytes(photo_px: tuple[int, int], options: SfmOptions, threads: int = 1) -> int:
    """Return the peak of a process that detects or matches features in so many threads."""
    pixels = photo_px[0] * photo_px[1]
    detection = _DETECTION_BYTES_PX if options.doubles(photo_px) else _OWN_SIZE_DETECTION_BYTES_PX
    a_thread = _PHOTO_BYTES_PX * pixels + detection * pixels / _shrink(photo_px, options) ** 2
    return int(_FIXED_BYTES + threads * a_thread)


def peak_bytes(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> int:
    """Return the peak of the memory of a reconstruction on this machine: of its features or of its mapping."""
    features = chunk_peak_bytes(photo_px, options, chosen_threads(options.threads))
    a_photograph = (_FEATURE_BYTES * _FOUND + _OBSERVATION_BYTES * _OBSERVED) * options.max_features
    return max(features, int(_FIXED_BYTES + photographs * a_photograph))


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
