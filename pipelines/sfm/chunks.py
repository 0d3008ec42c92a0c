"""Features and matches of a large survey in chunks, which are jobs of an engine, and their way into one database.

The plan lies in the partial product of the stage, and a folder for each chunk beside it. A chunk is finished when
its folder holds `database.db`. The folder's name has a hash of all that the chunk is made from: a finished chunk is
reused while photographs, options and COLMAP's version are unchanged. A process that works on a chunk needs no other
that runs at the same time; it writes the chunk's folder only, whose lock it holds. The same command again continues
a chunk that was interrupted.
"""

import hashlib
import json
import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pipelines.core.child import run_in_child
from pipelines.core.errors import DamagedPartialError, GeorefError, InputError
from pipelines.core.files import remove, replace_text
from pipelines.core.fingerprints import library_versions
from pipelines.core.json_values import JsonValue
from pipelines.core.lock import WriteLock
from pipelines.core.plan import photograph_folder
from pipelines.core.products import Product, load_json
from pipelines.core.progress import Progress
from pipelines.core.sentences import listed
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.types import IntArray
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.colmap import quiet_colmap
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import failed_of
from pipelines.sfm.colmap_database import (
    FEATURES,
    MATCHES,
    copy_rows,
    finish_database,
    remove_database,
    require_sound,
    write_frame,
)
from pipelines.sfm.estimate import chunk_peak_bytes
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features, masks_beside, match_features
from pipelines.sfm.options import SfmOptions
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

PLAN = "chunks.json"
FOLDER = "chunks"
DATABASE = "database.db"

Kind = Literal["features", "matches"]
Index = Annotated[int, Field(ge=0)]
# Matches of an image with its neighbours take about as long as its features: both kinds of chunks take as long.
_PAIRS_PER_PHOTOGRAPH = 8
_DRAFT = "unfinished.db"
_RUN_AGAIN = "Run the same command again: finished features and matches are kept."
_TITLES: dict[Kind, str] = {"features": "chunks of features", "matches": "chunks of matches"}


class Chunk(Product):
    """Part of the features, or of the matches, of a survey.

    Attributes:
        name: unique in the plan, for people and for the command line.
        key: hash of all that the chunk is made from.
        images: indices of the photographs, ascending.
        pairs: indices of the photographs to match, for a chunk of matches.
    """

    name: str = Field(pattern=r"^(features|matches)-[0-9]{4,9}$")
    kind: Kind
    key: str = Field(pattern=r"^[0-9a-f]{16}$")
    images: tuple[Index, ...]
    pairs: tuple[tuple[Index, Index], ...] = ()

    def folder(self, partial: Path) -> Path:
        return partial / FOLDER / f"{self.name}-{self.key}"

    def database(self, partial: Path) -> Path:
        return self.folder(partial) / DATABASE


class ChunkPlan(Product):
    """Chunks of a reconstruction, those of features before those of matches."""

    format_version: Literal[1] = 1
    options: SfmOptions
    chunks: tuple[Chunk, ...]


def plan_chunks(survey: Survey, pairs: IntArray, options: SfmOptions) -> ChunkPlan:
    """Return the chunks of a survey, of about equal size and about `options.chunk_size` photographs.

    Photographs and pairs are cut in their order, which for photographs is that of the flight as a rule: a chunk of
    matches needs the features of few chunks. The pairs to match (P, 2) are sorted.
    """
    count = len(survey.images)
    features = np.array_split(np.arange(count), options.chunks(count))
    matches = np.array_split(pairs, options.chunks(-(-len(pairs) // _PAIRS_PER_PHOTOGRAPH)))
    common = _digest(
        [prior.model_dump(mode="json") for prior in survey.cameras],
        options.model_dump(include={"camera_model", "max_image_size", "max_features", "doubled"}),
        library_versions(("pycolmap",))["pycolmap"],
    )
    photographs = [[image.name, image.camera_id, image.sha256] for image in survey.images]

    def chunk(kind: Kind, number: int, images: IntArray, pairs: IntArray) -> Chunk:
        listed: list[tuple[int, int]] = [(a, b) for a, b in pairs.tolist()]
        drawn = [options.seed, listed] if listed else []
        key = _digest(common, [[index, *photographs[index]] for index in images.tolist()], drawn)
        name = f"{kind}-{number:04d}"
        return Chunk(name=name, kind=kind, key=key, images=tuple(images.tolist()), pairs=tuple(listed))

    none = np.empty((0, 2), dtype=np.int64)
    chunks = [chunk("features", number, part, none) for number, part in enumerate(features)]
    chunks += [chunk("matches", number, np.unique(part), part) for number, part in enumerate(matches)]
    return ChunkPlan(options=options.model_copy(update={"threads": -1}), chunks=tuple(chunks))


def _digest(*content: object) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def work_chunk(workspace: Workspace, name: str, progress: Progress) -> bool:
    """Work on a chunk until it is finished, and return whether there was anything to do.

    Raises:
        InputError: no such chunk is planned, or a photograph has changed.
        WorkspaceBusyError: another process works on the chunk.
        GeorefError: a crash of COLMAP, or a full disk.
    """
    partial = workspace.partial(BY_NAME["sfm"])
    chunk = _planned(workspace, name)
    folder = chunk.folder(partial)
    with WriteLock(folder).hold(f"sfm --chunk {name}"):
        if chunk.database(partial).is_file():
            log.info("%s: finished before", name)
            return False
        survey = workspace.path(SURVEY)
        images = photograph_folder(workspace, load_json(Survey, survey).image_dir)
        arguments = {"survey": str(survey), "images": str(images), "partial": str(partial), "name": name}
        run_in_child("pipelines.sfm.chunks:write_chunk", arguments, _RUN_AGAIN, progress, writes=folder)
    return True


def write_chunk(arguments: Mapping[str, JsonValue], progress: Progress) -> None:
    """Compute the features or matches of a chunk, in a child process; paths and name are among the arguments."""
    partial = Path(arguments["partial"])
    plan = load_json(ChunkPlan, partial / PLAN)
    chunk = next(chunk for chunk in plan.chunks if chunk.name == arguments["name"])
    draft = chunk.folder(partial) / _DRAFT
    draft.parent.mkdir(parents=True, exist_ok=True)
    try:
        require_sound(draft)
    except DamagedPartialError as error:
        log.warning("%s starts afresh: %s", chunk.name, error)
        remove_database(draft)
    survey = load_json(Survey, Path(arguments["survey"])).with_companions()
    masks = masks_beside(arguments["survey"], survey)
    job = SfmJob(survey, Path(arguments["images"]), draft, plan.options, masks)
    with quiet_colmap() as colmap:
        colmap.set_random_seed(plan.options.seed)
        if chunk.kind == "features":
            extract_features(colmap, job, chunk.images, progress)
            finish_database(draft, chunk.database(partial))
        else:
            write_frame(colmap, draft, job.survey, chunk.images, plan.options)
            for other in plan.chunks:
                shared = sorted(set(chunk.images).intersection(other.images))
                if shared and other.kind == "features":
                    copy_finished(other, partial, draft, FEATURES, shared)
            match_features(colmap, job, np.array(chunk.pairs, dtype=np.int64).reshape(-1, 2), progress)
            finish_database(draft, chunk.database(partial), without=FEATURES)


def copy_finished(
    chunk: Chunk, partial: Path, target: Path, tables: tuple[str, ...], images: list[int] | None = None
) -> None:
    """Copy rows of a finished chunk into a database; see `copy_rows`.

    Raises:
        InputError: the chunk is not finished, or its database is damaged; a damaged one is removed, so that the
            chunk is computed again.
    """
    database = chunk.database(partial)
    if not chunk.database(partial).is_file():
        raise InputError(
            "chunk-not-finished",
            f"{chunk.name} is not finished, and its features are needed.",
            path=database,
        )
    try:
        copy_rows(database, target, tables, images)
    except DamagedPartialError as error:
        remove_database(database)
        raise InputError(
            "chunk-damaged", f"{error.message}; the file was removed: run `georef sfm` again.", path=database
        ) from error


def _planned(workspace: Workspace, name: str) -> Chunk:
    path = workspace.partial(BY_NAME["sfm"]) / PLAN
    if not path.is_file():
        raise InputError(
            "no-chunk-plan", "No chunks are planned.", path=path, remedy=f"Run `georef sfm {workspace.root}`."
        )
    chunks = load_json(ChunkPlan, path).chunks
    chunk = next((chunk for chunk in chunks if chunk.name == name), None)
    if chunk is None:
        names = f"{chunks[0].name} … {chunks[-1].name}" if chunks else "none"
        raise InputError("unknown-chunk", f"{name!r} is none of the chunks {names}", field="--chunk")
    count = len(load_json(Survey, workspace.path(SURVEY)).with_companions().images)
    if max((*chunk.images, *(index for pair in chunk.pairs for index in pair)), default=0) >= count:
        message = f"{name} has more photographs than the survey."
        remedy = f"Run `georef sfm {workspace.root}`."
        raise InputError("chunk-plan-outdated", message, path=path, remedy=remedy)
    return chunk


def work_in_chunks(stage: StageRun, survey: Survey, options: SfmOptions) -> ChunkPlan:
    """Compute features and matches in chunks that the engine in use shares out, and return their plan.

    The partial product of the stage receives plan and chunks. Chunks that an earlier run has finished are kept.

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
    def ended(_: JobEnd) -> None:
        finished = sum(chunk.database(stage.out).is_file() for chunk in plan.chunks)
        stage.record_progress(f"{finished} of {len(plan.chunks)} chunks")

    title = _TITLES[kind]
    waiting = [chunk for chunk in plan.chunks if chunk.kind == kind and not chunk.database(stage.out).is_file()]
    jobs = [_job(stage, survey, plan, chunk) for chunk in waiting]
    if failed := failed_of(title, jobs, ended, stage.progress):
        names = listed([end.job.name for end in failed])
        raise GeorefError(
            "chunks-failed",
            f"{len(failed)} of {len(jobs)} {title} failed ({names}). The first error: {failed[0].error}. The same "
            "command repeats these chunks, and keeps the others.",
        )


def _job(stage: StageRun, survey: Survey, plan: ChunkPlan, chunk: Chunk) -> Job:
    root = stage.workspace.root.absolute()
    if chunk.kind == "features":
        images = photograph_folder(stage.workspace, survey.image_dir)
        reads = [images / survey.images[index].name for index in chunk.images]
    else:
        needed = set(chunk.images)
        reads = [
            other.database(stage.out)
            for other in plan.chunks
            if other.kind == "features" and not needed.isdisjoint(other.images)
        ]
    return Job(
        chunk.name,
        ("sfm", str(root), "--chunk", chunk.name),
        chunk_peak_bytes(survey.largest_photograph_px, plan.options),
        folder=root,
        writes=chunk.folder(stage.out),
        reads=(stage.workspace.path(SURVEY), stage.out / PLAN, *reads),
    )


def join_chunks(colmap: ModuleType, job: SfmJob, plan: ChunkPlan, partial: Path, progress: Progress) -> None:
    """Copy the features and matches of all finished chunks into the database of the job, which is made anew.

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
