"""Heights of the rendered surface at check points, from above: what a DSM says there, on the ground and on roofs.

The triangulated check points measure the georeference. A roof that the Gaussians show too low is right in them and
wrong in every surface model, mesh and measurement, so that the surface has figures of its own.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.extras import extra_part
from pipelines.core.figures import SurfaceAccuracy, SurfaceErrors
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray, FloatArray
from pipelines.surface.ground import terrain_of
from pipelines.surface.plan_heights import heights_in_plan
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.report import SurfaceHeight
from pipelines.survey.survey import SurveyedPoint

_RAISED_M = 1.0  # above the ground, from which a check point lies on a roof, a wall or a vehicle
_STEP_M = 1.0  # of the surface around a point, from which it lies at an edge, and of the surface above a point
_AROUND_PX, _LEAST_AROUND_M = 3.0, 0.3  # distance at which the surface around is looked at
_REACH_PX = 1.5  # of a place: the pixels whose mean height it takes
_NEIGHBOURS, _LEAST_SPACING_M, _LEAST_POINTS = 10, 0.5, 100  # of the tie points that show the ground


def surface_heights(
    check_points: Sequence[SurveyedPoint], renderer: ModelRenderer, progress: Progress
) -> tuple[SurfaceHeight, ...]:
    """Return the rendered surface's height above each check point's, in plan at the surveyed place.

    Left out are points under vegetation, where the surface is that of the plants. Points at an edge, as on a wall,
    and points that a surface covers, as below a roof, are no places of a DSM: their difference is not stated.
    """
    points = [point for point in check_points if point.land_cover != "vegetated"]
    if not points:
        return ()
    surveyed = np.array([point.position_in_geo for point in points])
    center = renderer.model.center_in_geo
    arm_m = np.linalg.norm(center[None] - surveyed[:, None], axis=2)
    focal_px = np.array([renderer.images.pinhole(camera).fx for camera in range(len(center))])
    pixel_m = float(np.median((arm_m / focal_px).min(axis=1)))  # of the most detailed view
    around_m = max(_AROUND_PX * pixel_m, _LEAST_AROUND_M)
    steps = around_m * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    plan = (surveyed[:, None, :2] + steps).reshape(-1, 2)
    with progress.task("surface at check points") as task:
        surface = heights_in_plan(renderer, plan, float(np.median(surveyed[:, 2])), _REACH_PX * pixel_m)
        task.advance()
    height = surface.height_m.reshape(len(points), len(steps))
    difference = height[:, 0] - surveyed[:, 2]
    at_edge = np.ptp(np.where(np.isfinite(height), height, height[:, :1]), axis=1) > _STEP_M
    covered = difference > _STEP_M
    tie_points = renderer.geo_from_model.apply(renderer.model.point_in_model(renderer.sfm))
    raised = _raised(tie_points, surveyed)
    rows = []
    for index, point in enumerate(points):
        place = None if raised is None else "raised" if raised[index] else "ground"
        hidden = "edge" if at_edge[index] else "covered" if covered[index] else None
        known = hidden is None and np.isfinite(difference[index])
        rows.append(
            SurfaceHeight(name=point.name, du_m=float(difference[index]) if known else None, place=hidden or place)
        )
    return tuple(rows)


def surface_accuracy(heights: Sequence[SurfaceHeight], points: Sequence[SurveyedPoint]) -> SurfaceAccuracy | None:
    """Return the RMSE of the surface's heights, their survey's error included; None: none was measured."""
    variance = {point.name: point.cov_in_geo[2][2] for point in points}

    def errors(place: str | None) -> SurfaceErrors | None:
        square = [
            row.du_m**2 + variance[row.name] for row in heights if row.place == place and row.du_m is not None
        ]
        return SurfaceErrors(check_points=len(square), rmse_v_m=float(np.sqrt(np.mean(square)))) if square else None

    accuracy = SurfaceAccuracy(
        ground=errors("ground"),
        raised=errors("raised"),
        anywhere=errors(None),
        unseen=sum(row.du_m is None for row in heights),
    )
    return accuracy if accuracy.parts else None


def _raised(points: FloatArray, surveyed: FloatArray) -> BoolArray | None:
    """Return which places (J, 3) stand above the ground around them; None: the ground is not known.

    The ground is found in the tie points (N, 3): no Gaussian below it can pull it down.
    """
    if extra_part("terrain").found is None or len(points) < _LEAST_POINTS:
        return None
    distance, near = cKDTree(points).query(points, k=_NEIGHBOURS)
    apart = points[near] - points[near].mean(axis=1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart))[1][:, :, 0]
    try:
        ground = terrain_of(points, normal, max(float(np.median(distance[:, 1])), _LEAST_SPACING_M))
    except DegenerateGeometryError:
        return None
    above_m = surveyed[:, 2] - ground.interpolated(ground.height, surveyed[:, :2])
    return np.asarray(above_m > max(_RAISED_M, ground.limit_m))
