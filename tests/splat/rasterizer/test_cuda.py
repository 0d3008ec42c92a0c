"""The gsplat backend without a GPU: what it makes of gsplat's results.

A stand-in plays gsplat on the CPU: it projects by the reference, and blends and lists intersections by brute force,
in the shapes and the order of gsplat 1.5.3. The real kernels are tested in tests/gpu.
"""

from __future__ import annotations

import pytest
import torch

from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer import cuda
from pipelines.splat.rasterizer.api import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterSettings
from pipelines.splat.rasterizer.reference import project_gaussians, render_reference, view_colours

BACKGROUND = (0.1, 0.7, 0.4)


class StandIn:
    """gsplat's three functions that the backend calls."""

    def rasterization(self, means, quats, scales, opacities, colors, viewmats, Ks, width, height, **options):
        assert options["packed"] and viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3)
        assert options["backgrounds"].tolist() == [pytest.approx(BACKGROUND)]
        gaussians = Gaussians(means, quats, scales.log(), torch.logit(opacities), colors)
        camera = self.camera
        assert (width, height, Ks[0, 0, 2].item()) == (camera.width, camera.height, camera.cx)
        settings = RasterSettings(options["sh_degree"], BACKGROUND, options["near_plane"], options["eps2d"])
        with torch.no_grad():
            rows = render_reference(gaussians, viewmats[0], camera, settings).stats.visible
        seen, pose = gaussians.select(rows), viewmats[0]
        in_cam = seen.means @ pose[:3, :3].T + pose[:3, 3]
        means2d, cov = project_gaussians(seen, in_cam, pose, camera, options["eps2d"])
        inverse = torch.linalg.inv(cov)
        conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], dim=-1)
        meta = {"means2d": means2d, "conics": conics, "opacities": opacities[rows], "depths": in_cam[:, 2]}
        meta |= {"gaussian_ids": rows, "tile_size": 16, "isect_offsets": None}
        meta["flatten_ids"] = torch.argsort(meta["depths"])
        colours = view_colours(seen, pose, options["sh_degree"])
        image, alpha = self.rasterize_to_pixels(
            means2d, conics, colours, opacities[rows], width, height, 16, None, meta["flatten_ids"], packed=True
        )
        return image + (1 - alpha) * options["backgrounds"], alpha, meta

    def rasterize_to_pixels(
        self, means2d, conics, colors, opacities, width, height, tile_size, offsets, order, *, packed
    ):
        assert packed and tile_size == 16 and colors.shape in ((len(means2d), 3), (len(means2d), 9))
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        dx, dy = (center[order, None, None] - at for center, at in zip(means2d.T, (u, v), strict=True))
        a, b, c = conics[order].T[:, :, None, None]
        alpha = opacities[order, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha.clamp(max=ALPHA_MAX), 0.0)
        after = torch.cumprod(1 - alpha, dim=0)
        counted = after > TRANSMITTANCE_MIN
        weight = torch.where(counted, alpha * torch.cat([torch.ones_like(after[:1]), after[:-1]]), 0.0)
        return torch.einsum("nhw,nc->hwc", weight, colors[order])[None], weight.sum(dim=0)[None, ..., None]

    def rasterize_to_indices_in_range(
        self, start, end, transmittances, means2d, conics, opacities, width, height, tile_size, offsets, order
    ):
        assert start == 0 and end > 1_000_000 and transmittances.shape == (1, height, width)
        intersections = []
        for pixel in range(width * height):
            transmittance = 1.0
            for index in order.tolist():
                dx, dy = means2d[0, index] - torch.tensor([pixel % width + 0.5, pixel // width + 0.5])
                a, b, c = conics[0, index]
                alpha = min(
                    ALPHA_MAX,
                    (opacities[0, index] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).item(),
                )
                if alpha < ALPHA_MIN:
                    continue
                transmittance *= 1 - alpha
                if transmittance <= TRANSMITTANCE_MIN:
                    break
                intersections.append((index, pixel))
        gaussian, pixel = torch.tensor(intersections).T
        return gaussian, pixel, torch.zeros_like(pixel)


@pytest.fixture
def backend(monkeypatch):
    stand_in = StandIn()
    monkeypatch.setattr(cuda, "load_gsplat", lambda progress: stand_in)
    return cuda.CudaRasterizer(), stand_in


def test_images_statistics_and_median(make_scene, leaves, camera, backend):
    rasteriser, stand_in = backend
    (gaussians, pose), settings = (
        leaves(make_scene(12, seed=4), torch.float32),
        RasterSettings(0, BACKGROUND, depth=True, normal=True),
    )
    small = type(camera)(20, 14, 18.0, 18.0, 10.0, 7.0)
    stand_in.camera = small
    truth = render_reference(gaussians, pose, small, settings)
    render = rasteriser.render(gaussians, pose, small, settings)
    torch.testing.assert_close(render.colour, truth.colour, rtol=0, atol=1e-5)
    torch.testing.assert_close(render.alpha, truth.alpha, rtol=0, atol=1e-5)
    torch.testing.assert_close(render.median_depth, truth.median_depth, rtol=0, atol=1e-5)
    assert (truth.median_depth > 0).any() and (truth.median_depth == 0).any()
    torch.testing.assert_close(render.expected_depth, truth.expected_depth, rtol=0, atol=1e-4)
    torch.testing.assert_close(render.depth_variance, truth.depth_variance, rtol=0, atol=1e-3)
    torch.testing.assert_close(render.normal, truth.normal, rtol=0, atol=1e-5)
    assert torch.equal(render.stats.visible, truth.stats.visible)
    render.colour.sum().backward()
    assert render.stats.mean_gradient.shape == (len(render.stats.visible), 2)


def test_gradients_of_depth_and_normals(make_scene, leaves, camera, backend, loss_of):
    rasteriser, stand_in = backend
    small = stand_in.camera = type(camera)(20, 14, 18.0, 18.0, 9.0, 8.0)
    settings = RasterSettings(0, BACKGROUND, depth=True, normal=True)
    scene = make_scene(12, seed=4, log_scale=-0.5)
    (gaussians, pose), (truth, truth_pose) = leaves(scene, torch.float32), leaves(scene, torch.float64)
    render = rasteriser.render(gaussians, pose, small, settings)
    expected = render_reference(truth, truth_pose, small, settings)
    loss_of(render).backward()
    loss_of(expected).backward()
    # float32 throughout: some 1e3 terms of either sign, and planes that tilt by metres over the image.
    pairs = [(ours.grad, truth.tensors()[name].grad) for name, ours in gaussians.tensors().items()]
    pairs += [(pose.grad, truth_pose.grad), (render.stats.mean_gradient, expected.stats.mean_gradient)]
    for ours, theirs in pairs:
        assert (ours - theirs).abs().max() < 1e-3 * theirs.abs().max()


def test_without_depth_there_is_none(make_scene, camera, backend):
    rasteriser, stand_in = backend
    stand_in.camera = camera
    gaussians, pose = make_scene(12, seed=4)
    gaussians = Gaussians(*(tensor.float() for tensor in gaussians.tensors().values()))
    render = rasteriser.render(gaussians, pose, camera, RasterSettings(0, BACKGROUND))
    assert render.colour.shape == (45, 70, 3)
    assert render.expected_depth is None
    assert render.depth_variance is None
    assert render.median_depth is None
    assert render.normal is None


def test_nothing_visible(make_scene, camera, backend):
    rasteriser, stand_in = backend
    stand_in.camera = camera
    gaussians, pose = make_scene(3)
    gaussians = Gaussians(*(tensor.float() for tensor in gaussians.tensors().values()))
    gaussians.means -= 100 * pose[2, :3].float()
    render = rasteriser.render(gaussians, pose, camera, RasterSettings(0, BACKGROUND, depth=True, normal=True))
    assert len(render.stats.visible) == 0
    assert render.median_depth.abs().max() == 0
    assert render.expected_depth.abs().max() == 0
    assert render.normal.abs().max() == 0
