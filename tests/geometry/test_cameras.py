"""Lens models against OpenCV's and formulas of their own, and their edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import (
    MODELS,
    Camera,
    Lenses,
    Pinhole,
    bearings,
    distort,
    parameter_names,
    parameters_in,
    project,
    undistort,
)
from tests.refusals import numbers, refused

pycolmap = pytest.importorskip("pycolmap")

FOCAL, CENTER = [500.0, 505.0], [610.0, 455.0]
PARAMS = {
    "SIMPLE_PINHOLE": [900.0, *CENTER],
    "PINHOLE": [900.0, 905.0, *CENTER],
    "SIMPLE_RADIAL": [900.0, *CENTER, -0.08],
    "RADIAL": [900.0, *CENTER, -0.08, 0.02],
    "OPENCV": [900.0, 905.0, *CENTER, -0.09, 0.03, 4e-4, -3e-4],
    "FULL_OPENCV": [900.0, 905.0, *CENTER, 0.2, -0.1, 4e-4, -3e-4, 0.02, 0.3, -0.1, 0.01],
    "SIMPLE_FISHEYE": [500.0, *CENTER],
    "FISHEYE": [*FOCAL, *CENTER],
    "SIMPLE_RADIAL_FISHEYE": [500.0, *CENTER, 0.02],
    "RADIAL_FISHEYE": [500.0, *CENTER, 0.02, -0.01],
    "OPENCV_FISHEYE": [*FOCAL, *CENTER, 0.02, -0.01, 0.004, -0.001],
    "THIN_PRISM_FISHEYE": [*FOCAL, *CENTER, 0.02, -0.01, 4e-4, -3e-4, 0.004, -0.001, 2e-4, 1e-4],
    "RAD_TAN_THIN_PRISM_FISHEYE": [
        *FOCAL,
        *CENTER,
        0.02,
        -0.01,
        4e-3,
        -1e-3,
        0.0,
        0.0,
        4e-4,
        -3e-4,
        2e-4,
        0,
        1e-4,
        0,
    ],
    "FOV": [*FOCAL, *CENTER, 0.6],
    "SIMPLE_DIVISION": [900.0, *CENTER, -0.05],
    "DIVISION": [900.0, 905.0, *CENTER, -0.05],
    "EUCM": [*FOCAL, *CENTER, 0.6, 1.1],
}


def camera_of(model: str) -> Camera:
    return Camera(model, 1200, 900, np.array(PARAMS[model]))


@pytest.fixture
def pixels() -> np.ndarray:
    grid = np.meshgrid(np.linspace(0.5, 1199.5, 25), np.linspace(0.5, 899.5, 19))
    return np.stack(grid, axis=-1).reshape(-1, 2)


def opencv_pixels(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Pixels of rays (N, 2) by OpenCV, of a model that is among its own."""
    fisheye = camera.model.endswith("FISHEYE")
    full = parameters_in(camera, "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV")
    assert full is not None
    matrix = np.array([[full[0], 0, full[2]], [0, full[1], full[3]], [0, 0, 1]])
    points, none = np.column_stack([rays, np.ones(len(rays))])[:, None], np.zeros(3)
    if fisheye:
        return cv2.fisheye.projectPoints(points, none, none, matrix, full[4:])[0][:, 0]
    return cv2.projectPoints(points, none, none, matrix, full[4:])[0][:, 0]


def other_pixels(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Pixels of rays (N, 2) by the published formula of a model that OpenCV has not."""
    fx, fy, cx, cy, *terms = PARAMS[camera.model]
    if camera.model == "SIMPLE_DIVISION":
        fx, cx, cy, *terms = PARAMS[camera.model]
        fy = fx
    x, y = rays.T
    r = np.hypot(x, y)
    if camera.model == "FOV":  # Devernay and Faugeras (2001)
        gain = np.arctan(2 * r * np.tan(terms[0] / 2)) / terms[0] / r
        u, v = x * gain, y * gain
    elif camera.model == "EUCM":  # Khomutenko, Garcia and Martinet (2016)
        alpha, beta = terms
        below = alpha * np.sqrt(beta * r * r + 1) + 1 - alpha
        u, v = x / below, y / below
    elif camera.model.endswith("DIVISION"):  # Fitzgibbon (2001): r = d / (1 + k d²)
        gain = 2 / (1 + np.sqrt(1 - 4 * terms[0] * r * r))
        u, v = x * gain, y * gain
    else:  # Weng, Cohen and Herniou (1992), on the angle
        k1, k2, p1, p2, k3, k4, sx, sy = terms
        theta = np.arctan(r)
        a, b, t = x * theta / r, y * theta / r, theta * theta
        radial = 1 + k1 * t + k2 * t**2 + k3 * t**3 + k4 * t**4
        u = a * radial + 2 * p1 * a * b + p2 * (t + 2 * a * a) + sx * t
        v = b * radial + 2 * p2 * a * b + p1 * (t + 2 * b * b) + sy * t
    return np.column_stack([fx * u + cx, fy * v + cy])


@pytest.mark.parametrize("model", [model for model in MODELS if not model.startswith("RAD_TAN")])
def test_pixels_are_those_of_opencv_or_of_the_published_formula(model: str) -> None:
    camera, rays = camera_of(model), np.random.default_rng(0).uniform([-0.6, -0.45], [0.6, 0.45], (200, 2))
    theirs = model in ("FOV", "EUCM", "SIMPLE_DIVISION", "DIVISION", "THIN_PRISM_FISHEYE")
    expected = other_pixels(camera, rays) if theirs else opencv_pixels(camera, rays)
    np.testing.assert_allclose(distort(camera, rays), expected, rtol=1e-12)


@pytest.mark.parametrize("model", MODELS)
def test_parameters_have_the_library_names(model: str) -> None:
    theirs = pycolmap.Camera(model=model, width=1200, height=900, params=PARAMS[model]).params_info
    assert parameter_names(camera_of(model)) == tuple(
        "k1" if name == "k" and "DIVISION" not in model else name for name in theirs.split(", ")
    )


def test_all_models_but_panoramas_are_known() -> None:
    assert set(MODELS) == set(pycolmap.CameraModelId.__members__) - {"INVALID", "EQUIRECTANGULAR"}


@pytest.mark.parametrize("model", MODELS)
def test_undistort_inverts_distort(model: str, pixels: np.ndarray) -> None:
    # COLMAP stops its iteration at 1e-10 of normalised coordinates or later, which is 1e-7 px here.
    back = distort(camera_of(model), undistort(camera_of(model), pixels))
    np.testing.assert_allclose(back, pixels, atol=1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_bearings_move_with_the_parameters_as_their_derivatives_say(model: str) -> None:
    camera = camera_of(model)
    lenses, xy = Lenses({1: camera}, np.array([1])), np.array([[100.0, 80.0], [640.0, 430.0], [1100.0, 850.0]])
    jacobian = lenses.bearing_jacobian(np.zeros(3, dtype=np.int64), xy)
    for index, value in enumerate(camera.params):
        change = np.zeros(len(camera.params))
        change[index] = 1e-4 * max(1.0, abs(value))
        ahead, behind = (bearings(lenses.moved(sign * change).cameras[1], xy) for sign in (1, -1))
        # The inverse of the lens is iterated to 1e-8, over a step of 1e-4 at least, whose curvature is left.
        np.testing.assert_allclose(
            jacobian[:, :, index], (ahead - behind) / (2 * change[index]), rtol=1e-3, atol=2e-4
        )


def test_pixel_at_90_degrees_from_the_axis_of_a_fisheye_has_no_ray() -> None:
    camera = Camera("OPENCV_FISHEYE", 1200, 900, np.array([300.0, 300.0, 600.0, 450.0, 0, 0, 0, 0]))
    # The radius is 300 px for each radian: 471 px at 90°.
    rays = undistort(camera, [[1069.0, 450.0], [1073.0, 450.0], [1190.0, 450.0]])
    assert rays[0, 0] == pytest.approx(np.tan(469 / 300), rel=1e-6)
    assert np.isnan(rays[1:]).all()


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
