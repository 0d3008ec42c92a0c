"""Fixtures for the command line."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from georef_cli import boundary
from georef_cli.main import cli
from pipelines.jobs import pace
from tests.cli_runs import Georef, Result
from tests.killed import make_survey


@pytest.fixture(autouse=True)
def own_pace(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of tests teach this machine nothing."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setattr(pace, "_file", lambda: folder / "pace.json")


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
    exit_of, root = boundary.exit_of, logging.getLogger()

    def call(*arguments: object) -> Result:
        exits: list[boundary.Exit | None] = []
        records: list[logging.LogRecord] = []

        def recorded(error: BaseException) -> boundary.Exit | None:
            exits.append(exit_of(error))
            return exits[-1]

        handler = logging.Handler(logging.WARNING)
        handler.emit = records.append  # type: ignore[method-assign]
        root.addHandler(handler)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(boundary, "exit_of", recorded)
            code = boundary.guarded(cli, [str(argument) for argument in arguments])
        root.removeHandler(handler)
        captured = capsys.readouterr()
        error = exits[-1].error if exits and exits[-1] is not None else None
        warned = tuple(record.code for record in records if hasattr(record, "code"))
        return Result(code, captured.out, captured.err, error, warned)

    return call
