"""Fixtures for all tests."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock, Timeout

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
def between_processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all processes of this run of the tests share."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def flights(between_processes: Path, tmp_path_factory: pytest.TempPathFactory) -> list[RenderedFlight]:
    """Rendered surveys that differ in everything random, made once for the tests of training and evaluation."""
    from tests.splat_scenes import RenderedFlight, make_rendered, write_photographs
    from tests.threads import single_thread

    made = []
    for seed in range(SEEDS):
        rendered, shared = make_rendered(seed), between_processes / f"rendered{seed}"
        with single_thread():
            make_once({shared / "photos": partial(write_photographs, rendered)})
        (shared / "cache").mkdir(exist_ok=True)
        root = tmp_path_factory.mktemp(f"rendered{seed}")
        for name in ("photos", "cache"):
            (root / name).symlink_to(shared / name)
        made.append(RenderedFlight(rendered, root, seed))
    return made


@pytest.fixture(scope="session")
def trained(flights: list[RenderedFlight], between_processes: Path) -> list[tuple[Workspace, Workspace]]:
    """Each survey trained with the geographic losses and without."""
    from pipelines.core.runner import run_stage
    from tests.splat_scenes import TRAINING
    from tests.threads import single_thread

    def train(flight: RenderedFlight, geo_loss: bool, made: Path) -> None:
        workspace = flight.workspace(made.name)
        run_stage(workspace, BY_NAME["train"], {**TRAINING, "geo_loss": geo_loss})
        shutil.copytree(workspace.root, made, symlinks=True)

    tasks = {
        between_processes / f"trained{flight.seed}" / name: partial(train, flight, name == "with")
        for name in ("with", "without")
        for flight in flights
    }
    with single_thread():
        make_once(tasks)
    for made in tasks:
        own = flights[int(made.parent.name[-1])].root / made.name
        if not own.exists():
            shutil.copytree(made, own, symlinks=True)
    return [(Workspace(flight.root / "with"), Workspace(flight.root / "without")) for flight in flights]


@pytest.fixture(scope="session")
def finished(between_processes: Path) -> Workspace:
    """A workspace with every product of 40 iterations on nine tiny photographs, which nobody changes."""
    from tests.killed import make_finished

    root = between_processes / "finished" / "ws"
    make_once({root: make_finished})
    return Workspace(root)


def make_once(tasks: Mapping[Path, Callable[[Path], None]]) -> None:
    """Call each function with the path of what it makes, unless another process of this run has, or does."""
    for wait in (False, True):  # first what nobody has begun
        for made, make in tasks.items():
            made.parent.mkdir(exist_ok=True)
            done = made.with_name(f"{made.name}.done")
            with contextlib.suppress(Timeout), FileLock(f"{made}.lock", blocking=wait):
                if not done.exists():
                    make(made)
                    done.touch()
