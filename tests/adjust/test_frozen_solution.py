"""Solution of cameras and similarity without photographs, and trainings that hold it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from pipelines.adjust.frozen_solution import exposures_of, held_problem, solve_once, with_exposures
from pipelines.core.products import load_json, save_json
from pipelines.geometry.similarity import Similarity
from pipelines.scene.geographic_options import GeographicOptions
from pipelines.scene.scene import Scene, initial_scene
from pipelines.scene.trained_model import FrozenSolution
from tests.adjusted_scenes import adjusted_model, block
from tests.scenes import Measured, Noise, initial, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")
NOISE = Noise(fix_m=(0.02, 0.02, 0.03), pixel_px=0.2, mark_px=0.2)


@pytest.fixture(scope="module")
def solved() -> tuple[Scene, FrozenSolution]:
    rng, of = np.random.default_rng(4), block("orbit", 8)
    survey = survey_of(of.scene, NOISE, Measured(gcps=True), rng)
    scene = initial_scene(adjusted_model(of, NOISE, rng), survey, initial())
    return scene, solve_once(scene, survey, initial(), GeographicOptions())


def test_solution_places_the_cameras_within_their_noise(solved: tuple[Scene, FrozenSolution]) -> None:
    scene, solution = solved
    geo_from_model = Similarity.from_record(solution.geo_from_model)
    true = block("orbit", 8).scene.center_in_geo

    def off_m(place: Similarity, center: np.ndarray) -> float:
        return float(np.linalg.norm(place.apply(center) - true, axis=1).mean())

    # Each fix errs by 4.1 cm (RMS). The bundle ties eight of them together, and so the cameras err by less.
    solution_m = off_m(geo_from_model, solution.poses.cam_center_in_model)
    assert solution_m < 0.75 * 0.041
    assert solution_m < off_m(scene.geo_from_model, scene.poses.cam_center_in_model)
    assert np.sqrt(np.diag(solution.geo_from_model.covariance))[4:].max() < 0.04


def test_solution_is_read_as_it_was_written(solved: tuple[Scene, FrozenSolution], tmp_path: Path) -> None:
    exposure = np.random.default_rng(0).normal(size=(8, 3, 4))
    solution = with_exposures(solved[1], exposure)
    save_json(solution, tmp_path / "solution.json")
    again = load_json(FrozenSolution, tmp_path / "solution.json")
    assert again == solution
    kept = exposures_of(again)
    assert kept is not None
    np.testing.assert_array_equal(kept, exposure)
    assert exposures_of(solved[1]) is None


def test_held_problem_has_the_solution_and_does_not_move(solved: tuple[Scene, FrozenSolution]) -> None:
    scene, solution = solved
    problem = held_problem(scene, solution)
    rotation, center = problem.cameras.pose(3)
    np.testing.assert_allclose(rotation.detach().numpy(), solution.poses.cam_from_model[3], atol=1e-12)
    np.testing.assert_allclose(center.detach().numpy(), solution.poses.cam_center_in_model[3], atol=1e-9)
    np.testing.assert_allclose(
        problem.similarity.current().apply(scene.point_in_model),
        Similarity.from_record(solution.geo_from_model).apply(scene.point_in_model),
        atol=1e-9,
    )
    lens = scene.sparse.lenses.moved(problem.cameras.lens().detach().numpy())
    np.testing.assert_allclose(lens.cameras[1].params, solution.lenses[0].params, rtol=1e-12)
    loss = problem.loss()
    loss.backward()
    moving = [each for each in problem.learned().values() if each.grad is not None and bool(each.grad.any())]
    assert float(loss.detach()) == 0.0
    assert not moving
    assert not torch.is_nonzero(problem.cameras.z.detach().abs().sum())
