"""Look at an exported splat from where the photographs were taken: PLY, sidecar and survey are all it knows.

    python examples/render_from_sidecar.py WORKSPACE SPLAT.ply OUTPUT_FOLDER [--images 6]

Each camera stands where GNSS measured it, on the Earth (EPSG:4978); only the sidecar takes it into the PLY's frame.
It looks where the trained camera looks, or with `--attitude recorded` where the gimbal says. Writes photograph and
render side by side; what lies between them is the error of GNSS (and gimbal).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from pipelines.core.products import load_json
from pipelines.core.types import FloatArray
from pipelines.core.workspace import Workspace
from pipelines.formats.georef_sidecar import GeorefSidecar, sidecar_path
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_enu_rotation, lla_of
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.splat.gaussians import read_gaussians
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.backends import rasterizer
from pipelines.survey.navigation import load_survey
from pipelines.survey.scene import photographs
from pipelines.survey.solution import Solution, read_sfm, read_trained
from pipelines.survey.survey import Fix, SurveyImage


def geo_from_cam(image: SurveyImage, index: int, solution: Solution, recorded: bool) -> FloatArray:
    """Rotation (3, 3) of a photograph's camera, measured or trained."""
    if recorded:
        if image.attitude is None:
            raise SystemExit(f"{image.name} has no recorded attitude")
        return matrix_from_quat_xyzw(image.attitude.quat_xyzw)
    return np.asarray(solution.similarity.rotation @ solution.poses.cam_from_model[index].T)


def cam_from_ply(fix: Fix, rotation_geo_from_cam: FloatArray, origin: Origin, splat: Path) -> torch.Tensor:
    """Pose (4, 4) in the PLY's frame of a camera that stands at a fix."""
    ply_from_ecef = load_json(GeorefSidecar, sidecar_path(splat)).ecef_from_file().inverse()
    center = ply_from_ecef.apply(ecef_from_enu(np.array(fix.position_in_geo), origin))
    ecef_from_cam = ecef_from_enu_rotation(lla_of(origin)) @ rotation_geo_from_cam
    rotation = (ply_from_ecef.rotation @ ecef_from_cam).T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ center
    return torch.from_numpy(pose).float()


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("workspace", type=Path)
    parser.add_argument("splat", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--images", type=int, default=6)
    parser.add_argument("--size", type=int, default=640)
    parser.add_argument("--attitude", choices=("trained", "recorded"), default="trained")
    options = parser.parse_args()
    workspace = Workspace(options.workspace)
    solution, survey = read_trained(workspace), load_survey(workspace)
    sfm = read_sfm(workspace, solution)
    number = sfm.image_index()
    registered = [(image, image.fix) for image in survey.images if image.name in number and image.fix is not None]
    chosen = registered[:: max(1, len(registered) // options.images)][: options.images]
    images = photographs(solution.with_lenses(sfm), survey, workspace, options.size)
    gaussians, backend = read_gaussians(options.splat), rasterizer("auto")
    options.output.mkdir(parents=True, exist_ok=True)
    for image, fix in chosen:
        index = number[image.name]
        rotation = geo_from_cam(image, index, solution, options.attitude == "recorded")
        pose = cam_from_ply(fix, rotation, survey.origin_on_earth, options.splat)
        with torch.no_grad():
            render = backend.render(gaussians, pose, images.pinhole(index), RasterSettings())
        colour = render.colour.clamp(0, 1).mul(255).byte().numpy()
        strip = np.concatenate([images.image(index), colour], axis=1)
        path = options.output / f"{Path(image.name).stem}.png"
        cv2.imwrite(str(path), np.ascontiguousarray(strip[..., ::-1]))
        print(path)


if __name__ == "__main__":
    main()
