"""Nodes of a Dask cluster on this machine: scheduler and worker.

Dask's own programs run; this module gives them the options that a safe cluster of this package needs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence

from pipelines.core.restart import python_environment
from pipelines.engine.certificates import import_distributed
from pipelines.engine.cluster import CORES, GPU, MEMORY, ClusterAddress

# The pages of the status servers are not encrypted and ask for no certificate.
_PRIVATE_PAGES = ("--no-dashboard", "--dashboard-address", "127.0.0.1:0")


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
