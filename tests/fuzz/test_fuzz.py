"""The fuzzer on every reader: 200 mutated files each, the same in every run.

`python -m tests.fuzz --replay READER:CASE` repeats a case.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys

import pytest

from tests.cli_runs import REPOSITORY
from tests.fuzz.mutations import mutated

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits of memory and time are those of Linux"),
]

CASES, SLOW_CASES = 120, 10


@pytest.fixture(scope="module")
def findings() -> list[dict[str, str]]:
    """Findings of all readers."""
    command = [sys.executable, "-m", "tests.fuzz", "--first", "0", "--cases", str(CASES), "--slow", str(SLOW_CASES)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    assert f"{CASES} cases of each of" in done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_every_mutated_file_is_read_or_refused(findings: list[dict[str, str]]) -> None:
    assert findings == []


def test_mutations_repeat_and_differ() -> None:
    data = bytes(range(256)) * 4
    once, again = ([mutated(data, random.Random(f"x:{case}")) for case in range(200)] for _ in range(2))
    assert once == again
    assert len(set(once)) > 190


def test_a_planted_defect_is_found() -> None:
    """Exceptions, crashes, hangs and memory: a fuzzer that finds nothing must be one that would."""
    code = """
import os, time
from tests.fuzz import __main__ as fuzz
from tests.fuzz.readers import READERS, Reader
fuzz.LIMIT_S = fuzz.LIMIT_WAITING_S = 1
def prepare(folder):
    (folder / "a").write_bytes(b"abc")
def divide():
    return 1 / 0
def compute():
    while True:
        pass
def defect(number):
    def read(folder):
        [divide, os.abort, lambda: time.sleep(9), compute, lambda: bytearray(2 * fuzz.LIMIT_BYTES)][number]()
    return Reader(prepare, read)
for number in range(5):
    READERS["planted"] = defect(number)
    print(next(fuzz._findings([("planted", range(1))])).problem.partition(":")[0])
"""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "ZeroDivisionError",
        "ends the process",
        "hangs",
        "hangs",
        "MemoryError",
    ]
