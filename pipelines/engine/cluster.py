"""Access to a Dask cluster: its address and certificate, and what its workers offer.

Dask executes what it is sent, and a scheduler obeys everybody who reaches it. Connections therefore need a
certificate on both sides, or never leave this machine.
"""

from __future__ import annotations

import ipaddress
import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, urlsplit

from pipelines.core.errors import ClusterError
from pipelines.engine.certificates import CERTIFICATE, KEY, check_certificates, import_distributed
from pipelines.engine.job import Job

if TYPE_CHECKING:
    from distributed import Client

PORT = 8786
# Names of Dask's resources; cores are told, not taken.
MEMORY, GPU, CORES = "MEMORY", "GPU", "CORES"
_CONNECT_S = 20.0


@dataclass(frozen=True)
class ClusterAddress:
    """Address of a scheduler, and the certificate that its cluster shares.

    Args:
        address: `tls://host:port`, `tcp://127.0.0.1:port`, or without the scheme.
        certificates: folder with `cluster.pem` and `cluster.key`; None: no encryption, on this machine only.

    Raises:
        ValueError: no such address, or one of another machine without a certificate.
        InputError: the certificate is missing or not valid now.
        BackendUnavailableError: the extra is not installed.
    """

    address: str
    certificates: Path | None = None

    def __post_init__(self) -> None:
        scheme = self._parts.scheme
        if not self.host or scheme not in ("tls", "tcp"):
            raise ValueError(f"{self.address!r} is no address such as tls://host:{PORT}")
        if self.certificates is None:
            if scheme == "tls" or not is_loopback(self.host):
                raise ValueError(
                    f"{self.address} needs certificates: without them only tcp://127.0.0.1 is used, because "
                    "everybody who reaches a scheduler can run programs on its workers"
                )
            return
        if scheme == "tcp":
            raise ValueError(f"{self.address} is not encrypted: write tls://, or add --insecure")
        check_certificates(self.certificates)

    @property
    def host(self) -> str:
        """Host name or number."""
        return self._parts.hostname or ""

    @property
    def port(self) -> int:
        """Port."""
        return self._parts.port or PORT

    @property
    def url(self) -> str:
        """Address as Dask writes it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self._parts.scheme}://{host}:{self.port}"

    def dask_options(self) -> tuple[str, ...]:
        """Return the options of `dask scheduler` and `dask worker` for the certificate."""
        if self.certificates is None:
            return ()
        certificate, key = str(self.certificates / CERTIFICATE), str(self.certificates / KEY)
        return ("--tls-ca-file", certificate, "--tls-cert", certificate, "--tls-key", key)

    @property
    def _parts(self) -> SplitResult:
        return _parts(self.address, "tcp" if self.certificates is None else "tls")


def is_on_this_machine(address: str) -> bool:
    """Return whether an address is that of this machine, seen by itself only."""
    return is_loopback(_parts(address, "tls").hostname or "")


def _parts(address: str, scheme: str) -> SplitResult:
    """Return the parts of an address, with this scheme if it has none.

    Raises:
        ValueError: it is none.
    """
    parts = urlsplit(address if "://" in address else f"{scheme}://{address}")
    _ = parts.port  # raises if it is none
    return parts


@contextmanager
def connected(cluster: ClusterAddress) -> Iterator[Client]:
    """Connect to the scheduler while the context lasts.

    Raises:
        BackendUnavailableError: the extra is not installed.
        ClusterError: no scheduler answers there, or it refuses the certificate.
    """
    distributed = import_distributed()
    for name in ("distributed", "tornado"):  # They log each lost connection with a traceback.
        logging.getLogger(name).setLevel(logging.CRITICAL)
    security: dict[str, Any] = {}
    if cluster.certificates is not None:
        certificate, key = str(cluster.certificates / CERTIFICATE), str(cluster.certificates / KEY)
        security = {"tls_ca_file": certificate, "tls_client_cert": certificate, "tls_client_key": key}
    try:
        client = distributed.Client(
            cluster.url,
            security=distributed.Security(require_encryption=bool(security), **security),
            timeout=_CONNECT_S,
            set_as_default=False,
        )
    except (OSError, TimeoutError, ValueError, RuntimeError) as error:
        hint = "" if not security else ", and whether it has the same certificate"
        raise ClusterError(f"no scheduler answers at {cluster.url}: check that it runs{hint}") from error
    try:
        yield client
    finally:
        with suppress(OSError, TimeoutError, RuntimeError):
            client.close(timeout=5)


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine, seen by itself only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


@dataclass(frozen=True)
class Place:
    """Worker of the cluster, and what it offers to jobs.

    Attributes:
        address: of the worker; another one after its restart.
        name: for people.
        slots: number of jobs at a time.
        memory_bytes: for all jobs together.
        gpus: number of GPUs.
    """

    address: str
    name: str
    slots: int
    memory_bytes: int
    gpus: int

    def admits(self, job: Job, running: Sequence[Job], largest_bytes: int) -> bool:
        """Return whether a job may run beside others; one that is too large for all runs alone on the largest."""
        gpus_taken = sum(other.uses_gpu for other in running)
        if len(running) >= self.slots or (job.uses_gpu and gpus_taken >= self.gpus):
            return False
        taken = sum(min(other.peak_bytes, self.memory_bytes) for other in running)
        return taken + min(job.peak_bytes, largest_bytes) <= self.memory_bytes


def places_of(workers: Mapping[str, Mapping[str, Any]]) -> dict[str, Place]:
    """Return the workers that offer memory to jobs, by address.

    Args:
        workers: from the scheduler, by address.
    """
    return {
        address: Place(
            address,
            f"{worker['name']} on {worker['host']}" if worker["name"] != address else address,
            int(worker["nthreads"]),
            int(worker["resources"][MEMORY]),
            int(worker["resources"].get(GPU, 0)),
        )
        for address, worker in workers.items()
        if MEMORY in worker["resources"]
    }


def place_for(
    job: Job, places: Mapping[str, Place], running: Mapping[str, Sequence[Job]], avoided: Collection[str] = ()
) -> Place | None:
    """Return the worker for a job: the one with the fewest jobs that has room, or None.

    Args:
        job: that waits.
        places: workers by address.
        running: jobs by address of their worker.
        avoided: addresses of workers on which the job has failed; they are chosen if there are no others.
    """
    largest = max((place.memory_bytes for place in places.values()), default=0)
    others = [place for address, place in places.items() if address not in avoided]
    free = [
        place for place in others or places.values() if place.admits(job, running.get(place.address, ()), largest)
    ]
    return min(free, key=lambda place: len(running.get(place.address, ())), default=None)
