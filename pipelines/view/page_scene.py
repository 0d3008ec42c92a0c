"""Scene that a page of the viewer draws: frame, cameras, points, error arrows, and outlines that files have.

Of the files that commands write (area of interest, contour lines, regions that have changed), what cannot be read
is not drawn: the commands say what is wrong.
"""

from pathlib import Path

import numpy as np
import shapely

from pipelines.core.errors import GeorefError
from pipelines.core.json_values import Json
from pipelines.core.sentences import without_folders
from pipelines.core.stages import REPORT
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.geotiff import sampled_raster
from pipelines.formats.vector_files import read_contours, read_regions
from pipelines.geodesy.crs import PointCrs
from pipelines.report.plots.plans import nice_number
from pipelines.report.plots.style import colours_of
from pipelines.surface.measured_area import area_of
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.headline import headline_of
from pipelines.survey.options import CrsOptions, FilledAreaOptions
from pipelines.survey.report import read_report
from pipelines.survey.survey import Survey
from pipelines.survey.target_crs import TargetCrs, usable_crs
from pipelines.view.measuring import MeasuringModel
from pipelines.view.pictures import ViewFrame

_MOST_POINTS = 30_000  # SfM points that a page draws
_MOST_PLACES = 200_000  # of contour lines, and of regions
_LONGEST_ARROW = 0.07  # of the scene's radius: the arrow of the largest error
_CONTOURS, _REGIONS, _SURFACE = "raster/contours.gpkg", "change/regions.gpkg", "raster/dsm.tif"


def described_scene(workspace: Workspace, model: MeasuringModel, frame: ViewFrame) -> Json:
    """Return the scene as JSON; lengths in metres, places in the viewer's frame unless they say otherwise."""
    survey, renderer, target = model.survey, model.reader.renderer, model.target
    crs = target.crs
    xyz = target.xyz_from_geo((frame.middle_in_geo + np.vstack([np.zeros(3), np.eye(3)])).reshape(-1, 3))
    surveyed = (("control", survey.control_points), ("check", survey.check_points))
    return {
        "name": workspace.root.name,
        "accuracy": accuracy_sentence(workspace),
        "crs": {
            "name": crs.name,
            "heights": crs.vertical.name if target.origin is None else crs.vertical.described,
            "units": crs.units,
            "axes": target.axes,
            "assumed": [without_folders(text) for text in target.assumed if not _is_said(text, crs)],
            # Coordinates under the cursor: those of the middle, and how they change along east, north, up.
            "middle": xyz[0].tolist(),
            "by_view": (xyz[1:] - xyz[0]).T.tolist(),
        },
        "without_sigma": model.without_sigma,
        "middle_in_geo": frame.middle_in_geo.tolist(),
        "radius_m": frame.radius_m,
        "cameras": [_camera(model, frame, camera) for camera in range(len(model.solution.cameras))],
        "surveyed": [
            {"name": point.name, "kind": kind, "at": frame.from_geo(np.array(point.position_in_geo)).tolist()}
            for kind, points in surveyed
            for point in points
        ],
        "errors": error_arrows(workspace, survey, frame),
        "tie_points": _tie_points(model, frame),
        "boundary": boundary_rings(workspace, survey, renderer, frame),
        "contours": drawn_contours(workspace, survey, frame),
        "changes": changed_regions(workspace, survey, frame),
        "rasters": model.rasters(),
        "has_sigma": model.posterior is not None and model.posterior.grid is not None,
    }


def _is_said(assumption: str, crs: PointCrs) -> bool:
    """Return whether the page says an assumption anyway: the CRS by name, and heights whose datum was stated."""
    return crs.name in assumption or (crs.vertical.stated and crs.vertical.name in assumption)


def accuracy_sentence(workspace: Workspace) -> str:
    """Return the accuracy of the result; empty where nothing states it."""
    headline = headline_of(workspace)
    return "" if headline is None else f"Accuracy: {headline.text}."


def _camera(model: MeasuringModel, frame: ViewFrame, camera: int) -> Json:
    renderer, solved = model.reader.renderer, model.solution.cameras[camera]
    lens = renderer.sparse.camera_of(camera)
    rotation = renderer.poses.cam_from_model[camera] @ frame.view_from_model.inverse().rotation
    return {
        "name": solved.name,
        "split": solved.split,
        "at": frame.view_from_model.apply(renderer.poses.cam_center_in_model[camera][None])[0].tolist(),
        "rotation": rotation.ravel().tolist(),
        "half": [lens.width / 2 / lens.mean_focal_px, lens.height / 2 / lens.mean_focal_px],
        "size": [lens.width, lens.height],
    }


def _tie_points(model: MeasuringModel, frame: ViewFrame) -> Json:
    """Return SfM points with their colours, and the colours of their predicted σ where it is known."""
    sfm, points = model.reader.renderer.sfm, model.solution.point_in_model(model.reader.renderer.sfm)
    every = max(1, -(-len(points) // _MOST_POINTS))
    point: FloatArray = points[::every]
    sigma, grid = None, None if model.posterior is None else model.posterior.grid
    if grid is not None and len(point):
        cov = grid.cov_at(model.solution.similarity.apply(point))
        sigma_m = np.sqrt(np.trace(cov, axis1=1, axis2=2))
        low, high = np.quantile(sigma_m, [0.02, 0.98]).tolist()
        sigma = {"rgb": colours_of(sigma_m, low, high).ravel().tolist(), "scale": [low, high]}
    return {
        "at": np.round(frame.view_from_model.apply(point), 3).ravel().tolist(),
        "rgb": sfm.point_rgb[::every].ravel().tolist(),
        "sigma": sigma,
    }


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
    enlarged = nice_number(max(_LONGEST_ARROW * frame.radius_m / max(longest, 1e-12), 1.0))
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
    contours, places = [], 0
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
        contours.append({"height": line.height, "major": line.is_major, "at": at})
    return contours


def changed_regions(workspace: Workspace, survey: Survey, frame: ViewFrame) -> list[Json]:
    """Return the regions that `georef change` found, doubtful ones last, on the surface; none: there are none."""
    path, surface = workspace.root / _REGIONS, workspace.root / _SURFACE
    if not path.is_file() or not surface.is_file():
        return []
    drawn = (_drawn_regions(path, surface, survey, frame, doubtful=doubtful) for doubtful in (False, True))
    return [region for layer in drawn for region in layer]


def _drawn_regions(path: Path, surface: Path, survey: Survey, frame: ViewFrame, *, doubtful: bool) -> list[Json]:
    regions: list[Json] = []
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
                    return regions
                height = sampled_raster(surface, xy)
                if not np.isfinite(height).any():
                    continue
                height = np.where(np.isfinite(height), height, np.nanmedian(height))
                at = frame.from_geo(crs.geo_from_xyz(np.column_stack([xy, height])))
                outline = {"at": np.round(at, 2).tolist(), "raised": net_m3 > 0, "doubtful": doubtful}
                regions.append({"text": text, **outline})
                text = ""
    except GeorefError:
        return []
    return regions


def _crs(wkt: str, survey: Survey, frame: ViewFrame) -> TargetCrs:
    return usable_crs(CrsOptions(crs=wkt), survey.origin, frame.middle_in_geo[None], survey.vertical)
