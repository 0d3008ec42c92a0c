"""Gaussians that are written and read again are the same, bit by bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipelines.core.errors import InputError
from pipelines.formats.splat_ply import SplatArrays, read_splat_ply, write_splat_ply

finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


@st.composite
def splats(draw: st.DrawFn) -> SplatArrays:
    count, degree = draw(st.integers(1, 20)), draw(st.integers(0, 3))

    def rows(*shape: int) -> np.ndarray:
        return draw(hnp.arrays(np.float32, (count, *shape), elements=finite))

    return SplatArrays(rows(3), rows(4), rows(3), rows(), rows((degree + 1) ** 2, 3))


@given(splat=splats())
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_round_trip(tmp_path: Path, splat: SplatArrays) -> None:
    path = tmp_path / "splat.ply"
    write_splat_ply(path, splat)
    again = read_splat_ply(path)
    for name, values in vars(splat).items():
        np.testing.assert_array_equal(getattr(again, name), values)
    assert [file.name for file in tmp_path.iterdir()] == ["splat.ply"]


@given(noise=st.binary(max_size=400), cut=st.integers(0, 600))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_files_are_refused_with_a_message(tmp_path: Path, noise: bytes, cut: int) -> None:
    path = tmp_path / "splat.ply"
    ones = np.ones((2, 3), dtype=np.float32)
    write_splat_ply(path, SplatArrays(ones, np.ones((2, 4), np.float32), ones, ones[:, 0], ones[:, None]))
    whole = path.read_bytes()
    path.write_bytes(whole[: cut % len(whole)] + noise)
    if len(path.read_bytes()) != len(whole):
        with pytest.raises(InputError, match=r"splat\.ply"):
            read_splat_ply(path)
