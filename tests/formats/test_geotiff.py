"""Rasters made of parts are read by GDAL as one: same cells, same CRS, same place."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from pyproj import CRS
from rio_cogeo.cogeo import cog_validate

from pipelines.formats.geotiff import NODATA, Band, RasterFrame, RasterKind, read_reduced, write_mosaic, write_part
from pipelines.geodesy.crs import parse_crs

KIND = RasterKind("float32", (Band("height", "metre"),))


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:32632+3855", "EPSG:7405", "EPSG:2056+5728", "EPSG:4326"])
def test_a_mosaic_gives_back_its_cells_and_its_crs(tmp_path: Path, crs: str) -> None:
    values = np.random.default_rng(0).normal(0, 100, (1, 700, 1100)).astype(np.float32)
    values[0, :60, :80] = np.nan
    frame = RasterFrame(parse_crs(crs).wkt1, 7.0, 47.0, 2e-6, 1e-6, 1100, 700)
    parts = []
    for column, columns in ((0, 600), (600, 500)):
        path = tmp_path / f"part_{column}.tif"
        write_part(path, values[:, :, column : column + columns], frame.part(column, 0, columns, 700))
        parts.append((path, column, 0))
    path = tmp_path / "heights.tif"
    write_mosaic(path, parts, frame, KIND, {"GEOREF_CRS": crs})
    assert cog_validate(path) == (True, [], [])
    with rasterio.open(path) as raster:
        assert CRS(raster.crs.to_wkt()).equals(CRS(crs), ignore_axis_order=True)
        assert raster.tags()["GEOREF_CRS"] == crs
        assert (raster.descriptions, raster.units) == (("height",), ("metre",))
        np.testing.assert_allclose(raster.bounds, frame.bounds, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(raster.read(1), np.where(np.isfinite(values[0]), values[0], NODATA))
    reduced, cell = read_reduced(path, 110)
    assert reduced.shape == (1, 70, 110)
    assert cell == pytest.approx(2e-5)
    # A cell holds the mean of 10 × 10, whose standard deviation is a tenth; by overviews a little less.
    assert np.nanstd(reduced) == pytest.approx(10.0, rel=0.15)
    assert np.isnan(reduced[0, :6, :8]).all()
