"""Fit the model of a block's time and memory, and check it on other blocks: block_cost.py WORKSPACE --scratch DIR.

The workspace has been run up to init-sim3. Blocks of several sizes are trained for a few iterations, each in a
process of its own with one thread. Every second block serves the fit, and the others tell its error. Times are
those of the processor, which other programs on the machine hardly change.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from blocks import copied, georef

from pipelines.core.products import load_json
from pipelines.core.types import FloatArray
from pipelines.scene.block_record import BlockTraining
from pipelines.train.pace import BlockCost

# Blocks, Gaussians of the whole, longest side of the photographs.
_SIZES = ((2, 10_000, 240), (3, 30_000, 320), (4, 60_000, 400), (4, 120_000, 320), (3, 120_000, 480))


def measured(workspace: Path, scratch: Path, iterations: int) -> list[BlockTraining]:
    """Train blocks of all sizes, and return their records."""
    records = []
    for count, gaussians, size in _SIZES:
        place = copied(workspace, scratch / f"{count}-{gaussians}-{size}", scratch / "cache")
        georef(
            *("blocks", "train", place, "--blocks", count, "--max-gaussians", gaussians, "--max-image-size", size),
            *("--iterations", iterations, "--log-every", 2, "--no-dense", "--no-coarse-to-fine", "--threads", 1),
        )
        records += [
            load_json(BlockTraining, place / f"blocks/{number}/block/record.json") for number in range(count)
        ]
    return records


def sizes_of(records: list[BlockTraining]) -> FloatArray:
    """Return pixels, visible and all Gaussians (B, 3) of blocks."""
    return np.array([[row.mean_px, row.mean_visible, row.mean_gaussians + row.surroundings] for row in records])


def main() -> None:
    """Print measured and predicted cost of each block, and the largest error of those that were held out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--scratch", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=40)
    args = parser.parse_args()
    args.scratch.mkdir(parents=True, exist_ok=True)
    records = [row for row in measured(args.workspace, args.scratch, args.iterations) if row.processor_s]
    sizes = sizes_of(records)
    seconds = np.array([row.processor_s for row in records], dtype=np.float64)
    memory = np.array([row.peak_bytes or np.nan for row in records], dtype=np.float64)
    model = BlockCost.fitted(sizes[::2], seconds[::2], memory[::2])
    print(f"{'pixels':>9}{'visible':>9}{'all':>9}{'ms':>8}{'model':>8}{'MiB':>8}{'model':>8}")
    errors = []
    for row, (size, took, peak) in enumerate(zip(sizes.tolist(), seconds, memory, strict=True)):
        predicted, predicted_bytes = model.iteration_s(*size), model.peak_bytes(*size)
        held_out = row % 2 == 1
        errors += [(predicted / took - 1, predicted_bytes / peak - 1)] if held_out else []
        print(
            "".join(f"{value:9.0f}" for value in size)
            + f"{1e3 * took:8.1f}{1e3 * predicted:8.1f}{peak / 2**20:8.0f}{predicted_bytes / 2**20:8.0f}"
            + ("  held out" if held_out else "")
        )
    worst = np.abs(errors).max(axis=0)
    print(f"held out: time within {100 * worst[0]:.0f} %, memory within {100 * worst[1]:.0f} %")
    every = BlockCost.fitted(sizes, seconds, memory)
    document = {"seconds": every.seconds.tolist(), "bytes": every.bytes.tolist(), "blocks": len(records)}
    print(json.dumps(document))


if __name__ == "__main__":
    main()
