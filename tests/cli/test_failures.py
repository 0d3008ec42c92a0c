"""Failures for programs: `--json` prints one document of the error, and the exit code tells usage from the rest."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.core import errors
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.cli.test_process import BROKEN
from tests.cli_runs import Georef, finish, start


@pytest.fixture
def done(georef: Georef, workspace: Workspace, photos: Path) -> Path:
    """A workspace in which a stage can fail: ingest is done."""
    assert georef("ingest", workspace.root, "--images", photos).code == 0
    return workspace.root


def test_error_of_a_file_names_path_line_and_field(georef: Georef, done: Path, tmp_path: Path) -> None:
    def refuse(stage: StageRun, options: object) -> Summary:
        raise errors.InputError("east-no-number", "'east' is no number", path="t.csv", line=5, field="longitude")

    fakes.install(ingest=refuse)
    result = georef("ingest", done, "--force", "--json")
    result.assert_failed(1)
    assert result.document["error"] == {
        "kind": "input", "code": "east-no-number", "message": "'east' is no number", "path": "t.csv", "line": 5,
        "field": "longitude", "remedy": None,
    }  # fmt: skip
    assert result.err.splitlines()[-1] == "error: t.csv:5 [longitude]: 'east' is no number"


def test_missing_product_names_the_command(georef: Georef, workspace: Workspace, photos: Path) -> None:
    georef("ingest", workspace.root, "--images", photos)
    result = georef("train", workspace.root, "--json")
    result.assert_failed(1)
    error = result.document["error"]
    assert (error["code"], error["remedy"]) == ("missing-product", f"Run `georef sfm {workspace.root}` first.")


def test_deliverables_of_a_run_that_ends_before_training(georef: Georef, workspace: Workspace) -> None:
    result = georef("run", workspace.root, "--to", "init-sim3", "--deliver", "cloud", "--json")
    result.assert_failed(2)
    assert "leave out --to" in result.err


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (["sfm", "WS", "--mapper", "best"], "--mapper"),
        (["sfm", "WS", "--frobnicate"], "--frobnicate"),
        (["train", "WS", "--iterations", 0], "--iterations"),
        (["compare", "WS", "--configs", "Z"], "--configs"),
        (["run", "WS", "--deliver", "meshes"], None),
        (["run", "WS", "--from", "train", "--to", "sfm"], None),
        (["sfm"], None),
        (["splat", "WS"], None),
    ],
)
def test_every_usage_error_is_2(georef: Georef, done: Path, words: list[object], field: str | None) -> None:
    result = georef(*(done if word == "WS" else word for word in words), "--json")
    result.assert_failed(2)
    assert result.document["error"]["field"] == field


def test_option_out_of_range_in_the_file_is_no_usage_error(georef: Georef, done: Path) -> None:
    (done / "georef.toml").write_text("[train]\niterations = 0\n")
    result = georef("train", done, "--json")
    result.assert_failed(1)
    assert result.document["error"]["path"] == str(done / "georef.toml")


@pytest.mark.parametrize(
    ("error", "code", "name"),
    [
        (errors.ConvergenceError("diverged", "diverged"), 1, "convergence"),
        (errors.DegenerateGeometryError("parallel-rays", "parallel rays"), 1, "geometry"),
        (OSError(28, "No space left on device", "points.npz"), 1, "storage"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_kinds_of_failures(georef: Georef, done: Path, error: BaseException, code: int, name: str) -> None:
    def fail(stage: StageRun, options: object) -> Summary:
        raise error

    fakes.install(sfm=fail)
    result = georef("sfm", done, "--force", "--json")
    expected = getattr(error, "code", "storage-enospc" if name == "storage" else name)
    result.assert_failed(code, expected)
    assert (result.document["error"]["kind"], result.document["error"]["code"]) == (name, expected)


def test_defect_has_a_document_and_a_traceback(tmp_path: Path, photos: Path) -> None:
    result = finish(start("ingest", tmp_path / "flight", "--images", photos, "--json", code=BROKEN))
    assert result.code == 1
    assert json.loads(result.out)["error"]["code"] == "defect"
    assert "Traceback" in result.err
