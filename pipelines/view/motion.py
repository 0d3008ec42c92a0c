"""Models for pictures while the view moves: each shows the whole scene with fewer Gaussians than the one before.

A pass over a million Gaussians takes a processor longer than the picture itself. What lies outside the picture is
left out block by block, so that a view from near has the trained model itself; a view from afar has a coarser one.
"""

import threading

import torch

from pipelines.formats.splat_ply import SplatArrays
from pipelines.geometry.cameras import ViewPose, pose_matrix
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.level_of_detail import coarser
from pipelines.splat.rasterizer.api import RasterSettings, Render, Window
from pipelines.surface.surface_views import ModelRenderer

MOST_GAUSSIANS = 120_000  # of a picture that moves: a tenth of a second on two cores


class MotionModels:
    """Models of a scene, the finest first; until all are made, those that there are."""

    def __init__(self, finest: ModelRenderer) -> None:
        self._models = [finest]

    def make(self, ended: threading.Event) -> None:
        """Make the coarser models, if a processor draws; `ended` gives up."""
        finest = self._models[0]
        gaussians = finest.gaussians
        if ended.is_set() or finest.device.type != "cpu" or len(gaussians) <= MOST_GAUSSIANS:
            return
        finest.blocks  # noqa: B018, made now, so that no picture waits for it
        for splat in coarser(SplatArrays(**gaussians.arrays()), MOST_GAUSSIANS):
            values = {name: torch.from_numpy(getattr(splat, name)) for name in gaussians.tensors()}
            model = finest.showing(Gaussians(**values))
            model.blocks  # noqa: B018
            self._models.append(model)
            if ended.is_set():
                return

    def render(self, pose: ViewPose) -> Render:
        """Return the render, with depth, by the finest model that shows few Gaussians here, else the last."""
        last = self._models[-1]
        if last is self._models[0]:
            return last.render(pose, depth=True)
        matrix, pinhole = pose_matrix(pose.cam_from_model, pose.center_in_model), pose.pinhole
        settings = RasterSettings(last.model.sh_degree, last.model.background, depth=True)
        for model in self._models:
            count = model.blocks.count_shown(matrix, pinhole, settings)
            if count <= MOST_GAUSSIANS:
                # Rows are gathered where that leaves out the most of them.
                few = 2 * count < len(model.gaussians)
                window = Window(0, 0, pinhole.width, pinhole.height) if few else None
                return model.render(pose, depth=True, window=window)
        return last.render(pose, depth=True)
