"""Options of earlier commands: remembered by every command, shown, and forgotten on request."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.core.options import read_requests, remember
from pipelines.core.workspace import Workspace
from tests.cli_runs import Georef


@pytest.fixture
def done(georef: Georef, workspace: Workspace, photos: Path, tmp_path: Path) -> Path:
    """A workspace with control points and an imported SfM model, and a preset for training."""
    (tmp_path / "gcp.txt").write_text("EPSG:4326")
    (tmp_path / "model").mkdir()
    assert georef("ingest", workspace.root, "--images", photos, "--gcp", tmp_path / "gcp.txt").code == 0
    assert georef("sfm", workspace.root, "--import", tmp_path / "model").code == 0
    remember(workspace.root, {"train": {"preset": "fast"}})
    return workspace.root


def test_bare_command_repeats_what_was_asked_for(georef: Georef, done: Path) -> None:
    """An imported model is not replaced by a reconstruction of hours, because a flag was left out."""
    for stage in ("ingest", "sfm"):
        assert not georef(stage, done, "--json").document["ran"], stage


def test_one_option_more_keeps_the_others(georef: Georef, done: Path, photos: Path, tmp_path: Path) -> None:
    assert georef("ingest", done, "--test-every", 4).code == 0
    expected = {"images": str(photos), "gcp": str(tmp_path / "gcp.txt"), "test_every": 4}
    assert read_requests(done)["ingest"] == expected


@pytest.mark.parametrize("words", [("ingest",), ("run", "--to", "ingest")])
def test_forget_drops_one_option(georef: Georef, done: Path, photos: Path, words: tuple[str, ...]) -> None:
    command, *options = words
    assert georef(command, done, *options, "--forget", "gcp").code == 0
    assert read_requests(done)["ingest"] == {"images": str(photos)}
    assert read_requests(done)["train"] == {"preset": "fast"}


@pytest.mark.parametrize("name", ["import", "--import", "all"])
def test_forget_knows_flags_and_all(georef: Georef, done: Path, name: str) -> None:
    result = georef("sfm", done, "--forget", name, "--max-features", 900, "--json")
    assert result.document["ran"]
    assert read_requests(done)["sfm"] == {"max_features": 900}


@pytest.mark.parametrize("command", ["sfm", "run"])
def test_forgetting_what_is_no_option_is_a_usage_error(georef: Georef, done: Path, command: str) -> None:
    before = read_requests(done)
    result = georef(command, done, "--forget", "gcps")
    result.assert_failed(2)
    assert "'gcps' is no option" in result.err
    assert read_requests(done) == before


def test_status_shows_options_with_their_origin(georef: Georef, done: Path, photos: Path, tmp_path: Path) -> None:
    (done / "georef.toml").write_text("[train]\npreset = 'high'\nseed = 7\n")
    rows = georef("status", done, "--options", "--json").document["options"]
    assert [(row["stage"], row["flag"], row["value"], row["origin"]) for row in rows] == [
        ("ingest", "--images", str(photos), "remembered"),
        ("ingest", "--gcp", str(tmp_path / "gcp.txt"), "remembered"),
        ("sfm", "--import", str(tmp_path / "model"), "remembered"),
        ("train", "--preset", "fast", "remembered"),
        ("train", "--seed", "7", "georef.toml"),
    ]
    text = georef("status", done, "--options").out
    assert "--import" in text and "remembered" in text and "georef.toml" in text
    assert "options" not in georef("status", done, "--json").document
