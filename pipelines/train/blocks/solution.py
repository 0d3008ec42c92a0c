"""Solution that all blocks of a survey share: the adjustment, with the exposures of the photographs.

Reads the survey, the SfM model and the adjustment. Writes `solution.json`.
"""

from pipelines.core.products import save_json
from pipelines.core.workspace import StageRun, Summary
from pipelines.survey.scene import load_solved_scene, photographs
from pipelines.train.options import SolutionOptions
from pipelines.train.solution_state import with_exposures
from pipelines.train.track_exposures import exposures_from_tracks


def run(stage: StageRun, options: SolutionOptions) -> Summary:
    """Write the solution, and return its key figures; raises a `GeorefError` if something cannot be read."""
    workspace = stage.workspace
    solution, survey, scene = load_solved_scene(workspace)
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
    return Summary(f"{len(solution.cameras)} cameras", values, cautions=solution.cautions)
