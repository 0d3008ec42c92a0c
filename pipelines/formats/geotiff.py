"""Rasters as Cloud Optimized GeoTIFF (OGC 21-026), made of parts so that a large one never lies in memory.

Parts are small GeoTIFFs. A mosaic of them (GDAL's VRT) is copied once into the final file, with overviews.
"""

from __future__ import annotations

import errno
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import GeorefError, InputError, storage_error, storage_error_in
from pipelines.core.files import replacing, storage_failure_of
from pipelines.core.types import AnyArray, BoolArray, ByteArray, FloatArray

if TYPE_CHECKING:
    import shapely

NODATA = -9999.0
_CACHE_BYTES = 256 * 1024 * 1024
_BLOCK_PX = 512
_GDAL_TYPE = {"uint8": "Byte", "uint16": "UInt16", "float32": "Float32"}


@dataclass(frozen=True)
class RasterFrame:
    """Place of a raster's cells: rows from the north, columns from the west.

    `wkt` is the CRS as WKT1, which keeps the codes of its parts; empty: none. `west`, `north` is the outer corner
    of the first cell, in the CRS's units, and the steps are the sizes of a cell, > 0.
    """

    wkt: str
    west: float
    north: float
    step_x: float
    step_y: float
    columns: int
    rows: int

    def part(self, column: int, row: int, columns: int, rows: int) -> RasterFrame:
        """Return the frame of a part whose first cell is at `column`, `row`."""
        west, north = self.west + column * self.step_x, self.north - row * self.step_y
        return RasterFrame(self.wkt, west, north, self.step_x, self.step_y, columns, rows)

    def resized(self, columns: int, rows: int) -> RasterFrame:
        """Return the frame with other, larger or smaller cells."""
        step_x, step_y = self.step_x * self.columns / columns, self.step_y * self.rows / rows
        return RasterFrame(self.wkt, self.west, self.north, step_x, step_y, columns, rows)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east, north of the outer edge."""
        south, east = self.north - self.rows * self.step_y, self.west + self.columns * self.step_x
        return self.west, south, east, self.north


@dataclass(frozen=True)
class Band:
    """Meaning of a band: description, unit (empty: none), colour, and of a narrow one its wavelength and width."""

    description: str
    unit: str = ""
    colour: Literal["Gray", "Red", "Green", "Blue", "Alpha"] = "Gray"
    wavelength_nm: float | None = None
    fwhm_nm: float | None = None

    def metadata(self) -> dict[str, dict[str, str]]:
        """Return the items of GDAL's metadata by domain: those of IMAGERY, and as ENVI names them."""
        plain: dict[str, str] = {}
        imagery: dict[str, str] = {}
        if self.wavelength_nm is not None:
            plain |= {"wavelength": f"{self.wavelength_nm:g}", "wavelength_units": "Nanometers"}
            imagery["CENTRAL_WAVELENGTH_UM"] = f"{self.wavelength_nm / 1000:g}"
        if self.fwhm_nm is not None:
            plain["fwhm"] = f"{self.fwhm_nm:g}"
            imagery["FWHM_UM"] = f"{self.fwhm_nm / 1000:g}"
        return {domain: items for domain, items in (("", plain), ("IMAGERY", imagery)) if items}


@dataclass(frozen=True)
class RasterKind:
    """Bands of a raster. Without a value, float32 rasters have `NODATA`; integers have an alpha band, or are 0."""

    dtype: Literal["uint8", "uint16", "float32"]
    bands: tuple[Band, ...]


def write_part(path: Path, values: AnyArray, frame: RasterFrame) -> None:
    """Write cells (bands, rows, columns) of a part; NaN becomes `NODATA`. The file appears whole or not at all."""
    import rasterio

    if values.dtype.kind == "f":
        values = np.where(np.isfinite(values), values, NODATA).astype(np.float32)
    profile: dict[str, Any] = {
        **_cells(frame),
        "count": len(values),
        "dtype": values.dtype,
        "nodata": NODATA if values.dtype.kind == "f" else None,
    }
    form = {"tiled": True, "blockxsize": _BLOCK_PX, "blockysize": _BLOCK_PX, "compress": "DEFLATE", "zlevel": 1}
    with replacing(path) as draft, _written(path, frame, len(values), values.itemsize):
        with rasterio.open(draft, "w", driver="GTiff", **profile, **form) as part:
            part.write(values)
        _require_whole(draft)


def write_mosaic(
    path: Path,
    parts: Sequence[tuple[Path, int, int]],
    frame: RasterFrame,
    kind: RasterKind,
    tags: Mapping[str, str],
) -> None:
    """Write parts in one folder, with first column and first row of each, as a Cloud Optimized GeoTIFF."""
    import rasterio
    import rasterio.shutil

    mosaic = write_vrt(path.stem, parts, frame, kind, tags)
    bands, bytes_each = len(kind.bands), np.dtype(kind.dtype).itemsize
    with (
        replacing(path) as draft,
        _written(path, frame, bands, bytes_each),
        rasterio.Env(GDAL_CACHEMAX=_CACHE_BYTES),
    ):
        rasterio.shutil.copy(
            mosaic,
            draft,
            driver="COG",
            COMPRESS="DEFLATE",
            PREDICTOR="YES",
            BLOCKSIZE=str(_BLOCK_PX),
            OVERVIEW_RESAMPLING="AVERAGE",
            NUM_THREADS="ALL_CPUS",
            BIGTIFF="IF_SAFER",
        )
        _require_whole(draft)


@contextmanager
def _written(path: Path, frame: RasterFrame, bands: int, bytes_each: int) -> Iterator[None]:
    """Turn GDAL's errors of a disk that is full or fails, which seldom name it, into a `StorageError`.

    The disk is full where it has no room for the cells, unpacked and with their overviews.
    """
    try:
        yield
    except GeorefError:
        raise
    except Exception as error:  # rasterio's, and those of GDAL's own numbers
        failure = storage_error_in(f"{error} {error.__cause__}", path) or storage_failure_of(path.parent)
        needed = frame.rows * frame.columns * bands * bytes_each * 4 // 3 + _BLOCK_PX**2 * bytes_each
        if failure is None and shutil.disk_usage(path.parent).free < needed:
            failure = storage_error(OSError(errno.ENOSPC, "no room", str(path)))
        if failure is None:
            raise
        raise failure from error


def _require_whole(draft: Path) -> None:
    """Raise an OSError where GDAL closed a raster without all its tiles: it does not report every full disk.

    A tile may be missing, or lie within the file and be empty: what was written after it made the file longer.
    """
    import rasterio

    size, whole = draft.stat().st_size, True
    with rasterio.open(draft, driver="GTiff") as raster:
        tiles = [(place, band) for band in raster.indexes for place, _ in raster.block_windows(band)]
        places = [
            [raster.get_tag_item(f"BLOCK_{what}_{x}_{y}", "TIFF", bidx=band) for what in ("OFFSET", "SIZE")]
            for (y, x), band in tiles
        ]
        whole = all(None not in place and sum(map(int, place)) <= size for place in places)
        try:
            for _, window in raster.block_windows(1) if whole else ():
                raster.read(window=window)  # each tile has a checksum
        except rasterio.errors.RasterioIOError:
            whole = False
    if not whole:
        raise OSError(errno.EIO, "the raster was not written whole", str(draft))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a raster as its suffix says: GDAL's other drivers open what a file names, also addresses.

    Raises:
        InputError: not such a raster, or a damaged one.
    """
    import rasterio
    from rasterio.errors import RasterioError

    try:
        with rasterio.open(path, driver="VRT" if path.suffix.lower() == ".vrt" else "GTiff") as raster:
            yield raster
    except RasterioError as error:
        message = f"The raster cannot be read: {error}."
        remedy = "Make it again with `georef`."
        raise InputError("raster-unreadable", message, path=path, remedy=remedy) from error


def write_vrt(
    name: str,
    parts: Sequence[tuple[Path, int, int]],
    frame: RasterFrame,
    kind: RasterKind,
    tags: Mapping[str, str],
) -> Path:
    """Write a file beside parts that shows them as one raster, as `write_mosaic` copies it, and return its path."""
    mosaic = parts[0][0].parent / f"{name}.vrt"
    mosaic.write_bytes(_vrt(parts, frame, kind, tags))
    return mosaic


def read_cells(path: Path, part: tuple[slice, slice] | None = None) -> NDArray[Any]:
    """Return the bands (bands, rows, columns) of a raster, or of rows and columns that lie in it; NaN: no value.

    Examples:
        >>> frame = RasterFrame("EPSG:32632", west=100.0, north=50.0, step_x=0.5, step_y=0.5, columns=2, rows=2)
        >>> write_part(Path("dsm.tif"), np.array([[[498.5, 499.5], [500.5, np.nan]]], np.float32), frame)
        >>> read_cells(Path("dsm.tif")).tolist()
        [[[498.5, 499.5], [500.5, nan]]]
    """
    from rasterio.windows import Window

    with _opened(path) as raster:
        values = raster.read(window=None if part is None else Window.from_slices(*part))
    return np.where(values == NODATA, np.nan, values) if values.dtype.kind == "f" else np.asarray(values)


def sampled_raster(path: Path, xy: FloatArray) -> FloatArray:
    """Return the values (N,) of a raster's first band at places (N, 2) in its CRS; NaN: none, or no such file."""

    if not path.is_file():
        return np.full(len(xy), np.nan)
    with _opened(path) as raster:
        values = np.array([value[0] for value in raster.sample(xy)], dtype=np.float64)
    return np.where(values == NODATA, np.nan, values)


def raster_frame(path: Path) -> RasterFrame:
    """Return the place of a raster's cells."""

    with _opened(path) as raster:
        at, wkt = raster.transform, raster.crs.to_wkt(version="WKT1_GDAL") if raster.crs else ""
        return RasterFrame(wkt, at.c, at.f, at.a, -at.e, raster.width, raster.height)


def is_same_crs(first: RasterFrame, second: RasterFrame) -> bool:
    """Return whether two rasters have one CRS, however it is written."""
    from rasterio.crs import CRS

    return bool(CRS.from_wkt(first.wkt) == CRS.from_wkt(second.wkt))


def read_onto(
    path: Path, frame: RasterFrame, resampling: Literal["nearest", "bilinear", "average"]
) -> NDArray[Any]:
    """Return the first band (rows, columns) of a raster on the cells of a frame in its CRS; NaN or 0: no value.

    Examples:
        >>> frame = RasterFrame("EPSG:32632", west=100.0, north=50.0, step_x=0.5, step_y=0.5, columns=2, rows=2)
        >>> write_part(Path("dsm.tif"), np.array([[[498.5, 499.5], [500.5, np.nan]]], np.float32), frame)
        >>> read_onto(Path("dsm.tif"), frame.resized(1, 1), "average").tolist()
        [[499.5]]
    """
    with _warped(path, frame, resampling) as warped:
        values = warped.read(1)
    if values.dtype == np.uint8:
        return np.asarray(values)
    return np.where(values == NODATA, np.nan, values).astype(np.float64)


def read_colours_onto(path: Path, frame: RasterFrame) -> ByteArray:
    """Return the colours (rows, columns, bands) of a raster of bytes, averaged on the cells of a frame.

    Examples:
        >>> frame = RasterFrame("EPSG:32632", west=100.0, north=50.0, step_x=0.5, step_y=0.5, columns=2, rows=2)
        >>> bands = np.array([[[0, 100], [200, 100]], [[10, 10], [10, 10]], [[0, 0], [0, 0]]], np.uint8)
        >>> write_part(Path("orthophoto.tif"), bands, frame)
        >>> read_colours_onto(Path("orthophoto.tif"), frame.resized(1, 1)).tolist()
        [[[100, 10, 0]]]
    """
    with _warped(path, frame, "average") as warped:
        return np.ascontiguousarray(np.moveaxis(warped.read(), 0, -1), dtype=np.uint8)


@contextmanager
def _warped(path: Path, frame: RasterFrame, resampling: str) -> Iterator[Any]:
    """Open a raster as it is on the cells of a frame in its CRS."""
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    with _opened(path) as raster:
        empty = {} if raster.dtypes[0] == "uint8" else {"src_nodata": NODATA, "nodata": NODATA}
        target = {"crs": raster.crs, **_cells(frame), "resampling": Resampling[resampling]}
        with WarpedVRT(raster, **target, **empty) as warped:
            yield warped


def cells_inside(polygon: shapely.Geometry, frame: RasterFrame) -> BoolArray:
    """Return which cells (rows, columns) have their middle in a polygon of the frame's CRS."""
    from rasterio.features import rasterize

    shape = (frame.rows, frame.columns)
    return np.asarray(rasterize([polygon], shape, transform=_transform(frame)), dtype=bool)


def outlines(cells: BoolArray, frame: RasterFrame) -> list[Any]:
    """Return the parts of chosen cells (rows, columns) over a frame as polygons, holes and all."""
    import shapely
    from rasterio.features import shapes

    transform = _transform(frame.resized(cells.shape[1], cells.shape[0]))
    parts = shapes(cells.astype(np.uint8), mask=cells, connectivity=8, transform=transform)
    return [shapely.make_valid(shapely.geometry.shape(part)) for part, _ in parts]


def _transform(frame: RasterFrame) -> Any:
    from rasterio.transform import from_origin

    return from_origin(frame.west, frame.north, frame.step_x, frame.step_y)


def _cells(frame: RasterFrame) -> dict[str, Any]:
    """Return the size and the place of a frame as rasterio takes them."""
    return {"width": frame.columns, "height": frame.rows, "transform": _transform(frame)}


def read_reduced(path: Path, longest_px: int) -> tuple[NDArray[Any], float]:
    """Return the bands (bands, rows, columns) of a raster, averaged to a longest side, and the size of a cell.

    Float rasters have NaN where there is no value.

    Examples:
        >>> frame = RasterFrame("EPSG:32632", west=100.0, north=50.0, step_x=0.5, step_y=0.5, columns=2, rows=2)
        >>> write_part(Path("dsm.tif"), np.array([[[498.5, 499.5], [500.5, np.nan]]], np.float32), frame)
        >>> bands, cell = read_reduced(Path("dsm.tif"), longest_px=1)
        >>> bands.tolist(), cell
        ([[[499.5]]], 1.0)
    """
    from rasterio.enums import Resampling

    with _opened(path) as raster:
        factor = max(max(raster.width, raster.height) / longest_px, 1.0)
        shape = (raster.count, max(round(raster.height / factor), 1), max(round(raster.width / factor), 1))
        values = raster.read(out_shape=shape, resampling=Resampling.average, masked=True)
        cell = abs(raster.transform.a) * raster.width / shape[2]
    if values.dtype.kind == "f":
        return values.filled(np.nan), cell
    return np.asarray(values.data), cell


def _vrt(
    parts: Sequence[tuple[Path, int, int]], frame: RasterFrame, kind: RasterKind, tags: Mapping[str, str]
) -> bytes:
    """Return the mosaic as XML that GDAL reads (https://gdal.org/drivers/raster/vrt.html)."""

    root = ElementTree.Element("VRTDataset", rasterXSize=str(frame.columns), rasterYSize=str(frame.rows))
    if frame.wkt:
        ElementTree.SubElement(root, "SRS").text = frame.wkt
    corner = (frame.west, frame.step_x, 0.0, frame.north, 0.0, -frame.step_y)
    ElementTree.SubElement(root, "GeoTransform").text = ", ".join(f"{value:.17g}" for value in corner)
    metadata = ElementTree.SubElement(root, "Metadata")
    for key, value in tags.items():
        ElementTree.SubElement(metadata, "MDI", key=key).text = value
    sizes = []
    for path, _, _ in parts:
        with _opened(path) as part:
            sizes.append((part.width, part.height))
    for number, band in enumerate(kind.bands, start=1):
        element = ElementTree.SubElement(root, "VRTRasterBand", dataType=_GDAL_TYPE[kind.dtype], band=str(number))
        for domain, items in band.metadata().items():
            of_band = ElementTree.SubElement(element, "Metadata", {"domain": domain} if domain else {})
            for key, value in items.items():
                ElementTree.SubElement(of_band, "MDI", key=key).text = value
        ElementTree.SubElement(element, "Description").text = band.description
        if band.unit:
            ElementTree.SubElement(element, "UnitType").text = band.unit
        if kind.dtype == "float32":
            ElementTree.SubElement(element, "NoDataValue").text = str(NODATA)
        ElementTree.SubElement(element, "ColorInterp").text = band.colour
        for (path, column, row), (columns, rows) in zip(parts, sizes, strict=True):
            source = ElementTree.SubElement(element, "SimpleSource")
            ElementTree.SubElement(source, "SourceFilename", relativeToVRT="1").text = path.name
            ElementTree.SubElement(source, "SourceBand").text = str(number)
            for name, x, y in (("SrcRect", 0, 0), ("DstRect", column, row)):
                window = {"xOff": str(x), "yOff": str(y), "xSize": str(columns), "ySize": str(rows)}
                ElementTree.SubElement(source, name, window)
    return b"<?xml version='1.0' encoding='utf-8'?>\n" + bytes(ElementTree.tostring(root, encoding="utf-8"))
