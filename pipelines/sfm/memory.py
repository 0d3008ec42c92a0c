"""Memory of a reconstruction: the peak that COLMAP will take, predicted before it starts."""

from __future__ import annotations

from pipelines.core.errors import ResourceError
from pipelines.core.machine import chosen_threads
from pipelines.sfm.mapping import chosen_mapper
from pipelines.sfm.options import SfmOptions

_USABLE = 0.9  # of the free memory: other programs grow, too
_FIXED_BYTES = 300 << 20  # interpreter, libraries, reserves of the allocator

# Bytes a pixel of the photograph, and of the image that features are detected in, by thread: measured with
# photographs of 2.3 and 20.9 megapixels at 600, 1200 and 2400 px, where they are 1.04 to 1.28 times the growth.
# Photographs that are not doubled: 79 to 91 bytes at 1200, 1600 and 3200 px.
_PHOTO_BYTES_PX, _DETECTION_BYTES_PX, _OWN_SIZE_DETECTION_BYTES_PX = 4.0, 310.0, 95.0

# Mapping and the adjustments after it, of the global mapper, which needs more than the incremental one
# (`examples/benchmarks/many_photographs.py`; docs/benchmarks.md has the runs).
_FEATURE_BYTES = 133.0
_OBSERVATION_BYTES = 2500.0
# Features that COLMAP finds and observations of points, as multiples of `--max-features`: eight surveys had up to
# 1.5 and, with real photographs, 0.14 to 0.32.
_FOUND, _OBSERVED = 1.5, 0.35


def chunk_peak_bytes(photo_px: tuple[int, int], options: SfmOptions, threads: int = 1) -> int:
    """Return the peak of a process that detects or matches features.

    Args:
        photo_px: width and height of the largest photographs.
        options: of the stage.
        threads: of the process.
    """
    pixels = photo_px[0] * photo_px[1]
    shrink = max(max(photo_px) / options.max_image_size, 1.0)
    detection = _DETECTION_BYTES_PX if options.doubles(photo_px) else _OWN_SIZE_DETECTION_BYTES_PX
    a_thread = _PHOTO_BYTES_PX * pixels + detection * pixels / shrink**2
    return int(_FIXED_BYTES + threads * a_thread)


def mapping_peak_bytes(photographs: int, options: SfmOptions) -> int:
    """Return the peak of mapping and the adjustments after it.

    Args:
        photographs: number of photographs.
        options: of the stage.
    """
    a_photograph = (_FEATURE_BYTES * _FOUND + _OBSERVATION_BYTES * _OBSERVED) * options.max_features
    return int(_FIXED_BYTES + photographs * a_photograph)


def peak_bytes(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> int:
    """Return the peak of the memory of a reconstruction on this machine; 0 for an imported model.

    Args:
        photographs: number of photographs.
        photo_px: width and height of the largest.
        options: of the stage.
    """
    if options.import_model is not None:
        return 0
    features = chunk_peak_bytes(photo_px, options, chosen_threads(options.threads))
    return max(features, mapping_peak_bytes(photographs, options))


def why_too_large(
    photographs: int, photo_px: tuple[int, int], options: SfmOptions, free_bytes: int | None
) -> str | None:
    """Return why a reconstruction would not fit into the free memory, and what would; None: it fits.

    Args:
        photographs: number of photographs.
        photo_px: width and height of the largest.
        options: of the stage.
        free_bytes: from `free_main_memory_bytes`; None: unknown, everything fits.
    """
    needed = peak_bytes(photographs, photo_px, options)
    if free_bytes is None or needed <= _USABLE * free_bytes:
        return None
    fewer = options.max_features
    while fewer > 1000 and peak_bytes(photographs, photo_px, _with(options, fewer)) > _USABLE * free_bytes:
        fewer -= 500
    fits = peak_bytes(photographs, photo_px, _with(options, fewer)) <= _USABLE * free_bytes
    advice = f"use --max-features {fewer}" if fits else "reconstruct elsewhere and use --import"
    mapper = chosen_mapper(photographs, options)
    return (
        f"SfM of {photographs} photographs needs about {_gib(needed)} at its peak ({mapper} mapper, "
        f"{options.max_features} features a photograph) and {_gib(free_bytes)} are free: {advice}, or a machine "
        "with more memory"
    )


def require_memory(
    photographs: int, photo_px: tuple[int, int], options: SfmOptions, free_bytes: int | None
) -> None:
    """Refuse a reconstruction that will not fit; the arguments are those of `why_too_large`.

    Raises:
        ResourceError: states the memory needed, and options that would fit.
    """
    reason = why_too_large(photographs, photo_px, options, free_bytes)
    if reason is not None:
        raise ResourceError(reason)


def _with(options: SfmOptions, max_features: int) -> SfmOptions:
    return options.model_copy(update={"max_features": max_features})


def _gib(size: float) -> str:
    return f"{size / 2**30:.1f} GiB"
