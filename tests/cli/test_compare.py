"""`georef compare` with fake stages: what runs, what is skipped, what is refused, and what is told."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.compare.configurations import BY_CONFIGURATION
from pipelines.core.errors import ConvergenceError, InputError
from pipelines.core.lock import WriteLock
from pipelines.core.options import StageOptions
from pipelines.core.products import Remark, dump_json
from pipelines.core.stages import BY_NAME, PIPELINE, stage_slice
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.cli_runs import Georef, Result
from tests.reports import check_points_with, report_with

NAMES = tuple(BY_CONFIGURATION)
SHARED = [spec.name for spec in stage_slice(None, "geolocate")]
OWN = ["init-sim3", "train", "evaluate"]


def error_of(text: str) -> float:
    """Metres that stand for a configuration: they follow from all that was read."""
    return int(hashlib.sha256(text.encode()).hexdigest()[:4], 16) / 1e6


def reporting(stage: StageRun, config: StageOptions) -> Summary:
    """A fake of `evaluate` whose report has figures."""
    spec = BY_NAME["evaluate"]
    text = fakes.fake_run(spec)(stage, config).values["text"]
    error = error_of(text)
    # Two points, as far off.
    points = check_points_with(count=2, mean_h_m=error, median_h_m=error, rmse_h_m=error, rmse_v_m=2 * error)
    cautions = (Remark(code="fake", sentence=text),)
    report = report_with(
        test={"psnr": 20.0 + error, "ssim": 0.5}, triangulated=points, surface=points, cautions=cautions
    )
    fakes.write_products(stage, spec, dump_json(report.model_dump(mode="json")))
    return Summary("evaluated", {}, (Remark(code="few-check-points", sentence="few check points"),))


@pytest.fixture
def survey(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace whose shared stages are current."""
    fakes.install(evaluate=reporting)
    assert georef("run", workspace.root, "--images", photos, "--to", "geolocate").code == 0
    return workspace.root


def ran(result: Result) -> list[tuple[str | None, str]]:
    """Configuration and name of the stages that were run."""
    assert result.code == 0, result.err
    return [(row["configuration"], row["stage"]) for row in result.document["stages"] if row["ran"]]


def options_of(root: Path, configuration: str, folder: str = "train") -> dict[str, Any]:
    manifest = json.loads((root / "compare" / configuration / folder / "manifest.json").read_text("utf-8"))
    return dict(manifest["config"])


def test_all_run_once_and_the_second_time_nothing_does(georef: Georef, survey: Path) -> None:
    first = georef("compare", survey, "--json")
    assert [row["configuration"] for row in first.document["rows"]] == list(NAMES)
    expected = [("baseline", "adjust"), ("baseline", "train"), ("baseline", "evaluate")]
    expected += [("A", stage) for stage in OWN] + [("B", "init-sim3"), ("B", "evaluate")]
    expected += [(name, stage) for name in "CDE" for stage in OWN]
    assert ran(first) == expected
    files = {path: path.stat().st_mtime_ns for path in (survey / "compare").glob("*.*")}
    assert {path.name for path in files} == {"table.json", "table.md", "plot.png", "comparison.html"}
    second = georef("compare", survey, "--json")
    assert ran(second) == []
    assert second.document["rows"] == first.document["rows"]
    assert {path: path.stat().st_mtime_ns for path in files} == files


def test_each_configuration_is_what_the_method_says(georef: Georef, survey: Path) -> None:
    assert georef("compare", survey).code == 0
    train = {name: options_of(survey, name) for name in ("baseline", "A", "C", "D", "E")}
    assert not (survey / "compare/B/train").exists()  # its Gaussians are those of A
    losses = ("georeference", "gcp_loss", "distance_loss", "geo_schedule")
    assert {name: tuple(options[loss] for loss in losses) for name, options in train.items()} == {
        "baseline": ("frozen", False, False, "constant"),
        "A": ("frozen", False, False, "constant"),
        "C": ("joint", False, False, "constant"),
        "D": ("joint", True, True, "constant"),
        "E": ("joint", True, True, "rising"),
    }
    start = {name: options_of(survey, name, "sim3") for name in "ABCDE"}
    assert {name: (options["method"], options["control_points"]) for name, options in start.items()} == {
        "A": ("robust", False),
        "B": ("paper", False),
        "C": ("robust", False),
        "D": ("robust", True),
        "E": ("robust", True),
    }
    placed = {name: options_of(survey, name, "evaluate")["similarity"] for name in NAMES}
    assert placed == {**dict.fromkeys(NAMES, "trained"), "B": "initial"}


def test_variants_read_what_is_theirs(georef: Georef, survey: Path) -> None:
    """Each stage's fingerprints are those of the folders that the configuration is defined to read."""
    assert georef("compare", survey).code == 0

    def digest(path: str) -> str:
        return json.loads((survey / path / "manifest.json").read_text("utf-8"))["inputs"]

    trained = {name: digest(f"compare/{name}/train") for name in ("baseline", "A", "E")}
    assert trained["A"]["sfm/sparse"] == trained["E"]["sfm/sparse"] != trained["baseline"]["sfm/sparse"]
    assert len({inputs["sim3/adjustment.json"] for inputs in trained.values()}) == 3
    evaluated = {name: digest(f"compare/{name}/evaluate") for name in "AB"}
    assert evaluated["A"]["train/gaussians.ply"] == evaluated["B"]["train/gaussians.ply"]
    assert evaluated["A"]["sim3/adjustment.json"] != evaluated["B"]["sim3/adjustment.json"]


def test_one_alone_runs_only_what_it_needs(georef: Georef, survey: Path) -> None:
    result = georef("compare", survey, "--configs", "B", "--json")
    assert ran(result) == [("B", stage) for stage in ("init-sim3", "train", "init-sim3", "evaluate")]
    assert [row["configuration"] for row in result.document["rows"]] == ["B"]
    assert ran(georef("compare", survey, "--configs", "A", "--json")) == [("A", "evaluate")]


def test_order_is_the_users_and_each_counts_once(georef: Georef, survey: Path) -> None:
    result = georef("compare", survey, "--configs", "E, A,E", "--json")
    assert [row["configuration"] for row in result.document["rows"]] == ["E", "A"]
    assert (survey / "compare/table.md").read_text("utf-8").index("**E**") < 1000


@pytest.mark.parametrize("names", ["A,F", "a", ","])
def test_unknown_configuration_is_refused_before_anything_runs(georef: Georef, survey: Path, names: str) -> None:
    result = georef("compare", survey, "--configs", names)
    result.assert_failed(2)
    assert "--configs" in result.err
    assert "baseline, A, B, C, D, E" in result.err
    assert not (survey / "compare").exists()


def test_options_reach_all_trainings_and_are_remembered(georef: Georef, survey: Path) -> None:
    first = georef("compare", survey, "--configs", "A,E", "--iterations", 7, "--seed", 3, "--json")
    assert first.document["options"] == {"iterations": 7, "seed": 3}
    assert options_of(survey, "A")["iterations"] == options_of(survey, "E")["iterations"] == 7
    assert options_of(survey, "E", "sim3")["seed"] == options_of(survey, "E")["seed"] == 3
    again = georef("compare", survey, "--configs", "C,E", "--json")
    assert ran(again) == [("C", stage) for stage in OWN]
    assert options_of(survey, "C")["iterations"] == 7
    other = georef("compare", survey, "--configs", "E", "--strategy", "mcmc", "--json")
    assert ran(other) == [("E", "train"), ("E", "evaluate")]
    assert other.document["options"] == {"iterations": 7, "seed": 3, "strategy": "mcmc"}


def test_training_is_asked_for_as_before_but_for_what_makes_the_configuration(georef: Georef, survey: Path) -> None:
    georef("init-sim3", survey)
    assert georef("train", survey, "--preset", "fast", "--georeference", "frozen").code == 0
    own = '[init-sim3]\nmethod = "paper"\nmax_residual = 1.0\n[train]\nsh_degree = 1\n'
    (survey / "georef.toml").write_text(own, encoding="utf-8")
    assert georef("compare", survey, "--configs", "E").code == 0
    options = options_of(survey, "E")
    assert (options["preset"], options["sh_degree"], options["georeference"]) == ("fast", 1, "joint")
    start = options_of(survey, "E", "sim3")
    assert (start["method"], start["max_residual"]) == ("robust", None)


def test_bad_option_is_refused_before_anything_runs(georef: Georef, survey: Path) -> None:
    result = georef("compare", survey, "--iterations", 0)
    assert result.code == 2
    assert "--iterations" in result.err
    assert not (survey / "compare").exists()
    # What makes the configurations is not for the user to set.
    assert georef("compare", survey, "--no-gcp-loss").code == 2
    frozen = georef("compare", survey, "--georeference", "frozen", "--json")
    assert (frozen.code, frozen.document["error"]["code"]) == (2, "georeference-frozen")


def test_the_papers_losses_are_those_of_all_that_train_the_cameras(georef: Georef, survey: Path) -> None:
    assert georef("compare", survey, "--configs", "A,D", "--georeference", "paper").code == 0
    assert [options_of(survey, name)["georeference"] for name in "AD"] == ["frozen", "paper"]


def test_changed_survey_makes_everything_again(georef: Georef, survey: Path) -> None:
    assert georef("compare", survey, "--configs", "A").code == 0
    (survey / "georef.toml").write_text("[ingest]\ntest_every = 3\n", encoding="utf-8")
    result = georef("compare", survey, "--configs", "A", "--json")
    assert ran(result) == [(None, stage) for stage in SHARED] + [("A", stage) for stage in OWN]


def test_the_workspaces_own_line_is_left_alone(georef: Georef, survey: Path) -> None:
    assert georef("run", survey).code == 0
    assert georef("compare", survey, "--iterations", 5).code == 0
    rows = georef("status", survey, "--json").document["stages"]
    assert [row["state"] for row in rows] == ["current"] * len(PIPELINE)
    assert not [row for row in georef("run", survey, "--json").document["stages"] if row["ran"]]


def test_force_redoes_the_configurations_but_not_what_they_share(georef: Georef, survey: Path) -> None:
    georef("compare", survey, "--configs", "A,B")
    result = georef("compare", survey, "--configs", "A,B", "--force", "--json")
    assert ran(result) == [*(("A", stage) for stage in OWN), ("B", "init-sim3"), ("B", "evaluate")]


def test_interrupted_comparison_goes_on(georef: Georef, survey: Path) -> None:
    whole = fakes.fake_run(BY_NAME["train"])

    def interrupted(stage: StageRun, config: StageOptions) -> Summary:
        if stage.out.parent.name == "C":
            raise KeyboardInterrupt
        return whole(stage, config)

    fakes.install(evaluate=reporting, train=interrupted)
    assert georef("compare", survey, "--iterations", 9).code == 130
    assert not (survey / "compare/table.json").exists()
    fakes.install(evaluate=reporting)
    result = georef("compare", survey, "--json")
    assert ran(result) == [("C", "train"), ("C", "evaluate"), *((name, stage) for name in "DE" for stage in OWN)]
    resumed = [row["values"]["resumed"] for row in result.document["stages"] if row["stage"] == "train"]
    assert resumed == [False, False, True, False, False]
    assert options_of(survey, "E")["iterations"] == 9


def test_a_configuration_that_fails_has_a_row_that_says_why(georef: Georef, survey: Path) -> None:
    def diverging(stage: StageRun, config: StageOptions) -> Summary:
        raise ConvergenceError("diverged", "it diverged")

    fakes.install(evaluate=reporting, train=diverging, adjust=diverging)
    result = georef("compare", survey, "--configs", "baseline,A,B", "--json")
    rows = result.document["rows"]
    assert [row["failure"] for row in rows] == ["it diverged"] * 3
    assert [row["test_psnr"] for row in rows] == [None] * 3
    assert result.err.count("train: started") == 1  # B waits for the same training
    table = georef("compare", survey, "--configs", "baseline")
    assert table.code == 0
    assert "failed: it diverged" in table.out
    fakes.install(evaluate=reporting)
    assert georef("compare", survey, "--configs", "baseline", "--json").document["rows"][0]["failure"] is None


def test_other_errors_end_it(georef: Georef, survey: Path) -> None:
    def refusing(stage: StageRun, config: StageOptions) -> Summary:
        raise InputError("no-such-thing", "no such thing")

    fakes.install(evaluate=reporting, train=refusing)
    result = georef("compare", survey)
    result.assert_failed(1, "no-such-thing")


def test_figures_are_those_of_the_reports(georef: Georef, survey: Path) -> None:
    rows = georef("compare", survey, "--json").document["rows"]
    for row in rows:
        text = (survey / "compare" / row["configuration"] / "evaluate/report.json").read_text("utf-8")
        report = json.loads(text)
        assert row["test_psnr"] == report["photometric"]["test"]["psnr"]
        assert row["triangulated"]["rmse_v_m"] == report["checkpoints"]["triangulated"]["rmse_v_m"]
        assert (
            row["surface"]["median_h_m"] == report["checkpoints"]["surface"]["mean_h_m"]
        )  # two points, as far off
        assert row["surface"]["count"] == 2
        assert row["warnings"] == []  # that of evaluate is of the survey
    assert json.loads((survey / "compare/table.json").read_text("utf-8"))["rows"] == rows


def test_table_for_people(georef: Georef, survey: Path) -> None:
    result = georef("compare", survey)
    assert result.code == 0
    lines = result.out.splitlines()
    for name in NAMES:
        assert sum(line.startswith(f"{name} ") for line in lines) == 2  # its figures, and what it is
    assert "SfM-BBA + 3DGS" in result.out
    assert all(len(line) <= 120 for line in lines)


def test_without_a_workspace_there_is_nothing_to_compare(georef: Georef, tmp_path: Path) -> None:
    result = georef("compare", tmp_path / "nowhere")
    assert result.code == 1
    assert "does not exist" in result.err
    assert not (tmp_path / "nowhere").exists()


def test_busy_workspace_is_not_touched(georef: Georef, survey: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipelines.core.workspace.ORPHAN_S", 0.1)
    with Workspace(survey).lock("train"):
        result = georef("compare", survey)
    result.assert_failed(1, "workspace-busy")
    assert "train" in result.err


def test_workspace_is_held_while_configurations_run(georef: Georef, survey: Path) -> None:
    seen = []

    def looking(stage: StageRun, config: StageOptions) -> Summary:
        seen.append(WriteLock(survey).activity())
        return reporting(stage, config)

    fakes.install(evaluate=looking)
    assert georef("compare", survey, "--configs", "A").code == 0
    assert seen == ["compare"]


def test_logs_lie_with_the_configuration(georef: Georef, survey: Path) -> None:
    georef("compare", survey, "--configs", "A")
    assert "train: train done" in (survey / "compare/A/logs/train.log").read_text("utf-8")
    assert not (survey / "logs/train.log").exists()
