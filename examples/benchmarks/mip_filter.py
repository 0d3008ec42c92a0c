"""PSNR of test views zoomed out, trained with the mip filter and without: `mip_filter.py WORKSPACE FOLDER`.

Needs a workspace up to init-sim3, which is copied into the folder for each training. Photographs at a half, a
quarter and an eighth of the training's size are means over the pixels of the whole size.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import cv2
import numpy as np
import torch

from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import ViewPose
from pipelines.splat.exposure import with_affine
from pipelines.splat.metrics import psnr
from pipelines.surface.photometry import photograph_and_mask
from pipelines.surface.surface_views import model_renderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import read_sfm, read_trained

_SHRINKS = (1, 2, 4, 8)


def main() -> None:
    """Print a line a training: seed, filter, Gaussians, and the mean PSNR at each size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--max-image-size", type=int, default=480)
    args = parser.parse_args()
    for seed in range(args.seeds):
        for mip_filter in (False, True):
            root = args.folder / f"{'mip' if mip_filter else 'plain'}{seed}"
            if not root.exists():
                shutil.copytree(args.workspace, root, symlinks=True)
            options = {name: getattr(args, name) for name in ("iterations", "max_gaussians", "max_image_size")}
            run_stage(Workspace(root), BY_NAME["train"], {**options, "seed": seed, "mip_filter": mip_filter})
            count, figures = _zoomed_out(Workspace(root))
            print(root.name, count, *(f"1/{k}: {db:.2f} dB" for k, db in figures.items()), flush=True)


def _zoomed_out(workspace: Workspace) -> tuple[int, dict[int, float]]:
    """Return the number of Gaussians, and the mean PSNR of the test views by how much they are shrunken."""
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey)
    figures: dict[int, list[float]] = {shrink: [] for shrink in _SHRINKS}
    for index in model.indices("test"):
        photo, mask = photograph_and_mask(renderer, index)
        pose, exposure = renderer.pose(index), model.cameras[index].exposure
        for shrink, found in figures.items():
            small = pose.pinhole.limited(max(pose.pinhole.width, pose.pinhole.height) // shrink)
            size = small.width, small.height
            shown = torch.from_numpy(cv2.resize(photo.numpy(), size, interpolation=cv2.INTER_AREA))
            counts = cv2.resize(mask.numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
            colour = renderer.render(ViewPose(small, pose.cam_from_model, pose.center_in_model)).colour.cpu()
            colour = colour if exposure is None else with_affine(colour, torch.tensor(exposure))
            found.append(psnr(colour, shown, torch.from_numpy(counts)))
    return len(renderer.gaussians), {shrink: float(np.mean(found)) for shrink, found in figures.items()}


if __name__ == "__main__":
    main()
