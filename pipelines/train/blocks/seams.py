"""Training across the seams: Gaussians along the sides of cells are adapted to those on the other side.

Each block was trained with Gaussians of its own beyond its cell. The merged model has the neighbour's there, which
lie elsewhere: along a seam, there are gaps and duplicates. Each strip along a seam is therefore trained for some
iterations, with the Gaussians of all blocks in it; those around the strip are frozen. No Gaussian is added or
removed.

Reads the survey, the SfM model, the initial similarity, the plan, the solution, the scaffold, and the Gaussians of
the blocks. Writes `<number>.ply` with the Gaussians of each cell. An interrupted run goes on at the next seam.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch

from pipelines.core.files import replace_text
from pipelines.core.products import load_json
from pipelines.core.progress import deferred_interrupts
from pipelines.core.stages import BLOCK_GAUSSIANS, BLOCK_PLAN, SCAFFOLD, SOLUTION
from pipelines.core.workspace import StageRun, Summary
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.splat.rasterizer.api import Rasterizer
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.survey.block_plan import BlockCell, BlockPlan, PlannedBlock
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import SparseScene, load_solved_scene, photographs
from pipelines.survey.solution import Solution
from pipelines.train.georeference.problem import frozen_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.options import SeamOptions
from pipelines.train.region import SceneBox, TrainingRegion, region_masks
from pipelines.train.solution_state import frozen_exposures
from pipelines.train.trainer import make_finisher

_SHARE = 0.2  # of a block's iterations, for a strip
_WIDTH = 0.5  # of a strip on each side of the seam, over the width of the blocks' overlap
_LEAST_VIEWS = 2
_DONE = "done.txt"  # number of trained seams


def run(stage: StageRun, options: SeamOptions) -> Summary:
    """Train all seams, and return their figures; a KeyboardInterrupt: asked to stop; those that ended are kept."""
    workspace, backend, done = (
        stage.workspace,
        rasterizer(options.backend, mip_filter=options.mip_filter),
        stage.out / _DONE,
    )
    plan = load_json(BlockPlan, workspace.path(BLOCK_PLAN))
    solution, survey, scene = load_solved_scene(workspace, SOLUTION)
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    if not stage.resumed or not done.is_file():
        for block in plan.blocks:
            gaussians = read_gaussians(workspace.root / str(block.id) / BLOCK_GAUSSIANS)
            inside = block.cell.contains(gaussians.means.double().numpy())
            write_gaussians(_file(stage.out, block.id), gaussians.select(torch.from_numpy(inside)))
        replace_text(done, "0")
    scaffold = read_gaussians(workspace.path(SCAFFOLD))
    trainer = _SeamTrainer(stage.out, plan, solution, scene, images, scaffold, backend, options)
    seams = list(seams_of(plan))
    with stage.progress.task("seams", len(seams)) as task, deferred_interrupts() as stop:
        for number, (first, second, strip) in enumerate(seams):
            if number >= int(done.read_text(encoding="utf-8")):
                trainer.train(first, second, strip)
                replace_text(done, str(number + 1))
                stage.record_progress(f"{number + 1} of {len(seams)} seams")
            task.advance()
            if stop.requested:
                raise KeyboardInterrupt
    count = sum(len(read_gaussians(_file(stage.out, block.id))) for block in plan.blocks)
    values = {"seams": len(seams), "gaussians": count}
    return Summary(f"{len(seams)} seams of {len(plan.blocks)} blocks, {count} Gaussians", values)


def _file(folder: Path, block: int) -> Path:
    return folder / f"{block}.ply"


def seams_of(plan: BlockPlan) -> Iterator[tuple[PlannedBlock, PlannedBlock, BlockCell]]:
    """Yield the pairs of blocks that have a strip along their common side, and the strip.

    Blocks that share a corner only have none.
    """
    for first, second in combinations(plan.blocks, 2):
        half = _WIDTH * np.minimum(first.margin_m, second.margin_m)
        touching = sum(_touches(first.cell, second.cell, axis) for axis in (0, 1))
        strip = first.cell.widened(half).common(second.cell.widened(half))
        if touching == 1 and (half > 0).all() and strip is not None:
            yield first, second, strip


def _touches(first: BlockCell, second: BlockCell, axis: int) -> bool:
    """Return whether one cell ends where the other begins on an axis."""
    return (first.high[axis] is not None and first.high[axis] == second.low[axis]) or (
        second.high[axis] is not None and second.high[axis] == first.low[axis]
    )


@dataclass(frozen=True)
class _SeamTrainer:
    """Trainer of strips, with the folder of the cells' Gaussians and the inputs that all strips share."""

    folder: Path
    plan: BlockPlan
    solution: Solution
    scene: SparseScene
    images: ImageCache
    scaffold: Gaussians
    backend: Rasterizer
    options: SeamOptions

    def train(self, first: PlannedBlock, second: PlannedBlock, strip: BlockCell) -> None:
        """Train the Gaussians of a strip, and write them into the files of their cells."""
        around = strip.widened(_WIDTH * np.minimum(first.margin_m, second.margin_m))
        near = [block.id for block in self.plan.blocks if block.cell.meets(around)]
        parts = {number: read_gaussians(_file(self.folder, number)) for number in near}
        together = Gaussians.concatenate(list(parts.values()))
        means = together.means.double().numpy()
        in_strip = strip.contains(means)
        frozen = together.select(torch.from_numpy(around.contains(means) & ~in_strip))
        beyond = torch.from_numpy(~around.contains(self.scaffold.means.double().numpy()))
        surroundings = Gaussians.concatenate([frozen, self.scaffold.select(beyond)])
        rows = torch.from_numpy(in_strip)
        cameras = sorted({*first.cameras, *second.cameras})
        trained = self._trained(cameras, strip, together.select(rows), surroundings)
        if trained is None:
            return
        for name, values in together.tensors().items():
            values[rows] = trained.tensors()[name]
        ends = np.cumsum([len(part) for part in parts.values()])
        for (number, part), end in zip(parts.items(), ends.tolist(), strict=True):
            if in_strip[end - len(part) : end].any():
                changed = together.select(torch.arange(end - len(part), end))
                write_gaussians(_file(self.folder, number), changed)

    def _trained(
        self, names: list[str], strip: BlockCell, start: Gaussians, surroundings: Gaussians
    ) -> Gaussians | None:
        """Return the Gaussians of a strip after their training; None if too few views show the strip."""
        if not len(start):
            return None
        scene, device = self.scene, self.backend.device
        index = scene.sparse.image_index()
        train = np.array([index[name] for name in names if name in index], dtype=np.int64)
        everything = Gaussians.concatenate([start, surroundings]).to(device)
        masks = region_masks(self.solution, train, self.images, self.backend, cell=strip, stand_in=everything)
        seeing = masks.seeing
        if len(seeing) < _LEAST_VIEWS:
            return None
        box = SceneBox.around(scene.point_in_model)
        region = TrainingRegion(strip, box, surroundings.to(device), start.select(torch.zeros(0).long()), masks)
        iterations = max(int(_SHARE * self.options.effort.iterations), 1)
        trainer = make_finisher(
            TrainingScene(replace(scene, train=seeing), self.images, None, region),
            start.to(device),
            frozen_problem(self.solution, scene),
            backend=self.backend,
            options=self.options.model_copy(update={"iterations": iterations}),
            exposures=frozen_exposures(self.solution, device),
        )
        for _ in range(iterations):
            trainer.step()
        trainer.watch.check()
        return trainer.optimizer.gaussians.detached().to(torch.device("cpu"))
