"""Facts of the report against a scene whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2, norm

from pipelines.core.errors import InputError
from pipelines.core.products import Remark, load_json
from pipelines.core.progress import SILENT
from pipelines.core.stages import SURVEY
from pipelines.report.accuracy import ninety_percent
from pipelines.report.cameras import (
    bias_of,
    cameras_facts,
    lenses_facts,
    links_of,
    mean_by_region,
    overlap_facts,
    ties_of,
)
from pipelines.report.cover import cover_facts, days_of, flying_height_m
from pipelines.report.options import ReportOptions
from pipelines.report.points import cut_chips, points_facts
from pipelines.report.verdicts import FIX_OUTLIERS, REGISTERED, Measured, verdict_of, verdicts
from pipelines.report.views import read_metrics
from pipelines.survey.area import ground_sampling_m, photographs_that_see
from pipelines.survey.measurement_errors import VarianceFactor
from pipelines.survey.report import ByAxis, DistanceError, PointError, PredictedSigma, SurfaceHeight
from pipelines.survey.solution import fix_differences
from pipelines.survey.survey import LOCAL_FRAME, Survey
from tests.dense_bundle import correction_basis, lens_elimination
from tests.evaluated_workspaces import CHECK_POINTS, ERROR_M
from tests.refusals import refused
from tests.report.conftest import Reported
from tests.reports import check_points_with, report_with
from tests.trained_workspaces import NOISE, scene_of


def test_photographs_that_see_a_point_are_those_that_observe_it(reported: Reported) -> None:
    scene = reported.truth.scene
    owner, _, _ = scene.pixels(scene.point_in_geo)
    true_count = np.bincount(owner, minlength=len(scene.point_in_geo))
    seen = photographs_that_see(reported.solution, reported.sfm, scene.point_in_geo)
    # The scene leaves out rays beyond a slope of 0.8, which the corners of the frame reach.
    assert (seen >= true_count).all()
    assert (seen == true_count).mean() > 0.95


def test_links_count_the_points_that_two_photographs_share(reported: Reported) -> None:
    network = reported.network
    points = [set(network.obs_point[network.obs_image == image]) for image in range(len(network.camera_id))]
    expected = {(i, j): len(points[i] & points[j]) for i, j in combinations(range(len(points)), 2)}
    pairs, shared = links_of(network)
    assert dict(zip(map(tuple, pairs.tolist()), shared.tolist(), strict=True)) == {
        pair: count for pair, count in expected.items() if count
    }


def test_photographs_without_a_tie_form_groups_of_their_own() -> None:
    pairs, shared = np.array([[0, 1], [1, 2], [3, 4]]), np.array([40, 14, 15])
    tied, parts = ties_of(6, pairs, shared)
    assert tied.tolist() == [1, 1, 0, 1, 1, 0]
    assert parts == 4  # {0, 1}, {2}, {3, 4}, {5}


def test_reprojection_residuals_are_the_noise_of_the_pixels(reported: Reported) -> None:
    facts = lenses_facts(reported.survey, reported.posterior, reported.network)
    # The cameras are true, and each point is adjusted to its rays: 3 of 2 r parameters are fitted.
    observations, points = facts.observations, facts.points
    expected = NOISE.pixel_px * np.sqrt(2 - 3 * points / observations)
    assert facts.rmse_px == pytest.approx(expected, rel=4 / np.sqrt(2 * observations))
    assert [parameter.name for parameter in facts.lenses[0].parameters][:5] == ["fx", "fy", "cx", "cy", "k1"]
    starts = [parameter.start for parameter in facts.lenses[0].parameters]
    assert starts == pytest.approx(reported.truth.scene.camera.params.tolist())


def test_mean_residuals_by_region_show_a_planted_pattern() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform([0, 0], [800, 400], (40_000, 2))
    planted = np.where(xy[:, :1] < 400, [[1.0, 0.0]], [[0.0, -2.0]])
    mean, rms = mean_by_region(xy, planted + rng.normal(0, 0.1, xy.shape), (800, 400))
    assert mean.shape == (8, 16, 2)
    # 300 observations a region: σ of a mean is 0.006.
    np.testing.assert_allclose(mean[:, :8], np.broadcast_to([1.0, 0.0], (8, 8, 2)), atol=0.03)
    np.testing.assert_allclose(mean[:, 8:], np.broadcast_to([0.0, -2.0], (8, 8, 2)), atol=0.03)
    np.testing.assert_allclose(rms[:, 8:], np.hypot(2.0, 0.1 * np.sqrt(2)), atol=0.03)
    few, _ = mean_by_region(xy[:5], planted[:5], (800, 400))
    assert np.isnan(few).all()


def test_lens_covariance_lies_between_its_free_part_and_that_of_the_photographs(reported: Reported) -> None:
    covariance = reported.posterior.of_lens()
    bundle = scene_of(reported.solution, reported.sfm).bundle
    by_poses, alone = correction_basis(bundle).lens_matrix, np.linalg.inv(lens_elimination(bundle)[1])
    assert covariance is not None
    from_photographs = by_poses @ by_poses.T + alone
    scale = 1 / np.sqrt(np.diag(from_photographs))

    def least(matrix: np.ndarray) -> float:
        return float(np.linalg.eigvalsh(matrix * scale[:, None] * scale)[0])

    assert least(from_photographs - covariance) > -1e-3  # fixes and control points add information
    # Of what no camera reveals they know little: marks of control points, as much as one tie point.
    assert least(covariance - alone) > -0.1
    assert np.trace(from_photographs - covariance) > 0


def test_fix_differences_are_the_errors_of_the_fixes(reported: Reported) -> None:
    survey = load_json(Survey, reported.truth.workspace.path(SURVEY))
    fixes = np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])
    found = fix_differences(reported.solution, reported.survey)
    np.testing.assert_allclose(found.difference_in_geo, reported.truth.scene.center_in_geo - fixes, atol=1e-6)
    used = found.difference_in_geo  # also of the test view
    stated_m = np.sort(np.abs(used), axis=0)[[3]] * np.ones((len(used), 1))
    assert [bias.mean_m for bias in bias_of(found, stated_m)] == pytest.approx(used.mean(axis=0).tolist())
    # Four of the fixes are within σ, which is the fourth smallest residual; more σ hold more of them.
    for bias in bias_of(found, stated_m):
        assert bias.within[0] == 4 / len(used)
        assert list(bias.within) == sorted(bias.within)
    outlier = replace(found, is_outlier=np.arange(len(fixes)) == 0)
    assert bias_of(outlier, stated_m)[0].mean_m == pytest.approx(used[1:, 0].mean())


def test_photographs_have_coordinates_and_differences(reported: Reported) -> None:
    facts = cameras_facts(reported.survey, reported.posterior, reported.crs)
    assert [row.use for row in facts.rows].count("test") == 1
    assert facts.by_time
    assert all(row.measured is not None and row.difference_m is not None for row in facts.rows)
    easting = [float(row.adjusted[0]) - float((row.measured or row.adjusted)[0]) for row in facts.rows]
    # Grid east at 7.75° E in zone 32 turns by 0.9° from true east, and differences are a few centimetres.
    assert easting == pytest.approx([(row.difference_m or (0.0,))[0] for row in facts.rows], abs=3e-3)


def test_chips_show_the_mark_and_where_the_points_project(reported: Reported) -> None:
    control, check = points_facts(
        reported.truth.workspace,
        reported.survey,
        reported.posterior,
        reported.report,
        reported.crs,
        chips_a_point=2,
        progress=SILENT,
    )
    assert (len(control.rows), len(check.rows)) == (3, CHECK_POINTS)
    scene, survey = reported.truth.scene, reported.survey
    for row, point in zip(check.rows, survey.check_points, strict=True):
        assert row.field is not None
        assert len(row.chips) == 2
        for chip in row.chips:
            white = _decoded(chip.picture.address)
            scale = chip.side_px / white.shape[0]
            y, x = np.argwhere(white > 200).mean(axis=0) * scale
            # The square is centred on the whole pixel of the exact mark; marks have a σ of 0.3 px.
            assert np.hypot(chip.mark[0] - x, chip.mark[1] - y) < 2.5
            image = scene.names.index(chip.image)
            moved = np.array(point.position_in_geo) + ERROR_M
            for place, pixel in ((moved, chip.adjusted), (np.array(point.position_in_geo), chip.surveyed)):
                owner, images, xy = scene.pixels(place[None])
                assert len(owner)
                mark = next(mark for mark in point.marks if mark.image == chip.image)
                expected = xy[images == image][0] - [mark.x_px, mark.y_px] + chip.mark
                np.testing.assert_allclose(pixel, expected, atol=1e-3)


def _decoded(address: str) -> np.ndarray:
    import base64

    data = base64.b64decode(address.partition(",")[2])
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def test_no_chips_are_cut_when_none_are_wanted(reported: Reported) -> None:
    chips, side_px = cut_chips(reported.truth.workspace, reported.survey, reported.posterior.sparse, [], SILENT)
    assert (chips, side_px) == ({}, 96)


def test_ninety_percent_factors_are_those_of_the_normal_distribution() -> None:
    errors = check_points_with(count=4, rmse_e_m=0.03, rmse_n_m=0.03, rmse_v_m=0.05)
    radii = ninety_percent("triangulated", errors)
    assert radii.ce90_m == pytest.approx(0.03 * np.sqrt(chi2.ppf(0.9, 2)), rel=1e-4)
    assert radii.le90_m == pytest.approx(0.05 * norm.ppf(0.95), rel=1e-4)
    assert radii.measured_h_m is None  # four points have no 90 % quantile
    assert ninety_percent("triangulated", check_points_with()).ce90_m is None


MEASURED = Measured(
    photographs=20, registered=20, enough_share=1.0, enough=5, parts=1, rmse_px=0.5, fixes=20, fix_outliers=0,
    control_points=5, control_outliers=0, check_points=0, stale=(),
)  # fmt: skip


@pytest.mark.parametrize(
    ("subject", "changes", "level"),
    [
        ("Registered photographs", {}, "good"),
        ("Registered photographs", {"registered": 19}, "good"),
        ("Registered photographs", {"registered": 16}, "fair"),
        ("Registered photographs", {"registered": 15}, "poor"),
        ("Overlap", {"enough_share": None}, "unknown"),
        ("Overlap", {"parts": 2}, "fair"),
        ("Overlap", {"enough_share": 0.69}, "poor"),
        ("Reprojection", {"rmse_px": 1.5}, "fair"),
        ("Reprojection", {"rmse_px": None}, "unknown"),
        ("Recorded positions", {"fix_outliers": 5}, "poor"),
        ("Recorded positions", {"fixes": 0}, "fair"),
        ("Control points", {"control_points": 0}, "fair"),
        ("Control points", {"control_points": 2}, "poor"),
        ("Check points", {}, "poor"),
        ("Predicted against measured", {}, "unknown"),
        ("Test views", {}, "unknown"),
        ("State of the products", {"stale": ("train",)}, "poor"),
    ],
)
def test_verdicts_follow_their_rules(subject: str, changes: dict[str, object], level: str) -> None:
    found = {verdict.subject: verdict for verdict in verdicts(report_with(), replace(MEASURED, **changes), ())}
    assert found[subject].level == level
    assert found[subject].reason
    assert found[subject].rule


@pytest.mark.parametrize(
    ("count", "code", "level"),
    [
        (3, None, "good"),
        (2, None, "unknown"),
        (3, "prediction-rejected", "poor"),
        (3, "prediction-pessimistic", "fair"),
        (3, "prediction-of-adjusted-similarity", "unknown"),
    ],
)
def test_verdict_on_the_prediction_is_that_of_its_test(count: int, code: str | None, level: str) -> None:
    axes = ByAxis(e=5.0, n=0.1, u=1.0)
    sigma = PredictedSigma(count=count, rms_h_m=0.02, rms_v_m=0.03, normalised_error_squared=axes)
    cautions = () if code is None else (Remark(code=code, sentence="The test says so."),)
    report = report_with(triangulated=check_points_with(predicted=sigma), cautions=cautions)
    found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, ())}
    assert found["Predicted against measured"].level == level


@pytest.mark.parametrize(
    ("code", "level", "words"),
    [
        (None, "good", "no reason to doubt"),
        ("prediction-rejected", "fair", "err more than predicted"),
        ("prediction-pessimistic", "fair", "err less than predicted"),
    ],
)
def test_verdict_on_the_sigma_knows_what_the_check_points_say(code: str | None, level: str, words: str) -> None:
    """The residuals agree with the σ: that alone is no praise where check points do not."""
    cautions = () if code is None else (Remark(code=code, sentence="The test says so."),)
    passed = VarianceFactor.model_validate({
        "group": "marks", "count": 9, "used": 9, "redundancy": 9.0, "estimated": 1.0, "probability": 0.5,
        "applied": 1.0, "sigma_source": "stated",
    })  # fmt: skip
    report = report_with(cautions=cautions).model_copy(update={"variance_factors": (passed,)})
    found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, ())}
    assert found["σ of the measurements"].level == level
    assert words in found["σ of the measurements"].reason


@pytest.mark.parametrize(
    ("subject", "changes", "level", "words"),
    [
        ("Recorded positions", {"largest_fix": ("a.jpg", 2.9)}, "good", "all fixes agree"),
        ("Recorded positions", {"largest_fix": ("a.jpg", 4.1)}, "good", "4.1 of its stated σ (a.jpg)"),
        ("Recorded positions", {"fix_outliers": 1, "outliers": ("b.jpg",)}, "good", "left out: b.jpg"),
        ("Control points", {"control_outliers": 1, "rejected": ("G7",)}, "good", "1 rejected (G7)"),
        ("Measured share", {"delivered": (0.3, 0.61)}, "poor", "30 % of 0.61 ha measured"),
        ("Measured share", {"delivered": (0.95, 0.61)}, "good", "95 %"),
    ],
)
def test_a_verdict_names_what_it_counts(subject: str, changes: dict[str, object], level: str, words: str) -> None:
    found = {verdict.subject: verdict for verdict in verdicts(report_with(), replace(MEASURED, **changes), ())}
    assert found[subject].level == level
    assert words in f"{found[subject].reading}: {found[subject].reason}"
    assert "all fixes agree" not in found["Recorded positions"].reason or "σ (" not in words


@pytest.mark.parametrize(("source", "level"), [("stated", "fair"), ("default", "good")])
def test_a_sigma_that_the_table_calls_too_large_is_not_good(source: str, level: str) -> None:
    wide = VarianceFactor.model_validate({
        "group": "marks", "count": 90, "used": 90, "redundancy": 160.0, "estimated": 0.3, "probability": 0.999,
        "applied": 1.0, "sigma_source": source,
    })  # fmt: skip
    report = report_with().model_copy(update={"variance_factors": (wide,)})
    found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, ())}["σ of the measurements"]
    assert found.level == level and ("marks (probability 1.00)" in found.reason) == (level == "fair")


def test_the_largest_residual_of_a_fix_is_that_of_its_axis(reported: Reported) -> None:
    facts, survey = cameras_facts(reported.survey, reported.posterior, reported.crs), reported.survey
    fixes = fix_differences(reported.solution, survey)
    stated = {
        image.name: np.sqrt(np.diag(np.array(image.fix.cov_apart)))
        for image in survey.images
        if image.fix is not None
    }
    names = reported.sfm.image_name
    ratios = {
        names[camera]: float((np.abs(row) / stated[names[camera]]).max())
        for camera, row, out in zip(fixes.camera, fixes.difference_in_geo, fixes.is_outlier, strict=True)
        if not out
    }
    name = max(ratios, key=lambda each: ratios[each])
    assert facts.largest_fix == (name, pytest.approx(ratios[name]))


@pytest.mark.parametrize(
    ("group", "applied", "estimated", "level", "words"),
    [
        ("fixes", 12.8, 12.5, "fair", "3.58 times"),
        ("horizontal drift", 100.0, 100.0, "fair", "10.00 times"),
        ("fixes", 1.5, 1.5, "good", "agree with each other"),
        ("fixes", 1.0, 0.06, "good", "agree with each other"),
    ],
)
def test_fixes_that_scatter_beyond_their_sigma_are_not_called_good(
    group: str, applied: float, estimated: float, level: str, words: str
) -> None:
    factor = VarianceFactor.model_validate({
        "group": group, "count": 28, "used": 28, "redundancy": 75.0, "estimated": estimated, "probability": 0.0,
        "applied": applied, "sigma_source": "stated",
    })  # fmt: skip
    report = report_with().model_copy(update={"variance_factors": (factor,)})
    found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, ())}
    assert found["Recorded positions"].level == level
    assert words in found["Recorded positions"].reason
    if estimated < 0.25:
        assert "less than half of σ of fixes" in found["σ of the measurements"].reason


def test_verdicts_are_given_on_what_there_is() -> None:
    subjects = {verdict.subject for verdict in verdicts(report_with(), MEASURED, ())}
    assert not {"Cautions", "State of the products"} & subjects
    warned = verdicts(report_with(), MEASURED, (Remark(code="x", sentence="Beware."),))
    assert {verdict.subject: verdict.level for verdict in warned}["Cautions"] == "fair"


def test_facts_of_the_cover_are_those_of_the_flight(reported: Reported) -> None:
    scene, solution, points = reported.truth.scene, reported.solution, reported.scene_in_geo
    above_m = scene.center_in_geo[:, 2].mean() - np.median(scene.point_in_geo[:, 2])
    height_m = flying_height_m(solution.center_in_geo, points)
    gsd_m = ground_sampling_m(solution, reported.sfm)
    assert height_m is not None and gsd_m is not None
    assert height_m == pytest.approx(above_m, abs=float(np.ptp(scene.point_in_geo[:, 2])))
    owner, image, _ = scene.pixels(scene.point_in_geo)
    away = np.linalg.norm(scene.point_in_geo[owner] - scene.center_in_geo[image], axis=1)
    # Depth is shorter than distance, by the cosine of at most half the frame's diagonal.
    assert 0.7 * np.median(away) < gsd_m * scene.camera.mean_focal_px <= np.median(away)
    network, crs, posterior = reported.network, reported.crs, reported.posterior
    cover = cover_facts(
        reported.truth.workspace,
        reported.survey,
        posterior,
        reported.report,
        ReportOptions(),
        crs=crs,
        scene=points,
        overlap=overlap_facts(posterior, network, points, crs),
        lenses=lenses_facts(reported.survey, posterior, network),
    )
    facts = dict(cover.facts)
    assert facts["Photographs"] == "8 of 8 registered"
    assert facts["Surveyed points"] == f"3 control points, {CHECK_POINTS} check points"
    assert facts["Photographs of a place"] == "8 (median)"
    assert facts["Area"] == "1.23 ha"  # as `evaluate` has found it


@pytest.mark.parametrize(
    ("times_s", "days"),
    [
        ((1_700_000_000.0, None, 1_700_000_100.0), "2023-11-14"),
        ((1_700_000_000.0, 1_700_090_000.0), "2023-11-14 to 2023-11-15"),
        ((12.0, 15.0), "–"),  # seconds since the flight controller was started
        ((None,), "–"),
    ],
)
def test_days_of_the_photographs(times_s: tuple[float | None, ...], days: str) -> None:
    assert days_of(times_s) == days


def test_limits_belong_to_the_better_verdict() -> None:
    assert verdict_of(REGISTERED[0], REGISTERED, more_is_better=True) == "good"
    assert verdict_of(FIX_OUTLIERS[1], FIX_OUTLIERS, more_is_better=False) == "fair"


@pytest.mark.parametrize("line", ["[]", "{}", '{"iteration": "x"}', '{"iteration": 1, "psnr": [1]}', "no json }"])
def test_damaged_metrics_are_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1}\n' + line + "}"[: not line.endswith("}")] + "\n", "utf-8")
    with refused("metrics-row", InputError) as error:
        read_metrics(path)
    assert error.value.line == 2


def test_unfinished_last_line_of_the_metrics_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1, "psnr": 20.5}\n{"iteration": 2, "ps', "utf-8")
    assert read_metrics(path) == [{"iteration": 1.0, "psnr": 20.5}]


def test_map_of_the_overlap_covers_the_scene(reported: Reported) -> None:
    facts = overlap_facts(reported.posterior, reported.network, reported.scene_in_geo, reported.crs)
    assert facts.median == 8  # the orbit's eight photographs all look at its middle
    assert facts.parts == 1
    assert facts.enough_share is not None
    assert facts.enough_share > 0.95


@pytest.mark.parametrize(
    ("controls", "errors_m", "level"),
    [(3, [0.01], "good"), (3, [], "fair"), (2, [0.01], "fair"), (3, [0.2], "poor")],
)
def test_in_a_local_frame_distances_take_the_place_of_ground_points(
    controls: int, errors_m: list[float], level: str
) -> None:
    known = {"rejected": False, "distance_m": 5.0, "stated_sigma_m": 0.003, "measured_m": 5.0, "sigma_m": 0.004}
    distances = (
        *(DistanceError(name=f"a{k}", use="control", error_m=0.0, **known) for k in range(controls)),
        *(DistanceError(name=f"b{k}", use="check", error_m=error, **known) for k, error in enumerate(errors_m)),
    )
    local = (Remark(code=LOCAL_FRAME, sentence="Not on Earth."),)
    report = report_with().model_copy(update={"distances": distances, "cautions": local})
    found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, local)}
    assert found["Known distances"].level == level
    assert not {"Control points", "Recorded positions", "Check points"} & found.keys()


@pytest.mark.parametrize(
    ("psnr", "covered_db", "share_", "longer"),
    [(15.0, 24.0, 0.4, False), (17.0, 17.2, 0.97, True), (17.0, None, None, True), (20.0, 20.5, 0.9, True)],
)
def test_longer_training_is_advised_only_where_photographs_show_the_ground(
    psnr: float, covered_db: float | None, share_: float | None, *, longer: bool
) -> None:
    figures = {"psnr": psnr, "psnr_covered": covered_db, "covered_share": share_}
    (verdict,) = (one for one in verdicts(report_with(test=figures), MEASURED, ()) if one.subject == "Test views")
    assert ("train longer" in verdict.reason) == longer
    assert longer or "photographs" in verdict.reason


@pytest.mark.parametrize(("off_m", "level"), [((), "good"), ((-7.45,), "fair"), ((2.0, -0.6, 0.5), "poor")])
def test_a_roof_that_is_missing_from_above_is_no_good_surface(off_m: tuple[float, ...], level: str) -> None:
    """Behind its marks each point lies on the surface; straight from above, another surface is seen at some."""
    small = np.random.default_rng(2).normal(0, 0.03, 13 - len(off_m))
    heights = tuple(
        SurfaceHeight(name=f"C{k}", du_m=float(du), place="raised") for k, du in enumerate([*off_m, *small])
    )
    report = report_with(triangulated=check_points_with(count=13), surface=check_points_with(count=13))
    points = report.checkpoints.model_copy(update={"heights": heights})
    found = {
        verdict.subject: verdict
        for verdict in verdicts(report.model_copy(update={"checkpoints": points}), MEASURED, ())
    }
    verdict = found["Surface at the points"]
    names = ", ".join(f"C{k}" for k in range(len(off_m)))
    assert (verdict.level, verdict.reading) == (level, f"{len(off_m)} of 13 off" + (f" ({names})" if names else ""))


def test_the_surface_is_not_blamed_for_a_wrong_check_point() -> None:
    def errors(north: float, up: float) -> tuple[PointError, ...]:
        return (PointError(name="G7", rays=4, de_m=0.0, dn_m=north, du_m=up, blunder=True),)

    triangulated = check_points_with(count=3, blunders=("G7",), refuted=("G7",), points=errors(1.5, 0.0))
    for on_surface, level in ((errors(1.52, 0.05), "good"), (errors(0.2, 1.4), "poor")):
        surface = check_points_with(count=3, blunders=("G7",), points=on_surface)
        report = report_with(triangulated=triangulated, surface=surface)
        found = {verdict.subject: verdict for verdict in verdicts(report, MEASURED, ())}
        assert found["Surface at the points"].level == level
