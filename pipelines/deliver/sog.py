"""Export of the splat as streamed SOG, PlayCanvas' format with levels of detail, with a sidecar.

Reads `ingest/survey.json`, `train/model.json` and `train/gaussians.ply`, or the cleaned model. Writes
`sog/lod-meta.json`, a folder for each unit of a level, such as `sog/0_0`, and the sidecar of the first
(docs/deliverables.md).

Level 0 has all Gaussians, each further one at most half as many, merged in the cells of a grid. All levels share
one tree of boxes, whose leaves a viewer shows each at its own level. Leaves that follow each other share a unit.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import SOG
from pipelines.core.types import FloatArray, IntArray, rows_of
from pipelines.core.workspace import StageRun, Summary
from pipelines.deliver.options import ExportSogOptions
from pipelines.deliver.placement import require_space
from pipelines.deliver.ply import ENU_FROM_AXES
from pipelines.deliver.splat import PlacedSplat, codec_arrays, load_splat, splat_values
from pipelines.formats.georef_sidecar import write_sidecar
from pipelines.formats.sog import MOST_IN_UNIT, SogNode, SogRows, write_sog, write_sog_index
from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import transformed
from pipelines.splat.level_of_detail import bounds_of, coarser, mixture_of

_MOST_IN_LEAF = 16_384  # Gaussians of level 0, a quarter of a unit
_LEAST_IN_LEVEL = 4096  # Gaussians of the coarsest level, about
_MOST_LEVELS = 8
_MOSTLY = 98.0  # percentage of the Gaussians whose positions are rounded by no more than is told
_BYTES = 80  # a Gaussian, in all levels


@dataclass(frozen=True)
class WrittenSog:
    """Gaussians of each level, number of units, and metres by which 98 % of level 0 are rounded at most."""

    levels: tuple[int, ...]
    units: int
    rounding_m: float


def run(stage: StageRun, options: ExportSogOptions) -> Summary:
    """Write the units, their index and its sidecar, and return their key figures; errors as of `load_splat`."""
    splat = load_splat(stage.workspace, options)
    count = len(splat.gaussians)
    advice = "give a lower --sh-degree or a larger --min-opacity"
    require_space(stage.out, _BYTES * count, f"levels of {count} Gaussians", advice)
    written = write_streamed(stage.out, splat, options, stage.progress)
    size = sum(path.stat().st_size for path in stage.out.rglob("*") if path.is_file())
    values = {
        **splat_values(splat),
        "levels": list(written.levels),
        "units": written.units,
        "rounding_m": written.rounding_m,
        "bytes": size,
    }
    figure = f"{count} Gaussians, {len(written.levels)} levels, {size / 2**20:.1f} MiB"
    return Summary(figure, values, cautions=splat.placement.cautions)


def write_streamed(
    folder: Path, splat: PlacedSplat, options: ExportSogOptions, progress: Progress = SILENT
) -> WrittenSog:
    """Write a splat in levels of detail into a folder, with its index and sidecar, and return its figures."""
    axes = ENU_FROM_AXES[options.up]
    arrays = codec_arrays(transformed(splat.gaussians, Similarity(1.0, axes.T)), options.sh_degree)
    levels = [arrays, *_coarser_levels(arrays)]
    counts = tuple(map(len, levels))
    rounding_m: list[FloatArray] = []
    with progress.task("units", sum(counts)) as task:
        units = _Units(folder, levels, mip_filter=splat.mip_filter)
        root = units.tree([np.arange(count) for count in counts])
        for level, rounded_m in units.write():
            rounding_m += [rounded_m] if level == 0 else []
            task.advance(len(rounded_m))
    index = folder / Path(SOG).name
    write_sog_index(index, units.names, list(counts), root)
    write_sidecar(splat.placement.sidecar(axes), index)
    return WrittenSog(counts, len(units.names), float(np.percentile(np.concatenate(rounding_m), _MOSTLY)))


def _coarser_levels(splat: SplatArrays) -> Iterator[SplatArrays]:
    for _, level in zip(range(_MOST_LEVELS - 1), coarser(splat, _LEAST_IN_LEVEL), strict=False):
        yield level


class _Units:
    """Tree over all levels of a splat, and the units that its leaves fill one after the other.

    Attributes:
        names: folders of the units.
    """

    def __init__(self, folder: Path, levels: list[SplatArrays], *, mip_filter: bool) -> None:
        self.names: list[str] = []
        self._folder, self._levels, self._mip_filter = folder, levels, mip_filter
        self._rows: list[list[IntArray]] = []  # of each unit, by leaf
        self._level_of: list[int] = []
        self._filling: dict[int, int] = {}  # the unit of a level that has room

    def tree(self, rows: list[IntArray]) -> SogNode:
        """Return the box of rows of each level: cut in two at the median along its longest side, or a leaf."""
        means = self._levels[0].means[rows[0]]
        if len(means) > _MOST_IN_LEAF:
            axis = int(np.ptp(means, axis=0).argmax())
            border = np.median(means[:, axis])
            sides = [self._levels[level].means[part, axis] < border for level, part in enumerate(rows)]
            if not sides[0].any():  # half of them are at one place
                sides[0][: len(means) // 2] = True
            below = [part[side] for part, side in zip(rows, sides, strict=True)]
            above = [part[~side] for part, side in zip(rows, sides, strict=True)]
            children = (self.tree(below), self.tree(above))
            return SogNode(_around([child.bounds for child in children]), children)
        shown = [(level, part) for level, part in enumerate(rows) if len(part)]
        bounds = _around([bounds_of(mixture_of(rows_of(self._levels[level], part))) for level, part in shown])
        return SogNode(bounds, (), {level: self._placed(level, part) for level, part in shown})

    def _placed(self, level: int, rows: IntArray) -> SogRows:
        """Return the place of a leaf's rows in a unit of their level."""
        unit = self._filling.get(level)
        if unit is None or sum(map(len, self._rows[unit])) + len(rows) > MOST_IN_UNIT:
            unit = self._filling[level] = len(self._rows)
            self.names.append(f"{level}_{self._level_of.count(level)}")
            self._level_of.append(level)
            self._rows.append([])
        first = sum(map(len, self._rows[unit]))
        self._rows[unit].append(rows)
        return SogRows(unit, first, len(rows))

    def write(self) -> Iterator[tuple[int, FloatArray]]:
        """Write one unit after the other, and yield its level and by how much positions are rounded, in metres."""
        for name, level, parts in zip(self.names, self._level_of, self._rows, strict=True):
            content = rows_of(self._levels[level], np.concatenate(parts))
            yield level, write_sog(self._folder / name, content, mip_filter=self._mip_filter)


def _around(boxes: list[FloatArray]) -> FloatArray:
    both = np.stack(boxes)
    return np.stack([both[:, 0].min(axis=0), both[:, 1].max(axis=0)])
