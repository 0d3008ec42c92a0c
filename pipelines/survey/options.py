"""Options of clouds of other instruments, and of everything whose coordinates are in a CRS."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from pipelines.core.options import ExtraMarker, InputMarker, StageOptions
from pipelines.geodesy.vertical import Vertical, VerticalChoice

BOUNDARY_SUFFIXES = frozenset({".geojson", ".json", ".gpkg", ".kml", ".dxf"})
LEAST_PHOTOGRAPHS = 3  # that see the ground of the area of interest: two do not check each other
CLOUD_SUFFIXES = frozenset({".las", ".laz", ".ply"})
NOT_IN_BLOCKS = (
    "a training in blocks does not use LiDAR: its shift is estimated against the depth maps of all photographs. "
    "Omit --lidar, or train in one run: `--blocks 1`, with a smaller --max-gaussians or --max-image-size where "
    "memory is short"
)
CloudPath = Annotated[Path, InputMarker(CLOUD_SUFFIXES)]


@dataclass(frozen=True)
class CloudCrs:
    """CRS of clouds as the user states it, which counts before what the files say themselves."""

    crs: str | None = None  # text of the CRS, with the unit of the coordinates
    vertical: VerticalChoice | None = None  # datum of the heights
    # Option that named the clouds, for errors: `--lidar` has `--lidar-crs` and `--lidar-vertical`
    flag: str = "--lidar"


class CrsOptions(StageOptions):
    """Options of every file whose coordinates are in a CRS."""

    crs: str | None = Field(
        None,
        description="CRS of the file: EPSG:32632, EPSG:32632+3855, a PROJ string or WKT. Without it: the UTM zone "
        "of the scene.",
    )
    vertical: Vertical | None = Field(
        None,
        description="Datum of the heights where --crs states none: ellipsoidal, EGM96, EGM2008 or EPSG:n. Without "
        "it: that of the survey.",
    )


class AreaOptions(StageOptions):
    """Options of everything that ends at a boundary."""

    boundary: Annotated[Path, InputMarker(BOUNDARY_SUFFIXES), ExtraMarker("vectors")] | None = Field(
        None,
        description="Polygon of the area of interest: GeoJSON, GeoPackage, KML or DXF. Without it: the ground that "
        f"at least {LEAST_PHOTOGRAPHS} photographs see.",
    )
    boundary_crs: str | None = Field(
        None,
        description="CRS of the boundary, as a DXF needs one: EPSG:32632 or another. It overrules the file's.",
    )
