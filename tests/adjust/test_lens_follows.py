"""A lens that follows the cameras, in the geographic losses: values, gradients and the linear problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.posterior import equations_of
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.terms import ControlTerm
from pipelines.geometry.similarity import Similarity
from tests.georef_scenes import LOOSE, SHIFT, draw_truth, fixes_of, make_block, marks_of, pivot, terms

BLOCK = make_block(images=4)
SIGMA_M = np.array([0.5, 0.4, 0.8])
CONTROL = np.array([[5.0, -4.0, 1.0], [-8.0, 6.0, 0.0], [2.0, 9.0, 3.0]])
DIRECTIONS = BLOCK.basis.shape[2]
# Of ln f and of the principal point in units of f: a part in a thousand.
LENS = 1e-3 * np.random.default_rng(1).normal(size=(3, DIRECTIONS))


def by_lens(marks: ControlTerm) -> torch.Tensor:
    """Of bearings by ln f, cx / f, cy / f of one camera for all: rays are (x, y, 1) → (x − cx, y − cy, 1) / f."""
    ray = marks.bearing_in_cam / marks.bearing_in_cam[:, 2:]
    moved = torch.zeros((len(ray), 3, 3), dtype=torch.float64)
    moved[:, :2, 0] = -ray[:, :2]
    moved[:, 0, 1] = moved[:, 1, 2] = -1.0
    across = torch.eye(3, dtype=torch.float64) - marks.bearing_in_cam[:, :, None] * marks.bearing_in_cam[:, None]
    return marks.bearing_in_cam[:, 2, None, None] * (across @ moved)


@pytest.fixture
def problem() -> GeoProblem:
    rng = np.random.default_rng(5)
    truth = draw_truth(BLOCK, rng)
    marks = marks_of(truth, CONTROL, 0.05, rng)
    marks = replace(marks, bearing_by_lens=by_lens(marks))
    problem = GeoProblem(
        LearnableSimilarity(Similarity(translation=SHIFT), LOOSE, pivot(BLOCK)),
        CameraCorrections(BLOCK.poses, BLOCK.basis, LENS),
        terms(fixes_of(truth, SIGMA_M, rng), marks),
    )
    with torch.no_grad():
        problem.cameras.z.copy_(torch.from_numpy(0.5 * rng.normal(size=DIRECTIONS)))
    return problem


def test_rays_spread_with_a_shorter_lens_and_turn_with_the_principal_point(problem: GeoProblem) -> None:
    marks = problem.control
    assert marks is not None
    change = torch.tensor([-0.01, 0.002, -0.003], dtype=torch.float64)
    told, before = marks.bearings(change), marks.bearing_in_cam
    wanted = 1.01 * before[:, :2] / before[:, 2:] - change[1:]
    # Second order: a hundredth squared, and the place in the image changes by as much.
    np.testing.assert_allclose(told[:, :2] / told[:, 2:], wanted, atol=2e-4)
    np.testing.assert_allclose(told.norm(dim=1), 1.0, rtol=1e-12)
    held = replace(problem.estimate(), lens=change[:0])
    away = marks.intersected(replace(held, lens=change)) - marks.intersected(held)
    # Some thousandths of 50 m.
    assert 0.05 < float(away.norm(dim=1).mean().detach()) < 0.5


def test_gradient_of_the_control_term_by_the_lens_is_exact(problem: GeoProblem) -> None:
    start = problem.cameras.z.detach().clone()

    def loss(z: torch.Tensor) -> torch.Tensor:
        terms = torch.func.functional_call(_Control(problem), {"problem.cameras.z": z}, ())
        assert isinstance(terms, torch.Tensor)
        return terms

    assert torch.autograd.gradcheck(loss, (start.requires_grad_(),), eps=1e-5, atol=1e-5, rtol=1e-4)
    (whole,) = torch.autograd.grad(loss(start), start)
    problem.cameras.lens_basis = torch.zeros((0, DIRECTIONS), dtype=torch.float64)
    problem.cameras.held_lens = torch.zeros(0, dtype=torch.float64)
    (held,) = torch.autograd.grad(loss(start), start)
    assert float((whole - held).norm()) > 0.01 * float(whole.norm())


class _Control(torch.nn.Module):
    def __init__(self, problem: GeoProblem) -> None:
        super().__init__()
        self.problem = problem

    def forward(self) -> torch.Tensor:
        control = self.problem.losses()["control"]
        assert control is not None
        return control


def test_equations_count_the_path_through_the_lens(problem: GeoProblem) -> None:
    equations, columns = equations_of(problem), []
    assert equations.seen is None  # 21 residuals, 17 corrections
    z = problem.cameras.z
    for direction in torch.eye(DIRECTIONS, dtype=torch.float64):
        moved = []
        for sign in (1, -1):
            with torch.no_grad():
                z.add_(sign * 1e-4 * direction)
                moved.append(problem.whitened(problem.estimate()))
                z.sub_(sign * 1e-4 * direction)
        columns.append({kind: (moved[0][kind] - moved[1][kind]) / 2e-4 for kind in moved[0]})
    for kind, rows in equations.normal.observations.items():
        numeric = torch.stack([column[kind] for column in columns], dim=2).numpy()
        # Second order in steps of 1e-4 σ.
        analytic = rows.jacobian[:, :, equations.cameras]
        np.testing.assert_allclose(analytic, numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())
