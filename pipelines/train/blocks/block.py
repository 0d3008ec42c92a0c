"""Training of one block: the Gaussians of its cell and overlap, while the scaffold stands in for the rest.

Reads the survey, the SfM model, the initial similarity, the plan, the solution and the scaffold. Writes
`gaussians.ply` in `model` with the Gaussians of cell and overlap, `record.json`, `metrics.jsonl` and the latest
checkpoint. The command is idempotent, and continues from the checkpoint.
"""

import json
import math
from dataclasses import replace

import numpy as np
import torch

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.machine import peak_memory_bytes, thread_count
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import BLOCK_PLAN, SCAFFOLD, SOLUTION
from pipelines.core.workspace import StageRun, Summary
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.splat.memory import free_memory_bytes, require_memory
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.area import boundary_area
from pipelines.survey.block_plan import BlockPlan, BlockTraining, PlannedBlock
from pipelines.survey.scene import load_solved_scene, photographs
from pipelines.train.estimate import training_size
from pipelines.train.georeference.problem import frozen_problem
from pipelines.train.initial_gaussians import TrainingScene
from pipelines.train.loop import METRICS, TrainingRecord, train_in_folder
from pipelines.train.options import BlockTrainOptions
from pipelines.train.region import RegionMasks, SceneBox, TrainingRegion, region_masks
from pipelines.train.solution_state import frozen_exposures
from pipelines.train.surface import SceneSurface
from pipelines.train.trainer import JointTrainer, make_trainer

_LEAST_VIEWS = 2
_LAST_ROWS = 20


def run(stage: StageRun, options: BlockTrainOptions) -> Summary:
    """Train the block, and return its figures; errors as of `train.stage.run`, or too few photographs show it."""
    backend, workspace = rasterizer(options.backend, mip_filter=options.mip_filter), stage.workspace
    block = load_json(BlockPlan, workspace.path(BLOCK_PLAN)).block(options.id)
    solution, survey, whole = load_solved_scene(workspace, SOLUTION)
    box = SceneBox.around(whole.point_in_model)
    index = whole.sparse.image_index()
    rows = np.array([index[name] for name in block.cameras if name in index], dtype=np.int64)
    if len(rows) < _LEAST_VIEWS:
        raise DegenerateGeometryError(
            "block-unseen",
            f"Block {block.id} is seen by {len(rows)} photographs only: reduce --blocks.",
        )
    solution, scene = solution.of_images(rows), whole.of_images(rows)
    options = options.model_copy(update={"max_gaussians": block.gaussians, "georeference": "frozen"})
    images = photographs(scene.sparse, survey, workspace, options.effort.max_image_size)
    scaffold = read_gaussians(workspace.path(SCAFFOLD)).to(backend.device)
    size = training_size(options, len(images), images.largest(), beside=len(scaffold))
    require_memory(size, free_memory_bytes(backend.device))
    images.build(stage.progress)
    maps = None
    if options.dense:
        maps = DepthMaps(workspace.cache / "surface", scene, images)
        maps.build(stage.progress)
    masks = region_masks(
        solution,
        scene.train,
        images,
        backend,
        cell=block.region,
        stand_in=scaffold,
        maps=maps,
        progress=stage.progress,
    )
    seeing = masks.seeing
    if len(seeing) < _LEAST_VIEWS:
        raise DegenerateGeometryError(
            "block-unseen",
            f"The surface of block {block.id} is seen by {len(seeing)} photographs only: reduce --blocks.",
        )
    surface = None if maps is None else SceneSurface(maps)
    region = _region(block, box, scaffold, masks)
    area = boundary_area(options, scene.geo_from_model.apply(whole.point_in_model), survey.origin)
    training = TrainingScene(replace(scene, train=seeing), images, surface, region, area)
    exposures = frozen_exposures(solution, backend.device)
    trainer = make_trainer(training, frozen_problem(solution, scene), backend, options, exposures)
    earlier = None if stage.extends is None else stage.extends / "record.json"
    done = load_json(BlockTraining, earlier).iterations if earlier is not None and earlier.is_file() else 0
    record = train_in_folder(stage, trainer, options, done)
    measured = _measured(stage, trainer, block, record)
    write_gaussians(stage.out / "gaussians.ply", trainer.optimizer.gaussians.detached())
    save_json(measured, stage.out / "record.json")
    return Summary(
        f"block {block.id}: {measured.gaussians_in_cell} Gaussians, train PSNR {measured.train_psnr:.2f} dB",
        measured.model_dump(mode="json"),
    )


def _region(block: PlannedBlock, box: SceneBox, scaffold: Gaussians, masks: RegionMasks) -> TrainingRegion:
    means = scaffold.means.cpu().double().numpy()
    inside = block.region.contains(means)
    rows = torch.from_numpy(~inside), torch.from_numpy(inside & ~box.contains(means))
    outside, sky = (scaffold.select(mask.to(scaffold.means.device)) for mask in rows)
    return TrainingRegion(block.region, box, outside, sky.to(torch.device("cpu")), masks)


def _measured(stage: StageRun, trainer: JointTrainer, block: PlannedBlock, record: TrainingRecord) -> BlockTraining:
    rows = [json.loads(line) for line in (stage.out / METRICS).read_text(encoding="utf-8").splitlines()]
    means = {name: float(np.mean([row[name] for row in rows])) for name in ("gaussians", "visible", "pixels")}
    gaussians, region = trainer.optimizer.gaussians.detached(), trainer.region
    assert region is not None
    in_cell = block.cell.contains(gaussians.means.cpu().double().numpy())
    return BlockTraining(
        id=block.id,
        iterations=trainer.iteration,
        gaussians=len(gaussians),
        gaussians_in_cell=int(in_cell.sum()),
        photographs=len(trainer.views.camera),
        seconds=record.seconds,
        processor_s=None if math.isnan(record.processor_s) else record.processor_s,
        mean_gaussians=means["gaussians"],
        mean_visible=means["visible"],
        mean_px=means["pixels"],
        surroundings=len(region.surroundings),
        peak_bytes=peak_memory_bytes(),
        threads=thread_count(),
        backend=trainer.rasterizer.name,
        train_psnr=float(np.mean([row["psnr"] for row in rows[-_LAST_ROWS:]])),
    )
