"""The commands of the documents, run as they stand there, in an empty folder with a tiny simulated survey.

Only two things are added: `georef.toml` makes the training tiny, and simulated surveys are small.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

REPOSITORY = Path(__file__).parents[2]
GEOREF = (sys.executable, "-c", "from georef_cli.main import main; main()")
SURVEY = "--images 12 --size 240x180 --samples 1 --flight grid --height 60 --radius 15 --targets 12 --control 4"
SMALL = "--images 4 --size 96x72 --samples 1"
TINY = "[train]\niterations = 150\nmax_image_size = 240\nmax_gaussians = 20000\n[export-raster]\nmin_views = 2\n"


def commands_of(document: str) -> list[list[str]]:
    """Return the calls of georef in the blocks of a document, in order."""
    text = (REPOSITORY / document).read_text("utf-8")
    blocks = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    lines = re.sub(r"\\\n\s*", " ", blocks).splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line and Path(line[0]).name == "georef"]


def call(arguments: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run georef; end a viewer as a user does once it is there."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "BROWSER": "true"}
    with subprocess.Popen(
        [*GEOREF, *arguments],
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        if arguments[0] == "view":
            assert process.stdout is not None
            assert "http://127.0.0.1:" in process.stdout.readline()
            time.sleep(3)
            process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=900)
    return subprocess.CompletedProcess(arguments, process.returncode, out, err)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the documents speak of: photographs, a trajectory, control and check points, bags."""
    root = tmp_path_factory.mktemp("documented")
    assert call(["simulate", "own", *shlex.split(SURVEY), "--bag", "mcap"], root).returncode == 0
    for name, target in (
        ("photos", "own/images"),
        ("track.csv", "own/trajectory.csv"),
        ("gcp_list.txt", "own/gcp_list.txt"),
        ("checkpoints.txt", "own/checkpoints.txt"),
        ("flight_bag", "own/bag"),
    ):
        (root / name).symlink_to(root / target)
    (root / "www").mkdir()
    (root / "px4.mcap").symlink_to(next((root / "own/bag").glob("*.mcap")))
    return root


@pytest.mark.parametrize("document", ["README.md", "docs/deliverables.md", "docs/viewer.md"])
def test_commands_of_a_flight_run(folder: Path, document: str) -> None:
    (folder / "flight").mkdir(exist_ok=True)
    (folder / "flight/georef.toml").write_text(TINY, "utf-8")
    calls = commands_of(document)
    assert calls
    for arguments in calls:
        done = call(arguments, folder)
        assert done.returncode == 0, f"georef {shlex.join(arguments)}\n{done.stdout}\n{done.stderr}"


@pytest.mark.parametrize("document", ["docs/bags.md", "docs/simulator.md"])
def test_commands_on_simulated_surveys_and_bags_run(folder: Path, document: str) -> None:
    for number, arguments in enumerate(commands_of(document)):
        small = [*arguments, *shlex.split(SMALL)] if arguments[0] == "simulate" else arguments
        # Each block has a flight of its own.
        own = [f"flight{number}" if word == "flight" else word for word in small]
        if own[0] == "simulate":
            own.append("--force")
        if own[0] == "run":
            (folder / own[1]).mkdir(exist_ok=True)
            (folder / own[1] / "georef.toml").write_text(TINY, "utf-8")
            own += ["--to", "ingest"]  # these surveys are too small for more
        done = call(own, folder)
        assert done.returncode == 0, f"georef {shlex.join(own)}\n{done.stdout}\n{done.stderr}"
