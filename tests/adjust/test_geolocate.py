"""Stage `geolocate` on synthetic surveys, through the runner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.options import GeolocateOptions
from pipelines.core.errors import InputError
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, POINTS
from pipelines.geometry.rotations import exp_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.survey.solution import GeolocatedPoints
from pipelines.survey.survey import Survey
from tests.refusals import codes, numbers, refused, said
from tests.scenes import (
    Measured,
    Noise,
    TrueScene,
    make_scene,
    sparse_model,
    survey_of,
    without_fixes,
    write_workspace,
)

CONFIG = GeolocateOptions()
CONSUMER = Noise(fix_m=(1.5, 1.5, 3.0))


def squared_errors(points: GeolocatedPoints, scene: TrueScene) -> np.ndarray:
    good = points.inlier
    error = (points.position_in_geo - scene.point_in_geo)[good]
    return (error * np.linalg.solve(points.cov_in_geo[good], error[..., None])[..., 0]).sum(axis=1)


def located(
    noise: Noise, measured: Measured, config: GeolocateOptions = CONFIG, seed: int = 0
) -> tuple[GeolocatedPoints, TrueScene, tuple[str, ...]]:
    scene, rng = make_scene(points=100), np.random.default_rng(seed)
    found = geolocate(survey_of(scene, noise, measured, rng), sparse_model(scene, noise, rng), config)
    return found.points, scene, found.warnings


def test_stage_writes_points_where_they_are(tmp_path: Path) -> None:
    scene, noise, rng = make_scene(points=200), Noise(), np.random.default_rng(0)
    workspace = write_workspace(tmp_path, survey_of(scene, noise, Measured(), rng), sparse_model(scene, noise, rng))
    outcome = run_stage(workspace, BY_NAME["geolocate"], {"sigma_px": 0.5})
    points = GeolocatedPoints.load(workspace.path(POINTS))
    assert points.rotation_source == "recorded"
    assert points.inlier.mean() > 0.98
    error = np.linalg.norm(points.position_in_geo - scene.point_in_geo, axis=1)[points.inlier]
    # 0.5° over 100 m is 0.9 m across a ray; ten and more rays average it down, along three axes.
    assert np.median(error) < 0.9
    assert outcome.manifest.values["inliers"] == points.inlier.sum()
    vertex = PlyData.read(tmp_path / "geolocate" / "points.ply")["vertex"]
    np.testing.assert_allclose(vertex["x"], points.position_in_geo[:, 0])
    assert vertex["inlier"].sum() == points.inlier.sum()
    assert vertex["sigma"][points.inlier].max() < 2.0


@pytest.mark.parametrize("attitude", ["recorded", "sfm"])
@pytest.mark.parametrize("noise", [Noise(), CONSUMER], ids=["rtk", "consumer"])
def test_covariance_is_calibrated(attitude: str, noise: Noise) -> None:
    squared = []
    for seed in range(30):
        points, scene, _ = located(noise, Measured(), GeolocateOptions(attitude=attitude, sigma_px=0.5), seed)
        assert points.rotation_source == attitude
        squared.append(squared_errors(points, scene).mean())
    # Points of one run share its cameras: if they shared all, 30 means of χ²₃ would have a mean with σ 0.45.
    assert np.mean(squared) == pytest.approx(3.0, abs=3 * 0.45)
    assert np.mean(squared) > 2.0


def test_without_attitudes_sfm_rotations_are_used_and_named() -> None:
    points, scene, _ = located(CONSUMER, Measured(attitudes=False))
    assert points.rotation_source == "sfm"
    error = np.linalg.norm(points.position_in_geo - scene.point_in_geo, axis=1)
    assert np.median(error[points.inlier]) < 2.0  # 1.5/3 m fixes, averaged over many rays


def test_outlying_fixes_give_no_rays_and_are_named() -> None:
    noise = replace(Noise(), outliers=(3, 9, 17))
    points, scene, warnings = located(noise, Measured())
    sentence = said(warnings, "fixes-inconsistent")
    assert numbers(sentence)[:2] == [3, 24] and "image_009.jpg" in sentence
    error = np.linalg.norm(points.position_in_geo - scene.point_in_geo, axis=1)
    assert np.quantile(error[points.inlier], 0.99) < 1.5


def test_images_without_fix_give_no_rays() -> None:
    scene, rng = make_scene(points=100), np.random.default_rng(0)
    survey = survey_of(scene, Noise(), Measured(), rng)
    model = sparse_model(scene, Noise(), rng)
    full = geolocate(survey, model, CONFIG)
    part = geolocate(without_fixes(survey, scene.names[:6]), model, CONFIG)
    assert (part.points.ray_count <= full.points.ray_count).all()
    assert part.points.ray_count.sum() < full.points.ray_count.sum()
    assert numbers(said(part.warnings, "photographs-without-fix")) == [6, 24]


def test_survey_without_fixes_gives_an_empty_product_that_says_so(tmp_path: Path) -> None:
    scene, noise, rng = make_scene(points=50), Noise(), np.random.default_rng(0)
    survey = survey_of(scene, noise, Measured(fixes=False, gcps=True), rng)
    workspace = write_workspace(tmp_path, survey, sparse_model(scene, noise, rng))
    outcome = run_stage(workspace, BY_NAME["geolocate"], {})
    points = GeolocatedPoints.load(workspace.path(POINTS))
    assert not points.inlier.any()
    assert np.isnan(points.position_in_geo).all()
    assert outcome.manifest.key_figure == said(outcome.manifest.warnings, "points-not-located")


def test_check_points_do_not_matter() -> None:
    scene, rng = make_scene(points=60), np.random.default_rng(0)
    survey = survey_of(scene, Noise(), Measured(gcps=True), rng)
    model = sparse_model(scene, Noise(), rng)
    other = survey.model_copy(update={"check_points": survey.control_points, "control_points": ()})
    first, second = geolocate(survey, model, CONFIG), geolocate(other, model, CONFIG)
    np.testing.assert_array_equal(first.points.position_in_geo, second.points.position_in_geo)


def turned_attitudes(survey: Survey, names: Sequence[str], change: Callable[[np.ndarray], np.ndarray]) -> Survey:
    """The survey with the rotations (3, 3) of some images changed."""
    images = []
    for image in survey.images:
        assert image.attitude is not None
        quat = image.attitude.quat_xyzw
        if image.name in names:
            quat = tuple(quat_xyzw_from_matrix(change(matrix_from_quat_xyzw(quat))).tolist())
        images.append(image.model_copy(update={"attitude": image.attitude.model_copy(update={"quat_xyzw": quat})}))
    return survey.model_copy(update={"images": tuple(images)})


def test_boresight_error_is_told() -> None:
    scene, rng = make_scene(points=60), np.random.default_rng(0)
    about_vertical = exp_so3([0, 0, np.radians(5.0)])
    whole = survey_of(scene, Noise(), Measured(), rng)
    survey = turned_attitudes(whole, scene.names, lambda rotation: about_vertical @ rotation)
    found = geolocate(survey, sparse_model(scene, Noise(), rng), CONFIG)
    assert numbers(said(found.warnings, "attitudes-turned"))[0] == pytest.approx(5.0, abs=0.99)


def test_line_without_attitudes_has_no_located_points_and_recorded_ones_are_refused() -> None:
    scene, rng = make_scene("line", points=60), np.random.default_rng(0)
    survey = survey_of(scene, Noise(), Measured(attitudes=False), rng)
    model = sparse_model(scene, Noise(), rng)
    without = geolocate(survey, model, CONFIG)
    assert not without.points.inlier.any()
    assert codes(without.warnings) == ["points-not-located"]
    with refused("too-few-attitudes", InputError) as error:
        geolocate(survey, model, GeolocateOptions(attitude="recorded"))
    assert error.value.field == "--attitude" and numbers(error.value.message)[0] == 0


def test_attitudes_of_a_large_sigma_are_not_said_to_disagree() -> None:
    """Rays that meet within σ, and σ that leave the points open, are two things."""
    scene, rng = make_scene(points=60), np.random.default_rng(0)
    survey = survey_of(scene, Noise(), Measured(), rng)
    unsure = [
        image.model_copy(
            update={"attitude": image.attitude and image.attitude.model_copy(update={"sigma_deg": 170.0})}
        )
        for image in survey.images
    ]
    survey = survey.model_copy(update={"images": tuple(unsure)})
    found = geolocate(survey, sparse_model(scene, Noise(), rng), GeolocateOptions(attitude="recorded"))
    assert found.points.inlier.sum() < 30
    agree, total, known, part = numbers(said(found.warnings, "few-points-located"))
    assert agree > 50 and total == 60 and (known, part) == (found.points.inlier.sum(), 30.0)


def test_attitudes_that_are_wrong_make_rays_disagree() -> None:
    scene, rng = make_scene(points=60), np.random.default_rng(0)
    wrong = iter(rng.normal(0.0, np.radians(20.0), (len(scene.names), 3)))
    survey = turned_attitudes(
        survey_of(scene, Noise(), Measured(), rng), scene.names, lambda rotation: exp_so3(next(wrong)) @ rotation
    )
    found = geolocate(survey, sparse_model(scene, Noise(), rng), GeolocateOptions(attitude="recorded"))
    agree, total = numbers(said(found.warnings, "few-points-agree"))
    assert agree < 30 and total == 60


def test_limits_of_angle_and_sigma_thin_the_inliers() -> None:
    all_points, _, _ = located(Noise(), Measured())
    strict, _, _ = located(Noise(), Measured(), GeolocateOptions(max_sigma=0.4))
    axes = np.sqrt(np.linalg.eigvalsh(strict.cov_in_geo[strict.inlier])[:, 2])
    assert axes.max() <= 0.4
    assert 0 < strict.inlier.sum() < all_points.inlier.sum()
    wide, _, _ = located(Noise(), Measured(), GeolocateOptions(min_angle=80))
    assert (wide.max_angle_deg[wide.inlier] >= 80).all()


def test_a_photograph_turned_in_a_viewer_loses_its_attitude_not_the_survey() -> None:
    # The drone's attitude stays in the file when a person turns the picture: it is wrong by 180° about the axis.
    scene, rng = make_scene(points=100), np.random.default_rng(0)
    whole = survey_of(scene, Noise(), Measured(), rng)
    turned = [scene.names[2], scene.names[5]]
    survey = turned_attitudes(whole, turned, lambda rotation: rotation @ np.diag([-1.0, -1.0, 1.0]))
    found = geolocate(survey, sparse_model(scene, Noise(), rng), CONFIG)
    for name in turned:
        assert name in said(found.warnings, "attitudes-inconsistent")
    assert found.points.inlier.mean() > 0.9
