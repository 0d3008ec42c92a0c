"""The gsplat backend without a GPU: gsplat's own Python code over kernels of a CPU. The real ones: tests/gpu."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer import cuda
from pipelines.splat.rasterizer.api import RasterSettings, Window
from pipelines.splat.rasterizer.reference import render_reference
from tests.gsplat_on_cpu import gsplat_on_cpu
from tests.splat.rasterizer.parity import BACKGROUND, CASES, assert_parity


@pytest.fixture
def rasteriser(monkeypatch):
    gsplat = gsplat_on_cpu(monkeypatch)
    monkeypatch.setattr(cuda, "load_gsplat", lambda progress: gsplat)
    return cuda.CudaRasterizer()


@pytest.mark.parametrize("case", CASES)
def test_images_and_gradients(make_scene, camera, rasteriser, case):
    count, log_scale, degree, depth = case
    settings = RasterSettings(sh_degree=degree, background=BACKGROUND, depth=depth, normal=depth)
    assert_parity(rasteriser, "cpu", make_scene(count, seed=count, log_scale=log_scale), camera, settings)


def test_mip_filter_is_gsplats(make_scene, camera, rasteriser):
    settings = RasterSettings(1, BACKGROUND, depth=True, normal=True, mip_filter=True)
    assert_parity(rasteriser, "cpu", make_scene(150, seed=7, log_scale=-2.5), camera, settings)


def test_depth_variance_and_without_median(make_scene, leaves, camera, rasteriser):
    scene = make_scene(60, seed=4, log_scale=-0.5)
    settings = RasterSettings(0, BACKGROUND, depth=True, median=False)
    expected = render_reference(*leaves(scene, torch.float64), camera, settings)
    render = rasteriser.render(*leaves(scene, torch.float32), camera, settings)
    assert render.median_depth is None
    # A difference of squares of up to 8 m in float32: 1e-5 of 64 m².
    difference = (render.depth_variance.double() - expected.depth_variance).abs()
    assert (difference > 1e-3).double().mean() < 1e-3


def test_a_window_is_cut_from_the_image(make_scene, leaves, camera, rasteriser):
    scene, window = make_scene(60, seed=4), Window(13, 7, 40, 30)
    whole, part = (
        rasteriser.render(
            *leaves(scene, torch.float32), camera, RasterSettings(1, BACKGROUND, depth=True, window=cut)
        )
        for cut in (None, window)
    )
    for name in ("colour", "alpha", "expected_depth", "median_depth"):
        torch.testing.assert_close(getattr(part, name), getattr(whole, name)[7:37, 13:53])
    assert torch.equal(part.stats.visible, whole.stats.visible)


def test_background_shows_where_nothing_lies(make_scene, camera, rasteriser):
    gaussians, pose = _moved_away(make_scene(3))
    for background in (BACKGROUND, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        render = rasteriser.render(gaussians, pose, camera, RasterSettings(0, background))
        torch.testing.assert_close(render.colour, torch.tensor(background).expand(45, 70, 3))


def test_a_camera_of_numpys_numbers_renders_the_same(make_scene, leaves, camera, rasteriser):
    """Cameras that COLMAP read hold them; of two equal ones, the constants of the first are kept."""
    of_numpy = Pinhole(camera.width, camera.height, *np.array([camera.fx, camera.fy, camera.cx, camera.cy]))
    cuda._row.cache_clear()
    images = [
        rasteriser.render(*leaves(make_scene(60, seed=4), torch.float32), of, RasterSettings(1, BACKGROUND)).colour
        for of in (of_numpy, camera)
    ]
    assert torch.equal(*images)


def test_without_depth_there_is_none(make_scene, leaves, camera, rasteriser):
    render = rasteriser.render(*leaves(make_scene(12), torch.float32), camera, RasterSettings(0, BACKGROUND))
    assert render.colour.shape == (45, 70, 3)
    assert (render.expected_depth, render.depth_variance, render.median_depth, render.normal) == (None,) * 4


def test_nothing_visible(make_scene, camera, rasteriser):
    gaussians, pose = _moved_away(make_scene(3))
    render = rasteriser.render(gaussians, pose, camera, RasterSettings(0, BACKGROUND, depth=True, normal=True))
    assert len(render.stats.visible) == 0
    for image in (render.alpha, render.median_depth, render.expected_depth, render.normal):
        assert image.abs().max() == 0


def _moved_away(scene):
    gaussians, pose = scene
    gaussians = Gaussians(*(tensor.float() for tensor in gaussians.tensors().values()))
    gaussians.means -= 100 * pose[2, :3].float()
    return gaussians, pose
