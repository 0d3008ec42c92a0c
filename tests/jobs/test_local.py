"""The engine of this machine: what may run beside what, and how a job ends."""

from __future__ import annotations

import signal
import sys
import time

import pytest

from pipelines.core.progress import SILENT
from pipelines.jobs.engine import Job, JobEnd
from pipelines.jobs.local import LocalEngine

# A job in place of `georef`: its first argument is Python.
PROGRAM = ("-c", "import sys; exec(sys.argv[1])")
GIB = 1 << 30
MESSAGES = """
import json, sys
def send(kind, **content): print(json.dumps({"kind": kind, **content}), file=sys.stderr)
send("begin", name="stages", total=2)
send("advance", steps=0, note="sfm", left_s=None)
print("glog: a line of a library", file=sys.stderr)
"""


def job(name: str, gib: float = 0.0, code: str = "", *, uses_gpu: bool = False) -> Job:
    return Job(name, (code,), int(gib * GIB), uses_gpu)


def ends_of(engine: LocalEngine, *jobs: Job) -> dict[str, JobEnd]:
    ends: list[JobEnd] = []
    engine.run("jobs", jobs, ends.append, SILENT)
    return {end.job.name: end for end in ends}


@pytest.mark.parametrize(
    ("at_a_time", "gib", "together"),
    [
        (9, [3, 3, 3, 3], 3),  # 0.9 × 10 GiB
        (2, [3, 3, 3, 3], 2),
        (9, [20, 1], 1),  # too large for the machine: alone
        (9, [5, 5, 4], 2),  # a smaller one passes
    ],
)
def test_as_many_as_memory_allows(at_a_time: int, gib: list[float], together: int) -> None:
    engine = LocalEngine(at_a_time, 2, 10 * GIB)
    assert engine.together([job(str(number), size) for number, size in enumerate(gib)]) == together


def test_one_at_a_time_on_a_gpu() -> None:
    jobs = [job("a", uses_gpu=True), job("b", uses_gpu=True), job("c")]
    assert LocalEngine(9, 2, None).together(jobs) == 2


def test_each_end_is_told_and_none_stops_another() -> None:
    engine = LocalEngine(2, 2, None, PROGRAM)
    ends = ends_of(
        engine,
        job("killed", code=MESSAGES + "import os, signal; os.kill(os.getpid(), signal.SIGABRT)"),
        job("failed", code=MESSAGES + "print('error: No such file.', file=sys.stderr); sys.exit(1)"),
        job("defect", code=MESSAGES + "{}['key']"),
        job("done", code=MESSAGES + "send('advance', steps=1, note='', left_s=None); send('end')"),
    )
    assert {name: (end.is_done, end.step) for name, end in ends.items()} == {
        "killed": (False, "sfm"),
        "failed": (False, "sfm"),
        "defect": (False, "sfm"),
        "done": (True, "sfm"),
    }
    assert ends["failed"].error == "No such file."
    assert ends["defect"].error == "KeyError: 'key'"
    if sys.platform != "win32":
        assert ends["killed"].code == -signal.SIGABRT
        assert "(SIGABRT)" in ends["killed"].error and ends["killed"].error.endswith("glog: a line of a library")


def test_a_job_that_cannot_be_started_stops_no_other() -> None:
    """No system takes an argument of 20 MB."""
    ends = ends_of(LocalEngine(1, 1, None, PROGRAM), job("long", code="#" * 20_000_000), job("done"))
    assert {name: end.is_done for name, end in ends.items()} == {"long": False, "done": True}
    assert ends["long"].code == 1 and "Argument list too long" in ends["long"].error


def test_an_error_of_the_caller_leaves_no_process() -> None:
    """The table of a batch may meet a full disk."""

    def fail(end: JobEnd) -> None:
        raise OSError("full")

    engine = LocalEngine(2, 2, None, PROGRAM)
    started = time.monotonic()
    with pytest.raises(OSError, match="full"):
        engine.run("jobs", [job("slow", code="import time; time.sleep(60)"), job("quick")], fail, SILENT)
    assert time.monotonic() - started < 30
