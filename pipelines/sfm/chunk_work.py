"""Work on one chunk of a reconstruction: a process of its own, which needs no other that runs at the same time.

Reads `ingest/survey.json`, the photographs, the plan in `sfm.partial/`, and for matches the finished features.
Writes the chunk's folder only, whose lock it holds. The same command again continues a chunk that was interrupted.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.child import run_in_child
from pipelines.core.errors import DamagedPartialError, InputError
from pipelines.core.lock import WriteLock
from pipelines.core.photograph_folder import photograph_folder
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import BY_NAME, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import quiet_colmap
from pipelines.scene.survey import Survey
from pipelines.sfm.chunks import PLAN, Chunk, ChunkPlan
from pipelines.sfm.colmap_database import (
    FEATURES,
    copy_rows,
    finish_database,
    remove_database,
    require_sound,
    write_frame,
)
from pipelines.sfm.features import SfmJob, extract_features, match_features

log = logging.getLogger(__name__)

_DRAFT = "unfinished.db"
_RUN_AGAIN = "run the same command again (finished features and matches are kept)"


def work_chunk(workspace: Workspace, name: str, progress: Progress) -> bool:
    """Work on a chunk until it is finished, and return whether there was anything to do.

    Args:
        workspace: in which `georef sfm` has planned the chunks.
        name: of the chunk.
        progress: shows its photographs or pairs.

    Raises:
        InputError: no such chunk is planned, or a photograph has changed.
        WorkspaceBusyError: another process works on the chunk.
        GeorefError: a crash of COLMAP, or a full disk.
    """
    partial = workspace.partial(BY_NAME["sfm"])
    chunk = _planned(workspace, load_plan(workspace), name)
    folder = chunk.folder(partial)
    with WriteLock(folder).hold(f"sfm --chunk {name}"):
        if chunk.is_finished(partial):
            log.info("%s: finished before", name)
            return False
        survey = workspace.path(SURVEY)
        images = photograph_folder(workspace, load_json(Survey, survey).image_dir)
        arguments = {"survey": str(survey), "images": str(images), "partial": str(partial), "name": name}
        run_in_child("pipelines.sfm.chunk_work:write_chunk", arguments, _RUN_AGAIN, progress, writes=folder)
    return True


def load_plan(workspace: Workspace) -> ChunkPlan:
    """Return the plan of the chunks of a workspace.

    Raises:
        InputError: there is none.
    """
    path = workspace.partial(BY_NAME["sfm"]) / PLAN
    if not path.is_file():
        raise InputError(f"no chunks are planned: `georef sfm {workspace.root}` plans them", path=path)
    return load_json(ChunkPlan, path)


def write_chunk(arguments: Mapping[str, Any], progress: Progress) -> None:
    """Compute the features or matches of a chunk, in a child process.

    Args:
        arguments: paths of `survey`, `images` and `partial`, and the `name` of the chunk.
        progress: shows its photographs or pairs.

    Raises:
        GeorefError: as `work_chunk`.
    """
    partial = Path(arguments["partial"])
    plan = load_json(ChunkPlan, partial / PLAN)
    chunk = next(chunk for chunk in plan.chunks if chunk.name == arguments["name"])
    draft = chunk.folder(partial) / _DRAFT
    draft.parent.mkdir(parents=True, exist_ok=True)
    try:
        require_sound(draft)
    except DamagedPartialError as error:
        log.warning("%s: starts afresh: %s", chunk.name, error)
        remove_database(draft)
    job = SfmJob(load_json(Survey, Path(arguments["survey"])), Path(arguments["images"]), draft, plan.options)
    with quiet_colmap() as colmap:
        colmap.set_random_seed(plan.options.seed)
        if chunk.kind == "features":
            extract_features(colmap, job, chunk.images, progress)
            finish_database(draft, chunk.database(partial))
        else:
            write_frame(colmap, draft, job.survey, chunk.images, plan.options)
            for features in plan.of_kind("features"):
                shared = sorted(set(chunk.images).intersection(features.images))
                if shared:
                    copy_finished(features, partial, draft, FEATURES, shared)
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
    if not chunk.is_finished(partial):
        raise InputError(f"{chunk.name} is not finished, and its features are needed", path=database)
    try:
        copy_rows(database, target, tables, images)
    except DamagedPartialError as error:
        remove_database(database)
        raise InputError(f"{error.message}: it was removed; run `georef sfm` again", path=database) from error


def _planned(workspace: Workspace, plan: ChunkPlan, name: str) -> Chunk:
    for chunk in plan.chunks:
        if chunk.name == name:
            count = len(load_json(Survey, workspace.path(SURVEY)).images)
            if max((*chunk.images, *(index for pair in chunk.pairs for index in pair)), default=0) >= count:
                raise InputError(
                    f"{name} has more photographs than the survey: `georef sfm {workspace.root}` plans anew",
                    path=workspace.partial(BY_NAME["sfm"]) / PLAN,
                )
            return chunk
    names = f"{plan.chunks[0].name} … {plan.chunks[-1].name}" if plan.chunks else "none"
    raise InputError(f"{name!r} is none of the chunks {names}", field="--chunk")
