"""What a page draws over the picture: errors of points, area of interest, contour lines, regions that have changed.

What cannot be read is not drawn: the commands that write it say what is wrong.
"""

from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipelines.core.errors import GeorefError
from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.formats.geotiff import sampled_raster
from pipelines.formats.vector_files import read_contours, read_regions
from pipelines.report.plots.plans import nice_number
from pipelines.surface.measured_area import area_of
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.options import CrsOptions, FilledAreaOptions
from pipelines.survey.report import read_report
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, usable_crs
from pipelines.view.pictures import ViewFrame

Json = dict[str, Any]
_MOST_PLACES = 200_000  # of contour lines, and of regions
_LENGTH = 0.07  # of the scene's radius: the longest error arrow
_CONTOURS, _REGIONS, _SURFACE = "raster/contours.gpkg", "change/regions.gpkg", "raster/dsm.tif"


def error_arrows(workspace: Workspace, survey: Survey, frame: ViewFrame) -> Json | None:
    """Return arrows of the errors of surveyed points, enlarged so that they are seen; None: no errors."""
    try:
        report = read_report(workspace.path(REPORT))
    except GeorefError:
        return None
    points = (*survey.control_points, *survey.check_points)
    place = {point.name: np.array(point.position_in_geo) for point in points}
    rows = (*report.checkpoints.triangulated.points, *report.fit.gcp.points)
    errors = [(place[row.name], np.array(row.error_m)) for row in rows if row.name in place and row.error_m]
    if not errors:
        return None
    longest = max(float(np.linalg.norm(error)) for _, error in errors)
    enlarged = nice_number(max(_LENGTH * frame.radius_m / max(longest, 1e-12), 1.0))
    arrows = [[surveyed, surveyed + enlarged * error] for surveyed, error in errors]
    return {"enlarged": enlarged, "arrows": frame.from_geo(np.array(arrows)).tolist()}


def boundary_rings(
    workspace: Workspace, survey: Survey, renderer: ModelRenderer, frame: ViewFrame
) -> list[list[list[float]]]:
    """Return the rings of the area of interest."""
    try:
        area = area_of(FilledAreaOptions(), workspace, renderer.model, renderer.sfm, survey)
    except GeorefError:
        return []
    rings = [ring for part in shapely.get_parts(area.polygon) for ring in (part.exterior, *part.interiors)]
    places = [np.column_stack([np.array(ring.coords), np.full(len(ring.coords), area.level_m)]) for ring in rings]
    return [frame.from_geo(place).tolist() for place in places]


def drawn_contours(workspace: Workspace, survey: Survey, frame: ViewFrame) -> list[Json]:
    """Return the contour lines that export-raster drew; none: there are none."""
    path = workspace.root / _CONTOURS
    if not path.is_file():
        return []
    found, places = [], 0
    try:
        wkt, lines = read_contours(path)
        crs = _crs(wkt, survey, frame)
    except GeorefError:
        return []
    for line in lines:
        places += len(line.xy)
        if places > _MOST_PLACES:
            break
        in_geo = crs.geo_from_xyz(np.column_stack([line.xy, np.full(len(line.xy), line.height)]))
        at = np.round(frame.from_geo(in_geo), 2).tolist()
        found.append({"height": line.height, "major": line.is_major, "at": at})
    return found


def changed_regions(workspace: Workspace, survey: Survey, frame: ViewFrame) -> list[Json]:
    """Return the regions that `georef change` found, doubtful ones last, on the surface; none: there are none."""
    path, surface = workspace.root / _REGIONS, workspace.root / _SURFACE
    if not path.is_file() or not surface.is_file():
        return []
    drawn = (_drawn_regions(path, surface, survey, frame, doubtful=doubtful) for doubtful in (False, True))
    return [region for layer in drawn for region in layer]


def _drawn_regions(path: Path, surface: Path, survey: Survey, frame: ViewFrame, *, doubtful: bool) -> list[Json]:
    found: list[Json] = []
    places = 0
    try:
        wkt, polygons, rows = read_regions(path, ("name", "net_m3", "sigma_m3"), doubtful=doubtful)
        crs = _crs(wkt, survey, frame)
        for polygon, (name, net_m3, sigma_m3) in zip(polygons, rows, strict=True):
            text = f"{name}: {net_m3:+.1f} ± {sigma_m3:.1f} m³{', doubtful' if doubtful else ''}"
            for part in shapely.get_parts(polygon):
                xy = np.array(part.exterior.coords)
                places += len(xy)
                if places > _MOST_PLACES:
                    return found
                height = sampled_raster(surface, xy)
                if not np.isfinite(height).any():
                    continue
                height = np.where(np.isfinite(height), height, np.nanmedian(height))
                at = frame.from_geo(crs.geo_from_xyz(np.column_stack([xy, height])))
                outline = {"at": np.round(at, 2).tolist(), "raised": net_m3 > 0, "doubtful": doubtful}
                found.append({"text": text, **outline})
                text = ""
    except GeorefError:
        return []
    return found


def _crs(wkt: str, survey: Survey, frame: ViewFrame) -> TargetCrs:
    return usable_crs(CrsOptions(crs=wkt), survey.origin, frame.middle_in_geo[None], survey.vertical)
