"""Python files beside the photographs are never run, however the program and its children are started."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from pipelines.core import child
from pipelines.splat.kernel_cache import cache_folder
from tests.block_scenes import make_field, write_field
from tests.cli_runs import REPOSITORY, finish
from tests.photos import write_flight

# Modules that this program, its libraries and Python's own start of processes import.
POISON = (
    *("asyncio", "base64", "cv2", "click", "csv", "ctypes", "distributed", "hashlib", "inspect", "json", "logging"),
    *("multiprocessing", "numba", "numpy", "pickle", "PIL", "platform", "pycolmap", "queue", "random", "select"),
    *("shutil", "signal", "socket", "struct", "subprocess", "tempfile", "threading", "torch", "traceback", "yaml"),
    *("coverage", "gsplat", "sitecustomize", "usercustomize", "spam"),
)
SCRIPT = "import sys\nfrom georef_cli.main import main\nif __name__ == '__main__':\n    sys.exit(main())\n"
MISSIONS = '[missions.lost]\nimages = "nowhere"\n'
PHOTOS = 5  # two chunks


@pytest.fixture
def poisoned(tmp_path: Path) -> Path:
    """A folder of photographs in which each module that is imported tells so in the file `witness`."""
    folder = tmp_path / "poisoned"
    write_flight(folder / "photos", PHOTOS)
    for name in POISON:
        witness = f"with open({str(folder / 'witness')!r}, 'a') as file: file.write({name!r} + '\\n')\n"
        (folder / f"{name}.py").write_text(witness, "utf-8")
    (folder / "missions.toml").write_text(MISSIONS, "utf-8")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "georef").write_text(SCRIPT, "utf-8")
    return folder


def start_in(folder: Path, *arguments: object, way: Sequence[str] = ()) -> subprocess.Popen[str]:
    """Start `georef` in a folder, by default as its installed script: with the script's folder on the path.

    Home is another, in which nobody would find the kernels that are compiled.
    """
    homes = {"HOME": str(folder.parent), "NUMBA_CACHE_DIR": str(cache_folder())}
    return subprocess.Popen(
        [sys.executable, *(way or [str(folder.parent / "bin/georef")]), *map(str, arguments)],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), **homes},
    )


def assert_not_run(folder: Path) -> None:
    witness = folder / "witness"
    assert not witness.exists(), f"run: {witness.read_text('utf-8').split()}"


@pytest.mark.slow
@pytest.mark.parametrize("way", [(), ("-P", "-m", "georef_cli"), ("-m", "georef_cli")], ids=["script", "-P", "-m"])
def test_jobs(poisoned: Path, way: Sequence[str]) -> None:
    ended = finish(start_in(poisoned, "batch", "missions.toml", "--json", way=way))
    assert_not_run(poisoned)
    assert "nowhere [--images]" in ended.document["missions"][0]["failure"], "the job told it"


@pytest.mark.slow
def test_children(poisoned: Path) -> None:
    """COLMAP's, which finds nothing in photographs of noise."""
    ended = finish(start_in(poisoned, "run", "flight", "--images", "photos", "--to", "sfm"))
    assert_not_run(poisoned)
    assert ended.code == 1 and "photographs" in ended.err.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_workers_of_a_cluster(poisoned: Path) -> None:
    """A worker is spawned by its nanny, and says that the scheduler knows it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    processes = [
        start_in(poisoned, "cluster", "scheduler", "--listen", address),
        start_in(poisoned, "cluster", "worker", address, "--gpus", 0),
    ]
    try:
        assert processes[1].stderr is not None
        said = [next(line for line in processes[1].stderr if "Registered to:" in line)]
        assert said
    finally:
        for process in reversed(processes):
            process.terminate()
            process.communicate(timeout=60)
    assert_not_run(poisoned)


@pytest.mark.slow
def test_chunks_of_a_mission(poisoned: Path) -> None:
    """A job that starts jobs, which start children."""
    missions = '[missions.found]\nimages = "photos"\n[missions.found.sfm]\nchunk_size = 4\n'
    (poisoned / "missions.toml").write_text(missions, "utf-8")
    ended = finish(start_in(poisoned, "batch", "missions.toml", "--to", "sfm", "--json"), 300)
    assert_not_run(poisoned)
    assert ended.document["missions"][0]["failure"].startswith("sfm: ")


@pytest.mark.slow
def test_blocks(poisoned: Path) -> None:
    """Trainings as jobs."""
    field = write_field(poisoned / "field", make_field(5, 3, points=400, test_views=(7,)))
    few = (
        "--max-gaussians",
        1500,
        "--max-image-size",
        96,
        "--sh-degree",
        0,
        "--no-geometry-regularisation",
        "--no-dense",
    )
    ended = finish(start_in(poisoned, "train", field.root, "--blocks", 2, "--iterations", 20, *few), 300)
    assert_not_run(poisoned)
    assert ended.code == 0, ended.err


def test_only_a_checkout_is_found_in_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its name on the path: empty, relative, absolute or a link; a checkout comes behind the libraries."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "photos")
    monkeypatch.chdir(tmp_path / "photos")
    named = ["", ".", "../photos", str(tmp_path / "photos"), str(tmp_path / "link")]
    monkeypatch.setattr(sys, "path", [*named, "/usr/lib/modules-of-a-user", *sys.path])
    path = child.python_environment()["PYTHONPATH"].split(os.pathsep)
    assert path[0] == "/usr/lib/modules-of-a-user" and not set(named) & set(path)
    monkeypatch.chdir(REPOSITORY)
    path = child.python_environment()["PYTHONPATH"].split(os.pathsep)
    assert path.index(str(REPOSITORY)) == len(path) - 1
