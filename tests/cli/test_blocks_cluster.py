"""`georef train --blocks --cluster` on a scheduler and two workers that are killed: blocks of a small field."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.core.lock import WriteLock
from pipelines.core.products import load_json
from pipelines.core.stages import BLOCK_RECORD
from pipelines.core.workspace import Workspace
from pipelines.survey.block_plan import BlockRecord
from tests.block_scenes import make_field, write_field
from tests.cli_runs import Result, start
from tests.clusters import RunningCluster, finish_patiently, running_cluster, wait_until

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")]

BLOCKS, ITERATIONS, CHECKPOINT = 4, 240, 20
OPTIONS = (
    *("--blocks", BLOCKS, "--iterations", ITERATIONS, "--checkpoint-every", CHECKPOINT, "--log-every", 1),
    *(
        "--max-gaussians",
        1500,
        "--max-image-size",
        96,
        "--sh-degree",
        0,
        "--no-geometry-regularisation",
        "--no-dense",
    ),
)
PLAIN = "from georef_cli.main import main; main()"


@pytest.fixture
def field(tmp_path: Path) -> Workspace:
    return write_field(tmp_path / "field", make_field(5, 3, points=400, test_views=(7,)))


def blocks(cluster: RunningCluster, field: Workspace) -> subprocess.Popen[str]:
    return start("train", field.root, *OPTIONS, *cluster.words, code=PLAIN)


def begun(field: Workspace) -> dict[int, int]:
    """Iterations so far of the blocks that are in training, by number."""
    counts = {}
    for number in range(BLOCKS):
        path = field.root / f"blocks/{number}/block.partial/metrics.jsonl"
        if path.is_file() and (lines := path.read_text("utf-8").count("\n")) > CHECKPOINT:
            counts[number] = lines
    return counts


def finished(field: Workspace) -> dict[int, int]:
    """Times of the records of the finished blocks, by number."""
    records = {number: field.root / f"blocks/{number}/block/record.json" for number in range(BLOCKS)}
    return {number: path.stat().st_mtime_ns for number, path in records.items() if path.is_file()}


def resumed(field: Workspace, number: int) -> list[int]:
    """Iterations at which a block went on after an interruption."""
    log = (field.root / f"blocks/{number}/logs/block.log").read_text("utf-8")
    return [int(found) for found in re.findall(r"resumed at iteration (\d+)", log)]


def assert_complete(ended: Result, field: Workspace) -> None:
    assert ended.code == 0, ended.err
    assert sorted(finished(field)) == list(range(BLOCKS))
    record = load_json(BlockRecord, field.path(BLOCK_RECORD))
    assert [block.training.iterations for block in record.blocks] == [ITERATIONS] * BLOCKS


def test_a_killed_worker_loses_no_more_than_a_checkpoint(tmp_path: Path, field: Workspace) -> None:
    with running_cluster(tmp_path, PLAIN) as cluster:
        process = blocks(cluster, field)
        wait_until(lambda: len(begun(field)) == 2, "two blocks are in training")
        for worker in cluster.worker_processes():
            os.kill(worker, signal.SIGKILL)
        done = begun(field)
        ended = finish_patiently(process)
    assert_complete(ended, field)
    assert ended.err.count("its worker was lost") == 2
    for number, iteration in done.items():
        # An iteration may run on for a moment until the job notices that its worker is gone.
        assert len(at := resumed(field, number)) == 1 and at[0] >= iteration - CHECKPOINT, (number, iteration, at)


def test_a_killed_driver_leaves_only_what_is_missing(tmp_path: Path, field: Workspace) -> None:
    with running_cluster(tmp_path, PLAIN) as cluster:
        process = blocks(cluster, field)
        wait_until(lambda: bool(finished(field)) and bool(begun(field)), "one block is done, another in training")
        process.kill()
        process.communicate()
        in_training = [Workspace(field.root / f"blocks/{number}") for number in begun(field)]
        wait_until(lambda: all(WriteLock(block.root).activity() is None for block in in_training), "the jobs stop")
        kept, stopped = finished(field), begun(field)
        ended = finish_patiently(blocks(cluster, field))
    assert_complete(ended, field)
    assert kept.items() <= finished(field).items(), "a finished block was trained again"
    assert all(len(resumed(field, number)) == 1 for number in stopped)


def test_a_block_that_always_crashes_is_named(tmp_path: Path, field: Workspace) -> None:
    """The others finish, and the exit code is 1."""
    crashing = f"import os, sys\nif '--part 2' in ' '.join(sys.argv): os.abort()\n{PLAIN}"
    with running_cluster(tmp_path, crashing) as cluster:
        ended = finish_patiently(blocks(cluster, field))
    ended.assert_failed(1)
    assert "block 2" in ended.err and "failed 3 times" in ended.err and "SIGABRT" in ended.err
    assert sorted(finished(field)) == [0, 1, 3]
    assert not (field.root / "train").exists()
