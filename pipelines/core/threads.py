"""Number of threads that this process and its children compute with.

OpenMP, BLAS and numba read their variables when they are loaded. The limit is therefore set before the first stage
is imported.
"""

from __future__ import annotations

import os

_STANDARD = "OMP_NUM_THREADS"
_VARIABLES = (_STANDARD, "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS")


def limit_threads(count: int) -> None:
    """Limit the threads of libraries that are loaded from now on, here and in child processes.

    Args:
        count: 1 or more; more than there are cores counts as all of them.

    Raises:
        ValueError: the count is less than 1.
    """
    if count < 1:
        raise ValueError(f"{count} threads: at least 1 is needed")
    for name in _VARIABLES:
        os.environ[name] = str(min(count, available_cores()))


def thread_count() -> int:
    """Return the number of threads to compute with: the limit (`OMP_NUM_THREADS`), or the cores of this process."""
    text = os.environ.get(_STANDARD, "")
    return int(text) if text.isdecimal() and int(text) > 0 else available_cores()


def chosen_threads(option: int) -> int:
    """Return the number of threads that a stage's option asks for; 0 and less stand for `thread_count`."""
    return option if option > 0 else thread_count()


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(len(os.sched_getaffinity(0)), 1)
    return os.cpu_count() or 1
