"""Distance of Gaussians' centres from the points that a user picks, beside that of the rendered surface.

`python examples/benchmarks/centre_picking.py WS` reads an evaluated survey with check points. In each image, the
centre that is picked is that of the frontmost visible Gaussian within `--reach` pixels of the mark, as in a viewer
that snaps to centres. Its distance from the surveyed point is compared with the error by model of the report.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.scene.marks import mark_rays
from pipelines.scene.report import read_report
from pipelines.scene.trained_survey import TrainedSurvey, load_trained

LEAST_OPACITY = 0.5


def picked_errors_m(trained: TrainedSurvey, reach_px: float) -> np.ndarray:
    """Return the distances (K, 2), horizontal and vertical, of the picked centres from the points of all marks."""
    opaque = torch.sigmoid(trained.gaussians.logit_opacities) >= LEAST_OPACITY
    centres = trained.gaussians.select(opaque).means.numpy().astype(np.float64)
    points = trained.survey.check_points
    rays = mark_rays(points, trained.sparse)
    errors = []
    for point, camera, xy in zip(rays.point, rays.camera, rays.xy, strict=True):
        in_cam = (centres - trained.poses.cam_center_in_model[camera]) @ trained.poses.cam_from_model[camera].T
        focal_px = trained.sparse.camera_of(int(camera)).mean_focal_px
        off_px = np.linalg.norm(in_cam[:, :2] / np.maximum(in_cam[:, 2:], 1e-6) - xy, axis=1) * focal_px
        near = np.flatnonzero((in_cam[:, 2] > 0) & (off_px <= reach_px))
        if len(near):
            picked = trained.geo_from_model.apply(centres[near[np.argmin(in_cam[near, 2])]][None])[0]
            away = picked - np.array(points[point].position_in_geo)
            errors.append([np.hypot(away[0], away[1]), abs(away[2])])
    return np.array(errors).reshape(-1, 2)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspace", type=Path)
    parser.add_argument("--reach", type=float, default=2.0, help="pixels of the photograph")
    arguments = parser.parse_args()
    workspace = Workspace(arguments.workspace)
    by_model = read_report(workspace.path(REPORT)).checkpoints.model
    picked = picked_errors_m(load_trained(workspace), arguments.reach)
    print(f"rendered surface: {by_model.count} points, median {by_model.median_h_m:.3f} m H")
    median_h_m, median_v_m = np.median(picked, axis=0)
    print(f"picked centres: {len(picked)} marks, median {median_h_m:.3f} m H, {median_v_m:.3f} m V")


if __name__ == "__main__":
    main()
