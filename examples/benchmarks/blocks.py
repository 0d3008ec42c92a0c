"""Compare a training in blocks with one run of as many Gaussians: python examples/benchmarks/blocks.py --help.

    georef simulate survey --scene city --flight grid --images 400 --size 480x360
    georef run WORKSPACE --images survey/images … --to init-sim3
    python examples/benchmarks/blocks.py WORKSPACE --scratch /tmp/blocks --blocks 4

The workspace is read, and copied twice into the scratch folder. Blocks have as many iterations each as makes the
number of looks at a photograph equal in both trainings, unless --block-iterations says otherwise. The table has the
PSNR of the test views, their PSNR in the bands along the seams, and the RMSE of check points found in the model.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pipelines.core.products import load_json
from pipelines.core.stages import BLOCK_RECORD, REPORT
from pipelines.core.types import BoolArray, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.block_plan import BlockCell, BlockRecord
from pipelines.survey.navigation import load_survey
from pipelines.survey.report import read_report
from pipelines.survey.solution import read_sfm, read_trained

# Half the width of the bands along the seams, relative to the square root of a cell's mean area.
_BAND = 0.05
_PRODUCTS = ("ingest", "sfm", "calibrate", "geolocate", "sim3", "georef.toml")


def georef(*arguments: object) -> Any:
    """Run a command with `--json`, its log on stderr, and return its document."""
    command = [sys.executable, "-m", "georef_cli", *map(str, arguments), "--json"]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def copied(source: Path, target: Path, cache: Path) -> Path:
    """Copy what training reads, and return the new workspace, whose cache is shared; an existing one is kept."""
    target.mkdir(parents=True, exist_ok=True)
    for name in _PRODUCTS:
        if (source / name).is_dir() and not (target / name).exists():
            shutil.copytree(source / name, target / name)
        elif (source / name).is_file():
            shutil.copyfile(source / name, target / name)
    cache.mkdir(exist_ok=True)
    if not (target / "cache").exists():
        (target / "cache").symlink_to(cache.resolve(), target_is_directory=True)
    return target


def near_seams(points: FloatArray, cells: Sequence[BlockCell], half_width_m: float) -> BoolArray:
    """Return which of points (N, 3) in `model` lie near a side that two cells share, as a mask (N,)."""
    held = sum(cell.widened((half_width_m, half_width_m)).contains(points).astype(int) for cell in cells)
    return np.asarray(held > 1)


def squared_errors(place: Path, record: BlockRecord, half_width_m: float) -> dict[str, list[float]]:
    """Return the mean squared error of each test view: of the whole view, and of the band along the seams."""
    workspace = Workspace(place)
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey)
    images = renderer.images
    errors: dict[str, list[float]] = {"whole": [], "band": []}
    for index in model.indices("test"):
        render = renderer.render(index).colour.clamp(0, 1).cpu()
        photo = torch.from_numpy(np.array(images.image(index))).float() / 255.0
        error = (render - photo).square().mean(dim=-1).numpy()
        mask = np.array(images.mask(index))
        depth, pose = renderer.depth_m(index), renderer.pose(index)
        points = pose.pinhole.points_at(depth) @ pose.cam_from_model + pose.center_in_model
        cells = [block.cell for block in record.blocks]
        band = near_seams(points, cells, half_width_m).reshape(depth.shape) & mask & (depth > 0)
        errors["whole"].append(float(error[mask].mean()))
        if band.sum() > 100:
            errors["band"].append(float(error[band].mean()))
    return errors


def mean_psnr(errors: Sequence[float]) -> float:
    """Return the mean PSNR of views, in decibels; NaN without any."""
    return float(np.mean(-10 * np.log10(np.maximum(errors, 1e-10)))) if errors else float("nan")


def measured(place: Path, record: BlockRecord, half_width_m: float) -> dict[str, float | None]:
    """Return the figures of a trained and evaluated workspace."""
    errors = squared_errors(place, record, half_width_m)
    report = read_report(place / REPORT)
    found = report.checkpoints.surface
    training = json.loads((place / "train/manifest.json").read_text(encoding="utf-8"))
    return {
        "psnr_db": mean_psnr(errors["whole"]),
        "band_psnr_db": mean_psnr(errors["band"]),
        "rmse_h_m": None if found is None else found.rmse_h_m,
        "rmse_v_m": None if found is None else found.rmse_v_m,
        "gaussians": training["values"]["gaussians"],
        "training_s": training["duration_s"],
    }


def cell_side(place: Path) -> float:
    """Return the square root of the mean area of a cell, in metres, from the extent of the SfM points."""
    model = read_trained(Workspace(place))
    points = model.point_in_model(read_sfm(Workspace(place), model))
    low, high = np.quantile(points[:, :2], [0.01, 0.99], axis=0)
    record = load_json(BlockRecord, place / BLOCK_RECORD)
    return float(np.sqrt(np.prod(high - low) / len(record.blocks)))


def main() -> None:
    """Train both ways, and print a table; the figures are also written to `blocks.json` in the scratch folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--scratch", type=Path, required=True)
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--iterations", type=int, default=2_000)
    parser.add_argument("--block-iterations", type=int)
    parser.add_argument("--image-size", type=int, default=320)
    parser.add_argument("--threads", type=int)
    parser.add_argument("--more", nargs="*", default=[], help="Further options of `georef train`.")
    args = parser.parse_args()
    cache = args.scratch / "cache"
    args.scratch.mkdir(parents=True, exist_ok=True)
    one, divided = (copied(args.workspace, args.scratch / name, cache) for name in ("one", "blocks"))
    threads = () if args.threads is None else ("--threads", args.threads)
    size = ("--max-gaussians", args.gaussians, "--max-image-size", args.image_size, *args.more, *threads)
    plan = georef("train", divided, "--part", "plan", "--blocks", args.blocks, *size)
    looks = np.mean([len(block["cameras"]) for block in plan["blocks"]]) / plan["photographs"]
    of_block = args.block_iterations or round(args.iterations * looks)
    georef("train", one, "--iterations", args.iterations, "--blocks", 1, *size)
    georef("train", divided, "--iterations", of_block, "--blocks", args.blocks, *size)
    for place in (one, divided):
        georef("evaluate", place, *threads)
    record, half_width_m = load_json(BlockRecord, divided / BLOCK_RECORD), _BAND * cell_side(divided)
    figures = {name: measured(place, record, half_width_m) for name, place in (("one", one), ("blocks", divided))}
    document = {"iterations": args.iterations, "block_iterations": of_block, "band_m": half_width_m, **figures}
    (args.scratch / "blocks.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(f"{'':14}{'one run':>12}{f'{args.blocks} blocks':>12}")
    for name in figures["one"]:
        values = (figures[way][name] for way in ("one", "blocks"))
        print(f"{name:14}" + "".join(f"{'–' if value is None else f'{value:.3f}':>12}" for value in values))


if __name__ == "__main__":
    main()
