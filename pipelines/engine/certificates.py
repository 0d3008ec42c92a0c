"""Certificates of a Dask cluster: made, kept for their owner alone, and checked where a cluster is used.

Dask executes what it is sent: whoever holds the key of a cluster can run programs on all its machines, as the user
who has started it.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.core.errors import BackendUnavailableError, InputError

CERTIFICATE, KEY = "cluster.pem", "cluster.key"
_OF_OTHERS, _OF_EVERYBODY = 0o077, 0o007  # bits of a mode
_MINUTES = "%Y-%m-%d %H:%M UTC"
_RENEW = (
    f"delete {CERTIFICATE} and {KEY} there, make new ones by `georef cluster certificates`, copy them to every "
    "machine of the cluster, and start scheduler and workers again"
)


def import_distributed() -> Any:
    """Return Dask's library.

    Raises:
        BackendUnavailableError: it is not installed; names the extra.
    """
    try:
        import distributed
    except ImportError as error:
        raise BackendUnavailableError(
            "a cluster needs Dask: install it with `pip install 'georefgs[cluster]'`"
        ) from error
    return distributed


def make_certificates(folder: Path) -> None:
    """Write a new certificate and its key, which are all that a machine needs to belong to a cluster.

    The certificate is its own authority. It is valid for a year, as those that Dask makes for itself. Folder and
    files are for their owner alone.

    Raises:
        InputError: the folder has a certificate already.
        BackendUnavailableError: the extra is not installed.
    """
    distributed = import_distributed()
    try:
        security = distributed.Security.temporary()
    except ImportError as error:
        raise _needs_cryptography() from error
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, text in ((KEY, security.tls_client_key), (CERTIFICATE, security.tls_client_cert)):
        try:
            descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError as error:
            raise InputError("exists: delete it to make another", path=folder / name) from error
        with os.fdopen(descriptor, "w", encoding="utf-8") as handle:
            handle.write(text)


def make_own_certificates(folder: Path) -> None:
    """Make the certificate of a user's clusters where there is none; several programs may ask at once.

    Raises:
        BackendUnavailableError: the extra is not installed.
    """
    if folder.is_dir() and any(folder.iterdir()):
        return
    folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as drafts:
        draft = Path(drafts, folder.name)
        make_certificates(draft)
        with suppress(OSError):  # Another program was faster.
            draft.rename(folder)


def check_own_certificates(folder: Path) -> None:
    """Check that nobody else can read a user's key, or put another in its place.

    Raises:
        InputError: folder or files belong to somebody else, or others have access.
    """
    if os.name != "posix":
        return
    for path in (folder, folder / CERTIFICATE, folder / KEY):
        if not path.exists():  # which `check_certificates` tells
            continue
        status = path.stat()
        if status.st_uid != os.geteuid():
            raise InputError("belongs to another user, who can run programs as you: delete it", path=path)
        if status.st_mode & _OF_OTHERS:
            raise InputError(
                "is open to other users, who can run programs as you. If none of them has read or changed it: "
                f"`chmod -R go-rwx {folder}`; else delete it",
                path=path,
            )


def check_certificates(folder: Path) -> None:
    """Check that a folder has a certificate and its key, and that the certificate is valid now.

    Raises:
        InputError: one is missing, everybody can read the key, or the certificate is none, has expired, or is not
            valid yet; names its dates.
        BackendUnavailableError: the extra is not installed.
    """
    for name in (CERTIFICATE, KEY):
        if not (folder / name).is_file():
            raise InputError(
                f"has no {name}: name the folder of the cluster's certificate with --certificates. `georef cluster "
                "certificates DIR` makes one; `georef cluster scheduler` makes yours for this machine",
                path=folder,
            )
    if os.name == "posix" and (folder / KEY).stat().st_mode & _OF_EVERYBODY:
        raise InputError("can be read by every user of this machine: `chmod 600` it", path=folder / KEY)
    try:
        from cryptography import x509
    except ImportError as error:
        raise _needs_cryptography() from error
    path = folder / CERTIFICATE
    try:
        certificates = x509.load_pem_x509_certificates(path.read_bytes())
    except ValueError as error:
        raise InputError(f"is no certificate in the form PEM: {_RENEW}", path=path) from error
    now = datetime.now(UTC)
    for certificate in certificates:
        since, until = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if now > until:
            raise InputError(f"has expired on {until:{_MINUTES}}: {_RENEW}", path=path)
        if now < since:
            clock = f"the clock of this machine says {now:{_MINUTES}}: set it, or {_RENEW}"
            raise InputError(f"is valid from {since:{_MINUTES}} on, and {clock}", path=path)


def _needs_cryptography() -> BackendUnavailableError:
    return BackendUnavailableError(
        "certificates need cryptography: install it with `pip install 'georefgs[cluster]'`"
    )
