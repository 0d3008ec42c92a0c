"""Outlines that the user draws, with the way from their plan to WGS84.

1. The option's CRS counts before the file's, and a line says so. KML is in WGS84 whatever an option says.
2. Coordinates of a drawing are in the unit that its header states, unless only those of the CRS's own unit meet the
   survey: many programs write a unit that nobody chose.
3. A drawing holds more than a boundary. One layer is taken: those named for a site or boundary, else the one whose
   outlines agree best with the ground of the survey (intersection over union with its convex hull). So a sheet's
   frame, which contains all, and buildings, which are small, are left out, and a line names the layer.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.boundary_file import Boundary, BoundaryLayer, Refusal, read_boundary
from pipelines.geodesy.crs import PointCrs, parse_crs, proj_crs

log = logging.getLogger(__name__)

_SAME_UNIT = 1e-4  # relative: the two feet, of which a drawing's header knows one
_SITE = re.compile(
    r"site|boundar|perimet|outline|area.?of.?interest|\baoi\b|limit|grenze|gebiet|umriss|emprise|contorno|linder",
    re.IGNORECASE,
)
_FRAME = re.compile(
    r"frame|sheet|title|viewport|defpoints|legend|limits\b|rahmen|blatt|cadre|marco|caj[ei]tin", re.IGNORECASE
)
_FRAMES_IN_LAYER = 3  # the most frames around the outlines of one layer, less one
_RECTANGULAR = 0.999  # least area of a sheet's frame over that of the rectangle around it


@dataclass(frozen=True)
class Outlines:
    """Polygons of one layer in the plan of a CRS, easting or longitude first, in its units."""

    polygons: tuple[Any, ...]
    crs: PointCrs
    layer: str = ""

    def lla(self, plan: FloatArray, path: Path) -> FloatArray:
        """Return WGS84 latitude, longitude, height 0 of places (N, 2) in that plan; an InputError: outside it."""
        return self.crs.lla_from_xyz(np.column_stack([plan, np.zeros(len(plan))]), path=path)


def read_outlines(
    path: Path, places_lla: FloatArray, *, field: str, crs: str | None, crs_field: str, one_site: bool = True
) -> tuple[Outlines, ...]:
    """Return the outlines of a boundary's file by the rules of this module.

    Args:
        places_lla: (N, 3) places of the survey, which tell units and layers of a drawing apart.
        field: option that names the file.
        crs: CRS that the user states with the option `crs_field`.
        one_site: whether a drawing's layer is chosen; else all count.

    Raises:
        InputError: the file cannot be read, has no area, states no CRS, or lies outside its CRS.
    """
    boundary = read_boundary(path, field=field)
    for remark in boundary.remarks:
        log.warning("%s", remark.text, extra={"code": remark.code})
    refusal = partial(InputError, path=path, field=crs_field)
    layers = []
    for layer in boundary.layers:
        text = _crs_text(layer, crs, path, crs_field)
        if not text:
            of_layer = f"layer {layer.name} " if len(boundary.layers) > 1 and layer.name else ""
            raise refusal("boundary-without-crs", f"{of_layer}states no CRS.", remedy=f"Give {crs_field}.")
        own = parse_crs(text, path=path, field=crs_field)
        outlines = Outlines(layer.polygons, own, layer.name)
        if layer.crs_is_default and text == layer.crs:
            _require_degrees(outlines, refusal, crs_field)
        layers.append(outlines)
    if boundary.is_drawing:
        places = _plan_of(layers[0].crs, places_lla)
        layers = _in_unit_of_crs(boundary, layers, places, path)
        return _site(layers, places, path) if one_site else tuple(layers)
    return tuple(layers)


def _crs_text(layer: BoundaryLayer, stated: str | None, path: Path, crs_field: str) -> str:
    """Return the CRS that counts: the user's, else the layer's, if that is one of places on Earth."""
    try:
        of_layer = "" if not layer.crs or _is_local(layer.crs, path) else layer.crs
    except InputError:
        if not stated:
            raise
        log.warning(
            "%s: %s, %s, overrules the file's CRS, %s, which PROJ does not know.",
            path.name, crs_field, stated, layer.crs[:60], extra={"code": "boundary-crs-overrules"},
        )  # fmt: skip
        return stated
    if not stated or not of_layer or _are_equal(stated, of_layer):
        return of_layer or stated or ""
    name = proj_crs(of_layer).name
    if path.suffix.lower() in (".kml", ".kmz"):
        log.warning(
            "%s: %s is not used, KML is in WGS84.", path.name, crs_field, extra={"code": "boundary-crs-unused"}
        )
        return of_layer
    if not layer.crs_is_default:
        log.warning(
            "%s: %s, %s, overrules the file's CRS, %s.",
            path.name, crs_field, stated, name, extra={"code": "boundary-crs-overrules"},
        )  # fmt: skip
    return stated


def _is_local(text: str, path: Path) -> bool:
    crs = proj_crs(text, path=path)
    return not (crs.is_geographic or crs.is_projected or crs.is_geocentric)


def _are_equal(one: str, other: str) -> bool:
    try:
        return bool(proj_crs(one).equals(proj_crs(other), ignore_axis_order=True))
    except InputError:
        return False


def _require_degrees(outlines: Outlines, refusal: Refusal, crs_field: str) -> None:
    """Refuse metres in a format whose coordinates are degrees where nothing else is said."""
    west, south, east, north = shapely.total_bounds(list(outlines.polygons)).tolist()
    if max(abs(west), abs(east)) > 720 or max(abs(south), abs(north)) > 90:
        raise refusal(
            "boundary-no-degrees",
            (
                "names no CRS, so that its coordinates are longitude and latitude in degrees, but they reach from "
                f"({west:.10g}, {south:.10g}) to ({east:.10g}, {north:.10g})."
            ),
            remedy=f"Give {crs_field}.",
        )


def _in_unit_of_crs(
    boundary: Boundary, layers: Sequence[Outlines], places: FloatArray | None, path: Path
) -> list[Outlines]:
    """Return the outlines of a drawing in the unit of their CRS."""
    crs = layers[0].crs
    if boundary.unit is None or crs.is_geographic:
        return list(layers)
    name, size_m = boundary.unit
    stated = size_m / crs.horizontal_unit
    factor = _unit_factor(layers, places, stated)
    if factor != 1.0:
        log.warning(
            "%s: coordinates were converted from %s, its $INSUNITS, into %s, the unit of %s.",
            path.name, name, crs.units[0], crs.name, extra={"code": "boundary-unit"},
        )  # fmt: skip
    elif abs(stated - 1) > _SAME_UNIT:
        log.warning(
            "%s: its $INSUNITS states %s, but only coordinates in %s, the unit of %s, meet the survey: these were "
            "used.", path.name, name, crs.units[0], crs.name, extra={"code": "boundary-unit-ignored"},
        )  # fmt: skip
    return [
        replace(one, polygons=tuple(shapely.transform(list(one.polygons), lambda plan: plan * factor)))
        for one in layers
    ]


def _plan_of(crs: PointCrs, places_lla: FloatArray) -> FloatArray | None:
    """Return places (N, 2) of the survey in the plan of a CRS; None: none, or they lie outside it."""
    try:
        places = crs.xyz_from_lla(places_lla)[:, :2]
    except InputError:  # said later, of the boundary
        return None
    return places if len(places) else None


def _unit_factor(layers: Sequence[Outlines], places: FloatArray | None, factor: float) -> float:
    """Return what coordinates are multiplied by: the stated unit over that of the CRS, or 1 if only that fits."""
    if abs(factor - 1) < _SAME_UNIT:
        return 1.0
    if places is None:
        return factor

    polygons = [one for every in layers for one in every.polygons]

    def meets(scale: float) -> bool:
        return any(bool(shapely.contains_xy(one, *(places / scale).T).any()) for one in polygons)

    return 1.0 if not meets(factor) and meets(1.0) else factor


def _site(layers: Sequence[Outlines], places: FloatArray | None, path: Path) -> tuple[Outlines, ...]:
    """Return the layer of a drawing that outlines the site."""
    choices = [choice for one in layers for choice in _choices(one)]
    if len(choices) < 2 or places is None:
        return tuple(layers)
    held = [(one, area) for one, area in choices if shapely.contains_xy(area, *places.T).any()]
    if not held:
        return tuple(layers)
    hull = shapely.MultiPoint(places).convex_hull
    agreement = [
        shapely.intersection(area, hull).area / max(shapely.union(area, hull).area, 1e-300) for _, area in held
    ]
    order = np.argsort(agreement, kind="stable")[::-1].tolist()
    named = [at for at in order if _SITE.search(held[at][0].layer) and not _FRAME.search(held[at][0].layer)]
    taken, area = held[(named or order)[0]]
    others = ", ".join(one.layer or "one without a name" for one in layers if one.layer != taken.layer)
    frames = max(len(one.polygons) for one in layers if one.layer == taken.layer) - len(taken.polygons)
    size = "" if taken.crs.is_geographic else f" ({area.area * taken.crs.horizontal_unit**2 / 1e4:.4g} ha)"
    log.warning(
        "%s: layer %s%s was taken as the boundary%s%s.",
        path.name, taken.layer, size, f", without {frames} outlines around its others" if frames else "",
        f"; not taken: {others[:300]}" if others else "", extra={"code": "boundary-layer"},
    )  # fmt: skip
    return (taken,)


def _choices(one: Outlines) -> Iterator[tuple[Outlines, Any]]:
    """Yield a layer with its area: whole, and without the largest rectangles that contain all its others."""
    polygons = sorted(one.polygons, key=lambda part: float(part.area), reverse=True)
    for left_out in range(min(_FRAMES_IN_LAYER, len(polygons))):
        rest = polygons[left_out:]
        whole = shapely.union_all(rest)
        if left_out and not (_is_rectangle(polygons[left_out - 1]) and polygons[left_out - 1].covers(whole)):
            return
        yield replace(one, polygons=tuple(rest)), whole


def _is_rectangle(polygon: shapely.Geometry) -> bool:
    return float(shapely.oriented_envelope(polygon).area) * _RECTANGULAR <= float(polygon.area)
