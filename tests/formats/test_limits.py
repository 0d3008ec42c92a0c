"""Readers of text are linear, and refuse what would take more memory than a file of its size needs."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.core.errors import InputError
from pipelines.core.options import read_toml
from pipelines.formats import tables
from pipelines.formats.ground_points import read_ground_points
from pipelines.formats.metashape import read_markers_xml
from pipelines.formats.trajectory_csv import read_trajectory
from tests.refusals import refused

MIB = 1 << 20
HEAD = "<document><chunk><markers>"


def peak_mib(read: Callable[[], object]) -> float:
    """Most memory that a call holds at a time."""
    tracemalloc.start()
    try:
        read()
        return tracemalloc.get_traced_memory()[1] / MIB
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("read", "content", "code", "words", "most_mib"),
    [
        # Before: ten bytes for each line end, and a hundred in a table of points.
        (read_ground_points, b"\n" * MIB, "too-many-lines", "10000 lines", 2),
        (read_trajectory, b"a,b\n" + b"," * MIB, "line-too-long", ":2: |65536 ", 1),
        # Before: the square of the parts of a key. A thousand of them took 4 MiB.
        (read_toml, b".".join([b"a"] * 3000) + b"=1", "toml-invalid", "16 parts|line 1", 1),
        (read_toml, b"[b]\n[" + b" . ".join([b"'a'"] * 3000) + b"]", "toml-invalid", "16 parts|line 2", 1),
        (read_toml, b"seed=" + b"9" * 5000, "toml-invalid", "64 bits", 1),
        (read_toml, b"seed=[{a=0x" + b"9" * 50 + b"}]", "toml-invalid", "64 bits", 1),
        (read_markers_xml, f"{HEAD}<a b='{'c' * 3 * MIB}'/>".encode(), "xml-tag-too-long", "1 MiB", 12),
        (read_markers_xml, b"<a><reference>" + b"c\n" * MIB, "crs-too-long", "65536", 12),
    ],
)
def test_what_a_file_may_ask_for_is_bounded(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    read: Callable[[Path], object],
    content: bytes,
    code: str,
    words: str,
    most_mib: float,
) -> None:
    path = tmp_path / "hostile"
    path.write_bytes(content)
    monkeypatch.setattr(tables, "MOST_LINES", 10_000)  # a hundredth

    def read_in_vain() -> None:
        with refused(code, InputError) as error:
            read(path)
        assert error.value.path == path and all(word in str(error.value) for word in words.split("|"))

    read_in_vain()  # so that imports do not count
    assert peak_mib(read_in_vain) < most_mib


def test_a_wide_header_does_not_widen_its_rows(tmp_path: Path) -> None:
    """Ten thousand rows of four cells below a header of 10 000: 800 MB when they were filled up."""
    path = tmp_path / "track.csv"
    path.write_text("timestamp,x,y,z" + ",a" * 10_000 + "\n" + "1,2,3,4\n2,2,3,4\n" * 5000, "utf-8")
    assert peak_mib(lambda: read_trajectory(path)) < 20


def test_markers_take_time_in_proportion(tmp_path: Path) -> None:
    """Four times the markers: four times the time, and sixteen when each was compared with all before it."""

    def seconds(count: int) -> float:
        markers = (f'<marker id="{i}" label="p{i}"><reference x="{i}" y="1" z="2"/></marker>' for i in range(count))
        path = tmp_path / f"{count}.xml"
        path.write_text(f"{HEAD}{''.join(markers)}</markers></chunk></document>", "utf-8")
        times = []
        for _ in range(3):
            began = time.process_time()
            assert len(read_markers_xml(path).points) == count
            times.append(time.process_time() - began)
        return min(times)

    assert seconds(20_000) < 9 * seconds(5000)
