"""The simulated lens against COLMAP's own camera models, which share no code with it."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from pipelines.core.errors import InputError
from pipelines.simulate.lens import BrownLens, LensModel
from tests.refusals import refused

LENSES = [
    BrownLens("pinhole", 640, 480, 544.0, (320.0, 240.0)),
    BrownLens("radial", 640, 480, 544.0, (322.5, 238.5), -0.045, 0.012),
    BrownLens("opencv", 640, 480, 544.0, (322.5, 238.5), -0.045, 0.012, 0.0004, -0.0003),
    BrownLens("opencv", 640, 480, 400.0, (310.0, 250.0), 0.1, -0.02, -0.002, 0.003),
]


def corners_and_middle(lens: BrownLens) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(0, lens.width, 9), np.linspace(0, lens.height, 9))
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_projection_is_colmaps(lens: BrownLens) -> None:
    camera = pycolmap.Camera(
        model=lens.colmap_model, width=lens.width, height=lens.height, params=lens.colmap_params
    )
    points = lens.directions(corners_and_middle(lens)) * 37.0
    expected = np.array([camera.img_from_cam(point) for point in points])
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-9)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_rays_project_where_they_came_from(lens: BrownLens) -> None:
    pixels = corners_and_middle(lens)
    np.testing.assert_allclose(lens.project(lens.directions(pixels)), pixels, atol=1e-8)


def test_what_lies_behind_or_beyond_the_fold_is_not_seen() -> None:
    lens = BrownLens("radial", 640, 480, 544.0, (320.0, 240.0), -0.3, 0.0)
    # With k1 = −0.3 the polynomial r(1 − 0.3 r²) turns at r = 1/√0.9 ≈ 1.05: r = 1.7 would come back inside.
    pixels = lens.project([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0], [1.7, 0.0, 1.0]])
    assert np.isfinite(pixels).all(axis=1).tolist() == [True, False, False]


@pytest.mark.parametrize("model", ["radial", "opencv"])
def test_distortion_that_folds_inside_the_image_is_refused(model: LensModel) -> None:
    lens = BrownLens(model, 640, 480, 200.0, (320.0, 240.0), -0.4, 0.0)
    with refused("distortion-too-strong", InputError):
        lens.directions(corners_and_middle(lens))
