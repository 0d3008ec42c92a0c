"""Input files that block, never end, or ask for more memory than they have bytes."""

from __future__ import annotations

import io
import os
import socket
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, read_npz
from tests.refusals import numbers, refused

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no pipes and devices in folders")


def test_size_of_a_file_and_of_what_a_link_leads_to(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"123")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert file_size(tmp_path / "link", limit_bytes=3) == 3
    with refused("file-too-large", InputError) as error:
        file_size(tmp_path / "a", limit_bytes=2, kind="text table", field="--gcp")
    assert str(error.value).startswith(f"{tmp_path / 'a'} [--gcp]: ")
    assert numbers(error.value.message) == [0, 0]  # MiB


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
    for path, kind in (
        (tmp_path / "pipe", "a named pipe"),
        (tmp_path / "s", "a socket"),
        (tmp_path / "link", "a device"),
        (Path("/dev/zero"), "a device"),
        (tmp_path, "a folder"),
        (tmp_path / "gone", "No such file or directory"),
        (Path("a\0b"), "embedded null"),
    ):
        with refused(
            "file-unreadable" if kind[0].isupper() or "null" in kind else "not-a-file", InputError
        ) as error:
            file_size(path)
        assert kind in str(error.value)


def test_arrays_are_read_as_written(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 7), np.int32)}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    again = read_npz(tmp_path / "a.npz")
    assert sorted(again) == ["a", "b", "c"]
    for name, array in arrays.items():
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype
    assert list(read_npz(tmp_path / "a.npz", ("b",))) == ["b"]


def forged(shape: str, content: bytes, descr: str = "<f8") -> bytes:
    """An NPZ file with one array, whose header states that shape."""
    header = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content)
    return stream.getvalue()


@pytest.mark.parametrize(
    ("shape", "descr", "cause"),
    [
        ("(1000000000000,)", "<f8", "promises 8000000000000 bytes, the entry holds 16"),
        ("(10**9,)", "<f8", ""),
        ("(-2, -1)", "<f8", ""),
        ("(2.0,)", "<f8", ""),
        ("(1,)", "|O", "allow_pickle=False"),
        ("(1,", "<f8", ""),
        ("(" * 300 + "1" + ",)" * 300, "<f8", ""),
    ],
    ids=["huge", "product", "negative", "fraction", "objects", "unclosed", "nested"],
)
def test_headers_are_checked_before_the_data(tmp_path: Path, shape: str, descr: str, cause: str) -> None:
    (tmp_path / "a.npz").write_bytes(forged(shape, bytes(16), descr))
    with refused("npz-damaged", InputError) as error:
        read_npz(tmp_path / "a.npz", ("a",))
    assert cause in str(error.value)


def test_zeros_that_unpack_to_more_than_the_limit_are_refused_unread(tmp_path: Path) -> None:
    header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({300 * 2**17},), }}".ljust(117).encode() + b"\n"
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("a.npy", "w") as entry,
    ):
        entry.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(300 * 2**20))
    with refused("npz-damaged", InputError) as error:
        read_npz(tmp_path / "a.npz", ("a",))
    assert numbers(error.value.message) == [300, 256]  # MiB
