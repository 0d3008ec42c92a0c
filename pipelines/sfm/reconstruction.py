"""Reconstruction by COLMAP: features, matches, mapping, and a last, robust adjustment.

COLMAP hears no interrupts while it works: the stage runs this in a child process.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.progress import Progress
from pipelines.core.stages import SURVEY
from pipelines.core.threads import chosen_threads
from pipelines.core.types import IntArray
from pipelines.formats.image_file import read_bytes, require_unchanged
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.scene.survey import CameraPrior, Survey
from pipelines.sfm.last_adjustment import LastAdjustment, adjust_finally
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.pairs import CameraDirections, all_pairs, select_pairs

log = logging.getLogger(__name__)

_EXHAUSTIVE_UP_TO = 20
_IMAGES_PER_CHUNK = 4
_PAIRS_PER_CHUNK = 48


@dataclass(frozen=True)
class SfmJob:
    """Inputs of a reconstruction.

    Attributes:
        survey: photographs with priors of their cameras, positions and attitudes.
        images: folder of the photographs.
        database: path of COLMAP's database; an existing one is continued.
        options: of the stage.
    """

    survey: Survey
    images: Path
    database: Path
    options: SfmOptions


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
    names = [image.name for image in job.survey.images]
    missing = [name for name in names if not (job.images / name).is_file()]
    if missing:
        raise InputError(f"{len(missing)} photographs of the survey are gone", path=job.images / missing[0])
    colmap.set_random_seed(job.options.seed)
    number_of = {name: f"{number:06d}" for number, name in enumerate(names)}
    name_of = {number: name for name, number in number_of.items()}
    _rename_images(colmap, job.database, name_of)  # A killed run may have left the numbers.
    _extract(colmap, job, progress)
    # COLMAP reads pairs from a text in which a blank ends a name: numbers replace the names while it matches.
    _rename_images(colmap, job.database, number_of)
    pairs = [(number_of[names[i]], number_of[names[j]]) for i, j in candidate_pairs(job.survey, job.options)]
    try:
        _match(colmap, job, pairs, progress)
    finally:
        _rename_images(colmap, job.database, name_of)
    models = _map(colmap, job, progress)
    if not models:
        raise DegenerateGeometryError(
            "no two photographs could be tied together: is there enough overlap and texture? "
            "`--max-features` and `--pairs exhaustive` may help"
        )
    if len(models) > 1:
        sizes = sorted((model.num_reg_images() for model in models), reverse=True)
        log.warning("the survey fell apart into %d models of %s images; the largest is used", len(models), sizes)
    model = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    last = LastAdjustment(job.options.principal_point, chosen_threads(job.options.threads))
    adjust_finally(colmap, model, last, progress)
    return model


def candidate_pairs(survey: Survey, options: SfmOptions) -> IntArray:
    """Return the pairs to match as indices (P, 2) into `survey.images`.

    All pairs are matched if there are up to 20 images, or if no image has a fix. Otherwise position and viewing
    direction decide.
    """
    count = len(survey.images)
    located = any(image.fix for image in survey.images)
    if options.pairs == "exhaustive" or count <= _EXHAUSTIVE_UP_TO or not located:
        return all_pairs(count)
    unknown = (np.nan, np.nan, np.nan)
    position = np.array([image.fix.position_in_geo if image.fix else unknown for image in survey.images])
    axis = np.array(
        [
            matrix_from_quat_xyzw(image.attitude.quat_xyzw)[:, 2] if image.attitude else unknown
            for image in survey.images
        ]
    )
    return select_pairs(CameraDirections(position, axis), options.max_neighbors)


def _extract(colmap: Any, job: SfmJob, progress: Progress) -> None:
    """Detect features camera by camera, in chunks of images: finished chunks survive an interruption."""
    options = colmap.FeatureExtractionOptions()
    options.max_image_size = job.options.max_image_size
    options.num_threads = chosen_threads(job.options.threads)
    options.sift.max_num_features = job.options.max_features
    sha256_of = {image.name: image.sha256 for image in job.survey.images}
    with progress.task("features", len(job.survey.images)) as task:
        for prior in job.survey.cameras:
            names = [image.name for image in job.survey.images if image.camera_id == prior.camera_id]
            _add_camera(colmap, job, prior)
            reader = colmap.ImageReaderOptions()
            reader.existing_camera_id = prior.camera_id
            for chunk in _chunks(names, _IMAGES_PER_CHUNK):
                for name in chunk:
                    require_unchanged(read_bytes(job.images / name), sha256_of[name], job.images / name)
                colmap.extract_features(
                    job.database,
                    job.images,
                    image_names=chunk,
                    reader_options=reader,
                    extraction_options=options,
                )
                task.advance(len(chunk))


def _add_camera(colmap: Any, job: SfmJob, prior: CameraPrior) -> None:
    """Put the camera into the database, unless an interrupted run has already done so."""
    with colmap.Database.open(job.database) as database:
        if database.exists_camera(prior.camera_id):
            return
        # No perspective model approximates a fisheye: its own model is kept.
        model = prior.model if prior.model == "OPENCV_FISHEYE" else job.options.camera_model
        camera = colmap.Camera.create_from_model_name(
            prior.camera_id, model, prior.params[0], prior.width, prior.height
        )
        _copy_shared_params(colmap, prior, camera)
        camera.has_prior_focal_length = prior.focal_source != "assumed"
        database.write_camera(camera, use_camera_id=True)


def _copy_shared_params(colmap: Any, prior: CameraPrior, camera: Any) -> None:
    """Copy the parameters of the prior that both camera models have: focal length, centre, distortion.

    Raises:
        InputError: COLMAP has no camera of that model with that number of parameters.
    """
    try:
        original = colmap.Camera(
            model=prior.model, width=prior.width, height=prior.height, params=list(prior.params)
        )
        names = [name.strip() for name in original.params_info.split(",")]
        by_name = dict(zip(names, prior.params, strict=True))
    except ValueError as error:
        raise InputError(
            f"{prior.model} is no camera of COLMAP with {len(prior.params)} parameters", field=SURVEY
        ) from error
    f = by_name.get("f", by_name.get("fx", 0.0))
    by_name = {"f": f, "fx": f, "fy": f, "k": by_name.get("k1", 0.0), "k1": by_name.get("k", 0.0), **by_name}
    params = camera.params
    for index, name in enumerate(part.strip() for part in camera.params_info.split(",")):
        params[index] = by_name.get(name, params[index])
    camera.params = params


def _match(colmap: Any, job: SfmJob, pairs: list[tuple[str, str]], progress: Progress) -> None:
    matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
    matching.num_threads = chosen_threads(job.options.threads)
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.options.seed
    listing = job.database.with_name("pairs.txt")
    with progress.task("matching", len(pairs)) as task:
        for chunk in _chunks(pairs, _PAIRS_PER_CHUNK):
            listing.write_text("".join(f"{a} {b}\n" for a, b in chunk), encoding="utf-8")
            pairing.match_list_path = listing
            colmap.match_image_pairs(job.database, matching, pairing, verification)
            task.advance(len(chunk))
    listing.unlink(missing_ok=True)


def _rename_images(colmap: Any, path: Path, names: dict[str, str]) -> None:
    """Rename those images of a database whose names are keys of `names`."""
    with colmap.Database.open(path) as database:
        for image in database.read_all_images():
            if image.name in names:
                image.name = names[image.name]
                database.update_image(image)


def _map(colmap: Any, job: SfmJob, progress: Progress) -> list[Any]:
    with progress.task("mapping", len(job.survey.images)) as task, _scratch(job.database.parent) as out:
        if job.options.mapper == "global":
            options = colmap.GlobalPipelineOptions()
            options.num_threads, options.random_seed = chosen_threads(job.options.threads), job.options.seed
            models = colmap.global_mapping(job.database, job.images, out, options)
            task.advance(len(job.survey.images))
            return list(models.values())
        options = colmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = chosen_threads(job.options.threads), job.options.seed
        options.min_model_size = 3
        models = colmap.incremental_mapping(
            job.database, job.images, out, options, next_image_callback=lambda: task.advance(1)
        )
        return list(models.values())


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Make an empty folder for COLMAP's own output, and remove it at the end.

    The name is fixed, so that the next run removes the folder of a killed one.
    """
    scratch = folder / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _chunks(items: list[Any], size: int) -> Iterator[list[Any]]:
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
