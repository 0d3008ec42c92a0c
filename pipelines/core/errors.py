"""Known failures. Each message says what happened, where, and what to do next.

The command line prints any `GeorefError` as one message and exits with 1; every other exception is a
defect and keeps its traceback.
"""

from __future__ import annotations

from pathlib import Path


class GeorefError(Exception):
    """A failure that the user can understand and act on."""


class InputError(GeorefError):
    """Bad input: a file, a line or field of it, or an option.

    Args:
        message: what is wrong and what to do.
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
    """A stage needs a product that is not there yet.

    Args:
        product: workspace-relative path of the product.
        command: the command line that makes it.
    """

    def __init__(self, product: str, command: str) -> None:
        self.product = product
        self.command = command
        super().__init__(f"{product} is missing: run `{command}` first")


class WorkspaceBusyError(GeorefError):
    """Another process is writing to the workspace."""


class DegenerateGeometryError(GeorefError):
    """The observations do not determine the unknowns (parallel rays, collinear cameras …)."""


class ConvergenceError(GeorefError):
    """An optimisation diverged, or ended outside the bound that the user set."""


class ResourceError(GeorefError):
    """The machine is too small for what was asked; the message says what to ask for instead."""


class BackendUnavailableError(GeorefError):
    """An optional library or device is missing; the message names the extra to install."""
