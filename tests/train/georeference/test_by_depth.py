"""Control points through the rendered depth: gradients through everything, and a flight brought home."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import bsr_matrix

from pipelines.adjust.root import information_root
from pipelines.adjust.state import State
from pipelines.adjust.system import NormalMatrix
from pipelines.geometry.bundle import similarity_modes
from pipelines.geometry.cameras import CameraPoses, Pinhole
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.statistics import CAUCHY_SCALE2
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.reference import render_reference
from pipelines.train.georeference.problem import DepthMarks, GeoProblem
from pipelines.train.georeference.unknowns import SolutionUnknowns

pytestmark = pytest.mark.usefixtures("one_thread")
SHIFT = np.array([100.0, 50.0, 20.0])
PINHOLE = Pinhole(24, 18, 20.0, 20.0, 12.0, 9.0)
DEPTH_M = 10.0
SURVEY_M, MARK_RAD, SURFACE_M = 0.02, 1e-3, 0.02


def wall() -> Gaussians:
    """Opaque Gaussians on a plane ten metres in front of the cameras, float64."""
    axis = torch.arange(-7.0, 7.1, 1.0, dtype=torch.float64)
    x, y = (each.flatten() for each in torch.meshgrid(axis, axis, indexing="ij"))
    count = len(x)
    return Gaussians(
        torch.stack([x, y, torch.full_like(x, DEPTH_M)], dim=1),
        torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(count, 1),
        torch.tensor([0.7, 0.7, 0.01], dtype=torch.float64).log().repeat(count, 1),
        torch.full((count,), 3.0, dtype=torch.float64),
        torch.zeros((count, 1, 3), dtype=torch.float64),
    )


CENTER = np.array([[-1.0, 0.5, 0], [0, -0.5, 0], [1.0, 0.4, 0]])
CONTROL = np.array([[-2.0, -1.5, DEPTH_M], [2.5, -1.0, DEPTH_M], [0.5, 2.0, DEPTH_M]])
POSES = CameraPoses(np.tile(np.eye(3), (3, 1, 1)), CENTER)


SIGMA = np.array([0.02] * 4 + [0.5] * 3)  # of the similarity: ln s, rotation, shift in metres
SHAPE = 1e-3  # σ of what cameras move beside it, rad and m


def problem(truth: Similarity) -> GeoProblem:
    """Each of three cameras sees each of three control points on the wall."""
    camera, point = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    ray = CONTROL[point] - CENTER[camera]
    surveyed = torch.from_numpy(truth.apply(CONTROL))
    variance = SURVEY_M**2 + (MARK_RAD * DEPTH_M) ** 2 + SURFACE_M**2
    marks = DepthMarks(
        torch.from_numpy(camera),
        torch.from_numpy(ray[:, :2] / ray[:, 2:]),
        torch.zeros((9, 2, 0), dtype=torch.float64),
        surveyed[point],
        (torch.eye(3, dtype=torch.float64) / variance**0.5).repeat(9, 1, 1),
        torch.full((9,), 1 / 3, dtype=torch.float64),
        points=3,
        views=3,
        rows={index: slice(3 * index, 3 * index + 3) for index in range(3)},
    )
    modes = similarity_modes(CENTER).reshape(-1, 7)
    information = np.linalg.inv(modes * SIGMA**2 @ modes.T + SHAPE**2 * np.eye(18))
    normal = NormalMatrix(bsr_matrix(information, blocksize=(6, 6)), np.zeros((0, 18)), np.zeros((0, 0)), CENTER)
    nothing = np.zeros(0, dtype=np.int64)
    root = information_root(normal, np.linalg.pinv(modes), nothing, 0)
    start = State(Similarity(translation=SHIFT), np.zeros((3, 6)), np.zeros(0))
    return GeoProblem(SolutionUnknowns(POSES, start, root, nothing), 3, marks=marks)


def loss_of_view(problem: GeoProblem, gaussians: Gaussians, index: int) -> torch.Tensor:
    """As the trainer has it, but for the pose, which stays float64."""
    rotation, center = problem.unknowns.pose(index)
    bottom = torch.eye(4, dtype=torch.float64)[3:]
    pose = torch.cat([torch.cat([rotation, -(rotation @ center)[:, None]], dim=1), bottom])
    render = render_reference(gaussians, pose, PINHOLE, RasterSettings(sh_degree=0, depth=True))
    assert render.expected_depth is not None
    found = problem.depth_loss(index, render.expected_depth, render.alpha, PINHOLE)
    assert found is not None
    return found


def test_gradients_reach_similarity_cameras_and_gaussians() -> None:
    rng = np.random.default_rng(0)
    truth = Similarity(1.0, np.eye(3), SHIFT + np.array([0.05, -0.02, 0.04]))
    whole = problem(truth)
    gaussians = wall()

    def loss(w: torch.Tensor, depth_m: torch.Tensor, log_scales: torch.Tensor) -> torch.Tensor:
        means = torch.cat([gaussians.means[:, :2], depth_m[:, None]], dim=1)
        moved = replace(gaussians, means=means, log_scales=log_scales)
        told = {"problem.unknowns.w": w}
        return torch.func.functional_call(_View(whole, 1), told, (moved,))

    start = (
        torch.from_numpy(0.1 * rng.normal(size=18)),
        gaussians.means[:, 2] + 0.05 * torch.from_numpy(rng.normal(size=len(gaussians))),
        gaussians.log_scales,
    )
    assert float(loss(*start)) > 0
    inputs = tuple(each.clone().requires_grad_() for each in start)
    gradients = torch.autograd.grad(loss(*inputs), inputs)
    assert all(float(each.abs().max()) > 1e-3 for each in gradients)
    for which, gradient in enumerate(gradients):
        direction = torch.from_numpy(rng.normal(size=gradient.shape))
        step = 1e-6
        ahead, behind = (
            loss(*(each + sign * step * direction if k == which else each for k, each in enumerate(start)))
            for sign in (1, -1)
        )
        numeric = float((ahead - behind).detach()) / (2 * step)
        assert float((gradient * direction).sum()) == pytest.approx(numeric, rel=1e-4)


class _View(torch.nn.Module):
    def __init__(self, problem: GeoProblem, index: int) -> None:
        super().__init__()
        self.problem, self.index = problem, index

    def forward(self, gaussians: Gaussians) -> torch.Tensor:
        return loss_of_view(self.problem, gaussians, self.index)


def test_depth_alone_brings_a_shifted_flight_home() -> None:
    truth = Similarity(1.01, np.eye(3), SHIFT + np.array([0.4, -0.3, 0.5]))
    whole, gaussians = problem(truth), wall()
    depths = []
    for index in range(3):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = -torch.from_numpy(CENTER[index])
        render = render_reference(gaussians, pose, PINHOLE, RasterSettings(sh_degree=0, depth=True))
        depths.append((render.expected_depth, render.alpha))
    adam = torch.optim.Adam([whole.unknowns.w])
    for step in range(300):
        adam.param_groups[0]["lr"] = 0.1 * 0.05 ** (step / 300)
        adam.zero_grad()
        depth, alpha = depths[step % 3]
        assert depth is not None
        found = whole.depth_loss(step % 3, depth, alpha, PINHOLE)
        assert found is not None
        found.backward()
        adam.step()
    error = whole.unknowns.current_similarity().apply(CONTROL) - truth.apply(CONTROL)
    assert np.abs(error).max() < 0.01
    # What the views say one by one is, on the average, the whole: three points with the weight of three fixes.
    before = Similarity(translation=SHIFT).apply(CONTROL) - truth.apply(CONTROL)
    assert np.abs(before).max() > 0.3


def test_views_add_up_to_the_loss_by_intersection() -> None:
    # On a perfect surface and with the same σ, both ways find the same points.
    truth = Similarity(1.0, np.eye(3), SHIFT + np.array([0.03, -0.02, 0.01]))
    whole = problem(truth)
    flat, solid = torch.full((18, 24), DEPTH_M, dtype=torch.float64), torch.ones(18, 24, dtype=torch.float64)
    views = [whole.depth_loss(index, flat, solid, PINHOLE) for index in range(3)]
    mean = sum(float(view.detach()) for view in views if view is not None) / 3
    # λ_gcp = 3 control points over N = 3 cameras, as there are no fixes.
    missed = Similarity(translation=SHIFT).apply(CONTROL) - truth.apply(CONTROL)
    squared = (missed**2).sum(axis=1) / (SURVEY_M**2 + (MARK_RAD * DEPTH_M) ** 2 + SURFACE_M**2)
    rho = CAUCHY_SCALE2[3] * np.log1p(squared / CAUCHY_SCALE2[3])
    assert mean == pytest.approx(rho.mean(), rel=1e-9)
    assert float(whole.loss().detach()) == 0.0  # nothing has moved


def test_a_view_without_marks_asks_for_no_depth() -> None:
    whole = problem(Similarity(translation=SHIFT))
    assert whole.sees_by_depth(1)
    assert not whole.sees_by_depth(7)
    assert whole.depth_loss(7, torch.ones(18, 24), torch.ones(18, 24), PINHOLE) is None
