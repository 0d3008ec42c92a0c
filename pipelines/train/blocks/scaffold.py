"""Training of the scaffold: a coarse model of the whole survey with sky and horizon.

In the training of a block its Gaussians outside the block stand in for the rest of the world. Reads the survey, the
SfM model, the initial similarity and the solution. Writes `gaussians.ply` in `model`.
"""

from pipelines.core.stages import SOLUTION
from pipelines.core.workspace import StageRun, Summary
from pipelines.splat.gaussians import write_gaussians
from pipelines.splat.memory import free_memory_bytes, require_memory
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.survey.block_plan import SCAFFOLD_IMAGE_PX, scaffold_gaussians
from pipelines.survey.scene import load_solved_scene, photographs
from pipelines.train.estimate import training_size
from pipelines.train.georeference.problem import frozen_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.loop import train_in_folder
from pipelines.train.options import TrainOptions
from pipelines.train.solution_state import frozen_exposures
from pipelines.train.trainer import make_trainer

_SHARE = 0.5  # of a block's iterations
_MOST_ITERATIONS, _MOST_LOOKS = 3_000, 10_000


def run(stage: StageRun, options: TrainOptions) -> Summary:
    """Train the scaffold, and return its key figures; errors are those of `train.stage.run`."""
    backend, workspace = rasterizer(options.backend, mip_filter=options.mip_filter), stage.workspace
    solution, survey, scene = load_solved_scene(workspace, SOLUTION)
    coarse = coarse_options(options, len(scene.train))
    images = photographs(scene.sparse, survey, workspace, coarse.effort.max_image_size)
    require_memory(training_size(coarse, len(images), images.largest()), free_memory_bytes(backend.device))
    images.build(stage.progress)
    exposures = frozen_exposures(solution, backend.device)
    trainer = make_trainer(
        TrainingScene(scene, images), frozen_problem(solution, scene), backend, coarse, exposures
    )
    record = train_in_folder(stage, trainer, coarse)
    gaussians = trainer.optimizer.gaussians.detached()
    write_gaussians(stage.out / "gaussians.ply", gaussians)
    values = {"gaussians": len(gaussians), "iterations": trainer.iteration, "seconds": round(record.seconds, 1)}
    return Summary(f"{len(gaussians)} Gaussians of the whole", values)


def coarse_options(options: TrainOptions, photographs_count: int) -> TrainOptions:
    """Return the options of the scaffold's training, of those of the blocks: less effort, and no stereo.

    Each of the training photographs is looked at once, if they are not too many.
    """
    effort, looks = options.effort, min(photographs_count, _MOST_LOOKS)
    return options.model_copy(
        update={
            "iterations": max(min(int(_SHARE * effort.iterations), _MOST_ITERATIONS), looks),
            "max_gaussians": scaffold_gaussians(effort.max_gaussians),
            "max_image_size": min(effort.max_image_size, SCAFFOLD_IMAGE_PX),
            "georeference": "frozen",
            "dense": False,
        }
    )
