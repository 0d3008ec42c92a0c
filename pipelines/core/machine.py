"""Number of threads that this process and its children use, and main memory, of the machine or of a container.

OpenMP, BLAS and numba read their variables when they are loaded. The limit is therefore set before the first stage
is imported.
"""

import ctypes
import os
import sys
from pathlib import Path

_OPENMP = "OMP_NUM_THREADS"
_VARIABLES = (_OPENMP, "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS")


def limit_threads(count: int) -> None:
    """Limit the threads, from 1 to all cores, of libraries that are loaded from now on, also in child processes."""
    if count < 1:
        raise ValueError(f"{count} threads: at least 1 is needed")
    for name in _VARIABLES:
        os.environ[name] = str(min(count, available_cores()))


def thread_count() -> int:
    """Return the number of threads to compute with: the limit (`OMP_NUM_THREADS`), or the cores of this process."""
    text = os.environ.get(_OPENMP, "")
    return int(text) if text.isdecimal() and int(text) > 0 else available_cores()


def chosen_threads(option: int) -> int:
    """Return the number of threads that a stage's option asks for; 0 and less stand for `thread_count`."""
    return option if option > 0 else thread_count()


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1


def free_main_memory_bytes() -> int | None:
    """Return the memory that programs may still take; None if the system does not state it."""
    known = [free for free in (_free_in_system(), _free_in_group(Path("/sys/fs/cgroup"))) if free is not None]
    return min(known) if known else None


def peak_memory_bytes() -> int | None:
    """Return the most main memory that this process has held so far; None if the system does not state it."""
    # First Linux's own line: `ru_maxrss` of a new process starts there at what its parent had.
    if (kib := _kib_of(Path("/proc/self/status"), "VmHWM:")) is not None:
        return 1024 * kib
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _kib_of(table: Path, name: str) -> int | None:
    try:
        lines = table.read_text(encoding="utf-8", errors="replace").splitlines()
        return next((int(line.split()[1]) for line in lines if line.startswith(name)), None)
    except (OSError, ValueError):
        return None


def _free_in_system() -> int | None:
    if sys.platform == "win32":
        status = _WindowsMemory(length=ctypes.sizeof(_WindowsMemory))
        return status.free_bytes if ctypes.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)) else None
    kib = _kib_of(Path("/proc/meminfo"), "MemAvailable:")
    return total_main_memory_bytes() if kib is None else 1024 * kib


def total_main_memory_bytes() -> int | None:
    """Return the memory of the machine; None if the system does not state it."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


class _WindowsMemory(ctypes.Structure):
    """MEMORYSTATUSEX of the Windows API."""

    _fields_ = (
        ("length", ctypes.c_uint32),
        ("load_percent", ctypes.c_uint32),
        ("total_bytes", ctypes.c_uint64),
        ("free_bytes", ctypes.c_uint64),
        ("paging", ctypes.c_uint64 * 2),
        ("address_space", ctypes.c_uint64 * 3),
    )

    length: int
    free_bytes: int


def _free_in_group(root: Path) -> int | None:
    """Return the memory that a container's control group (v2) leaves; droppable file cache counts as free."""
    try:
        limit = (root / "memory.max").read_text(encoding="ascii").strip()
        if limit == "max":
            return None
        used = int((root / "memory.current").read_text(encoding="ascii"))
        rows = (line.split() for line in (root / "memory.stat").read_text(encoding="ascii").splitlines())
        cache = next((int(value) for name, value in rows if name == "inactive_file"), 0)
        return max(int(limit) - used + cache, 0)
    except (OSError, ValueError):
        return None
