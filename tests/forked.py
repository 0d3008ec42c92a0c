"""`georef` in processes forked from one that has imported what commands import: real ones that start at once.

Importing torch and COLMAP takes seconds, which tests of dozens of commands would spend for each anew. A forked
process has a number, streams and an exit code of its own, and can be killed; it computes with one thread. Where
libraries do not bear a fork, which is on all systems but Linux, Python is started instead.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from functools import cache
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TextIO

import pytest

from pipelines.core.stages import STAGES

REPOSITORY = Path(__file__).parents[1]
_IMPORTED = (
    "georef_cli.main",
    "torch",
    "pycolmap",
    "cv2",
    "rasterio",
    *(spec.module for spec in STAGES),
    "tests.forked",
)
# Read by libraries when they are imported, which --threads comes too late for here.
_THREADS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS")


class ForkedProcess:
    """A running command, with what tests use of `subprocess.Popen`."""

    def __init__(self, words: tuple[str, ...], folder: Path, environment: Mapping[str, str]) -> None:
        server = _server()
        (out, out_of), (err, err_of) = (server.Pipe(duplex=False) for _ in range(2))
        self._process = server.Process(target=_run, args=(words, str(folder), dict(environment), out_of, err_of))
        self._process.start()
        for connection in (out_of, err_of):
            connection.close()
        self.stdout, self.stderr = _text_of(out), _text_of(err)
        self._said = ["", ""]
        self._readers = [threading.Thread(target=self._read, args=(index,), daemon=True) for index in range(2)]

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, or the negative number of the signal that has ended it."""
        return self._process.exitcode

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("georef", timeout or 0.0)
        return self._process.exitcode

    def kill(self) -> None:
        self._process.kill()

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Return what it has said until it and all that have its streams have ended."""
        for reader in self._readers:
            if reader.ident is None:
                reader.start()
        for reader in self._readers:
            reader.join(timeout)
            if reader.is_alive():
                raise subprocess.TimeoutExpired("georef", timeout or 0.0)
        self.wait(timeout)
        return self._said[0], self._said[1]

    def _read(self, index: int) -> None:
        with (self.stdout, self.stderr)[index] as stream:
            self._said[index] = stream.read()


def start_georef(
    *words: object, folder: Path | None = None, environment: Mapping[str, str] | None = None
) -> ForkedProcess | subprocess.Popen[str]:
    """Start a command in a folder, by default this process's, with changes of its variables."""
    arguments, folder = tuple(map(str, words)), folder or Path.cwd()
    if sys.platform == "linux":
        return ForkedProcess(arguments, folder, environment or {})
    return subprocess.Popen(
        [sys.executable, "-c", "from georef_cli.main import main; main()", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), **(environment or {})},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@cache
def _server() -> multiprocessing.context.ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(dict.fromkeys(_IMPORTED)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(REPOSITORY))
        for name in _THREADS:
            patch.setenv(name, "1")
        forkserver.ensure_running()
    return context


def _run(
    words: tuple[str, ...], folder: str, environment: Mapping[str, str], out: Connection, err: Connection
) -> None:
    """Be `georef`, in a forked process."""
    for connection, descriptor in ((out, 1), (err, 2)):
        os.dup2(connection.fileno(), descriptor)
        connection.close()
    # Those of the server may lead to a file, in which one can seek.
    sys.stdout = sys.__stdout__ = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.__stderr__ = open(2, "w", encoding="utf-8", buffering=1, closefd=False)  # noqa: SIM115
    os.fsync = lambda _descriptor: None  # no test cuts the power, and each flush is waited for
    os.environ.update(environment)
    os.chdir(folder)
    sys.argv = ["-c", *words]
    from georef_cli.main import main

    main()


def _text_of(connection: Connection) -> TextIO:
    descriptor = os.dup(connection.fileno())
    connection.close()
    return open(descriptor, encoding="utf-8")  # noqa: PTH123  (a descriptor, closed by its reader)
