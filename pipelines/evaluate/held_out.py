"""Errors of the trained surface at measured points that the training was not given, beside those of stereo."""

import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.surface.surface_views import ModelRenderer
from pipelines.survey.lidar_report import DepthErrors, HeldOutDepths, HeldOutPoints

_MOST_VIEWS = 24  # renders: those of most points


def held_out_depths(renderer: ModelRenderer, held: HeldOutPoints, progress: Progress = SILENT) -> HeldOutDepths:
    """Return the errors at held-out points, along their normals in metres, before and after the training.

    Of many views, those that show most of the points are rendered; points of others do not count.
    """
    views, counts = np.unique(held.view, return_counts=True)
    chosen = views[np.argsort(-counts, kind="stable")[:_MOST_VIEWS]]
    after_m = np.full(len(held.view), np.nan)
    with progress.task("held-out points", len(chosen)) as task:
        for view in chosen.tolist():
            rows = np.flatnonzero(held.view == view)
            after_m[rows] = _errors_in(renderer, view, held.point_in_model[rows], held.normal_in_model[rows])
            task.advance()
    scale = renderer.geo_from_model.scale
    rendered = np.isin(held.view, chosen)
    before_m, after_m = scale * held.before_m[rendered], scale * after_m[rendered]
    known = np.isfinite(before_m) & np.isfinite(after_m)
    return HeldOutDepths(
        share=float(held.share),
        points=int(rendered.sum()),
        changed=int(held.changed),
        unseen=int(held.unseen),
        known_before=int(np.isfinite(before_m).sum()),
        known_after=int(np.isfinite(after_m).sum()),
        before=_errors(before_m[known]),
        after=_errors(after_m[known]),
    )


def _errors_in(renderer: ModelRenderer, view: int, point: FloatArray, normal: FloatArray) -> FloatArray:
    """Return the distances (P,) of the surface in a render from the planes of points (P, 3); NaN: none is shown."""
    pose, depth = renderer.pose(view), renderer.depth_m(view)
    xy = pose.pinhole.project((point - pose.center_in_model) @ pose.cam_from_model.T)
    inside = pose.pinhole.contains(xy)
    pixel = np.floor(xy[inside]).astype(np.int64)
    depth_m = depth[pixel[:, 1], pixel[:, 0]]
    surface_in_model = pose.center_in_model + depth_m[:, None] * (
        pose.pinhole.rays(pixel + 0.5) @ pose.cam_from_model
    )
    off_m = np.full(len(point), np.nan)
    distance = np.einsum("pi,pi->p", surface_in_model - point[inside], normal[inside])
    off_m[inside] = np.where(depth_m > 0, distance, np.nan)
    return off_m


def _errors(off_m: FloatArray) -> DepthErrors:
    if not len(off_m):
        return DepthErrors(points=0, bias_m=None, median_m=None, abs_90_m=None)
    median_m, abs_90_m = np.percentile(np.abs(off_m), [50, 90]).tolist()
    return DepthErrors(points=len(off_m), bias_m=float(np.median(off_m)), median_m=median_m, abs_90_m=abs_90_m)
