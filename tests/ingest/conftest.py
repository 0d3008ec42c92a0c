"""Ingested bags."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.core.products import load_json
from pipelines.survey.survey import Survey
from tests import bags
from tests.bags import Message
from tests.ingested_bags import Ingest, Refusal


@pytest.fixture
def ingest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Ingest:
    """`georef ingest --bag` of a bag, or of messages; it must succeed."""

    def call(bag: Path | list[Message], *arguments: str) -> Survey:
        path = bag if isinstance(bag, Path) else bags.write(tmp_path / f"bag{len(list(tmp_path.iterdir()))}", bag)
        workspace = tmp_path / f"ws{len(list(tmp_path.iterdir()))}"
        code = boundary.guarded(cli, ["ingest", str(workspace), "--bag", str(path), *arguments])
        captured = capsys.readouterr()
        assert code == 0, captured.err
        survey = load_json(Survey, workspace / "ingest/survey.json")
        assert all((workspace / survey.image_dir / image.name).is_file() for image in survey.images)
        return survey

    return call


@pytest.fixture
def refusal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refusal:
    """The error document of `georef ingest --bag` of a bag that it must refuse."""

    def call(bag: Path | list[Message], *arguments: str) -> dict[str, Any]:
        path = bag if isinstance(bag, Path) else bags.write(tmp_path / "refused", bag)
        code = boundary.guarded(cli, ["ingest", str(tmp_path / "never"), "--bag", str(path), "--json", *arguments])
        assert code in (1, 2)
        error: dict[str, Any] = json.loads(capsys.readouterr().out)["error"]
        return error

    return call
