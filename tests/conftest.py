"""Fixtures for all tests."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipelines.stages import STAGES
from pipelines.workspace import Workspace
from tests import fakes

# As the command line does, and for the same reason: see georef_cli/main.py.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


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
