"""Thirty surveys with everything drawn: is the predicted accuracy true, and do the estimates come near the bound?

Each run draws image observations, fixes, control points and marks with the σ that they state. The bundle is
adjusted with its lens, the tool then finds similarity and cameras, and points that no one surveyed are intersected
from their marks. The bundle is small and its lens is weak (σ of the focal length 0.3 %), so that every part of the
prediction counts: the similarity, the cameras, the lens, the marks. In a second bundle all cameras are held level,
which leaves the principal point, and with it the heights, to the fixes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag

from pipelines.adjust.cameras import CameraCorrections
from pipelines.adjust.intersection_jacobian import intersection_jacobian
from pipelines.adjust.posterior import FreeLens, minimise, posterior
from pipelines.adjust.problem import GeoProblem
from pipelines.adjust.similarity import LearnableSimilarity
from pipelines.adjust.terms import ControlTerm, FixTerm
from pipelines.evaluate.cautions import refutation
from pipelines.evaluate.cramer_rao import Anchors, CameraInformation
from pipelines.geometry.bundle import Network
from pipelines.geometry.cameras import CameraPoses
from pipelines.geometry.correction_basis import correction_basis
from pipelines.geometry.lens import Lenses, bearings
from pipelines.geometry.similarity import Similarity
from pipelines.view.quantities import MeasuredPoints, distances
from tests.bundle_scenes import LENS, SIGMA_PX, adjuster, exact_network, noisy, pixels, readjusted, size
from tests.georef_scenes import terms

pytestmark = pytest.mark.usefixtures("one_thread")
IMAGES, MARK_PX, SURVEY_M = 8, 0.3, 0.02
RTK, CONSUMER = np.array([0.02, 0.02, 0.03]), np.array([1.5, 1.5, 3.0])
START = np.diag([0.01, 0.02, 0.02, 0.02, 2.0, 2.0, 2.0]) ** 2
EXACT = exact_network(images=IMAGES)
LEVEL = exact_network(images=IMAGES, rolled=False)
PLACES = np.random.default_rng(99)
CONTROL = PLACES.uniform([-8, -8, -4], [8, 8, 6], (5, 3))
CHECK = PLACES.uniform([-9, -9, -6], [9, 9, 9], (12, 3))


@dataclass(frozen=True)
class Run:
    """Errors (J, 3) at the held-out points, and their joint predicted covariance (3 J, 3 J)."""

    error: np.ndarray
    joint: np.ndarray


def marked(points: np.ndarray, truth: Network, network: Network | None = None) -> Network:
    """Points that all cameras see, at their exact pixels; in the cameras of `network`, if given."""
    count = len(points)
    seen = replace(
        truth,
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )
    xy = pixels(seen, np.zeros(size(seen)))
    at = truth if network is None else network
    poses = {"cam_from_world": at.cam_from_world, "cam_center_in_world": at.cam_center_in_world}
    return replace(seen, obs_xy_px=xy, cameras=at.cameras, **poses)


def marks_of(seen: Network, cov_survey: np.ndarray, rng: np.random.Generator) -> ControlTerm:
    """Noisy marks, read through the adjusted lens, and a noisy survey."""
    xy_px = seen.obs_xy_px + rng.normal(0, MARK_PX, seen.obs_xy_px.shape)
    cov = intersection_jacobian(seen, np.full(len(xy_px), MARK_PX)).cov_of_marks + cov_survey
    surveyed = seen.point_in_world + rng.multivariate_normal(np.zeros(3), cov_survey, len(cov))
    return ControlTerm(
        torch.from_numpy(seen.obs_point),
        torch.from_numpy(seen.obs_image),
        torch.from_numpy(bearings(seen.cameras[1], xy_px)),
        torch.full((len(xy_px),), MARK_PX / LENS.params[0], dtype=torch.float64),
        torch.from_numpy(surveyed),
        torch.from_numpy(np.linalg.inv(np.linalg.cholesky(cov))),
        bearing_by_lens=torch.from_numpy(
            Lenses(seen.cameras, seen.camera_id).bearing_jacobian(seen.obs_image, xy_px)
        ),
    )


@dataclass(frozen=True)
class Setting:
    """What is drawn from: true bundle, σ (3,) of the fixes, control points or none; whether the lens follows."""

    sigma_m: np.ndarray
    control: bool
    truth: Network = EXACT
    follows: bool = True


def one_run(seed: int, setting: Setting, solve: np.ndarray) -> Run:
    rng, truth, sigma_m = np.random.default_rng(seed), setting.truth, setting.sigma_m
    drawn = noisy(truth, rng)
    network = readjusted(drawn, solve @ (drawn.obs_xy_px - truth.obs_xy_px).ravel())
    found, center = correction_basis(network, lens_follows=setting.follows), truth.cam_center_in_world
    fixes = FixTerm(
        torch.arange(IMAGES),
        torch.from_numpy(center + sigma_m * rng.normal(size=center.shape)),
        torch.from_numpy(np.tile(np.diag(1 / sigma_m), (IMAGES, 1, 1))),
    )
    at_control = marked(CONTROL, truth, network)
    problem = GeoProblem(
        LearnableSimilarity(Similarity(), START, center.mean(axis=0)),
        CameraCorrections(
            CameraPoses(network.cam_from_world, network.cam_center_in_world),
            found.matrix,
            found.lens_matrix if setting.follows else None,
        ),
        terms(fixes, marks_of(at_control, SURVEY_M**2 * np.eye(3), rng) if setting.control else None),
    )
    minimise(problem)
    by_control = intersection_jacobian(at_control, np.full(len(at_control.obs_point), MARK_PX)).by_lens
    joint = posterior(problem, FreeLens(found.lens_cov, by_control))
    at_check = marked(CHECK, truth, network)
    with torch.no_grad():
        measured = problem.similarity(marks_of(at_check, np.zeros((3, 3)), rng).intersected(problem.estimate()))
    moved = intersection_jacobian(at_check, np.full(len(at_check.obs_point), MARK_PX))
    by_cameras = moved.by_corrections(found.matrix) + moved.by_lens @ found.lens_matrix
    predicted = joint.jointly_at(measured.numpy(), by_cameras, moved.by_lens) + block_diag(*moved.cov_of_marks)
    return Run(measured.numpy() - CHECK, predicted)


@cache
def runs_of(count: int, profile: str) -> tuple[Run, ...]:
    return tuple(draw(count, PROFILES[profile]))


def draw(count: int, setting: Setting) -> list[Run]:
    solve = adjuster(setting.truth)
    return [one_run(seed, setting, solve) for seed in range(count)]


def squares(found: Iterable[Run]) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors and predicted variances (count, J, 3)."""
    predicted = [np.diagonal(run.joint).reshape(-1, 3) for run in found]
    return np.array([run.error**2 for run in found]), np.array(predicted)


def bound(setting: Setting) -> np.ndarray:
    """Least variances (J, 3) of the held-out points."""
    anchors = Anchors(np.arange(IMAGES), np.tile(np.diag(setting.sigma_m**2), (IMAGES, 1, 1)))
    if setting.control:
        marks = np.full(IMAGES * len(CONTROL), MARK_PX)
        cov = np.tile(SURVEY_M**2 * np.eye(3), (len(CONTROL), 1, 1))
        anchors = replace(anchors, control=marked(CONTROL, setting.truth), control_sigma_px=marks, cov_control=cov)
    information = CameraInformation(setting.truth, SIGMA_PX, anchors)
    found = information.bound(marked(CHECK, setting.truth), np.full(IMAGES * len(CHECK), MARK_PX))
    return np.diagonal(found, axis1=1, axis2=2)


PROFILES = {
    "rtk": Setting(RTK, control=False),
    "rtk and control": Setting(RTK, control=True),
    "consumer": Setting(CONSUMER, control=False),
    "consumer and control": Setting(CONSUMER, control=True),
    "rtk, all level": Setting(RTK, control=False, truth=LEVEL),
}
ABOVE_BOUND = 1.15  # robust weights cost some per cent, and thirty runs know a root mean square to a tenth


@pytest.mark.parametrize("profile", PROFILES)
def test_predicted_accuracy_is_true(profile: str) -> None:
    setting = PROFILES[profile]
    squared, variance = squares(runs_of(30, profile))
    # Points of a run share most of their error: 30 values and a few more for each axis, σ of the mean 0.13.
    assert (squared / variance).mean() == pytest.approx(1.0, abs=0.25)
    assert np.sqrt(squared.mean() / bound(setting).mean()) < ABOVE_BOUND


@pytest.mark.parametrize("profile", PROFILES)
def test_sigma_of_a_distance_is_true(profile: str) -> None:
    squared, of_distance, of_points = [], [], []
    for run in runs_of(30, profile):
        for pair in ([0, 1], [2, 7], [4, 9], [5, 10]):
            rows = (3 * np.array(pair)[:, None] + np.arange(3)).ravel()
            places, cov = CHECK[pair] + run.error[pair], run.joint[np.ix_(rows, rows)]
            true = distances(MeasuredPoints(CHECK[pair], None, CHECK[pair][:, 2]))
            for quantity, truth in zip(distances(MeasuredPoints(places, cov, places[:, 2])), true, strict=True):
                assert quantity.sigma is not None
                squared.append(((quantity.value - truth.value) / quantity.sigma) ** 2)
                of_distance.append(quantity.sigma)
            of_points.append(np.sqrt(np.trace(cov) / 6))
    # Distances of a run share most of their error, as its points do.
    assert np.mean(squared) == pytest.approx(1.0, abs=0.3)
    if profile == "consumer":  # points are known to a metre: what moves all of them cancels
        assert np.median(of_distance) < 0.3 * np.median(of_points)


def test_true_predictions_are_not_refuted_by_the_errors_that_points_share() -> None:
    codes = [code_of(run.error, run.joint) for profile in PROFILES for run in runs_of(30, profile)]
    assert codes.count(None) >= 0.97 * len(codes)
    # The points share most of their error: taken for independent, a third of these draws would be refuted.
    alone = [code_of(run.error, blocks_of(run.joint)) for profile in PROFILES for run in runs_of(30, profile)]
    assert alone.count(None) < 0.8 * len(alone)


@pytest.mark.parametrize(("factor", "code"), [(2.0, "prediction-refuted"), (0.5, "prediction-pessimistic")])
def test_wrong_predictions_are_refuted(factor: float, code: str) -> None:
    found = [code_of(factor * run.error, run.joint) for profile in PROFILES for run in runs_of(30, profile)]
    assert found.count(code) > 0.97 * len(found)


def code_of(error: np.ndarray, cov: np.ndarray) -> str | None:
    """The code of the caution that check points with these errors cause."""
    caution = refutation(tuple(map(str, range(len(error)))), error.ravel(), cov)
    return None if caution is None else caution.code


def blocks_of(cov: np.ndarray) -> np.ndarray:
    """The covariance of points as if they shared no error."""
    return block_diag(*(cov[row : row + 3, row : row + 3] for row in range(0, len(cov), 3)))


def test_heights_come_near_the_bound_because_the_lens_follows() -> None:
    # Level cameras around a scene: a wrong principal point lifts or lowers what they see by one and the same
    # angle, which the images take for a lower or higher flight. RTK knows the height of the flight: it moves the
    # cameras back against the scene, but only if the lens goes with them do the rays meet where the points are.
    setting = PROFILES["rtk, all level"]
    least = np.sqrt(bound(setting)[:, 2].mean())
    following, held = (
        np.sqrt(squares(draw(12, each))[0][:, :, 2].mean()) for each in (setting, replace(setting, follows=False))
    )
    # Twelve runs know a root mean square to a fifth.
    assert following < 1.4 * least
    assert held > 4 * following


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_predicted_accuracy_is_true_for_each_axis(profile: str) -> None:
    setting = PROFILES[profile]
    squared, variance = squares(draw(200, setting))
    np.testing.assert_allclose((squared / variance).mean(axis=(0, 1)), 1.0, atol=0.2)  # σ of the mean up to 0.1
    least = bound(setting).mean(axis=0)
    # No estimate is better than the bound, but for the draw: 200 values know their root mean square to 5 %.
    above = np.sqrt(squared.mean(axis=(0, 1)) / least)
    assert above.min() > 0.9
    assert above.max() < ABOVE_BOUND
