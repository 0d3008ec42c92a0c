"""Solution that all blocks of a survey share: similarity, cameras, lens, constant errors, exposures.

Reads the survey, the SfM model, the geolocated points and the initial similarity. Writes `solution.json`.
"""

from __future__ import annotations

from pipelines.adjust.frozen_solution import solve_once, with_exposures
from pipelines.core.products import save_json
from pipelines.core.workspace import StageRun, Summary
from pipelines.scene.scene import load_initial_scene, photographs
from pipelines.scene.track_exposures import exposures_from_tracks
from pipelines.train.options import SolutionOptions


def run(stage: StageRun, options: SolutionOptions) -> Summary:
    """Write the solution, and return its key figures.

    Raises:
        DegenerateGeometryError: the measurements leave the similarity open.
        GeorefError: a product or a photograph cannot be read.
    """
    workspace = stage.workspace
    initial, survey, scene = load_initial_scene(workspace)
    solution = solve_once(scene, survey, initial, options)
    if options.exposure:
        images = photographs(scene.sparse, survey, workspace, options.max_image_size)
        images.build(stage.progress)
        solution = with_exposures(solution, exposures_from_tracks(scene, images, stage.progress))
    save_json(solution, stage.out / "solution.json")
    values = {
        "cameras": len(solution.cameras),
        "gnss_outliers": list(solution.gnss_outliers),
        "control_outliers": list(solution.control_outliers),
        "estimated_errors": [error.model_dump() for error in solution.estimated_errors],
    }
    return Summary(f"{len(solution.cameras)} cameras solved", values, cautions=solution.cautions)
