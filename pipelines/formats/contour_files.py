"""Contour lines as GeoPackage and DXF: a line a height, with the height as attribute and as z."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.durable import replace_file
from pipelines.core.types import FloatArray

_LINE_STRING_Z = 1002  # OGC 06-103r4, table 8
_MINOR, _MAJOR = "CONTOURS", "CONTOURS_MAJOR"


@dataclass(frozen=True)
class ContourLine:
    """Line of equal height.

    Attributes:
        height: in the unit of the CRS's heights.
        xy: (K, 2) in the CRS, easting or longitude first.
        is_major: whether it is one of every fifth, drawn thicker.
    """

    height: float
    xy: FloatArray
    is_major: bool


def write_contours_gpkg(path: Path, lines: Sequence[ContourLine], wkt: str) -> None:
    """Write contour lines as a GeoPackage (OGC 12-128r18) with the layer `contours`."""
    import pyogrio

    draft = path.with_name(f".{path.name}")  # GDAL takes the format from the suffix
    draft.unlink(missing_ok=True)
    pyogrio.raw.write(
        draft,
        geometry=np.array([_wkb(line) for line in lines], dtype=object),
        field_data=[
            np.array([line.height for line in lines], dtype=np.float64),
            np.array([line.is_major for line in lines], dtype=np.bool_),
        ],
        fields=["height", "major"],
        layer="contours",
        driver="GPKG",
        geometry_type="LineString Z",
        crs=wkt,
    )
    replace_file(draft, path)


def write_contours_dxf(path: Path, lines: Sequence[ContourLine]) -> None:
    """Write contour lines as DXF (R2010) polylines with their height as elevation, every fifth on its own layer."""
    from ezdxf.filemanagement import new

    document = new("R2010")
    document.layers.add(_MINOR, color=8)
    document.layers.add(_MAJOR, color=7, lineweight=50)
    space = document.modelspace()
    for line in lines:
        layer = _MAJOR if line.is_major else _MINOR
        polyline = space.add_lwpolyline(line.xy.tolist(), dxfattribs={"layer": layer})
        polyline.dxf.elevation = line.height
    draft = path.with_name(path.name + ".tmp")
    document.saveas(draft)
    replace_file(draft, path)


def _wkb(line: ContourLine) -> bytes:
    points = np.column_stack([line.xy, np.full(len(line.xy), line.height)])
    return struct.pack("<BII", 1, _LINE_STRING_Z, len(points)) + points.astype("<f8").tobytes()
