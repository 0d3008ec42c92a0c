"""One answer: a result has one accuracy, the same to the digit wherever it is stated."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from georef_cli.commands.batch import batch_tables
from georef_cli.output import print_outcomes, print_rich
from pipelines.core.figures import Headline
from pipelines.core.fingerprints import fingerprints, hashes_of
from pipelines.core.manifest import MANIFEST, Manifest
from pipelines.core.products import NOT_CHECKED, Remark, load_json, save_json
from pipelines.core.stages import (
    ADJUSTMENT,
    BY_NAME,
    DELIVERABLES,
    GAUSSIANS,
    HEADLINE,
    MODEL,
    PIPELINE,
    REPORT,
    SPARSE,
    TRAIN_POSTERIOR,
)
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.deliver import cameras, ply, sog, spz, tiles
from pipelines.deliver.overview import overview
from pipelines.formats.colmap import write_sparse
from pipelines.jobs.batch import BatchTable, mission_row, write_batch
from pipelines.jobs.missions import Mission
from pipelines.report import stage as report
from pipelines.survey.headline import headline, headline_of, with_newest_solution
from pipelines.survey.options import CrsOptions
from pipelines.survey.report import AccuracySummary, EvaluationReport, TotalRmse, read_report
from pipelines.survey.survey import Survey
from pipelines.view.page_scene import accuracy_sentence
from tests.cli_runs import Georef
from tests.evaluated_workspaces import CHECK_POINTS, ERROR_M, evaluated_workspace
from tests.reports import check_points_with
from tests.scenes import WITH_GCPS, Noise, make_scene, sparse_model, survey_of, write_workspace
from tests.trained_workspaces import load_adjustment, untrained

UNCHECKED = (Remark(code=NOT_CHECKED, sentence="Nothing checks the positions."),)


@pytest.fixture
def flight(tmp_path: Path) -> Workspace:
    return evaluated_workspace(tmp_path / "flight").workspace


def true_headline(workspace: Workspace) -> Headline:
    """All errors are `ERROR_M`; the standard adds the variances of the points' survey."""
    points = load_json(Survey, workspace.path("ingest/survey.json")).check_points
    variance = np.mean([np.diag(point.cov_in_geo) for point in points], axis=0)
    east, north, up = np.square(ERROR_M) + variance
    return Headline(
        kind="measured", rmse_h_m=np.sqrt(east + north), rmse_v_m=np.sqrt(up), check_points=CHECK_POINTS
    )


def made(workspace: Workspace, name: str, run: Callable[..., Summary]) -> Path:
    """Run a stage in its place, and return its folder."""
    spec = BY_NAME[name]
    out = workspace.root / spec.folder
    out.mkdir(exist_ok=True)
    run(StageRun(workspace, out), spec.options())
    return out


def test_it_is_the_same_everywhere(
    real_georef: Georef, flight: Workspace, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    stated = headline_of(flight)
    assert stated is not None
    truth = true_headline(flight)
    assert (stated.rmse_h_m, stated.rmse_v_m) == pytest.approx((truth.rmse_h_m, truth.rmse_v_m), rel=1e-12)
    text, figures = truth.text, stated.model_dump(mode="json")
    of_points = "measured at 3 check points, triangulated, with the error of their survey"
    assert re.fullmatch(rf"{of_points}: RMSE H \d\.\d cm, V \d\.\d cm", text)

    # In JSON, to the last digit.
    assert real_georef("status", flight.root, "--json").document["accuracy"] == figures
    assert real_georef("info", flight.root, "--json").document["properties"]["quality"]["accuracy"] == figures
    runs = {"ply": ply.run, "spz": spz.run, "sog": sog.run, "tiles": tiles.run, "cameras": cameras.run}
    folders = {name: made(flight, f"export-{name}", run) for name, run in runs.items()}
    sidecars = [path for folder in folders.values() for path in folder.rglob("*.georef.json")]
    assert len(sidecars) == 12
    assert [json.loads(path.read_text("utf-8"))["accuracy"] for path in sidecars] == [figures] * 12

    # In text, to the digit that is shown.
    page = (made(flight, "report", report.run) / "report.html").read_text("utf-8")
    tiles_page = (folders["tiles"] / "index.html").read_text("utf-8")
    print_outcomes(flight, [], overview(flight, CrsOptions()), as_json=False, logged=True)
    end_of_run = capsys.readouterr().out
    mission = Mission("flight", flight, "flight")
    table = BatchTable(batch="b", missions=(mission_row(mission, "done"),))
    assert table.missions[0].accuracy == stated
    for where in (
        real_georef("status", flight.root).out,
        real_georef("info", flight.root).out,
        end_of_run,
        page,
        tiles_page,
        accuracy_sentence(flight),
    ):
        assert text in " ".join(where.split())
    write_batch(tmp_path, table)
    print_rich(*batch_tables(table, tmp_path))
    horizontal, vertical = re.findall(r"[HV] (\d\.\d) cm", text)
    assert re.search(rf"measured +{horizontal} cm +{vertical} cm +3", capsys.readouterr().out)
    for html in ((tmp_path / "b.batch.html").read_text("utf-8"), page):
        head = html.split("Errors of the check")[0]
        shown = re.findall(r'rmse_[hv]_m" data-value="([^"]+)">([^<]+)</data>', head)
        assert shown == [(str(stated.rmse_h_m), f"{horizontal} cm"), (str(stated.rmse_v_m), f"{vertical} cm")]


def test_what_states_it_goes_stale_with_it_alone(flight: Workspace) -> None:
    stating = [BY_NAME["export-ply"], *(spec for spec in DELIVERABLES if spec.name != "report")]
    assert all(HEADLINE in spec.reads for spec in stating)
    before = PIPELINE[: PIPELINE.index(BY_NAME["evaluate"])]
    assert not any(part.product == REPORT for spec in before for part in spec.reads)

    def hashes() -> str:
        spec = BY_NAME["export-ply"]
        return fingerprints(flight, spec, spec.options(), {}).hashes[REPORT]

    first, found = hashes(), load_json(EvaluationReport, flight.path(REPORT))
    save_json(found.model_copy(update={"cautions": UNCHECKED}), flight.path(REPORT))
    assert hashes() == first
    better = found.headline.model_copy(update={"rmse_v_m": 0.01})
    save_json(found.model_copy(update={"headline": better}), flight.path(REPORT))
    assert hashes() != first


def test_without_check_points_it_is_predicted_and_called_so() -> None:
    scene = AccuracySummary(cells=4, rms_sigma_h_m=0.0421, rms_sigma_v_m=0.0514, reason=None)
    none = check_points_with()
    assert headline(none, scene, ()).sentence == "accuracy predicted, not measured: σ H 4.2 cm, V 5.1 cm"
    unchecked = headline(none, scene, UNCHECKED)
    assert unchecked.sentence == "accuracy not known: nothing checks the σ of the positions"
    assert (unchecked.rmse_h_m, unchecked.rmse_v_m) == (None, None)
    few = AccuracySummary(cells=0, reason="the scene has too few points")
    assert headline(none, few, ()).text == "not known: the scene has too few points"
    # What is measured needs no check of the σ.
    total = TotalRmse(rmse_h_m=0.03, rmse_v_m=0.04, rmse_3d_m=0.05)
    points = check_points_with(count=1, with_survey=total)
    assert (
        headline(points, scene, UNCHECKED).text
        == "measured at 1 check point, triangulated, with the error of their survey: RMSE H 3.0 cm, V 4.0 cm"
    )


def test_blunders_that_count_are_told_from_those_that_are_refuted() -> None:
    total = TotalRmse(rmse_h_m=0.03, rmse_v_m=0.04, rmse_3d_m=0.05)
    named = {"blunders": ("G1", "G2", "G3"), "refuted": ("G2",), "with_survey_without_refuted": total}
    stated = headline(
        check_points_with(count=9, with_survey=total, **named), AccuracySummary(cells=0, reason=None), ()
    )
    assert (stated.beyond_class, stated.blunders, stated.vegetated) == (2, ("G2",), 0)


def test_before_evaluation_the_adjustment_predicts_it(real_georef: Georef, flight: Workspace) -> None:
    flight.path(REPORT).unlink()
    stated = headline_of(flight)
    grid = load_adjustment(flight).grid
    assert stated is not None and stated.rmse_h_m is not None and grid is not None
    assert stated.kind == "predicted"
    assert stated.rmse_h_m == pytest.approx(np.sqrt(np.mean(grid.sigma_h_m**2)), rel=1e-12)
    assert real_georef("status", flight.root, "--json").document["accuracy"] == stated.model_dump(mode="json")
    assert stated.text in " ".join(real_georef("info", flight.root).out.split())
    untrained(flight)  # init-sim3 predicts it as training does
    assert headline_of(flight) == stated
    flight.path("sim3/adjustment.json").unlink()
    assert headline_of(flight) is None


def test_a_run_without_training_ends_with_its_evaluation(real_georef: Georef, tmp_path: Path) -> None:
    scene, rng = make_scene(), np.random.default_rng(4)
    survey = survey_of(scene, Noise(), WITH_GCPS, rng)
    points = {"control_points": survey.control_points[2:], "check_points": survey.control_points[:2]}
    root = write_workspace(
        tmp_path / "ws", survey.model_copy(update=points), sparse_model(scene, Noise(), rng)
    ).root
    ended = real_georef("run", root, "--to", "init-sim3")
    assert ended.code == 0
    for title in ("Errors of the check points", "Predicted σ", "Residuals of the fit"):
        assert title in ended.out
    assert not (root / "evaluate").exists()  # no stage of its own
    document = real_georef("run", root, "--to", "init-sim3", "--json").document
    evaluation = document["evaluation"]
    stated = Headline.model_validate(evaluation["headline"])
    assert stated.check_points == 2 and stated.text in " ".join(ended.out.split())
    assert evaluation["checkpoints"]["surface"] is None and evaluation["cameras"]["count"] == len(scene.names)
    # The stage, asked for by its name, states the same; and so does the report, without what Gaussians show.
    assert real_georef("evaluate", root).code == 0
    assert read_report(root / REPORT).model_dump(mode="json") == evaluation
    # Each check point stands in a line of its own.
    for point in points["check_points"]:
        assert re.search(rf"^ *{point.name} +triangulated ", ended.out, re.MULTILINE)
    status = real_georef("status", root, "--json").document
    assert status["accuracy"] == evaluation["headline"]
    assert status["cautions"] == document["cautions"]
    assert stated.text in " ".join(real_georef("status", root).out.split())


def test_a_wrong_check_point_is_named_by_run_and_status_alike(real_georef: Georef, tmp_path: Path) -> None:
    scene, rng = make_scene(), np.random.default_rng(4)
    survey = survey_of(scene, Noise(), WITH_GCPS, rng)
    wrong, *others = survey.control_points[:3]
    east, north, up = wrong.position_in_geo
    typed = wrong.model_copy(update={"position_in_geo": (east, north + 1.5, up)})
    points = {"control_points": survey.control_points[3:], "check_points": (typed, *others)}
    root = write_workspace(
        tmp_path / "ws", survey.model_copy(update=points), sparse_model(scene, Noise(), rng)
    ).root
    document = real_georef("run", root, "--to", "init-sim3", "--json").document
    headline_ = document["evaluation"]["headline"]
    assert headline_["blunders"] == [wrong.name]
    # One of three points is off by 1.5 m; the others are as good as their σ of centimetres.
    assert headline_["rmse_h_m"] == pytest.approx(1.5 / 3**0.5, rel=0.1)
    assert headline_["rmse_h_without_m"] < 0.1
    (caution,) = (one for one in document["cautions"] if one["code"] == "check-point-blunder")
    assert wrong.name in caution["sentence"] and not any(point.name in caution["sentence"] for point in others)
    assert "prediction-rejected" not in {one["code"] for one in document["cautions"]}
    status = real_georef("status", root, "--json").document
    assert status["accuracy"] == headline_ and caution in status["cautions"]


def solved_again(real_georef: Georef, root: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the documents of a run to `init-sim3` without control points, and of the status after it."""
    run = real_georef(
        "run", root, "--to", "init-sim3", "--set", "init-sim3.control_points=false", "--json"
    ).document
    return run, real_georef("status", root, "--json").document


def codes(document: dict[str, Any]) -> list[str]:
    return [one["code"] for one in document["cautions"]]


@pytest.mark.slow
def test_a_new_solution_has_not_the_accuracy_of_the_evaluated_one(real_georef: Georef, tmp_path: Path) -> None:
    scene, rng = make_scene(), np.random.default_rng(4)
    noise = Noise(fix_m=(0.3, 0.3, 0.3), bias_m=(1.0, 0.0, 0.0))
    survey = survey_of(scene, noise, WITH_GCPS, rng)
    points = {"control_points": survey.control_points[2:], "check_points": survey.control_points[:2]}
    root = write_workspace(tmp_path / "ws", survey.model_copy(update=points), sparse_model(scene, noise, rng)).root
    assert real_georef("run", root, "--to", "init-sim3").code == 0
    assert real_georef("evaluate", root).code == 0
    before = real_georef("status", root, "--json").document
    evaluated = read_report(root / REPORT).headline
    assert before["accuracy"] == evaluated.model_dump(mode="json")
    assert "result-of-earlier-solution" not in codes(before)

    run, status = solved_again(real_georef, root)
    stated = run["evaluation"]["headline"]
    # The fixes alone are shifted by 1 m, which control points of centimetres removed.
    assert stated["kind"] == "measured" and stated["rmse_h_m"] > 0.7
    assert evaluated.rmse_h_m is not None and evaluated.rmse_h_m < 0.1
    assert status["accuracy"] == stated
    assert codes(run).count("result-of-earlier-solution") == codes(status).count("result-of-earlier-solution") == 1
    text = " ".join(real_georef("status", root).out.split())
    assert f"accuracy {Headline.model_validate(stated).text} caution" in text
    # What is handed over of the new solution has its accuracy, by σ until it is evaluated.
    handed_over = headline_of(Workspace(root))
    assert handed_over is not None and handed_over.kind == "predicted"
    assert real_georef("evaluate", root).code == 0
    after = real_georef("status", root, "--json").document
    assert after["accuracy"] == stated and "result-of-earlier-solution" not in codes(after)

    # A newer SfM model makes the solution one of an earlier model, and nothing is known of the new one.
    write_sparse(sparse_model(scene, noise, rng), root / SPARSE)
    status = real_georef("status", root, "--json").document
    assert status["accuracy"] is None and "result-of-earlier-solution" in codes(status)


@pytest.mark.parametrize("newer", ["init-sim3", "train"])
def test_a_training_of_an_earlier_solution_does_not_speak_for_the_new(
    real_georef: Georef, flight: Workspace, newer: str
) -> None:
    """The evaluation is of the training; then `init-sim3` runs again, or the training does."""
    stated = headline_of(flight)
    model = (flight.root / MODEL).read_bytes()
    posterior = (flight.root / TRAIN_POSTERIOR).read_bytes()
    gaussians = (flight.root / GAUSSIANS).read_bytes()
    untrained(flight)
    (flight.root / "train").mkdir()
    for product, content in {MODEL: model, TRAIN_POSTERIOR: posterior, GAUSSIANS: gaussians}.items():
        (flight.root / product).write_bytes(content)
    for name in ("train", "evaluate"):
        spec = BY_NAME[name]
        made = {"stage": name, "config": {}, "versions": {}, "key_figure": "", "values": {}, "warnings": []}
        reads = (replace(part, optional=True) for part in spec.reads)  # `geolocate` has made nothing
        inputs = dict(chain.from_iterable(hashes_of(flight, part, {}).items() for part in reads))
        manifest = Manifest(started=datetime.now(UTC), duration_s=1.0, inputs=inputs, **made)
        save_json(manifest, flight.root / spec.folder / MANIFEST)
    assert headline_of(flight) == headline_of(with_newest_solution(flight)) == stated

    changed = flight.root / (ADJUSTMENT if newer == "init-sim3" else MODEL)
    solution = json.loads(changed.read_text("utf-8"))
    solution["accuracy"] |= {"rms_sigma_h_m": 0.5, "rms_sigma_v_m": 0.25}
    changed.write_text(json.dumps(solution), "utf-8")
    status = real_georef("status", flight.root, "--json").document
    (caution,) = (one for one in status["cautions"] if one["code"] == "result-of-earlier-solution")
    if newer == "train":  # no evaluation of a newer training: σ predict its accuracy
        assert caution["stage"] == "evaluate"
        assert (status["accuracy"]["kind"], status["accuracy"]["rmse_h_m"]) == ("predicted", 0.5)
        assert headline_of(flight) == Headline.model_validate(status["accuracy"])
    else:  # the solution of init-sim3 is measured anew; the files of the training keep the accuracy of the training
        assert caution["stage"] == "train" and "evaluate" in caution["sentence"]
        assert status["accuracy"] != stated.model_dump(mode="json") and headline_of(flight) == stated
