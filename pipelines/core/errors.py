"""Known failures; each message states the fault, its place and the remedy.

The command line prints a `GeorefError` as one message. Every other exception is a defect and keeps its traceback.
"""

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

from pipelines.core.sentences import with_remedy


class GeorefError(Exception):
    """Failure that the user can understand and act on.

    Attributes:
        kind: class of the failure, for machines.
        code: the failure itself, for machines and tests: lower-case words joined by hyphens, stable while the
            wording of the message changes.
        fault: what is wrong, with its place.
        remedy: what to type against it, where that is known apart from the fault; as of a `Remark`.

    As a text it is both.
    """

    kind: ClassVar[str] = "failed"

    def __init__(self, code: str, message: str, *, remedy: str = "") -> None:
        super().__init__(with_remedy(message, remedy))
        self.code, self.fault, self.remedy = code, message, remedy

    def document(self) -> dict[str, str | int | None]:
        """Return the JSON form: kind, code, message, path, line, field and remedy."""
        nowhere = dict.fromkeys(("path", "line", "field"))
        remedy = self.remedy or None
        return {"kind": self.kind, "code": self.code, "message": self.fault, **nowhere, "remedy": remedy}


class InputError(GeorefError):
    """Bad input: a file, a line (counted from 1) or field of it, or an option."""

    kind = "input"

    def __init__(
        self,
        code: str,
        message: str,
        *,
        path: Path | str | None = None,
        line: int | None = None,
        field: str | None = None,
        remedy: str = "",
    ) -> None:
        self.message = message
        self.path = Path(path) if path is not None else None
        self.line = line
        self.field = field
        where = "" if path is None else str(path) + (f":{line}" if line is not None else "")
        if field is not None:
            where = f"{where} [{field}]" if where else f"[{field}]"
        super().__init__(code, f"{where}: {message}" if where else message, remedy=remedy)

    @property
    def is_usage(self) -> bool:
        """Whether the fault lies in the options on the command line alone, and in no file."""
        return self.path is None and self.field is not None and self.field.startswith("--")

    def document(self) -> dict[str, str | int | None]:
        """Return the JSON form; the message is without path and field."""
        return {
            **super().document(),
            "kind": "usage" if self.is_usage else self.kind,
            "message": self.message,
            "path": None if self.path is None else str(self.path),
            "line": self.line,
            "field": self.field,
        }


class MissingProductError(GeorefError):
    """Missing product of another stage: its workspace path, and the command line that makes it."""

    kind = "missing-product"

    def __init__(self, product: str, command: str) -> None:
        self.product = product
        self.command = command
        super().__init__("missing-product", f"{product} is missing.", remedy=f"Run `{command}` first.")


class WorkspaceBusyError(GeorefError):
    """Workspace that another process is writing to."""

    kind = "busy"


class DegenerateGeometryError(GeorefError):
    """Observations that do not determine the unknowns (parallel rays, collinear cameras …)."""

    kind = "geometry"


class InconsistencyError(GeorefError):
    """Sources that are inconsistent as a whole; the message names both sides and what would reconcile them."""

    kind = "inconsistent"


class ConvergenceError(GeorefError):
    """Optimisation that diverged, or ended outside the bound that the user set."""

    kind = "convergence"


class ResourceError(GeorefError):
    """Machine too small for the options; the message names options that need less."""

    kind = "resources"


class CrashError(GeorefError):
    """Native library that ended its process."""

    kind = "crash"


class BackendUnavailableError(GeorefError):
    """Missing optional library or device; the message names the extra to install."""

    kind = "backend"


class ClusterError(GeorefError):
    """Cluster of which no scheduler answers, or none of whose workers can run the jobs."""

    kind = "cluster"


class StorageError(GeorefError):
    """Disk or file system that is full, fails, or may not be written; names the file."""

    kind = "storage"


class DamagedPartialError(InputError):
    """Partial product of an interrupted run that cannot be continued; the runner starts the stage afresh."""

    kind = "damaged-partial"


_SQLITE_ERRNO = {8: errno.EROFS, 10: errno.EIO, 13: errno.ENOSPC}
_WRITTEN_IN_PART = re.compile(r"\d+ requested and \d+ written")  # numpy: a full disk
_DISK_FAILURES = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
_NATIVE_WORDS = {
    "disk is full": errno.ENOSPC,
    "No space left on device": errno.ENOSPC,
    "quota exceeded": errno.EDQUOT,
    "disk I/O error": errno.EIO,
    "Input/output error": errno.EIO,
    "readonly database": errno.EROFS,
    "Read-only file system": errno.EROFS,
}
_STORAGE_REASONS = {
    errno.ENOSPC: "the disk is full.",
    errno.EDQUOT: "the disk quota is used up. Delete files, or have it raised.",
    errno.EFBIG: "the file would be larger than the system allows.",
    errno.EIO: "the disk reports an input/output error. Check the disk, then run the command again.",
    errno.EROFS: "the file system is read-only. Use a workspace elsewhere.",
    errno.EACCES: "permission is denied. Change the permissions, or use a workspace elsewhere.",
    errno.EPERM: "permission is denied. Change the permissions, or use a workspace elsewhere.",
    errno.ENAMETOOLONG: "the name is too long. File names have at most 255 bytes.",
    errno.ELOOP: "symbolic links lead in a circle.",
    errno.ENOTDIR: "a file stands where a folder is needed. Move it away.",
    errno.EISDIR: "a folder stands where a file is needed. Move it away.",
    errno.EEXIST: "a file stands where a folder is needed. Move it away.",
    errno.EMFILE: "too many files are open. Raise the limit (`ulimit -n`).",
    errno.ESTALE: "the network file system has lost the file. Mount it again.",
}


def storage_error(error: BaseException, target: Path | None = None) -> StorageError | None:
    """Return the storage failure behind an exception, or None.

    Libraries replace an OSError by an error of their own while they close a half-written file. Failures
    of the disk count also if the exception arose in their handling.

    Args:
        target: file or folder that was written, for failures that name none, mostly those of a full disk.
    """
    seen: set[int] = set()
    cause: BaseException | None = error
    while cause is not None and id(cause) not in seen:
        seen.add(id(cause))
        code = cause.errno if isinstance(cause, OSError) else None
        # An error of sqlite3, known by its code: the module need not be imported for it.
        code = _SQLITE_ERRNO.get(getattr(cause, "sqlite_errorcode", 0) & 0xFF, code)
        if isinstance(cause, OSError) and _WRITTEN_IN_PART.fullmatch(str(cause)):
            code = errno.ENOSPC
        if code in _STORAGE_REASONS and (cause is error or code in _DISK_FAILURES):
            path = getattr(cause, "filename", None)
            return StorageError(*_storage_message(code, path or target or "workspace or output"))
        cause = cause.__cause__ or cause.__context__
    return None


def storage_error_in(text: str, path: Path) -> StorageError | None:
    """Return the storage failure at a path that messages of SQLite or of the C library name, or None."""
    code = next((code for words, code in _NATIVE_WORDS.items() if words in text), None)
    return None if code is None else StorageError(*_storage_message(code, path))


def _storage_message(code: int, path: Path | str) -> tuple[str, str]:
    """Return code and message of a storage failure, e.g. `storage-enospc`."""
    return f"storage-{errno.errorcode[code].lower()}", f"{path}: {_STORAGE_REASONS[code]}"


@contextmanager
def storage_failures(target: Path | None = None) -> Iterator[None]:
    """Turn storage failures of any library into `StorageError` while the context lasts; `place` as above."""
    try:
        yield
    except GeorefError:
        raise
    except Exception as error:
        storage = storage_error(error, target)
        if storage is None:
            raise
        raise storage from error
