"""Gaussians that are written as SPZ and read again differ by no more than half a step of the format."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipelines.core.errors import InputError
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import SpzVersion, decode_spz, encode_spz


@st.composite
def splats(draw: st.DrawFn) -> SplatArrays:
    count, degree = draw(st.integers(1, 12)), draw(st.integers(0, 3))

    def rows(bound: float, *shape: int) -> np.ndarray:
        number = st.floats(-bound, bound, width=32)
        return draw(hnp.arrays(np.float32, (count, *shape), elements=number))

    quats = rows(8, 4)
    quats[~quats.any(axis=1)] = [0, 0, 1, 0]
    return SplatArrays(rows(2047, 3), quats, rows(20, 3), rows(50), rows(8, (degree + 1) ** 2, 3))


@given(splat=splats(), version=st.sampled_from([3, 4]))
@settings(max_examples=40, deadline=None)
def test_round_trip_within_the_bounds_of_the_format(splat: SplatArrays, version: SpzVersion) -> None:
    again = decode_spz(encode_spz(splat, version))
    rounding = 1e-6
    np.testing.assert_allclose(again.means, splat.means, rtol=1e-7, atol=0.5 / 4096 + rounding)
    scales = np.clip(splat.log_scales, -10, 255 / 16 - 10)
    np.testing.assert_allclose(again.log_scales, scales, atol=0.5 / 16 + rounding)
    opacity, expected = (1 / (1 + np.exp(-np.float64(one.logit_opacities))) for one in (again, splat))
    np.testing.assert_allclose(opacity, expected, atol=0.5 / 255 + rounding)
    limit = 127.5 / 38.25
    constant = np.clip(splat.sh[:, 0], -limit, limit)
    np.testing.assert_allclose(again.sh[:, 0], constant, atol=0.5 / 38.25 + rounding)
    # The topmost step, 256, does not fit into a byte: 255 takes its place.
    for columns, step in ((slice(1, 4), 1 / 16), (slice(4, None), 1 / 8)):
        higher = np.clip(splat.sh[:, columns], -1, 1)
        np.testing.assert_allclose(again.sh[:, columns], higher, atol=step / 2 + 1 / 128 + rounding)
    # Three components are off by half a step of √½ / 511, the fourth by at most three times as much, and the angle
    # by twice the length of that error: 4.8 mrad.
    left, right = (one.quats_wxyz.astype(np.float64) for one in (again, splat))
    cosine = np.abs((left * right).sum(axis=1)) / np.linalg.norm(left, axis=1) / np.linalg.norm(right, axis=1)
    assert 2 * np.arccos(np.minimum(cosine, 1)).max() < 0.0048 + rounding


@given(noise=st.binary(max_size=200), cut=st.integers(0, 400), version=st.sampled_from([3, 4]))
@settings(max_examples=40, deadline=None)
def test_damaged_files_are_refused_with_a_message(noise: bytes, cut: int, version: SpzVersion) -> None:
    ones = np.ones((2, 3), dtype=np.float32)
    whole = encode_spz(SplatArrays(ones, np.ones((2, 4), np.float32), ones, ones[:, 0], ones[:, None]), version)
    data = whole[: cut % len(whole)]
    with pytest.raises(InputError):
        decode_spz(data)
    # Damage to bytes that mean nothing, such as the time in the gzip header, is none.
    with contextlib.suppress(InputError):
        decode_spz(data + noise + whole[len(data) + len(noise) :])
