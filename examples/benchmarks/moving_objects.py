"""Measure what objects cost that move between photographs: python examples/benchmarks/moving_objects.py --help.

Discs of one colour are painted into the training photographs of a workspace, in each at other places. The workspace
is trained with and without them, and with and without `--robust-photometric`. The table has the PSNR of the clean
test views, and the PSNR of the training views against the clean photographs at the pixels of the discs.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from training import ViewQuality, trainer_on, undistorted

from pipelines.core.types import BoolArray, ByteArray
from pipelines.core.workspace import Workspace
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.survey.photographs import ImageCache, save_array
from pipelines.survey.scene import SparseScene, load_solved_scene
from pipelines.train.options import TrainOptions
from pipelines.train.trainer import JointTrainer


def discs(shape: tuple[int, int], count: int, share: float, random: np.random.Generator) -> BoolArray:
    """Mask (H, W) of discs whose diameter is a share of the longer side."""
    mask = np.zeros(shape, dtype=np.uint8)
    for _ in range(count):
        centre = (int(random.integers(shape[1])), int(random.integers(shape[0])))
        cv2.circle(mask, centre, max(1, round(0.5 * share * max(shape))), 1, -1)
    return mask.astype(bool)


def paint(
    scene: SparseScene, images: ImageCache, arguments: argparse.Namespace, *, write: bool
) -> dict[int, tuple[BoolArray, ByteArray]]:
    """Paint the undistorted training photographs, if `write`; returns mask and clean photograph of each."""
    random, painted = np.random.default_rng(arguments.seed), {}
    for index in map(int, scene.train):
        clean = np.array(images.image(index))
        mask = discs(clean.shape[:2], arguments.objects, arguments.size, random)
        changed = clean.copy()
        changed[mask] = random.integers(0, 256, 3)
        if write:
            save_array(Path(images.image(index).filename), changed)  # type: ignore[attr-defined]
        painted[index] = (mask, clean)
    return painted


@torch.no_grad()
def psnr_at(trainer: JointTrainer, painted: dict[int, tuple[BoolArray, ByteArray]]) -> float:
    """PSNR of all painted pixels together, with the exposures of the photographs."""
    squares = []
    for index, (mask, clean) in painted.items():
        pose = trainer.problem.unknowns.cam_from_model(index)
        settings = RasterSettings(sh_degree=trainer.options.sh_degree)
        colour = trainer.rasterizer.render(
            trainer.optimizer.gaussians, pose, trainer.pinholes.of(index), settings
        ).colour
        if trainer.exposures is not None:
            colour = trainer.exposures.apply(index, colour)
        squares.append(((colour.numpy() - clean / 255.0)[mask] ** 2).ravel())
    return float(-10 * np.log10(np.concatenate(squares).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path, help="with init-sim3 done; copied")
    parser.add_argument("scratch", type=Path, help="folder for the copies")
    parser.add_argument("--objects", type=int, default=6, help="in each photograph")
    parser.add_argument("--size", type=float, default=0.06, help="of an object, in longer sides of the photograph")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--max-image-size", type=int, default=320)
    parser.add_argument("--max-gaussians", type=int, default=40_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("objects  robust  processor s  test PSNR dB  PSNR at the objects dB")
    for objects in (False, True):
        root = arguments.scratch / ("painted" if objects else "clean")
        shutil.copytree(arguments.workspace, root, ignore=shutil.ignore_patterns("cache", "train"))
        painted = None
        for robust in (False, True):
            options = TrainOptions(
                iterations=arguments.iterations,
                max_image_size=arguments.max_image_size,
                max_gaussians=arguments.max_gaussians,
                robust_photometric=robust,
                seed=arguments.seed,
            )
            if painted is None:
                _, survey, scene = load_solved_scene(Workspace(root))
                images = undistorted(root, scene, survey, options)
                painted = paint(scene, images, arguments, write=objects)
            trainer, scene, images = trainer_on(root, options)
            worked = time.process_time()
            for _ in range(arguments.iterations):
                trainer.step()
            worked = time.process_time() - worked
            quality = ViewQuality(trainer, images).psnr(scene.test)
            at_objects = psnr_at(trainer, painted)
            print(f"{objects!s:7}  {robust!s:6}  {worked:11.0f}  {quality:12.2f}  {at_objects:10.2f}", flush=True)


if __name__ == "__main__":
    main()
