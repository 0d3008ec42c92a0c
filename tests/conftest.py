"""Fixtures for all tests."""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from pipelines.core.stages import BY_NAME, STAGES
from pipelines.core.workspace import Workspace
from tests import fakes
from tests.children import run_here
from tests.once import make_once

if TYPE_CHECKING:
    from tests.splat_scenes import RenderedFlight

# Two: a third one hardly moves a mean. The squared errors of the similarity are 4.3 and 3.5 (the third 3.8).
SEEDS = 2

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# Files that take longest, the longest first, of the fast tests and of the slow ones.
LONGEST = (
    "cli/test_kill_matrix.py",
    "cli/test_falsified_surveys.py",
    "train/test_train.py",
    "faults/test_full_disk.py",
    "cli/test_batch_cluster.py",
    "adjust/test_monte_carlo.py",
    "cli/test_current_folder.py",
    "adjust/test_drift.py",
    "cli/test_kill.py",
    "adjust/test_sessions.py",
    "train/test_train_on_gsplat.py",
    "cli/test_documented_commands.py",
    "cli/test_blocks_cluster.py",
    "faults/test_faults.py",
    "cli/test_bad_products.py",
    "simulate/test_simulate.py",
    "splat/rasterizer/test_cpu.py",
    "ingest/test_targets.py",
    "deliver/raster/test_raster.py",
    "sfm/test_known_poses.py",
    "splat/test_losses.py",
    "sfm/test_sfm.py",
    "test_package.py",
    "fuzz/test_fuzz.py",
    "deliver/raster/test_pictures.py",
    "cli/test_webodm.py",
    "view/test_saved.py",
    "cli/test_compare.py",
)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let several processes begin with the longest files: one that begins last is waited for by all."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return
    rank = {Path(__file__).parent / name: number for number, name in enumerate(LONGEST)}
    count = Counter(item.path for item in items)
    items.sort(key=lambda item: (rank.get(item.path, len(rank)), -count[item.path]))


@pytest.fixture(scope="session", autouse=True)
def heard_interrupts() -> Iterator[None]:
    """Let SIGINT interrupt these processes and their children: in the background of a shell it is ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session", autouse=True)
def unflushed_files() -> Iterator[None]:
    """Let the system write files to the disk when it likes: no test cuts the power, and flushes are waited for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _descriptor: None)
        yield


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
def children_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Native code works in this process, for tests of what it does and not of where."""
    for module in ("sfm.stage", "sfm.prior_adjustment", "surface.poisson"):
        monkeypatch.setattr(f"pipelines.{module}.run_in_child", run_here)


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
        run_stage(workspace, BY_NAME["train"], {**TRAINING, "georeference": "joint" if geo_loss else "frozen"})
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
