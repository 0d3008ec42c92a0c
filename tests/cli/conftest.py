"""Fixtures for the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from georef_cli import boundary
from georef_cli.main import cli
from tests.cli_runs import Georef, Result
from tests.killed import make_survey


@pytest.fixture
def georef(capsys: pytest.CaptureFixture[str], fake_stages: None) -> Georef:
    """`georef` in this process, with fake stages."""
    return _in_this_process(capsys)


@pytest.fixture
def real_georef(capsys: pytest.CaptureFixture[str]) -> Georef:
    """`georef` in this process, as it is."""
    return _in_this_process(capsys)


@pytest.fixture(scope="session")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small survey for real runs."""
    folder = tmp_path_factory.mktemp("real") / "survey"
    make_survey(folder)
    return folder


def _in_this_process(capsys: pytest.CaptureFixture[str]) -> Georef:
    def call(*arguments: object) -> Result:
        code = boundary.guarded(cli, [str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Result(code, captured.out, captured.err)

    return call
