"""Nodes of a Dask cluster on this machine: certificate, scheduler and worker.

Dask's own programs run; this module gives them the options that a safe cluster of this package needs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pipelines.core.errors import BackendUnavailableError, InputError
from pipelines.core.restart import python_environment
from pipelines.engine.cluster import CERTIFICATE, CORES, GPU, KEY, MEMORY, ClusterAddress, import_distributed

# The pages of the status servers are not encrypted and ask for no certificate.
_PRIVATE_PAGES = ("--no-dashboard", "--dashboard-address", "127.0.0.1:0")


def make_certificates(folder: Path) -> None:
    """Write a new certificate and its key, which are all that a machine needs to belong to a cluster.

    The certificate is its own authority. It is valid for a year, as those that Dask makes for itself.

    Raises:
        InputError: the folder has a certificate already.
        BackendUnavailableError: the extra is not installed.
    """
    distributed = import_distributed()
    try:
        security = distributed.Security.temporary()
    except ImportError as error:
        raise BackendUnavailableError(
            "certificates need cryptography: install it with `pip install 'georefgs[cluster]'`"
        ) from error
    folder.mkdir(parents=True, exist_ok=True)
    _write_new(folder / KEY, security.tls_client_key, mode=0o600)
    _write_new(folder / CERTIFICATE, security.tls_client_cert, mode=0o644)


def run_scheduler(listen: ClusterAddress) -> None:
    """Run a scheduler until it is interrupted.

    Raises:
        BackendUnavailableError: the extra is not installed.
    """
    import_distributed()
    from distributed.cli.dask_scheduler import main

    scheme = listen.url.partition(":")[0]
    place = ("--protocol", scheme, "--host", listen.host, "--port", str(listen.port))
    _call(main, [*place, *listen.dask_options(), *_PRIVATE_PAGES])


def run_worker(
    scheduler: ClusterAddress, *, jobs: int, cores: int, memory_bytes: int, gpus: int, name: str | None = None
) -> None:
    """Run a worker until it is interrupted, or its scheduler ends.

    Args:
        scheduler: its address.
        jobs: most jobs at a time.
        cores: that they share.
        memory_bytes: that they share.
        gpus: number of GPUs; a job takes one.
        name: for people; None: its address.

    Raises:
        BackendUnavailableError: the extra is not installed.
    """
    import_distributed()
    from distributed.cli.dask_worker import main

    resources = f"{MEMORY}={memory_bytes},{CORES}={cores}" + (f",{GPU}={gpus}" if gpus else "")
    # Dask's own limit of memory counts the worker alone; the jobs are processes of their own.
    options = ["--nthreads", str(jobs), "--memory-limit", "0", "--resources", resources]
    here = ["--host", "127.0.0.1"] if scheduler.certificates is None else []
    named = [] if name is None else ["--name", name]
    _call(main, [scheduler.url, *options, *here, *named, *scheduler.dask_options(), *_PRIVATE_PAGES])


def _call(main: object, arguments: Sequence[str]) -> None:
    """Run a program of Dask with encryption demanded where it has a certificate."""
    import dask

    os.environ.update(python_environment())  # Nannies spawn the processes of their workers by this environment.
    is_encrypted = "--tls-cert" in arguments
    with dask.config.set({"distributed.comm.require-encryption": is_encrypted}):
        main(args=list(arguments), standalone_mode=False)  # type: ignore[operator]


def _write_new(path: Path, text: str, mode: int) -> None:
    """Write a file that must not exist."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    except FileExistsError as error:
        raise InputError("exists: delete it to make another", path=path) from error
    with os.fdopen(descriptor, "w", encoding="utf-8") as handle:
        handle.write(text)
