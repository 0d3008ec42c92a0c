"""A training of a few hundred Gaussians on six small photographs, which are renders of known ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from pipelines.adjust.state import State
from pipelines.geometry.cameras import Camera, CameraPoses, Pinhole
from pipelines.geometry.similarity import Similarity
from pipelines.splat.densify import DefaultSettings, DefaultStrategy, Strategy
from pipelines.splat.exposure import Exposures
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.optimizer import GaussianAdam
from pipelines.splat.outlier_pixels import OutlierPixels
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.survey.photographs import ImageCache, Photograph
from pipelines.train.georeference.problem import GeoProblem
from pipelines.train.georeference.unknowns import SolutionUnknowns
from pipelines.train.schedule import JointOptions
from pipelines.train.trainer import JointTrainer, TrainingViews

CAMERA = Camera("PINHOLE", 64, 48, np.array([60.0, 60.0, 32.0, 24.0]))
PINHOLE = Pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)
EXTENT_M = 2.0
SETTINGS = DefaultSettings(start=4, stop=60, every=8, reset_every=0, max_gaussians=400)


def true_gaussians(count: int = 200, seed: int = 0) -> Gaussians:
    """Return coloured blobs that cover a wall 4 m away: photographs have no holes."""
    random = torch.Generator().manual_seed(seed)
    place = torch.rand(count, 2, generator=random) * torch.tensor([8.0, 5.0]) - torch.tensor([4.0, 2.5])
    return Gaussians(
        torch.cat([place, torch.full((count, 1), 4.0)], dim=1),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        torch.full((count, 3), -1.0),
        torch.full((count,), 2.0),
        torch.randn(count, 4, 3, generator=random) * torch.tensor([1.0, 0.0, 0.0, 0.0])[:, None],
    )


def poses(count: int = 6) -> CameraPoses:
    """Return cameras beside each other that look along z."""
    center = np.column_stack([np.linspace(-1, 1, count), np.zeros(count), np.zeros(count)])
    return CameraPoses(np.tile(np.eye(3), (count, 1, 1)), center)


def photographs(folder: Path, scene: Gaussians, gains: tuple[float, ...] = (1.0,) * 6) -> ImageCache:
    """Write renders of the scene as PNG files, each times its gain, and return the cache over them."""
    shots = []
    for index, gain in enumerate(gains):
        pose = torch.eye(4)
        pose[0, 3] = -float(poses(len(gains)).cam_center_in_model[index, 0])
        colour = CpuRasterizer().render(scene, pose, PINHOLE, RasterSettings(sh_degree=0)).colour
        file = folder / f"{index}.png"
        cv2.imwrite(str(file), (gain * colour).clamp(0, 1).mul(255).round().byte().numpy()[..., ::-1])
        shots.append(Photograph(file.name, file, CAMERA))
    return ImageCache(folder / "cache", shots, 64)


def trainer(
    images: ImageCache,
    options: JointOptions,
    *,
    strategy: Strategy | None = None,
    with_exposures: bool = False,
    outliers: OutlierPixels | None = None,
    count: int = 200,
) -> JointTrainer:
    """Return a trainer that starts from the true places, grey and small."""
    start = true_gaussians(count)
    start = replace(start, log_scales=start.log_scales - 0.5, sh=torch.zeros_like(start.sh))
    train = np.arange(len(images))
    state = State(Similarity(), np.zeros((len(images), 6)), np.zeros(0))
    unknowns = SolutionUnknowns.frozen(poses(len(images)), state)
    exposures = Exposures(torch.eye(3, 4).repeat(len(images), 1, 1), torch.from_numpy(train), options.iterations)
    return JointTrainer(
        GaussianAdam(start, EXTENT_M, options.iterations),
        strategy or DefaultStrategy(SETTINGS, EXTENT_M, len(start)),
        GeoProblem(unknowns, len(images)),
        TrainingViews(train, images),
        rasterizer=CpuRasterizer(),
        options=options,
        exposures=exposures if with_exposures else None,
        outliers=outliers,
    )
