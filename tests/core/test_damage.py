"""Products that are not as their stage wrote them, and storage that fails: states, refusals, repair."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from pipelines.core import runner
from pipelines.core import staleness as states
from pipelines.core.errors import DamagedPartialError, InputError, StorageError, storage_error
from pipelines.core.manifest import Manifest
from pipelines.core.stages import BY_NAME, GAUSSIANS, PIPELINE, SPARSE
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes
from tests.refusals import logged_codes, refused

pytestmark = pytest.mark.usefixtures("fake_stages")


@pytest.fixture
def done(workspace: Workspace, photos: Path) -> Workspace:
    """A workspace in which all stages are current."""
    runner.run_pipeline(workspace, PIPELINE, {"ingest": {"images": photos}})
    return workspace


def row_of(workspace: Workspace, stage: str) -> states.StageState:
    return next(row for row in states.status(workspace) if row.stage == stage)


def spoil(path: Path, *, keep_time: bool = False) -> bytes:
    """Turn one bit of a file; returns the whole file."""
    whole, stat = path.read_bytes(), path.stat()
    path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])
    if keep_time:
        os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    return whole


def test_damaged_product_is_recognised_refused_and_made_again(done: Workspace) -> None:
    whole = spoil(done.root / GAUSSIANS)
    assert row_of(done, "train").state == "damaged"
    assert row_of(done, "train").reason == f"{GAUSSIANS} is not as the stage wrote it"
    assert row_of(done, "evaluate").state == "stale"
    with refused("product-damaged", InputError) as error:
        runner.run_stage(done, BY_NAME["evaluate"], {})
    assert GAUSSIANS in str(error.value) and "train/manifest.json" in str(error.value)
    outcomes = runner.run_pipeline(done, PIPELINE, {})
    assert [outcome.stage for outcome in outcomes if outcome.ran] == ["train"]  # with the same result
    assert (done.root / GAUSSIANS).read_bytes() == whole
    assert {row.state for row in states.status(done)} == {"current"}
    # It may have been an edit.
    assert (done.root / "damaged" / GAUSSIANS).read_bytes() == bytes([whole[0] ^ 1]) + whole[1:]


def test_bit_that_turned_by_itself_is_found_when_the_product_is_used(done: Workspace) -> None:
    """Size and time are those of the manifest: only the content tells."""
    whole = spoil(done.root / SPARSE / "content.txt", keep_time=True)
    with refused("product-damaged", InputError):
        runner.run_stage(done, BY_NAME["geolocate"], {})
    runner.run_pipeline(done, PIPELINE, {})
    assert (done.root / SPARSE / "content.txt").read_bytes() == whole


def test_copied_workspace_is_current(done: Workspace) -> None:
    for path in done.root.rglob("*.*"):
        os.utime(path)
    assert {row.state for row in states.status(done)} == {"current"}


def test_manifest_of_an_earlier_version_guards_nothing(done: Workspace) -> None:
    path = done.root / "sfm/manifest.json"
    manifest = Manifest.model_validate_json(path.read_text())
    path.write_text(manifest.model_dump_json(exclude={"files"}))
    assert row_of(done, "sfm").state == "current"


@pytest.mark.parametrize("resume", ["if-same", "always"])
def test_damaged_partial_is_dropped_and_said(
    done: Workspace, resume: str, caplog: pytest.LogCaptureFixture
) -> None:
    resumed: list[bool] = []

    def interrupted(stage: StageRun, options: object) -> Summary:
        raise KeyboardInterrupt

    def picky(stage: StageRun, options: object) -> Summary:
        resumed.append(stage.resumed)
        if stage.resumed:
            raise DamagedPartialError("checkpoint-damaged", "is not a readable checkpoint.")
        return fakes.fake_run(BY_NAME["train"])(stage, options)  # type: ignore[arg-type]

    fakes.install(train=interrupted)
    with pytest.raises(KeyboardInterrupt):
        runner.run_stage(done, BY_NAME["train"], {"seed": 3})
    fakes.install(train=picky)
    runner.run_stage(done, BY_NAME["train"], {"seed": 3}, resume=resume)  # type: ignore[arg-type]
    assert resumed == [True, False]
    assert "interrupted-run-damaged" in logged_codes(caplog)


@pytest.mark.parametrize("folder", ["sfm", "sfm.partial"])
@pytest.mark.parametrize("kind", ["link", "dangling", "file"])
def test_what_stands_where_a_stage_writes(
    workspace: Workspace, photos: Path, tmp_path: Path, folder: str, kind: str
) -> None:
    """A link in the place of a finished folder is refused, its target untouched; a partial one is only a draft."""
    elsewhere = tmp_path / "elsewhere"
    (elsewhere / "mine").mkdir(parents=True)
    workspace.root.mkdir()
    place = workspace.root / folder
    if kind == "file":
        place.write_text("mine")
    else:
        place.symlink_to(elsewhere if kind == "link" else tmp_path / "nowhere")
    if folder == "sfm":
        with refused("stage-folder-is-file" if kind == "file" else "stage-folder-is-link", InputError):
            runner.run_pipeline(workspace, PIPELINE, {"ingest": {"images": photos}})
    else:
        runner.run_pipeline(workspace, PIPELINE, {"ingest": {"images": photos}})
    assert (elsewhere / "mine").is_dir()
    states.status(workspace)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_array_written_in_part_is_a_full_disk() -> None:
    """numpy's error has no number."""
    with Path("/dev/full").open("wb", buffering=0) as full, pytest.raises(OSError) as error:
        np.zeros(100_000).tofile(full)
    storage = storage_error(error.value, Path("cache"))
    assert storage is not None and storage.code == "storage-enospc"


def test_storage_error_behind_another_error() -> None:
    """`zipfile` replaces the error of a full disk by one of its own."""
    try:
        try:
            raise OSError(errno.ENOSPC, "No space left on device", "points.npz")
        finally:
            raise ValueError("Can't close the ZIP file while there is an open writing handle on it.")
    except ValueError as error:
        found = storage_error(error)
        assert found is not None and found.code == "storage-enospc" and str(found).startswith("points.npz: ")
    assert storage_error(ValueError("a defect")) is None
    assert storage_error(FileNotFoundError(errno.ENOENT, "No such file", "x")) is None


def test_storage_error_of_a_stage_is_recorded(done: Workspace) -> None:
    def full(stage: StageRun, options: object) -> Summary:
        raise OSError(errno.EIO, "Input/output error", "model.json")

    fakes.install(train=full)
    with refused("storage-eio", StorageError) as error:
        runner.run_stage(done, BY_NAME["train"], {"seed": 3})
    assert str(error.value).startswith("model.json: ")
    assert str(error.value) in row_of(done, "train").reason
