"""Each term alone mends what it is there for, with the training's own optimiser and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.adjust.posterior import minimise, solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.so3 import log_so3 as torch_log
from pipelines.adjust.start import begin
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import ControlTerm, FixTerm, PlaneTerm
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3, log_so3
from pipelines.geometry.similarity import Similarity
from tests.georef_scenes import (
    SHIFT,
    Block,
    Truth,
    attitudes_of,
    contradicting,
    descend,
    draw_truth,
    fixes_of,
    make_block,
    marks_of,
    pairs_of,
    problem_with,
    terms,
)

pytestmark = pytest.mark.usefixtures("one_thread")
BLOCK = make_block(images=10)
RTK, CONSUMER = np.array([0.02, 0.02, 0.03]), np.array([1.5, 1.5, 3.0])
CONTROL = np.array([[-15.0, -15, 0], [15, -12, 1], [12, 15, 2], [-14, 13, 0.5], [0, 0, 3]])
# Half a per cent, half a degree, a metre: within what `georef_scenes.LOOSE` says of the start.
OFF = Similarity(1.005, exp_so3([0.004, -0.006, 0.008]), SHIFT + np.array([1.0, -1.5, 0.8]))
STIFF = replace(BLOCK, basis=np.zeros((10, 6, 0)))


def moved(fixes: FixTerm, offset_m: np.ndarray) -> FixTerm:
    return replace(fixes, position_in_geo=fixes.position_in_geo + torch.from_numpy(offset_m))


def error_m(problem: GeoProblem, truth: Truth, points: np.ndarray) -> float:
    """Largest error of points (n, 3) of `model` on Earth."""
    return float(np.abs(problem.similarity.current().apply(points) - truth.geo_from_model.apply(points)).max())


def test_absolute_loss_brings_a_shifted_and_turned_flight_home() -> None:
    truth = Truth(OFF, BLOCK.poses)
    problem = problem_with(STIFF, terms(fixes_of(truth, RTK, np.random.default_rng(0))))
    assert error_m(problem, truth, CONTROL) > 1.0
    descend(problem)
    assert error_m(problem, truth, CONTROL) < 0.03  # 2 to 3 cm over √10, and 40 m of arm


def domed(center: np.ndarray, lift: float) -> tuple[CameraPoses, np.ndarray]:
    """Cameras at centres (n, 3) that look straight down, bent into a dome; and the bend as a correction (n, 6).

    What looks like this to every camera is a ground that is domed as well: SfM from above hardly resists it.
    """
    down = np.tile(np.diag([1.0, -1.0, -1.0]), (len(center), 1, 1))
    x, y = center[:, 0], center[:, 1]
    mode = np.zeros((len(center), 6))
    mode[:, 0], mode[:, 1], mode[:, 5] = 2 * lift * y, -2 * lift * x, lift * (x**2 + y**2)
    return CameraPoses(down @ exp_so3(-mode[:, :3]), center + mode[:, 3:]), mode


def test_control_points_straighten_a_bowed_block() -> None:
    axis = np.linspace(-40, 40, 5)
    east, north = (each.ravel() for each in np.meshgrid(axis, axis))
    center = np.column_stack([east, north, np.full(25, 50.0)])
    bent, mode = domed(center, 0.5 / 3200)  # 0.5 m at the corners
    true = CameraPoses(np.tile(np.diag([1.0, -1.0, -1.0]), (25, 1, 1)), center)
    block = Block(bent, 2 * mode[:, :, None])  # a bend of twice that has σ 1
    truth = Truth(Similarity(translation=SHIFT), true)
    given = np.array([[x, y, 0.0] for x in (-38.0, 0.0, 38.0) for y in (-38.0, 0.0, 38.0)])
    checked = np.array([[x, y, 0.0] for x in (-20.0, 20.0) for y in (-20.0, 20.0)] + [[30.0, -5, 0], [-5, 30, 0]])
    rng = np.random.default_rng(0)
    problem = problem_with(block, terms(near(marks_of(truth, given, 0.005, rng), given, center)))
    check = near(marks_of(truth, checked, 1e-6, rng), checked, center)

    def height_error() -> float:
        return float(check.residuals(problem.estimate()).detach()[:, 2].square().mean().sqrt())

    level = problem_with(replace(block, basis=np.zeros((25, 6, 0))), problem.terms)
    for each in (problem, level):
        descend(each, 600)
    assert height_error() < 0.02
    problem = level  # with cameras that may not move, the best similarity leaves the dome
    assert height_error() > 0.06


def near(marks: ControlTerm, points: np.ndarray, center: np.ndarray) -> ControlTerm:
    """Only the marks in cameras nearly above the points."""
    away = np.linalg.norm((points[marks.point] - center[marks.camera])[:, :2], axis=1)
    kept = torch.from_numpy(away < 25.0)
    return replace(
        marks,
        point=marks.point[kept],
        camera=marks.camera[kept],
        bearing_in_cam=marks.bearing_in_cam[kept],
        sigma_rad=marks.sigma_rad[kept],
    )


def test_control_points_outvote_biased_positions() -> None:
    truth, rng = Truth(OFF, BLOCK.poses), np.random.default_rng(1)
    fixes = moved(fixes_of(truth, CONSUMER, rng), np.array([4.0, -3.0, 8.0]))
    without = problem_with(STIFF, terms(fixes))
    with_control = problem_with(STIFF, terms(fixes, marks_of(truth, CONTROL, 0.02, rng)))
    for problem in (without, with_control):
        minimise(problem)
    assert error_m(without, truth, CONTROL) > 3.0
    assert error_m(with_control, truth, CONTROL) < 0.06


def test_relative_loss_mends_the_scale_and_nothing_else() -> None:
    truth = Truth(Similarity(1.01, np.eye(3), SHIFT), BLOCK.poses)
    points = np.random.default_rng(2).uniform(-20, 20, (12, 3))
    problem = problem_with(STIFF, terms(pairs_of(truth, points, 0.005, np.random.default_rng(3))))
    descend(problem)
    found = problem.similarity.current()
    # 5 mm over pairs of some 20 m, 66 of them that hang on 12 points.
    assert found.scale == pytest.approx(1.01, abs=3e-4)
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-9)
    pivot = problem.similarity.pivot_in_geo
    np.testing.assert_allclose(found.apply((pivot - SHIFT)[None])[0], pivot, atol=1e-9)


def estimated(problem: GeoProblem, name: str) -> tuple[np.ndarray, np.ndarray, tuple[bool, bool, bool]]:
    """Value, σ and whether it was observed."""
    (found,) = [each for each in problem.errors.estimates(solution_covariances(problem)[1]) if each.name == name]
    return np.array(found.value), np.array(found.sigma), found.observed


def test_bias_of_a_flight_is_told_by_control_points() -> None:
    truth, rng, bias = Truth(OFF, BLOCK.poses), np.random.default_rng(4), np.array([0.5, -0.3, 1.2])
    measured = terms(moved(fixes_of(truth, RTK, rng), bias), marks_of(truth, CONTROL, 0.02, rng))
    blind, problem = problem_with(STIFF, measured), problem_with(STIFF, measured, SystematicErrors(1))
    assert begin(problem) > 100.0
    for each in (blind, problem):
        descend(each)
    assert error_m(problem, truth, CONTROL) < 0.04
    assert error_m(blind, truth, CONTROL) > 0.1
    value, sigma, observed = estimated(problem, "bias")
    assert (np.abs(value - bias) < 4 * sigma).all()
    assert sigma.max() < 0.02  # 2 cm over √5, 3 cm over √10
    assert observed == (True, True, True)
    assert contradicting(problem, ControlTerm) == contradicting(problem, FixTerm) == []


def test_two_flights_have_a_bias_each() -> None:
    truth, rng = Truth(OFF, BLOCK.poses), np.random.default_rng(5)
    flight = torch.tensor([0, 1] * 5)
    biases = np.array([[0.4, 0.0, -0.6], [-0.4, 0.1, 0.6]])  # no offset on the average
    fixes = fixes_of(truth, RTK, rng)
    fixes = replace(moved(fixes, biases[flight.numpy()]), flight=flight)
    problem = problem_with(STIFF, terms(fixes, marks_of(truth, CONTROL, 0.02, rng)), SystematicErrors(2))
    begin(problem)
    minimise(problem)
    found = problem.errors.estimates(solution_covariances(problem)[1])
    assert [each.flight for each in found] == [0, 1]
    np.testing.assert_allclose([each.value for each in found], biases, atol=0.06)
    assert error_m(problem, truth, CONTROL) < 0.04


def test_bias_without_control_points_is_not_observed() -> None:
    truth = Truth(OFF, BLOCK.poses)
    problem = problem_with(STIFF, terms(fixes_of(truth, RTK, np.random.default_rng(0))), SystematicErrors(1))
    begin(problem)
    assert estimated(problem, "bias")[2] == (False, False, False)
    # Nobody then knows the position better than the prior of the bias.
    assert np.sqrt(np.diag(solution_covariances(problem)[0])[4:]) == pytest.approx([5.0, 5.0, 10.0], rel=0.01)


def test_lever_arm_is_found_and_taken_out() -> None:
    truth, rng, arm = Truth(OFF, BLOCK.poses), np.random.default_rng(6), np.array([0.1, -0.4, 0.25])
    offset = (OFF.rotation @ np.swapaxes(BLOCK.poses.cam_from_model, 1, 2)) @ arm
    measured = terms(moved(fixes_of(truth, RTK, rng), offset), marks_of(truth, CONTROL, 0.02, rng))
    problem = problem_with(STIFF, measured, SystematicErrors(arm=True))
    begin(problem)
    minimise(problem)
    value, sigma, observed = estimated(problem, "lever-arm")
    assert (np.abs(value - arm) < 4 * sigma).all()
    assert sigma.max() < 0.05
    assert observed == (True, True, True)
    assert error_m(problem, truth, CONTROL) < 0.04


def test_lever_arm_passes_for_a_similarity_without_control_points() -> None:
    # All cameras look at the middle: an antenna further out is a larger ring, one to the right a turned one.
    truth = Truth(OFF, BLOCK.poses)
    problem = problem_with(STIFF, terms(fixes_of(truth, RTK, np.random.default_rng(0))), SystematicErrors(arm=True))
    begin(problem)
    observed = estimated(problem, "lever-arm")[2]
    assert not observed[0]
    assert not observed[2]


def test_boresight_is_found() -> None:
    truth, rng = Truth(OFF, BLOCK.poses), np.random.default_rng(7)
    boresight_rad, sigma_rad = np.radians([2.0, -3.0, 8.0]), np.radians(0.5)
    attitudes = attitudes_of(truth, sigma_rad, rng, exp_so3(boresight_rad))
    measured = terms(fixes_of(truth, RTK, rng), attitudes)
    problem = problem_with(STIFF, measured, SystematicErrors(attitude_sigma_rad=sigma_rad))
    begin(problem)
    minimise(problem)
    value, sigma, observed = estimated(problem, "boresight")
    assert (np.abs(value - np.degrees(boresight_rad)) < 4 * sigma).all()
    # What all attitudes share in the axes of geo does not average out, but for what turns with the cameras.
    assert 0.5 / np.sqrt(10) < sigma.max() < 0.6
    assert observed == (True, True, True)
    assert error_m(problem, truth, CONTROL) < 0.05


def test_attitudes_claim_no_more_of_the_rotation_than_one_of_them() -> None:
    # A compass that is 3° off turns all attitudes alike, and must not turn what RTK knows.
    truth, rng = Truth(OFF, BLOCK.poses), np.random.default_rng(8)
    attitudes = attitudes_of(truth, np.radians(0.5), rng)
    turned = torch.from_numpy(exp_so3([0.0, 0.0, np.radians(3.0)])) @ attitudes.geo_from_cam
    measured = terms(fixes_of(truth, CONSUMER, rng), replace(attitudes, geo_from_cam=turned))
    alone = problem_with(STIFF, measured[:1])
    problem = problem_with(STIFF, measured, SystematicErrors(attitude_sigma_rad=np.radians(0.5)))
    begin(problem)
    assert np.sqrt(solution_covariances(problem)[0][3, 3]) > np.radians(0.4)
    assert np.sqrt(solution_covariances(problem)[0][3, 3]) < np.sqrt(solution_covariances(alone)[0][3, 3])


def test_a_moved_control_point_is_named() -> None:
    truth, rng = Truth(OFF, BLOCK.poses), np.random.default_rng(9)
    marks = marks_of(truth, CONTROL, 0.02, rng)
    position = marks.position_in_geo.clone()
    position[2] += torch.tensor([0.5, 0.0, -0.4])
    problem = problem_with(STIFF, terms(fixes_of(truth, RTK, rng), replace(marks, position_in_geo=position)))
    minimise(problem)
    assert contradicting(problem, ControlTerm) == [2]
    assert contradicting(problem, FixTerm) == []


def test_observations_move_with_the_parameters() -> None:
    truth, rng = draw_truth(BLOCK, np.random.default_rng(0)), np.random.default_rng(0)
    measured = terms(
        replace(fixes_of(truth, RTK, rng), flight=torch.zeros(10, dtype=torch.int64)),
        marks_of(truth, CONTROL, 0.02, rng),
        attitudes_of(truth, 0.01, rng),
        pairs_of(truth, CONTROL, 0.1, rng),
    )
    errors = SystematicErrors(1, arm=True, attitude_sigma_rad=0.01)
    loss = problem_with(BLOCK, measured, errors, learned_weights=True).to("meta").loss()
    assert loss.device.type == "meta"


def test_log_of_a_rotation() -> None:
    vector = np.array([[0.0, 0, 0], [1e-9, 0, 0], [0.3, -0.2, 0.5], [0, 3.0, 0]])
    rotation = torch.from_numpy(exp_so3(vector)).requires_grad_()
    found = torch_log(rotation)
    np.testing.assert_allclose(found.detach(), vector, atol=1e-12)
    np.testing.assert_allclose(found.detach()[2:], log_so3(exp_so3(vector[2:])), atol=1e-12)
    found.sum().backward()
    assert rotation.grad is not None
    assert torch.isfinite(rotation.grad).all()


def planes_of(truth: Truth, shift_m: np.ndarray, sigma_m: float, rng: np.random.Generator) -> PlaneTerm:
    """120 planes of ground, two slopes and walls to two sides, of a LiDAR that is shifted."""
    facing = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8], [1, 0, 0], [0, 1, 0]], dtype=np.float64)
    normal = facing[rng.integers(0, 5, 120)]
    point = rng.uniform([-30, -30, 0], [30, 30, 8], (120, 3))
    on_plane = truth.geo_from_model.apply(point) + sigma_m * rng.normal(size=(120, 1)) * normal + shift_m
    root = torch.full((120, 1, 1), 1 / sigma_m, dtype=torch.float64)
    return PlaneTerm(torch.from_numpy(point), torch.from_numpy(on_plane), torch.from_numpy(normal), root)


@pytest.mark.parametrize("seed", range(4))
def test_shift_of_a_lidar_is_found_beside_the_fixes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, shift = Truth(Similarity(1.0, np.eye(3), SHIFT), BLOCK.poses), np.array([0.06, -0.08, 0.10])
    measured = terms(fixes_of(truth, RTK, rng), planes_of(truth, shift, 0.01, rng))
    problem = problem_with(STIFF, measured, SystematicErrors(lidar=True))
    begin(problem)
    minimise(problem)
    _, covariance = solution_covariances(problem)
    (found,) = problem.errors.estimates(covariance)
    assert found.name == "lidar-shift" and all(found.observed)
    error, sigma = np.array(found.value) - shift, np.array(found.sigma)
    # Ten fixes of 2 and 3 cm tell where the photographs are: 1 cm.
    assert (np.abs(error) < 4 * sigma).all() and (sigma < 0.015).all()
