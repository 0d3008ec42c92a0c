"""Known failures; each message states the fault, its place and the remedy.

The command line prints a `GeorefError` as one message and exits with 1. Every other exception is a defect and keeps
its traceback.
"""

from __future__ import annotations

from pathlib import Path


class GeorefError(Exception):
    """Failure that the user can understand and act on."""


class InputError(GeorefError):
    """Bad input: a file, a line or field of it, or an option.

    Args:
        message: the fault and its remedy.
        path: the file at fault.
        line: 1-based line number in `path`.
        field: column, tag or option at fault.
    """

    def __init__(
        self,
        message: str,
        *,
        path: Path | str | None = None,
        line: int | None = None,
        field: str | None = None,
    ) -> None:
        self.path = Path(path) if path is not None else None
        self.line = line
        self.field = field
        where = "" if path is None else str(path) + (f":{line}" if line is not None else "")
        if field is not None:
            where = f"{where} [{field}]" if where else f"[{field}]"
        super().__init__(f"{where}: {message}" if where else message)


class MissingProductError(GeorefError):
    """Missing product of another stage.

    Args:
        product: workspace-relative path of the product.
        command: the command line that makes it.
    """

    def __init__(self, product: str, command: str) -> None:
        self.product = product
        self.command = command
        super().__init__(f"{product} is missing: run `{command}` first")


class WorkspaceBusyError(GeorefError):
    """Workspace that another process is writing to."""


class DegenerateGeometryError(GeorefError):
    """Observations that do not determine the unknowns (parallel rays, collinear cameras …)."""


class ContradictionError(GeorefError):
    """Sources that contradict each other as a whole; the message names both sides and what would reconcile them."""


class ConvergenceError(GeorefError):
    """Optimisation that diverged, or ended outside the bound that the user set."""


class ResourceError(GeorefError):
    """Machine too small for the options; the message names options that need less."""


class CrashError(GeorefError):
    """Native library that ended its process."""


class BackendUnavailableError(GeorefError):
    """Missing optional library or device; the message names the extra to install."""
