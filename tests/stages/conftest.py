"""Trained surveys of a rendered scene, made once for the tests of training and evaluation."""

from __future__ import annotations

import pytest
from splat_scenes import TRAINING, Flight, make_rendered, write_photographs
from threads import single_thread

from pipelines.runner import run_stage
from pipelines.stages import BY_NAME
from pipelines.workspace import Workspace

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
