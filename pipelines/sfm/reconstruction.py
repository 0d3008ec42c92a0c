"""Reconstruction by COLMAP: features, matches, mapping, and a last, robust adjustment.

COLMAP hears no interrupts while it works: the stage runs this in a child process.

Import of a COLMAP model: where it lies, and whether it is one of the survey's photographs.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.machine import chosen_threads
from pipelines.core.progress import Progress
from pipelines.formats.colmap import load_reconstruction
from pipelines.sfm.features import SfmJob, candidate_pairs, extract_features, match_features
from pipelines.sfm.mapping import LastAdjustment, adjust_finally, map_database, remove_drift
from pipelines.survey.survey import Survey

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


# Below the folder of a project: COLMAP's mapper numbers its models and puts the largest first as a rule.
_PLACES = ("", "sparse/0", "sparse", "0")
_WITHOUT_DISTORTION = frozenset({"PINHOLE", "SIMPLE_PINHOLE"})


def import_model(path: Path, survey: Survey) -> Any:
    """Return the COLMAP model at `path` (a `pycolmap.Reconstruction`), reduced to the survey's images.

    Args:
        path: folder of the model, or of a COLMAP project that has it in `sparse/0` or `sparse`.
        survey: has the names and the sizes of the photographs.

    Raises:
        InputError: the folder holds no COLMAP model, fewer than 3 of its images are in the survey, or its cameras
            have other sizes than the photographs.
    """
    folder = find_model(path)
    model = load_reconstruction(folder)
    names = {image.name for image in survey.images}
    foreign = [image for image in model.images.values() if image.has_pose and image.name not in names]
    for frame_id in {image.frame_id for image in foreign}:  # The images of a rig share a frame.
        model.deregister_frame(frame_id)
    if model.num_reg_images() < 3:
        raise InputError(
            f"only {model.num_reg_images()} of its images are in the survey: names must be equal", path=folder
        )
    if foreign:
        log.warning("%d images of the imported model are not in the survey and were left out", len(foreign))
    _check_cameras(model, survey, folder)
    return model


def find_model(path: Path) -> Path:
    """Return the folder of the model at or below `path`; `path` itself if there is none.

    Among several models of a project the one in `sparse/0` is returned, with a warning.
    """
    places = [path / place for place in _PLACES]
    folder = next((place for place in places if _has_model(place)), path)
    others = [other for other in folder.parent.glob("[0-9]*") if other != folder and _has_model(other)]
    if folder != path and others:
        log.warning("%s is imported; %d further models lie beside it", folder, len(others))
    return folder


def _has_model(folder: Path) -> bool:
    return any((folder / f"images{suffix}").exists() for suffix in (".bin", ".txt"))


def _check_cameras(model: Any, survey: Survey, folder: Path) -> None:
    """Refuse cameras of other sizes than the photographs; warn of cameras without distortion."""
    priors = {prior.camera_id: prior for prior in survey.cameras}
    size_of = {
        image.name: (priors[image.camera_id].width, priors[image.camera_id].height) for image in survey.images
    }
    flat = set()
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        camera = model.cameras[image.camera_id]
        width, height = size_of[image.name]
        undistorted = camera.model_name in _WITHOUT_DISTORTION
        if (camera.width, camera.height) != (width, height):
            cause = "undistorted copies" if undistorted else "copies of another size"
            raise InputError(
                f"its camera {image.camera_id} ({camera.model_name}) has {camera.width}×{camera.height} pixels, "
                f"the photograph {image.name} {width}×{height}: the model was made of {cause}. Import the model of "
                "the photographs themselves, or give the folder of the copies to `georef ingest --images`",
                path=folder,
            )
        if undistorted:
            flat.add(image.camera_id)
    if flat:
        log.warning(
            "the imported model has no lens distortion (camera %s): if it was made of undistorted copies, import "
            "the model of the photographs themselves",
            ", ".join(map(str, sorted(flat))),
        )
