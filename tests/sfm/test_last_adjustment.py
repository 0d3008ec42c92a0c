"""The adjustment that ends a reconstruction finds the principal point, and is not drawn by wrong observations."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from pipelines.formats.colmap import quiet_colmap
from pipelines.geometry.similarity import umeyama
from pipelines.sfm import adjustment
from pipelines.sfm.adjustment import adjust_finally
from tests.refusals import logged_codes

pytestmark = pytest.mark.usefixtures("one_thread")

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT = 1024, 768
CENTER = np.array([WIDTH / 2, HEIGHT / 2])
OFF_PX = (6.0, -4.0)
FOCAL_PX = 1280.0


def true_model(off_px: tuple[float, float] = OFF_PX, images: int = 12) -> Any:
    """300 points that all images see, through a lens whose principal point is off the image's centre."""
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, images, 300
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [FOCAL_PX, *(CENTER + off_px), -0.05]
    return pycolmap.synthesize_dataset(options)


def disturb(model: Any, noise_px: float, wrong: float = 0.0, seed: int = 0) -> None:
    """Noise on all observations, and a share of wrong ones in the right half of the images.

    Those are off by 2–3 px, below COLMAP's filter, and all to the right, which looks like another focal length.
    """
    rng = np.random.default_rng(seed)
    for image in model.images.values():
        for point in image.points2D:
            shift = rng.normal(0.0, noise_px, 2) if noise_px else np.zeros(2)
            if rng.random() < wrong and point.xy[0] > WIDTH / 2:
                shift[0] += rng.uniform(2.0, 3.0)
            point.xy = point.xy + shift


def as_mapped(model: Any) -> Any:
    """What the mapper leaves: all is adjusted by least squares but the principal point, which is at the centre."""
    params = model.cameras[1].params
    params[1:3] = CENTER
    model.cameras[1].params = params
    return least_squares(model, principal_point=False)


def mapped(off_px: tuple[float, float], noise_px: float = 0.5, images: int = 12) -> Any:
    model = true_model(off_px, images)
    disturb(model, noise_px)
    return as_mapped(model)


def least_squares(model: Any, *, principal_point: bool) -> Any:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = principal_point
    with quiet_colmap():
        pycolmap.bundle_adjustment(model, options)
    return model


def adjust(model: Any, *, principal_point: bool = True) -> Any:
    with quiet_colmap() as colmap:
        adjust_finally(colmap, model, principal_point=principal_point, threads=1)
    return model


def poses(model: Any) -> np.ndarray:
    return np.array([model.images[key].cam_from_world().matrix() for key in sorted(model.images)])


def centers(model: Any) -> np.ndarray:
    return np.array([model.images[key].projection_center() for key in sorted(model.images)])


def rms_off(model: Any, truth: Any) -> float:
    """RMS distance of the cameras from the true ones, laid on them by a similarity."""
    laid = umeyama(centers(model), centers(truth)).apply(centers(model))
    return float(np.sqrt(((laid - centers(truth)) ** 2).sum(axis=1).mean()))


def mean_point_error_px(model: Any) -> float:
    errors = []
    for point in model.points3D.values():
        seen = [model.images[each.image_id] for each in point.track.elements]
        pixels = [
            image.points2D[each.point2D_idx].xy for image, each in zip(seen, point.track.elements, strict=True)
        ]
        ends = zip(seen, pixels, strict=True)
        errors.append(np.mean([np.linalg.norm(image.project_point(point.xyz) - xy) for image, xy in ends]))
    return float(np.mean(errors))


# Of 3600 observations to 0.5 px: repeated with other noise, either coordinate scatters by 0.8 px; 3 σ of that.
@pytest.mark.parametrize(("noise_px", "bound_px"), [(0.0, 1e-3), (0.5, 2.4)])
def test_principal_point_is_found(noise_px: float, bound_px: float) -> None:
    model = mapped(OFF_PX, noise_px)
    before_px = model.compute_mean_reprojection_error()
    adjust(model)
    np.testing.assert_allclose(model.cameras[1].params[1:3] - CENTER, OFF_PX, atol=bound_px)
    assert model.compute_mean_reprojection_error() < before_px


def test_exact_without_noise() -> None:
    truth = true_model()
    model = adjust(mapped(OFF_PX, noise_px=0.0))
    np.testing.assert_allclose(model.cameras[1].params, truth.cameras[1].params, rtol=1e-5, atol=1e-5)
    assert rms_off(model, truth) < 1e-5  # of a scene ten units wide


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_wrong_observations_do_not_draw_lens_and_poses(seed: int) -> None:
    truth, model = true_model(), true_model()
    disturb(model, noise_px=0.1, wrong=0.06, seed=seed)
    as_mapped(model)
    plain = least_squares(pycolmap.Reconstruction(model), principal_point=True)
    adjust(model)
    # From 24 draws of the noise alone: the focal length scatters by 0.12 px, the principal point by 0.16 px in
    # either coordinate, the cameras' RMS by 0.5e-4 about 2.9e-4. 3 σ of those, as if nothing were wrong.
    lens_bound_px, cameras_bound = np.array([0.36, 0.48, 0.48]), 4.4e-4
    assert (np.abs(model.cameras[1].params - truth.cameras[1].params)[:3] < lens_bound_px).all()
    assert rms_off(model, truth) < cameras_bound
    # Least squares takes the same observations for another lens and other poses.
    assert (np.abs(plain.cameras[1].params - truth.cameras[1].params)[:3] > lens_bound_px).any()
    assert rms_off(plain, truth) > 2 * cameras_bound


def test_stated_errors_are_those_of_the_adjusted_model() -> None:
    model = adjust(mapped(OFF_PX))
    assert model.compute_mean_reprojection_error() == pytest.approx(mean_point_error_px(model), rel=1e-9)


def test_point_far_from_the_middle_is_refused(caplog: pytest.LogCaptureFixture) -> None:
    model = mapped((80.0, 0.0))  # more than 5 % of 1024 px
    frozen = adjust(pycolmap.Reconstruction(model), principal_point=False)
    with caplog.at_level(logging.WARNING):
        adjust(model)
    assert logged_codes(caplog) == ["principal-point-not-determined"]
    np.testing.assert_array_equal(model.cameras[1].params[1:3], CENTER)
    # All else is adjusted again, and comes to the minimum that it reaches with the principal point frozen. They end
    # a fraction of σ from their minimum, for which the scatter of the focal length, 0.6 px, is the measure.
    np.testing.assert_allclose(model.cameras[1].params, frozen.cameras[1].params, atol=0.1)
    np.testing.assert_allclose(poses(model), poses(frozen), atol=1e-3)


@pytest.mark.parametrize(("images", "principal_point"), [(9, True), (12, False)])
def test_principal_point_is_frozen_for_few_images_and_on_demand(images: int, principal_point: bool) -> None:
    truth, model = true_model((0.0, 0.0), images), true_model((0.0, 0.0), images)
    disturb(model, noise_px=0.1, wrong=0.06)
    as_mapped(model)
    before = rms_off(model, truth)
    adjust(model, principal_point=principal_point)
    np.testing.assert_array_equal(model.cameras[1].params[1:3], CENTER)
    assert rms_off(model, truth) < before / 2  # the robust rounds run all the same


class Bars:
    """Progress that counts: total and steps of the tasks."""

    def __init__(self) -> None:
        self.total, self.steps = 0, 0

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[Bars]:
        self.total += total or 0
        yield self

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self.steps += steps


def test_few_tracks_first_end_at_the_same_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    truth, model = true_model(), true_model()
    disturb(model, noise_px=0.3, wrong=0.06)
    as_mapped(model)
    few = pycolmap.Reconstruction(model)
    adjustment.keep_few_tracks(few, 60)
    # All images see each of the 300 points: 60 points are enough.
    assert (few.num_points3D(), model.num_points3D()) == (60, 300)
    at_once = adjust(pycolmap.Reconstruction(model))
    monkeypatch.setattr(adjustment, "_MANY_OBSERVATIONS", 1000)
    monkeypatch.setattr(adjustment, "_TRACKS_A_PHOTOGRAPH", 60)
    bars = Bars()
    with quiet_colmap() as colmap:
        adjust_finally(colmap, model, threads=1, progress=bars)
    assert bars.steps == bars.total == 8
    assert model.num_points3D() == 300
    # Both end a small part of σ from their minimum; the errors against the truth are the measure of σ.
    assert rms_off(model, at_once) < 0.1 * rms_off(at_once, truth)
    np.testing.assert_allclose(model.cameras[1].params, at_once.cameras[1].params, atol=0.1)
    assert model.compute_mean_reprojection_error() == pytest.approx(
        at_once.compute_mean_reprojection_error(), rel=1e-3
    )


@pytest.mark.parametrize("noise_px", [0.0, 0.5])  # without noise the scale has settled after one round
def test_progress_comes_to_its_end(noise_px: float) -> None:
    bars, model = Bars(), mapped(OFF_PX, noise_px)
    with quiet_colmap() as colmap:
        adjust_finally(colmap, model, threads=1, progress=bars)
    assert bars.steps == bars.total == 4
