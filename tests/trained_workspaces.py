"""A workspace whose trained model is the truth, written without any training."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.core.products import save_json
from pipelines.core.stages import GAUSSIANS, MODEL, SIM3
from pipelines.core.workspace import Workspace
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.scene.trained_model import TrainedCamera
from pipelines.splat.initialise import gaussians_of_size
from pipelines.splat.storage import write_gaussians
from tests.scenes import (
    GEO_FROM_LOCAL,
    WITH_GCPS,
    Noise,
    TrueScene,
    initial,
    make_scene,
    sparse_model,
    survey_of,
    trained_model,
    write_workspace,
)

# In `model` the axes are those of geo, and the origin lies elsewhere.
GEO_FROM_MODEL = Similarity(translation=np.array([40.0, -30.0, 60.0]))
NOISE = Noise(pixel_px=0.3)
IMAGES = 8


def trained_workspace(root: Path) -> tuple[TrueScene, Workspace]:
    """Return a true scene, and a workspace as `train` leaves it; a Gaussian stands at every SfM point."""
    scene, rng = make_scene(images=IMAGES, points=80), np.random.default_rng(0)
    survey = survey_of(scene, NOISE, WITH_GCPS, rng)
    images = tuple(
        image.model_copy(update={"timestamp_s": 1.7e9 + index}) for index, image in enumerate(survey.images)
    )
    workspace = write_workspace(root, survey.model_copy(update={"images": images}), sparse_model(scene, NOISE, rng))
    model_from_geo = GEO_FROM_MODEL.inverse()
    rotation = np.swapaxes(scene.geo_from_cam, 1, 2)
    centers = model_from_geo.apply(scene.center_in_geo)
    cameras = tuple(
        TrainedCamera(
            name=name,
            split="test" if index == 2 else "train",
            quat_xyzw=tuple(quat_xyzw_from_matrix(rotation[index])),
            translation=tuple(-rotation[index] @ centers[index]),
        )
        for index, name in enumerate(scene.names)
    )
    save_json(trained_model(GEO_FROM_MODEL, model_from_geo @ GEO_FROM_LOCAL, cameras=cameras), root / MODEL)
    save_json(initial(), root / SIM3)
    means = model_from_geo.apply(scene.point_in_geo)
    write_gaussians(root / GAUSSIANS, gaussians_of_size(means, np.zeros_like(means), np.ones(len(means))))
    return scene, workspace
