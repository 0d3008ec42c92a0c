"""Mutation fuzzer of every reader: `python -m tests.fuzz` for an hour, `--replay READER:CASE` for one case.

A mutated file parses, or is refused by a `GeorefError`. Any other exception, a crash, ten seconds of computing or
more than a gibibyte of further memory is a finding; it is printed as a line of JSON with the case that repeats it.
A case is a number: the seed of its mutation. Each reader runs in a process of its own, which a finding ends.
"""

from __future__ import annotations

import argparse
import gc
import json
import logging
import os
import random
import resource
import selectors
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import GeorefError
from tests.fuzz.mutations import mutated
from tests.fuzz.readers import READERS, Reader

LIMIT_S = 10  # of computing; a reader that waits gets more, since other programs may have the processor
LIMIT_WAITING_S = 60
LIMIT_BYTES = 1024**3
BLOCK = 200  # cases of a process


@dataclass(frozen=True)
class Finding:
    """A case that is neither read nor refused."""

    reader: str
    case: int
    file: str
    problem: str


def main() -> int:
    """Fuzz, print the findings and return 1 if there are any."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=float(os.environ.get("FUZZ_SECONDS", "3600")))
    parser.add_argument("--cases", type=int, help="of each reader, instead of a time")
    parser.add_argument(
        "--slow", type=int, default=BLOCK // 4, help="cases of slow readers, for each 200 of others"
    )
    parser.add_argument("--first", type=int, help="first case; without it every run has new ones")
    parser.add_argument("--reader", action="append", choices=READERS)
    parser.add_argument("--replay", metavar="READER:CASE", help="repeat a case, with its traceback")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    if arguments.replay:
        name, _, case = arguments.replay.partition(":")
        return _replay(name, int(case))
    names = arguments.reader or list(READERS)
    deadline = time.monotonic() + arguments.seconds
    first = time.time_ns() if arguments.first is None else arguments.first
    counts, done = Counter[str](), 0
    while done < arguments.cases if arguments.cases else time.monotonic() < deadline:
        size = min(BLOCK, arguments.cases - done) if arguments.cases else BLOCK
        blocks = [
            (name, range(first + done, first + done + (min(size, arguments.slow) if READERS[name].slow else size)))
            for name in names
        ]
        for finding in _findings(blocks):
            counts[finding.reader] += 1
            print(json.dumps(vars(finding)), flush=True)
        done += size
    print(
        f"{done} cases of each of {len(names)} readers, {counts.total()} findings {dict(counts)}", file=sys.stderr
    )
    return 1 if counts else 0


def _findings(blocks: list[tuple[str, range]]) -> Iterator[Finding]:
    """Run the cases of readers in child processes; a new one begins behind each case that ended the last.

    This process has one thread, so that no child begins with a lock that another thread held.
    """
    waiting, running = list(reversed(blocks)), selectors.DefaultSelector()
    while waiting or running.get_map():
        while waiting and len(running.get_map()) < (os.cpu_count() or 1):
            name, cases = waiting.pop()
            child = _start(name, cases)
            running.register(child.reading, selectors.EVENT_READ, child)
        for key, _ in running.select():
            child = key.data
            data = os.read(child.reading, 65536)
            child.output += data
            if data:
                continue
            running.unregister(child.reading)
            done, problem = _ended(child)
            if problem:
                case = child.cases[done]
                yield Finding(child.name, case, _file(child.name, case), problem)
                if child.cases[done + 1 :]:
                    waiting.append((child.name, child.cases[done + 1 :]))


@dataclass
class _Child:
    name: str
    cases: range
    pid: int
    reading: int
    output: bytes = b""


def _start(name: str, cases: range) -> _Child:
    """Begin a child process that runs cases until one is a finding."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reading)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        try:
            signal.alarm(LIMIT_WAITING_S)  # also for the valid files
            _limit_memory()
            with _folder(name) as folder:
                for case in cases:
                    problem = _run(READERS[name], folder, name, case)
                    os.write(writing, json.dumps(problem).encode() + b"\n")
                    if problem:
                        break
        finally:
            os._exit(0)
    os.close(writing)
    return _Child(name, cases, pid, reading)


def _ended(child: _Child) -> tuple[int, str]:
    """Return the place of a child's finding among its cases and the problem, empty if there is none."""
    os.close(child.reading)
    problems = [json.loads(line) for line in child.output.splitlines(keepends=True) if line.endswith(b"\n")]
    _, status = os.waitpid(child.pid, 0)
    if problems and problems[-1]:
        return len(problems) - 1, problems[-1]
    if len(problems) == len(child.cases):
        return len(child.cases), ""
    code = os.waitstatus_to_exitcode(status)
    if -code in (signal.SIGALRM, signal.SIGPROF):
        return len(problems), f"hangs: {signal.Signals(-code).name}"
    return len(problems), f"ends the process: {signal.Signals(-code).name if code < 0 else f'exit code {code}'}"


def _run(reader: Reader, folder: Path, name: str, case: int) -> str:
    """Read the folder with one mutated file; return the problem, empty if there is none."""
    file = _target(reader, folder, name, case)
    original = file.read_bytes()
    file.write_bytes(mutated(original, random.Random(f"{name}:{case}")))
    signal.setitimer(signal.ITIMER_PROF, LIMIT_S)
    signal.alarm(LIMIT_WAITING_S)
    try:
        reader.read(folder)
    except GeorefError:
        pass
    except BaseException as error:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/pipelines/" in frame.filename]
        places = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames[-2:]]
        return f"{type(error).__name__}: {str(error)[:200]} ({' '.join(places)})"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        file.write_bytes(original)
    return ""


def _target(reader: Reader, folder: Path, name: str, case: int) -> Path:
    files = sorted(path for path in folder.glob(reader.files) if path.is_file())
    return random.Random(f"file:{name}:{case}").choice(files)


def _file(name: str, case: int) -> str:
    with _folder(name) as folder:
        return _target(READERS[name], folder, name, case).relative_to(folder).as_posix()


@contextmanager
def _folder(name: str) -> Iterator[Path]:
    """Yield a folder with the valid files of a reader."""
    path = Path(tempfile.mkdtemp(prefix="fuzz"))
    try:
        READERS[name].prepare(path)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _limit_memory() -> None:
    gc.freeze()
    used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + LIMIT_BYTES, used + LIMIT_BYTES))


def _replay(name: str, case: int) -> int:
    with _folder(name) as folder:
        file = _target(READERS[name], folder, name, case)
        file.write_bytes(mutated(file.read_bytes(), random.Random(f"{name}:{case}")))
        kept = Path(tempfile.gettempdir()) / f"{name}-{case}-{file.name}"
        shutil.copy(file, kept)
        print(f"mutated: {kept}")
        try:
            print("read:", READERS[name].read(folder))
        except GeorefError as error:
            print("refused:", error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
