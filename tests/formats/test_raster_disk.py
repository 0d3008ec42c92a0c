"""Rasters on a disk that fills, and files with the suffix of a raster that GDAL would take for something else."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError, StorageError
from pipelines.formats.geotiff import (
    Band,
    RasterFrame,
    RasterKind,
    raster_frame,
    read_cells,
    read_reduced,
    sampled_raster,
    write_mosaic,
    write_part,
)
from tests.faults.injection import mounted
from tests.refusals import refused

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # of rasterio itself

FRAME = RasterFrame("", 10.0, 20.0, 1.0, 1.0, 600, 600)
PLACE = np.zeros((1, 2))
VALUES = np.random.default_rng(0).normal(size=(1, 600, 600)).astype(np.float32)


@pytest.mark.skipif(not hasattr(os, "statvfs"), reason="mounts a disk")
def test_rasters_are_whole_or_refused(tmp_path: Path) -> None:
    kind, folder = RasterKind("float32", (Band("height", "m"),)), tmp_path / "small"
    (tmp_path / "parts").mkdir()
    part = tmp_path / "parts/part.tif"
    write_part(part, VALUES, FRAME)
    size = part.stat().st_size
    with mounted(folder, "6m"):
        outcomes = set()
        for share in (0.01, 0.5, 0.9, 0.97, 0.99, 1.0, 1.02, 1.1, 2.0):
            for name in ("part.tif", "mosaic.tif"):
                status = os.statvfs(folder)
                room = max(status.f_bavail * status.f_frsize - int(share * size), 0)
                (folder / "filler").write_bytes(bytes(room))
                try:
                    if name == "part.tif":
                        write_part(folder / name, VALUES, FRAME)
                    else:
                        write_mosaic(folder / name, [(part, 0, 0)], FRAME, kind, {})
                    np.testing.assert_array_equal(read_cells(folder / name), VALUES)
                    outcomes.add((name, "whole"))
                except StorageError as error:
                    assert error.code == "storage-enospc"
                    assert not (folder / name).exists()
                    outcomes.add((name, "refused"))
                for file in folder.glob("*.tif"):
                    file.unlink()
                assert [file.name for file in folder.iterdir()] == ["filler"]
                (folder / "filler").unlink()
        assert len(outcomes) == 4


@pytest.mark.parametrize(
    "text",
    [
        "<VRTDataset rasterXSize='600' rasterYSize='600'><VRTRasterBand dataType='Float32' band='1'><SimpleSource>"
        "<SourceFilename>{other}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>",
        '{{"type": "gdal_streamed_alg", "command_line": "gdal raster pipeline ! read {other}"}}',
        "<GDAL_WMS><Service name='TMS'><ServerUrl>file://{other}</ServerUrl></Service></GDAL_WMS>",
    ],
)
def test_no_other_file_is_opened(tmp_path: Path, text: str) -> None:
    other = tmp_path / "other.tif"
    write_part(other, VALUES, FRAME)
    path = tmp_path / "dsm.tif"
    path.write_text(text.format(other=other))
    readers = (
        read_cells,
        raster_frame,
        lambda file: read_reduced(file, 10),
        lambda file: sampled_raster(file, PLACE),
    )
    for read in readers:
        with refused("raster-unreadable", InputError) as caught:
            read(path)
        assert caught.value.path == path
