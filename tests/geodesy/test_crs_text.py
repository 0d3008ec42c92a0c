"""Texts of a CRS that would open files."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest
from pyproj import CRS

from pipelines.core.errors import InputError
from pipelines.geodesy.crs import file_in, parse_crs
from tests.refusals import refused

WKT = (
    'PROJCS["x",GEOGCS["W",DATUM["D",SPHEROID["e",6378137,298.257223563]],PRIMEM["G",0],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["m",1],EXTENSION["PROJ4","{}"]]'
)
BOUND = CRS("+proj=longlat +ellps=intl +nadgrids=@grid.gsb +type=crs")


def texts_that_open(path: str) -> list[str]:
    return [
        f"+proj=longlat +datum=WGS84 +nadgrids={path}",
        f"+proj=longlat +nadgrids=@null,@{path}",
        f"+proj=longlat +nadgrids= {path}",
        f'+proj=longlat +nadgrids="{path}"',
        f"proj=utm zone=32 geoidgrids=@{path}",
        f"+proj=longlat +catalog={path}",
        f"+init={path}:x",
        f"init={path}:x",
        f"+proj=pipeline +step +proj=tinshift +file={path}",
        f"+proj=tinshift +file={path}",
        f"+proj=hgridshift +grids={path}",
        f"+proj=deformation +xy_grids={path} +z_grids=a",
        WKT.format(f"+proj=utm +zone=32 +nadgrids={path} +type=crs"),
        BOUND.to_wkt().replace("@grid.gsb", path),
        BOUND.to_wkt().replace("@grid.gsb", path).replace("PARAMETERFILE[", "parameterfile ["),
        BOUND.to_json().replace("@grid.gsb", path),
        BOUND.to_json().replace("@grid.gsb", json.dumps(path)[1:-1].replace("/", "\\u002f")),
    ]


@pytest.mark.skipif(sys.platform == "win32", reason="no pipes in folders")
@pytest.mark.parametrize("number", range(len(texts_that_open("x"))))
def test_text_that_opens_a_file_is_refused(tmp_path: Path, number: int) -> None:
    """The file is a pipe: PROJ would wait for ever to open it."""
    os.mkfifo(tmp_path / "pipe")
    with refused("crs-opens-file", InputError) as error:
        parse_crs(texts_that_open(str(tmp_path / "pipe"))[number], path="gcp.txt", line=1)
    assert str(error.value).startswith("gcp.txt:1: ")


@pytest.mark.parametrize("path", ["../a.gsb", "~/a.gsb", "C:\\a.gsb", "https://x.org/a.tif", "a/b", ""])
def test_paths_of_every_kind(path: str) -> None:
    assert file_in(f"+proj=longlat +nadgrids={path}") is not None


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:4326",
        "EPSG:32632+5773",
        "WGS 84 / UTM zone 32N",
        "urn:ogc:def:crs:EPSG::4326",
        "http://www.opengis.net/def/crs/EPSG/0/4326",
        "+proj=utm +zone=10 +ellps=clrk66 +nadgrids=@conus,conus.gsb,@null +geoidgrids=us_noaa-1.gtx",
        CRS("EPSG:3857").to_wkt(),
        CRS("EPSG:3857").to_wkt("WKT1_GDAL"),
        CRS("EPSG:32632+5773").to_json(),
        BOUND.to_wkt(),
        BOUND.to_json(),
    ],
)
def test_other_texts_are_left_to_proj(text: str) -> None:
    assert file_in(text) is None
