"""Training in blocks: plan, solution and scaffold once, the blocks as jobs of the engine, and the merged model.

The second module of stage `train`, for surveys that one training does not hold. Its product is that of `train`.
Each block is a command over the workspace whose repetition completes it. Finished blocks are kept, and interrupted
ones continue from their checkpoints.

The merged model has of each block the Gaussians in its cell, and the solution that was frozen in all blocks. Its
internal precision is the disagreement of neighbouring blocks. A view that shows the overlap of two blocks is
rendered twice: with the Gaussians of either block, and the scaffold around it. Where both renders show a surface in
the overlap, their depths and colours are compared.
"""

import json
import logging
import math
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pipelines.core import stages
from pipelines.core.errors import GeorefError
from pipelines.core.files import file_size
from pipelines.core.options import CONFIG_FILE, REQUESTS
from pipelines.core.products import save_json
from pipelines.core.progress import Progress
from pipelines.core.stages import PLAN_BLOCKS, SOLVE, TRAIN_BLOCK, TRAIN_SCAFFOLD, TRAIN_SEAMS
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import read_sparse
from pipelines.formats.splat_ply import join_splat_plys
from pipelines.geometry.cameras import pose_matrix
from pipelines.geometry.statistics import mad_sigma
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import failed_of
from pipelines.splat.gaussians import Gaussians, read_gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.splat.surface import measured_depth
from pipelines.survey.block_plan import BlockPlan, BlockRecord, BlockTraining, MergedBlock, PlannedBlock, Seam
from pipelines.survey.photographs import pinhole_of
from pipelines.survey.solution import Solution, TrainedModel, read_solution
from pipelines.train.blocks.parts import UPSTREAM, Parts
from pipelines.train.options import TrainOptions
from pipelines.train.schedule import BACKGROUND
from pipelines.train.solution_state import figures_of

log = logging.getLogger(__name__)


def run(stage: StageRun, options: TrainOptions) -> Summary:
    """Train what is not trained, write the merged model, and return its key figures; see `train_blocks`."""
    parts, force, note = Parts(stage.workspace, options), stage.afresh, stage.record_progress
    plan = train_blocks(parts, stage.progress, force=force, note=note)
    if force or parts.why_missing(TRAIN_SEAMS):
        largest = max(block.peak_bytes for block in plan.blocks)
        _run_jobs("seams", [_job(parts, "seams", "seams", largest, force=force)], stage.progress, note)
    return merge_blocks(parts, plan, stage.out, stage.progress)


def train_blocks(
    parts: Parts, progress: Progress, *, force: bool = False, note: Callable[[str], None] = lambda _text: None
) -> BlockPlan:
    """Bring plan, solution, scaffold and all blocks up to date, and return the plan.

    Args:
        note: receives how far the work has come, after each block (`2 of 4 blocks`).

    Raises:
        KeyboardInterrupt: the user asked to stop; the blocks that ran have saved their work.
        GeorefError: a part fails; the blocks that have ended are kept.
    """
    parts.run(PLAN_BLOCKS, force=force, progress=progress)
    parts.run(SOLVE, force=force, progress=progress)
    plan = parts.plan()
    log.info("train: %d blocks", len(plan.blocks))
    if force or parts.why_missing(TRAIN_SCAFFOLD):
        least = min(block.peak_bytes for block in plan.blocks)
        _run_jobs("scaffold", [_job(parts, "scaffold", "scaffold", least, force=force)], progress, note)
    jobs = [
        _job(parts, f"block {block.id}", str(block.id), block.peak_bytes, force=force)
        for block in sorted(plan.blocks, key=lambda block: -block.gaussians)  # the largest first
        if force or parts.why_missing(TRAIN_BLOCK, block.id)
    ]
    _run_jobs("blocks", jobs, progress, note)
    return plan


def _job(parts: Parts, name: str, part: str, peak_bytes: int, *, force: bool) -> Job:
    """Return a job of `georef train --part`; a part is named as the folder of its product in `blocks/`."""
    root, shared = parts.workspace.root.absolute(), parts.variant().root.absolute()
    read = [root / name for name in (*(spec.folder for spec in UPSTREAM), REQUESTS, CONFIG_FILE)]
    read += [shared / spec.folder for spec in (PLAN_BLOCKS, SOLVE, TRAIN_SCAFFOLD)]
    if part == TRAIN_SEAMS.folder:
        read += [shared / str(block.id) for block in parts.plan().blocks]
    return Job(
        name,
        ("train", str(root), "--part", part, *(("--force",) if force else ())),
        peak_bytes,
        uses_gpu=parts.on_gpu(),
        folder=root,
        writes=shared / part,
        reads=tuple(path for path in read if path.exists() and path != shared / part),
    )


def _run_jobs(title: str, jobs: Sequence[Job], progress: Progress, note: Callable[[str], None]) -> None:
    """Run jobs to their ends; those that have failed are an error, which names them."""
    done = 0

    def ended(end: JobEnd) -> None:
        nonlocal done
        if end.is_done:
            done += 1
            note(f"{done} of {len(jobs)} {title}")

    if failed := failed_of(title, jobs, ended, progress):
        reasons = "; ".join(f"{end.job.name}: {end.error}" for end in failed)
        raise GeorefError(
            "blocks-failed",
            f"{len(failed)} of {len(jobs)} {title} failed ({reasons}).",
            remedy="Run the same command again to train them.",
        )


_VIEWS = 4  # in which a seam is measured
_CANDIDATES = 16  # views from which they are chosen, by small renders
_CANDIDATE_PX = 80  # longest side of a small render
_IMAGE_PX = 640  # longest side of a render that is measured
_SOLID = 0.9  # least alpha of a surface
_LEAST_PIXELS = 200  # of a seam: fewer tell nothing


def compare_neighbours(parts: Parts, plan: BlockPlan, solution: Solution, progress: Progress) -> tuple[Seam, ...]:
    """Return the disagreement of all neighbouring blocks whose overlap is shown by a view."""
    pairs = [pair for pair in combinations(plan.blocks, 2) if pair[0].region.meets(pair[1].region)]
    if not pairs:
        return ()
    views = SeamViews(parts, plan, solution)
    seams = []
    with progress.task("seams", len(pairs)) as task:
        for first, second in pairs:
            seams.append(views.seam(first, second))
            task.advance()
    return tuple(seam for seam in seams if seam is not None)


@dataclass(frozen=True)
class _View:
    """Render of one block: colour (H, W, 3), depth (H, W) in metres, mask (H, W) of surface in both regions."""

    colour: Tensor
    depth_m: FloatArray
    shared: BoolArray


class SeamViews:
    """Views of the overlaps of trained blocks, rendered by the models of the blocks.

    Memory holds the Gaussians of few blocks at a time.
    """

    def __init__(self, parts: Parts, plan: BlockPlan, solution: Solution) -> None:
        self._parts, self._plan = parts, plan
        self._backend: Rasterizer = rasterizer(parts.options.backend, mip_filter=parts.options.mip_filter)
        self._device = self._backend.device
        self._poses = solution.poses
        self._sfm = solution.with_lenses(read_sparse(parts.workspace.path(stages.SPARSE)))
        self._index = self._sfm.image_index()
        self._scaffold = read_gaussians(parts.variant().path(stages.SCAFFOLD))
        self.model_of = lru_cache(2)(self._model_of)

    def seam(self, first: PlannedBlock, second: PlannedBlock) -> Seam | None:
        """Return the disagreement of two blocks; None if no view shows enough of their overlap."""
        depths, colours, views = [], [], 0
        common = sorted(set(first.cameras) & set(second.cameras))
        common = common[:: max(1, len(common) // _CANDIDATES)]
        shared_px = {
            name: int(self._view(first, name, _CANDIDATE_PX, (first, second)).shared.sum()) for name in common
        }
        for name in sorted(common, key=lambda name: -shared_px[name])[:_VIEWS]:
            if not shared_px[name]:
                break
            one, other = (self._view(block, name, _IMAGE_PX, (first, second)) for block in (first, second))
            both = one.shared & other.shared
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

    def _view(self, block: PlannedBlock, name: str, size_px: int, pair: tuple[PlannedBlock, PlannedBlock]) -> _View:
        index = self._index[name]
        pinhole = pinhole_of(self._sfm.camera_of(index), min(size_px, self._parts.options.effort.max_image_size))
        matrix = pose_matrix(self._poses.cam_from_model[index], self._poses.cam_center_in_model[index])
        pose = torch.as_tensor(matrix, dtype=torch.float32, device=self._device)
        gaussians = self.model_of(block.id)
        with torch.no_grad():
            view = self._backend.render(gaussians, pose, pinhole, RasterSettings(gaussians.sh_degree, depth=True))
        depth = measured_depth(view).cpu().double().numpy()
        solid = (view.alpha > _SOLID).cpu().numpy() & (depth > 0)
        points = (pinhole.points_at(depth) - matrix[:3, 3]) @ matrix[:3, :3]
        inside = np.all([one.region.contains(points) for one in pair], axis=0)
        return _View(view.colour.clamp(0, 1), depth, solid & inside.reshape(depth.shape))

    def _model_of(self, number: int) -> Gaussians:
        """Return the Gaussians of a block, with the scaffold's outside of its region, on the device."""
        block = read_gaussians(self._parts.variant(number).path(stages.BLOCK_GAUSSIANS))
        around = ~self._plan.block(number).region.contains(self._scaffold.means.double().numpy())
        return Gaussians.concatenate([block, self._scaffold.select(torch.from_numpy(around))]).to(self._device)


def merge_blocks(parts: Parts, plan: BlockPlan, folder: Path, progress: Progress) -> Summary:
    """Write the product of `train` from a plan's blocks, and return its key figures; an InputError: unreadable."""
    trainings = parts.trainings(plan)
    # The Gaussians of each cell, adapted to those of its neighbours.
    cells = [parts.variant().root / stages.TRAIN_SEAMS.folder / f"{block.id}.ply" for block in plan.blocks]
    count = join_splat_plys(cells, folder / "gaussians.ply", mip_filter=parts.options.mip_filter)
    solution = read_solution(parts.variant(), stages.SOLUTION)
    model = TrainedModel(
        **dict(solution),
        max_image_size=parts.options.effort.max_image_size,
        background=BACKGROUND,
        sh_degree=read_gaussians(cells[0], slice(0, 1)).sh_degree,
        iterations=max(training.iterations for training in trainings),
        gaussians=count,
        backend=trainings[0].backend,
        mip_filter=parts.options.mip_filter,
    )
    save_json(model, folder / Path(stages.MODEL).name)
    # Blocks keep the adjustment of init-sim3, and with it the covariances.
    shutil.copyfile(parts.workspace.path(stages.SIM3_POSTERIOR), folder / Path(stages.TRAIN_POSTERIOR).name)
    _write_metrics(parts, plan, folder / "metrics.jsonl")
    seams = compare_neighbours(parts, plan, solution, progress)
    pairs = zip(plan.blocks, trainings, strict=True)
    blocks = tuple(MergedBlock(cell=block.cell, training=training) for block, training in pairs)
    save_json(BlockRecord(blocks=blocks, seams=seams), folder / "blocks.json")
    return _summary(model, trainings, seams)


def _write_metrics(parts: Parts, plan: BlockPlan, path: Path) -> None:
    """Write metrics of the whole: means over the blocks, and sums of Gaussians and seconds."""
    by_iteration: dict[int, list[dict[str, float]]] = {}
    for block in plan.blocks:
        source = parts.variant(block.id).path("block/metrics.jsonl")
        file_size(source)
        for line in source.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            by_iteration.setdefault(int(row["iteration"]), []).append(row)
    with path.open("w", encoding="utf-8") as lines:
        for iteration, rows in sorted(by_iteration.items()):
            if len(rows) == len(plan.blocks):
                means = {name: float(np.mean([row[name] for row in rows])) for name in ("photometric", "psnr")}
                sums = {name: sum(row[name] for row in rows) for name in ("seconds", "gaussians")}
                lines.write(json.dumps({"iteration": iteration, **means, **sums}) + "\n")


def _summary(model: TrainedModel, trainings: Sequence[BlockTraining], seams: Sequence[Seam]) -> Summary:
    psnr = float(np.average([t.train_psnr for t in trainings], weights=[t.photographs for t in trainings]))
    values = {
        "blocks": len(trainings),
        "iterations": model.iterations,
        "gaussians": model.gaussians,
        "train_psnr": round(psnr, 3),
        "seconds": round(sum(training.seconds for training in trainings), 1),
        **figures_of(model),
    }
    key_figure = f"{model.gaussians} gaussians in {len(trainings)} blocks, train PSNR {psnr:.2f} dB"
    if seams:
        squares = np.square([[seam.depth_nmad_m for seam in seams], [seam.colour_rms for seam in seams]])
        pooled = np.average(squares, axis=1, weights=[seam.pixels for seam in seams])
        spread, colour_rms = map(math.sqrt, pooled.tolist())
        values |= {
            "seams": len(seams),
            "seam_depth_nmad_m": round(spread, 5),
            "seam_depth_shift_m": round(max(abs(seam.depth_median_m) for seam in seams), 5),
            "seam_colour_rms": round(colour_rms, 5),
        }
        key_figure += f", neighbours agree to {spread:.3f} m"
    return Summary(key_figure, values, cautions=model.cautions)
