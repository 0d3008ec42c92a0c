"""Check of solved lenses: a focal length far from what the photographs state, and rays that turn back.

A model of few photographs, or of flat ground seen from above, fits its observations with a lens that no drone
carries. Whoever measures in it is wrong by as much, and photographs that would fit the true lens are refused.
"""

import numpy as np

from pipelines.formats.colmap import lens_of_colmap
from pipelines.geometry.cameras import Camera, Reconstruction, undistort
from pipelines.survey.survey import FOCAL_DIFFERS, Survey

_RIM = 0.98  # of the image's half sides: at the corners themselves few points lie


def lenses_astray(model: Reconstruction, survey: Survey) -> dict[int, str]:
    """Return the cameras of a `pycolmap.Reconstruction` whose lens cannot be, each with the reason for people."""
    used = {model.images[image_id].camera_id for image_id in model.reg_image_ids()}
    priors = {prior.camera_id: prior for prior in survey.cameras}
    astray = {}
    for camera_id in sorted(used & set(priors)):
        solved, prior = model.cameras[camera_id], priors[camera_id]
        lens = lens_of_colmap(solved)
        if prior.focal_factor(lens) > FOCAL_DIFFERS:
            stated_px = prior.camera.mean_focal_px
            astray[camera_id] = (
                f"a focal length of {lens.mean_focal_px:.0f} px, where {stated_px:.0f} px are stated"
            )
        elif not _sees_its_rim(lens):
            astray[camera_id] = "a distortion that turns rays back within the image"
    return astray


def _sees_its_rim(lens: Camera) -> bool:
    """Return whether the lens maps one ray to each pixel near the rim of the image."""
    along = np.linspace(-_RIM, _RIM, 9)
    square = np.concatenate([[(x, side), (side, x)] for side in (-_RIM, _RIM) for x in along])
    half = np.array([lens.width, lens.height]) / 2
    return bool(np.isfinite(undistort(lens, half + square * half)).all())
