"""A workspace whose trained model is the truth of a rendered survey, to be viewed and measured in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pipelines.core.products import save_json
from pipelines.core.stages import GAUSSIANS, MODEL
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, read_gaussians, write_gaussians
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.navigation import load_survey
from pipelines.survey.scene import photographs
from pipelines.survey.solution import read_sfm, read_trained
from tests.scenes import GEO_FROM_LOCAL, trained_cameras, trained_model
from tests.splat_scenes import (
    CAMERA,
    SPACING_M,
    TEST_VIEWS,
    Rendered,
    ground_height,
    write_photographs,
    write_rendered,
)
from tests.trained_workspaces import write_adjustment

FINE_M = 0.6  # between the Gaussians
# The fixes' σ, about: what a similarity from twelve of them has.


def smooth(rendered: Rendered) -> Rendered:
    """Return the survey with finer Gaussians that follow the slope of the hill: a surface without steps."""
    grid = np.arange(-36.0, 36.1, FINE_M)
    east, north = (axis.ravel() for axis in np.meshgrid(grid, grid))
    height, step = ground_height(east, north), 1e-3
    by_east = (ground_height(east + step, north) - height) / step
    by_north = (ground_height(east, north + step) - height) / step
    # The rotation that brings the upright onto the normal by the shortest way, as 1 + n · z and z × n.
    length = np.sqrt(1 + by_east**2 + by_north**2)
    quats = np.column_stack([1 + 1 / length, by_north / length, -by_east / length, np.zeros_like(east)])
    nearest = [
        np.argmin(np.abs(np.arange(-36.0, 36.1, SPACING_M)[:, None] - axis), axis=0) for axis in (north, east)
    ]
    coarse = nearest[0] * len(np.arange(-36.0, 36.1, SPACING_M)) + nearest[1]
    count = len(east)
    gaussians = Gaussians(
        means=torch.from_numpy(np.column_stack([east, north, height])).float(),
        quats_wxyz=torch.from_numpy(quats).float(),
        log_scales=torch.tensor([0.5 * FINE_M, 0.5 * FINE_M, 0.02]).log().repeat(count, 1),
        logit_opacities=torch.full((count,), 3.0),
        sh=rendered.gaussians.sh[torch.from_numpy(coarse)],
    )
    return replace(rendered, gaussians=gaussians)


def viewed_workspace(root: Path, rendered: Rendered) -> Workspace:
    """Return a workspace as `train` would leave it at best: its model is the truth, and its frame is `geo`."""
    root.mkdir(parents=True, exist_ok=True)
    scene = rendered.scene
    write_photographs(rendered, root / "photos")
    workspace = write_rendered(root, rendered)
    poses = CameraPoses(np.swapaxes(scene.geo_from_cam, 1, 2), scene.center_in_geo)
    cameras = trained_cameras(scene.names, poses, test=TEST_VIEWS)
    model = trained_model(Similarity(), GEO_FROM_LOCAL, cameras=cameras).model_copy(
        update={"sh_degree": 0, "max_image_size": CAMERA.width, "gaussians": len(rendered.gaussians)}
    )
    save_json(model, root / MODEL)
    write_gaussians(root / GAUSSIANS, rendered.gaussians)
    write_adjustment(workspace)
    return workspace


def renderer_of(workspace: Workspace) -> ModelRenderer:
    """Return the renderer of a workspace's model."""
    model = read_trained(workspace)
    sfm, gaussians = read_sfm(workspace, model), read_gaussians(workspace.path(GAUSSIANS))
    images = photographs(sfm, load_survey(workspace), workspace, model.max_image_size)
    return ModelRenderer(model, sfm, gaussians, images, CpuRasterizer())
