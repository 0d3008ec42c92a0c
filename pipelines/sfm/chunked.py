"""Features and matches of a large survey in chunks, as jobs of an engine, and their way into one database."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from pipelines.core.durable import remove, replace_text
from pipelines.core.errors import GeorefError
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.progress import Progress
from pipelines.core.sentences import listed
from pipelines.core.stages import SURVEY
from pipelines.core.workspace import StageRun
from pipelines.engine.chosen import failed_of
from pipelines.engine.job import Job, JobEnd
from pipelines.scene.survey import Survey
from pipelines.sfm.chunk_work import copy_finished
from pipelines.sfm.chunks import FOLDER, PLAN, Chunk, ChunkPlan, Kind, plan_chunks
from pipelines.sfm.colmap_database import FEATURES, MATCHES, remove_database, write_frame
from pipelines.sfm.features import SfmJob, candidate_pairs
from pipelines.sfm.memory import chunk_peak_bytes
from pipelines.sfm.options import SfmOptions

_TITLES: dict[Kind, str] = {
    "features": "chunks of features",
    "matches": "chunks of matches",
}


def work_in_chunks(stage: StageRun, survey: Survey, options: SfmOptions) -> ChunkPlan:
    """Compute features and matches in chunks that the engine in use shares out, and return their plan.

    Chunks that an earlier run has finished are kept.

    Args:
        stage: run of `sfm`; its partial product receives plan and chunks.
        survey: the photographs.
        options: of the stage.

    Raises:
        GeorefError: chunks have failed; the others are finished and kept.
        KeyboardInterrupt: the user stopped the run; the chunks have saved their work.
    """
    plan = plan_chunks(survey, candidate_pairs(survey, options), options)
    replace_text(stage.out / PLAN, plan.model_dump_json())
    for kind in _TITLES:
        _work(stage, survey, plan, kind)
    return plan


def _work(stage: StageRun, survey: Survey, plan: ChunkPlan, kind: Kind) -> None:
    """Run those chunks of a kind that are not finished.

    Raises:
        GeorefError: at least one has failed.
    """

    def ended(_: JobEnd) -> None:
        finished = sum(chunk.is_finished(stage.out) for chunk in plan.chunks)
        stage.record_progress(f"{finished} of {len(plan.chunks)} chunks")

    title = _TITLES[kind]
    waiting = [chunk for chunk in plan.of_kind(kind) if not chunk.is_finished(stage.out)]
    jobs = [_job(stage, survey, plan, chunk) for chunk in waiting]
    if failed := failed_of(title, jobs, ended, stage.progress):
        names = listed([end.job.name for end in failed])
        raise GeorefError(
            f"{len(failed)} of {len(jobs)} {title} failed ({names}): {failed[0].error}; the same command works on "
            "those again and keeps the others"
        )


def _job(stage: StageRun, survey: Survey, plan: ChunkPlan, chunk: Chunk) -> Job:
    """Return the command that works on a chunk, with all that it reads and writes."""
    root = stage.workspace.root.absolute()
    if chunk.kind == "features":
        images = photograph_folder(stage.workspace, survey.image_dir)
        reads = [images / survey.images[index].name for index in chunk.images]
    else:
        needed = set(chunk.images)
        reads = [
            features.database(stage.out)
            for features in plan.of_kind("features")
            if not needed.isdisjoint(features.images)
        ]
    return Job(
        chunk.name,
        ("sfm", str(root), "--chunk", chunk.name),
        chunk_peak_bytes(survey.largest_photograph_px, plan.options),
        folder=root,
        writes=chunk.folder(stage.out),
        reads=(stage.workspace.path(SURVEY), stage.out / PLAN, *reads),
    )


def join_chunks(colmap: Any, job: SfmJob, plan: ChunkPlan, partial: Path, progress: Progress) -> None:
    """Copy the features and matches of all chunks into the database of the job, which is made anew.

    Args:
        colmap: the pycolmap module.
        job: inputs of the reconstruction.
        plan: its chunks, all of them finished.
        partial: the partial product of the stage.
        progress: shows the chunks.

    Raises:
        InputError: a chunk is damaged; it was removed, and the same command computes it again.
    """
    remove_database(job.database)  # An interrupted run may have left half of it, or one for other chunks.
    write_frame(colmap, job.database, job.survey, range(len(job.survey.images)), job.options)
    with progress.task("joining chunks", len(plan.chunks)) as task:
        for chunk in plan.chunks:
            copy_finished(chunk, partial, job.database, FEATURES if chunk.kind == "features" else MATCHES)
            task.advance()


def remove_chunks(partial: Path) -> None:
    """Remove plan and chunks from the product, which has all of them in its database."""
    remove(partial / PLAN)
    shutil.rmtree(partial / FOLDER, ignore_errors=True)
