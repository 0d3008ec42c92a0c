"""The CRS of a deliverable: the user's, or the UTM zone of the scene, with every point transformed by itself.

A survey without a place on Earth has none: its coordinates are those of its local metric frame.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.figures import Headline
from pipelines.core.products import Remark
from pipelines.core.types import FloatArray, vector3
from pipelines.formats.georef_sidecar import CrsSidecar, SceneSigma
from pipelines.geodesy.crs import PointCrs, local_frame, parse_crs
from pipelines.geodesy.enu import (
    SEMI_MAJOR_M,
    Origin,
    ecef_from_lla,
    enu_from_ecef,
    lla_from_enu,
    median_lla,
)
from pipelines.geodesy.operations import Operation
from pipelines.geodesy.vertical import ELLIPSOIDAL, VerticalChoice, VerticalDatum, parse_vertical
from pipelines.survey.options import CrsOptions


@dataclass(frozen=True)
class TargetCrs:
    """CRS of a file, with one operation for the whole scene."""

    crs: PointCrs
    origin: Origin | None  # of the frame `geo`; None: the frame is local, and so are the coordinates
    lla: FloatArray  # (M, 3) places that span the scene; none in a local frame
    assumed: tuple[str, ...] = ()  # what the user did not state, for the user and the file; empty: nothing

    @property
    def axes(self) -> tuple[str, str]:
        """Names of the horizontal coordinates."""
        if self.origin is None:
            return "x", "y"
        return ("longitude", "latitude") if self.crs.is_geographic else ("easting", "northing")

    @property
    def horizontal_unit_m(self) -> float:
        """Unit of the plan in metres; of degrees along a meridian, by which a raster's cells are judged."""
        if self.crs.is_geographic:
            return self.crs.horizontal_unit * SEMI_MAJOR_M
        return self.crs.horizontal_unit

    def xyz_from_geo(self, points: ArrayLike) -> FloatArray:
        """Return points (N, 3) in the CRS, easting or longitude first, of points (N, 3) in `geo`.

        Raises:
            InputError: a point lies outside the domain of the CRS.
        """
        if self.origin is None:
            return np.array(points, dtype=np.float64).reshape(-1, 3)
        return self.crs.xyz_from_lla(lla_from_enu(points, self.origin))

    def geo_from_xyz(self, points: ArrayLike) -> FloatArray:
        """Return points (N, 3) in `geo` of points (N, 3) in the CRS.

        Raises:
            InputError: a point lies outside the domain of the CRS.
        """
        if self.origin is None:
            return np.array(points, dtype=np.float64).reshape(-1, 3)
        return enu_from_ecef(ecef_from_lla(self.crs.lla_from_xyz(points)), self.origin)

    def operation(self) -> Operation:
        """Return the transformation from WGS84; of a local frame there is none."""
        if self.origin is None:
            return Operation("none: the coordinates are those of the local frame", None, ())
        return self.crs.operation(self.lla)

    def sidecar(
        self,
        bounds: ArrayLike,
        accuracy: Headline | None,
        sigma: SceneSigma | None,
        cautions: tuple[Remark, ...],
    ) -> CrsSidecar:
        """Return the sidecar of a file in this CRS, with bounds (2, 3): least and largest coordinates."""
        operation = self.operation()
        low, high = np.asarray(bounds, dtype=np.float64)
        return CrsSidecar(
            crs=self.crs.name,
            crs_wkt=self.crs.wkt,
            vertical_datum=self.crs.vertical,
            units=self.crs.units,
            operation=operation.name,
            operation_accuracy_m=operation.accuracy_m,
            bounds=(vector3(low), vector3(high)),
            accuracy=accuracy,
            sigma=sigma,
            assumed=self.assumed,
            cautions=cautions,
        )


def target_crs(
    options: CrsOptions, origin: Origin | None, scene_in_geo: ArrayLike, heights: VerticalDatum
) -> TargetCrs:
    """Return the CRS of a deliverable.

    Args:
        origin: of the frame `geo`; None: the frame is local.
        scene_in_geo: (M, 3) places that span the scene, such as the corners of its bounds; M ≥ 1.
        heights: what the survey's input heights referred to: the default.

    Raises:
        InputError: not a CRS, not for this place, a grid that it needs is not installed, or the frame is local.
    """
    if origin is None:
        if options.crs is not None or options.vertical is not None:
            raise InputError(
                "not-on-earth",
                "The survey has a local metric frame and no place on Earth: a CRS does not apply to it.",
                field="--vertical" if options.crs is None else "--crs",
                remedy="Remove --crs and --vertical, or run `georef ingest` with positions or control points.",
            )
        return TargetCrs(local_frame(), None, np.zeros((0, 3)))
    lla = lla_from_enu(scene_in_geo, origin).reshape(-1, 3)
    text = options.crs or utm_zone(lla)
    vertical = options.vertical or _as_choice(heights)
    crs = parse_crs(text, vertical=vertical, field="--crs")
    crs = replace(crs, vertical=_datum_of_result(crs, options, heights))
    assumed = []
    if options.crs is None:
        assumed.append(f"the UTM zone of the scene, {text}, as nobody stated a CRS")
    if not crs.states_vertical and options.vertical is None:
        assumed.append(
            f"heights are {crs.vertical.name}, the datum of the survey's input ({heights.source}), as nobody "
            "stated another"
        )
    elif heights.is_assumed:
        assumed.append(f"the survey's heights were assumed to be {heights.name}: nobody stated their datum")
    return TargetCrs(crs.serving(lla), origin, lla, tuple(assumed))


def usable_crs(
    options: CrsOptions, origin: Origin | None, scene_in_geo: ArrayLike, heights: VerticalDatum
) -> TargetCrs:
    """Return the CRS in which a result is shown: `target_crs`, or one with ellipsoidal heights.

    Only the default gives way, where the survey's datum needs a grid that is not installed: a user who names a CRS
    or a datum learns what is missing.

    Raises:
        InputError: as `target_crs`, for a CRS or a datum that the user named.
    """
    try:
        return target_crs(options, origin, scene_in_geo, heights)
    except InputError:
        if options.crs is not None or options.vertical is not None:
            raise
    reason = f"heights are ellipsoidal: the grid of {heights.name} is not installed"
    return without_grid(options, origin, scene_in_geo, heights, reason)


def without_grid(
    options: CrsOptions, origin: Origin | None, scene_in_geo: ArrayLike, heights: VerticalDatum, reason: str
) -> TargetCrs:
    """Return the CRS with ellipsoidal heights, which need no grid, and the reason as an assumption."""
    ellipsoidal = options.model_copy(update={"vertical": VerticalChoice(ELLIPSOIDAL, None)})
    target = target_crs(ellipsoidal, origin, scene_in_geo, heights)
    datum = target.crs.vertical.model_copy(update={"note": reason})
    return replace(target, crs=replace(target.crs, vertical=datum), assumed=(*target.assumed, reason))


def _datum_of_result(crs: PointCrs, options: CrsOptions, heights: VerticalDatum) -> VerticalDatum:
    """Return the datum of a result's heights; it is stated only if the datum of the survey's heights was.

    A datum that the user names for a file is that of the file. Where the input's was assumed, so is every height
    that was converted from it.
    """
    datum = crs.vertical
    named = options.vertical is not None or crs.states_vertical
    note = datum.note if named else heights.note
    if named and heights.is_assumed:
        note = f"{note}; from heights that were assumed to be {heights.name}"
    return VerticalDatum(
        name=datum.name,
        stated=heights.stated or (named and heights.by_definition),
        note=note,
        by_definition=heights.by_definition and not named,
    )


def utm_zone(lla: ArrayLike) -> str:
    """Return the WGS84 UTM zone of the middle of places (M, 3) as `EPSG:n`."""
    lat, lon, _ = median_lla(lla)
    zone = int((lon + 180.0) // 6.0) % 60 + 1
    return f"EPSG:{(32700 if lat < 0 else 32600) + zone}"


def _as_choice(heights: VerticalDatum) -> VerticalChoice:
    try:
        return parse_vertical(heights.name)
    except InputError:  # a datum that has no code: the ellipsoid needs none
        return VerticalChoice(ELLIPSOIDAL, None)
