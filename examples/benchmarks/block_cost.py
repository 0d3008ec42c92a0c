"""Fit the model of a block's time and memory, and check it on other blocks: block_cost.py WORKSPACE --scratch DIR.

The workspace has been run up to init-sim3. Blocks of several sizes are trained for a few iterations, each in a
process of its own with one thread. Every second block serves the fit, and the others tell its error, by the sizes
that were measured in training and by those that the plan had predicted before. Times are those of the processor.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from blocks import copied, georef
from fitted_cost import fitted_cost, work_of

from pipelines.core.products import load_json
from pipelines.survey.block_plan import BlockPlan, BlockTraining, PlannedBlock

# Blocks, Gaussians of the whole, longest side of the photographs.
_SIZES = ((2, 10_000, 240), (3, 30_000, 320), (4, 60_000, 400), (4, 120_000, 320), (3, 120_000, 480))


def measured(workspace: Path, scratch: Path, iterations: int) -> list[tuple[PlannedBlock, BlockTraining]]:
    """Train blocks of all sizes, and return them as planned and as trained."""
    blocks = []
    for count, gaussians, size in _SIZES:
        place = copied(workspace, scratch / f"{count}-{gaussians}-{size}", scratch / "cache")
        georef(
            *("train", place, "--blocks", count, "--max-gaussians", gaussians, "--max-image-size", size),
            *("--iterations", iterations, "--log-every", 2, "--no-dense", "--no-coarse-to-fine", "--threads", 1),
        )
        blocks += [
            (planned, load_json(BlockTraining, place / f"blocks/{planned.id}/block/record.json"))
            for planned in load_json(BlockPlan, place / "blocks/plan/plan.json").blocks
        ]
    return blocks


def main() -> None:
    """Print measured and predicted cost of each block, and the largest error of those that were held out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--scratch", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=100)
    args = parser.parse_args()
    args.scratch.mkdir(parents=True, exist_ok=True)
    blocks = measured(args.workspace, args.scratch, args.iterations)
    records = [record for _, record in blocks]
    sizes = np.array([[row.mean_px, row.mean_visible, row.mean_gaussians + row.surroundings] for row in records])
    # The plan's number of Gaussians is a limit, which so short a training does not reach where points are few.
    visible = [planned.visible * record.mean_gaussians / planned.gaussians for planned, record in blocks]
    in_plan = np.column_stack([[planned.view_px for planned, _ in blocks], visible, sizes[:, 2]])
    seconds = np.array([row.processor_s for row in records], dtype=np.float64)
    memory = np.array([row.peak_bytes or np.nan for row in records], dtype=np.float64)
    time, peak = fitted_cost(sizes[::2], seconds[::2]), fitted_cost(sizes[::2], memory[::2])
    print(f"{'pixels':>9}{'visible':>9}{'all':>9}{'ms':>8}{'model':>8}{'plan':>8}{'MiB':>8}{'model':>8}")
    for row, (size, before, took, held) in enumerate(zip(sizes, in_plan, seconds, memory, strict=True)):
        values = 1e3 * took, 1e3 * time.of(work_of(size)), 1e3 * time.of(work_of(before))
        print(
            "".join(f"{value:9.0f}" for value in size)
            + "".join(f"{value:8.1f}" for value in values)
            + f"{held / 2**20:8.0f}{peak.of(work_of(size)) / 2**20:8.0f}"
            + ("  held out" if row % 2 else "")
        )
    for what, predicted, truth in (
        ("time by measured sizes", [time.of(work_of(size)) for size in sizes], seconds),
        ("time by the plan's sizes", [time.of(work_of(size)) for size in in_plan], seconds),
        ("memory", [peak.of(work_of(size)) for size in sizes], memory),
    ):
        error = np.abs(np.array(predicted) / truth - 1)[1::2]
        print(f"{what}, held out: median {100 * np.median(error):.0f} %, largest {100 * error.max():.0f} %")
    print("seconds", fitted_cost(sizes, seconds))
    print("bytes", fitted_cost(sizes, memory))


if __name__ == "__main__":
    main()
