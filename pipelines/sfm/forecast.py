"""Forecast of a reconstruction: mapper, chunks, time and memory for the photographs of a survey."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pipelines.core.machine import free_main_memory_bytes, thread_count
from pipelines.core.sentences import about
from pipelines.jobs.costs import ReconstructionPace, reconstruction_pace
from pipelines.sfm.chunks import is_chunked
from pipelines.sfm.mapping import MapperName, chosen_mapper
from pipelines.sfm.memory import peak_bytes, why_too_large
from pipelines.sfm.options import SfmOptions


@dataclass(frozen=True)
class ReconstructionForecast:
    """Forecast of a reconstruction.

    Attributes:
        photographs: number of photographs.
        mapper: that `auto` chooses, or the user.
        chunks: of features; 1: the survey is worked in one process.
        seconds: about, on this machine.
        peak_bytes: predicted peak of the memory.
        free_bytes: memory that is free; None: unknown.
        refusal: reason why it would not fit; empty: it fits.
    """

    photographs: int
    mapper: MapperName
    chunks: int
    seconds: float
    peak_bytes: int
    free_bytes: int | None
    refusal: str

    def sentences(self) -> list[str]:
        """Return the forecast for people: mapper, chunks, time and memory."""
        parts = "" if self.chunks == 1 else f", features and matches in {self.chunks} chunks each"
        free = "" if self.free_bytes is None else f" of {self.free_bytes / 2**30:.1f} GiB free"
        return [
            f"{self.photographs} photographs, {self.mapper} mapper{parts}",
            f"about {about(self.seconds)} on this machine; memory at most {self.peak_bytes / 2**30:.1f} GiB{free}",
        ]


def forecast(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> ReconstructionForecast | None:
    """Return the forecast of a reconstruction; None for an imported model.

    Args:
        photographs: number of photographs.
        photo_px: width and height of the largest.
        options: of the reconstruction.
    """
    if options.import_model is not None:
        return None
    free_bytes = free_main_memory_bytes()
    return ReconstructionForecast(
        photographs=photographs,
        mapper=chosen_mapper(photographs, options),
        chunks=math.ceil(photographs / options.chunk_size) if is_chunked(photographs, options) else 1,
        seconds=pace(photographs, photo_px, options).total_s / thread_count(),
        peak_bytes=peak_bytes(photographs, photo_px, options),
        free_bytes=free_bytes,
        refusal=why_too_large(photographs, photo_px, options, free_bytes) or "",
    )


def pace(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> ReconstructionPace:
    """Return about how many seconds one core needs for each step; arguments as for `forecast`."""
    shrink = max(max(photo_px) / options.max_image_size, 1.0)
    every = photographs * (photographs - 1) / 2
    # Half of the largest number of neighbours: most pairs are chosen by both of their images.
    pairs = every if options.pairs == "exhaustive" else min(every, photographs * options.max_neighbors / 2)
    return reconstruction_pace(
        photographs,
        photo_px[0] * photo_px[1] / shrink**2 / 1e6,
        pairs,
        doubled=options.doubles(photo_px),
        max_features=options.max_features,
    )
