"""Time the rasters of a large splat: python examples/benchmarks/orthophoto.py WORKSPACE [--help].

The Gaussians of a trained workspace are multiplied: each is replaced by smaller ones that are drawn from it. The
size of the cells is chosen for the wanted number of cells. Nothing is written into the workspace.
"""

from __future__ import annotations

import argparse
import math
import resource
import shutil
import tempfile
import time
from pathlib import Path

import torch

from pipelines.core.manifest import MANIFEST
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS
from pipelines.core.workspace import Workspace
from pipelines.splat.gaussians import Gaussians, read_gaussians, rotation_matrices, write_gaussians


def multiplied(gaussians: Gaussians, count: int) -> Gaussians:
    """Return about `count` Gaussians on the same surface."""
    times = max(round(count / len(gaussians)), 1)
    many = gaussians.select(torch.arange(len(gaussians)).repeat_interleave(times))
    generator = torch.Generator().manual_seed(0)
    along = torch.randn(len(many), 3, generator=generator) * many.log_scales.exp()
    many.means = many.means + (rotation_matrices(many.quats_wxyz) @ along[..., None])[..., 0]
    # As large as their share of the disc.
    many.log_scales = many.log_scales - 0.5 * math.log(times)
    return many


def main() -> None:
    """Print time, size and peak memory."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--cells", type=float, default=1e8)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        copy = Workspace(Path(place) / "workspace")
        shutil.copytree(args.workspace, copy.root, symlinks=True)
        gaussians = multiplied(read_gaussians(copy.path(GAUSSIANS)), args.gaussians)
        (copy.root / "train" / MANIFEST).unlink(missing_ok=True)
        write_gaussians(copy.path(GAUSSIANS), gaussians)
        spec = BY_NAME["export-raster"]
        first = run_stage(copy, spec, {"gsd": 1.0, "hillshade": False}).manifest.values
        gsd = math.sqrt(first["columns"] * first["rows"] / args.cells)
        start = time.perf_counter()
        values = run_stage(copy, spec, {"gsd": gsd, "contours": 1.0}).manifest.values
        seconds = time.perf_counter() - start
        cells = values["columns"] * values["rows"]
        size = sum(file.stat().st_size for file in (copy.root / spec.folder).iterdir()) / 2**20
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{len(gaussians)} Gaussians, {cells / 1e6:.0f} M cells of {gsd:.4f}: {seconds:.0f} s, {size:.0f} MiB")
    print(f"peak memory {peak:.2f} GiB")


if __name__ == "__main__":
    main()
