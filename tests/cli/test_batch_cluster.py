"""`georef batch --cluster` on a scheduler and two workers that are killed; fake stages count their steps."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.core.lock import WriteLock
from pipelines.core.options import read_requests
from pipelines.core.workspace import Workspace
from tests import fakes
from tests.cli_runs import Result, start
from tests.clusters import RunningCluster, finish_patiently, running_cluster, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")]

STEPS = 40
# A training that keeps its count in a checkpoint, and tells every step in a file beside its workspace.
COUNTING = f"""
import time
from pipelines.core.stages import BY_NAME
from tests import fakes
def train(stage, options):
    checkpoint, steps = stage.out / "checkpoint", stage.workspace.root / "steps"
    done = int(checkpoint.read_text()) if stage.resumed else 0
    with stage.progress.task("training", {STEPS}) as task:
        for step in range(done, {STEPS}):
            time.sleep(0.05)
            with steps.open("a") as handle: handle.write(f"{{step}}\\n")
            (stage.out / "draft").write_text(str(step + 1))
            (stage.out / "draft").replace(checkpoint)
            stage.record_progress(f"{{step + 1}} of {STEPS} iterations")
            task.advance()
    return fakes.fake_run(BY_NAME["train"])(stage, options)
fakes.install(train=train)
from georef_cli.main import main
main()
"""
PLAIN = "from georef_cli.main import main; main()"


def write_missions(folder: Path, *names: str) -> Path:
    for name in names:
        fakes.photographs(folder / name / "images")
    return folder


def steps_of(workspace: Path) -> list[int]:
    path = workspace / "steps"
    return [int(line) for line in path.read_text().split()] if path.exists() else []


def batch(cluster: RunningCluster, missions: Path, *more: str) -> subprocess.Popen[str]:
    return start("batch", missions, "--to", "train", "--json", *cluster.words, *more, code=PLAIN)


def assert_complete(ended: Result, missions: Path, *names: str, again: int) -> None:
    """Each mission has taken every step, and at most `again` of them twice."""
    assert ended.code == 0, ended.err
    assert {row["state"] for row in ended.document["missions"]} <= {"done", "current"}
    for name in names:
        steps = steps_of(missions / name)
        assert sorted(set(steps)) == list(range(STEPS))
        assert len(steps) - STEPS <= again, f"{name}: {steps}"


def test_killed_workers(tmp_path: Path) -> None:
    """Both workers at once, in the middle of their trainings; their nannies start new ones."""
    missions = write_missions(tmp_path / "missions", "a", "b", "c")
    with running_cluster(tmp_path, COUNTING) as cluster:
        process = batch(cluster, missions)
        wait_until(lambda: all(len(steps_of(missions / name)) > 3 for name in "ab"), "two begin")
        for worker in cluster.worker_processes():
            os.kill(worker, signal.SIGKILL)
        ended = finish_patiently(process)
    assert_complete(ended, missions, "a", "b", "c", again=1)
    assert ended.err.count("its worker was lost") == 2


def test_killed_engine(tmp_path: Path) -> None:
    """The jobs stop by themselves; the same command goes on with what is missing."""
    missions = write_missions(tmp_path / "missions", "a", "b", "c")
    with running_cluster(tmp_path, COUNTING) as cluster:
        process = batch(cluster, missions)
        wait_until(lambda: len(steps_of(missions / "c")) > 3, "the third begins when one has ended")
        process.kill()
        process.communicate()
        wait_until(lambda: all(WriteLock(missions / name).activity() is None for name in "abc"), "the jobs stop")
        missing = [name for name in "abc" if len(steps_of(missions / name)) < STEPS]
        assert "c" in missing and len(missing) < 3
        ended = finish_patiently(batch(cluster, missions))
    assert_complete(ended, missions, "a", "b", "c", again=1)
    states = {row["mission"]: row["state"] for row in ended.document["missions"]}
    assert [name for name in "abc" if states[name] == "done"] == missing


def test_killed_scheduler(tmp_path: Path) -> None:
    """Its workers end with it. After a new start, the same command goes on with what is missing."""
    missions = write_missions(tmp_path / "missions", "a", "b", "c")
    with running_cluster(tmp_path, COUNTING) as cluster:
        process = batch(cluster, missions)
        wait_until(lambda: len(steps_of(missions / "c")) > 3, "the third begins when one has ended")
        cluster.scheduler.kill()
        lost = finish_patiently(process)
        lost.assert_failed(1)
        assert lost.document["error"]["code"] == "scheduler-lost"
        table = json.loads((missions / "missions.batch.json").read_text("utf-8"))
        assert {row["state"] for row in table["missions"]} == {"done", "interrupted"}
        wait_until(lambda: all(WriteLock(missions / name).activity() is None for name in "abc"), "the jobs stop")
        cluster.restart()
        ended = finish_patiently(batch(cluster, missions))
    assert_complete(ended, missions, "a", "b", "c", again=1)


def test_a_worker_that_closes_hands_its_job_on(tmp_path: Path) -> None:
    """As when the time of a machine is over: nothing is lost, and the mission goes on elsewhere."""
    missions = write_missions(tmp_path / "missions", "a")
    with running_cluster(tmp_path, COUNTING, workers=1) as cluster:
        process = batch(cluster, missions)
        wait_until(lambda: len(steps_of(missions / "a")) > 3, "it begins")
        cluster.start_worker("late")
        cluster.wait_for_workers(2)
        cluster.workers[0].send_signal(signal.SIGTERM)
        ended = finish_patiently(process)
    assert_complete(ended, missions, "a", again=0)


def test_a_mission_that_always_crashes_is_named(tmp_path: Path) -> None:
    """The others finish, and the exit code is 1."""
    crashing = COUNTING.replace(
        "    checkpoint, steps",
        "    if stage.workspace.root.name == 'b': import os; os.abort()\n    checkpoint, steps",
    )
    missions = write_missions(tmp_path / "missions", "a", "b", "c")
    with running_cluster(tmp_path, crashing) as cluster:
        ended = finish_patiently(batch(cluster, missions))
    assert ended.code == 1
    rows = {row["mission"]: row for row in ended.document["missions"]}
    assert {name: row["state"] for name, row in rows.items()} == {"a": "done", "b": "failed", "c": "done"}
    assert "failed 3 times" in rows["b"]["failure"] and "SIGABRT" in rows["b"]["failure"]


def test_ctrl_c_keeps_the_work(tmp_path: Path) -> None:
    missions = write_missions(tmp_path / "missions", "a", "b")
    with running_cluster(tmp_path, COUNTING) as cluster:
        process = batch(cluster, missions)
        wait_until(lambda: all(len(steps_of(missions / name)) > 3 for name in "ab"), "both begin")
        process.send_signal(signal.SIGINT)
        stopped = finish_patiently(process)
        assert stopped.code == 130, stopped.err
        table = json.loads((missions / "missions.batch.json").read_text("utf-8"))
        assert [row["state"] for row in table["missions"]] == ["interrupted"] * 2
        ended = finish_patiently(batch(cluster, missions))
    assert_complete(ended, missions, "a", "b", again=1)
    with contextlib.suppress(FileNotFoundError):
        assert not [path for path in missions.iterdir() if path.name.startswith(".georef")]


def checkpoints_below(folder: Path) -> int:
    """Trainings that have written one; a walk, as a glob fails where a worker deletes a folder under it."""
    walk = os.walk(folder)
    return sum(Path(parent).name == "train.partial" and "checkpoint" in files for parent, _, files in walk)


def test_files_go_through_a_storage(tmp_path: Path) -> None:
    """The workers see nothing but the store; a mission whose engine was killed goes on from its checkpoint."""
    missions, store = write_missions(tmp_path / "missions", "a", "b"), ("--storage", (tmp_path / "store").as_uri())
    # On a busy machine one job begins seconds after the other.
    slowly = COUNTING.replace("time.sleep(0.05)", "time.sleep(0.2)")
    listed = missions / "valley.toml"
    listed.write_text('[missions.one]\nimages = "a/images"\n[missions.two]\nimages = "b/images"\n', "utf-8")
    with running_cluster(tmp_path, slowly) as cluster:
        process = batch(cluster, listed, *store)
        scratch = tmp_path / "scratch"
        wait_until(lambda: checkpoints_below(scratch) == 2, "both begin")
        process.kill()
        process.communicate()
        wait_until(lambda: not any("train.partial" in names for _, names, _ in os.walk(scratch)), "the jobs stop")
        assert not (missions / "one").exists()
        ended = finish_patiently(batch(cluster, listed, *store))
        assert not list(scratch.glob("**/ingest")), "nothing is left on the workers"
    assert_complete(ended, missions, "one", "two", again=0)
    made = Workspace(missions / "one")
    assert read_requests(made.root)["ingest"]["images"] == str(missions / "a/images"), "paths of this machine"
    planned = finish_patiently(start("batch", listed, "--to", "train", "--dry-run", "--json", code=PLAIN)).document
    assert all(set(row["stages"].values()) == {"keep"} for row in planned["missions"])
