"""Clean-up after failed commands: nothing is left where nothing was finished."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.core.errors import BackendUnavailableError, InputError
from pipelines.core.lock import LOCK, WriteLock
from pipelines.core.options import read_requests
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.cli_runs import Georef


def refuse(stage: StageRun, options: object) -> Summary:
    (stage.out / "half.json").write_text("{")
    raise InputError("images-too-few", "2 images are too few")


def listing(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.mark.parametrize("command", ["ingest", "run"])
def test_refused_in_a_folder_of_photographs(georef: Georef, photos: Path, command: str) -> None:
    fakes.install(ingest=refuse)
    before = listing(photos)
    georef(command, photos, "--images", photos).assert_failed(1)
    assert listing(photos) == before


@pytest.mark.parametrize("command", ["ingest", "run"])
def test_refused_in_a_new_folder(georef: Georef, tmp_path: Path, photos: Path, command: str) -> None:
    fakes.install(ingest=refuse)
    georef(command, tmp_path / "new/flight", "--images", photos).assert_failed(1)
    assert not (tmp_path / "new").exists()


def test_options_of_the_user_stay(georef: Georef, workspace: Workspace, photos: Path) -> None:
    fakes.install(ingest=refuse)
    workspace.root.mkdir()
    workspace.config_file.write_text("[train]\nseed = 1\n")
    georef("run", workspace.root, "--images", photos).assert_failed(1)
    assert listing(workspace.root) == ["georef.toml"]


@pytest.mark.parametrize("command", ["status", "info", "sfm", "compare"])
def test_mistyped_workspace_is_not_made(georef: Georef, tmp_path: Path, command: str) -> None:
    georef(command, tmp_path / "fligth").assert_failed(1)
    assert not (tmp_path / "fligth").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), None])
def test_interrupted_and_broken_commands_keep_their_log(
    georef: Georef, workspace: Workspace, photos: Path, error: BaseException | None
) -> None:
    def end(stage: StageRun, options: object) -> Summary:
        raise error or ZeroDivisionError("a defect")

    fakes.install(ingest=end)
    if error is None:
        with pytest.raises(ZeroDivisionError):
            georef("run", workspace.root, "--images", photos)
    else:
        assert georef("run", workspace.root, "--images", photos).code == 130
    text = (workspace.root / "logs/ingest.log").read_text()
    assert "ingest: started" in text
    assert ("Traceback" in text) is (error is None)
    assert read_requests(workspace.root)["ingest"]["images"] == str(photos)


def test_a_later_failure_removes_nothing(georef: Georef, workspace: Workspace, photos: Path) -> None:
    def fail(stage: StageRun, options: object) -> Summary:
        raise BackendUnavailableError("no-gpu", "no GPU")

    fakes.install(sfm=fail)
    georef("run", workspace.root, "--images", photos).assert_failed(1)
    kept = listing(workspace.root)
    assert {"ingest/manifest.json", "sfm.partial/failure.txt", "logs/ingest.log", "logs/sfm.log"} <= set(kept)


def test_lock_that_was_discarded_excludes_nobody(tmp_path: Path) -> None:
    """A process that opened the file of a lock before it was discarded takes a new one."""
    lock = WriteLock(tmp_path)
    with lock.hold("first"):
        lock.discard()
        assert not (tmp_path / LOCK).exists()
        with lock.hold("second"):
            assert lock.activity() == "second"
