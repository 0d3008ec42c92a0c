"""Training in blocks: plan, solution and scaffold once, the blocks as jobs of the engine, and the merged model.

The second module of stage `train`, for surveys that one training does not hold. Its product is that of `train`.
Each block is a command over the workspace whose repetition completes it. Finished blocks are kept, and interrupted
ones continue from their checkpoints.
"""

import logging
from collections.abc import Callable, Sequence

from pipelines.core.errors import GeorefError
from pipelines.core.options import CONFIG_FILE, REQUESTS
from pipelines.core.progress import Progress
from pipelines.core.stages import PLAN_BLOCKS, SOLVE, TRAIN_BLOCK, TRAIN_SCAFFOLD, TRAIN_SEAMS
from pipelines.core.workspace import StageRun, Summary
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import failed_of
from pipelines.survey.block_plan import BlockPlan
from pipelines.train.blocks.merge import merge_blocks
from pipelines.train.blocks.parts import UPSTREAM, Parts
from pipelines.train.options import TrainOptions

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
