"""The CPU rasteriser gives the reference's images and gradients, and its own gradients pass gradcheck."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings, Window
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.rasterizer.reference import render_reference

# float64 differs by the order of sums alone. In float32 an exponent down to −5.5 is off by some 1e-6, and depths
# of several metres scale it; gradients sum some 1e3 such terms of either sign.
TOLERANCE = {torch.float64: (1e-12, 1e-10), torch.float32: (1e-5, 1e-4)}
BACKGROUND = (0.2, 0.5, 0.9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    # Number of Gaussians, logarithm of their size, degree of the harmonics; with depth, normals, mip filter.
    "case",
    [
        (150, -2.0, 3, True, True, False),
        (150, -1.0, 2, True, False, False),
        (400, -3.0, 1, False, True, False),
        (60, 0.3, 0, True, True, False),
        (200, -2.0, 1, False, False, False),
        (150, -2.0, 2, True, True, True),
        (400, -3.5, 1, False, False, True),
    ],
)
def test_images_and_gradients(make_scene, leaves, loss_of, camera, dtype, case):
    count, log_scale, degree, depth, normal, mip_filter = case
    scene = make_scene(count, seed=count, log_scale=log_scale)
    settings = RasterSettings(degree, BACKGROUND, depth=depth, normal=normal, mip_filter=mip_filter)
    (expected_gaussians, expected_pose), (gaussians, pose) = leaves(scene, torch.float64), leaves(scene, dtype)
    expected = render_reference(expected_gaussians, expected_pose, camera, settings)
    render = CpuRasterizer().render(gaussians, pose, camera, settings)

    image_error, gradient_error = TOLERANCE[dtype]
    for name in ("colour", "alpha", "expected_depth", "depth_variance", "median_depth", "normal"):
        ours, theirs = getattr(render, name), getattr(expected, name)
        assert (ours is None) == (theirs is None)
        if ours is not None:
            assert ours.dtype == dtype
            # The variance is what is left of squares of up to 100 m².
            scale = 100 if name == "depth_variance" else 10
            torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=scale * image_error)
    assert torch.equal(render.stats.visible, expected.stats.visible)

    loss_of(expected).backward()
    loss_of(render).backward()
    pairs = {name: (tensor, expected_gaussians.tensors()[name]) for name, tensor in gaussians.tensors().items()}
    pairs["cam_from_model"] = (pose, expected_pose)
    for name, (ours, theirs) in pairs.items():
        error = (ours.grad - theirs.grad).abs().max() / theirs.grad.abs().max()
        assert error < gradient_error, f"{name}: {error}"
    gradient, truth = render.stats.mean_gradient, expected.stats.mean_gradient
    assert (gradient - truth).abs().max() < max(gradient_error, 1e-6) * truth.abs().max()


@pytest.mark.parametrize("window", [Window(0, 0, 3, 2), Window(13, 9, 20, 17), Window(40, 30, 5, 5)])
def test_window_is_a_part_of_the_image(make_scene, leaves, camera, window):
    # Off the middle, where the limit of the linear projection would move if the window were a camera of its own.
    gaussians, pose = make_scene(300, seed=4, log_scale=-1.0)
    settings = RasterSettings(sh_degree=3, background=BACKGROUND, depth=True, normal=True)
    whole = render_reference(gaussians, pose, camera, settings)
    render = CpuRasterizer().render(gaussians, pose, camera, replace(settings, window=window))
    rows, columns = slice(window.top, window.top + window.height), slice(window.left, window.left + window.width)
    for name in ("colour", "alpha", "expected_depth", "median_depth", "normal"):
        torch.testing.assert_close(getattr(render, name), getattr(whole, name)[rows, columns], rtol=0, atol=1e-11)


@pytest.mark.usefixtures("one_thread")
# The last ones reach so far towards the camera that the slopes of their depths are shortened.
@pytest.mark.parametrize(
    ("degree", "seed", "log_scale", "mip_filter"),
    [
        (3, 1, -1.0, False),
        pytest.param(1, 2, -1.0, False, marks=pytest.mark.slow),
        pytest.param(0, 3, 0.7, False, marks=pytest.mark.slow),
        pytest.param(0, 4, -2.0, True, marks=pytest.mark.slow),
    ],
)
def test_gradcheck(make_scene, degree, seed, log_scale, mip_filter):
    # More than one tile each way, and big Gaussians: rows, columns and tiles all end somewhere within them.
    (gaussians, pose), camera = (
        make_scene(4, seed=seed, degree=degree, log_scale=log_scale),
        Pinhole(19, 35, 16, 15, 9, 17),
    )

    def images(*inputs):
        settings = RasterSettings(degree, BACKGROUND, depth=True, normal=True, mip_filter=mip_filter)
        render = CpuRasterizer().render(Gaussians(*inputs[:5]), inputs[5], camera, settings)
        return render.colour, render.alpha, render.expected_depth, render.normal

    inputs = [tensor.requires_grad_() for tensor in (*gaussians.tensors().values(), pose)]
    assert torch.autograd.gradcheck(images, inputs, check_undefined_grad=False)


def test_stored_degree_above_the_one_in_use_gets_no_gradient(make_scene, leaves, loss_of, camera):
    gaussians, pose = leaves(make_scene(50), torch.float32)
    loss_of(CpuRasterizer().render(gaussians, pose, camera, RasterSettings(sh_degree=1))).backward()
    assert gaussians.sh.grad[:, :4].abs().max() > 0
    assert gaussians.sh.grad[:, 4:].abs().max() == 0


def test_gradient_of_negative_colours_is_cut(make_scene, leaves, camera):
    gaussians, pose = leaves(make_scene(50, degree=0), torch.float32)
    with torch.no_grad():
        gaussians.sh[:, 0, 0] = -5.0
    CpuRasterizer().render(gaussians, pose, camera, RasterSettings(sh_degree=0)).colour.sum().backward()
    assert gaussians.sh.grad[..., 0].abs().max() == 0
    assert gaussians.sh.grad[..., 1].abs().max() > 0
