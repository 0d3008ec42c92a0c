"""Time two workers against one: python examples/benchmarks/cluster.py [--missions 4].

Tiny simulated missions are run by `georef batch --cluster` on a scheduler and workers of this machine, each with
one thread, first by one worker and then by two. Scheduler and workers have started before the clock does, and the
missions are the same. Needs two idle cores and the extra `cluster`.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pipelines.jobs.cluster import ClusterAddress, connected

REPOSITORY = Path(__file__).parents[2]
GEOREF = (sys.executable, "-m", "georef_cli")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
PORT = 18_790
LAYOUT = ("--images", "16", "--size", "320x240", "--samples", "1", "-q")


def make_flights(folder: Path, count: int) -> None:
    """Simulate flights that differ in their noise, and make their missions equally long."""
    for number in range(count):
        flight = folder / f"flight{number}"
        subprocess.run([*GEOREF, "simulate", flight, *LAYOUT, "--seed", str(number)], check=True, env=ENVIRONMENT)


@contextmanager
def cluster(folder: Path, workers: int) -> Iterator[ClusterAddress]:
    """Run a scheduler and workers with one thread each, while the context lasts."""
    certificates = folder / "certificates"
    if not certificates.exists():
        subprocess.run([*GEOREF, "cluster", "certificates", certificates], check=True, env=ENVIRONMENT)
    address = ClusterAddress(f"tls://127.0.0.1:{PORT}", certificates)
    shared = ("--certificates", str(certificates))
    commands: list[tuple[str, ...]] = [("scheduler", "--listen", f"127.0.0.1:{PORT}", *shared)]
    commands += [("worker", address.url, *shared, "-j", "1", "--memory", "4", "--gpus", "0")] * workers
    with (folder / "cluster.log").open("ab") as log:
        processes = [
            subprocess.Popen([*GEOREF, "cluster", *words], stdout=log, stderr=log, env=ENVIRONMENT)
            for words in commands
        ]
    try:
        with connected(address) as client:
            client.wait_for_workers(workers)
        yield address
    finally:
        for process in reversed(processes):
            process.send_signal(signal.SIGTERM)
            process.wait(timeout=60)


def measured_s(folder: Path, workers: int, iterations: int) -> float:
    """Return the wall time of the batch on a number of workers; no mission has begun before."""
    missions = folder / f"workers{workers}"
    shutil.copytree(folder / "flights", missions)
    with cluster(folder, workers) as address:
        words = ("--cluster", address.url, "--certificates", str(address.certificates), "--json", "-q")
        options = ("train.preset=smoke", f"train.iterations={iterations}", "ingest.vertical=ellipsoidal")
        settings = [word for option in options for word in ("--set", option)]
        started = time.perf_counter()
        done = subprocess.run(
            [*GEOREF, "batch", missions, *words, *settings], check=True, stdout=subprocess.PIPE, env=ENVIRONMENT
        )
        seconds = time.perf_counter() - started
    assert {row["state"] for row in json.loads(done.stdout)["missions"]} == {"done"}
    return seconds


def main() -> None:
    """Measure, and print the ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--missions", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=300)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_flights(folder / "flights", asked.missions)
        one = measured_s(folder, 1, asked.iterations)
        two = measured_s(folder, 2, asked.iterations)
    print(
        f"{asked.missions} missions: one worker {one:.1f} s, two workers {two:.1f} s, {one / two:.2f} times as fast"
    )


if __name__ == "__main__":
    main()
