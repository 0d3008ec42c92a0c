"""Trained surveys of a rendered scene, made once for the tests of training and evaluation; ingested bags."""

from __future__ import annotations

from pathlib import Path

import pytest
from splat_scenes import TRAINING, Flight, make_rendered, write_photographs
from threads import single_thread

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.products import load_json
from pipelines.runner import run_stage
from pipelines.stages import BY_NAME
from pipelines.survey import Survey
from pipelines.workspace import Workspace
from tests import bags
from tests.bags import Message
from tests.ingested_bags import Ingest, Refused

SEEDS = 3


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Flight]:
    """Rendered surveys that differ in everything random."""
    made = []
    for seed in range(SEEDS):
        rendered, root = make_rendered(seed), tmp_path_factory.mktemp(f"rendered{seed}")
        with single_thread():
            write_photographs(rendered, root / "photos")
        made.append(Flight(rendered, root, seed))
    return made


@pytest.fixture(scope="session")
def trained(flights: list[Flight]) -> list[tuple[Workspace, Workspace]]:
    """Each survey trained with the geographic losses and without."""
    pairs = []
    for flight in flights:
        pair = flight.workspace("with"), flight.workspace("without")
        with single_thread():
            run_stage(pair[0], BY_NAME["train"], TRAINING)
            run_stage(pair[1], BY_NAME["train"], {**TRAINING, "geo_loss": False})
        pairs.append(pair)
    return pairs


@pytest.fixture
def ingest(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Ingest:
    """`georef ingest --bag` of a bag, or of messages; it must succeed."""

    def call(bag: Path | list[Message], *arguments: str) -> Survey:
        path = bag if isinstance(bag, Path) else bags.write(tmp_path / f"bag{len(list(tmp_path.iterdir()))}", bag)
        workspace = tmp_path / f"ws{len(list(tmp_path.iterdir()))}"
        code = boundary.guarded(cli, ["ingest", str(workspace), "--bag", str(path), *arguments])
        told = capsys.readouterr()
        assert code == 0, told.err
        survey = load_json(Survey, workspace / "ingest/survey.json")
        assert all((workspace / survey.image_dir / image.name).is_file() for image in survey.images)
        return survey

    return call


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refused:
    """What `georef ingest --bag` says of a bag that it must refuse."""

    def call(bag: Path | list[Message], *arguments: str) -> str:
        path = bag if isinstance(bag, Path) else bags.write(tmp_path / "refused", bag)
        code = boundary.guarded(cli, ["ingest", str(tmp_path / "never"), "--bag", str(path), *arguments])
        told = capsys.readouterr()
        assert (code, told.out) == (1, "")
        return told.err

    return call
