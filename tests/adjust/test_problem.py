"""The geographic half by itself: where its minimum lies, how well it knows that, and what it resists."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from pipelines.adjust.alignment import align
from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.posterior import minimise, solution_covariances
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.similarity_fit import Correspondences, RotationPrior
from pipelines.adjust.start import begin, bias_pays
from pipelines.adjust.systematic import SystematicErrors
from pipelines.adjust.terms import FixTerm
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.rotations import exp_so3
from pipelines.geometry.similarity import Similarity, jacobian_at, umeyama
from tests.georef_scenes import (
    SHIFT,
    Block,
    contradicting,
    draw_truth,
    fixes_of,
    make_block,
    marks_of,
    pivot,
    problem_of,
    problem_with,
    squared_error,
    terms,
)

pytestmark = pytest.mark.usefixtures("one_thread")
BLOCK = make_block()
RTK = np.array([0.02, 0.02, 0.03])
CONSUMER = np.array([1.5, 1.5, 3.0])
CONTROL = np.array([[-15.0, -15, 0], [15, -12, 1], [12, 15, 2], [-14, 13, 0.5], [0, 0, 3]])
FAR = float(chi2.ppf(0.999, 7))


@pytest.mark.parametrize(
    ("sigma_m", "control", "biased"),
    [(RTK, False, False), (CONSUMER, False, False), (CONSUMER, True, False), (RTK, True, True)],
    ids=["rtk", "consumer", "consumer and control", "biased rtk and control"],
)
def test_covariance_is_calibrated(sigma_m: np.ndarray, control: bool, biased: bool) -> None:
    squared, of_points, of_bias = [], [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = draw_truth(BLOCK, rng)
        bias = rng.normal(size=3) if biased else np.zeros(3)
        fixes = fixes_of(truth, sigma_m, rng)
        fixes = replace(fixes, position_in_geo=fixes.position_in_geo + torch.from_numpy(bias))
        marks = marks_of(truth, CONTROL[:4], 0.02, rng) if control else None
        problem = problem_with(BLOCK, terms(fixes, marks), SystematicErrors(int(biased)))
        if biased:
            begin(problem)
        minimise(problem)
        covariance, of_errors = solution_covariances(problem)
        found = problem.similarity.current()
        squared.append(squared_error(truth.geo_from_model, found, covariance, pivot(BLOCK)))
        if biased:
            missed = problem.errors.vector().detach().numpy() - bias
            of_bias.append(missed @ np.linalg.solve(of_errors, missed))
        jacobian = jacobian_at(found.apply(CONTROL[4:]), pivot(BLOCK))[0]
        missed = (found.apply(CONTROL[4:]) - truth.geo_from_model.apply(CONTROL[4:]))[0]
        of_points.append(missed @ np.linalg.solve(jacobian @ covariance @ jacobian.T, missed))
    # The mean of 30 χ²₇ has σ 0.68, 10 % of 7; that of χ²₃ 15 % of 3.
    assert np.mean(squared) == pytest.approx(7.0, rel=0.25)
    assert np.mean(of_points) == pytest.approx(3.0, rel=0.4)
    assert not biased or np.mean(of_bias) == pytest.approx(3.0, rel=0.4)


def test_bias_is_believed_where_it_is_and_costs_nothing_where_it_is_not() -> None:
    """Position error of what `auto` does, over eight surveys, against knowing which of the two is the case."""
    gone = {0.0: [], 0.4: []}  # type: dict[float, list[tuple[float, float]]]
    for offset, errors in gone.items():
        for seed in range(8):
            rng = np.random.default_rng(100 + seed)
            truth = replace(draw_truth(BLOCK, rng), poses=BLOCK.poses)
            fixes = fixes_of(truth, RTK, rng)
            shifted = fixes.position_in_geo + torch.tensor([offset, -offset / 2, offset])
            measured = terms(replace(fixes, position_in_geo=shifted), marks_of(truth, CONTROL, 0.03, rng))
            stiff = replace(BLOCK, basis=np.zeros((12, 6, 0)))
            free, none = problem_with(stiff, measured, SystematicErrors(1)), problem_with(stiff, measured)
            believed = bias_pays(free.errors, begin(free))
            assert believed is (offset > 0)
            for problem in (free, none):
                minimise(problem)
            wrong = [
                float(np.linalg.norm(p.similarity.current().apply(CONTROL) - truth.geo_from_model.apply(CONTROL)))
                for p in (free, none)
            ]
            errors.append((wrong[0] if believed else wrong[1], wrong[1]))
    without, with_bias = (np.array(gone[offset]) for offset in (0.0, 0.4))
    np.testing.assert_array_equal(without[:, 0], without[:, 1])
    # 3 cm over √5 control points, in place of 0.6 m that some of the fixes claim.
    assert np.median(with_bias[:, 0]) < 0.1 < np.median(with_bias[:, 1])


@pytest.mark.parametrize("control", [False, True])
def test_minimum_of_the_loss_is_where_gauss_newton_ends(control: bool) -> None:
    rng = np.random.default_rng(4)
    truth = draw_truth(BLOCK, rng)
    problem = problem_of(BLOCK, fixes_of(truth, RTK, rng), marks_of(truth, CONTROL, 0.02, rng) if control else None)
    problem.loss().backward()
    start = problem.similarity.y.grad
    assert start is not None
    before = float(start.norm())
    problem.zero_grad()
    minimise(problem)
    problem.loss().backward()
    for parameter in (problem.similarity.y, problem.cameras.z):
        assert parameter.grad is not None
        assert float(parameter.grad.norm()) < 1e-3 * before


def test_one_outlier_moves_nothing() -> None:
    rng = np.random.default_rng(2)
    truth = draw_truth(BLOCK, rng)
    fixes = fixes_of(truth, RTK, rng)
    spoilt = fixes.position_in_geo.clone()
    spoilt[3] += torch.tensor([9.0, -12.0, 0.0], dtype=torch.float64)  # 15 m
    clean, hit = problem_of(BLOCK, fixes), problem_of(BLOCK, replace(fixes, position_in_geo=spoilt))
    minimise(clean)
    minimise(hit)
    center = BLOCK.poses.cam_center_in_model
    moved = hit.similarity.current().apply(center) - clean.similarity.current().apply(center)
    # Losing one fix of twelve moves the block by a fraction of its σ, 1 cm; 15 m in the mean would be 1.25 m.
    assert np.abs(moved).max() < 0.02
    assert contradicting(hit, FixTerm) == [3]
    assert contradicting(clean, FixTerm) == []
    assert (
        squared_error(truth.geo_from_model, hit.similarity.current(), solution_covariances(hit)[0], pivot(BLOCK))
        < FAR
    )


def test_bowed_block_is_straightened_by_its_fixes() -> None:
    # SfM bows flat blocks: the truth is the block with each camera lifted by up to 0.4 m, smoothly.
    center = BLOCK.poses.cam_center_in_model
    bow = 0.4 * np.cos(2 * np.arctan2(center[:, 1], center[:, 0]))
    straight = CameraPoses(BLOCK.poses.cam_from_model, center + bow[:, None] * [0.0, 0.0, 1.0])
    loose = replace(BLOCK, basis=20 * BLOCK.basis)  # bundle adjustment knows the bow to 0.4 m, not to 2 cm
    truth = replace(draw_truth(BLOCK, np.random.default_rng(0)), poses=straight)
    problem = problem_of(loose, fixes_of(truth, RTK, np.random.default_rng(0)))
    minimise(problem)
    found = problem.similarity.current().apply(problem.cameras.current().cam_center_in_model)
    error = found - truth.geo_from_model.apply(straight.cam_center_in_model)
    # Each camera follows its own fix of 2 to 3 cm; before, the best similarity leaves 0.28 m.
    assert np.sqrt((error**2).mean()) < 0.035
    fitted = umeyama(center, truth.geo_from_model.apply(straight.cam_center_in_model))
    before = fitted.apply(center) - truth.geo_from_model.apply(straight.cam_center_in_model)
    assert np.sqrt((before**2).sum(axis=1).mean()) > 0.2


def test_stiff_block_keeps_its_shape() -> None:
    # Fixes of metres must not bend what bundle adjustment knows to centimetres.
    rng = np.random.default_rng(6)
    truth = draw_truth(BLOCK, rng)
    problem = problem_of(BLOCK, fixes_of(truth, CONSUMER, rng))
    minimise(problem)
    moved = problem.cameras.current().cam_center_in_model - BLOCK.poses.cam_center_in_model
    assert np.abs(moved).max() < 0.005


def test_control_points_alone_fix_scale_and_shift() -> None:
    rng = np.random.default_rng(1)
    away = Similarity(1.02, np.eye(3), SHIFT + np.array([4.0, -3.0, 2.0]))
    truth = replace(draw_truth(BLOCK, rng), geo_from_model=away, poses=BLOCK.poses)
    problem = problem_of(BLOCK, None, marks_of(truth, CONTROL, 0.005, rng))
    minimise(problem)
    found = problem.similarity.current()
    assert found.scale == pytest.approx(1.02, rel=2e-3)
    # 5 mm over 5 points, and the cameras' own 2 cm over 12.
    np.testing.assert_allclose(found.apply(CONTROL), away.apply(CONTROL), atol=0.015)


def test_gauge_holds_while_the_measurements_pull() -> None:
    rng = np.random.default_rng(9)
    truth = draw_truth(BLOCK, rng)
    loose = replace(BLOCK, basis=50 * BLOCK.basis)
    problem = problem_of(loose, fixes_of(truth, RTK, rng))
    minimise(problem)
    center, moved = BLOCK.poses.cam_center_in_model, problem.cameras.current().cam_center_in_model
    assert np.abs(moved - center).max() > 0.01
    arm = center - center.mean(axis=0)
    # Mean shift and mean stretch of the corrections: what the similarity is there for.
    assert np.abs((moved - center).mean(axis=0)).max() < 1e-9
    assert abs((arm * (moved - center)).sum() / (arm * arm).sum()) < 1e-12


def line_of(images: int) -> Block:
    """Cameras that look straight down from a line of 100 m, and are held."""
    center = np.column_stack([np.linspace(-50, 50, images), np.zeros((images, 2))])
    poses = CameraPoses(np.tile(np.diag([1.0, -1.0, -1.0]), (images, 1, 1)), center)
    return Block(poses, np.zeros((images, 6, 0)))


@pytest.mark.parametrize(
    ("sigma_m", "sigma_rad"),
    [(RTK, 0.02), (CONSUMER, 0.02), (CONSUMER, 0.1)],
    ids=["rtk", "consumer", "poor compass"],
)
def test_covariance_of_a_line_counts_its_fixes_once(sigma_m: np.ndarray, sigma_rad: float) -> None:
    """Only the attitude is held: the start was estimated from the fixes, which are observed in training again."""
    block, squared, twice = line_of(12), [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        truth = replace(draw_truth(block, rng), poses=block.poses)
        fixes = fixes_of(truth, sigma_m, rng)
        seen = exp_so3(sigma_rad * rng.normal(size=3)) @ truth.geo_from_model.rotation
        attitude = RotationPrior(seen, sigma_rad**2 * np.eye(3))
        start = align(_correspondences(block, fixes, sigma_m), rng, attitude=attitude)
        about = start.solution.pivot
        for prior, found in ((attitude, squared), (None, twice)):
            similarity = LearnableSimilarity(start.geo_from_local, start.solution.covariance, about, prior)
            assert similarity.current().apply(about) == pytest.approx(start.geo_from_local.apply(about), abs=1e-9)
            problem = GeoProblem(
                similarity, CameraCorrections(block.poses, block.basis), terms(fixes, None), hold_prior=True
            )
            minimise(problem)
            found.append(
                squared_error(truth.geo_from_model, similarity.current(), solution_covariances(problem)[0], about)
            )
    # The mean of 30 χ²₇ has σ 0.68, 10 % of 7.
    assert np.mean(squared) == pytest.approx(7.0, rel=0.25)
    # All of the start held: six of the seven unknowns, those that the fixes know, look twice as certain.
    assert np.mean(twice) > 9.0


def _correspondences(block: Block, fixes: FixTerm, sigma_m: np.ndarray) -> Correspondences:
    count = len(block.poses.cam_center_in_model)
    return Correspondences(
        name=tuple(map(str, range(count))),
        control=np.zeros(count, dtype=bool),
        in_local=block.poses.cam_center_in_model,
        cov_in_local=np.zeros((count, 3, 3)),
        in_geo=fixes.position_in_geo.numpy(),
        cov_in_geo=np.tile(np.diag(sigma_m**2), (count, 1, 1)),
    )


def test_prior_is_held_where_asked() -> None:
    # On a line the turn about it is open: only the initial estimate knows it.
    block = line_of(6)
    rng = np.random.default_rng(0)
    truth = replace(draw_truth(block, rng), poses=block.poses)
    problem = problem_of(block, fixes_of(truth, RTK, rng))
    problem.hold_prior = True
    minimise(problem)
    covariance = solution_covariances(problem)[0]
    # A priori 0.02 rad about every axis; the fixes say nothing of the one along the line (east).
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.02, rel=0.02)
    assert np.sqrt(covariance[2, 2]) < 1e-3


def test_cameras_that_are_held_leave_a_covariance() -> None:
    rng = np.random.default_rng(3)
    truth = replace(draw_truth(BLOCK, rng), poses=BLOCK.poses)
    problem = problem_of(replace(BLOCK, basis=np.zeros((12, 6, 0))), fixes_of(truth, RTK, rng))
    minimise(problem)
    assert (
        squared_error(
            truth.geo_from_model, problem.similarity.current(), solution_covariances(problem)[0], pivot(BLOCK)
        )
        < FAR
    )


def test_paper_weighting_is_plain_least_squares() -> None:
    rng = np.random.default_rng(8)
    truth = replace(draw_truth(BLOCK, rng), poses=BLOCK.poses)
    fixes, marks = fixes_of(truth, RTK, rng), marks_of(truth, CONTROL, 0.02, rng)
    problem = problem_of(BLOCK, fixes, marks, weighting="paper")
    values = problem.losses()
    assert float(problem.loss().detach()) == pytest.approx(float((values["absolute"] + values["control"]).detach()))
    with torch.no_grad():
        problem.cameras.z += 1.0
    again = problem.losses()
    assert float(problem.loss().detach()) == pytest.approx(float((again["absolute"] + again["control"]).detach()))
