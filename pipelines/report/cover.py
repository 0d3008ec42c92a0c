"""Cover of the report: for whom and by whom, the result from above, and the facts that a client asks for first."""

import contextlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from pipelines.adjust.posterior import Posterior
from pipelines.core.errors import GeorefError
from pipelines.core.figures import MISSING, Headline, SurfaceErrors, length_text
from pipelines.core.sentences import listed
from pipelines.core.stages import BY_NAME, HILLSHADE, ORTHOPHOTO_PREVIEW
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.footprints import PointSurface
from pipelines.report.cameras import LensesFacts, OverlapFacts
from pipelines.report.options import ReportOptions
from pipelines.report.page import (
    Picture,
    count_text,
    limited,
    logo_picture,
    number_text,
    picture_of_png,
    preview,
    read_pixels,
    share,
)
from pipelines.report.plots.maps import RasterPlace, raster_map
from pipelines.report.record import measured_share
from pipelines.survey.area import ground_sampling_m
from pipelines.survey.report import EvaluationReport
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs

_NOTES = {
    "measured": "RMSE of the triangulated check points, their survey's error included",
    "predicted": "no check points: root mean square of the predicted σ over the scene",
    "unknown": "neither measured nor predicted",
}
_PREVIEW_PX = 900
_EARLIEST_S = 631_152_000.0  # 1990: smaller times count from the start of a device, not from 1970
_MOST_CAMERAS = 3


@dataclass(frozen=True)
class CoverFacts:
    """Cover of a report; a picture is None where there is none, a name empty where nobody gave it."""

    client: str
    author: str
    logo: Picture | None
    views: tuple[tuple[str, Picture], ...]  # caption and picture of the result from above
    facts: tuple[tuple[str, str], ...]  # name and value
    headline: Headline
    accuracy_note: str
    surface: tuple[tuple[str, str, SurfaceErrors], ...]  # where, key in the headline, and errors
    unseen: int  # check points without a surface
    trained: bool
    without: str  # blunders among the check points, for the figures without them; empty: there are none


def cover_facts(
    workspace: Workspace,
    survey: Survey,
    posterior: Posterior,
    report: EvaluationReport,
    options: ReportOptions,
    *,
    crs: TargetCrs,
    scene: FloatArray,
    overlap: OverlapFacts,
    lenses: LensesFacts,
) -> CoverFacts:
    """Return the cover, of a scene (N, 3) in `geo`; an InputError: the logo is no PNG or JPEG, or too large."""
    area = MISSING if report.area_ha is None else f"{number_text(report.area_ha, 2)} ha"
    delivered = measured_share(workspace)
    if delivered is not None:  # what the list of delivered files says of the rasters
        area = f"{number_text(delivered[1], 2)} ha, {share(delivered[0])} of it measured"
    elif report.area_measured is not None:
        area += f", {report.area_measured:.0%} of it measured"
    surface, solution = report.headline.surface, posterior.solution
    height_m, gsd_m = flying_height_m(solution.center_in_geo, scene), ground_sampling_m(solution, posterior.sparse)
    previews = {"Orthophoto": ORTHOPHOTO_PREVIEW, "Surface model": HILLSHADE}
    pictures = {name: _raster_picture(workspace, name, product) for name, product in previews.items()}
    registered = f"{count_text(lenses.photographs)} of {count_text(len(survey.images))} registered"
    control, check = (count_text(len(points)) for points in (survey.control_points, survey.check_points))
    cameras = [
        f"{lens.make_model or lens.camera.model}, {lens.camera.width} × {lens.camera.height} px, "
        f"focal length {number_text(lens.camera.mean_focal_px, 0)} px"
        for lens in lenses.lenses[:_MOST_CAMERAS]
    ]
    cameras += ["…"] if len(lenses.lenses) > _MOST_CAMERAS else []
    return CoverFacts(
        client=options.client,
        author=options.author,
        logo=None if options.logo is None else logo_picture(options.logo),
        views=tuple((name, picture) for name, picture in pictures.items() if picture is not None),
        facts=(
            ("Area", area),
            ("Photographs", registered),
            ("Taken on", days_of(image.timestamp_s for image in survey.images)),
            ("Camera", "; ".join(cameras) or MISSING),
            ("Flying height above ground", MISSING if height_m is None else f"{number_text(height_m, 0)} m"),
            ("Ground sample distance", length_text(gsd_m)),
            ("Photographs of a place", f"{number_text(overlap.median, 0)} (median)"),
            ("Surveyed points", f"{control} control points, {check} check points"),
            ("Coordinate system", crs.crs.name),
            ("Heights", crs.crs.vertical.name if crs.origin is None else crs.crs.vertical.described),
        ),
        headline=report.headline,
        surface=() if surface is None else surface.parts,
        unseen=0 if surface is None else surface.unseen,
        trained=report.test_views is not None,
        accuracy_note=_NOTES[report.headline.kind],
        without=listed(report.headline.blunders),
    )


def _raster_picture(workspace: Workspace, name: str, product: str) -> Picture | None:
    """Return a raster as a map with coordinates, and of heights with their legend; without its place, as it is."""
    path = workspace.root / product
    if not path.is_file():
        return None
    manifest = None
    with contextlib.suppress(GeorefError):  # damaged: the section on processing says so
        manifest = workspace.manifest(BY_NAME["export-raster"])
    values = {} if manifest is None else manifest.values
    drawn = values.get("map")
    if drawn is None:
        return preview(path, _PREVIEW_PX)
    (west, south, _), (east, north, _) = values["bounds"]
    unit_m = east_m = float(drawn["unit_m"])
    if drawn["unit"] == "°":
        east_m *= math.cos(math.radians((south + north) / 2))
    place = RasterPlace(
        crs=values["crs"],
        names=tuple(drawn["names"]),
        unit=drawn["unit"],
        bounds=(west, south, east, north),
        unit_m=(east_m, unit_m),
    )
    heights = (*drawn["height_colours"], drawn["height_unit"]) if product == HILLSHADE else None
    return picture_of_png(raster_map(limited(read_pixels(path), _PREVIEW_PX), place, name, heights))


def flying_height_m(center: FloatArray, scene: FloatArray) -> float | None:
    """Return the median height of photographs (n, 3) above the surface of a scene (N, 3); None: it is empty."""
    return float(np.median(center[:, 2] - PointSurface(scene).heights(center[:, :2]))) if len(scene) else None


def days_of(times_s: Iterable[float | None]) -> str:
    """Return the first and the last day, in UTC, of times since 1970; a dash where none is known."""
    known = [time_s for time_s in times_s if time_s is not None and time_s >= _EARLIEST_S]
    ends = (min(known), max(known)) if known else ()
    days = [f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d}" for time_s in ends]
    return " to ".join(dict.fromkeys(days)) or MISSING
