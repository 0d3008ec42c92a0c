"""Threads that this process and its children use, main memory, of the machine or of a container, and the cache.

OpenMP, BLAS and numba read their variables when they are loaded. The limit is therefore set before the first stage
is imported.
"""

import contextlib
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


def user_cache() -> Path:
    """Return the folder of what this program keeps for the user from run to run; it may not exist."""
    import platformdirs

    return platformdirs.user_cache_path("georefgs", appauthor=False)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1


def free_main_memory_bytes() -> int:
    """Return the memory that programs may still take."""
    import psutil

    free = int(psutil.virtual_memory().available)
    in_group = _free_in_group(Path("/sys/fs/cgroup"))
    return free if in_group is None else min(free, in_group)


def total_main_memory_bytes() -> int:
    """Return the memory of the machine."""
    import psutil

    return int(psutil.virtual_memory().total)


def peak_memory_bytes() -> int | None:
    """Return the most main memory that this process has held so far; None if the system does not state it."""
    # First Linux's own line: `ru_maxrss` of a new process starts there at what its parent had.
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/self/status").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


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
