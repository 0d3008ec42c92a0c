"""What a page of the viewer needs once: frame, cameras, points, outlines, and what may be measured."""

from typing import Any

import numpy as np

from pipelines.core.sentences import without_folders
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geodesy.crs import PointCrs
from pipelines.report.plots.style import colours_of
from pipelines.survey.headline import headline_of
from pipelines.view.measuring import MeasuringModel
from pipelines.view.overlays import boundary_rings, changed_regions, drawn_contours, error_arrows
from pipelines.view.pictures import ViewFrame

Json = dict[str, Any]
_MOST_POINTS = 30_000  # SfM points that a page draws


def described_scene(workspace: Workspace, model: MeasuringModel, frame: ViewFrame) -> Json:
    """Return all of it as JSON; lengths in metres, places in the viewer's frame unless they say otherwise."""
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
            for kind, found in surveyed
            for point in found
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
