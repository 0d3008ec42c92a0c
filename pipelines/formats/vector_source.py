"""GDAL's way to vector files, narrowed: drivers of the known formats alone, and tables of a GeoPackage, no views.

GDAL chooses a driver by what a file says of itself. Many of its drivers open other files and addresses that a
file names: GDALG is a pipeline of commands, VRT and WFS name sources. SQL in a view is executed as soon as GDAL
reads it, and may count without end.
"""

import contextlib
import shutil
import sqlite3
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pipelines.core.errors import InputError

_DRIVERS = frozenset(("GPKG", "GeoJSON", "KML", "LIBKML", "DXF"))
_SQLITE = b"SQLite format 3\0"
# What GDAL reads before any layer.
_OWN_TABLES = ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys")


@cache
def gdal() -> Any:
    """Return pyogrio, whose GDAL knows the drivers of GeoPackage, GeoJSON, KML and DXF alone.

    rasterio has a GDAL of its own.
    """
    import pyogrio
    from pyogrio import _ogr

    others = sorted(set(pyogrio.list_drivers()) - _DRIVERS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        pyogrio.set_gdal_config_options({"GDAL_SKIP": ",".join(others)})
        _ogr._register_drivers()
    unwanted = set(pyogrio.list_drivers()) - _DRIVERS
    if unwanted:
        raise RuntimeError(f"GDAL keeps its drivers {', '.join(sorted(unwanted))}")
    return pyogrio


def reading_errors() -> tuple[type[Exception], ...]:
    """Return the errors of reading a file that is damaged or of another kind."""
    from pyogrio.errors import DataLayerError, DataSourceError

    return DataSourceError, DataLayerError, ValueError, OSError, sqlite3.Error


def layers_with_shapes(source: Path) -> list[str]:
    """Return the layers of a file that have geometry; QGIS keeps styles in a table that has none."""
    return [name for name, kind in gdal().list_layers(source).tolist() if kind is not None]


@contextmanager
def tables_alone(path: Path, *, field: str | None = None) -> Iterator[Path]:
    """Yield a file for GDAL: itself, or of a GeoPackage with views a copy without them.

    Raises:
        InputError: a layer of the GeoPackage is a view; names it.
        sqlite3.Error: damaged.
    """
    with path.open("rb") as file:
        is_sqlite = file.read(len(_SQLITE)) == _SQLITE
    views = _views(path) if is_sqlite else []
    if not views:
        yield path
        return
    with TemporaryDirectory(prefix="georef_gpkg_") as room:
        copy = Path(room) / path.name
        shutil.copyfile(path, copy)
        with contextlib.closing(sqlite3.connect(copy, isolation_level=None)) as base:
            for name in views:
                base.execute(f"DROP VIEW {_quoted(name)}")
            layers = _registered(base)
        bad = next((view for view in views if view.lower() in layers or view.lower() in _OWN_TABLES), None)
        if bad is not None:
            message = f"The layer {bad!r} is a view, whose SQL is not executed."
            remedy = "Save it as a layer of its own."
            raise InputError("layer-is-view", message, path=path, field=field, remedy=remedy)
        yield copy


def rows_of_table(path: Path, table: str) -> int:
    """Return the number of rows of a table of a GeoPackage."""
    with contextlib.closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as base:
        return int(base.execute(f"SELECT count(*) FROM {_quoted(table)}").fetchone()[0])


def _views(path: Path) -> list[str]:
    """Return the names of the views of a database, which is not changed."""
    address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
    with contextlib.closing(sqlite3.connect(address, uri=True)) as base:
        return [str(name) for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'view'")]


def _registered(base: sqlite3.Connection) -> set[str]:
    """Return the layers that a GeoPackage states, in small letters; its own tables are no views any more."""
    tables: set[str] = set()
    for table in _OWN_TABLES[:2]:
        with contextlib.suppress(sqlite3.OperationalError):  # it lacks the table
            tables |= {str(name).lower() for (name,) in base.execute(f"SELECT table_name FROM {table}")}
    return tables


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'
