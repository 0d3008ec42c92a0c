"""Renders of a model with the true Gaussians and cameras: they are the photographs, their depth is the ground's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.similarity import Similarity
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.scene import photographs
from tests.scenes import trained_cameras, trained_model
from tests.splat_scenes import CAMERA, SPACING_M, TEST_VIEWS, RenderedFlight, ground_height

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def renderer(flights: list[RenderedFlight]) -> ModelRenderer:
    """Of the true Gaussians in true cameras; the frame `model` is `geo`."""
    rendered, scene = flights[0].rendered, flights[0].rendered.scene
    poses = CameraPoses(np.swapaxes(scene.geo_from_cam, 1, 2), scene.center_in_geo)
    cameras = trained_cameras(scene.names, poses, test=TEST_VIEWS)
    model = trained_model(Similarity(), max_image_size=CAMERA.width, cameras=cameras)
    workspace = flights[0].workspace("renderer")
    images = photographs(rendered.sparse, rendered.survey, workspace, CAMERA.width)
    return ModelRenderer(model, rendered.sparse, rendered.gaussians, images, CpuRasterizer())


@pytest.mark.parametrize("index", [0, 5])
def test_render_is_the_photograph(renderer: ModelRenderer, index: int) -> None:
    render = renderer.render(index).colour.clamp(0, 1).numpy()
    photo = np.array(renderer.images.image(index)) / 255.0
    np.testing.assert_allclose(render, photo, atol=0.51 / 255)  # a photograph has eight bits


@pytest.mark.parametrize("index", [0, 5])
def test_depth_is_that_of_the_ground(renderer: ModelRenderer, index: int) -> None:
    depth, camera, poses = renderer.depth_m(index), renderer.images.pinhole(index), renderer.poses
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    place = (depth[..., None] * ray) @ poses.cam_from_model[index] + poses.cam_center_in_model[index]
    inside = (depth > 0) & (np.abs(place[..., :2]).max(axis=-1) < 30)
    height = place[inside][:, 2] - ground_height(*place[inside][:, :2].T)
    assert inside.sum() > 1000
    # The Gaussians are level and 0.1 m thick, on slopes of up to 0.3: half the diagonal of their grid away from a
    # centre, the surface is off by that much of the slope; uphill and downhill cancel.
    assert np.abs(np.median(height)) < 0.1
    assert np.quantile(np.abs(height), 0.9) < 0.3 * SPACING_M / np.sqrt(2) + 0.1


def test_key_changes_with_what_the_surface_depends_on(renderer: ModelRenderer) -> None:
    """A deliverable takes the maps of another for its own, by this key."""
    model, poses, gaussians = renderer.model, renderer.poses, renderer.gaussians
    moved = replace(poses, cam_center_in_model=poses.cam_center_in_model + np.array([0, 0, 1e-6]))
    cameras = trained_cameras([camera.name for camera in model.cameras], moved, test=TEST_VIEWS)
    opacity = torch.nextafter(gaussians.logit_opacities, torch.tensor(9.0))
    others = [
        (model, gaussians),
        (model, replace(gaussians, logit_opacities=opacity)),
        (model.model_copy(update={"mip_filter": True}), gaussians),
        (model.model_copy(update={"cameras": cameras}), gaussians),
    ]
    keys = {ModelRenderer(m, renderer.sfm, g, renderer.images, renderer.backend).key() for m, g in others}
    assert len(keys) == 4 and renderer.key() in keys
