"""Command `georef cluster certificates`."""

from pathlib import Path

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.layout import shown
from georef_cli.output import print_result


def _certificates(folder: Path, as_json: bool) -> None:
    from pipelines.jobs.cluster import CERTIFICATE, KEY, make_certificates

    make_certificates(folder)
    text = f"has {CERTIFICATE} and {KEY}. Copy the folder to every machine of the cluster, and to nobody else."
    document = {"certificate": str(folder / CERTIFICATE), "key": str(folder / KEY)}
    print_result(document, f"{shown(str(folder))} {text}", as_json=as_json)


command = Command(
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
)
