"""The adjustment as a product: control points left out, the file, and the frame that it is stated in."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipelines.adjust.joint import Start, adjust_jointly, in_own_frame
from pipelines.adjust.measurements import problem_of, start_of
from pipelines.adjust.posterior import Posterior, load_posterior, save_posterior
from pipelines.adjust.solution import adjusted
from pipelines.adjust.system import cost_at, minimise
from pipelines.core.errors import InputError
from pipelines.core.files import read_npz
from pipelines.core.products import save_npz
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity
from pipelines.survey.marks import mark_rays
from pipelines.survey.scene import SparseScene, initial_scene
from pipelines.survey.solution import MeasurementVerdict
from pipelines.survey.survey import Survey
from tests.drawn_surveys import Receiver, drawn, flight, missed, surveyed
from tests.refusals import refused
from tests.scenes import GEO_FROM_LOCAL, initial_product

pytestmark = pytest.mark.usefixtures("one_thread")
INITIAL = initial_product(GEO_FROM_LOCAL.to_record("local", "geo"))
FLIGHT = flight(25, 150)


@cache
def measured() -> tuple[SparseScene, Survey]:
    rng = np.random.default_rng(4)
    receiver = Receiver((0.3, 0.3, 0.5), (0.05, 0.05, 0.08))
    survey = surveyed(FLIGHT, drawn(FLIGHT, rng), receiver, 0.02, rng)
    images = tuple(image.model_copy(update={"split": "train"}) for image in survey.images)
    survey = survey.model_copy(update={"images": images})
    scene = initial_scene(FLIGHT.model, survey, INITIAL)
    return scene, survey


def solved(survey: Survey) -> Posterior:
    scene, _ = measured()
    problem = problem_of(scene, survey)
    return adjusted(scene, problem, minimise(problem, start_of(scene, problem)).state, MeasurementVerdict())


@cache
def solution() -> Posterior:
    return solved(measured()[1])


@pytest.mark.slow
def test_leaving_out_a_control_point_is_what_solving_again_would_give() -> None:
    _, survey = measured()
    rows = {row.name: row for row in solution().solution.measurements if row.kind == "control point"}
    assert len(rows) == len(survey.control_points) == 6
    for left, point in enumerate(survey.control_points):
        others = tuple(each for index, each in enumerate(survey.control_points) if index != left)
        again = solved(survey.model_copy(update={"control_points": others}))
        as_check = survey.model_copy(update={"check_points": (point,)})
        error, cov = missed(again, as_check)
        cov = cov + np.array(point.cov_in_geo)
        row = rows[point.name]
        sigma = np.sqrt(np.diag(cov))
        # The robust weights of the others, which are frozen, change a little when it is gone.
        np.testing.assert_allclose(np.array(row.left_out_error_m) / sigma, error[0] / sigma, atol=0.35)
        np.testing.assert_allclose(np.sqrt(np.diag(np.array(row.left_out_cov_m2))), sigma, rtol=0.15)


def test_file_holds_every_covariance(tmp_path: Path) -> None:
    posterior, path = solution(), tmp_path / "adjustment.npz"
    save_posterior(posterior, path)
    read = load_posterior(path, posterior.solution, FLIGHT.model)
    rays = mark_rays(measured()[1].check_points, read.sparse)
    np.testing.assert_allclose(
        read.jointly_of_marked_points(FLIGHT.check, rays),
        posterior.jointly_of_marked_points(FLIGHT.check, rays),
        rtol=1e-9,
        atol=1e-15,
    )
    np.testing.assert_allclose(read.of_similarity, posterior.of_similarity, rtol=1e-9)
    np.testing.assert_array_equal(read.camera_cov, posterior.camera_cov)
    of_lens = read.of_lens()
    assert of_lens is not None
    assert (np.diag(of_lens) > 0).all()
    with pytest.raises(InputError) as error:
        load_posterior(tmp_path / "none.npz", posterior.solution, FLIGHT.model)
    assert error.value.path == tmp_path / "none.npz"
    arrays = read_npz(path, tuple(np.load(path).files))
    save_npz(path, arrays | {"position": arrays["position"][1:]})
    with refused("posterior-of-another-solution", InputError):
        load_posterior(path, posterior.solution, FLIGHT.model)
    # As versions wrote it that had no grid of σ, or no covariances of cameras.
    for since in ("camera_cov", "indptr"):
        save_npz(path, {name: array for name, array in arrays.items() if name != since})
        with refused("posterior-of-older-version", InputError):
            load_posterior(path, posterior.solution, FLIGHT.model)


def test_frame_of_the_start_is_left_without_a_trace() -> None:
    _, survey = measured()
    # A start that is turned and scaled: its frame `model` is not that of the solution.
    away = Similarity(1.02, exp_so3([0.01, -0.02, 0.03]), np.array([1.0, -2.0, 0.5]))
    start = initial_product((away @ GEO_FROM_LOCAL).to_record("local", "geo"))
    before, near, _ = adjust_jointly(survey, FLIGHT.model, [Start(start)])
    record = (near.state.geo_from_model @ before.model_from_local).to_record("local", "geo")
    scene, state = in_own_frame(before, near.state, survey, initial_product(record))
    old, new = near.state.poses(before.poses), state.poses(scene.poses)
    np.testing.assert_allclose(
        state.geo_from_model.apply(new.cam_center_in_model),
        near.state.geo_from_model.apply(old.cam_center_in_model),
        atol=1e-6,
    )
    problem = replace(near.problem, base=scene.poses, bundle=scene.bundle)  # terms are measured in geo
    residuals = problem.residuals(state)
    assert cost_at(problem, state, residuals) == pytest.approx(
        cost_at(near.problem, near.state, near.problem.residuals(near.state)), rel=1e-6
    )
    # It is a minimum there as well, and the one from the true start.
    again = minimise(problem, state)
    direct = minimise(problem, start_of(scene, problem))
    assert again.cost == pytest.approx(direct.cost, abs=1e-3)
