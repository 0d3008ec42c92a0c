"""The vector type does what numpy does, in both widths."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from pipelines.splat.rasterizer.cpu_lanes import (
    LANES,
    any_positive,
    exp,
    load,
    splat,
    store,
    store_totals,
    where_greater,
)


@numba.njit
def _arithmetic(a, b, out):
    x, y = load(a, 1), load(b, 0)
    store(out, 1, where_greater(x, y, x * y - x, x / y + splat(a[0])))
    return any_positive(x), any_positive(x - x)


@numba.njit
def _exponential(a, out):
    store(out, 0, exp(load(a, 0)))


@numba.njit
def _sums(a, out):
    store_totals(out, 1, load(a, 0), load(a, LANES), load(a, 2 * LANES), load(a, 3 * LANES))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arithmetic(dtype):
    random = np.random.default_rng(0)
    a, b = random.uniform(0.5, 2, LANES + 1).astype(dtype), random.uniform(0.5, 2, LANES).astype(dtype)
    out = np.zeros(LANES + 2, dtype=dtype)
    assert _arithmetic(a, b, out) == (True, False)
    x = a[1:]
    np.testing.assert_allclose(out[1:-1], np.where(x > b, x * b - x, x / b + a[0]), rtol=1e-5)
    assert out[0] == out[-1] == 0


@pytest.mark.parametrize(("dtype", "bound"), [(np.float32, 3e-6), (np.float64, 1e-15)])
def test_exp_where_blending_needs_it(dtype, bound):
    x, y = np.linspace(-5.56, 0, 64 * LANES, dtype=dtype).reshape(-1, LANES), np.empty(LANES, dtype=dtype)
    for row in x:
        _exponential(row, y)
        np.testing.assert_allclose(y, np.exp(row.astype(np.float64)), rtol=bound)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_totals(dtype):
    a, out = np.random.default_rng(1).normal(size=4 * LANES).astype(dtype), np.zeros(6, dtype=dtype)
    _sums(a, out)
    np.testing.assert_allclose(out, [0, *a.reshape(4, LANES).sum(axis=1), 0], rtol=1e-4)
