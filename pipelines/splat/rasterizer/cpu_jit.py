"""How the kernels are compiled.

A kernel is a short parallel loop over workers (`parallel_jit`), each of which runs one serial function
(`worker_jit`: the parallel compiler is slow on long bodies) made of small ones (`jit`, always inlined: the
reference counts of arrays passed between threads would cost more than the work). Only what Python calls is
kept in numba's cache; it contains the rest.

No flag lets the compiler reorder or assume anything, but for fused multiply-add: results are reproducible.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}

jit: Any = njit(forceinline=True, **_OPTIONS)
worker_jit: Any = njit(**_OPTIONS)
kernel_jit: Any = njit(cache=True, **_OPTIONS)
parallel_jit: Any = njit(cache=True, parallel=True, **_OPTIONS)
