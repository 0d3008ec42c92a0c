"""Merged model: of each block the Gaussians in its cell, and the solution that all blocks have held."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.blocks.parts import Parts
from pipelines.blocks.seams import compare_neighbours
from pipelines.core.files import file_size
from pipelines.core.products import load_json, save_json
from pipelines.core.progress import Progress
from pipelines.core.stages import MODEL, SIM3_POSTERIOR, SOLUTION, TRAIN_POSTERIOR, TRAIN_SEAMS
from pipelines.core.workspace import Summary
from pipelines.formats.splat_ply import join_splat_plys
from pipelines.scene.block_plan import BlockPlan
from pipelines.scene.block_record import BlockRecord, BlockTraining, MergedBlock, Seam
from pipelines.scene.trained_model import Adjustment, TrainedModel
from pipelines.splat.storage import read_gaussians

_BLACK = (0.0, 0.0, 0.0)


def merge_blocks(parts: Parts, plan: BlockPlan, folder: Path, progress: Progress) -> Summary:
    """Write the product of `train` from the trained blocks of a plan, and return its key figures.

    Args:
        parts: of the training.
        plan: of the blocks, all of which are trained.
        folder: receives the product.
        progress: shows the comparison of neighbours.

    Raises:
        InputError: a block cannot be read.
    """
    trainings = [parts.training(block) for block in plan.blocks]
    cells = [_gaussians_in_cell(parts, block.id) for block in plan.blocks]
    count = join_splat_plys(cells, folder / "gaussians.ply")
    solution = load_json(Adjustment, parts.whole.path(SOLUTION))
    model = TrainedModel(
        **dict(solution),
        max_image_size=parts.options.effort.max_image_size,
        background=_BLACK,
        sh_degree=read_gaussians(cells[0], slice(0, 1)).sh_degree,
        iterations=max(training.iterations for training in trainings),
        gaussians=count,
        backend=trainings[0].backend,
    )
    save_json(model, folder / Path(MODEL).name)
    # Blocks hold the adjustment of init-sim3: its covariances stay.
    shutil.copyfile(parts.workspace.path(SIM3_POSTERIOR), folder / Path(TRAIN_POSTERIOR).name)
    _write_metrics(parts, plan, folder / "metrics.jsonl")
    seams = compare_neighbours(parts, plan, solution, progress)
    blocks = tuple(
        MergedBlock(cell=block.cell, training=training)
        for block, training in zip(plan.blocks, trainings, strict=True)
    )
    save_json(BlockRecord(blocks=blocks, seams=seams), folder / "blocks.json")
    return _summary(model, trainings, seams)


def _gaussians_in_cell(parts: Parts, number: int) -> Path:
    """Return the file of the Gaussians of a cell, adapted to those of its neighbours."""
    return parts.whole.root / TRAIN_SEAMS.folder / f"{number}.ply"


def _write_metrics(parts: Parts, plan: BlockPlan, path: Path) -> None:
    """Write metrics of the whole: means over the blocks, and sums of Gaussians and seconds."""
    by_iteration: dict[int, list[dict[str, float]]] = {}
    for block in plan.blocks:
        source = parts.of_block(block.id).path("block/metrics.jsonl")
        file_size(source)
        for line in source.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            by_iteration.setdefault(int(row["iteration"]), []).append(row)
    with path.open("w", encoding="utf-8") as lines:
        for iteration, rows in sorted(by_iteration.items()):
            if len(rows) == len(plan.blocks):
                lines.write(json.dumps({"iteration": iteration, **_joined(rows)}) + "\n")


def _joined(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    means = {name: float(np.mean([row[name] for row in rows])) for name in ("photometric", "psnr")}
    sums = {name: sum(row[name] for row in rows) for name in ("seconds", "gaussians")}
    return means | sums


def _summary(model: TrainedModel, trainings: Sequence[BlockTraining], seams: Sequence[Seam]) -> Summary:
    psnr = float(np.average([t.train_psnr for t in trainings], weights=[t.photographs for t in trainings]))
    sigma = np.sqrt(np.diag(np.array(model.geo_from_model.covariance)))
    values = {
        "blocks": len(trainings),
        "iterations": model.iterations,
        "gaussians": model.gaussians,
        "train_psnr": round(psnr, 3),
        "seconds": round(sum(training.seconds for training in trainings), 1),
        "similarity_sigma_m": [round(float(value), 5) for value in sigma[4:]],
        "gnss_outliers": list(model.gnss_outliers),
        "control_outliers": list(model.control_outliers),
        "estimated_errors": [error.model_dump() for error in model.estimated_errors],
    }
    key_figure = f"{model.gaussians} gaussians in {len(trainings)} blocks, train PSNR {psnr:.2f} dB"
    if seams:
        spread = math.sqrt(_pooled([seam.depth_nmad_m for seam in seams], seams))
        values |= {
            "seams": len(seams),
            "seam_depth_nmad_m": round(spread, 5),
            "seam_depth_shift_m": round(max(abs(seam.depth_median_m) for seam in seams), 5),
            "seam_colour_rms": round(math.sqrt(_pooled([seam.colour_rms for seam in seams], seams)), 5),
        }
        key_figure += f", neighbours agree to {spread:.3f} m"
    return Summary(key_figure, values, cautions=model.cautions)


def _pooled(values: Sequence[float], seams: Sequence[Seam]) -> float:
    """Return the mean square of values of seams, each weighted by its pixels."""
    return float(np.average(np.square(values), weights=[seam.pixels for seam in seams]))
