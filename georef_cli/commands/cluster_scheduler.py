"""Command `georef cluster scheduler`."""

from typing import Any

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.engines import CERTIFICATES, cluster_address
from georef_cli.output import print_json


def _scheduler(listen: str | None, as_json: bool, **values: Any) -> None:
    from pipelines.jobs.dask_task import run_scheduler

    everywhere = "127.0.0.1" if values["certificates"] is None else "0.0.0.0"
    address = cluster_address(listen or everywhere, values, "--listen", is_node=True)
    run_scheduler(address)
    if as_json:
        print_json({"scheduler": address.url})


command = Command(
    "cluster scheduler",
    params=[
        click.Option(
            ["--listen"],
            metavar="HOST:PORT",
            help="Where to listen (default: port 8786 of every network with --certificates, else of 127.0.0.1).",
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
)
