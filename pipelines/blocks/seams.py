"""Disagreement of neighbouring blocks where both were trained: the internal precision of the merged model.

A view that shows the overlap of two blocks is rendered twice: with the Gaussians of either block, and the scaffold
around it. Where both renders show a surface in the overlap, their depths and colours are compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from pipelines.blocks.parts import Parts
from pipelines.core.progress import Progress
from pipelines.core.stages import BLOCK_GAUSSIANS, SCAFFOLD, SPARSE
from pipelines.core.types import BoolArray, FloatArray
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import Pinhole
from pipelines.robust.statistics import mad_sigma
from pipelines.scene.block_plan import BlockCell, BlockPlan, PlannedBlock
from pipelines.scene.block_record import Seam
from pipelines.scene.photographs import pinhole_of
from pipelines.scene.trained_model import Adjustment
from pipelines.splat.depth import measured_depth
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.rasterizer.backends import device_of, rasterizer
from pipelines.splat.storage import read_gaussians

_VIEWS = 4  # of a seam
_CANDIDATES = 16  # from which they are chosen, by small renders
_CANDIDATE_PX = 80
_IMAGE_PX = 640
_SOLID = 0.9  # alpha of a surface
_LEAST_PIXELS = 200  # of a seam: fewer tell nothing


def compare_neighbours(parts: Parts, plan: BlockPlan, solution: Adjustment, progress: Progress) -> tuple[Seam, ...]:
    """Return the disagreement of all neighbours whose overlap some view shows.

    Args:
        parts: of the training.
        plan: of the blocks, all of which are trained.
        solution: cameras and lenses.
        progress: counts the seams.

    Raises:
        InputError: a block or the scaffold cannot be read.
    """
    pairs = list(neighbours(plan))
    if not pairs:
        return ()
    views = SeamViews(parts, plan, solution)
    found = []
    with progress.task("seams", len(pairs)) as task:
        for first, second in pairs:
            seam = views.seam(first, second)
            found += [] if seam is None else [seam]
            task.advance()
    return tuple(found)


def neighbours(plan: BlockPlan) -> Iterator[tuple[PlannedBlock, PlannedBlock]]:
    """Yield the pairs of blocks whose regions have points in common."""
    for first, second in combinations(plan.blocks, 2):
        if first.region.meets(second.region):
            yield first, second


@dataclass(frozen=True)
class _View:
    """Render of one block in a view: colour (H, W, 3), depth (H, W) in metres, and the pixels in a region."""

    colour: Tensor
    depth_m: FloatArray
    counts: BoolArray


class SeamViews:
    """Views of the overlaps of trained blocks, rendered by the models of the blocks.

    Memory holds the Gaussians of few blocks at a time.

    Args:
        parts: of the training.
        plan: of the blocks.
        solution: cameras and lenses.
    """

    def __init__(self, parts: Parts, plan: BlockPlan, solution: Adjustment) -> None:
        self._parts, self._plan, self._solution = parts, plan, solution
        self._backend: Rasterizer = rasterizer(parts.options.backend)
        self._device = device_of(self._backend)
        self._poses = solution.poses
        self._sfm = solution.with_lenses(read_sparse(parts.workspace.path(SPARSE)))
        self._index = self._sfm.image_index()
        self._scaffold = read_gaussians(parts.whole.path(SCAFFOLD))
        self.model_of = lru_cache(2)(self._model_of)

    def seam(self, first: PlannedBlock, second: PlannedBlock) -> Seam | None:
        """Return the disagreement of two blocks; None if no view shows enough of their overlap."""
        depths, colours, views = [], [], 0
        for name in self._best_views(first, second):
            one, other = (self._view(block, name, _IMAGE_PX, (first, second)) for block in (first, second))
            both = one.counts & other.counts
            if not both.any():
                continue
            views += 1
            depths.append((other.depth_m - one.depth_m)[both])
            colours.append((other.colour - one.colour).square().mean(dim=-1).cpu().numpy()[both])
        differences = np.concatenate(depths) if depths else np.zeros(0)
        if len(differences) < _LEAST_PIXELS:
            return None
        return Seam(
            blocks=(first.id, second.id),
            views=views,
            pixels=len(differences),
            depth_median_m=float(np.median(differences)),
            depth_nmad_m=float(mad_sigma(differences)),
            colour_rms=float(np.sqrt(np.concatenate(colours).mean())),
        )

    def _best_views(self, first: PlannedBlock, second: PlannedBlock) -> list[str]:
        """Return the names of the views that show most of an overlap."""
        common = sorted(set(first.cameras) & set(second.cameras))
        common = common[:: max(1, len(common) // _CANDIDATES)]
        shown = {name: int(self._view(first, name, _CANDIDATE_PX, (first, second)).counts.sum()) for name in common}
        best = sorted(common, key=lambda name: -shown[name])[:_VIEWS]
        return [name for name in best if shown[name]]

    def _view(self, block: PlannedBlock, name: str, size_px: int, pair: tuple[PlannedBlock, PlannedBlock]) -> _View:
        index = self._index[name]
        pinhole = pinhole_of(self._sfm.camera_of(index), min(size_px, self._parts.options.effort.max_image_size))
        matrix = self._poses.matrix(index)
        pose = torch.as_tensor(matrix, dtype=torch.float32, device=self._device)
        gaussians = self.model_of(block.id)
        with torch.no_grad():
            view = self._backend.render(gaussians, pose, pinhole, RasterSettings(gaussians.sh_degree, depth=True))
        assert view.median_depth is not None and view.expected_depth is not None and view.depth_variance is not None
        measured = measured_depth(view.median_depth, view.expected_depth, view.depth_variance)
        depth = measured.cpu().double().numpy()
        solid = (view.alpha > _SOLID).cpu().numpy() & (depth > 0)
        inside = _in_all(depth, matrix, pinhole, [one.region for one in pair])
        return _View(view.colour.clamp(0, 1), depth, solid & inside)

    def _model_of(self, number: int) -> Gaussians:
        """Return the Gaussians of a block, with the scaffold outside of it, on the device."""
        own = read_gaussians(self._parts.of_block(number).path(BLOCK_GAUSSIANS))
        around = ~self._plan.block(number).region.contains(self._scaffold.means.double().numpy())
        return Gaussians.concatenate([own, self._scaffold.select(torch.from_numpy(around))]).to(self._device)


def _in_all(depth_m: FloatArray, pose: FloatArray, pinhole: Pinhole, cells: list[BlockCell]) -> BoolArray:
    """Return the pixels (H, W) whose surface lies in all cells.

    Args:
        depth_m: (H, W) along z.
        pose: (4, 4) cam ← model.
        pinhole: of H × W pixels.
        cells: in `model`.
    """
    points = (pinhole.points_at(depth_m) - pose[:3, 3]) @ pose[:3, :3]
    inside = np.all([cell.contains(points) for cell in cells], axis=0)
    return np.asarray(inside.reshape(depth_m.shape))
