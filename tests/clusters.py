"""Dask clusters on this machine: a scheduler and workers in processes of their own, started by `georef cluster`."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from pipelines.jobs.cluster import ClusterAddress, connected, make_certificates
from tests.cli_runs import REPOSITORY, Result, finish

PATIENCE_S = 180.0
# Jobs of these clusters are this program in place of `georef`.
_PRELOAD = "from pipelines.core import child\nchild.THIS_PROGRAM = ('-c', {program!r})\n"


def finish_patiently(process: subprocess.Popen[str]) -> Result:
    """Wait for a command on a cluster."""
    return finish(process, 5 * PATIENCE_S)


def greeting(port: int, certificates: Path | None) -> bytes:
    """First bytes that a scheduler of this machine says to one who trusts everybody."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    if certificates is not None:
        context.load_cert_chain(certificates / "cluster.pem", certificates / "cluster.key")
    try:
        with (
            socket.create_connection(("127.0.0.1", port), timeout=10) as plain,
            context.wrap_socket(plain) as connection,
        ):
            return connection.recv(8)
    except (ssl.SSLError, ConnectionError):
        return b""


def wait_until(happened: Callable[[], bool], what: str) -> None:
    """Wait for something that another process does."""
    deadline = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


class RunningCluster:
    """Cluster with one-job workers, which are restarted by their nannies when they are killed."""

    def __init__(self, folder: Path, program: str) -> None:
        self.folder = folder
        certificates = folder / "certificates"
        make_certificates(certificates)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address = ClusterAddress(f"tls://127.0.0.1:{self.port}", certificates)
        self._options = ("--certificates", str(certificates))
        (folder / "preload.py").write_text(_PRELOAD.format(program=program), "utf-8")
        self.scheduler = self.start_scheduler()
        self.workers: list[subprocess.Popen[bytes]] = []

    @property
    def words(self) -> tuple[str, ...]:
        """Options of a command that uses the cluster."""
        return ("--cluster", self.address.url, *self._options)

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        self.scheduler = self._start("scheduler", "--listen", f"127.0.0.1:{self.port}", *self._options)
        deadline = time.monotonic() + PATIENCE_S
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), timeout=1):
                return self.scheduler
            assert self.scheduler.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)

    def start_worker(self, name: str) -> subprocess.Popen[bytes]:
        offer = ("--jobs", "1", "-j", "1", "--memory", "4", "--gpus", "0", "--name", name)
        worker = self._start("worker", self.address.url, *self._options, *offer)
        self.workers.append(worker)
        return worker

    def wait_for_workers(self, count: int) -> None:
        deadline = time.monotonic() + PATIENCE_S
        with connected(self.address) as client:
            while len(client.scheduler_info()["workers"]) < count:
                assert time.monotonic() < deadline
                time.sleep(0.05)

    def worker_processes(self) -> list[int]:
        """Numbers of the processes that run jobs: children of the nannies."""
        with connected(self.address) as client:
            return list(client.run(os.getpid).values())

    def restart(self) -> None:
        """Start the scheduler again, and as many workers as there were, which have ended with it."""
        for worker in self.workers:
            worker.wait(timeout=PATIENCE_S)
        count = len(self.workers)
        self.workers.clear()
        self.start_scheduler()
        for number in range(count):
            self.start_worker(f"again{number}")
        self.wait_for_workers(count)

    def close(self) -> None:
        for processes in (self.workers, [self.scheduler]):  # A worker says goodbye to its scheduler.
            for process in processes:
                process.send_signal(signal.SIGTERM)
            for process in processes:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=10)
                process.kill()
                process.wait()

    def _start(self, *words: str) -> subprocess.Popen[bytes]:
        with (self.folder / f"{words[0]}.log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "georef_cli", "cluster", *words],
                stdout=log,
                stderr=log,
                cwd=self.folder,
                env={
                    **os.environ,
                    "PYTHONPATH": str(REPOSITORY),
                    "DASK_DISTRIBUTED__WORKER__PRELOAD": str(self.folder / "preload.py"),
                    "DASK_TEMPORARY_DIRECTORY": str(self.folder / "scratch"),
                },
            )


@contextlib.contextmanager
def running_cluster(folder: Path, program: str, workers: int = 2) -> Iterator[RunningCluster]:
    """Start a scheduler and workers, and end them with the context."""
    cluster = RunningCluster(folder, program)
    try:
        for number in range(workers):
            cluster.start_worker(f"w{number}")
        cluster.wait_for_workers(workers)
        yield cluster
    finally:
        cluster.close()
