"""Compilation of the kernels.

1. A kernel is a short parallel loop over workers (`parallel_jit`).
2. Each worker runs one serial function (`worker_jit`), because the parallel compiler is slow on long bodies.
3. The serial function is made of small functions (`jit`). These are always inlined: the reference counts of arrays
   passed between threads would cost more than the work.
4. Numba's cache keeps only the functions that Python calls. They contain the others.

Of all flags that allow the compiler to reorder or assume, only fused multiply-add is set: results are reproducible.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}

jit: Any = njit(forceinline=True, **_OPTIONS)
worker_jit: Any = njit(**_OPTIONS)
kernel_jit: Any = njit(cache=True, **_OPTIONS)
parallel_jit: Any = njit(cache=True, parallel=True, **_OPTIONS)
