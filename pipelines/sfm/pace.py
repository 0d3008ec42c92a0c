"""Pace of the reconstruction: the time that COLMAP will take, before it starts."""

from __future__ import annotations

from dataclasses import dataclass

from pipelines.core.threads import thread_count
from pipelines.sfm.options import SfmOptions

# Four reconstructions of 18, 48, 48 and 40 photographs took 61, 134, 148 and 175 s, on 2 cores of an AMD EPYC
# beside other programs, 2026-11-22. This model says 49, 147, 125 and 103 s.
_MEASURED_CORES = 2
_FEATURES_MEGAPIXEL_S, _PAIR_S, _MAPPING_S = 1.2, 0.12, 0.8
# Of photographs that are not doubled: one of 0.8 megapixels takes 0.72 s on one core, doubled 2.15 s.
_OWN_SIZE_FEATURES_MEGAPIXEL_S = 0.45
# Features a megapixel of aerial photographs, about, and their number for which `_PAIR_S` holds: matching compares
# each feature of a photograph with each of the other.
_FEATURES_MEGAPIXEL, _OWN_SIZE_FEATURES_MEGAPIXEL, _PAIR_FEATURES = 6000, 3000, 5000


@dataclass(frozen=True)
class ReconstructionPace:
    """Seconds of one core for the steps of a reconstruction."""

    features_s: float
    matching_s: float
    mapping_s: float


def reconstruction_seconds(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> float:
    """Return about how many seconds features, matching and mapping will take on this machine.

    Args:
        photographs: number of photographs.
        photo_px: their width and height.
        options: of the reconstruction.
    """
    if options.import_model is not None:
        return 0.0
    pace = reconstruction_pace(photographs, photo_px, options)
    return (pace.features_s + pace.matching_s + pace.mapping_s) / thread_count()


def reconstruction_pace(photographs: int, photo_px: tuple[int, int], options: SfmOptions) -> ReconstructionPace:
    """Return about how many seconds one core needs for each step; arguments as for `reconstruction_seconds`."""
    shrink = max(max(photo_px) / options.max_image_size, 1.0)
    megapixels = photo_px[0] * photo_px[1] / shrink**2 / 1e6
    every = photographs * (photographs - 1) / 2
    # Half of the largest number of neighbours: most pairs are chosen by both of their images.
    pairs = every if options.pairs == "exhaustive" else min(every, photographs * options.max_neighbors / 2)
    doubles = options.doubles(photo_px)
    detection_s = _FEATURES_MEGAPIXEL_S if doubles else _OWN_SIZE_FEATURES_MEGAPIXEL_S
    found = megapixels * (_FEATURES_MEGAPIXEL if doubles else _OWN_SIZE_FEATURES_MEGAPIXEL)
    compared = (min(found, options.max_features) / _PAIR_FEATURES) ** 2
    return ReconstructionPace(
        features_s=_MEASURED_CORES * photographs * detection_s * megapixels,
        matching_s=_MEASURED_CORES * _PAIR_S * pairs * compared,
        mapping_s=_MEASURED_CORES * photographs * _MAPPING_S,
    )
