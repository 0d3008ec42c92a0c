"""`georef batch` with fake stages: six missions, one of them broken; Ctrl-C; what would be run."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from html.parser import HTMLParser
from pathlib import Path

import pytest

from pipelines.core import child
from pipelines.core.lock import WriteLock
from pipelines.core.options import read_requests
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from tests import fakes
from tests.cli_runs import WITH_FAKES, Georef, start
from tests.photos import write_flight

NAMES = ("north", "south", "east", "west", "mill", "broken")
LAST = "sfm"
STUCK = """
import time
from tests import fakes
def train(stage, options):
    with stage.progress.task("training", 1000) as task:
        for _ in range(1000):
            task.advance(note="20.0 dB")
            stage.record_progress("1 of 1000 iterations")
            time.sleep(0.05)
fakes.install(train=train)
from georef_cli.main import main
main()
"""


@pytest.fixture
def with_fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fake stages in the processes of the missions."""
    monkeypatch.setattr(child, "THIS_PROGRAM", ("-c", WITH_FAKES))


def write_missions(folder: Path) -> Path:
    """Six missions: `broken` names photographs that there are not, and `mill` differs from the others."""
    for name in NAMES:
        if name != "broken":
            write_flight(folder / "photos" / name, 3)
    tables = {name: f'[missions.{name}]\nimages = "photos/{name}"\n' for name in NAMES}
    tables["mill"] += 'workspace = "more/mill"\nseed = 9\n[missions.mill.sfm]\nmapper = "global"\n'
    path = folder / "valley.toml"
    defaults = f'[defaults]\nseed = 7\nto = "{LAST}"\n[defaults.ingest]\ntest_every = 3\n'
    path.write_text(defaults + "".join(tables.values()), "utf-8")
    return path


class Rows(HTMLParser):
    """Texts of the cells of a page's rows."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: object) -> None:
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th") and self.rows:
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data.strip()


@pytest.mark.slow
def test_a_broken_one_is_told_and_the_others_finish(real_georef: Georef, with_fakes: None, tmp_path: Path) -> None:
    path = write_missions(tmp_path)
    dry = real_georef("batch", path, "--dry-run", "--json")
    assert dry.code == 1, "the dry run ends as the run does"
    planned = {row["mission"]: row for row in dry.document["missions"]}
    assert set(planned["north"]["stages"].values()) == {"run"} and not (tmp_path / "north").exists()
    assert "photos/broken" in planned["broken"]["refusal"]
    first = real_georef("batch", path, "--json", "--at-a-time", 3)
    assert first.code == 1
    rows = {row["mission"]: row for row in first.document["missions"]}
    states = {name: row["state"] for name, row in rows.items()}
    assert states == {**dict.fromkeys(NAMES, "done"), "broken": "failed"}
    assert "ingest: " in rows["broken"]["failure"] and "photos/broken" in rows["broken"]["failure"]
    made = {name: Workspace(tmp_path / row["workspace"]).manifest(BY_NAME["sfm"]) for name, row in rows.items()}
    assert {
        name: made_by and (made_by.config["seed"], made_by.config["mapper"]) for name, made_by in made.items()
    } == {
        **dict.fromkeys(NAMES, (7, "auto")),
        "mill": (9, "global"),
        "broken": None,
    }
    assert read_requests(tmp_path / "north")["ingest"]["test_every"] == 3
    assert not (tmp_path / "north/calibrate").exists(), "the last stage is sfm"
    assert "ingest: started" in (tmp_path / "north/logs/ingest.log").read_text("utf-8")
    assert json.loads((tmp_path / "valley.batch.json").read_text("utf-8")) == first.document
    page = Rows(tmp_path / "valley.batch.html")
    assert {row[0]: row[1][1:] for row in page.rows if row and row[0] in NAMES} == states

    fakes.photographs(tmp_path / "photos/broken")
    second = real_georef("batch", path)
    assert second.code == 0, second.err
    assert [line.split()[:2] for line in second.out.splitlines()[1:7]] == [
        *([name, "current"] for name in NAMES[:-1]),
        ["broken", "done"],
    ]
    assert "broken: started" in second.err and "north: started" not in second.err


@pytest.mark.skipif(sys.platform == "win32", reason="no process can be sent SIGINT")
@pytest.mark.slow
def test_ctrl_c_stops_all_and_the_same_command_goes_on(
    real_georef: Georef, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Both trainings have work to lose, which they keep: the next call would resume them."""
    monkeypatch.setattr(child, "THIS_PROGRAM", ("-c", STUCK))
    names = ("a", "b")
    for name in names:
        fakes.photographs(tmp_path / name / "images")

    def interrupt() -> None:
        deadline = time.monotonic() + 60
        begun = [tmp_path / name / "train.partial/progress.txt" for name in names]
        while not all(path.exists() for path in begun) and time.monotonic() < deadline:
            time.sleep(0.02)
        if all(path.exists() for path in begun):
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt).start()
    words = ("batch", tmp_path, "--to", "train")
    ended = real_georef(*words)
    assert ended.code == 130
    assert ended.err.splitlines()[-1].startswith("interrupted") and "same command" in ended.err
    table = json.loads((tmp_path / f"{tmp_path.name}.batch.json").read_text("utf-8"))
    assert [row["state"] for row in table["missions"]] == ["interrupted"] * 2
    assert all(WriteLock(tmp_path / name).activity() is None for name in names), "no process is left behind"
    planned = real_georef(*words, "--dry-run", "--json").document["missions"]
    assert [row["stages"]["train"] for row in planned] == ["resume"] * 2
    text = real_georef(*words, "--dry-run").out
    assert "a " in text and "train" in text and "Nothing was run" in text


@pytest.mark.skipif(sys.platform == "win32", reason="pipes end otherwise there")
@pytest.mark.slow
def test_a_mission_stops_when_nobody_follows_it(tmp_path: Path) -> None:
    """The batch was killed: its missions save their work and end, also one that has nothing to tell."""
    photos = fakes.photographs(tmp_path / "photos")
    words = ("run", tmp_path / "ws", "--images", photos, "--to", "train", "--json-progress")
    process = start(*words, code=STUCK.replace('task.advance(note="20.0 dB")', "pass"))
    deadline = time.monotonic() + 60
    while not (tmp_path / "ws/train.partial/progress.txt").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    assert process.stderr is not None and process.stdout is not None
    process.stderr.close()
    assert process.wait(timeout=30) != 0
    process.stdout.close()
    assert (tmp_path / "ws/train.partial/progress.txt").exists()
    assert "KeyboardInterrupt" in (tmp_path / "ws/logs/train.log").read_text("utf-8")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--at-a-time", 0], 2, "--at-a-time"),
        (["--deliver", "rasters"], 2, "--deliver"),
        (["--set", "train.sh_degree"], 2, "stage.option=value"),
        (["--set", "train.degree=1"], 2, "train has no option 'degree'"),
        (["--set", "training.sh_degree=1"], 2, "'training' is not among the stages"),
    ],
)
def test_bad_options_are_refused(
    real_georef: Georef, tmp_path: Path, words: list[object], code: int, message: str
) -> None:
    path = write_missions(tmp_path)
    result = real_georef("batch", path, *words)
    result.assert_failed(code)
    assert message in result.err
    assert not (tmp_path / "valley.batch.json").exists()


def test_settings_reach_their_stage(georef: Georef, workspace: Workspace, photos: Path) -> None:
    """Texts of TOML, plain texts and paths, which become absolute."""
    words = ("--set", "sfm.seed=4", "--set", 'sfm.mapper="global"', "--set", "ingest.vertical=ellipsoidal")
    assert georef("run", workspace.root, "--images", photos, "--to", "sfm", *words).code == 0
    requests = read_requests(workspace.root)
    assert requests["sfm"] == {"seed": 4, "mapper": "global"}
    assert requests["ingest"] == {"images": str(photos), "vertical": "ellipsoidal"}
    of_later = georef("run", workspace.root, "--to", "sfm", "--set", "train.seed=4")
    assert of_later.code == 0 and "train.seed" in of_later.err  # named, and no error: the same command serves both
    assert "train" not in read_requests(workspace.root)
    assert georef("run", workspace.root, "--to", "sfm", "--set", "trainer.seed=4").code == 2
    assert georef("run", workspace.root, "--set", "train.sh_degree=9").code == 2
