"""Lens models against COLMAP's own, and their edges."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import MODELS, Camera, Pinhole, distort, project, undistort
from tests.refusals import numbers, refused

pycolmap = pytest.importorskip("pycolmap")

PARAMS = {
    "SIMPLE_PINHOLE": [900.0, 610.0, 455.0],
    "PINHOLE": [900.0, 905.0, 610.0, 455.0],
    "SIMPLE_RADIAL": [900.0, 610.0, 455.0, -0.08],
    "RADIAL": [900.0, 610.0, 455.0, -0.08, 0.02],
    "OPENCV": [900.0, 905.0, 610.0, 455.0, -0.09, 0.03, 4e-4, -3e-4],
    "FULL_OPENCV": [900.0, 905.0, 610.0, 455.0, 0.2, -0.1, 4e-4, -3e-4, 0.02, 0.3, -0.1, 0.01],
    "OPENCV_FISHEYE": [500.0, 505.0, 610.0, 455.0, 0.02, -0.01, 0.004, -0.001],
}


def camera_of(model: str) -> Camera:
    return Camera(model, 1200, 900, np.array(PARAMS[model]))


@pytest.fixture
def pixels() -> np.ndarray:
    grid = np.meshgrid(np.linspace(0.5, 1199.5, 25), np.linspace(0.5, 899.5, 19))
    return np.stack(grid, axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("model", MODELS)
def test_undistort_agrees_with_colmap(model: str, pixels: np.ndarray) -> None:
    oracle = pycolmap.Camera(model=model, width=1200, height=900, params=PARAMS[model])
    # COLMAP stops its own iteration at about 1e-10.
    np.testing.assert_allclose(
        undistort(camera_of(model), pixels), np.array(oracle.cam_from_img(pixels)), atol=1e-8
    )


@pytest.mark.parametrize("model", MODELS)
def test_project_agrees_with_colmap(model: str) -> None:
    oracle = pycolmap.Camera(model=model, width=1200, height=900, params=PARAMS[model])
    points = np.random.default_rng(0).uniform([-2, -2, 3], [2, 2, 9], (200, 3))
    np.testing.assert_allclose(project(camera_of(model), points), np.array(oracle.img_from_cam(points)), rtol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_undistort_inverts_distort(model: str, pixels: np.ndarray) -> None:
    # Newton stops at 1e-11 of normalised coordinates, which is 1e-8 px here.
    back = distort(camera_of(model), undistort(camera_of(model), pixels))
    np.testing.assert_allclose(back, pixels, atol=1e-7)


def test_pixel_beyond_the_fold_of_the_polynomial_has_no_ray() -> None:
    camera = Camera("SIMPLE_RADIAL", 1200, 900, np.array([900.0, 600.0, 450.0, -0.5]))
    # x (1 − x²/2) is at most 0.544, at x = 0.816: no ray lands 600 px (0.667) from the centre.
    rays = undistort(camera, [[600.0, 450.0], [1000.0, 450.0], [1200.0, 450.0]])
    assert np.isfinite(rays[:2]).all()
    assert rays[1, 0] < 0.816
    assert np.isnan(rays[2]).all()


def test_point_behind_the_camera_has_no_pixel() -> None:
    pixels = project(camera_of("OPENCV"), [[0.1, 0.2, -3.0], [0.1, 0.2, 3.0]])
    assert np.isnan(pixels[0]).all()
    assert np.isfinite(pixels[1]).all()


def test_unknown_model_and_wrong_parameter_count_are_named() -> None:
    with refused("camera-model-unknown", InputError) as error:
        undistort(Camera("THIN_PRISM", 10, 10, np.ones(4)), [[1.0, 2.0]])
    assert "THIN_PRISM" in str(error.value)
    with refused("camera-parameters", InputError) as error:
        undistort(Camera("OPENCV", 10, 10, np.ones(4)), [[1.0, 2.0]])
    assert numbers(str(error.value)) == [8, 4]
    with refused("focal-length", InputError):
        project(Camera("SIMPLE_PINHOLE", 10, 10, np.array([0.0, 5.0, 5.0])), [[1.0, 2.0, 3.0]])


def test_pinhole_shows_a_point_where_its_ray_leaves() -> None:
    camera, random = Pinhole(1200, 900, 900.0, 905.0, 610.0, 455.0), np.random.default_rng(0)
    xy = random.uniform([-300, -300], [1500, 1200], (200, 2))
    in_cam = camera.rays(xy) * random.uniform(0.1, 1e4, (200, 1))
    np.testing.assert_allclose(camera.project(in_cam), xy, atol=1e-9)
    within = (xy[:, 0] >= 0) & (xy[:, 0] < 1200) & (xy[:, 1] >= 0) & (xy[:, 1] < 900)
    assert 0 < within.sum() < 200
    np.testing.assert_array_equal(camera.contains(xy), within)
    # The image ends where the next pixel would begin.
    np.testing.assert_array_equal(
        camera.contains([[0, 0], [1200, 0], [0, 900], [-1e-9, 0]]), [True, False, False, False]
    )
    behind = camera.project(-in_cam)
    assert np.isnan(behind).all()
    assert not camera.contains(behind).any()
