"""Terms as tensors against those of the adjustment: equal residuals and derivatives in any state."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from pipelines.adjust.measurements import problem_of
from pipelines.adjust.state import State
from pipelines.adjust.system import Problem
from pipelines.adjust.terms import Level, Planes, Term
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import perturbation
from pipelines.survey.scene import Scene, initial_scene
from pipelines.survey.survey import KnownDistance
from pipelines.train.geographic.terms import tensor_term
from pipelines.train.geographic.unknowns import CameraCorrections, Estimate, LearnableSimilarity
from tests.scenes import initial, material, session_of

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def every() -> tuple[Scene, Problem]:
    """Measurements of all kinds, of two sessions, with all systematic errors."""
    _, sparse, survey = material(images=5, points=40)
    images = tuple(
        image.model_copy(update={"fix": image.fix.model_copy(update={"session": index % 2})})
        for index, image in enumerate(survey.images)
        if image.fix is not None
    )
    bar = KnownDistance(ends=survey.control_points[:2], distance_m=20.0, sigma_m=0.01)
    sessions = (session_of(0.02), session_of(2.0))
    survey = survey.model_copy(update={"images": images, "sessions": sessions, "distances": (bar,)})
    scene, rng = initial_scene(sparse, survey, initial()), np.random.default_rng(1)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    point = rng.uniform(-30, 30, (20, 3))
    on_plane = scene.geo_from_model.apply(point) + 0.02 * rng.normal(size=(20, 3))
    planes = Planes(point, on_plane, normal, np.full((20, 1, 1), 50.0))
    return scene, problem_of(scene, survey, estimate=("lever-arm", "boresight"), planes=planes)


def drawn(scene: Scene, problem: Problem, seed: int) -> State:
    """A state away from SfM's: centimetres and thousandths of a radian, a pixel, half a σ of the priors."""
    rng = np.random.default_rng(seed)
    count = len(scene.sparse.image_name)
    correction = rng.normal(size=(count, 6)) * ([1e-3] * 3 + [0.02] * 3)
    lens = 1e-3 * rng.normal(size=len(problem.bundle.sums.lens))
    lens[:2] *= 1e3  # focal lengths
    away = perturbation(rng.normal(size=7) * ([1e-3] * 4 + [0.1] * 3), np.array([5.0, -3.0, 60.0]))
    sigma = np.array([block.sigma for block in problem.errors.blocks]).reshape(-1)
    errors = 0.5 * sigma * rng.normal(size=len(problem.errors))
    return State(away @ scene.geo_from_model, correction, lens, errors)


def residuals_of(problem: Problem, term: Term, state: State) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """Return the residuals of a term as tensors, as a function of corrections, lens and errors."""
    similarity = LearnableSimilarity(state.geo_from_model, np.eye(7), np.zeros(3))()
    tensors = tensor_term(term, problem.errors)

    def residuals(correction: Tensor, lens: Tensor, errors: Tensor) -> Tensor:
        cameras = CameraCorrections.frozen(problem.base, state)
        cameras.frozen_poses = correction
        return tensors.residuals(Estimate(*cameras.moved(), similarity, problem.errors, errors, lens))

    return residuals


def test_level_is_that_of_the_adjustment(every: tuple[Scene, Problem]) -> None:
    scene, problem = every
    up = exp_so3([0.2, -0.3, 0.1]) @ np.array([0.0, 0.0, 1.0])
    level = Level(up[None], np.linalg.svd(up[None])[2][None, 1:], np.eye(2)[None] / 0.05)
    state = drawn(scene, problem, 0)
    arrays = (state.correction, state.lens, state.errors)
    found = residuals_of(problem, level, state)(*(torch.from_numpy(array) for array in arrays))
    np.testing.assert_allclose(found.detach().numpy(), level.residuals(problem.at(state)), rtol=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["fixes", "control points", "distances", "attitudes", "lidar"])
def test_residuals_and_slopes_are_those_of_the_adjustment(
    every: tuple[Scene, Problem], kind: str, seed: int
) -> None:
    scene, problem = every
    term, state = problem.term(kind), drawn(scene, problem, seed)
    assert term is not None
    slopes, residuals = term.slopes(problem.at(state)), residuals_of(problem, term, state)
    at = tuple(torch.from_numpy(each) for each in (state.correction, state.lens, state.errors))
    np.testing.assert_allclose(residuals(*at).detach(), slopes.residual, atol=1e-11)
    by_correction, by_lens, by_errors = torch.autograd.functional.jacobian(residuals, at)
    by_pose = np.zeros(by_correction.shape)
    for row, camera, block in zip(slopes.row, slopes.camera, slopes.by_pose, strict=True):
        by_pose[row, :, camera] += block
    # The slopes of an intersection hold the weights of its rays one pass later than the tensors do.
    of_marks = kind in ("control points", "distances")
    tolerance = 5e-3 if of_marks else 1e-6
    for found, wanted in ((by_correction, by_pose), (by_lens, slopes.by_lens), (by_errors, slopes.by_errors)):
        np.testing.assert_allclose(found.detach(), wanted, atol=tolerance * (1e-3 + np.abs(wanted).max(initial=0)))
    assert by_pose.any() or kind == "lidar"
    assert by_errors.any() or of_marks
    assert by_lens.any() == of_marks
