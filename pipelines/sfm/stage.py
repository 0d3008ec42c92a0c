"""Stage `sfm`: structure from motion by an engine (`reconstructor.py`): COLMAP, or the import of a model.

Reads `ingest/survey.json` and the photographs. Writes `sfm/sparse/` (a COLMAP model that COLMAP itself opens) and
`sfm/database.db` (features and matches). The model's frame is `local`: similar to the scene, with an arbitrary
place, rotation and scale. The positions measured by GNSS select the pairs to match, and remove the drift of a large
model before its last adjustment.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.core.child import run_in_child
from pipelines.core.errors import CrashError, DamagedPartialError, DegenerateGeometryError, InputError
from pipelines.core.json_values import JsonValue
from pipelines.core.plan import photograph_folder
from pipelines.core.products import Remark, load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import COMMON_POINTS, RIG_MODEL, SURVEY
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import load_reconstruction, quiet_colmap
from pipelines.geometry.cameras import Reconstruction
from pipelines.sfm.dates import SolvedDate, tie_to_earlier
from pipelines.sfm.features import SfmJob, masks_beside
from pipelines.sfm.learned_weights import learned_remedy
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.reconstructor import reconstructor_of
from pipelines.sfm.unregistered import unregistered
from pipelines.survey.survey import Survey

_FEW_REGISTERED = 0.8


def run(stage: StageRun, options: SfmOptions) -> Summary:
    """Reconstruct the cameras and points, or import a model, and write the model.

    Raises:
        GeorefError: unreadable products, an error of the engine, or a crash of COLMAP.
        DegenerateGeometryError: fewer than three photographs are registered.
    """
    path = stage.workspace.path(SURVEY)
    survey, engine = surveyed(path, options), reconstructor_of(options)
    if options.earlier is not None:  # What cannot be tied is refused before the work begins.
        if options.earlier.resolve() == stage.workspace.root.resolve():
            raise InputError(
                "earlier-is-itself", "is this workspace itself.", field="--earlier", path=options.earlier
            )
        SolvedDate.load(options.earlier, survey)
    continues = engine.prepare(stage, survey, options)
    arguments = {
        "survey": str(path),
        "images": str(photograph_folder(stage.workspace, survey.image_dir)),
        "out": str(stage.out),
        "options": options.model_dump(mode="json"),
    }
    task = "pipelines.sfm.stage:write_model"
    try:
        document = run_in_child(task, arguments, engine.remedy, stage.progress, writes=stage.out)
    except (CrashError, RuntimeError) as error:
        if stage.resumed and continues:
            cause = str(error).strip().splitlines()[-1]
            raise DamagedPartialError(
                "partial-not-continued", f"COLMAP cannot continue it: {cause}", path=stage.out
            ) from error
        raise
    warnings = tuple(Remark(**warning) for warning in document["warnings"])
    return Summary(document["key_figure"], document["values"], warnings)


def write_model(arguments: Mapping[str, JsonValue], progress: Progress) -> dict[str, Any]:
    """Reconstruct or import the model and write it; return the summary as a document.

    Among the arguments are paths of `survey`, `images` and `out`, and the `options` of the stage.
    """
    options = SfmOptions.model_validate(arguments["options"])
    survey, database = surveyed(Path(arguments["survey"]), options), Path(arguments["out"]) / "database.db"
    job = SfmJob(survey, Path(arguments["images"]), database, options, masks_beside(arguments["survey"], survey))
    for folder in (job.sparse, job.sparse.with_name(Path(RIG_MODEL).name)):
        shutil.rmtree(folder, ignore_errors=True)
    model = reconstructor_of(options).reconstruct(job, progress)
    summary = _summarise(model, survey)
    if survey.companions and options.import_model is None:
        summary = _summarise_rig(load_reconstruction(job.sparse), model, survey)
    warnings = list(summary.warnings)
    if options.earlier is not None:
        if not database.is_file():
            message = "needs the features of the photographs, which an imported model with points has none of."
            raise InputError("earlier-needs-features", message, field="--earlier")
        with quiet_colmap() as colmap:
            common = tie_to_earlier(colmap, job, model, SolvedDate.load(options.earlier, survey), progress)
        common.save(job.sparse / Path(COMMON_POINTS).name)
        summary.values["common_points"] = len(common)
    if database.is_file():
        with quiet_colmap() as colmap:
            warnings += unregistered(colmap, database, model, learned_remedy(options.features))
    return {**vars(summary), "warnings": [warning.model_dump() for warning in warnings]}


def surveyed(path: Path, options: SfmOptions) -> Survey:
    """Return the survey, and among its images those of a rig's other lenses; without them for an imported model."""
    survey = load_json(Survey, path)
    return survey if options.import_model is not None else survey.with_companions()


def _summarise_rig(reference: Reconstruction, model: Reconstruction, survey: Survey) -> Summary:
    """Return the summary of the reference lens's photographs, with the number of all."""
    images = tuple(image for image in survey.images if image.name not in {each.name for each in survey.companions})
    summary = _summarise(reference, survey.model_copy(update={"images": images}))
    names = {model.images[image_id].name for image_id in model.reg_image_ids()}
    beside = sum(each.name in names for each in survey.companions)
    values = {**summary.values, "companions": len(survey.companions), "companions_registered": beside}
    figure = f"{summary.key_figure}, and {beside} of {len(survey.companions)} of the rig's other lenses"
    return Summary(figure, values, summary.warnings)


def _summarise(model: Reconstruction, survey: Survey) -> Summary:
    registered, total = model.num_reg_images(), len(survey.images)
    if registered < 3:
        raise DegenerateGeometryError(
            "too-few-registered",
            f"{registered} of {total} photographs could be registered; at least three are needed.",
        )
    error_px = model.compute_mean_reprojection_error()
    left_out = sorted(
        {image.name for image in survey.images} - {i.name for i in model.images.values() if i.has_pose}
    )
    warnings = []
    if registered < _FEW_REGISTERED * total:
        sentence = (
            f"{registered} of {total} photographs were registered: the splat will have holes. "
            f"Not registered: {', '.join(left_out[:5])}{' …' if len(left_out) > 5 else ''}."
        )
        warnings.append(Remark(code="few-photographs-registered", sentence=sentence))
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
