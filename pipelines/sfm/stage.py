"""Stage `sfm`: structure from motion with COLMAP.

Reads `ingest/survey.json` and the photographs. Writes `sfm/sparse/` (a COLMAP model that COLMAP itself opens) and
`sfm/database.db` (features and matches). The model's frame is `local`: similar to the scene, with an arbitrary
place, rotation and scale. The positions measured by GNSS select the pairs to match, and have no other use here.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.core.products import load_json
from pipelines.core.stages import SURVEY
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import load_reconstruction, quiet_colmap
from pipelines.scene.survey import Survey
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.reconstruction import SfmJob, reconstruct

log = logging.getLogger(__name__)

_FEW_REGISTERED = 0.8


def run(stage: StageRun, options: SfmOptions) -> Summary:
    """Reconstruct the cameras and points, or import a model, and write the model.

    Raises:
        GeorefError: unreadable products, or an error of `reconstruct` or `import_model`.
        DegenerateGeometryError: fewer than three photographs are registered.
    """
    survey = load_json(Survey, stage.workspace.path(SURVEY))
    images = stage.workspace.photographs(survey.image_dir)
    sparse = stage.out / "sparse"
    if sparse.exists():
        shutil.rmtree(sparse)
    with quiet_colmap() as colmap:
        if options.import_model is not None:
            model = import_model(options.import_model, survey)
        else:
            job = SfmJob(survey, images, stage.out / "database.db", options)
            model = reconstruct(colmap, job, stage.progress)
        sparse.mkdir()
        model.write_binary(str(sparse))
    return _summarise(model, survey)


def import_model(path: Path, survey: Survey) -> Any:
    """Return the COLMAP model at `path` (a `pycolmap.Reconstruction`), reduced to the survey's images.

    Raises:
        InputError: the folder holds no COLMAP model, or fewer than 3 of its images are in the survey.
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
