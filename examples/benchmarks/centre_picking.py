"""Distance of Gaussians' centres from the points that a user picks, beside that of the rendered surface.

`python examples/benchmarks/centre_picking.py WS` reads an evaluated survey with check points, and its
`export/splat.ply`, or with `--measurable` its `measurable/splat.measurable.ply`. At each mark, a centre is picked
as viewers do it:

- `front`: the frontmost centre of an opaque Gaussian within `--reach` pixels of the mark;
- `nearest`: the centre next to the mark among the opaque ones that lie at most 1 % behind the frontmost;
- `render`: the centre of the Gaussian at which half of the light of the mark's ray is stopped, in a window whose
  pixels are `--coarser` times as wide as those of the photograph.

`depth` is the difference, along the camera's z axis, between the centre and the surveyed point. H and V are the
horizontal and vertical distances between the two. `surface` is that of the trained model, rendered at the
same marks; the last line is the error on the rendered surface, of the report. All are medians.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pipelines.core.stages import MEASURABLE_SPLAT, REPORT, SPLAT
from pipelines.core.types import FloatArray, IntArray
from pipelines.core.workspace import Workspace
from pipelines.deliver.placement import solved_placement
from pipelines.geometry.cameras import Pinhole, pose_matrix
from pipelines.splat.gaussians import Gaussians, read_gaussians, transformed
from pipelines.splat.rasterizer.api import ALPHA_MAX, ALPHA_MIN, RasterSettings
from pipelines.splat.rasterizer.reference import project_gaussians
from pipelines.surface.picking import depth_around
from pipelines.surface.surface_views import ModelRenderer, model_renderer
from pipelines.survey.marks import MarkRays, mark_rays
from pipelines.survey.navigation import load_survey
from pipelines.survey.report import read_report
from pipelines.survey.solution import read_sfm, read_trained
from pipelines.survey.survey import SurveyedPoint

LEAST_OPACITY = 0.5
NOT_HIDDEN = 1.01  # of the depth of the frontmost centre
AROUND_PX = 80.0  # Gaussians with their centre further from a mark do not reach it


@dataclass(frozen=True)
class Look:
    """Gaussians as one camera sees them around a mark.

    Attributes:
        gaussians: all of N.
        in_cam: (N, 3) their centres.
        off_px: (N,) distances from the mark, in pixels of the photograph.
        opaque: (M,) rows of the opaque ones before the camera, within the reach.
        cam_from_model: (4, 4) pose.
        camera: of the viewer's window.
        xy_px: (2,) the mark in the window.
    """

    gaussians: Gaussians
    in_cam: FloatArray
    off_px: FloatArray
    opaque: IntArray
    cam_from_model: FloatArray
    camera: Pinhole
    xy_px: FloatArray


def front(look: Look) -> int | None:
    """Return the row of the centre that is picked; None: no centre is."""
    rows = look.opaque
    return int(rows[np.argmin(look.in_cam[rows, 2])]) if len(rows) else None


def nearest(look: Look) -> int | None:
    """Return the row of the centre that is picked; None: no centre is."""
    rows, depth = look.opaque, look.in_cam[look.opaque, 2]
    shown = rows[depth <= NOT_HIDDEN * depth.min()] if len(rows) else rows
    return int(shown[np.argmin(look.off_px[shown])]) if len(shown) else None


def render(look: Look) -> int | None:
    """Return the row of the centre that is picked; None: the ray meets too few Gaussians."""
    rows = np.flatnonzero((look.in_cam[:, 2] > RasterSettings().near_m) & (look.off_px < AROUND_PX))
    rows = rows[np.argsort(look.in_cam[rows, 2])]
    part = Gaussians(**{name: values[rows].double() for name, values in look.gaussians.tensors().items()})
    in_cam, pose = torch.from_numpy(look.in_cam[rows]), torch.from_numpy(look.cam_from_model)
    mean_px, cov_px2 = project_gaussians(part, in_cam, pose, look.camera, RasterSettings().dilation_px2)
    offset = torch.from_numpy(look.xy_px) - mean_px
    squared = (offset * torch.linalg.solve(cov_px2, offset)).sum(dim=1)
    alpha = torch.sigmoid(part.logit_opacities) * torch.exp(-0.5 * squared)
    light = torch.cumprod(1 - torch.where(alpha < ALPHA_MIN, 0.0, alpha.clamp_max(ALPHA_MAX)), dim=0)
    stopped = np.flatnonzero(light.numpy() <= 0.5)
    return int(rows[stopped[0]]) if len(stopped) else None


def picked_errors_m(
    points: Sequence[SurveyedPoint],
    renderer: ModelRenderer,
    gaussians: Gaussians,
    rules: list[Callable[[Look], int | None]],
    *,
    reach_px: float,
    coarser: float,
) -> FloatArray:
    """Return errors (rules, K, 3) in depth, horizontally and vertically at all K marks; NaN: nothing is picked."""
    rays, poses = mark_rays(points, renderer.sparse), renderer.poses
    true_in_geo = np.array([point.position_in_geo for point in points])[rays.point]
    centres, geo_from_model = gaussians.means.numpy().astype(np.float64), renderer.geo_from_model
    opaque = torch.sigmoid(gaussians.logit_opacities).numpy() >= LEAST_OPACITY
    errors = np.full((len(rules), len(rays.point), 3), np.nan)
    for camera in np.unique(rays.camera):
        turn, center = poses.cam_from_model[camera], poses.cam_center_in_model[camera]
        in_cam = (centres - center) @ turn.T
        focal_px = renderer.sparse.camera_of(int(camera)).mean_focal_px
        window_px = focal_px / coarser
        pinhole = Pinhole(1, 1, window_px, window_px, 0.0, 0.0)
        for mark in np.flatnonzero(rays.camera == camera):
            off_px = focal_px * np.linalg.norm(
                in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1e-6) - rays.xy[mark], axis=1
            )
            rows = np.flatnonzero(opaque & (in_cam[:, 2] > 0) & (off_px <= reach_px))
            pose, xy_px = pose_matrix(turn, center), window_px * rays.xy[mark]
            look = Look(gaussians, in_cam, off_px, rows, pose, pinhole, xy_px)
            true_in_model = geo_from_model.inverse().apply(true_in_geo[mark][None])[0]
            for number, rule in enumerate(rules):
                row = rule(look)
                if row is not None:
                    away = geo_from_model.apply(centres[row][None])[0] - true_in_geo[mark]
                    depth_m = geo_from_model.scale * (turn @ (centres[row] - true_in_model))[2]
                    errors[number, mark] = abs(depth_m), np.hypot(away[0], away[1]), abs(away[2])
    return errors


def surface_errors_m(points: Sequence[SurveyedPoint], renderer: ModelRenderer, rays: MarkRays) -> FloatArray:
    """Return the errors (K,) in depth of the trained model's rendered surface at the marks; NaN: no surface."""
    renderer.images.build()
    poses = renderer.poses
    true_in_geo = np.array([point.position_in_geo for point in points])[rays.point]
    true_in_model = renderer.geo_from_model.inverse().apply(true_in_geo)
    errors = np.full(len(rays.point), np.nan)
    for mark, (camera, xy) in enumerate(zip(rays.camera, rays.xy, strict=True)):
        depth_m = depth_around(renderer, int(camera), xy).depth_at(xy)
        true_m = (poses.cam_from_model[camera] @ (true_in_model[mark] - poses.cam_center_in_model[camera]))[2]
        if depth_m > 0:
            errors[mark] = renderer.geo_from_model.scale * abs(depth_m - true_m)
    return errors


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--reach", type=float, default=2.0, help="pixels of the photograph")
    parser.add_argument(
        "--coarser", type=float, default=1.0, help="width of a pixel of the window in the photograph's"
    )
    parser.add_argument("--measurable", action="store_true", help="pick in the measurable splat")
    arguments = parser.parse_args()
    workspace = Workspace(arguments.workspace)
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    renderer = model_renderer(workspace, model, sfm, survey)
    placement = solved_placement(model, survey, renderer.gaussians.means.numpy(), None)
    path = workspace.path(MEASURABLE_SPLAT if arguments.measurable else SPLAT)
    splat = transformed(read_gaussians(path), placement.file_from_model.inverse())
    rules: list[Callable[[Look], int | None]] = [front, nearest, render]
    print(f"{len(splat)} Gaussians\n{'':8}  marks  depth      H      V  (medians, m)")
    picked_m = picked_errors_m(
        survey.check_points, renderer, splat, rules, reach_px=arguments.reach, coarser=arguments.coarser
    )
    for rule, errors in zip(rules, picked_m, strict=True):
        known = np.isfinite(errors[:, 0])
        depth_m, horizontal_m, vertical_m = np.median(errors[known], axis=0)
        print(f"{rule.__name__:8}  {known.sum():5}  {depth_m:.3f}  {horizontal_m:.3f}  {vertical_m:.3f}")
    rays = mark_rays(survey.check_points, renderer.sparse)
    surface_m = surface_errors_m(survey.check_points, renderer, rays)
    print(f"surface   {np.isfinite(surface_m).sum():5}  {np.nanmedian(surface_m):.3f}")
    on_surface = read_report(workspace.path(REPORT)).checkpoints.surface
    assert on_surface is not None
    print(f"on the surface: {on_surface.count} points, median {on_surface.median_h_m:.3f} m H")


if __name__ == "__main__":
    main()
