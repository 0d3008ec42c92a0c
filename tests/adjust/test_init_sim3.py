"""Stage `init-sim3` on synthetic surveys, through the runner and as a pure function."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.init_sim3 import estimate_similarity
from pipelines.adjust.measurements import control_correspondences
from pipelines.adjust.options import GeolocateOptions, InitSim3Options
from pipelines.core.errors import ConvergenceError, DegenerateGeometryError, InputError
from pipelines.core.products import load_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import ADJUSTMENT, BY_NAME, SIM3
from pipelines.geometry.rotations import exp_so3, log_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.survey.solution import GeolocatedPoints, SimilarityEstimate, Solution
from pipelines.survey.survey import Survey
from tests.refusals import numbers, refused, said
from tests.scenes import (
    GEO_FROM_LOCAL,
    Measured,
    Noise,
    TrueScene,
    make_scene,
    sparse_model,
    survey_of,
    write_workspace,
)

CONFIG = InitSim3Options()
CONSUMER = Noise(fix_m=(1.5, 1.5, 3.0))


def material(
    noise: Noise, measured: Measured, seed: int = 0, layout: str = "orbit"
) -> tuple[Survey, SparseModel, GeolocatedPoints]:
    scene, rng = make_scene(layout, points=120), np.random.default_rng(seed)
    survey, model = survey_of(scene, noise, measured, rng), sparse_model(scene, noise, rng)
    return survey, model, geolocate(survey, model, GeolocateOptions()).points


def estimated(
    survey: Survey, model: SparseModel, points: GeolocatedPoints, options: InitSim3Options
) -> tuple[Solution, tuple[str, ...]]:
    """Return the solution and the warnings."""
    posterior, warnings = estimate_similarity(survey, model, points, options)
    return posterior.solution, warnings


def squared_error(found: Solution) -> float:
    record = found.initial.geo_from_local
    away = GEO_FROM_LOCAL @ Similarity.from_record(record).inverse()
    pivot = np.array(record.pivot)
    error = np.array([np.log(away.scale), *log_so3(away.rotation), *(away.apply(pivot) - pivot)])
    return float(error @ np.linalg.solve(np.array(record.covariance), error))


def test_stage_recovers_the_truth_with_rtk(tmp_path: Path) -> None:
    scene, noise, rng = make_scene(points=120), Noise(), np.random.default_rng(1)
    survey = survey_of(scene, noise, Measured(), rng)
    workspace = write_workspace(tmp_path, survey, sparse_model(scene, noise, rng))
    run_stage(workspace, BY_NAME["geolocate"], {})
    outcome = run_stage(workspace, BY_NAME["init-sim3"], {})
    found = load_json(Solution, workspace.path(ADJUSTMENT))
    assert found.initial.geo_from_local.scale == pytest.approx(GEO_FROM_LOCAL.scale, rel=1e-3)
    away = Similarity.from_record(found.initial.geo_from_local).apply(
        GEO_FROM_LOCAL.inverse().apply(np.eye(3) * 50)
    )
    assert squared_error(found) < 24.3  # χ²₇ at 0.999
    # 2–3 cm over √24, and the lens, which moves the scene along the views: 2 cm in σ at 50 m.
    np.testing.assert_allclose(away, np.eye(3) * 50, atol=0.06)
    assert found.initial.correspondences == {"gnss": 24, "gcp": 0, "points": 120}
    assert found.initial.residuals["gnss"].rmse_h_m == pytest.approx(0.028, rel=0.6)  # the cameras follow the fixes
    assert found.initial.layout == "volume"
    assert load_json(SimilarityEstimate, workspace.path(SIM3)) == found.initial  # alone, for other programs
    assert outcome.manifest.warnings == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("control", [False, True])
@pytest.mark.parametrize("pixel_px", [0.0, 1e-7, 1e-3])  # exact, rounded in a text file, of a renderer's distortion
def test_model_without_residuals_has_finite_sigma(pixel_px: float, control: bool) -> None:
    survey, model, points = material(Noise(pixel_px=pixel_px), Measured(gcps=control), seed=2)
    found, _ = estimated(survey, model, points, CONFIG)
    # 24 fixes of 2 cm over 50 m.
    assert found.initial.geo_from_local.scale == pytest.approx(GEO_FROM_LOCAL.scale, rel=1e-3)
    sigma = np.sqrt(np.diag(np.array(found.initial.geo_from_local.covariance)))
    assert np.isfinite(sigma).all() and (sigma > 0).all()
    assert squared_error(found) < 24.3  # χ²₇ at 0.999


def test_outlying_fixes_are_listed() -> None:
    noise = replace(Noise(fix_m=(0.05, 0.05, 0.08)), outliers=(2, 7, 11, 20))
    survey, model, points = material(noise, Measured())
    found, warnings = estimated(survey, model, points, CONFIG)
    assert found.gnss_outliers == tuple(f"image_{index:03d}.jpg" for index in noise.outliers)
    assert found.initial.inliers["gnss"] == 20
    assert squared_error(found) < 24.3  # χ²₇ at 0.999
    sentence = said(warnings, "fix-outliers")
    assert numbers(sentence)[:2] == [4, 24]
    assert all(name in sentence for name in found.gnss_outliers)


ARM_M, BORESIGHT_DEG = np.array([0.25, -0.1, 0.15]), np.array([0.7, -0.5, 0.4])


def with_mount(survey: Survey, scene: TrueScene) -> Survey:
    """The survey with positions of an antenna beside the camera, and attitudes of other axes than the camera's."""
    turned, images = scene.geo_from_cam @ exp_so3(np.radians(BORESIGHT_DEG)).T, []
    for index, image in enumerate(survey.images):
        assert image.fix is not None and image.attitude is not None
        place = image.fix.position_in_geo + scene.geo_from_cam[index] @ ARM_M
        noise = matrix_from_quat_xyzw(image.attitude.quat_xyzw) @ scene.geo_from_cam[index].T
        quat = tuple(quat_xyzw_from_matrix(noise @ turned[index]).tolist())
        images.append(
            image.model_copy(
                update={
                    "fix": image.fix.model_copy(update={"position_in_geo": tuple(place.tolist())}),
                    "attitude": image.attitude.model_copy(update={"quat_xyzw": quat}),
                }
            )
        )
    return survey.model_copy(update={"images": tuple(images), "estimate": ("boresight", "lever-arm")})


@pytest.mark.parametrize("seed", [0, 1])
def test_adjustment_solves_the_mount_that_a_survey_leaves_unknown(seed: int) -> None:
    """Control points fix the scale and height that an arm of an orbit otherwise passes for."""
    scene, rng = make_scene(points=120), np.random.default_rng(seed)
    survey = with_mount(survey_of(scene, Noise(), Measured(gcps=True), rng), scene)
    model = sparse_model(scene, Noise(), rng)
    points = geolocate(survey, model, GeolocateOptions()).points
    found, _ = estimated(survey, model, points, CONFIG)
    assert squared_error(found) < 24.3  # χ²₇ at 0.999
    errors = {error.name: error for error in found.estimated_errors}
    for name, truth in (("lever-arm", ARM_M), ("boresight", BORESIGHT_DEG)):
        sigma = np.array(errors[name].sigma)
        missed = np.array(errors[name].value) - truth
        assert (np.abs(missed) < 4 * sigma).all()
        assert list(errors[name].observed) == (sigma <= 0.1 * np.array(errors[name].prior)).tolist()
    # In an orbit, the heading that all attitudes share passes for a boresight: 0.5° for each of the two.
    assert max(errors["boresight"].sigma) < 1.0 and max(errors["lever-arm"].sigma) < 0.1
    # Who does not know of them has them in the residuals.
    without, _ = estimated(
        survey.model_copy(update={"estimate": ()}),
        model,
        geolocate(survey, model, GeolocateOptions()).points,
        CONFIG,
    )
    assert without.initial.residuals["gnss"].rmse_3d_m > found.initial.residuals["gnss"].rmse_3d_m


def test_downward_lever_arm_of_a_level_flight_widens_the_height() -> None:
    """Nothing tells it from another height of the whole: its prior of 1 m is all that is known of either."""
    survey, model, points = material(Noise(), Measured(), layout="grid")
    survey = survey.model_copy(update={"estimate": ("lever-arm",)})
    found, _ = estimated(survey, model, points, CONFIG)
    assert squared_error(found) < 24.3  # χ²₇ at 0.999
    (arm,) = (error for error in found.estimated_errors if error.name == "lever-arm")
    assert not arm.observed[2] and arm.sigma[2] > 0.5
    assert np.sqrt(np.array(found.initial.geo_from_local.covariance)[6, 6]) > 0.5


def test_control_points_alone_carry_the_survey() -> None:
    survey, model, points = material(Noise(), Measured(fixes=False, attitudes=False, gcps=True))
    found, _ = estimated(survey, model, points, CONFIG)
    assert found.initial.inliers == {"gnss": 0, "gcp": 6, "points": 0}
    assert found.initial.residuals["gnss"].count == 0
    assert squared_error(found) < 24.3


def test_fixes_that_disagree_with_control_points_are_told_with_numbers() -> None:
    noise = replace(Noise(), bias_m=(0.4, 0.0, -1.2))
    survey, model, points = material(noise, Measured(gcps=True))
    found, _ = estimated(survey, model, points, CONFIG)
    assert squared_error(found) < 24.3
    (caution,) = found.cautions
    assert caution.code == "fixes-shifted"
    assert numbers(caution.sentence)[0] == pytest.approx(0.4, abs=0.1)


def test_paper_method_is_coarse_but_near() -> None:
    survey, model, points = material(Noise(), Measured())
    found, _ = estimated(survey, model, points, InitSim3Options(method="paper"))
    assert found.initial.method == "paper"
    away = Similarity.from_record(found.initial.geo_from_local).apply(model.point_in_local)
    error = np.linalg.norm(away - GEO_FROM_LOCAL.apply(model.point_in_local), axis=1)
    # 0.5° attitudes over 100 m, averaged over 24 cameras: 0.2 m.
    assert error.mean() < 0.6
    robust, _ = estimated(survey, model, points, CONFIG)
    assert found.initial.residuals["gnss"].rmse_3d_m > robust.initial.residuals["gnss"].rmse_3d_m


def test_paper_method_without_points_says_what_to_use() -> None:
    survey, model, points = material(Noise(), Measured(fixes=False, gcps=True))
    with refused("too-few-intersected-points", DegenerateGeometryError):
        estimate_similarity(survey, model, points, InitSim3Options(method="paper"))


def test_max_residual_fails_with_the_figures() -> None:
    survey, model, points = material(CONSUMER, Measured())
    with refused("residual-above-limit", ConvergenceError) as error:
        estimate_similarity(survey, model, points, InitSim3Options(max_residual=0.1))
    count, rms_m, *_, limit_m = numbers(str(error.value))
    assert (count, limit_m) == (24, 0.1) and 0.1 < rms_m < 10.0
    assert estimated(survey, model, points, InitSim3Options(max_residual=10.0))[0].initial.inliers["gnss"] == 24


def test_line_needs_attitude() -> None:
    survey, model, points = material(Noise(), Measured(), layout="line")
    found, _ = estimated(survey, model, points, CONFIG)
    assert found.initial.layout == "line"
    assert found.initial.attitude_used
    assert squared_error(found) < 24.3
    bare = survey.model_copy(
        update={"images": tuple(image.model_copy(update={"attitude": None}) for image in survey.images)}
    )
    with refused("positions-on-a-line", DegenerateGeometryError):
        estimate_similarity(bare, model, points, CONFIG)


def test_nothing_measured_is_refused() -> None:
    survey, model, points = material(Noise(), Measured(fixes=False, attitudes=False))
    with refused("too-few-positions", DegenerateGeometryError) as error:
        estimate_similarity(survey, model, points, CONFIG)
    assert numbers(str(error.value))[0] == 0


def test_unusable_control_points_are_named() -> None:
    survey, model, points = material(Noise(), Measured(gcps=True))
    first, second, *rest = survey.control_points
    lonely = first.model_copy(update={"marks": first.marks[:1]})
    shifted = tuple(
        mark.model_copy(update={"x_px": mark.x_px + 40.0 * index}) for index, mark in enumerate(second.marks)
    )
    broken = second.model_copy(update={"marks": shifted})
    spoilt = survey.model_copy(update={"control_points": (lonely, broken, *rest)})
    found, warnings = estimated(spoilt, model, points, CONFIG)
    assert found.initial.correspondences["gcp"] == 4
    lonely_told, broken_told = (one.sentence for one in warnings if one.code == "control-point-unused")
    assert "gcp0" in lonely_told and "px" not in lonely_told
    assert "gcp1" in broken_told and "px" in broken_told


def test_error_carries_the_reasons_why_control_points_are_not_used() -> None:
    survey, model, points = material(Noise(), Measured(fixes=False, attitudes=False, gcps=True))
    two_marks = [
        point.model_copy(update={"marks": (point.marks[0], point.marks[len(point.marks) // 3])})
        for point in survey.control_points[:4]
    ]
    missing, apart = two_marks[2].marks[1], two_marks[3].marks[0]
    two_marks[2] = two_marks[2].model_copy(
        update={"marks": (two_marks[2].marks[0], missing.model_copy(update={"image": "kite_07.jpg"}))}
    )
    moved = apart.model_copy(update={"y_px": apart.y_px + 60.0, "x_px": apart.x_px + 60.0})
    two_marks[3] = two_marks[3].model_copy(update={"marks": (moved, two_marks[3].marks[1])})
    kite = survey.model_copy(update={"control_points": tuple(two_marks)})
    with refused("too-few-positions", DegenerateGeometryError) as raised:
        estimate_similarity(kite, model, points, CONFIG)
    message = str(raised.value)
    assert numbers(message)[0] == 2
    assert "24 of 24 images" in message and "0 of 0 fixes and 2 of 4 control points" in message
    of_third, of_fourth, *_ = message.split("gcp2", 1)[1].split("gcp3")
    assert "kite_07.jpg not registered" in of_third
    count, worst_px, rms_px, *_ = numbers(of_fourth)
    assert count == 2
    # 85 px of which the part across the epipolar line counts, shared between the two marks.
    assert 5 < rms_px <= worst_px < 85
    assert f"{apart.image} " in message
    assert f"{two_marks[3].marks[1].image} " in message


def test_worst_mark_of_a_control_point_is_named_first() -> None:
    survey, model, _ = material(Noise(), Measured(gcps=True))
    point = survey.control_points[0]
    off = {0: 300.0, 1: -200.0, 2: 150.0}
    marks = tuple(
        mark.model_copy(update={"x_px": mark.x_px + off.get(index, 0.0)})
        for index, mark in enumerate(point.marks[:5])
    )
    spoilt = survey.model_copy(update={"control_points": (point.model_copy(update={"marks": marks}),)})
    _, (unused,) = control_correspondences(spoilt, model)
    assert len(unused.residual_px) == len(unused.registered) == 5
    worst = unused.registered[int(np.argmax(unused.residual_px))]
    assert f"px ({worst} {max(unused.residual_px):.1f} px, " in unused.sentence


def test_points_of_another_model_are_refused() -> None:
    survey, model, points = material(Noise(), Measured())
    with refused("points-of-another-model", InputError):
        estimate_similarity(survey, model, replace(points, point_id=points.point_id + 1), CONFIG)


def test_control_points_can_be_left_out() -> None:
    survey, model, points = material(CONSUMER, Measured(gcps=True))
    with_control, _ = estimated(survey, model, points, CONFIG)
    without, _ = estimated(survey, model, points, InitSim3Options(control_points=False))
    assert with_control.initial.correspondences["gcp"] == 6
    assert without.initial.correspondences["gcp"] == without.initial.residuals["gcp"].count == 0
    alone, _ = estimated(survey.model_copy(update={"control_points": ()}), model, points, CONFIG)
    assert without == alone


def test_an_assumed_sigma_is_said_once_with_the_option_that_states_it() -> None:
    survey, model, points = material(Noise(), Measured(gcps=True))
    wide_px = 7.0 * survey.control_points[0].marks[0].sigma_px
    wide = tuple(
        point.model_copy(
            update={"marks": tuple(mark.model_copy(update={"sigma_px": wide_px}) for mark in point.marks)}
        )
        for point in survey.control_points
    )
    assumed = survey.model_copy(update={"control_points": wide, "default_sigmas": ("control points", "marks")})
    found, _ = estimated(assumed, model, points, CONFIG)
    factors = {factor.group: factor for factor in found.variance_factors}
    (default,) = (one for one in found.cautions if one.code == "default-sigma")
    of_control, of_marks = default.remedy.split("--sigma-gcp-v")
    assert "--sigma-gcp-h" in of_control and "--sigma-mark" in of_marks
    of_marks = default.sentence.partition("The marks")[2]
    assert factors["marks"].applied == pytest.approx(1 / 49, rel=0.5)
    assert numbers(of_marks) == pytest.approx([np.sqrt(factors["marks"].applied), wide_px], rel=0.05)
    off = [point.position_in_geo for point in survey.control_points]
    poor = tuple(
        point.model_copy(update={"position_in_geo": (east + 0.5 * (-1) ** index, north, up + 0.3 * (index % 3))})
        for index, (point, (east, north, up)) in enumerate(zip(wide, off, strict=True))
    )
    rejected, _ = estimated(assumed.model_copy(update={"control_points": poor}), model, points, CONFIG)
    assert "--sigma-gcp-h" in said(rejected.cautions, "sigma-rejected")
    assert "--sigma-gcp-h" not in said(rejected.cautions, "default-sigma")
