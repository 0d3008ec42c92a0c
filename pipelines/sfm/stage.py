"""Structure from motion with COLMAP.

Reads `ingest/survey.json` and the photographs. Writes `sfm/sparse/` (a COLMAP model that COLMAP itself opens)
and `sfm/database.db` (features and matches). The model's frame is `local`: similar to the scene, at an arbitrary
place and scale; what GNSS measured chooses the pairs to match and enters nothing else.
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
from pipelines.core.interrupts import interruptible
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import SURVEY
from pipelines.core.types import IntArray
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import load_reconstruction, quiet_colmap
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.scene.survey import CameraPrior, Survey
from pipelines.sfm.last_adjustment import LastAdjustment, adjust_finally
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.pairs import Views, all_pairs, select_pairs

log = logging.getLogger(__name__)

_EXHAUSTIVE_UP_TO = 20
_IMAGES_A_CHUNK = 4
_PAIRS_A_CHUNK = 48
_FEW_REGISTERED = 0.8


def run(stage: StageRun, config: SfmOptions) -> Summary:
    """Reconstruct, or take over someone else's model, and say how complete it is."""
    survey = load_json(Survey, stage.workspace.path(SURVEY))
    images = stage.workspace.photographs(survey.image_dir)
    sparse = stage.out / "sparse"
    if sparse.exists():
        shutil.rmtree(sparse)
    with quiet_colmap() as colmap:
        if config.import_model is not None:
            model = import_model(config.import_model, survey)
        else:
            job = SfmJob(survey, images, stage.out / "database.db", config)
            model = reconstruct(colmap, job, stage.progress)
        sparse.mkdir()
        model.write_binary(str(sparse))
    return _summarise(model, survey)


@dataclass(frozen=True)
class SfmJob:
    """What to reconstruct.

    Attributes:
        survey: the photographs, what is known of their cameras and places.
        images: folder that the survey's image names are relative to.
        database: COLMAP's database; one that is there is continued.
        config: options.
    """

    survey: Survey
    images: Path
    database: Path
    config: SfmOptions


def reconstruct(colmap: Any, job: SfmJob, progress: Progress) -> Any:
    """Features, matches, mapping and a last, robust adjustment.

    Args:
        colmap: the pycolmap module.

    Returns:
        The largest `pycolmap.Reconstruction`.

    Raises:
        InputError: a photograph is gone.
        DegenerateGeometryError: no two images could be tied together.
    """
    names = [image.name for image in job.survey.images]
    missing = [name for name in names if not (job.images / name).is_file()]
    if missing:
        raise InputError(f"{len(missing)} photographs of the survey are gone", path=job.images / missing[0])
    colmap.set_random_seed(job.config.seed)
    plain = {name: f"{number:06d}" for number, name in enumerate(names)}
    _rename(colmap, job.database, {short: name for name, short in plain.items()})  # as a killed run may leave it
    _extract(colmap, job, progress)
    # COLMAP takes pairs from a text in which a blank ends a name: meanwhile, photographs go by numbers.
    _rename(colmap, job.database, plain)
    pairs = [(plain[names[i]], plain[names[j]]) for i, j in candidate_pairs(job.survey, job.config)]
    try:
        _match(colmap, job, pairs, progress)
    finally:
        _rename(colmap, job.database, {short: name for name, short in plain.items()})
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
    last = LastAdjustment(job.config.principal_point, job.config.threads)
    adjust_finally(colmap, model, last, progress)
    return model


def candidate_pairs(survey: Survey, config: SfmOptions) -> IntArray:
    """Indices (P, 2) into `survey.images` of the pairs to match.

    All pairs for up to 20 images or where no image has a fix; else by position and view direction.
    """
    count = len(survey.images)
    located = any(image.fix for image in survey.images)
    if config.pairs == "exhaustive" or count <= _EXHAUSTIVE_UP_TO or not located:
        return all_pairs(count)
    unknown = (np.nan, np.nan, np.nan)
    position = np.array([image.fix.position_in_geo if image.fix else unknown for image in survey.images])
    axis = np.array(
        [
            matrix_from_quat_xyzw(image.attitude.quat_xyzw)[:, 2] if image.attitude else unknown
            for image in survey.images
        ]
    )
    return select_pairs(Views(position, axis), config.max_neighbors)


def _extract(colmap: Any, job: SfmJob, progress: Progress) -> None:
    """Detect features camera by camera, a few images at a time: what is done survives an interruption."""
    options = colmap.FeatureExtractionOptions()
    options.max_image_size = job.config.max_image_size
    options.num_threads = job.config.threads
    options.sift.max_num_features = job.config.max_features
    with progress.task("features", len(job.survey.images)) as task:
        for prior in job.survey.cameras:
            names = [image.name for image in job.survey.images if image.camera_id == prior.camera_id]
            _add_camera(colmap, job, prior)
            reader = colmap.ImageReaderOptions()
            reader.existing_camera_id = prior.camera_id
            for chunk in _chunks(names, _IMAGES_A_CHUNK):
                colmap.extract_features(
                    job.database,
                    job.images,
                    image_names=chunk,
                    reader_options=reader,
                    extraction_options=options,
                )
                task.advance(len(chunk))


def _add_camera(colmap: Any, job: SfmJob, prior: CameraPrior) -> None:
    """Put the camera into the database unless an interrupted run already did."""
    with colmap.Database.open(job.database) as database:
        if database.exists_camera(prior.camera_id):
            return
        # A fisheye has no likeness among the perspective models to start from.
        model = prior.model if prior.model == "OPENCV_FISHEYE" else job.config.camera_model
        camera = colmap.Camera.create_from_model_name(
            prior.camera_id, model, prior.params[0], prior.width, prior.height
        )
        _copy_shared_params(colmap, prior, camera)
        camera.has_prior_focal_length = prior.focal_source != "assumed"
        database.write_camera(camera, use_camera_id=True)


def _copy_shared_params(colmap: Any, prior: CameraPrior, camera: Any) -> None:
    """Take over the prior's focal length, centre and distortion as far as both models know them."""
    try:
        given = colmap.Camera(model=prior.model, width=prior.width, height=prior.height, params=list(prior.params))
        names = [name.strip() for name in given.params_info.split(",")]
        known = dict(zip(names, prior.params, strict=True))
    except ValueError as error:
        raise InputError(
            f"{prior.model} is no camera of COLMAP with {len(prior.params)} parameters", field=SURVEY
        ) from error
    f = known.get("f", known.get("fx", 0.0))
    known = {"f": f, "fx": f, "fy": f, "k": known.get("k1", 0.0), "k1": known.get("k", 0.0), **known}
    params = camera.params
    for index, name in enumerate(part.strip() for part in camera.params_info.split(",")):
        params[index] = known.get(name, params[index])
    camera.params = params


def _match(colmap: Any, job: SfmJob, pairs: list[tuple[str, str]], progress: Progress) -> None:
    matching, pairing = colmap.FeatureMatchingOptions(), colmap.ImportedPairingOptions()
    matching.num_threads = job.config.threads
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.config.seed
    listing = job.database.with_name("pairs.txt")
    with progress.task("matching", len(pairs)) as task:
        for chunk in _chunks(pairs, _PAIRS_A_CHUNK):
            listing.write_text("".join(f"{a} {b}\n" for a, b in chunk), encoding="utf-8")
            pairing.match_list_path = listing
            colmap.match_image_pairs(job.database, matching, pairing, verification)
            task.advance(len(chunk))
    listing.unlink(missing_ok=True)


def _rename(colmap: Any, path: Path, names: dict[str, str]) -> None:
    """Rename the images of a database, as far as they have one of these names."""
    with colmap.Database.open(path) as database:
        for image in database.read_all_images():
            if image.name in names:
                image.name = names[image.name]
                database.update_image(image)


def _map(colmap: Any, job: SfmJob, progress: Progress) -> list[Any]:
    with progress.task("mapping", len(job.survey.images)) as task, _scratch(job.database.parent) as out:
        if job.config.mapper == "global":
            options = colmap.GlobalPipelineOptions()
            options.num_threads, options.random_seed = job.config.threads, job.config.seed
            models = interruptible(lambda: colmap.global_mapping(job.database, job.images, out, options))
            task.advance(len(job.survey.images))
            return list(models.values())
        options = colmap.IncrementalPipelineOptions()
        options.num_threads, options.random_seed = job.config.threads, job.config.seed
        options.min_model_size = 3
        models = colmap.incremental_mapping(
            job.database, job.images, out, options, next_image_callback=lambda: task.advance(1)
        )
        return list(models.values())


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """An empty folder for COLMAP's own output; its fixed name lets the next run clear what a killed one left."""
    scratch = folder / "mapping"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def import_model(path: Path, survey: Survey) -> Any:
    """Someone else's COLMAP model, reduced to the survey's images.

    Raises:
        InputError: not a COLMAP model, or fewer than 3 of its images are the survey's.
    """
    model = load_reconstruction(path)
    names = {image.name for image in survey.images}
    foreign = [image.image_id for image in model.images.values() if image.name not in names]
    for image_id in foreign:
        model.deregister_frame(model.images[image_id].frame_id)
    if model.num_reg_images() < 3:
        raise InputError(
            f"only {model.num_reg_images()} of its images are in the survey: names must be equal", path=path
        )
    if foreign:
        log.warning("%d images of the imported model are not in the survey and were left out", len(foreign))
    return model


def _summarise(model: Any, survey: Survey) -> Summary:
    registered, total = model.num_reg_images(), len(survey.images)
    if registered < 3:
        raise DegenerateGeometryError(
            f"only {registered} of {total} photographs could be registered: a splat needs 3 or more"
        )
    error_px = model.compute_mean_reprojection_error()
    left_out = sorted(
        {image.name for image in survey.images} - {i.name for i in model.images.values() if i.has_pose}
    )
    warnings = []
    if registered < _FEW_REGISTERED * total:
        warnings.append(
            f"ONLY {registered} OF {total} PHOTOGRAPHS WERE REGISTERED: the splat will have holes. "
            f"Not registered: {', '.join(left_out[:5])}{' …' if len(left_out) > 5 else ''}"
        )
    values = {
        "registered": registered,
        "images": total,
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
        "mean_track_length": round(model.compute_mean_track_length(), 3),
        "reprojection_error_px": round(error_px, 4),
        "not_registered": left_out,
    }
    figure = f"{registered} of {total} registered, {model.num_points3D()} points, {error_px:.2f} px"
    return Summary(figure, values, tuple(warnings))


def _chunks(items: list[Any], size: int) -> Iterator[list[Any]]:
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]
