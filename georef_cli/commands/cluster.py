"""Commands `georef cluster …`: the certificate, the scheduler and the workers of a cluster."""

from pathlib import Path
from typing import Any

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.engines import CERTIFICATES, cluster_address
from georef_cli.layout import shown
from georef_cli.output import print_json, print_result
from pipelines.core.machine import free_main_memory_bytes, thread_count

_USABLE = 0.9  # of the free memory: other programs grow, too
_GIB = 1 << 30


def _certificates(folder: Path, as_json: bool) -> None:
    from pipelines.jobs.cluster import CERTIFICATE, KEY, make_certificates

    make_certificates(folder)
    text = f"has {CERTIFICATE} and {KEY}. Copy the folder to every machine of the cluster, and to nobody else."
    document = {"certificate": str(folder / CERTIFICATE), "key": str(folder / KEY)}
    print_result(document, f"{shown(str(folder))} {text}", as_json=as_json)


def _scheduler(listen: str | None, as_json: bool, **values: Any) -> None:
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
    **values: Any,
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


_COMMANDS = (
    Command(
        "cluster certificates",
        params=[
            click.Argument(["folder"], type=options.FOLDER, metavar="DIR"),
            options.JSON,
        ],
        callback=_certificates,
        help="""Make the certificate that the machines of a cluster share: cluster.pem and cluster.key in DIR.

        Scheduler, workers and the commands with --cluster refuse everybody who does not have it (mutual TLS).
        Whoever has it can run programs on every worker: treat cluster.key as a password. It is valid for a year.

        \b
        Examples:
          georef cluster certificates certificates
        """,
    ),
    Command(
        "cluster scheduler",
        params=[
            click.Option(
                ["--listen"],
                metavar="HOST:PORT",
                help="Where to listen (default: port 8786, of every network with --certificates, else of "
                "127.0.0.1).",
            ),
            *CERTIFICATES,
            options.JSON,
        ],
        callback=_scheduler,
        help="""Start the scheduler of a cluster (docs/cluster.md). It runs until Ctrl-C.

        This is Dask's scheduler, with encryption demanded and its unprotected pages kept on this machine. Without
        --certificates it listens on 127.0.0.1 only, and hears nobody but you: it makes a certificate in your
        settings, where your workers and commands find it.

        \b
        Examples:
          georef cluster scheduler --certificates certificates
          georef cluster scheduler
        """,
    ),
    Command(
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
        help="""Lend this machine to a cluster (docs/cluster.md), until Ctrl-C or the end of the scheduler.

        ADDRESS is that of the scheduler. This is Dask's worker, which tells how much memory and how many GPUs the
        machine has. Each job is a process of georef with the cores of the worker, or its share of them. Ctrl-C
        stops the jobs, which save their work and go on elsewhere.

        \b
        Examples:
          georef cluster worker tls://head:8786 --certificates certificates
          georef cluster worker tls://head:8786 --certificates certificates --jobs 4 --memory 100
          georef cluster worker 127.0.0.1:8786 -j 2
        """,
    ),
)


def command(name: str) -> Command:
    """Return the command of two words."""
    return next(each for each in _COMMANDS if each.name == name)
