"""Whatever numbers a CSV is written from come back, in every way to write them."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.formats.trajectory_csv import read_trajectory

POSITIONS = st.tuples(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), st.floats(-500.0, 9000.0))
STYLES = st.sampled_from([(",", "."), (";", "."), (";", ","), ("\t", ","), ("\t", ".")])


@settings(deadline=None)
@given(
    rows=st.lists(POSITIONS, min_size=1, max_size=8),
    style=STYLES,
    end=st.sampled_from(["\n", "\r\n"]),
    mark=st.booleans(),
    order=st.permutations(["image", "latitude", "longitude", "altitude"]),
)
def test_csv_round_trip(
    rows: list[tuple[float, float, float]], style: tuple[str, str], end: str, mark: bool, order: list[str]
) -> None:
    separator, point = style
    lines = [separator.join(order)]
    for index, (lat, lon, alt) in enumerate(rows):
        cells = {"image": f"{index}.jpg", "latitude": repr(lat), "longitude": repr(lon), "altitude": repr(alt)}
        texts = (cells[name] if name == "image" else cells[name].replace(".", point) for name in order)
        lines.append(separator.join(texts))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "t.csv"
        path.write_text(("\ufeff" if mark else "") + end.join(lines), encoding="utf-8", newline="")
        table = read_trajectory(path)
    np.testing.assert_array_equal(table.xyz, np.array(rows)[:, [1, 0, 2]])
    assert table.names == tuple(f"{index}.jpg" for index in range(len(rows)))
