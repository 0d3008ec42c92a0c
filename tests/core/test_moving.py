"""What stays current when workspace and inputs are moved, copied or joined by other files, and what does not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.core import runner
from pipelines.core import staleness as states
from pipelines.core.manifest import MANIFEST
from pipelines.core.options import read_requests, remember
from pipelines.core.plan import photograph_folder
from pipelines.core.stages import BY_NAME, stage_slice
from pipelines.core.workspace import StageRun, Summary, Workspace
from tests import fakes

pytestmark = pytest.mark.usefixtures("fake_stages")
STAGES = stage_slice(None, "geolocate")  # the photographs of a survey decide one of them, all of it two


def stale(workspace: Workspace) -> dict[str, str]:
    """Stages that are not current, with the reason."""
    rows = states.status(workspace, before=BY_NAME["init-sim3"])
    return {row.stage: row.reason for row in rows if row.state != "current"}


def made(workspace: Workspace, **flags: object) -> list[str]:
    """Run the stages; the names of those that ran."""
    return [outcome.stage for outcome in runner.run_pipeline(workspace, STAGES, {"ingest": flags}) if outcome.ran]


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with photographs, a table, and a workspace in which these stages are current."""
    project = tmp_path / "project"
    fakes.photographs(project / "photos" / "sub")
    (project / "track.csv").write_text("image,lat\n")
    made(Workspace(project / "ws"), images=project / "photos", trajectory=project / "track.csv")
    return project


def later(path: Path) -> None:
    """Give every file below a folder another time, as a copy over the network has it."""
    for file in path.rglob("*"):
        os.utime(file, (1, 1))


class TestNothingIsStale:
    def test_photographs_copied_to_another_path(self, project: Path) -> None:
        copied = shutil.copytree(project / "photos", project / "elsewhere")
        later(copied)
        workspace = Workspace(project / "ws")
        shutil.rmtree(project / "photos")
        assert made(workspace, images=copied) == []
        assert stale(workspace) == {}

    def test_workspace_moved_with_its_inputs(self, project: Path, tmp_path: Path) -> None:
        later(project)
        moved = Workspace(project.rename(tmp_path / "archive") / "ws")
        assert stale(moved) == {}
        assert made(moved) == []
        assert read_requests(moved.root)["ingest"]["images"] == str(tmp_path / "archive/photos")

    def test_workspace_moved_alone(self, project: Path, tmp_path: Path) -> None:
        moved = Workspace((project / "ws").rename(tmp_path / "fast-disk"))
        assert stale(moved) == {}
        assert made(moved) == []

    def test_workspace_copied_with_relative_options(self, project: Path, tmp_path: Path) -> None:
        workspace = Workspace(project / "ws")
        workspace.config_file.write_text('[ingest]\nimages = "../photos"\ntrajectory = "../track.csv"\n')
        remember(workspace.root, {"ingest": {}})
        assert stale(workspace) == {}
        copied = Workspace(shutil.copytree(project, tmp_path / "copy") / "ws")
        shutil.rmtree(project)
        assert stale(copied) == {} and made(copied) == []

    @pytest.mark.parametrize("name", ["Thumbs.db", "flight_Timestamp.MRK", "sub/notes.txt", ".hidden.jpg"])
    def test_stray_file_among_the_photographs(self, project: Path, name: str) -> None:
        (project / "photos" / name).write_text("stray")
        assert stale(Workspace(project / "ws")) == {}


def change(path: Path) -> None:
    path.write_bytes(b"A" + path.read_bytes()[1:])


def touch_back(path: Path) -> None:
    """Change a table without its size and time."""
    stat = path.stat()
    change(path)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


class TestChangesAreNoticed:
    @pytest.mark.parametrize(
        ("name", "act"),
        [
            ("photos/sub/a.jpg", change),
            ("photos/sub/a.jpg", Path.unlink),
            ("photos/sub/a.jpg", lambda path: path.rename(path.with_name("c.jpg"))),
            ("photos/c.JPG", lambda path: path.write_bytes(b"c")),
        ],
        ids=["changed", "removed", "renamed", "added"],
    )
    def test_photographs(self, project: Path, name: str, act: Callable[[Path], object]) -> None:
        act(project / name)
        assert stale(Workspace(project / "ws"))["ingest"] == "--images changed"

    def test_photographs_changed_on_the_way(self, project: Path, tmp_path: Path) -> None:
        copied = Workspace(shutil.copytree(project, tmp_path / "copy") / "ws")
        shutil.rmtree(project)
        change(tmp_path / "copy/photos/sub/b.jpg")
        assert stale(copied)["ingest"] == "--images changed"

    def test_table_also_at_its_old_size_and_time(self, project: Path) -> None:
        touch_back(project / "track.csv")
        assert stale(Workspace(project / "ws"))["ingest"] == "--trajectory changed"

    def test_table_given_no_more(self, project: Path) -> None:
        workspace = Workspace(project / "ws")
        remember(workspace.root, {"ingest": {"images": str(project / "photos")}})
        assert stale(workspace)["ingest"] == "--trajectory changed"


def test_moved_photographs_are_read_once(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`run` records the new times, so that no later look reads the photographs again."""
    workspace = Workspace(project / "ws")
    later(project / "photos")
    assert made(workspace) == []
    read: list[Path] = []
    monkeypatch.setattr("pipelines.core.fingerprints._record", read.append)
    assert stale(workspace) == {} and read == []


def test_photographs_are_found_where_they_are(project: Path, tmp_path: Path) -> None:
    """The survey names the folder of its time; after a move, that of the present options counts."""
    before = project / "photos"
    assert photograph_folder(Workspace(project / "ws"), str(before)) == before
    moved = Workspace(project.rename(tmp_path / "archive") / "ws")
    assert photograph_folder(moved, str(before)) == tmp_path / "archive/photos"
    assert photograph_folder(moved, "ingest/images") == tmp_path / "archive/photos"
    shutil.rmtree(tmp_path / "archive/photos")
    assert photograph_folder(moved, str(before)) == before


def test_interrupted_stage_is_resumed_after_a_move(project: Path, tmp_path: Path) -> None:
    workspace = Workspace(project / "ws")
    model = project / "model"
    model.mkdir()
    (model / "cameras.bin").write_bytes(b"model")

    def interrupted(stage: StageRun, options: object) -> Summary:
        raise KeyboardInterrupt

    fakes.install(sfm=interrupted)
    with pytest.raises(KeyboardInterrupt):
        runner.run_stage(workspace, BY_NAME["sfm"], {"import_model": model})
    fakes.install()
    moved = Workspace(project.rename(tmp_path / "archive") / "ws")
    outcome = runner.run_stage(moved, BY_NAME["sfm"], read_requests(moved.root)["sfm"], resume="always")
    assert outcome.manifest.values["resumed"]


def test_records_of_a_manifest_name_no_other_files(project: Path) -> None:
    """A hostile record cannot make a file outside the folder count, nor hide a file in it."""
    workspace = Workspace(project / "ws")
    path = workspace.root / "ingest" / MANIFEST
    path.write_text(path.read_text().replace('"sub/a.jpg"', '"../track.csv"'))
    assert stale(workspace) == {}
    (project / "track.csv").write_text("changed")
    assert "--images" not in stale(workspace)["ingest"]
