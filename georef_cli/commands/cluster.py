"""Commands `georef cluster …`, and the engine of commands that run many jobs: this machine, or a cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.options import FOLDER, flag
from georef_cli.output import print_json, print_result
from georef_cli.tables import literal
from pipelines.core.machine import free_main_memory_bytes, thread_count
from pipelines.core.options import OptionValue
from pipelines.core.staleness import Flags
from pipelines.jobs.engine import Engine
from pipelines.jobs.local import LocalEngine, chosen_engine

if TYPE_CHECKING:
    from pipelines.jobs.cluster import ClusterAddress

log = logging.getLogger(__name__)

_USABLE = 0.9  # of the free memory: other programs grow, too
_GIB = 1 << 30

CERTIFICATES = (
    click.Option(
        ["--certificates"],
        type=FOLDER,
        metavar="DIR",
        help="Folder with the certificate of the cluster, from `georef cluster certificates` (default: yours, "
        "which the first scheduler or worker on 127.0.0.1 makes).",
    ),
    flag(
        "--insecure",
        text="Use no certificate. Every program of this machine, of any user, can then run programs as you.",
    ),
)
ENGINE = (
    click.Option(
        ["--cluster"],
        metavar="ADDRESS",
        help="Run the jobs on the workers of the Dask scheduler at this address, such as tls://host:8786 "
        "(docs/cluster.md; default: as processes of this machine).",
    ),
    *CERTIFICATES,
    click.Option(
        ["--storage"],
        metavar="URL",
        help="Object store through which files go to workers that share no folder, such as s3://bucket/prefix.",
    ),
)


def engine_for(values: Flags, at_a_time: int | None = None) -> Engine:
    """Return the engine that the options choose, for at most so many jobs at a time."""
    if values["cluster"] is None:
        for option in ("certificates", "insecure", "storage"):
            if values[option]:
                raise click.UsageError(f"--{option} is for --cluster.")
        cores = thread_count()
        return LocalEngine(at_a_time or cores, cores, free_main_memory_bytes())
    from pipelines.jobs.dask_engine import DaskEngine
    from pipelines.jobs.storage import Storage

    address = cluster_address(values["cluster"], values, "--cluster")
    return DaskEngine(address, at_a_time, None if values["storage"] is None else Storage(values["storage"]))


@contextmanager
def requested_engine(values: Flags) -> Iterator[None]:
    """Let stages share their work with the engine that `--cluster` chooses; without it, with that in use."""
    engine = engine_for(values)
    with nullcontext() if values["cluster"] is None else chosen_engine(engine):
        yield


def cluster_address(text: str, values: Flags, option: str, *, is_node: bool = False) -> ClusterAddress:
    """Return the address that an option or argument gives, with the certificate that the other options choose.

    A program that is a node of the cluster, on this machine, makes a missing certificate.
    """
    from pipelines.jobs.cluster import (
        ClusterAddress,
        check_own_certificates,
        is_on_this_machine,
        make_own_certificates,
    )

    certificates: Path | None = values["certificates"]
    if values["insecure"]:
        if certificates is not None:
            raise click.UsageError("--insecure uses no certificate. Remove --certificates.")
        log.warning(
            "No certificate protects the cluster at %s (--insecure). Every program of this machine, of any user, "
            "can run programs as you through it.",
            text,
            extra={"code": "cluster-insecure"},
        )
    try:
        if certificates is None and not values["insecure"]:
            certificates = Path(click.get_app_dir("georef")).absolute() / "cluster"
            if is_node and is_on_this_machine(text):
                make_own_certificates(certificates)
            check_own_certificates(certificates)
        return ClusterAddress(text, certificates)
    except ValueError as error:
        raise click.UsageError(f"{option}: {error}") from error


def _certificates(folder: Path, as_json: bool) -> None:
    from pipelines.jobs.cluster import CERTIFICATE, KEY, make_certificates

    make_certificates(folder)
    text = f"has {CERTIFICATE} and {KEY}. Copy the folder to every machine of the cluster, and to nobody else."
    document = {"certificate": str(folder / CERTIFICATE), "key": str(folder / KEY)}
    print_result(document, f"{literal(str(folder))} {text}", as_json=as_json)


def _scheduler(listen: str | None, as_json: bool, **values: OptionValue) -> None:
    from pipelines.jobs.dask_task import run_scheduler

    everywhere = "127.0.0.1" if values["certificates"] is None else "0.0.0.0"
    address = cluster_address(listen or everywhere, values, "--listen", is_node=True)
    run_scheduler(address)
    if as_json:
        print_json({"scheduler": address.url})


def _worker(
    address: str,
    *,
    jobs: int,
    memory_gib: float | None,
    gpus: int | None,
    name: str | None,
    as_json: bool,
    **values: OptionValue,
) -> None:
    from pipelines.jobs.dask_task import run_worker

    scheduler = cluster_address(address, values, "ADDRESS", is_node=True)
    memory_bytes = int(_USABLE * free_main_memory_bytes() if memory_gib is None else memory_gib * _GIB)
    if gpus is None:
        from pipelines.jobs.machine import inspect_machine

        gpus = len(inspect_machine().gpus)
    run_worker(scheduler, jobs=jobs, cores=thread_count(), memory_bytes=memory_bytes, gpus=gpus, name=name)
    if as_json:
        print_json({"scheduler": scheduler.url, "jobs": jobs, "memory_bytes": memory_bytes, "gpus": gpus})


certificates = Command(
    "cluster certificates",
    params=[
        click.Argument(["folder"], type=options.FOLDER, metavar="DIR"),
        options.JSON,
    ],
    callback=_certificates,
    help="""
    DIR gets cluster.pem and cluster.key. Scheduler, workers and the commands with --cluster refuse everybody who
    does not have it (mutual TLS). Whoever has it can run programs on every worker: treat cluster.key as a password.
    It is valid for a year.

    \b
    Examples:
      georef cluster certificates certificates
    """,
)
scheduler = Command(
    "cluster scheduler",
    params=[
        click.Option(
            ["--listen"],
            metavar="HOST:PORT",
            help="Where to listen (default: port 8786, of every network with --certificates, else of 127.0.0.1).",
        ),
        *CERTIFICATES,
        options.JSON,
    ],
    callback=_scheduler,
    help="""
    It runs until Ctrl-C (docs/cluster.md). This is Dask's scheduler, with encryption demanded and its unprotected
    pages kept on this machine. Without --certificates it listens on 127.0.0.1 only, and hears nobody but you: it
    makes a certificate in your settings, where your workers and commands find it.

    \b
    Examples:
      georef cluster scheduler --certificates certificates
      georef cluster scheduler
    """,
)
worker = Command(
    "cluster worker",
    params=[
        click.Argument(["address"], metavar="ADDRESS"),
        *CERTIFICATES,
        click.Option(
            ["--jobs"],
            type=click.IntRange(min=1),
            default=1,
            metavar="N",
            help="Run at most this many jobs at a time, which share the cores (default: 1).",
        ),
        click.Option(
            ["--memory", "memory_gib"],
            type=click.FloatRange(min=0.1),
            metavar="GIB",
            help="Memory that the jobs share (default: nine tenths of what is free now).",
        ),
        click.Option(
            ["--gpus"], type=click.IntRange(min=0), metavar="N", help="Number of GPUs (default: as found)."
        ),
        click.Option(["--name"], metavar="NAME", help="Name for messages (default: its address)."),
        options.JSON,
    ],
    callback=_worker,
    help="""
    ADDRESS is that of the scheduler (docs/cluster.md); Ctrl-C or its end ends the worker. This is Dask's worker,
    which tells how much memory and how many GPUs the machine has. Each job is a process of georef with the cores of
    the worker, or its share of them. Ctrl-C stops the jobs, which save their work and go on elsewhere.

    \b
    Examples:
      georef cluster worker tls://head:8786 --certificates certificates
      georef cluster worker tls://head:8786 --certificates certificates --jobs 4 --memory 100
      georef cluster worker 127.0.0.1:8786 -j 2
    """,
)
