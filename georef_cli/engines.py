"""Engine of the commands that run many jobs: this machine, or a cluster (`--cluster`)."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from georef_cli.options import FOLDER, flag
from pipelines.core.machine import free_main_memory_bytes, thread_count
from pipelines.jobs.engine import Engine
from pipelines.jobs.local import LocalEngine, chosen_engine

if TYPE_CHECKING:
    from pipelines.jobs.cluster import ClusterAddress

log = logging.getLogger(__name__)


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


def engine_for(values: Mapping[str, Any], at_a_time: int | None = None) -> Engine:
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
def asked_engine(values: Mapping[str, Any]) -> Iterator[None]:
    """Let stages share their work with the engine that `--cluster` chooses; without it, with that in use."""
    engine = engine_for(values)
    with nullcontext() if values["cluster"] is None else chosen_engine(engine):
        yield


def cluster_address(text: str, values: Mapping[str, Any], option: str, *, is_node: bool = False) -> ClusterAddress:
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
