"""`georef info`, and the end of `georef run`: what users read of a result."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from georef_cli.output import print_outcomes, size
from pipelines.core.manifest import MANIFEST, Manifest
from pipelines.core.products import save_json
from pipelines.core.stages import BY_NAME, MODEL, SPLAT
from pipelines.core.workspace import StageRun, Workspace
from pipelines.deliver.overview import overview
from pipelines.survey.options import CrsOptions
from tests.cli_runs import Georef
from tests.trained_workspaces import trained_workspace


@pytest.fixture
def flight(tmp_path: Path) -> Workspace:
    """A trained workspace with a splat that stands for one."""
    workspace = trained_workspace(tmp_path / "ws")[1]
    (workspace.root / "export").mkdir()
    (workspace.root / SPLAT).write_bytes(bytes(12_345))
    return workspace


def record_stage(workspace: Workspace, stage: str) -> None:
    """Put a manifest beside the product of a stage, as if it had been made of another model."""
    made = Manifest(
        stage=stage,
        config={},
        inputs={MODEL: "another"},
        versions={},
        started=datetime.now(UTC),
        duration_s=1.0,
        key_figure="80 Gaussians",
        values={},
        warnings=[],
    )
    save_json(made, workspace.root / BY_NAME[stage].folder / MANIFEST)


def test_command_tells_place_files_and_what_can_be_made(real_georef: Georef, flight: Workspace) -> None:
    result = real_georef("info", flight.root, "--crs", "EPSG:4326")
    assert result.code == 0
    for text in ("46.00", "7.75", "EPSG:4326", "export/splat.ply", "12.3 kB", "for viewers", "Not made yet"):
        assert text in result.out
    document = real_georef("info", flight.root, "--json").document
    assert document["type"] == "Feature"
    assert document["properties"]["files"][0]["path"] == SPLAT
    assert document["properties"]["outdated"] == []


def test_a_stale_result_is_told_in_the_first_line(real_georef: Georef, flight: Workspace) -> None:
    """The splat was made of another model: what follows in the text is not of the present inputs."""
    record_stage(flight, "export-ply")
    first, *_ = real_georef("info", flight.root).out.splitlines()
    assert first.startswith(f"{flight.root} is stale (export-ply: ")
    (row,) = real_georef("info", flight.root, "--json").document["properties"]["outdated"]
    assert (row["stage"], row["state"]) == ("export-ply", "stale") and MODEL in row["reason"]


def test_an_interrupted_run_beside_the_result_is_told(real_georef: Georef, flight: Workspace) -> None:
    record_stage(flight, "train")
    partial = flight.partial_product(BY_NAME["train"])
    partial.begin("")
    StageRun(flight, partial.folder).record_progress("20 of 40 iterations")
    assert "train: an interrupted run: 20 of 40 iterations, saved 20" in real_georef("info", flight.root).out
    document = real_georef("info", flight.root, "--json").document
    assert f"`georef train {flight.root}` goes on with it" in document["properties"]["interrupted"]["train"]


def test_command_names_what_is_missing(real_georef: Georef, flight: Workspace, tmp_path: Path) -> None:
    flight.path(MODEL).unlink()
    result = real_georef("info", flight.root)
    result.assert_failed(1)
    assert f"georef train {flight.root}" in result.err
    real_georef("info", tmp_path / "nowhere").assert_failed(1, "no-workspace")


def test_run_ends_with_where_the_files_are(flight: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    print_outcomes(flight, (), overview(flight, CrsOptions(crs="EPSG:4326")), as_json=False, logged=False)
    out = " ".join(capsys.readouterr().out.split())
    for text in (
        "at 46.00",
        "longitude 7.74",
        "export/splat.ply the splat",
        "EPSG:4326 ",
        "georef info",
        "--deliver",
    ):
        assert text in out


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 B"), (812, "812 B"), (1000, "1.0 kB"), (3_140_000, "3.1 MB"), (5 * 10**15, "5000.0 TB")],
)
def test_sizes_are_read_at_a_glance(count: int, text: str) -> None:
    assert size(count) == text
