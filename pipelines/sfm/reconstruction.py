"""Reconstruction by COLMAP: features, matches, mapping, and a last, robust adjustment.

COLMAP hears no interrupts while it works: the stage runs this in a child process.
"""

from __future__ import annotations

import logging
from typing import Any

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.progress import Progress
from pipelines.core.threads import chosen_threads
from pipelines.sfm.drift import remove_drift
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features, match_features
from pipelines.sfm.last_adjustment import LastAdjustment, adjust_finally
from pipelines.sfm.mapping import map_database

log = logging.getLogger(__name__)

# Over so few photographs a model bends by less than the last adjustment removes.
_DRIFTLESS_UP_TO = 200


def reconstruct(colmap: Any, job: SfmJob, progress: Progress) -> Any:
    """Return the largest `pycolmap.Reconstruction` of the photographs, robustly adjusted.

    Args:
        colmap: the pycolmap module.
        job: inputs of the reconstruction.
        progress: shows features, matches and mapping.

    Raises:
        InputError: a photograph does not exist or is not that of the survey, or a camera prior is none of COLMAP's
            cameras.
        DegenerateGeometryError: COLMAP found no model.
        ConvergenceError: the last adjustment found no solution.
    """
    require_photographs(job)
    colmap.set_random_seed(job.options.seed)
    extract_features(colmap, job, range(len(job.survey.images)), progress)
    match_features(colmap, job, candidate_pairs(job.survey, job.options), progress)
    return map_matches(colmap, job, progress)


def require_photographs(job: SfmJob) -> None:
    """Refuse a survey whose photographs are gone.

    Raises:
        InputError: names the first of them.
    """
    missing = [image.name for image in job.survey.images if not (job.images / image.name).is_file()]
    if missing:
        raise InputError(f"{len(missing)} photographs of the survey are gone", path=job.images / missing[0])


def map_matches(colmap: Any, job: SfmJob, progress: Progress) -> Any:
    """Return the largest `pycolmap.Reconstruction` of a database with features and matches, robustly adjusted.

    Args:
        colmap: the pycolmap module.
        job: inputs of the reconstruction.
        progress: shows mapping and adjustment.

    Raises:
        DegenerateGeometryError: COLMAP found no model.
        ConvergenceError: the last adjustment found no solution.
    """
    colmap.set_random_seed(job.options.seed)
    models = map_database(colmap, job, progress)
    if not models:
        raise DegenerateGeometryError(
            "no two photographs could be tied together: is there enough overlap and texture? "
            "`--max-features` and `--pairs exhaustive` may help"
        )
    if len(models) > 1:
        sizes = [model.num_reg_images() for model in models]
        log.warning("the survey fell apart into %d models of %s images; the largest is used", len(models), sizes)
    model, threads = models[0], chosen_threads(job.options.threads)
    if len(job.survey.images) > _DRIFTLESS_UP_TO:
        fixes = {image.name: image.fix.position_in_geo for image in job.survey.images if image.fix is not None}
        remove_drift(colmap, model, fixes, threads, progress)
    adjust_finally(colmap, model, LastAdjustment(job.options.principal_point, threads), progress)
    return model
