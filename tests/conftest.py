"""Fixtures for all tests."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pipelines.core.stages import BY_NAME, STAGES
from pipelines.core.workspace import Workspace
from tests import fakes

if TYPE_CHECKING:
    from tests.splat_scenes import RenderedFlight

# Two: a third one hardly moves a mean. The squared errors of the similarity are 4.3 and 3.5 (the third 3.8), and
# what the geographic losses gain in quality is 0.27 and 0.08 dB (the third 0.09 dB).
SEEDS = 2

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@pytest.fixture(scope="session", autouse=True)
def heard_interrupts() -> Iterator[None]:
    """Let SIGINT interrupt these processes and their children: in the background of a shell it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def fake_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fake stages in place of the real ones, for one test."""
    for spec in STAGES:
        monkeypatch.setitem(sys.modules, spec.module, None)  # so that what was there is put back
    fakes.install()


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """A workspace that is not there yet."""
    return Workspace(tmp_path / "flight")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder that stands for one of photographs."""
    return fakes.photographs(tmp_path / "photos")


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Compute with one thread: see `threads.single_thread`."""
    from tests.threads import single_thread

    with single_thread():
        yield


@pytest.fixture(scope="session")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[RenderedFlight]:
    """Rendered surveys that differ in everything random, made once for the tests of training and evaluation."""
    from tests.splat_scenes import RenderedFlight, make_rendered, write_photographs
    from tests.threads import single_thread

    made = []
    for seed in range(SEEDS):
        rendered, root = make_rendered(seed), tmp_path_factory.mktemp(f"rendered{seed}")
        with single_thread():
            write_photographs(rendered, root / "photos")
        made.append(RenderedFlight(rendered, root, seed))
    return made


@pytest.fixture(scope="session")
def trained(flights: list[RenderedFlight]) -> list[tuple[Workspace, Workspace]]:
    """Each survey trained with the geographic losses and without."""
    from pipelines.core.runner import run_stage
    from tests.splat_scenes import TRAINING
    from tests.threads import single_thread

    pairs = []
    for flight in flights:
        pair = flight.workspace("with"), flight.workspace("without")
        with single_thread():
            run_stage(pair[0], BY_NAME["train"], TRAINING)
            run_stage(pair[1], BY_NAME["train"], {**TRAINING, "geo_loss": False})
        pairs.append(pair)
    return pairs
