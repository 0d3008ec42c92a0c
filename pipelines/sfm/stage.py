"""Stage `sfm`: structure from motion with COLMAP.

Reads `ingest/survey.json` and the photographs. Writes `sfm/sparse/` (a COLMAP model that COLMAP itself opens) and
`sfm/database.db` (features and matches). The model's frame is `local`: similar to the scene, with an arbitrary
place, rotation and scale. The positions measured by GNSS select the pairs to match, and remove the drift of a large
model before its last adjustment. Features and matches of a large survey are computed in chunks (`chunked.py`).
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipelines.core.child import run_in_child
from pipelines.core.errors import CrashError, DamagedPartialError, DegenerateGeometryError
from pipelines.core.machine import free_main_memory_bytes
from pipelines.core.plan import photograph_folder
from pipelines.core.products import load_json
from pipelines.core.progress import Progress
from pipelines.core.stages import SURVEY
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.colmap import quiet_colmap, write_reconstruction
from pipelines.sfm.chunks import ChunkPlan, is_chunked, join_chunks, remove_chunks, work_in_chunks
from pipelines.sfm.colmap_database import require_sound
from pipelines.sfm.features import SfmJob
from pipelines.sfm.memory import require_memory
from pipelines.sfm.options import SfmOptions
from pipelines.sfm.reconstruction import import_model, map_matches, reconstruct
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)

_FEW_REGISTERED = 0.8
_RUN_AGAIN = "run it again (finished features and matches are kept), or with a smaller `--max-image-size`"
_EXPORT_AGAIN = "COLMAP cannot read the imported model: export it again"


def run(stage: StageRun, options: SfmOptions) -> Summary:
    """Reconstruct the cameras and points, or import a model, and write the model.

    Raises:
        GeorefError: unreadable products, an error of `reconstruct` or `import_model`, or a crash of COLMAP.
        DegenerateGeometryError: fewer than three photographs are registered.
    """
    path = stage.workspace.path(SURVEY)
    survey = load_json(Survey, path)
    require_memory(len(survey.images), survey.largest_photograph_px, options, free_main_memory_bytes())
    plan = work_in_chunks(stage, survey, options) if is_chunked(len(survey.images), options) else None
    arguments = {
        "survey": str(path),
        "images": str(photograph_folder(stage.workspace, survey.image_dir)),
        "out": str(stage.out),
        "options": options.model_dump(mode="json"),
        "chunks": None if plan is None else plan.model_dump(mode="json"),
    }
    remedy = _EXPORT_AGAIN if options.import_model is not None else _RUN_AGAIN
    task = "pipelines.sfm.stage:write_model"
    try:
        document = run_in_child(task, arguments, remedy, stage.progress, writes=stage.out)
    except (CrashError, RuntimeError) as error:
        if stage.resumed and plan is None:
            cause = str(error).strip().splitlines()[-1]
            raise DamagedPartialError(f"COLMAP cannot continue it: {cause}", path=stage.out) from error
        raise
    return Summary(document["key_figure"], document["values"], tuple(document["warnings"]))


def write_model(arguments: Mapping[str, Any], progress: Progress) -> dict[str, Any]:
    """Reconstruct or import the model and write it; return the summary as a document.

    Args:
        arguments: paths of `survey`, `images` and `out`, the `options` of the stage, and the plan of its `chunks`,
            which are finished; None: there are none.
        progress: shows features, matches and mapping.

    Raises:
        GeorefError: as `run`.
    """
    survey, out = load_json(Survey, Path(arguments["survey"])), Path(arguments["out"])
    options = SfmOptions.model_validate(arguments["options"])
    sparse = out / "sparse"
    if sparse.exists():
        shutil.rmtree(sparse)
    with quiet_colmap() as colmap:
        if options.import_model is not None:
            model = import_model(options.import_model, survey)
        else:
            job = SfmJob(survey, Path(arguments["images"]), out / "database.db", options)
            plan = arguments["chunks"]
            if plan is None:
                require_sound(job.database)
                model = reconstruct(colmap, job, progress)
            else:
                join_chunks(colmap, job, ChunkPlan.model_validate(plan), out, progress)
                model = map_matches(colmap, job, progress)
        write_reconstruction(model, sparse)
    remove_chunks(out)
    return asdict(_summarise(model, survey))


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
