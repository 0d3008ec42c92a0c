"""Saving on a disk that fails, and by a viewer that is killed: what was there stays whole; a retry stores once."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyogrio
import pytest

from pipelines.core.errors import InputError, StorageError
from pipelines.formats.ground_points import read_ground_points
from pipelines.view.marking import CHECK, CONTROL
from pipelines.view.saved import FILES, PACKAGE, TABLES, SavedMeasurements
from tests.cli_runs import REPOSITORY
from tests.faults.injection import Disk, Kind, mounted
from tests.view.test_kept_marks import kept, marks
from tests.view.test_saved import measurement, names

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")

SAVING = """
import sys
from pathlib import Path
from tests.view.test_failing_disk import save_on
save_on(Path(sys.argv[1]))
"""


def save_on(folder: Path) -> None:
    """Save measurements and marks until somebody ends this process; print how many of each are saved."""
    saved, viewer = SavedMeasurements(folder), kept(folder)
    for number in range(10_000):
        saved.put(measurement(f"number {number}"))
        viewer.set_mark("C1", f"{number}.jpg", (number, number))
        viewer.write("EPSG:4326")
        print(number + 1, flush=True)


def faults(folder: Path, kind: Kind, act: Callable[[], object], check: Callable[[bool], None]) -> None:
    """Let each change of the disk fail once; `check` learns whether the act failed."""
    with Disk(folder).mounted() as disk:
        act()
    check(False)
    for at in range(1, len(disk.changes) + 1):
        failed = False
        with Disk(folder, kind, at).mounted():
            try:
                act()
            except (StorageError, InputError) as error:  # the latter of a lock that cannot be made
                failed = True
                assert str(folder) in str(error) and ".tmp" not in str(error)
        assert not list(folder.glob("*.tmp")), disk.changes[at - 1]
        check(failed)


@pytest.mark.parametrize("kind", ["full", "failing"])
def test_a_measurement_is_saved_once(tmp_path: Path, kind: Kind) -> None:
    saved = SavedMeasurements(tmp_path)
    saved.put(measurement("old"))
    tried = [measurement("tried")]

    def act() -> None:
        saved.put(tried[-1])

    def check(failed: bool) -> None:
        if failed and kind == "full":
            assert names(tmp_path) == [each.name for each in saved.all] == ["old"]
        act()  # the button again
        assert names(tmp_path) == [each.name for each in saved.all] == ["old", "tried"]
        assert (tmp_path / TABLES["point"]).read_text("utf-8").count("tried") == 1
        saved.remove(tried[-1])
        tried.append(measurement("tried"))

    faults(tmp_path, kind, act, check)


@pytest.mark.parametrize("kind", ["full", "failing"])
def test_marks_and_their_files_are_written_whole(tmp_path: Path, kind: Kind) -> None:
    viewer = kept(tmp_path)
    viewer.set_mark("G1", "a.jpg", None)
    viewer.write("EPSG:4326")
    before, text = marks(viewer), (tmp_path / CONTROL).read_text("utf-8")

    def act() -> None:
        viewer.set_mark("G1", "c.jpg", (5.0, 5.0))
        viewer.write("EPSG:4326")

    def check(failed: bool) -> None:
        if kind == "full":
            assert marks(kept(tmp_path)) == marks(viewer)
            if failed and marks(viewer) == before:
                assert (tmp_path / CONTROL).read_text("utf-8") == text
        act()
        assert (tmp_path / CONTROL).read_text("utf-8").count("c.jpg") == 1
        viewer.set_mark("G1", "c.jpg", None)
        viewer.write("EPSG:4326")
        assert (marks(viewer), (tmp_path / CONTROL).read_text("utf-8")) == (before, text)

    faults(tmp_path, kind, act, check)


@pytest.mark.slow
def test_a_viewer_killed_while_saving_leaves_whole_records(tmp_path: Path) -> None:
    for run, moment_s in enumerate(np.random.default_rng().uniform(0.0, 0.1, 3)):
        folder = tmp_path / str(run)
        process = subprocess.Popen(
            [sys.executable, "-c", SAVING, str(folder)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        )
        assert process.stdout is not None
        told = [process.stdout.readline() for _ in range(3)]
        time.sleep(moment_s)
        process.kill()
        told += process.stdout.readlines()
        process.wait()
        count = max(int(line) for line in told if line.endswith("\n"))
        expected = [f"number {number}" for number in range(count + 1)]
        assert names(folder) in (expected, expected[:-1])
        images = [f"{number}.jpg" for number in range(count + 1)]
        shown = list(marks(kept(folder))["C1"])
        assert shown in (images, images[:-1])
        written = [mark.image for mark in read_ground_points(folder / CHECK).marks]
        assert written in (images, images[:-1])
        SavedMeasurements(folder).put(measurement("after it"))  # nothing is in the way of the next one


def test_a_disk_that_fills_stores_a_measurement_whole_or_not_at_all(tmp_path: Path) -> None:
    """The GeoPackage is written by GDAL, past Python's files: the disk is a real one."""
    folder = tmp_path / "small"
    with mounted(folder, "700k"):
        saved, stored, refusals = SavedMeasurements(folder), ["first"], 0
        saved.put(measurement("first"))
        for free in (4096, 8192, 16384, 24576, 32768, 49152, 65536, 81920, 98304, 200_000):
            status = os.statvfs(folder)
            with (folder / "filler").open("wb") as filler:
                filler.write(bytes(max(status.f_bavail * status.f_frsize - free, 0)))
            try:
                saved.put(measurement(f"with {free}"))
                stored.append(f"with {free}")
            except StorageError as error:
                refusals += 1
                assert error.code == "storage-enospc"
            (folder / "filler").unlink()
            assert names(folder) == [each.name for each in saved.all] == stored
            _, _, shapes, _ = pyogrio.raw.read(folder / PACKAGE, layer="points")
            assert len(shapes) == len(stored)
            assert {file.name for file in folder.iterdir()} <= {*FILES, ".lock", ".lock.holder"}
        assert refusals >= 3 and stored[-1] == "with 200000"
