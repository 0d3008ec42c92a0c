"""The geographic losses as training gets them: they start at the adjustment, and options switch what counts."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

import pipelines.train
from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.adjust.posterior import Posterior
from pipelines.adjust.system import Problem, cost_at, minimise
from pipelines.adjust.terms import MarkedTerm, Term
from pipelines.core.errors import DegenerateGeometryError, InputError
from pipelines.survey.scene import SparseScene, adjusted_scene
from pipelines.survey.solution import GeolocatedPoints, Solution
from pipelines.survey.survey import Survey
from pipelines.train.georeference.problem import (
    SURFACE_SIGMA,
    GeoProblem,
    depth_residuals,
    frozen_problem,
    refining_problem,
)
from pipelines.train.options import GeographicOptions, TrainOptions
from pipelines.train.solution_state import (
    frozen_exposures,
    measured_problem,
    solved_at,
    state_of,
    with_exposures,
)
from tests.adjusted_scenes import adjusted_model, block
from tests.refusals import refused
from tests.scenes import Measured, Noise, survey_of

pytestmark = pytest.mark.usefixtures("one_thread")
NOISE = Noise(fix_m=(0.02, 0.02, 0.03), pixel_px=0.3, mark_px=0.3)
# Of a base station on wrong coordinates: what control points show of it is far beyond the σ of its prior.
WRONG_BASE = replace(NOISE, bias_m=(0.6, -0.4, 0.5))


@dataclass(frozen=True)
class Adjusted:
    """A survey after `init-sim3`."""

    survey: Survey
    scene: SparseScene
    posterior: Posterior
    points: GeolocatedPoints

    @property
    def solution(self) -> Solution:
        return self.posterior.solution

    def measured(self, *, control_points: bool = True) -> Problem:
        return measured_problem(self.solution, self.survey, self.scene, control_points=control_points)

    def problem(self, **options: object) -> GeoProblem:
        config = TrainOptions.model_validate({"georeference": "joint", **options})
        measured = self.measured(control_points=config.gcp_loss)
        return refining_problem(self.posterior, self.survey, self.scene, measured, config, points=self.points)


@cache
def adjusted(noise: Noise = NOISE, estimate: tuple[str, ...] = ()) -> Adjusted:
    rng, of = np.random.default_rng(4), block("orbit", 8)
    survey, sparse = survey_of(of.scene, noise, Measured(gcps=True), rng), adjusted_model(of, noise, rng)
    return of_survey(survey, sparse, estimate)


def of_survey(survey: Survey, sparse: object, estimate: tuple[str, ...] = ()) -> Adjusted:
    points = geolocate(survey, sparse, GeolocateOptions()).points  # type: ignore[arg-type]
    options, survey = InitSim3Options(accept_inconsistency=True), survey.model_copy(update={"estimate": estimate})
    posterior, _ = estimate_similarity(survey, sparse, points, options)  # type: ignore[arg-type]
    solution = posterior.solution
    weighted = solution.weighted(survey)
    scene = adjusted_scene(sparse, weighted, solution)  # type: ignore[arg-type]
    return Adjusted(weighted, scene, posterior, points)


@pytest.mark.parametrize(
    ("noise", "estimate"),
    [(NOISE, ()), (WRONG_BASE, ()), (NOISE, ("lever-arm", "boresight"))],
    ids=["good", "wrong base", "more errors"],
)
def test_training_starts_at_the_minimum_of_its_own_loss(noise: Noise, estimate: tuple[str, ...]) -> None:
    given = adjusted(noise, estimate)
    problem, solution = given.problem(distance_loss=False), given.posterior.solution
    unknowns = problem.unknowns
    rotation, center = (each.detach().numpy() for each in unknowns.moved())
    np.testing.assert_allclose(rotation, solution.poses.cam_from_model, atol=1e-12)
    np.testing.assert_allclose(center, solution.poses.cam_center_in_model, atol=1e-9)
    lens = given.scene.sparse.lenses.moved(unknowns.lens().detach().numpy())
    np.testing.assert_allclose(lens.cameras[1].params, solution.lenses[0].params, rtol=1e-10)
    np.testing.assert_array_equal(unknowns.current_similarity().translation, solution.similarity.translation)
    assert {"bias"} | set(estimate) == {error.name for error in solution.estimated_errors}
    loss = problem.loss()
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert unknowns.w.grad is not None and not bool(unknowns.w.grad.any())
    # That it is the minimum of the measurements, too: their own slope is none along any coordinate.
    measured, step = given.measured(), 0.5
    least = minimise(measured, state_of(solution, given.scene, measured.errors)).cost
    for row in np.random.default_rng(0).integers(0, len(unknowns.w), 5):
        costs = []
        for sign in (1, -1):
            with torch.no_grad():
                unknowns.w.zero_()
                unknowns.w[int(row)] = sign * step
            state = unknowns.state()
            costs.append(cost_at(measured, state, measured.residuals(state)) - least)
        # A slope would make one side cheaper; the motion itself costs a quarter at half a σ.
        assert min(costs) > 0.0
        assert abs(costs[0] - costs[1]) < 0.5 * sum(costs)


def test_state_at_the_start_gives_the_adjustment_again() -> None:
    given = adjusted()
    measured, problem = given.measured(), given.problem()
    again = solved_at(given.solution, given.survey, given.scene, measured, problem.unknowns.state())
    expected = given.posterior
    np.testing.assert_allclose(again.camera_cov, expected.camera_cov, rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(
        again.solution.geo_from_model.covariance, expected.solution.geo_from_model.covariance, atol=1e-12
    )
    for one, other in zip(again.solution.estimated_errors, expected.solution.estimated_errors, strict=True):
        np.testing.assert_allclose(one.value, other.value, atol=1e-9)
    names = [(each.kind, each.name, each.used) for each in expected.solution.measurements]
    assert [(each.kind, each.name, each.used) for each in again.solution.measurements] == names


def test_measurements_that_leave_the_similarity_open_are_refused_before_the_training() -> None:
    given = adjusted()
    images = tuple(
        image.model_copy(update={"fix": None}) if index else image
        for index, image in enumerate(given.survey.images)
    )
    few = replace(given, survey=given.survey.model_copy(update={"images": images}))
    few.problem()
    for options in ({"gcp_loss": False}, {"gcp_mode": "depth"}):
        with refused("similarity-open", DegenerateGeometryError):
            few.problem(**options)


def test_frozen_cameras_are_those_of_the_adjustment_and_do_not_move() -> None:
    given = adjusted()
    problem, solution = frozen_problem(given.solution, given.scene), given.solution
    _, center = problem.unknowns.pose(3)
    np.testing.assert_allclose(center.detach(), solution.poses.cam_center_in_model[3], atol=1e-9)
    lens = given.scene.sparse.lenses.moved(problem.unknowns.lens().detach().numpy())
    np.testing.assert_allclose(lens.cameras[1].params, solution.lenses[0].params, rtol=1e-12)
    loss = problem.loss()
    loss.backward()
    assert float(loss.detach()) == 0.0
    assert len(problem.unknowns.w) == 0


def test_exposures_come_back() -> None:
    solution = adjusted().solution
    assert frozen_exposures(solution, torch.device("cpu")) is None
    exposure = np.random.default_rng(0).normal(size=(8, 3, 4))
    shown = frozen_exposures(with_exposures(solution, exposure), torch.device("cpu"))
    assert shown is not None
    np.testing.assert_allclose(shown.affine, exposure, rtol=1e-6)


def test_paper_has_plain_mean_squares_and_their_slopes() -> None:
    given = adjusted()
    problem, measured = given.problem(georeference="paper"), given.measured()
    unknowns, rng = problem.unknowns, np.random.default_rng(5)
    with torch.no_grad():
        unknowns.w.copy_(torch.from_numpy(rng.normal(size=len(unknowns.w))))
    at, values = measured.at(unknowns.state()), problem.losses()
    assert set(values) == {"absolute", "control", "relative"}
    for kind, name in (("fixes", "absolute"), ("control points", "control")):
        term = measured.term(kind)
        assert term is not None
        squares = (term.residuals(at) ** 2).sum(axis=1)
        assert float(values[name].detach()) == pytest.approx(squares.mean(), rel=1e-9)
    loss = problem.loss()
    assert float(loss.detach()) == pytest.approx(sum(float(value.detach()) for value in values.values()))
    loss.backward()
    assert unknowns.w.grad is not None
    direction, ends = torch.from_numpy(rng.normal(size=len(unknowns.w))), []
    for sign in (1, -1):
        with torch.no_grad():
            unknowns.w.add_(sign * 1e-3 * direction)
            ends.append(float(problem.loss()))
            unknowns.w.sub_(sign * 1e-3 * direction)
    slope = (ends[0] - ends[1]) / 2e-3
    # A turn of the whole on top of a turn of a milliradian, and weights of rays one pass later.
    assert float(unknowns.w.grad @ direction) == pytest.approx(slope, rel=0.01)
    # Plain squares compare no lens with the photographs: it stays, as do the systematic errors.
    start = state_of(given.solution, given.scene, measured.errors)
    np.testing.assert_array_equal(unknowns.lens().detach(), start.lens)
    np.testing.assert_array_equal(unknowns.errors().detach(), start.errors)


def test_paper_moves_the_whole_to_the_fixes() -> None:
    given = adjusted(WRONG_BASE)
    problem = given.problem(georeference="paper", gcp_loss=False, distance_loss=False)
    adam, first = torch.optim.Adam([problem.unknowns.w], lr=0.3), float(problem.loss().detach())
    for _ in range(150):
        adam.zero_grad()
        problem.loss().backward()
        adam.step()
    assert float(problem.loss().detach()) < 0.5 * first


@pytest.mark.parametrize(
    ("options", "kinds"),
    [
        ({}, {"solution", "relative"}),
        ({"distance_loss": False}, {"solution"}),
        ({"georeference": "paper", "gcp_loss": False}, {"absolute", "relative"}),
    ],
)
def test_terms_can_be_switched_off(options: dict[str, object], kinds: set[str]) -> None:
    assert set(adjusted().problem(**options).losses()) == kinds


def test_without_control_points_the_solution_is_held_less() -> None:
    given = adjusted()
    root = np.random.default_rng(6)
    motion = root.normal(size=7) * [1e-5, 1e-5, 1e-5, 1e-5, 0.01, 0.01, 0.01]

    def stiffness(**options: object) -> float:
        common = given.problem(distance_loss=False, **options).unknowns.common.numpy()
        return float(motion @ np.linalg.solve(common @ common.T, motion))

    every, without, by_depth = stiffness(), stiffness(gcp_loss=False), stiffness(gcp_mode="depth")
    assert without == pytest.approx(by_depth, rel=1e-9)
    assert without < 0.9 * every


def test_everything_moves_to_a_device_together() -> None:
    problem = adjusted(NOISE, ("lever-arm", "boresight")).problem(gcp_mode="depth")
    assert problem.to("meta").loss().device.type == "meta"


def test_distances_say_of_the_scale_a_tenth_of_what_the_fixes_say() -> None:
    given = adjusted()
    fixes = given.measured().term("fixes")
    pairs = given.problem().pairs
    assert fixes is not None and pairs is not None and pairs.distance_in_model is not None
    of_pairs = pairs.share * float((pairs.distance_in_geo * pairs.weight).square().sum())
    place = fixes.position_in_geo  # type: ignore[attr-defined]
    of_fixes = ((fixes.root_information @ (place - place.mean(axis=0))[..., None]) ** 2).sum()
    assert 0 < of_pairs <= 0.1 * of_fixes * (1 + 1e-3)
    # The scene is in true metres: what remains is the error of the forward intersection.
    white = (pairs.distance_in_model - pairs.distance_in_geo) * pairs.weight
    assert float(white.square().mean()) < 1.5
    lost = replace(given, points=replace(given.points, inlier=np.zeros_like(given.points.inlier)))
    of_cameras = lost.problem().pairs
    assert of_cameras is not None and of_cameras.camera is not None
    foreign = replace(given, points=replace(given.points, point_id=given.points.point_id + 1))
    with refused("points-of-another-model", InputError):
        foreign.problem()


def test_depth_mode_finds_control_points_by_the_surface() -> None:
    given, found = adjusted(), adjusted().problem(gcp_mode="depth")
    marks, poses = found.marks, given.posterior.solution.poses
    assert marks is not None
    assert marks.views == 8
    assert float(marks.share.sum()) == pytest.approx(len(given.survey.control_points))
    similarity = given.posterior.solution.similarity
    for camera, rows in marks.rows.items():
        assert set(marks.camera[rows].tolist()) == {camera}
        # At the true depth of each mark lies its control point, to some pixels' worth of millimetres.
        arm = similarity.inverse().apply(marks.position_in_geo[rows].numpy()) - poses.cam_center_in_model[camera]
        depth = torch.from_numpy(arm @ poses.cam_from_model[camera][2])
        ray, surveyed = marks.rays(rows, found.unknowns.lens()), marks.position_in_geo[rows]
        missed = depth_residuals(found.unknowns.pose(camera), found.unknowns.similarity(), surveyed, ray, depth)
        assert float(missed.detach().abs().max()) < 0.2
        sigma = 1 / np.linalg.svd(marks.root_information[rows].numpy(), compute_uv=False)
        distance = np.linalg.norm(arm, axis=1)
        np.testing.assert_allclose(sigma, SURFACE_SIGMA * distance[:, None].repeat(3, axis=1), rtol=0.1)


def test_depth_does_not_go_with_frozen_cameras() -> None:
    with pytest.raises(ValidationError, match="--gcp-mode depth"):
        TrainOptions(gcp_mode="depth", georeference="frozen")


def test_cameras_are_refined_unless_they_are_frozen() -> None:
    assert [GeographicOptions(georeference=how).refined_cameras(5000) for how in ("joint", "paper", "frozen")] == [
        *(5000, 5000, 0)
    ]


def test_no_measurement_is_written_a_second_time() -> None:
    """The kinds of measurements are classes of the adjustment alone: training follows their normal matrix."""
    folder = Path(pipelines.train.__file__).parent
    classes = [
        name for file in folder.rglob("*.py") for name in re.findall(r"^class (\w+)", file.read_text("utf-8"), re.M)
    ]
    kinds = [kind.__name__.rstrip("s") for kind in (*Term.__subclasses__(), *MarkedTerm.__subclasses__())]
    assert "Fixe" in kinds and "ControlPoint" in kinds and "SolutionUnknowns" in classes
    assert [name for name in classes if name.startswith(tuple(kinds))] == []
