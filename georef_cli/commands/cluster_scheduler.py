"""Command `georef cluster scheduler`."""

from __future__ import annotations

from pathlib import Path

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.engines import certificates_option, cluster_address
from georef_cli.output import print_json


def _scheduler(listen: str | None, certificates: Path | None, as_json: bool) -> None:
    from pipelines.engine.nodes import run_scheduler

    everywhere = "127.0.0.1" if certificates is None else "0.0.0.0"
    address = cluster_address(listen or everywhere, certificates, "--listen")
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
        certificates_option(),
        options.json_option(),
    ],
    callback=_scheduler,
    help="""Start the scheduler of a cluster (docs/cluster.md). It runs until Ctrl-C.

        This is Dask's scheduler, with encryption demanded and its unprotected pages kept on this machine. Without
        --certificates it listens on 127.0.0.1 only.

        \b
        Examples:
          georef cluster scheduler --certificates certificates
          georef cluster scheduler
        """,
)
