"""Cache of compiled kernels: the user's own, for all checkouts and environments, by the content of the sources.

numba keeps compiled functions beside their source and goes by its time: each clone compiles again, and a kernel
whose callee changed in another file is not recompiled. Here the folder of a kernel is named by a hash of its module
and of all modules of this program that it imports, since kernels take functions and constants from these.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import njit
from numba.core.base import BaseContext as TargetContext
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.compiler import CompileResult
from numba.core.typing.templates import Signature

from pipelines.core.machine import user_cache

log = logging.getLogger(__name__)

_HOME = Path(__file__).parents[2]
_IMPORTS = re.compile(r"^ *from (pipelines[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)
_MOST_FOLDERS = 60  # one a kernel's module and version of its sources


_Kernel = Callable[..., Any]  # that numba compiles
_NumbaOption = Any  # of its `njit`


def kernel(**options: _NumbaOption) -> Callable[[_Kernel], Any]:
    """Return numba's `njit` with options, for functions that Python calls: compiled once for this user."""

    def compiled(function: _Kernel) -> Any:
        dispatcher: Any = njit(**options)(function)
        dispatcher._cache = _UserCache(function)
        return dispatcher

    return compiled


def cache_folder() -> Path:
    """Return the folder of all compiled kernels: below NUMBA_CACHE_DIR, or the user's cache."""
    stated = os.environ.get("NUMBA_CACHE_DIR")
    return Path(stated) if stated else user_cache() / "kernels"


def compilation_stamp(module: str) -> Path:
    """Return the file that a compilation of all kernels below a module leaves, for this numba and processor."""
    file = _HOME.joinpath(*module.split(".")).with_suffix(".py")
    return cache_folder() / _digest(file) / f"numba-{numba.__version__}-{llvm.get_host_cpu_name()}.compiled"


@cache
def _digest(module: Path) -> str:
    modules, open_ = {module}, [module]
    while open_:
        for name, members in _IMPORTS.findall(open_.pop().read_text(encoding="utf-8")):
            place = _HOME.joinpath(*name.split("."))
            files = [place.with_suffix(".py"), *(place / f"{one}.py" for one in re.findall(r"\w+", members))]
            new = {file for file in files if file.is_file()} - modules
            modules |= new
            open_ += new
    digest = hashlib.sha256()
    for file in sorted(modules):
        digest.update(f"{os.path.relpath(file, _HOME)}\n".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


class _Locator:
    """Place of a kernel's compiled forms, as numba asks for it."""

    def __init__(self, function: _Kernel, module: Path) -> None:
        self._folder = cache_folder() / _digest(module)
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: _Kernel, file: str) -> _Locator:
        return cls(function, Path(file))

    def ensure_cache_path(self) -> None:
        """Make the folder, which nobody else may write: numba's files are pickles. Old folders go."""
        if not self._folder.is_dir():
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            others = sorted(self._folder.parent.iterdir(), key=lambda folder: folder.stat().st_mtime)
            for folder in others[:-_MOST_FOLDERS]:
                shutil.rmtree(folder, ignore_errors=True)

    def get_cache_path(self) -> str:
        return str(self._folder)

    def get_source_stamp(self) -> str:
        return self._folder.name

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Compiled(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  (numba declares it for instances)


class _UserCache(FunctionCache):
    """Cache that computes anew what it cannot read, and goes without what it cannot write."""

    _impl_class = _Compiled

    def load_overload(self, sig: Signature, target_context: TargetContext) -> Any:
        folder = Path(self.cache_path)
        try:
            if not folder.is_dir() or not _is_own(folder):
                return None
            os.utime(folder, (time.time(),) * 2)  # the folders that are used longest ago go first
            return super().load_overload(sig, target_context)
        except Exception as error:  # Whatever a damaged pickle raises.
            log.debug("compiled kernels in %s cannot be read: %s", folder, error)
            return None

    def save_overload(self, sig: Signature, data: CompileResult) -> None:
        try:
            self._impl.locator.ensure_cache_path()
            if _is_own(Path(self.cache_path)):
                super().save_overload(sig, data)
        except Exception as error:  # As above: numba adds to an index that it reads.
            log.debug("compiled kernels cannot be kept in %s: %s", self.cache_path, error)


def _is_own(folder: Path) -> bool:
    """Return whether no other user can have written into a folder."""
    if not hasattr(os, "getuid"):
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & 0o022
