"""Stage `evaluate` on a trained survey of known truth: the report's form, and its figures."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.adjust import system
from pipelines.core.errors import InputError
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import BY_NAME, MODEL, SURVEY
from pipelines.core.staleness import status
from pipelines.core.workspace import Workspace
from pipelines.evaluate.asprs import few_points
from pipelines.survey.report import AsprsStatement
from pipelines.survey.solution import TrainedModel
from pipelines.survey.survey import KnownDistance, Mark, Survey
from tests.evaluate.conftest import solve
from tests.refusals import codes, numbers, refused, said
from tests.reports import report_of
from tests.splat_scenes import NOISE, SIGMA_M, Rendered, ground_height

pytestmark = pytest.mark.usefixtures("one_thread")
EVALUATE = BY_NAME["evaluate"]
STATS = {"count", "mean_h_m", "rmse_h_m", "rmse_e_m", "rmse_n_m", "rmse_v_m", "rmse_3d_m", "max_3d_m"}


def change_survey(workspace: Workspace, **update: object) -> None:
    survey = load_json(Survey, workspace.path(SURVEY))
    save_json(survey.model_copy(update=update), workspace.root / SURVEY)


def test_report_has_the_form_that_scripts_read(evaluated: tuple[Workspace, Outcome]) -> None:
    report = report_of(evaluated[0])
    test = report["photometric"]["test"]
    assert {"views", "psnr", "ssim", "lpips"} <= set(test)
    assert set(report["checkpoints"]) == {"triangulated", "surface", "heights"}
    for way in ("triangulated", "surface"):
        assert set(report["checkpoints"][way]) >= STATS
    assert set(report["fit"]) == {"gnss", "gcp"}
    assert set(report["fit"]["gnss"]) >= STATS
    assert report["fit"]["gcp"]["count"] == 0
    assert report["fit"]["gcp"]["rmse_3d_m"] is None


def test_triangulated_check_points_are_as_good_as_the_measurements(evaluated: tuple[Workspace, Outcome]) -> None:
    triangulated = report_of(evaluated[0])["checkpoints"]["triangulated"]
    assert triangulated["count"] == 6
    # Marks of 0.1 px are 5 cm from 45 m, over √12 rays 2 cm; the similarity's own 1.5 and 2.4 cm, and its turn.
    assert triangulated["rmse_h_m"] < 0.08
    assert triangulated["rmse_v_m"] < 0.12
    assert [row["rays"] for row in triangulated["points"]] == [14] * 6
    errors = np.array([[row[key] for key in ("de_m", "dn_m", "du_m")] for row in triangulated["points"]])
    assert triangulated["rmse_3d_m"] == pytest.approx(np.sqrt((errors**2).sum(axis=1).mean()))
    assert triangulated["mean_h_m"] == pytest.approx(np.hypot(errors[:, 0], errors[:, 1]).mean())


def test_check_points_are_measured_through_the_trained_lens(altered: Workspace) -> None:
    run_stage(altered, EVALUATE, {"renders": 0})
    before, cached = report_of(altered), {path.name for path in (altered.cache / "undistorted").iterdir()}
    model = load_json(TrainedModel, altered.path(MODEL))
    (lens,) = model.lenses
    fx, fy, cx, cy = lens.params
    longer = lens.model_copy(update={"params": (1.05 * fx, 1.05 * fy, cx, cy)})
    save_json(model.model_copy(update={"lenses": (longer,)}), altered.root / MODEL)
    run_stage(altered, EVALUATE, {"renders": 0})
    after = report_of(altered)
    # Narrower rays from cameras that look inward meet lower, though their axes hold the middle; and what is
    # rendered no longer fits the photographs.
    assert (
        after["checkpoints"]["triangulated"]["mean_u_m"] < before["checkpoints"]["triangulated"]["mean_u_m"] - 0.15
    )
    assert after["photometric"]["test"]["psnr"] < before["photometric"]["test"]["psnr"] - 1.0
    # The photographs are undistorted by that lens, too.
    assert {path.name for path in (altered.cache / "undistorted").iterdir()} > cached


def test_check_points_lie_on_the_surface(evaluated: tuple[Workspace, Outcome]) -> None:
    on_surface = report_of(evaluated[0])["checkpoints"]["surface"]
    assert on_surface["count"] == 6
    # The surface is known to a Gaussian: its size, not the cameras, decides.
    assert on_surface["rmse_3d_m"] < 1.5 * SIGMA_M
    assert on_surface["rmse_h_m"] < SIGMA_M


def test_fit_is_that_of_the_fixes(evaluated: tuple[Workspace, Outcome]) -> None:
    fit = report_of(evaluated[0])["fit"]["gnss"]
    assert fit["count"] == 14  # also of the test views
    assert fit["outliers"] == 0
    # 5 cm in east and north and 8 cm up, less seven of 42 degrees of freedom.
    assert fit["rmse_h_m"] == pytest.approx(0.07 * np.sqrt(35 / 42), rel=0.4)
    assert fit["rmse_v_m"] == pytest.approx(0.08 * np.sqrt(35 / 42), rel=0.5)


def test_few_check_points_are_remarked_on(evaluated: tuple[Workspace, Outcome]) -> None:
    asprs = AsprsStatement.model_validate(report_of(evaluated[0])["checkpoints"]["triangulated"]["asprs"])
    assert said(evaluated[1].manifest.warnings, "few-check-points") == few_points(asprs)
    # The points are on a square of 54 m, whose corners few cameras see.
    assert asprs.area_km2 == pytest.approx(54e-3**2, rel=0.3)


def test_control_points_are_a_fit_and_not_an_accuracy(altered: Workspace, rendered: Rendered) -> None:
    survey = rendered.survey
    change_survey(altered, control_points=survey.check_points, check_points=())
    run_stage(altered, EVALUATE, {"renders": 0})
    report = report_of(altered)
    assert report["checkpoints"]["triangulated"]["count"] == 0
    assert report["checkpoints"]["surface"]["rmse_3d_m"] is None
    assert report["fit"]["gcp"]["count"] == 6
    assert report["cross_validation"] is None  # nobody asked


def test_cross_validation_is_of_control_points_and_stands_alone(altered: Workspace, rendered: Rendered) -> None:
    survey = rendered.survey
    change_survey(altered, control_points=survey.check_points[:5], check_points=survey.check_points[5:])
    solve(altered)
    run_stage(altered, EVALUATE, {"renders": 0, "cross_validate": True})
    report = report_of(altered)
    crossed = report["cross_validation"]
    assert crossed["count"] == 5
    assert crossed["reason"] is None
    assert "asprs" not in crossed
    assert report["checkpoints"]["triangulated"]["count"] == 1
    # Twelve fixes of 5 and 8 cm, and the other four points: each is found to a few centimetres, and no better than
    # it fits when it is not left out.
    assert crossed["rmse_h_m"] < 0.08
    assert crossed["rmse_3d_m"] > report["fit"]["gcp"]["rmse_3d_m"] / 2
    assert [row["name"] for row in crossed["points"]] == [point.name for point in survey.check_points[:5]]


def test_cross_validation_without_control_points_says_so(altered: Workspace) -> None:
    outcome = run_stage(altered, EVALUATE, {"renders": 0, "cross_validate": True})
    assert report_of(altered)["cross_validation"]["count"] == 0
    assert "no-cross-validation" in codes(outcome.manifest.warnings)


def test_prediction_agrees_with_the_errors_of_triangulation(evaluated: tuple[Workspace, Outcome]) -> None:
    triangulated = report_of(evaluated[0])["checkpoints"]["triangulated"]
    predicted = triangulated["predicted"]
    assert predicted["count"] == 6
    # This scene's cameras are exact, which the prediction cannot know: the errors are less than it says, by the
    # cameras' share of a few centimetres, and more than a fifth, which is the marks'.
    assert 0.2 * predicted["rms_h_m"] < triangulated["rmse_h_m"] < 1.5 * predicted["rms_h_m"]
    assert all(0 < value < 2 for value in predicted["normalised_error_squared"].values())


def test_accuracy_is_stated_after_the_standard(evaluated: tuple[Workspace, Outcome]) -> None:
    triangulated = report_of(evaluated[0])["checkpoints"]["triangulated"]
    assert triangulated["survey"]["rmse_h_m"] == pytest.approx(np.sqrt(2) * NOISE.gcp_m)
    assert triangulated["with_survey"]["rmse_h_m"] == pytest.approx(
        np.hypot(triangulated["rmse_h_m"], np.sqrt(2) * NOISE.gcp_m)
    )
    class_cm = np.ceil(100 * triangulated["with_survey"]["rmse_h_m"])
    assert triangulated["asprs"]["horizontal_class"] == f"{class_cm:.0f} cm"
    assert triangulated["asprs"]["enough_points"] is False
    assert triangulated["blunders"] == []


def test_cautions_of_the_model_stand_first_in_the_report(altered: Workspace) -> None:
    caution = Remark(code="fixes-shifted", sentence="All fixes are 1.2 m too high.")
    model = load_json(TrainedModel, altered.path(MODEL))
    save_json(model.model_copy(update={"cautions": (caution,)}), altered.root / MODEL)
    survey = load_json(Survey, altered.path(SURVEY))
    first = survey.check_points[0]
    beside = tuple(np.array(first.position_in_geo) + np.array([0.3, 0.0, 0.4]))
    twin = first.model_copy(update={"name": "twin", "position_in_geo": beside})
    change_survey(altered, control_points=(twin,))
    outcome = run_stage(altered, EVALUATE, {"renders": 0})
    cautions = report_of(altered)["cautions"]
    assert cautions[0] == caution.model_dump()
    near = next(row for row in cautions if row["code"] == "check-point-not-independent")
    assert numbers(near["sentence"])[:2] == [1, 6]
    assert f"{first.name} (0.50 m from twin)" in near["sentence"]
    assert [row.model_dump() for row in outcome.manifest.cautions] == cautions


def test_check_points_that_are_off_together_reject_the_prediction(altered: Workspace) -> None:
    survey = load_json(Survey, altered.path(SURVEY))
    up = np.array([0.0, 0.0, 1.5])
    shifted = tuple(
        point.model_copy(update={"position_in_geo": tuple(np.array(point.position_in_geo) + up)})
        for point in survey.check_points
    )
    change_survey(altered, check_points=shifted)
    run_stage(altered, EVALUATE, {"renders": 0})
    (caution,) = (row for row in report_of(altered)["cautions"] if row["code"] == "prediction-rejected")
    assert numbers(caution["sentence"])[0] == 6
    change_survey(altered, check_points=shifted[:2])
    run_stage(altered, EVALUATE, {"renders": 0})
    assert caution["code"] not in {row["code"] for row in report_of(altered)["cautions"]}


def test_a_blunder_is_named_and_kept(altered: Workspace) -> None:
    survey = load_json(Survey, altered.path(SURVEY))
    first, *rest = survey.check_points
    east, north, up = first.position_in_geo
    change_survey(
        altered, check_points=(first.model_copy(update={"position_in_geo": (east + 3, north, up)}), *rest)
    )
    outcome = run_stage(altered, EVALUATE, {"renders": 0})
    triangulated = report_of(altered)["checkpoints"]["triangulated"]
    assert triangulated["blunders"] == [first.name]
    assert triangulated["count"] == 6
    assert triangulated["rmse_h_m"] > 1.0
    assert triangulated["without_blunders"]["rmse_h_m"] < 0.1
    told = [remark.sentence for remark in outcome.manifest.warnings if remark.code == "check-point-blunders"]
    assert "triangulated" in told[0] and numbers(told[0]) == [1, 6]


def test_predicted_accuracy_is_mapped(evaluated: tuple[Workspace, Outcome]) -> None:
    folder, accuracy = evaluated[0].root / "evaluate", report_of(evaluated[0])["accuracy"]
    with (folder / "accuracy.csv").open(encoding="utf-8", newline="") as handle:
        rows = [{key: float(value) for key, value in row.items()} for row in csv.DictReader(handle)]
    assert len(rows) == accuracy["cells"] > 500
    sigma_h = np.array([row["sigma_h_m"] for row in rows])
    assert np.median(sigma_h) == pytest.approx(accuracy["median_sigma_h_m"], abs=1e-5)
    assert np.sqrt(np.mean(sigma_h**2)) == pytest.approx(accuracy["rms_sigma_h_m"], abs=1e-5)
    place = np.array([[row["east_m"], row["north_m"], row["up_m"]] for row in rows])
    assert np.abs(place[:, :2]).max() < 27  # where the points are
    # The height is that of points nearby, on slopes of up to a third.
    np.testing.assert_allclose(place[:, 2], ground_height(*place[:, :2].T), atol=1.5)
    # Scale and tilt leave the rim less certain than the middle.
    far = np.hypot(place[:, 0], place[:, 1])
    assert sigma_h[far > 20].mean() > sigma_h[far < 10].mean()
    picture = cv2.imread(str(folder / "accuracy.png"))
    assert min(picture.shape[:2]) > 400


def test_points_are_written_and_printed(
    evaluated: tuple[Workspace, Outcome], capsys: pytest.CaptureFixture[str]
) -> None:
    workspace, _ = evaluated
    with (workspace.root / "evaluate/points.csv").open(encoding="utf-8", newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["measured"] == "triangulated"]
    triangulated = report_of(workspace)["checkpoints"]["triangulated"]
    rms = np.sqrt(np.mean([float(row["dh_m"]) ** 2 for row in rows]))
    assert rms == pytest.approx(triangulated["rmse_h_m"], abs=1e-4)  # the file has tenths of a millimetre
    assert boundary.guarded(cli, ["evaluate", str(workspace.root), "--renders", "1", "--points"]) == 0
    printed = capsys.readouterr().out
    assert "current, nothing to do" in printed and "Check points one by one, metres" in printed
    for row in rows:
        # The file has tenths of a millimetre: one that ends in 5 may have been rounded from either side.
        metres = float(row["du_m"])
        assert any(f"{metres + half:+.3f}" in printed for half in (-4e-5, 4e-5))


def test_every_field_of_the_report_is_described(altered: Workspace, rendered: Rendered) -> None:
    survey = rendered.survey
    far = survey.check_points[0].model_copy(update={"position_in_geo": (9.0, 9.0, 9.0)})
    bar = KnownDistance(ends=survey.check_points[1:3], distance_m=9.0, sigma_m=0.01, use="check")
    change_survey(
        altered,
        control_points=survey.check_points[1:4],
        check_points=(far, *survey.check_points[1:]),
        distances=(bar,),
    )
    run_stage(altered, EVALUATE, {"renders": 0, "cross_validate": True, "crs": "EPSG:4978", "tolerance_h": 1.0})
    text = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    missing = {name for name in names_in(report_of(altered)) if f"`{name}`" not in text}
    assert not missing


def names_in(document: Any) -> set[str]:
    """Every key of a document, however deep."""
    if isinstance(document, list):
        return set().union(*map(names_in, document))
    if not isinstance(document, dict):
        return set()
    return set(document).union(*map(names_in, document.values()))


def test_unusable_marks_leave_a_point_unmeasured(altered: Workspace) -> None:
    survey = load_json(Survey, altered.path(SURVEY))
    first, second, *rest = survey.check_points
    alone = first.model_copy(update={"marks": first.marks[:1]})
    elsewhere = second.model_copy(
        update={"marks": tuple(Mark(image=f"{row}.jpg", x_px=1, y_px=1, sigma_px=1) for row in range(3))}
    )
    change_survey(altered, check_points=(alone, elsewhere, *rest))
    run_stage(altered, EVALUATE, {"renders": 0})
    triangulated = report_of(altered)["checkpoints"]["triangulated"]
    assert triangulated["count"] == 4
    assert [row["rays"] for row in triangulated["points"][:2]] == [1, 0]
    assert [row["de_m"] for row in triangulated["points"][:2]] == [None, None]


def test_cameras_of_another_reconstruction_are_refused(altered: Workspace) -> None:
    model = load_json(TrainedModel, altered.path(MODEL))
    save_json(model.model_copy(update={"cameras": model.cameras[1:]}), altered.root / MODEL)
    with refused("cameras-of-another-model", InputError):
        run_stage(altered, EVALUATE, {})


def test_cameras_are_evaluated_before_training(evaluated: tuple[Workspace, Outcome], untrained: Workspace) -> None:
    outcome = run_stage(untrained, EVALUATE, {"cross_validate": True})
    found, trained = report_of(untrained), report_of(evaluated[0])
    # Not zero, but absent.
    assert found["photometric"] is None and found["checkpoints"]["surface"] is None
    assert not {"psnr", "surface_count"} & set(outcome.manifest.values)
    assert "not trained yet" in outcome.manifest.key_figure
    # The adjustment is the same, and so is all that does not show Gaussians.
    assert found["headline"]["surface"] is None and trained["headline"]["surface"] is not None
    for either in (found, trained):
        del either["headline"]["surface"]
    for name in ("headline", "accuracy", "fit", "similarity", "cameras", "cautions"):
        assert found[name] == trained[name], name
    before, after = (report["checkpoints"]["triangulated"] for report in (found, trained))
    # The area, which tells how many points are needed, is what is measured as soon as there are Gaussians.
    assert before.pop("asprs")["class_3d"] == after.pop("asprs")["class_3d"]
    assert before == after
    assert "area_measured" not in found and trained["area_measured"] <= 1
    folder = untrained.root / "evaluate"
    written = {path.name for path in folder.iterdir()}
    assert {"accuracy.csv", "accuracy.png", "cameras.csv", "points.csv"} <= written and "renders" not in written
    with (folder / "cameras.csv").open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == found["cameras"]["count"] == 14
    square = np.mean([float(row["sigma_u_m"]) ** 2 for row in rows])
    assert np.sqrt(square) == pytest.approx(found["cameras"]["rms_v_m"], abs=1e-5)
    assert boundary.guarded(cli, ["evaluate", str(untrained.root), "--cross-validate", "--points"]) == 0


def test_what_needs_gaussians_is_refused_before_training_in_one_sentence(untrained: Workspace) -> None:
    weights = untrained.root / "weights.npz"
    weights.touch()
    with refused("not-trained", InputError) as error:
        run_stage(untrained, EVALUATE, {"lpips_weights": weights})
    assert error.value.field == "--lpips-weights" and "`georef train" in error.value.remedy


def test_training_makes_the_evaluation_of_the_cameras_stale(
    evaluated: tuple[Workspace, Outcome], untrained: Workspace
) -> None:
    run_stage(untrained, EVALUATE, {})
    state = {row.stage: row.state for row in status(untrained)}
    assert (state["train"], state["evaluate"]) == ("missing", "current")
    shutil.copytree(evaluated[0].root / "train", untrained.root / "train")
    (row,) = [row for row in status(untrained) if row.stage == "evaluate"]
    assert row.state == "stale" and "train/model.json" in row.reason
    run_stage(untrained, EVALUATE, {"renders": 0})
    assert report_of(untrained)["photometric"]["test"]["views"] == 2


def test_nobody_solves_to_read(altered: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point that was left out is what init-sim3 found, whatever the survey says now."""
    first = load_json(TrainedModel, altered.path(MODEL))
    monkeypatch.setattr(system, "linearised", None)
    monkeypatch.setattr(system, "minimise", None)
    run_stage(altered, EVALUATE, {"renders": 0, "cross_validate": True})
    assert report_of(altered)["accuracy"]["rms_sigma_h_m"] == first.accuracy.rms_sigma_h_m
