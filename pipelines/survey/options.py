"""Options of clouds of other instruments, and of everything whose coordinates are in a CRS."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from pipelines.core.extras import require
from pipelines.core.options import WRITTEN, ExtraMarker, InputMarker, NeedMarker, StageOptions, from_text, triple_of
from pipelines.core.types import Vector3
from pipelines.formats.depth_image import DEPTH_SUFFIXES
from pipelines.geodesy.vertical import Vertical, VerticalChoice

BOUNDARY_SUFFIXES = frozenset({".geojson", ".json", ".gpkg", ".kml", ".kmz", ".dxf"})
LEAST_PHOTOGRAPHS = 3  # that see the ground of the area of interest: two do not check each other
CLOUD_SUFFIXES = frozenset({".las", ".laz", ".ply", ".e57", ".obj", ".glb"})
NOT_IN_BLOCKS = (
    "a training in blocks does not use LiDAR: its shift is estimated against the depth maps of all photographs. "
    "Omit --lidar, or train in one run: `--blocks 1`, with a smaller --max-gaussians or --max-image-size where "
    "memory is short"
)
# Files beside a mesh that say where it lies (formats/mesh_place.py).
_PLACES = ("*.georef.json", "coords.txt", "metadata.xml", "*offset.xyz", "*offset.txt", "*.prj")
_MESHES = tuple((suffix, _PLACES) for suffix in (".obj", ".glb", ".ply"))
_PLACE_SUFFIXES = frozenset({".json", ".txt", ".xml", ".xyz", ".prj"})
_NEEDS_SCANS = frozenset({".e57", ".exr"})


def _require_scans(path: Path) -> None:
    """Raise a BackendUnavailableError if a path holds a file that needs an extra which is missing."""
    files = path.rglob("*") if path.is_dir() else (path,)
    if any(file.suffix.lower() in _NEEDS_SCANS for file in files):
        require("scans")


CloudPath = Annotated[
    Path,
    InputMarker(CLOUD_SUFFIXES | _PLACE_SUFFIXES, beside=_MESHES),
    NeedMarker(_require_scans),
]

# Clouds and meshes, or depth maps of the photographs.
MeasuredPath = Annotated[
    Path,
    InputMarker(CLOUD_SUFFIXES | _PLACE_SUFFIXES | DEPTH_SUFFIXES, beside=_MESHES),
    NeedMarker(_require_scans),
]


def _offset(numbers: Vector3) -> Vector3:
    if not all(abs(number) < 1e8 for number in numbers):
        raise ValueError("each number must be below 100000000 in magnitude")
    return numbers


UpAxis = Literal["y", "z"]
MapOffset = Annotated[Vector3, from_text(triple_of), AfterValidator(_offset), WRITTEN]


@dataclass(frozen=True)
class CloudCrs:
    """CRS of clouds as the user states it, which counts before what the files say themselves."""

    crs: str | None = None  # text of the CRS, with the unit of the coordinates
    vertical: VerticalChoice | None = None  # datum of the heights
    # Option that named the clouds, for errors: `--lidar` has `--lidar-crs` and `--lidar-vertical`
    flag: str = "--lidar"
    offset: Vector3 | None = None  # added to the coordinates of the files, in their unit
    up: UpAxis | None = None  # third or second axis of meshes; None: as their format says


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
        description="Polygon of the area of interest: GeoJSON, GeoPackage, KML, KMZ or DXF. Without it: the ground "
        f"that {LEAST_PHOTOGRAPHS} training views measure; before training, that {LEAST_PHOTOGRAPHS} photographs "
        "see.",
    )
    boundary_crs: str | None = Field(
        None,
        description="CRS of the boundary, as a DXF needs one: EPSG:32632 or another. It overrules the file's.",
    )


def _width(fill: float | Literal["all"]) -> float | Literal["all"]:
    if fill != "all" and not 0 <= fill < 1e6:
        raise ValueError("a width in metres, or all")
    return fill


FillWidth = Annotated[
    float | Literal["all"],
    from_text(lambda text: text if text == "all" else float(text)),
    AfterValidator(_width),
    WRITTEN,
]


class FilledAreaOptions(AreaOptions):
    """Options of everything that ends at the area of interest: a boundary, or what is measured."""

    fill: FillWidth | None = Field(
        None,
        description="Width in metres up to which holes in the measured surface belong to the area, 0 for none; "
        f"all: all ground that {LEAST_PHOTOGRAPHS} photographs see. Without it: all inside a --boundary, else two "
        "metres and ten pixels of the photographs on the ground, at most a tenth of the area.",
    )


class CropOptions(FilledAreaOptions):
    """Options of everything that holds the Gaussians of an area."""

    crop: bool = Field(
        False, description="Leave out Gaussians outside the area of interest. --boundary implies it."
    )
    keep_sky: bool = Field(False, description="With a crop: keep what lies higher than all cameras.")
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Leave out Gaussians that are less opaque.")
