"""The scene in the frame `model`: where things lie, and that the truth fits its own measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import GEO_FROM_LOCAL, Measured, Noise, Scene, make_scene, sparse_model, survey_of, without_fixes

from pipelines.blocks.geographic import geo_problem
from pipelines.blocks.measurements import root_information
from pipelines.blocks.scene import initial_scene
from pipelines.config import TrainConfig
from pipelines.errors import DegenerateGeometryError
from pipelines.formats.colmap import SparseModel
from pipelines.geometry.cameras import Camera
from pipelines.products import AttitudeRecord, InitialSimilarity, Mark, Survey

pytestmark = pytest.mark.usefixtures("one_thread")
NOISELESS = Noise(pixel_px=0.2, mark_px=1e-9, gcp_m=1e-9, fix_m=(1e-9, 1e-9, 1e-9), attitude_deg=0.5)
STATED = Noise()
CONFIG = TrainConfig()


def initial(layout: str = "volume") -> InitialSimilarity:
    return InitialSimilarity(
        geo_from_local=GEO_FROM_LOCAL.to_record(
            "local", "geo", covariance=np.eye(7) * 1e-4, pivot=(5.0, -3.0, 60.0)
        ),
        method="robust",
        correspondences={},
        inliers={},
        residuals={},
        condition_number=1.0,
        layout=layout,  # type: ignore[arg-type]
        attitude_used=False,
    )


def material(noise: Noise = STATED, gcps: bool = True) -> tuple[Scene, SparseModel, Survey]:
    scene, rng = make_scene(images=8, points=60), np.random.default_rng(0)
    survey = survey_of(scene, noise, Measured(gcps=gcps), rng)
    return scene, sparse_model(scene, noise, rng), survey


def test_model_is_geo_but_for_a_shift_of_whole_metres() -> None:
    truth, sparse, survey = material()
    scene = initial_scene(sparse, survey, initial())
    shift = scene.geo_from_model.translation
    assert (shift == np.round(shift)).all()
    assert np.abs(np.median(scene.point_in_model, axis=0)).max() <= 0.5
    np.testing.assert_allclose(scene.point_in_model + shift, truth.point_in_geo, atol=1e-9)
    np.testing.assert_allclose(scene.poses.cam_center_in_model + shift, truth.center_in_geo, atol=1e-9)
    np.testing.assert_allclose(scene.poses.cam_from_model, np.swapaxes(truth.geo_from_cam, 1, 2), atol=1e-12)


def test_split_is_the_surveys_and_only_of_registered_images() -> None:
    _, sparse, survey = material()
    images = [
        image.model_copy(update={"split": "test" if i in (1, 5) else "train"})
        for i, image in enumerate(survey.images)
    ]
    lost = survey.images[0].model_copy(update={"name": "lost.jpg"})
    scene = initial_scene(sparse, survey.model_copy(update={"images": (*images, lost)}), initial())
    assert scene.test.tolist() == [1, 5]
    assert scene.train.tolist() == [0, 2, 3, 4, 6, 7]
    few = tuple(image.model_copy(update={"split": "test"}) for image in images[:-1])
    with pytest.raises(DegenerateGeometryError, match="1 registered training images"):
        initial_scene(sparse, survey.model_copy(update={"images": (*few, images[-1])}), initial())


def test_truth_fits_exact_measurements() -> None:
    _, sparse, survey = material(NOISELESS)
    problem = geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), CONFIG)
    assert problem.fixes is not None
    assert problem.marks is not None
    assert len(problem.fixes.camera) == 8
    assert len(problem.marks.position_in_geo) == 6
    terms = problem.terms()
    assert terms.absolute is not None
    assert terms.control is not None
    # 1e-9 m and 1e-9 px of noise, whitened by as much, and rounding of 1e-13 of 100 m.
    assert float(terms.absolute.detach()) < 10.0
    assert float(terms.control.detach()) < 10.0
    assert float(terms.cameras.detach()) == 0.0


def test_test_cameras_measure_nothing() -> None:
    _, sparse, survey = material()
    images = tuple(
        image.model_copy(update={"split": "test" if i < 3 else "train"}) for i, image in enumerate(survey.images)
    )
    split = survey.model_copy(update={"images": images})
    problem = geo_problem(initial_scene(sparse, split, initial()), split, initial(), CONFIG)
    assert problem.fixes is not None
    assert problem.marks is not None
    assert problem.fixes.camera.tolist() == [3, 4, 5, 6, 7]
    assert set(problem.marks.camera.tolist()) <= {3, 4, 5, 6, 7}


def test_unusable_marks_are_left_out() -> None:
    _, sparse, survey = material()
    first, second, *rest = survey.control_points
    twice = first.model_copy(update={"marks": (first.marks[0], first.marks[0])})  # two marks, one photograph
    # 3 000 px from the centre the lens has long turned back: no ray leads there.
    outside = Mark(image=second.marks[0].image, x_px=-3000.0, y_px=447.0, sigma_px=0.3)
    partly = second.model_copy(update={"marks": (outside, *second.marks[1:])})
    spoilt = survey.model_copy(update={"control_points": (twice, partly, *rest)})
    folding = Camera("OPENCV", 1200, 900, np.array([1020.0, 1018.0, 603.0, 447.0, -0.2, 0.0, 3e-4, -2e-4]))
    problem = geo_problem(
        initial_scene(replace(sparse, cameras={1: folding}), spoilt, initial()), spoilt, initial(), CONFIG
    )
    assert problem.marks is not None
    assert len(problem.marks.position_in_geo) == 5
    assert (problem.marks.point == 0).sum() == len(second.marks) - 1
    assert np.isfinite(float(problem.loss().detach()))


@pytest.mark.parametrize(("points", "held"), [(0, True), (2, True), (3, False), (6, False)])
def test_start_is_held_where_the_measurements_leave_it_open(points: int, held: bool) -> None:
    scene, sparse, survey = material()
    blind = without_fixes(survey, scene.names).model_copy(update={"control_points": survey.control_points[:points]})
    problem = geo_problem(initial_scene(sparse, blind, initial()), blind, initial(), CONFIG)
    assert problem.fixes is None
    assert problem.hold_prior is held
    if points:
        assert np.linalg.eigvalsh(problem.covariance()).min() > 0


def test_line_holds_its_start() -> None:
    _, sparse, survey = material()
    assert geo_problem(initial_scene(sparse, survey, initial()), survey, initial("line"), CONFIG).hold_prior
    assert not geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), CONFIG).hold_prior
    # With a boresight to estimate, the attitudes are observations themselves, and must not count twice.
    observed = TrainConfig(estimate="boresight")
    assert not geo_problem(initial_scene(sparse, survey, initial()), survey, initial("line"), observed).hold_prior


def test_line_holds_only_what_attitude_said() -> None:
    _, sparse, survey = material()
    start = initial("line")
    x, y, z, w = start.geo_from_local.quat_xyzw
    attitude = AttitudeRecord(quat_xyzw=(x, y, z, w), cov_rad2=((4e-4, 0, 0), (0, 4e-4, 0), (0, 0, 4e-4)))
    known = start.model_copy(update={"attitude": attitude})
    similarity = geo_problem(initial_scene(sparse, survey, known), survey, known, CONFIG).similarity
    # The start states σ 0.01 rad about every axis, the attitude 0.02: a quarter of what is known of the rotation.
    np.testing.assert_allclose(similarity.held, [0, 0, 0, 0, 0.25, 0.25, 0.25], atol=0.01)
    np.testing.assert_allclose(similarity.y.detach(), 0.0, atol=1e-9)


def test_covariance_of_the_start_is_about_the_cameras() -> None:
    _, sparse, survey = material()
    scene = initial_scene(sparse, survey, initial())
    problem = geo_problem(scene, survey, initial(), CONFIG)
    pivot = problem.similarity.pivot_in_geo
    np.testing.assert_allclose(
        pivot, (scene.poses.cam_center_in_model + scene.geo_from_model.translation).mean(axis=0)
    )
    arm = pivot - np.array([5.0, -3.0, 60.0])
    # σ 0.01 m of shift, 0.01 of scale and turn over the arm between the pivots.
    expected = 1e-4 * ((arm @ arm + 1) * np.eye(3))
    np.testing.assert_allclose(problem.similarity.prior_covariance()[4:, 4:], expected, rtol=1e-6, atol=1e-9)


def test_nothing_to_optimise_when_switched_off() -> None:
    _, sparse, survey = material()
    config = TrainConfig(geo_loss=False, optimize_cameras=False)
    problem = geo_problem(initial_scene(sparse, survey, initial()), survey, initial(), config)
    assert problem.fixes is None
    assert problem.marks is None
    assert len(problem.cameras.z) == 0


def test_root_information() -> None:
    half = np.random.default_rng(0).normal(size=(4, 3, 3))
    covariance = half @ np.swapaxes(half, 1, 2)
    root = root_information(covariance)
    np.testing.assert_allclose(np.swapaxes(root, 1, 2) @ root, np.linalg.inv(covariance), rtol=1e-8)
