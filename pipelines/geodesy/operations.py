"""The way from a CRS to WGS84 that serves a set of points, or why there is none, and PROJ's grids on this machine.

PROJ would rather answer than fail: without a geoid's grid it applies a *ballpark* transformation, that is none, and
a grid that a PROJ string calls optional (`+nadgrids=@file`) is a shift of zero where it is missing. Here both are
errors that name the grid.
"""

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from pyproj import CRS, Transformer
from pyproj.crs import CoordinateOperation
from pyproj.datadir import get_data_dir, get_user_data_dir
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.geodesy.vertical import missing_grid_error

WGS84 = "EPSG:4326"
_WGS84_3D = "EPSG:4979"
_NO_SHIFT = "@null"  # a PROJ string's way to say that there is none
# Ellipsoids of frames that follow the Earth's centre, as WGS84 does: semi-major axis and inverse flattening.
_MODERN_AXIS_M, _MODERN_FLATTENING = 6378137.0, (298.25, 298.26)
# Steps of PROJ that change the horizontal coordinates of a datum, and the parameters by which a Helmert one does.
_MOVING_STEPS = frozenset(
    {
        *("affine", "defmodel", "deformation", "geogoffset", "gridshift", "hgridshift", "horner"),
        *("molobadekas", "molodensky", "tinshift", "xyzgridshift"),
    }
)
_HELMERT_PARAMETERS = frozenset({"x", "y", "z", "rx", "ry", "rz", "s"})
_GRID_SUFFIXES = (".tif", ".gtx", ".gsb")


@dataclass(frozen=True)
class Operation:
    """How PROJ gets from a CRS to WGS84, how well (None: unknown), and grids with which it would do better.

    `renames`: the operation changes no horizontal coordinate of a datum. Its published accuracy is then that of
    calling ETRS89, NAD83 or GDA94 by the name of WGS84, as receivers do that get their corrections in these.
    """

    name: str
    accuracy_m: float | None
    missing_grids: tuple[str, ...]
    renames: bool = False

    @property
    def sigma_m(self) -> float:
        """σ of each horizontal axis by the published accuracy, 0 where none is known or nothing is moved."""
        return 0.0 if self.renames or self.accuracy_m is None else self.accuracy_m / 2**0.5


@dataclass(frozen=True)
class OperationRequest:
    """A CRS, its name in errors, whether its heights are transformed too, and the file of the points."""

    crs: CRS
    name: str
    three_dimensional: bool
    path: Path | str | None = None


@contextmanager
def proj_errors(name: str, path: Path | str | None = None) -> Iterator[None]:
    """Turn the exceptions of PROJ into InputErrors that name the CRS and the file."""
    try:
        yield
    except ProjError as error:
        raise InputError(
            "transformation-failed", f"PROJ cannot transform points of {name}: {error}.", path=path
        ) from error


def best_operation(request: OperationRequest, lon: FloatArray, lat: FloatArray) -> tuple[Transformer, Operation]:
    """Return the best transformation for points at `lon`, `lat` (N,) in degrees: one for all of them.

    Raises:
        InputError: a missing grid, or no transformation.
    """
    group = _group(request.crs, _WGS84_3D if request.three_dimensional else WGS84, _area(lon, lat))
    if group is None:
        raise _no_operation(request)
    real = [transformer for transformer in group.transformers if not _does_nothing(transformer)]
    if real:
        best = real[0]
        better = () if group.best_available else _missing(group.unavailable_operations[:1])
        accuracy_m = best.accuracy if best.accuracy >= 0 else None
        return best, Operation(best.description, accuracy_m, better, renames=not _moves(best.definition))
    # The fewest files to fetch; where as many would do, the way that PROJ likes best.
    lacking = [grids for operation in group.unavailable_operations if (grids := _missing([operation]))]
    lacking += [_missing(transformer.operations or ()) for transformer in group.transformers]
    if lacking:
        datum = request.crs.sub_crs_list[1].name if request.crs.is_compound else None
        raise missing_grid_error(datum, request.name, min(lacking, key=len), get_user_data_dir(), request.path)
    raise _no_operation(request)


def _group(crs: CRS, target: str, area: AreaOfInterest | None) -> TransformerGroup | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # "best transformation is not available": told by us
        try:
            return TransformerGroup(crs, target, always_xy=True, allow_ballpark=False, area_of_interest=area)
        # pyproj raises IndexError for a few CRS of the nineteenth century, and ProjError for damaged grids.
        except (IndexError, ProjError):
            return None


def _does_nothing(transformer: Transformer) -> bool:
    """Return whether a step is a shift of zero because every one of its optional grids is missing."""
    steps = [operation.grids for operation in transformer.operations or ()]
    named = [grids for grids in steps if grids and all(grid.short_name != _NO_SHIFT for grid in grids)]
    return any(not any(grid.available for grid in grids) for grids in named)


def _moves(definition: str) -> bool:
    """Return whether a pipeline of PROJ changes horizontal coordinates beyond projections, units and axes."""
    for step in re.split(r"(?:^|\s)step(?:\s|$)", definition.replace("+", " ")):
        given = dict(part.partition("=")[::2] for part in step.split())
        if given.get("proj") in _MOVING_STEPS:
            return True
        if given.get("proj") == "helmert" and any(float(given.get(key) or 0.0) for key in _HELMERT_PARAMETERS):
            return True
    return False


def _missing(operations: Iterable[CoordinateOperation]) -> tuple[str, ...]:
    names = (
        grid.short_name.removeprefix("@")
        for operation in operations
        for grid in operation.grids
        if not grid.available and grid.short_name != _NO_SHIFT
    )
    return tuple(dict.fromkeys(names))


def _no_operation(request: OperationRequest) -> InputError:
    """Return the error for a CRS that PROJ's database does not connect with WGS84."""
    horizontal = request.crs.sub_crs_list[0] if request.crs.is_compound else request.crs
    flat = _group(horizontal, WGS84, None) if request.crs.is_compound else None
    if flat is not None and (flat.transformers or flat.unavailable_operations):
        return InputError(
            "geoid-unknown",
            (
                f"Heights above {request.crs.sub_crs_list[1].name} cannot be converted to ellipsoidal heights: "
                "PROJ knows no geoid for them."
            ),
            path=request.path,
            remedy="Give ellipsoidal heights, the horizontal CRS alone and --vertical ellipsoidal.",
        )
    message = f"PROJ knows no transformation from {request.name} to WGS84."
    remedy = "Name its datum (+datum=… or +towgs84=… in a PROJ string), or give another CRS."
    ellipsoid = horizontal.ellipsoid
    low, high = _MODERN_FLATTENING
    if (
        ellipsoid is not None
        and abs(ellipsoid.semi_major_metre - _MODERN_AXIS_M) < 1e-3
        and low < ellipsoid.inverse_flattening < high
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "you will lose information": the datum, which is stated
            projection = horizontal.to_proj4().replace(" +no_defs", "").replace(" +type=crs", "")
        remedy += f" If its datum is close enough to WGS84, give: {projection} +towgs84=0,0,0"
    return InputError("no-transformation", message, path=request.path, remedy=remedy)


def _area(lon: FloatArray, lat: FloatArray) -> AreaOfInterest:
    """Return the box around points, a metre wider; its west lies east of its east across the date line."""
    margin = 1e-5
    near = lon - 360.0 * ((lon - lon[0]) / 360.0).round()
    west, east = float(near.min()) - margin, float(near.max()) + margin
    if east - west >= 180.0:  # around a pole
        west, east = -180.0, 180.0
    return AreaOfInterest(
        _wrapped(west), max(float(lat.min()) - margin, -90.0), _wrapped(east), min(float(lat.max()) + margin, 90.0)
    )


def _wrapped(lon_deg: float) -> float:
    return lon_deg - 360.0 * round(lon_deg / 360.0) if abs(lon_deg) > 180.0 else lon_deg


def grid_folders() -> list[Path]:
    """Return the existing folders in which PROJ looks for grids."""
    named = [*get_data_dir().split(";"), get_user_data_dir()]
    folders = [Path(part) for text in named for part in (text.split(":") if "/" in text else [text]) if part]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def installed_grids() -> list[str]:
    """Return the file names of the grids in PROJ's folders, sorted."""
    files = (file for folder in grid_folders() for file in folder.iterdir())
    return sorted({file.name for file in files if file.suffix.lower() in _GRID_SUFFIXES})
