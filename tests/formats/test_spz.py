"""SPZ: our files are those that another implementation reads, and forged or damaged ones are refused."""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path

import gsply.spz
import numpy as np
import pytest
import zstandard

from pipelines.core.errors import InputError
from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import SpzVersion, decode_spz, encode_spz, write_spz
from tests.oracles import read_spz
from tests.refusals import numbers, refused


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let gsply decode without compiling its kernel, which takes 12 s."""
    monkeypatch.setattr(gsply.spz, "_decode_spz_kernel", gsply.spz._decode_spz_kernel.py_func)


def splat(count: int = 50, degree: int = 3) -> SplatArrays:
    rng = np.random.default_rng(count + degree)

    def rows(*shape: int) -> np.ndarray:
        return rng.normal(size=(count, *shape)).astype(np.float32)

    return SplatArrays(300 * rows(3), rows(4), rows(3) - 3, 2 * rows(), 0.4 * rows((degree + 1) ** 2, 3))


def same_rotation(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """|cos| of half the angle between rotations."""
    unit = [quats / np.linalg.norm(quats, axis=1, keepdims=True) for quats in (left, right)]
    return np.abs((unit[0] * unit[1]).sum(axis=1))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("version", [3, 4])
def test_gsply_reads_what_we_read(tmp_path: Path, version: SpzVersion, degree: int) -> None:
    write_spz(tmp_path / "s.spz", splat(degree=degree), version)
    ours, theirs = read_spz(tmp_path / "s.spz"), gsply.spz.read_spz(tmp_path / "s.spz")
    np.testing.assert_array_equal(theirs.means, ours.means)
    np.testing.assert_array_equal(theirs.scales, ours.log_scales)
    np.testing.assert_allclose(theirs.quats, ours.quats_wxyz, atol=1e-6)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-6)
    # The two readers make 0 and 255 steps finite in different ways.
    inside = np.abs(ours.logit_opacities) < 5.5
    assert inside.sum() > 40
    np.testing.assert_allclose(theirs.opacities.ravel()[inside], ours.logit_opacities[inside], atol=1e-4)
    if degree:
        np.testing.assert_allclose(theirs.shN, ours.sh[:, 1:], atol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
def test_we_read_what_gsply_writes(tmp_path: Path, version: SpzVersion) -> None:
    truth = splat()
    data = gsply.GSData.from_arrays(
        means=truth.means,
        scales=truth.log_scales,
        quats=truth.quats_wxyz,
        opacities=truth.logit_opacities,
        sh0=truth.sh[:, 0],
        shN=truth.sh[:, 1:],
        format="ply",
    )
    gsply.spz.write_spz(tmp_path / "s.spz", data, version=version)
    ours = read_spz(tmp_path / "s.spz")
    np.testing.assert_allclose(ours.means, truth.means, atol=0.5 / 4096 + 1e-4)
    np.testing.assert_allclose(ours.log_scales, truth.log_scales, atol=1 / 32 + 1e-6)
    assert same_rotation(ours.quats_wxyz, truth.quats_wxyz).min() > np.cos(0.0025)
    inside = np.abs(truth.sh[:, 1:]) < 0.99
    np.testing.assert_allclose(ours.sh[:, 1:][inside], truth.sh[:, 1:][inside], atol=1 / 256 + 1e-6)


def test_version_2_is_read() -> None:
    """By hand: one Gaussian at (1, −2, 0.5), turned by 90° about z."""
    quat = [127.5, 127.5, 127.5 + 127.5 * np.sqrt(0.5)]
    body = b"".join(struct.pack("<i", round(4096 * value))[:3] for value in (1, -2, 0.5))
    body += bytes([128, 255, 128, 0, 160, 176, 144, *(round(value) for value in quat)])
    data = gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 2, 1, 0, 12, 0, 0) + body)
    read = decode_spz(data)
    np.testing.assert_array_equal(read.means, [[1, -2, 0.5]])
    np.testing.assert_array_equal(read.log_scales, [[0, 1, -1]])
    np.testing.assert_allclose(read.quats_wxyz, [[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]], atol=0.01)
    assert read.sh[0, 0, 0] == pytest.approx(0.5 / 0.15)


@pytest.mark.parametrize("place", [2048.0, -2048.0, 2047.99995, 1e9])
def test_positions_out_of_range_are_refused_and_never_wrap(place: float) -> None:
    gaussians = splat(3)
    gaussians.means[1, 2] = place
    with refused("spz-range", InputError) as error:
        encode_spz(gaussians)
    assert numbers(error.value.message)[:3] == [2048, 1, 3]
    # Fewer fractional bits reach further.
    if abs(place) < 4000:
        read = decode_spz(encode_spz(gaussians, fractional_bits=11))
        assert read.means[1, 2] == pytest.approx(place, abs=1 / 4096 + 1e-4)


@pytest.mark.parametrize("name", ["means", "quats_wxyz", "log_scales", "logit_opacities", "sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(name: str, value: float) -> None:
    gaussians = splat(3)
    getattr(gaussians, name)[1] = value
    with refused("values-not-finite", InputError) as error:
        encode_spz(gaussians)
    assert error.value.field == name
    gaussians = splat(3)
    gaussians.quats_wxyz[1] = 0
    with refused("quaternion-length", InputError):
        encode_spz(gaussians)


def test_bombs_are_refused_before_memory_is_taken(tmp_path: Path) -> None:
    head = struct.pack("<IIIBBBB", 0x5053474E, 3, 2**32 - 1, 3, 12, 0, 0)
    (tmp_path / "s.spz").write_bytes(gzip.compress(head + bytes(2**20)))
    with refused("unpacks-too-large", InputError) as error:
        read_spz(tmp_path / "s.spz")
    assert error.value.path == tmp_path / "s.spz" and numbers(error.value.message)[-1] == 16
    # A stream of zeros that is a thousand times longer than its header promises.
    honest = struct.pack("<IIIBBBB", 0x5053474E, 3, 1, 0, 12, 0, 0)
    with refused("size-differs", InputError) as error:
        decode_spz(gzip.compress(honest + bytes(2**20)))
    assert "more" in error.value.message
    packed = zstandard.compress(bytes(2**24))
    v4 = struct.pack("<IIIBBBBI12x", 0x5053474E, 4, 1, 0, 12, 0, 5, 32)
    v4 += b"".join(struct.pack("<QQ", len(packed), size) for size in (9, 1, 3, 3, 4)) + 5 * packed
    with refused("unpacked-size-differs", InputError):
        decode_spz(v4)


@pytest.mark.parametrize(
    ("place", "value", "code", "words"),
    [
        (0, 0, "not-an-spz", ""),
        (4, 9, "spz-version", " 9;"),
        (12, 4, "spz-header", "degree 4"),
        (13, 0, "spz-header", "0 fractional"),
        (14, 2, "spz-extensions", ""),
    ],
)
@pytest.mark.parametrize("version", [3, 4])
def test_other_headers_are_refused(version: SpzVersion, place: int, value: int, code: str, words: str) -> None:
    data = encode_spz(splat(3), version)
    plain = bytearray(zlib.decompress(data, 31) if version == 3 else data)
    plain[place] = value
    with refused(code, InputError) as error:
        decode_spz(gzip.compress(plain) if version == 3 else bytes(plain))
    assert words in error.value.message
