"""Traces of a refused command: a workspace that was not there before, and in which no stage has ended."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipelines.core.durable import remove
from pipelines.core.errors import GeorefError, WorkspaceBusyError
from pipelines.core.lock import WriteLock
from pipelines.core.requests import REQUESTS
from pipelines.core.stages import STAGES
from pipelines.core.workspace import Workspace


@contextmanager
def no_traces_of_refusal(workspace: Workspace) -> Iterator[None]:
    """Remove what a command wrote, if it fails before the first product of a new workspace.

    Files of others in the folder stay, `georef.toml` among them. An interrupted command keeps what it has written:
    it can be completed.

    Args:
        workspace: not locked by this process.

    Raises:
        GeorefError: the failure.
    """
    missing = [folder for folder in (workspace.root, *workspace.root.parents) if not folder.exists()]
    is_new = workspace.base is None and not workspace.has_begun()
    try:
        yield
    except WorkspaceBusyError:
        raise
    except GeorefError:
        if is_new and not workspace.has_product():
            with contextlib.suppress(OSError, GeorefError):
                _clear(workspace, missing)
        raise


def _clear(workspace: Workspace, missing: Sequence[Path]) -> None:
    """Remove lock, logs, requests and partial products, and the folders that were missing, if they are empty."""
    if not workspace.root.is_dir():
        return
    lock = WriteLock(workspace.root)
    with lock.hold("cleaning up"):
        for spec in STAGES:
            remove(workspace.partial(spec))
            workspace.log_file(spec).unlink(missing_ok=True)
        (workspace.root / REQUESTS).unlink(missing_ok=True)
        lock.discard()
    for folder in (workspace.root / "logs", *missing):
        with contextlib.suppress(OSError):  # of others, or not empty
            folder.rmdir()
