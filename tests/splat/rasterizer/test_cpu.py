"""Cut-offs, order, edge cases and reproducibility of the CPU rasteriser, each against a value known beforehand."""

from __future__ import annotations

import math
import threading

import numba
import pytest
import torch

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import ALPHA_MAX, RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer, predicted_bytes
from pipelines.splat.rasterizer.reference import render_reference
from tests.refusals import numbers, refused

SH_0 = math.sqrt(1 / (4 * math.pi))
FRONT = torch.eye(4)
PLAIN = RasterSettings(sh_degree=0, depth=True)


def stack(depths, logits, colours, *, sigma=500.0):
    """Return round Gaussians behind each other, wide enough to be constant over the image."""
    count = len(depths)
    means = torch.zeros(count, 3)
    means[:, 2] = torch.tensor(depths)
    return Gaussians(
        means=means,
        quats_wxyz=torch.tensor([[1.0, 0, 0, 0]]).expand(count, 4).contiguous(),
        log_scales=torch.full((count, 3), math.log(sigma)),
        logit_opacities=torch.tensor(logits),
        sh=((torch.tensor(colours) - 0.5) / SH_0)[:, None, :],
    )


def render(gaussians, camera, settings=PLAIN, pose=FRONT):
    return CpuRasterizer().render(gaussians, pose, camera, settings)


def gradients(gaussians, pose, camera, settings, loss_of):
    loss_of(render(gaussians, camera, settings, pose)).backward()
    return [tensor.grad for tensor in (*gaussians.tensors().values(), pose)]


def test_nothing_to_see_is_background(camera):
    background = (0.25, 0.5, 1.0)
    settings = RasterSettings(sh_degree=0, background=background, depth=True)
    behind = stack([-3.0], [2.0], [[1.0, 1, 1]], sigma=0.1)
    for gaussians in (behind, behind.select(torch.zeros(0, dtype=torch.long))):
        leaves = Gaussians(*(tensor.requires_grad_() for tensor in gaussians.tensors().values()))
        view = render(leaves, camera, settings)
        assert torch.equal(view.colour, torch.tensor(background).expand(45, 70, 3))
        assert view.alpha.abs().max() == 0
        assert view.expected_depth.abs().max() == 0
        assert view.median_depth.abs().max() == 0
        assert len(view.stats.visible) == 0
        (view.colour.sum() + view.expected_depth.sum()).backward()
        assert all((tensor.grad == 0).all() for tensor in leaves.tensors().values())
        assert view.stats.mean_gradient.shape == (0, 2)


def test_alpha_never_exceeds_its_maximum_and_ends_the_pixel(camera):
    # Behind α = 0.999 another such one would leave T = 1e-6 ≤ 1e-4: it is left out altogether.
    view = render(stack([2.0, 3.0], [30.0, 30.0], [[0.8, 0.2, 0.4], [1.0, 1, 1]]), camera)
    torch.testing.assert_close(view.alpha, torch.full((45, 70), ALPHA_MAX))
    torch.testing.assert_close(view.colour[20, 30], ALPHA_MAX * torch.tensor([0.8, 0.2, 0.4]))
    torch.testing.assert_close(view.expected_depth, torch.full((45, 70), 2.0))


def test_alpha_below_one_255th_is_left_out(camera):
    for opacity, expected in ((0.99 / 255, 0.0), (1.01 / 255, 1.01 / 255)):
        logit = math.log(opacity / (1 - opacity))
        view = render(stack([2.0], [logit], [[1.0, 1, 1]]), camera)
        torch.testing.assert_close(view.alpha, torch.full((45, 70), expected), rtol=1e-3, atol=0)


def test_nearer_gaussian_covers_whatever_the_order(camera):
    half = 0.0
    near, far = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
    for depths, colours in (([2.0, 5.0], [near, far]), ([5.0, 2.0], [far, near])):
        view = render(stack(depths, [half, half], colours), camera)
        torch.testing.assert_close(view.colour[10, 10], torch.tensor([0.5, 0.25, 0.0]), atol=1e-5, rtol=0)
        torch.testing.assert_close(
            view.expected_depth[10, 10], torch.tensor((0.5 * 2 + 0.25 * 5) / 0.75), atol=1e-3, rtol=0
        )


def test_median_depth_is_where_half_is_left(camera):
    logit = math.log(0.3 / 0.7)  # T = 0.7, 0.49 …: the second one crosses
    view = render(stack([4.0, 2.0, 3.0], [logit] * 3, [[1.0, 1, 1]] * 3), camera)
    torch.testing.assert_close(view.median_depth, torch.full((45, 70), 3.0))
    thin = render(stack([4.0], [logit], [[1.0, 1, 1]]), camera)
    assert thin.median_depth.abs().max() == 0


def test_candidates_alone_give_the_same_image_and_gradients(make_scene, leaves, camera):
    # Half of the Gaussians lie to the side or behind, where they must not be missed: some reach into the image.
    scene = make_scene(400, seed=3)
    with torch.no_grad():
        scene[0].means[::2] *= torch.tensor([6.0, 6.0, -1.0], dtype=torch.float64)
        scene[0].means[1::4] *= torch.tensor([2.5, 2.5, 1.0], dtype=torch.float64)
    (gaussians, pose), (_, again) = leaves(scene, torch.float64), leaves(scene, torch.float64)
    rows = CpuRasterizer().candidates(gaussians, pose, camera, RasterSettings())
    part = Gaussians(*(tensor.detach()[rows].requires_grad_() for tensor in gaussians.tensors().values()))
    whole_view, view = (
        render(gaussians, camera, RasterSettings(), pose),
        render(part, camera, RasterSettings(), again),
    )
    assert torch.equal(view.stats.among(rows).visible, whole_view.stats.visible)
    assert len(view.stats.visible) <= len(rows) < 300
    assert torch.equal(view.colour, whole_view.colour)
    whole_view.colour.square().sum().backward()
    view.colour.square().sum().backward()
    for name, tensor in part.tensors().items():
        torch.testing.assert_close(tensor.grad, gaussians.tensors()[name].grad[rows], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(again.grad, pose.grad, rtol=1e-9, atol=1e-9)


def test_near_plane(camera):
    gaussians = stack([1.0], [2.0], [[1.0, 1, 1]])
    assert render(gaussians, camera, RasterSettings(sh_degree=0, near_m=0.999)).alpha.min() > 0.5
    assert render(gaussians, camera, RasterSettings(sh_degree=0, near_m=1.001)).alpha.max() == 0


def test_long_thin_gaussians(make_scene, leaves, loss_of, camera):
    # 20 m × 1 mm, at every slant: the conic is nearly singular and most of each lies outside the image.
    scene = make_scene(30, seed=8)
    with torch.no_grad():
        scene[0].log_scales[:] = torch.tensor([3.0, -7.0, -7.0], dtype=torch.float64)
    (gaussians, pose), (truth, truth_pose) = leaves(scene, torch.float32), leaves(scene, torch.float64)
    settings = RasterSettings(depth=True)
    view, expected = (
        render(gaussians, camera, settings, pose),
        render_reference(truth, truth_pose, camera, settings),
    )
    # A screen length of 1000 px in float32 leaves 1e-4 px, and the flank of a Gaussian is 1/px steep; where that
    # decides about the cut-off, the step is 1/255.
    error = (view.colour.double() - expected.colour).abs()
    assert error.max() < 1 / 255
    assert (error > 3e-4).float().mean() < 1e-3
    loss_of(view).backward()
    loss_of(expected).backward()
    assert (gaussians.means.grad - truth.means.grad).norm() < 1e-2 * truth.means.grad.norm()


def test_extreme_parameters_keep_gradients_finite(make_scene, leaves, loss_of, camera):
    gaussians, pose = leaves(make_scene(64, seed=9), torch.float32)
    with torch.no_grad():
        gaussians.quats_wxyz[0] = 0.0
        gaussians.quats_wxyz[1] *= 1e-6
        gaussians.log_scales[2] = 15.0
        gaussians.log_scales[3] = -40.0
        gaussians.log_scales[4] = torch.tensor([8.0, -40.0, -40.0])
        gaussians.logit_opacities[5:7] = torch.tensor([60.0, -60.0])
        gaussians.means[7] = torch.linalg.inv(pose)[:3, 3] + 0.0501 * pose[2, :3]
        gaussians.sh[8] = 1e6
    grads = gradients(gaussians, pose, camera, RasterSettings(depth=True), loss_of)
    assert all(torch.isfinite(gradient).all() for gradient in grads)


@pytest.mark.parametrize("name", ["means", "quats_wxyz", "log_scales", "logit_opacities"])
def test_not_a_number_makes_only_its_own_gaussian_invisible(make_scene, camera, name):
    gaussians, pose = make_scene(40, seed=10)
    truth = render(gaussians.select(torch.arange(40) != 3), camera, RasterSettings(), pose)
    gaussians.tensors()[name][3] = math.nan
    view = render(gaussians, camera, RasterSettings(), pose)
    assert 3 not in view.stats.visible
    torch.testing.assert_close(view.colour, truth.colour)


@pytest.mark.parametrize("size", [(1, 1), (16, 32), (17, 33), (3, 100)])
def test_any_image_size(make_scene, size):
    scene, (width, height) = make_scene(80, seed=11), size
    camera = Pinhole(width, height, 20.0, 20.0, width / 2, height / 2)
    view = render(*(scene[0], camera), RasterSettings(), scene[1])
    assert view.colour.shape == (height, width, 3)
    expected = render_reference(*scene, camera, RasterSettings())
    torch.testing.assert_close(view.colour, expected.colour, rtol=0, atol=1e-10)


def test_same_bits_on_every_run_and_any_number_of_threads(make_scene, leaves, loss_of):
    scene, camera = make_scene(3000, seed=12), Pinhole(150, 100, 120.0, 120.0, 75.0, 50.0)
    threads = numba.get_num_threads()
    runs = []
    try:
        for number in (threads, threads, 1):
            numba.set_num_threads(number)
            gaussians, pose = leaves(scene, torch.float32)
            runs.append(gradients(gaussians, pose, camera, RasterSettings(depth=True), loss_of))
    finally:
        numba.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_python_threads_do_not_disturb_each_other(make_scene, leaves, loss_of, camera):
    scene = make_scene(200, seed=13)
    results = [None] * 4

    def work(slot):
        gaussians, pose = leaves(scene, torch.float32)
        results[slot] = gradients(gaussians, pose, camera, RasterSettings(), loss_of)

    workers = [threading.Thread(target=work, args=(slot,)) for slot in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_backward_twice_through_one_graph(make_scene, leaves, loss_of, camera):
    gaussians, pose = leaves(make_scene(60), torch.float32)
    loss = loss_of(render(gaussians, camera, RasterSettings(), pose))
    loss.backward(retain_graph=True)
    once = gaussians.means.grad.clone()
    loss.backward()
    torch.testing.assert_close(gaussians.means.grad, 2 * once)


def test_moving_model_and_camera_together_changes_nothing(make_scene, camera):
    (gaussians, pose), (_, move) = make_scene(100, degree=0), make_scene(1, seed=77)
    view = render(gaussians, camera, PLAIN, pose)
    turned = Gaussians(**gaussians.tensors())
    turned.means = gaussians.means @ move[:3, :3].T + move[:3, 3]
    # The rotation of `move` as a quaternion, multiplied from the left.
    w = 0.5 * torch.sqrt(1 + move[0, 0] + move[1, 1] + move[2, 2])
    x, y, z = ((move[a, b] - move[b, a]) / (4 * w) for a, b in ((2, 1), (0, 2), (1, 0)))
    left = torch.stack([torch.stack(row) for row in ((w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w))])
    turned.quats_wxyz = gaussians.quats_wxyz @ left.T
    again = render(turned, camera, PLAIN, pose @ torch.linalg.inv(move))
    torch.testing.assert_close(again.colour, view.colour, rtol=0, atol=1e-10)
    torch.testing.assert_close(again.expected_depth, view.expected_depth, rtol=0, atol=1e-9)


def test_input_that_does_not_fit_is_refused(make_scene, camera):
    gaussians, pose = make_scene(5)
    short = Gaussians(**{**gaussians.tensors(), "quats_wxyz": gaussians.quats_wxyz[:4]})
    mixed = Gaussians(**{**gaussians.tensors(), "sh": gaussians.sh.float()})
    with refused("tensor-shape", InputError) as error:
        render(short, camera, PLAIN, pose)
    assert error.value.field == "quats_wxyz" and numbers(error.value.message) == [4, 4, 5, 4]
    with refused("tensor-type", InputError) as error:
        render(mixed, camera, PLAIN, pose)
    assert error.value.field == "sh" and "float32" in error.value.message
    with refused("tensor-shape", InputError) as error:
        render(gaussians, camera, PLAIN, pose[:3])
    assert error.value.field == "cam_from_model" and numbers(error.value.message)[:2] == [3, 4]
    with refused("sh-degree", InputError) as error:
        render(gaussians, camera, RasterSettings(sh_degree=4), pose)
    assert numbers(error.value.message) == [0, 3, 4]
    with refused("near-plane", InputError):
        render(gaussians, camera, RasterSettings(near_m=0.0), pose)


def test_predicted_memory_grows_with_everything(camera):
    base = predicted_bytes(100_000, camera, 3)
    assert 100_000 * 59 * 4 < base < 200e6
    assert predicted_bytes(200_000, camera, 3) > 1.8 * base
    assert predicted_bytes(100_000, camera, 3, visible=30_000) < base
    assert predicted_bytes(100_000, camera, 0) < base
