"""Crop of a splat to the area of interest."""

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.core.workspace import Workspace
from pipelines.geometry.similarity import Similarity
from pipelines.surface.measured_area import area_of
from pipelines.survey.area import Area
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import CropOptions
from pipelines.survey.solution import read_sfm, read_solution


@dataclass(frozen=True)
class Crop:
    """Area outside which Gaussians are left out; those higher than `sky_m` in `geo` stay."""

    area: Area
    geo_from_model: Similarity
    sky_m: float

    def keeps(self, center_in_model: FloatArray | Float32Array) -> BoolArray:
        """Return which of Gaussians' centres (N, 3) stay."""
        center = self.geo_from_model.apply(center_in_model)
        return self.area.contains(center) | (center[:, 2] > self.sky_m)


def crop_of(workspace: Workspace, options: CropOptions) -> Crop | None:
    """Return the crop that the options ask for; None: none. Errors as of `read_solution` and `area_of`.

    The sky is what lies higher than all cameras.
    """
    if not options.crop and options.boundary is None:
        return None
    solution = read_solution(workspace)
    sfm, survey, cameras = read_sfm(workspace, solution), load_survey(workspace), solution.center_in_geo
    sky_m = float(cameras[:, 2].max()) if options.keep_sky else np.inf
    return Crop(area_of(options, workspace, solution, sfm, survey), solution.similarity, sky_m)
