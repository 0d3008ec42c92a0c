"""A survey whose photographs are renders of known Gaussians, which training should recover."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import save_posterior
from pipelines.core.products import load_json, save_json, save_npz
from pipelines.core.stages import ADJUSTMENT, POINTS, SIM3_POSTERIOR, SPARSE, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse
from pipelines.geometry.cameras import Camera, Pinhole
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.sh import sh_from_rgb
from pipelines.survey.survey import Survey
from tests.scenes import (
    Measured,
    Noise,
    TrueScene,
    looking_at,
    sparse_model,
    survey_of,
    write_workspace,
)

CAMERA = Camera("PINHOLE", 96, 72, np.array([90.0, 90.0, 48.0, 36.0]))
# Of the surface's Gaussians: metres between them, and their standard deviation along the ground.
SPACING_M, SIGMA_M = 1.6, 0.9
NOISE = Noise(fix_m=(0.05, 0.05, 0.08), pixel_px=0.1, mark_px=0.1, gcp_m=1e-4)
TEST_VIEWS = (3, 9)
# Too few for density control, which would turn differences of rounding into differences of tenths of a dB.
TRAINING = {"georeference": "joint", "iterations": 150, "sh_degree": 0, "log_every": 5}


@dataclass(frozen=True)
class Rendered:
    """True scene, its Gaussians in `geo`, and the measurements of it."""

    scene: TrueScene
    gaussians: Gaussians
    survey: Survey
    sparse: SparseModel


def ground_height(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return the height of a smooth hill, in metres."""
    return 6.0 * np.exp(-(east**2 + north**2) / 300.0)


def true_gaussians(rng: np.random.Generator) -> Gaussians:
    """Return opaque, flat, randomly coloured Gaussians on the hill, out to 36 m."""
    grid = np.arange(-36.0, 36.1, SPACING_M)
    east, north = (axis.ravel() for axis in np.meshgrid(grid, grid))
    count = len(east)
    patch = rng.uniform(0.1, 0.9, (12, 12, 3))
    cell = np.clip(((np.column_stack([east, north]) + 36) // 6).astype(int), 0, 11)
    colour = np.clip(patch[cell[:, 0], cell[:, 1]] + rng.normal(0, 0.08, (count, 3)), 0, 1)
    return Gaussians(
        means=torch.from_numpy(np.column_stack([east, north, ground_height(east, north)])).float(),
        quats_wxyz=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.tensor([SIGMA_M, SIGMA_M, 0.1]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 4.0),
        sh=sh_from_rgb(torch.from_numpy(colour)).float()[:, None],
    )


def true_scene(rng: np.random.Generator, images: int = 14, points: int = 500) -> TrueScene:
    """Return two rings of cameras that look down on the hill, with points, control and check places on it."""
    angle = np.linspace(0, 2 * np.pi, images, endpoint=False)
    height = np.where(np.arange(images) % 2, 30.0, 38.0)
    center = np.column_stack([32 * np.cos(angle), 32 * np.sin(angle), height])
    place = rng.uniform(-26, 26, (points, 2))
    marked = np.array([[-10.0, -8], [9, -11], [12, 8], [-7, 11], [1, 2], [-14, 2]])
    return TrueScene(
        center,
        looking_at(center, rng.normal(0, 2, center.shape) * [1, 1, 0]),
        np.column_stack([place, ground_height(*place.T)]),
        np.column_stack([marked, ground_height(*marked.T)]),
        camera=CAMERA,
    )


def make_rendered(seed: int = 0) -> Rendered:
    """Return the survey with six check points and two test views, and its SfM model."""
    rng = np.random.default_rng(seed)
    scene, gaussians = true_scene(rng), true_gaussians(rng)
    survey = survey_of(scene, NOISE, Measured(gcps=True), rng)
    images = tuple(
        image.model_copy(update={"split": "test"}) if index in TEST_VIEWS else image
        for index, image in enumerate(survey.images)
    )
    update = {"images": images, "check_points": survey.control_points, "control_points": (), "image_dir": "photos"}
    sparse = sparse_model(scene, NOISE, rng)
    east, north = scene.point_in_geo[:, 0], scene.point_in_geo[:, 1]
    nearest = (
        np.abs(gaussians.means[:, None, :2].numpy() - np.column_stack([east, north])).max(axis=2).argmin(axis=0)
    )
    rgb = (0.5 + 0.28209479 * gaussians.sh[nearest, 0].numpy()).clip(0, 1)
    sparse = replace(sparse, point_rgb=(255 * rgb).astype(np.uint8))
    return Rendered(scene, gaussians, survey.model_copy(update=update), sparse)


def write_photographs(rendered: Rendered, folder: Path) -> None:
    """Render every view into a PNG of its name."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = Pinhole(CAMERA.width, CAMERA.height, *CAMERA.params)
    scene = rendered.scene
    for name, center, rotation in zip(scene.names, scene.center_in_geo, scene.geo_from_cam, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ center
        with torch.no_grad():
            view = CpuRasterizer().render(
                rendered.gaussians, torch.from_numpy(pose).float(), camera, RasterSettings(sh_degree=0)
            )
        rgb = (255 * view.colour.clamp(0, 1)).round().byte().numpy()
        # The names end in .jpg, whose losses would be noise: the content is PNG, which OpenCV goes by.
        (folder / name).write_bytes(cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())


def write_rendered(root: Path, rendered: Rendered) -> Workspace:
    """Return a workspace as the stages before training leave it; the photographs must be in `root/photos`."""
    workspace = write_workspace(root, rendered.survey, rendered.sparse)
    adjust_workspace(workspace)
    return workspace


def adjust_workspace(workspace: Workspace, options: InitSim3Options | None = None) -> None:
    """Write what `geolocate` and `init-sim3` make of survey and model."""
    survey, sparse = load_json(Survey, workspace.path(SURVEY)), read_sparse(workspace.path(SPARSE))
    points = geolocate(survey, sparse, GeolocateOptions()).points
    save_npz(workspace.root / POINTS, vars(points))
    posterior, _ = estimate_similarity(survey, sparse, points, options or InitSim3Options())
    save_json(posterior.solution, workspace.root / ADJUSTMENT)
    save_posterior(posterior, workspace.root / SIM3_POSTERIOR)


@dataclass(frozen=True)
class RenderedFlight:
    """Rendered survey, the folder of its photographs and the cache of what is made from these."""

    rendered: Rendered
    root: Path
    seed: int

    def workspace(self, name: str) -> Workspace:
        """Return a new workspace of that name, ready to train.

        Workspaces of one flight share their cache: depth maps would take half of the time of a short training.
        """
        root = self.root / name
        root.mkdir()
        for shared in ("photos", "cache"):
            (self.root / shared).mkdir(exist_ok=True)
            (root / shared).symlink_to(self.root / shared)
        return write_rendered(root, self.rendered)
