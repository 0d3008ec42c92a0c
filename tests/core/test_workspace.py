"""The workspace: one writer, and no way to lose or damage a product by dying."""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pipelines.core import runner
from pipelines.core import staleness as states
from pipelines.core.errors import InputError, MissingProductError, WorkspaceBusyError
from pipelines.core.lock import WriteLock
from pipelines.core.options import read_requests, remember
from pipelines.core.plan import photograph_folder
from pipelines.core.stages import ADJUSTMENT, BY_NAME, MODEL, PIPELINE, POINTS, SPARSE, stage_slice
from pipelines.core.workspace import Workspace
from tests import fakes
from tests.refusals import refused

TRAIN = BY_NAME["train"]
FORKS = pytest.mark.skipif(sys.platform == "win32", reason="no fork, no SIGKILL")
WRITING = os.O_WRONLY | os.O_RDWR
CHANGES = ("os.rename", "os.remove", "os.rmdir", "os.mkdir")


def die_at(step: int) -> Callable[[str, tuple[Any, ...]], None]:
    """An audit hook that kills this process ahead of its `step`-th change of the file system."""
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        writes = event == "open" and isinstance(arguments[2], int) and bool(arguments[2] & WRITING)
        if event in CHANGES or writes:
            seen += 1
            if seen == step:
                os.kill(os.getpid(), signal.SIGKILL)

    return hook


def killed_at(step: int, work: Callable[[], object]) -> bool:
    """Do `work` in a child process that dies ahead of change `step`; False if it got to its end."""
    child = os.fork()
    if child == 0:
        sys.addaudithook(die_at(step))
        try:
            work()
        except BaseException:
            os._exit(1)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) in (0, -signal.SIGKILL), "the work failed by itself"
    return os.WIFSIGNALED(status)


def kill_points(
    make: Callable[[Path], Workspace], work: Callable[[Workspace], object], folder: Path
) -> Iterator[Workspace]:
    """Workspaces in which `work` was killed ahead of its 1st, 2nd, 3rd … change, and one where it was not."""
    for step in range(1, 200):
        workspace = make(folder / str(step))
        killed = killed_at(step, partial(work, workspace))
        yield workspace
        if not killed:
            assert step > 5, "hardly a kill point: the hook sees nothing"
            return
    raise AssertionError("the work never came to its end")


def assert_whole(workspace: Workspace) -> None:
    """Every product that is there is the one that its manifest tells of."""
    for spec in PIPELINE:
        manifest = workspace.manifest(spec)
        if manifest is not None:
            assert set(fakes.read_products(workspace, spec)) == {manifest.values["text"]}


def assert_tidy(workspace: Workspace) -> None:
    """Nothing of a killed run is left over."""
    left = [path.name for path in workspace.root.iterdir() if path.name.endswith((".partial", ".old", ".tmp"))]
    assert left == []


@FORKS
@pytest.mark.usefixtures("fake_stages")
@pytest.mark.slow
class TestKilledAtAnyMoment:
    """Every change of the file system is a kill point: the process dies ahead of each in turn."""

    def test_first_run_is_completed_by_the_next(self, tmp_path: Path, photos: Path) -> None:
        def work(workspace: Workspace) -> list[runner.Outcome]:
            return runner.run_pipeline(workspace, PIPELINE[:2], {"ingest": {"images": photos}})

        for workspace in kill_points(Workspace, work, tmp_path):
            if workspace.root.exists():
                states.status(workspace)  # can always be looked at
            work(workspace)
            assert_whole(workspace)
            assert_tidy(workspace)
            assert [row.state for row in states.status(workspace)][:2] == ["current", "current"]

    def test_rerun_leaves_old_or_new_product(self, tmp_path: Path, photos: Path) -> None:
        def make(root: Path) -> Workspace:
            workspace = Workspace(root)
            runner.run_pipeline(workspace, stage_slice(None, "train"), {"ingest": {"images": photos}})
            return workspace

        def work(workspace: Workspace) -> runner.Outcome:
            return runner.run_stage(workspace, TRAIN, {"seed": 1})

        old = fakes.read_products(make(tmp_path / "old"), TRAIN)
        for workspace in kill_points(make, work, tmp_path):
            with workspace.lock("test"):  # whoever writes next repairs first
                texts = fakes.read_products(workspace, TRAIN)
            assert len(set(texts)) == 1
            assert texts == old or '"seed":1' in texts[0]
            assert_whole(workspace)
            work(workspace)
            assert '"seed":1' in fakes.read_products(workspace, TRAIN)[0]
            assert_tidy(workspace)

    def test_half_deleted_run_is_never_resumed(self, tmp_path: Path) -> None:
        folders = "abcdefgh"  # in whatever order the file system lists them, some are deleted before the token

        def make(root: Path) -> Workspace:
            workspace = Workspace(root)
            out, _ = workspace.begin(TRAIN, "same", "never")
            for name in folders:
                (out / name).mkdir()
                (out / name / "part").write_text("part of a checkpoint")
            return workspace

        def drop(workspace: Workspace) -> object:
            return workspace.begin(TRAIN, "other", "if-same")

        for workspace in kill_points(make, drop, tmp_path):
            out, continued = workspace.begin(TRAIN, "same", "if-same")
            assert all((out / name / "part").exists() == continued for name in folders)


class TestLock:
    def test_second_writer_is_told_who_writes(self, workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("pipelines.core.workspace.ORPHAN_S", 0.1)
        with (
            workspace.lock("train"),
            pytest.raises(WorkspaceBusyError, match=rf"train in process {os.getpid()}"),
            workspace.lock("ingest"),
        ):
            pass

    def test_writer_is_seen_while_it_writes(self, workspace: Workspace) -> None:
        assert WriteLock(workspace.root).activity() is None
        with workspace.lock("train"):
            assert WriteLock(workspace.root).activity() == "train"
        assert WriteLock(workspace.root).activity() is None

    @FORKS
    def test_lock_dies_with_its_holder(self, workspace: Workspace) -> None:
        child = os.fork()
        if child == 0:
            with workspace.lock("train"):
                os.kill(os.getpid(), signal.SIGKILL)
        os.waitpid(child, 0)
        with workspace.lock("ingest"):
            assert WriteLock(workspace.root).activity() == "ingest"

    def test_file_in_place_of_workspace(self, tmp_path: Path) -> None:
        (tmp_path / "flight").write_text("not a folder")
        with refused("workspace-unusable", InputError), Workspace(tmp_path / "flight").lock("t"):
            pass


class TestBegin:
    def begin(self, workspace: Workspace) -> Path:
        out, continued = workspace.begin(TRAIN, "same", "if-same")
        assert not continued
        (out / "checkpoint").write_text("1000")
        return out

    def test_same_run_is_continued(self, workspace: Workspace) -> None:
        self.begin(workspace)
        out, continued = workspace.begin(TRAIN, "same", "if-same")
        assert continued
        assert (out / "checkpoint").exists()

    @pytest.mark.parametrize(("token", "resume"), [("other", "if-same"), ("same", "never")])
    def test_other_run_starts_empty(self, workspace: Workspace, token: str, resume: Any) -> None:
        self.begin(workspace)
        out, continued = workspace.begin(TRAIN, token, resume)
        assert not continued
        assert not (out / "checkpoint").exists()

    def test_insisting_on_another_run_is_refused_and_keeps_it(self, workspace: Workspace) -> None:
        out = self.begin(workspace)
        with refused("interrupted-run-differs", InputError):
            workspace.begin(TRAIN, "other", "always")
        assert (out / "checkpoint").exists()

    def test_stage_that_cannot_resume_starts_empty(self, workspace: Workspace) -> None:
        spec = BY_NAME["ingest"]
        out, _ = workspace.begin(spec, "same", "if-same")
        (out / "half").write_text("")
        assert workspace.begin(spec, "same", "if-same") == (out, False)
        assert not (out / "half").exists()


def test_missing_product_names_the_command(workspace: Workspace) -> None:
    with pytest.raises(MissingProductError, match=rf"georef geolocate {workspace.root}"):
        workspace.path(POINTS)
    with pytest.raises(MissingProductError, match="georef sfm"):
        workspace.path(SPARSE)


@pytest.mark.parametrize("text", ["{", "[]", '{"train": 1}', "\xff\xfe"])
def test_damaged_requests_are_named(workspace: Workspace, text: str) -> None:
    workspace.root.mkdir()
    path = workspace.root / "requests.json"
    path.write_text(text, encoding="latin-1")
    with refused("requests-damaged", InputError) as error:
        read_requests(workspace.root)
    assert error.value.path == path


def test_requests_are_kept_by_stage(workspace: Workspace) -> None:
    workspace.root.mkdir()
    remember(workspace.root, {"ingest": {"images": Path("/photos"), "check": ("P1", "P2")}})
    remember(workspace.root, {"train": {"preset": "fast"}})
    remember(workspace.root, {"train": {"seed": 3}})
    assert read_requests(workspace.root) == {
        "ingest": {"images": "/photos", "check": ["P1", "P2"]},
        "train": {"seed": 3},
    }
    assert json.loads((workspace.root / "requests.json").read_text())


def test_variant_reads_what_is_lent_and_writes_its_own(tmp_path: Path) -> None:
    workspace, elsewhere = Workspace(tmp_path / "flight"), tmp_path / "elsewhere"
    lent = {"sfm": workspace.root / "sfm", "geolocate": elsewhere}
    variant = Workspace(workspace.root / "compare/A", workspace, lent, "compare")
    for path in (workspace.root / SPARSE, elsewhere / "points.npz", variant.root / ADJUSTMENT):
        path.mkdir(parents=True)
    assert variant.path(SPARSE) == workspace.root / SPARSE
    assert variant.path(POINTS) == elsewhere / "points.npz"
    assert variant.path(ADJUSTMENT) == variant.root / ADJUSTMENT
    assert variant.partial(TRAIN).parent == variant.root == workspace.root / "compare/A"
    assert variant.cache == workspace.cache
    assert {row.stage: row.state for row in states.status(variant)}["sfm"] == "current"
    assert variant.config_file == workspace.config_file
    assert photograph_folder(variant, "ingest/images") == workspace.root / "ingest/images"
    assert photograph_folder(variant, "/photos") == Path("/photos")
    with pytest.raises(MissingProductError, match=f"georef compare {workspace.root}"):
        variant.path(MODEL)  # not the workspace's own, even if it were there


def test_failure_that_is_no_text_is_shown_as_far_as_it_is(workspace: Workspace) -> None:
    partial = workspace.partial(TRAIN)
    partial.mkdir(parents=True)
    (partial / "failure.txt").write_bytes(b"no \xe3 overlap")
    assert workspace.partial_product(TRAIN).failure() == "no \ufffd overlap"


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000])
def test_requests_nested_too_deeply_are_refused(workspace: Workspace, text: str) -> None:
    workspace.root.mkdir()
    (workspace.root / "requests.json").write_text(text)
    with refused("requests-damaged", InputError) as error:
        read_requests(workspace.root)
    assert error.value.path == workspace.root / "requests.json"


@pytest.mark.parametrize("duration", ["1e300", "1e999", "NaN"])
def test_manifest_that_ends_beyond_the_calendar_is_damaged(workspace: Workspace, duration: str) -> None:
    document = {key: {} for key in ("config", "inputs", "versions", "values")}
    document |= {"stage": "train", "key_figure": "", "warnings": [], "started": "2026-01-01T00:00:00Z"}
    folder = workspace.root / TRAIN.folder
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text(json.dumps(document)[:-1] + f', "duration_s": {duration}}}')
    with refused("product-invalid", InputError) as error:
        workspace.manifest(TRAIN)
    assert error.value.path == folder / "manifest.json"
