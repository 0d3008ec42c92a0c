"""The last adjustment of `sfm`: it finds the principal point that the mapper left at the image's centre."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from pipelines.formats.colmap import quiet_colmap
from pipelines.sfm import adjust_with_principal_point

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 1024, 768
CENTER = np.array([WIDTH / 2, HEIGHT / 2])


def mapped(off_px: tuple[float, float], noise_px: float = 0.5, images: int = 12) -> Any:
    """What the mapper leaves of a camera whose principal point is off the image's centre: all adjusted but that."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, images, 300
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [1280.0, *(CENTER + off_px), -0.05]
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = noise_px
    pycolmap.synthesize_noise(noise, model)
    params = model.cameras[1].params
    params[1:3] = CENTER
    model.cameras[1].params = params
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    with quiet_colmap():
        pycolmap.bundle_adjustment(model, adjustment)
    return model


def adjust(model: Any) -> None:
    with quiet_colmap() as colmap:
        adjust_with_principal_point(colmap, model)


def poses(model: Any) -> np.ndarray:
    return np.array([model.images[key].cam_from_world().matrix() for key in sorted(model.images)])


# Of 3600 observations to 0.5 px: repeated with other noise, either coordinate scatters by 0.6 px; 3 σ of that.
@pytest.mark.parametrize(("noise_px", "bound_px"), [(0.0, 1e-3), (0.5, 1.8)])
def test_principal_point_is_found(noise_px: float, bound_px: float) -> None:
    model = mapped((6.0, -4.0), noise_px)
    before_px = model.compute_mean_reprojection_error()
    adjust(model)
    np.testing.assert_allclose(model.cameras[1].params[1:3] - CENTER, [6.0, -4.0], atol=bound_px)
    assert model.compute_mean_reprojection_error() < before_px


def test_point_far_from_the_middle_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    model = mapped((80.0, 0.0))  # more than 5 % of 1024 px
    params, before = model.cameras[1].params.copy(), poses(model)
    with caplog.at_level(logging.WARNING):
        adjust(model)
    assert "principal point of camera 1 is not determined and stays where it was" in caplog.text
    np.testing.assert_array_equal(model.cameras[1].params[1:3], CENTER)
    # All else is adjusted again, and comes back to the minimum that it was in.
    np.testing.assert_allclose(model.cameras[1].params, params, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(poses(model), before, atol=1e-6)


def test_few_images_are_left_as_they_are() -> None:
    model = mapped((6.0, -4.0), images=9)
    params, before = model.cameras[1].params.copy(), poses(model)
    adjust(model)
    np.testing.assert_array_equal(model.cameras[1].params, params)
    np.testing.assert_array_equal(poses(model), before)
