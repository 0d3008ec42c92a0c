"""Whatever bytes a file holds, a reader answers or raises InputError: never anything else."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipelines.core.errors import InputError
from pipelines.formats.exif import read_tags
from pipelines.formats.gnss_logs import read_mrk, read_pos
from pipelines.formats.ground_points import read_geo, read_ground_points, read_marks, read_point_table
from pipelines.formats.image_file import header_size, inspect_image
from pipelines.formats.metashape import read_cameras, read_markers
from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.crs import parse_crs
from tests.photos import Exif, dji_xmp, gps_entries, jpeg

CELLS = st.one_of(
    st.sampled_from(
        ["", "nan", "inf", "-", "46,02", "1e999", "a.jpg", "../a", '"', "#", "\x00", "١", "2023-01-01T00:00"]
    ),
    st.floats().map(repr),
    st.text(max_size=5),
)
HEADERS = st.sampled_from(
    [
        "image,lat,lon,alt",
        "time;x;y;z;qx;qy;qz;qw",
        "EPSG:4326",
        "image,x,y,z,yaw,pitch,roll",
        "",
        "#Label,X,Y,Z,Yaw,Pitch,Roll",
        "label,x,y,z",
        "%  GPST latitude(deg) longitude(deg) height(m)",
        "%  UTC x-ecef(m) y-ecef(m) z-ecef(m)",
        "1 2.0 [3] 4,N",
    ]
)
TABLES = st.tuples(HEADERS, st.sampled_from(",; \t"), st.lists(st.lists(CELLS, max_size=9), max_size=5)).map(
    lambda drawn: drawn[0] + "\n" + "\n".join(drawn[1].join(row) for row in drawn[2])
)


@settings(deadline=None, max_examples=30)
@pytest.mark.parametrize(
    "read",
    [
        *(read_trajectory, read_geo, read_ground_points, read_markers, read_cameras, read_point_table, read_marks),
        *(read_pos, read_mrk),
    ],
    ids=["csv", "geo.txt", "gcp_list.txt", "markers", "cameras", "points", "marks", "pos", "mrk"],
)
@given(table=TABLES)
def test_tables(read: Callable[[Path], Any], table: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.txt"
        path.write_bytes(table.encode("utf-8", "surrogatepass"))
        with contextlib.suppress(InputError):
            assert read(path) is not None


@settings(deadline=None, max_examples=100)
@given(at=st.lists(st.tuples(st.floats(0.0, 0.999), st.integers(0, 255)), max_size=12))
def test_photographs_with_flipped_bytes(at: list[tuple[float, int]]) -> None:
    data = bytearray(jpeg(exif=Exif(gps=gps_entries(46.0, 7.0)), xmp=dji_xmp(RtkFlag="50")))
    for part, value in at:
        data[int(part * 700)] = value
    assert read_tags(bytes(data)).orientation is not None
    size = header_size(bytes(data))
    with contextlib.suppress(InputError):
        image = inspect_image(bytes(data), Path("a.jpg"))
        assert size == (image.width, image.height)


@settings(deadline=None, max_examples=5)  # PROJ searches all its names for each, a quarter of a second
@given(text=st.text(max_size=40))
def test_crs_texts(text: str) -> None:
    with contextlib.suppress(InputError):
        assert parse_crs(text).name == " ".join(text.split())
