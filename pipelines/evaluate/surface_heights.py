"""Heights of the rendered surface at check points, from above: what a DSM says there, on the ground and on roofs.

The triangulated check points measure the georeference. A roof that the Gaussians show too low is right in them and
wrong in every surface model, mesh and measurement, so that the surface has figures of its own.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from pipelines.core.errors import DegenerateGeometryError
from pipelines.core.extras import extra_part
from pipelines.core.figures import SurfaceAccuracy, SurfaceErrors
from pipelines.core.progress import Progress
from pipelines.core.types import BoolArray
from pipelines.splat.gaussians import rotation_matrices
from pipelines.surface.ground import terrain_of
from pipelines.surface.picking import Sight, SurfacePoint, SurfaceReader
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.report import SurfaceHeight
from pipelines.survey.survey import SurveyedPoint
from pipelines.survey.trained_survey import TrainedSurvey

_RAISED_M = 1.0  # above the ground, from which a check point lies on a roof, a wall or a vehicle
_GROUND_SPACING_M, _AROUND_M = (
    0.5,
    60.0,
)  # of the points that the ground is found in: the cloth's knots are 1 m apart
_SOLID = 0.5  # least opacity of a Gaussian that shows the surface


def surface_heights(renderer: ModelRenderer, progress: Progress) -> tuple[SurfaceHeight, ...]:
    """Return the rendered surface's height above each check point's, in plan at the surveyed place.

    Points under vegetation are left out: the surface there is that of the plants.
    """
    trained = renderer.trained
    points = [point for point in trained.survey.check_points if point.land_cover != "vegetated"]
    if not points:
        return ()
    surveyed = np.array([point.position_in_geo for point in points])
    center = trained.geo_from_model.apply(trained.poses.cam_center_in_model)
    raised, reader = _raised(trained, points), SurfaceReader(renderer)
    model_from_geo = trained.geo_from_model.inverse()
    down = model_from_geo.rotation @ np.array([0.0, 0.0, -1.0])
    rows = []
    with progress.task("surface at check points", len(points)) as task:
        for index, point in enumerate(points):
            start = np.append(surveyed[index, :2], center[:, 2].max())
            # A pixel of the nearest photograph, as the raster's cells are.
            arm_m = np.linalg.norm(center - surveyed[index], axis=1)
            nearest = int(arm_m.argmin())
            pixel_m = arm_m[nearest] / reader.focal_px(nearest)
            pixel_rad = pixel_m / max(start[2] - surveyed[index, 2], pixel_m)
            found = reader.under(Sight(model_from_geo.apply(start[None])[0], down, float(pixel_rad)))
            up_m = found.position_in_geo[2] - surveyed[index, 2] if isinstance(found, SurfacePoint) else None
            place = None if raised is None else "raised" if raised[index] else "ground"
            rows.append(SurfaceHeight(name=point.name, du_m=None if up_m is None else float(up_m), place=place))
            task.advance()
    return tuple(rows)


def surface_accuracy(heights: Sequence[SurfaceHeight], points: Sequence[SurveyedPoint]) -> SurfaceAccuracy | None:
    """Return the RMSE of the surface's heights, their survey's error included; None: none was measured."""
    variance = {point.name: point.cov_in_geo[2][2] for point in points}

    def errors(place: str | None) -> SurfaceErrors | None:
        square = [
            row.du_m**2 + variance[row.name] for row in heights if row.place == place and row.du_m is not None
        ]
        return SurfaceErrors(check_points=len(square), rmse_v_m=float(np.sqrt(np.mean(square)))) if square else None

    found = SurfaceAccuracy(
        ground=errors("ground"),
        raised=errors("raised"),
        anywhere=errors(None),
        unseen=sum(row.du_m is None for row in heights),
    )
    return found if heights and (found.ground or found.raised or found.anywhere) else None


def _raised(trained: TrainedSurvey, points: Sequence[SurveyedPoint]) -> BoolArray | None:
    """Return which points stand above the ground around them; None: the ground is not known."""
    if extra_part("terrain").found is None:
        return None
    place = np.array([point.position_in_geo for point in points])
    gaussians = trained.gaussians
    in_geo = trained.geo_from_model.apply(gaussians.means.numpy())
    low, high = place.min(axis=0)[:2] - _AROUND_M, place.max(axis=0)[:2] + _AROUND_M
    near = ((in_geo[:, :2] >= low) & (in_geo[:, :2] <= high)).all(axis=1)
    chosen = np.flatnonzero(near & (torch.sigmoid(gaussians.logit_opacities).numpy() >= _SOLID))
    _, first = np.unique(np.floor(in_geo[chosen] / _GROUND_SPACING_M), axis=0, return_index=True)
    chosen = chosen[np.sort(first)]
    of_chosen = gaussians.select(torch.from_numpy(chosen))
    axes, thinnest = rotation_matrices(of_chosen.quats_wxyz).numpy(), of_chosen.log_scales.numpy().argmin(axis=1)
    normal = axes[np.arange(len(chosen)), :, thinnest] @ trained.geo_from_model.rotation.T
    try:
        spacing_m = float(np.median(cKDTree(in_geo[chosen]).query(in_geo[chosen], k=2)[0][:, 1]))
        ground = terrain_of(in_geo[chosen], normal, max(spacing_m, _GROUND_SPACING_M))
    except DegenerateGeometryError:
        return None
    above_m = place[:, 2] - ground.interpolated(ground.height, place[:, :2])
    return np.asarray(above_m > max(_RAISED_M, ground.limit_m))
