"""Thirty surveys with everything drawn: is the predicted accuracy true, and do the estimates come near the bound?

Each run draws image observations, fixes, control points and marks with the σ that they state. The bundle is
adjusted with its lens, the tool then finds similarity and cameras, and points that no one surveyed are intersected
from pipelines.survey.solution import MeasurementVerdict
from their marks. The bundle is small and its lens is weak (σ of the focal length 0.3 %), so that every part of the
prediction counts: the similarity, the cameras, the lens, the marks. In a second bundle all cameras are level,
which leaves the principal point, and with it the heights, to the fixes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix

from pipelines.adjust.measurements import problem_of, start_of
from pipelines.adjust.solution import adjusted
from pipelines.adjust.system import linearised, minimise
from pipelines.evaluate.check_points import chi2_caution
from pipelines.geometry.intersection import intersection_jacobian
from pipelines.geometry.network import Network
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.scene import SparseScene
from pipelines.survey.solution import MeasurementVerdict
from pipelines.survey.survey import Fix, Mark, Survey, SurveyedPoint
from tests.bundle_scenes import SIGMA_PX, adjuster, exact_network, noisy, pixels, readjusted, size
from tests.drawn_surveys import missed, rows_of
from tests.scenes import Measured, Noise, material

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
IMAGES, MARK_PX, SURVEY_M = 8, 0.3, 0.02
RTK, CONSUMER = np.array([0.02, 0.02, 0.03]), np.array([1.5, 1.5, 3.0])
EXACT = exact_network(images=IMAGES)
LEVEL = exact_network(images=IMAGES, rolled=False)
PLACES = np.random.default_rng(99)
CONTROL = PLACES.uniform([-8, -8, -4], [8, 8, 6], (5, 3))
CHECK = PLACES.uniform([-9, -9, -6], [9, 9, 9], (12, 3))
NAMES = tuple(f"image_{index:03d}.jpg" for index in range(IMAGES))


@pytest.fixture(autouse=True)
def _without_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """The σ over the scene are not asked for here, and take half of the time."""
    monkeypatch.setattr("pipelines.adjust.solution.accuracy_grid", lambda *_: None)


@dataclass(frozen=True)
class Run:
    """Errors (J, 3) at the held-out points, and their joint predicted covariance (3 J, 3 J)."""

    error: np.ndarray
    joint: np.ndarray


@dataclass(frozen=True)
class Setting:
    """What is drawn from: true bundle, σ (3,) of the fixes, control points or none."""

    sigma_m: np.ndarray
    control: bool
    truth: Network = EXACT


def scene_of(network: Network) -> SparseScene:
    """The scene of an SfM model in the frame `geo`."""
    center = network.cam_center_in_world
    count = len(network.point_in_world)
    model = SparseModel(
        cameras=network.cameras,
        image_id=np.arange(1, IMAGES + 1),
        image_name=NAMES,
        image_camera_id=network.camera_id,
        rotation_cam_from_local=network.cam_from_world,
        translation_cam_from_local=-np.einsum("nij,nj->ni", network.cam_from_world, center),
        point_id=np.arange(1, count + 1),
        point_in_local=network.point_in_world,
        point_rgb=np.zeros((count, 3), dtype=np.uint8),
        point_error_px=np.full(count, SIGMA_PX),
        obs_point=network.obs_point,
        obs_image=network.obs_image,
        obs_xy_px=network.obs_xy_px,
    )
    return SparseScene(model, Similarity(), Similarity(), np.arange(IMAGES), np.arange(0))


@cache
def blank() -> Survey:
    """A survey of the images in which nothing is measured."""
    return material(Noise(), Measured(fixes=False, attitudes=False), images=IMAGES)[2]


def marked(points: np.ndarray, truth: Network) -> Network:
    """Points that all cameras see, at their exact pixels."""
    count = len(points)
    seen = replace(
        truth,
        point_in_world=points,
        obs_point=np.repeat(np.arange(count), IMAGES),
        obs_image=np.tile(np.arange(IMAGES), count),
        obs_xy_px=np.zeros((count * IMAGES, 2)),
    )
    return replace(seen, obs_xy_px=pixels(seen, np.zeros(size(seen))))


def surveyed_points(
    place: np.ndarray, truth: Network, sigma_m: float, name: str, rng: np.random.Generator
) -> tuple[SurveyedPoint, ...]:
    """Points with noisy marks and a noisy survey; σ of 0: the survey is exact."""
    xy_px = marked(place, truth).obs_xy_px.reshape(len(place), IMAGES, 2)
    xy_px = xy_px + rng.normal(0, MARK_PX, xy_px.shape)
    return tuple(
        SurveyedPoint(
            name=f"{name}{index}",
            position_in_geo=tuple(at + sigma_m * rng.normal(size=3)),
            cov_in_geo=rows_of(max(sigma_m, 1e-4) ** 2 * np.eye(3)),
            marks=tuple(
                Mark(image=image, x_px=x, y_px=y, sigma_px=MARK_PX) for image, (x, y) in zip(NAMES, xy, strict=True)
            ),
        )
        for index, (at, xy) in enumerate(zip(place, xy_px, strict=True))
    )


def survey_of(setting: Setting, rng: np.random.Generator) -> Survey:
    sigma_m, truth = setting.sigma_m, setting.truth
    cov = rows_of(np.diag(sigma_m**2))
    position = truth.cam_center_in_world + sigma_m * rng.normal(size=(IMAGES, 3))
    images = tuple(
        image.model_copy(
            update={"fix": Fix(position_in_geo=tuple(at), cov_in_geo=cov, source="csv", sigma_source="file")}
        )
        for image, at in zip(blank().images, position, strict=True)
    )
    control = surveyed_points(CONTROL, truth, SURVEY_M, "control", rng) if setting.control else ()
    check = surveyed_points(CHECK, truth, 0.0, "check", rng)
    return blank().model_copy(update={"images": images, "control_points": control, "check_points": check})


def one_run(seed: int, setting: Setting, solve: np.ndarray) -> Run:
    rng, truth = np.random.default_rng(seed), setting.truth
    survey, drawn, network = survey_of(setting, rng), noisy(truth, rng), truth
    for _ in range(3):  # a weak lens moves far enough for second-order terms to count
        left = drawn.obs_xy_px - pixels(network, np.zeros(size(network)))
        network = replace(readjusted(network, solve @ left.ravel()), obs_xy_px=drawn.obs_xy_px)
    scene = scene_of(network)
    problem = problem_of(scene, survey)
    state = minimise(problem, start_of(scene, problem)).state
    return Run(*missed(adjusted(scene, problem, state, MeasurementVerdict()), survey))


def runs_of(count: int, profile: str) -> list[Run]:
    return [drawn(seed, profile) for seed in range(count)]


@cache
def drawn(seed: int, profile: str) -> Run:
    return one_run(seed, PROFILES[profile], solver(profile))


@cache
def solver(profile: str) -> np.ndarray:
    return adjuster(PROFILES[profile].truth)


def squares(found: Iterable[Run]) -> tuple[np.ndarray, np.ndarray]:
    """Squared errors and predicted variances (count, J, 3)."""
    predicted = [np.diagonal(run.joint).reshape(-1, 3) for run in found]
    return np.array([run.error**2 for run in found]), np.array(predicted)


def bound(setting: Setting) -> np.ndarray:
    """Variances (J, 3) of the held-out points by plain weights at the truth: the least of any unbiased estimate.

    That each check point's own marks tell of the cameras as well is left out.
    """
    rng = np.random.default_rng(0)
    noise = rng.normal(0, SIGMA_PX, setting.truth.obs_xy_px.shape)
    scene = scene_of(replace(setting.truth, obs_xy_px=setting.truth.obs_xy_px + noise))  # which states the σ
    problem = problem_of(scene, survey_of(setting, rng))
    near = linearised(problem, start_of(scene, problem))
    normal = near.normal({term.kind: np.ones(len(term)) for term in problem.terms})
    moved = intersection_jacobian(marked(CHECK, setting.truth), np.full(IMAGES * len(CHECK), MARK_PX))
    by_border = np.zeros((3 * len(CHECK), len(normal.corner)))
    by_border[:, : len(problem.lens)] = moved.by_lens[:, :, problem.lens].reshape(3 * len(CHECK), -1)
    cov = normal.covariances(csr_matrix(moved.by_poses), by_border, 3) + moved.cov_of_marks
    return np.diagonal(cov, axis1=1, axis2=2)


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
        for first, second in ([0, 1], [2, 7], [4, 9], [5, 10]):
            rows = np.r_[3 * first : 3 * first + 3, 3 * second : 3 * second + 3]
            cov, apart = run.joint[np.ix_(rows, rows)], CHECK[second] - CHECK[first]
            along = apart / np.linalg.norm(apart)
            slope = np.concatenate([-along, along])
            found = np.linalg.norm(apart + run.error[second] - run.error[first])
            of_distance.append(np.sqrt(slope @ cov @ slope))
            squared.append(((found - np.linalg.norm(apart)) / of_distance[-1]) ** 2)
            of_points.append(np.sqrt(np.trace(cov) / 6))
    # The distances of a run share their error of scale: hardly more than 30 values, σ of their mean 0.26.
    assert np.mean(squared) == pytest.approx(1.0, abs=0.6)
    if profile == "consumer":  # points are known to a metre: what moves all of them cancels
        assert np.median(of_distance) < 0.3 * np.median(of_points)


def test_true_predictions_are_not_rejected_by_the_errors_that_points_share() -> None:
    codes = [code_of(run.error, run.joint) for profile in PROFILES for run in runs_of(30, profile)]
    assert codes.count(None) >= 0.97 * len(codes)
    # The points share most of their error: taken for independent, a third of these draws would be rejected.
    alone = [code_of(run.error, blocks_of(run.joint)) for profile in PROFILES for run in runs_of(30, profile)]
    assert alone.count(None) < 0.8 * len(alone)


@pytest.mark.parametrize(("factor", "code"), [(2.0, "prediction-rejected"), (0.5, "prediction-pessimistic")])
def test_wrong_predictions_are_rejected(factor: float, code: str) -> None:
    found = [code_of(factor * run.error, run.joint) for profile in PROFILES for run in runs_of(30, profile)]
    assert found.count(code) > 0.97 * len(found)


def code_of(error: np.ndarray, cov: np.ndarray) -> str | None:
    """The code of the caution that check points with these errors cause."""
    caution = chi2_caution(tuple(map(str, range(len(error)))), error.ravel(), cov)
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
    following = np.sqrt(squares(runs_of(30, "rtk, all level"))[0][:, :, 2].mean())
    assert following < 1.3 * least


def test_slow_descents_end() -> None:
    # Control points that disagree a little: Cauchy's weights make 150 plain steps of this draw too short.
    assert np.isfinite(drawn(1209, "consumer and control").error).all()


@pytest.mark.parametrize("profile", PROFILES)
def test_predicted_accuracy_is_true_for_each_axis(profile: str) -> None:
    setting = PROFILES[profile]
    squared, variance = squares(runs_of(200, profile))
    # Robust weights follow the noise of a few measurements: the mean of 800 runs is 1.03 to 1.11. σ of 200: 0.06.
    np.testing.assert_allclose((squared / variance).mean(axis=(0, 1)), 1.0, atol=0.25)
    least = bound(setting).mean(axis=0)
    # No estimate is better than the bound, but for the draw: 200 values know their root mean square to 5 %.
    above = np.sqrt(squared.mean(axis=(0, 1)) / least)
    assert above.min() > 0.9
    assert above.max() < ABOVE_BOUND
