"""Access to a Dask cluster: its certificate, its address, and the resources of its workers.

Dask executes what it is sent, and a scheduler obeys everybody who reaches it. Connections therefore need a
certificate on both sides, or never leave this machine. Whoever holds the key of a cluster can run programs on all
its machines, as the user who has started it: certificates are for their owner alone, and are checked at every use.
"""

from __future__ import annotations

import ipaddress
import logging
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, urlsplit

from pipelines.core.errors import ClusterError, InputError
from pipelines.core.extras import require
from pipelines.core.json_values import JsonValue
from pipelines.jobs.engine import Job

if TYPE_CHECKING:
    from distributed import Client

CERTIFICATE, KEY = "cluster.pem", "cluster.key"
_OF_OTHERS, _OF_EVERYBODY = 0o077, 0o007  # bits of a file's mode: permissions of group and all, of all
_MINUTES = "%Y-%m-%d %H:%M UTC"
_RENEW = (
    f"Delete {CERTIFICATE} and {KEY} there, make new ones with `georef cluster certificates`, copy them to every "
    "machine of the cluster, and start scheduler and workers again."
)


def make_certificates(folder: Path) -> None:
    """Write a new certificate and its key, which are all that a machine needs to belong to a cluster.

    The certificate is its own authority, valid for a year, as those that Dask makes for itself. A second one in the
    folder is an InputError.
    """
    require("cluster")
    from distributed import Security

    security = Security.temporary()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, text in ((KEY, security.tls_client_key), (CERTIFICATE, security.tls_client_cert)):
        try:
            descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError as error:
            raise InputError(
                "certificate-exists", "exists.", path=folder / name, remedy="Delete it to make another."
            ) from error
        with os.fdopen(descriptor, "w", encoding="utf-8") as handle:
            handle.write(text)


def make_own_certificates(folder: Path) -> None:
    """Make the certificate of a user's clusters where there is none; several programs may ask at once."""
    if folder.is_dir() and any(folder.iterdir()):
        return
    require("cluster")
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as drafts:
        draft = Path(drafts, folder.name)
        make_certificates(draft)
        with suppress(OSError):  # Another program was faster.
            draft.rename(folder)


def check_own_certificates(folder: Path) -> None:
    """Refuse the key of a user that others can read, or that they can replace."""
    if os.name != "posix":
        return
    for path in (folder, folder / CERTIFICATE, folder / KEY):
        if not path.exists():  # `check_certificates` raises that error
            continue
        status = path.stat()
        if status.st_uid != os.geteuid():
            message = "belongs to another user, who can run programs as you."
            remedy = "Delete it."
            raise InputError("key-of-another-user", message, path=path, remedy=remedy)
        if status.st_mode & _OF_OTHERS:
            message = (
                "is open to other users, who can run programs as you. If none of them has read or changed it: "
                f"`chmod -R go-rwx {folder}`. Otherwise delete it."
            )
            raise InputError("key-open", message, path=path)


def check_certificates(folder: Path) -> None:
    """Refuse a folder without certificate and key, or with a certificate that is not valid now.

    Raises:
        InputError: one is missing, everybody can read the key, or the certificate is none, has expired, or is not
            valid yet; names its dates.
    """
    for name in (CERTIFICATE, KEY):
        if not (folder / name).is_file():
            message = f"has no {name}."
            remedy = (
                "Name the folder of the cluster's certificate with --certificates. `georef cluster certificates "
                "DIR` makes one; `georef cluster scheduler` makes yours for this machine."
            )
            raise InputError("certificate-missing", message, path=folder, remedy=remedy)
    if os.name == "posix" and (folder / KEY).stat().st_mode & _OF_EVERYBODY:
        raise InputError(
            "key-open",
            "can be read by every user of this machine.",
            path=folder / KEY,
            remedy="Close it with `chmod 600`.",
        )
    from cryptography import x509

    path = folder / CERTIFICATE
    try:
        certificates = x509.load_pem_x509_certificates(path.read_bytes())
    except ValueError as error:
        raise InputError("certificate-damaged", f"is not a PEM certificate. {_RENEW}", path=path) from error
    now = datetime.now(UTC)
    for certificate in certificates:
        since, until = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if now > until:
            raise InputError("certificate-expired", f"has expired on {until:{_MINUTES}}. {_RENEW}", path=path)
        if now < since:
            clock = f"the clock of this machine says {now:{_MINUTES}}. Set the clock, or renew it. {_RENEW}"
            raise InputError(
                "certificate-not-yet-valid", f"is valid from {since:{_MINUTES}} on, and {clock}", path=path
            )


PORT = 8786
# Names of Dask's resources; jobs reserve memory and GPUs, not cores.
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
        require("cluster")
        scheme = self._parts.scheme
        if not self.host or scheme not in ("tls", "tcp"):
            raise ValueError(f"{self.address!r} is not an address such as tls://host:{PORT}.")
        if self.certificates is None:
            if scheme == "tls" or not is_on_this_machine(self.address):
                raise ValueError(
                    f"{self.address} needs --certificates. Without them only tcp://127.0.0.1 is used: whoever "
                    "reaches a scheduler can run programs on its workers."
                )
            return
        if scheme == "tcp":
            raise ValueError(f"{self.address} is not encrypted. Write tls://, or add --insecure.")
        check_certificates(self.certificates)

    @property
    def host(self) -> str:
        return self._parts.hostname or ""

    @property
    def port(self) -> int:
        return self._parts.port or PORT

    @property
    def url(self) -> str:
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
    host = _parts(address, "tls").hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _parts(address: str, scheme: str) -> SplitResult:
    """Return the parts of an address, with this scheme if it has none; a ValueError if it is none."""
    parts = urlsplit(address if "://" in address else f"{scheme}://{address}")
    _ = parts.port  # raises if it is none
    return parts


@contextmanager
def connected(cluster: ClusterAddress) -> Iterator[Client]:
    """Connect to the scheduler while the context lasts; a ClusterError: none answers, or the certificate is bad."""
    import distributed

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
        raise ClusterError(
            "no-scheduler", f"No scheduler answers at {cluster.url}.", remedy=f"Check whether it runs{hint}."
        ) from error
    try:
        yield client
    finally:
        with suppress(OSError, TimeoutError, RuntimeError):
            client.close(timeout=5)


@dataclass(frozen=True)
class Worker:
    """Worker of the cluster, with its resources for all its jobs together; a restart gives it another address."""

    address: str
    name: str
    slots: int
    memory_bytes: int
    gpus: int


def workers_of(described: Mapping[str, Mapping[str, JsonValue]]) -> dict[str, Worker]:
    """Return the workers that offer memory to jobs, by address, as the scheduler has described them."""
    return {
        address: Worker(
            address,
            f"{worker['name']} on {worker['host']}" if worker["name"] != address else address,
            int(worker["nthreads"]),
            int(worker["resources"][MEMORY]),
            int(worker["resources"].get(GPU, 0)),
        )
        for address, worker in described.items()
        if MEMORY in worker["resources"]
    }


def worker_for(
    job: Job, workers: Mapping[str, Worker], running: Mapping[str, Sequence[Job]], avoided: Collection[str] = ()
) -> Worker | None:
    """Return the worker for a job: the one with the fewest jobs that has room, or None.

    A job that is too large for all workers runs alone on the largest. Workers (by address) on which it has failed
    are avoided, unless there are no others.
    """
    largest_bytes = max((worker.memory_bytes for worker in workers.values()), default=0)

    def has_room(worker: Worker) -> bool:
        beside = running.get(worker.address, ())
        if len(beside) >= worker.slots or (job.uses_gpu and sum(other.uses_gpu for other in beside) >= worker.gpus):
            return False
        taken = sum(min(other.peak_bytes, worker.memory_bytes) for other in beside)
        return taken + min(job.peak_bytes, largest_bytes) <= worker.memory_bytes

    others = [worker for address, worker in workers.items() if address not in avoided]
    free = filter(has_room, others or workers.values())
    return min(free, key=lambda worker: len(running.get(worker.address, ())), default=None)
