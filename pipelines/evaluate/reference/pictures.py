"""Map and histogram of a comparison with a reference."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.stages import REFERENCE_HISTOGRAM, REFERENCE_MAP
from pipelines.evaluate.reference.comparison import ComparedReference
from pipelines.evaluate.reference.distances import CLASSES
from pipelines.plots.distances import write_distance_histogram, write_distance_map


def draw_reference(found: ComparedReference, folder: Path) -> None:
    """Write map and histogram of the distances along the normals; nothing if none was measured."""
    cores, lod_m = found.table.cores, found.table.lod_m
    known = np.isfinite(cores.distance_m)
    if not known.any():
        return
    distance_m, kind = cores.distance_m[known], cores.kinds.of_class[known]
    groups = {name: distance_m[kind == place] for place, name in enumerate(CLASSES) if (kind == place).any()}
    if len(groups) == 1:
        groups = {"all": distance_m}
    place, size_m = cores.position[known], found.comparison.cylinder_m
    write_distance_map(folder / REFERENCE_MAP.rpartition("/")[2], place[:, :2], distance_m, size_m)
    write_distance_histogram(
        folder / REFERENCE_HISTOGRAM.rpartition("/")[2], groups, float(np.median(lod_m[known]))
    )
