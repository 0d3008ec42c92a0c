"""The package that users install: built, installed in an environment of its own, and used without this checkout."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import threading
import urllib.request
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

import pipelines
from pipelines.core.version import PACKED, described_commit
from tests.environments import make_environment, site_packages, without_python

REPOSITORY = Path(__file__).parents[1]
PATIENCE_S = 300.0
pytestmark = pytest.mark.slow

# Refuses the checkout's files to the program and to its child processes. Libraries may lie in its .venv.
WITHOUT_CHECKOUT = """
import os, sys
checkout, libraries = {checkout!r}, {libraries!r}
def refuse(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], (str, bytes, os.PathLike)):
        path = os.path.abspath(os.fsdecode(arguments[0]))
        if path.startswith(checkout + os.sep) and not path.startswith(libraries):
            raise PermissionError(f"outside the package: {{path}}")
sys.addaudithook(refuse)
"""


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the source package and of the wheel that is built from it; GEOREF_PACKAGES names one to test."""
    if named := os.environ.get("GEOREF_PACKAGES"):
        return REPOSITORY / named
    folder = tmp_path_factory.mktemp("packages")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, REPOSITORY], folder)
    return folder


@pytest.fixture(scope="module")
def installed(packages: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of an environment with the wheel, beside the libraries of this one."""
    folder = tmp_path_factory.mktemp("installed")
    programs = make_environment(folder / "venv")
    site = site_packages(folder / "venv")
    with zipfile.ZipFile(only(packages, "*.whl")) as wheel:
        wheel.extractall(site)
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    guard = WITHOUT_CHECKOUT.format(checkout=str(REPOSITORY), libraries=tuple(libraries))
    (site / "sitecustomize.py").write_text(guard, encoding="utf-8")
    return programs


def only(folder: Path, pattern: str) -> Path:
    (found,) = folder.glob(pattern)
    return found


def run(words: Sequence[object], folder: Path) -> str:
    """Run a command there, without this process's path of modules, and return what it printed."""
    done = subprocess.run(
        list(map(str, words)), cwd=folder, env=without_python(), check=False, capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


def test_the_checkout_is_out_of_reach(installed: Path, tmp_path: Path) -> None:
    """Otherwise the test below would prove nothing."""
    read = f"import pathlib; pathlib.Path({str(REPOSITORY / 'README.md')!r}).read_text()"
    words = [str(installed / "python"), "-c", read]
    done = subprocess.run(words, cwd=tmp_path, env=without_python(), check=False, capture_output=True, text=True)
    assert "outside the package" in done.stderr
    place = run([installed / "python", "-c", "import pipelines; print(pipelines.__file__)"], tmp_path)
    assert Path(place.strip()).is_relative_to(installed.parent)


def georef(installed: Path) -> tuple[object, ...]:
    return installed / "python", "-c", "from georef_cli.main import main; main()"


def test_wheel_holds_every_file_of_the_packages(packages: Path) -> None:
    tracked = run(["git", "ls-files", "georef_cli", "pipelines"], REPOSITORY).split()
    with zipfile.ZipFile(only(packages, "*.whl")) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}
        commit = wheel.read(PACKED).decode().strip()
        (scripts,) = (wheel.read(name).decode() for name in wheel.namelist() if name.endswith("entry_points.txt"))
    assert held == {*tracked, PACKED}
    assert commit == described_commit(REPOSITORY)
    assert "georef = georef_cli.main:main" in scripts
    with tarfile.open(only(packages, "*.tar.gz")) as source:
        assert {name.partition("/")[2] for name in source.getnames()} >= {*held, "LICENSE", "README.md", "setup.py"}


def test_a_flight_without_the_checkout(installed: Path, tmp_path: Path) -> None:
    """Simulated, run to report and rasters, and shown: each of them reads files that lie in the package."""
    about = f"georef {pipelines.__version__} ({described_commit(REPOSITORY)})\n"
    assert run([*georef(installed), "--version"], tmp_path) == about
    layout = ("--flight", "grid", "--height", 60, "--radius", 10, "--targets", 12, "--control", 4)
    small = ("--images", 9, "--size", "200x150", "--samples", 1)
    run([*georef(installed), "simulate", "survey", *small, *layout], tmp_path)
    inputs = ("--images", "survey/images", "--trajectory", "survey/trajectory.csv", "--gcp", "survey/gcp_list.txt")
    effort = ("--preset", "smoke", "--iterations", 40, "--deliver", "raster,report")
    run([*georef(installed), "run", "ws", *inputs, *effort, "--json"], tmp_path)
    assert (tmp_path / "ws/raster/orthophoto.tif").stat().st_size > 1000
    assert "<html" in (tmp_path / "ws/report/report.html").read_text(encoding="utf-8")
    assert pipelines.__version__ in (tmp_path / "ws/report/report.html").read_text(encoding="utf-8")
    words = [*map(str, georef(installed)), "view", "ws", "--json"]
    viewer = subprocess.Popen(words, cwd=tmp_path, env=without_python(), stdout=subprocess.PIPE, text=True)
    ended = threading.Timer(PATIENCE_S, viewer.kill)
    ended.start()
    try:
        assert viewer.stdout is not None
        text = viewer.stdout.readline()
        while not text.rstrip().endswith("}"):
            line = viewer.stdout.readline()
            assert line, "the viewer ended"
            text += line
        with urllib.request.urlopen(json.loads(text)["address"], timeout=PATIENCE_S) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read()
    finally:
        ended.cancel()
        viewer.kill()
        viewer.wait()
