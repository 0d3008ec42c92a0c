"""Engine `colmap`: features, matches, mapping, and a final robust adjustment; a large survey in chunks."""

import logging
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

from pipelines.core.errors import DegenerateGeometryError, InputError, ResourceError
from pipelines.core.machine import chosen_threads, free_main_memory_bytes
from pipelines.core.products import load_json, save_json
from pipelines.core.progress import Progress
from pipelines.core.stages import RIG_MODEL
from pipelines.core.workspace import StageRun
from pipelines.formats.colmap import ROLLING_SHUTTER, quiet_colmap, write_reconstruction
from pipelines.geometry.cameras import Reconstruction
from pipelines.sfm.adjustment import adjust_finally
from pipelines.sfm.chunks import PLAN, ChunkPlan, join_chunks, remove_chunks, work_in_chunks
from pipelines.sfm.colmap_database import require_sound
from pipelines.sfm.estimate import estimate_reconstruction, why_too_large
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features, match_features
from pipelines.sfm.global_shutter_points import correct_tie_points
from pipelines.sfm.learned_weights import learned_remedy
from pipelines.sfm.lens_check import lenses_astray
from pipelines.sfm.mapping import triangulate
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.rigs import reference_alone, with_rigs
from pipelines.sfm.rounds import map_in_rounds
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

# Up to this number of photographs, the final adjustment alone removes the bend of a model.
_DRIFTLESS_UP_TO = 200


class ColmapReconstructor:
    """Reconstruction by COLMAP, which cannot be interrupted while it works."""

    remedy = "Run it again (finished features and matches are kept), or with a smaller --max-image-size."

    estimate = staticmethod(estimate_reconstruction)

    def prepare(self, stage: StageRun, survey: Survey, options: SfmOptions) -> bool:
        count = len(survey.images)
        reason = why_too_large(count, survey.largest_photograph_px, options, free_main_memory_bytes())
        if reason is not None:
            raise ResourceError("memory-too-small", reason)
        if count > options.chunk_size:
            work_in_chunks(stage, survey, options)
        return count <= options.chunk_size

    def reconstruct(self, job: SfmJob, progress: Progress) -> Any:
        out = job.database.parent
        with quiet_colmap() as colmap:
            if len(job.survey.images) > job.options.chunk_size:
                join_chunks(colmap, job, load_json(ChunkPlan, out / PLAN), out, progress)
                model, lens_held = map_matches(colmap, job, progress)
            else:
                require_sound(job.database)
                model, lens_held = reconstruct(colmap, job, progress)
            adjust = partial(_adjust, colmap, job, lens_held=lens_held, progress=progress)
            model, shutter = correct_tie_points(model, job.survey, adjust)
            if job.survey.companions:
                write_reconstruction(model, job.sparse.with_name(Path(RIG_MODEL).name))
                write_reconstruction(reference_alone(model, job.survey), job.sparse)
            else:
                write_reconstruction(model, job.sparse)
            if shutter is not None:
                save_json(shutter, job.sparse / ROLLING_SHUTTER)
        remove_chunks(out)
        return model


def reconstruct(colmap: ModuleType, job: SfmJob, progress: Progress) -> tuple[Any, bool]:
    """Return the largest `pycolmap.Reconstruction` of the photographs, adjusted, and whether its lens is held.

    Raises:
        InputError: a photograph does not exist or is not that of the survey, or a camera prior is none of COLMAP's
            cameras.
        DegenerateGeometryError: COLMAP found no model.
        ConvergenceError: the final adjustment found no solution.
    """
    missing = [image.name for image in job.survey.images if not (job.images / image.name).is_file()]
    if missing:
        raise InputError(
            "photograph-missing",
            f"{len(missing)} photographs of the survey are missing, such as this one.",
            path=job.images / missing[0],
            remedy="Restore them, or run `georef ingest` again.",
        )
    colmap.set_random_seed(job.options.seed)
    extract_features(colmap, job, range(len(job.survey.images)), progress)
    match_features(colmap, job, candidate_pairs(job.survey, job.options), progress)
    return map_matches(colmap, job, progress)


def map_matches(colmap: ModuleType, job: SfmJob, progress: Progress) -> tuple[Any, bool]:
    """Return the largest model of a database with features and matches, adjusted, and whether its lens is held.

    Raises as `reconstruct`. A held lens stays as stated in every later adjustment, too.
    """
    colmap.set_random_seed(job.options.seed)
    aligned = map_in_rounds(colmap, job, progress)
    if not aligned.models:
        raise DegenerateGeometryError(
            "no-matches",
            "No two photographs could be matched: overlap or texture is too low. Try a larger --max-features, or "
            f"--pairs exhaustive. {learned_remedy(job.options.features)}".rstrip(),
        )
    model, complete, fixes = aligned.models[0], None, None
    if len(job.survey.images) > _DRIFTLESS_UP_TO:
        fixes = {image.name: image.fix.position_in_geo for image in job.survey.images if image.fix is not None}
    if aligned.mapper == "global":
        complete = partial(triangulate, colmap, database=job.database, progress=progress)
    if job.survey.companions:
        if complete is not None:
            complete(model)  # before the database's photographs have a pose each, and the model's one an instant
            complete = None
        model = with_rigs(colmap, job, model, lens_held=aligned.lens_held, progress=progress)
    mapped = type(model)(model) if aligned.lens_held else None
    _adjust(colmap, job, model, fixes=fixes, complete=complete, progress=progress)
    astray = lenses_astray(model, job.survey)
    lens_held = bool(astray) and mapped is not None
    if lens_held:
        for camera_id, reason in astray.items():
            log.warning(
                "The photographs do not determine the lens of camera %d, which would have %s: it is held.",
                camera_id, reason, extra={"code": "lens-held"},
            )  # fmt: skip
        model = mapped
        _adjust(colmap, job, model, lens_held=True, fixes=fixes, complete=complete, progress=progress)
    else:
        for camera_id, reason in astray.items():
            log.warning(
                "Camera %d was solved with %s. State the focal length by --focal-px.",
                camera_id, reason, extra={"code": "lens-astray"},
            )  # fmt: skip
    return model, lens_held


def _adjust(
    colmap: ModuleType,
    job: SfmJob,
    model: Reconstruction,
    **how: Any,  # of `adjust_finally`
) -> None:
    free, threads = job.options.principal_point, chosen_threads(job.options.threads)
    adjust_finally(colmap, model, principal_point=free, threads=threads, **how)
