"""A rolling shutter that nobody stated: found in the residuals of the bundle, said with its readout time."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.adjust.lens_cautions import focal_length_of, rolling_shutter_of
from pipelines.geometry.bundle import BundleInformation, bundle_information
from pipelines.geometry.network import Network
from pipelines.geometry.sparse_model import SparseModel
from tests.adjust.test_unmodelled_lens import CAMERA, PIXEL_PX, adjusted, block, field_of
from tests.scenes import WITH_GCPS, Noise, sparse_model, survey_of

READOUT_S, INTERVAL_S = 0.030, 6.0  # 3.7 m/s: the last row moves by about 1 px
TO_AND_FRO = "to and fro"


@cache
def model_of(kind: str) -> SparseModel:
    """Return the adjusted model of a flight whose rows are moved by its own velocity, or of another lens."""
    scene, rng = block(turns=False), np.random.default_rng(5)
    exact = sparse_model(scene, Noise(pixel_px=0.0), rng)
    pixels = exact.obs_xy_px.copy()
    if kind == TO_AND_FRO:
        travel = np.gradient(scene.center_in_geo, INTERVAL_S, axis=0)[exact.obs_image] * READOUT_S
        in_cam = np.einsum("mji,mj->mi", scene.geo_from_cam[exact.obs_image], travel)
        in_geo = scene.point_in_geo[exact.obs_point] - scene.center_in_geo[exact.obs_image]
        depth = np.einsum("mji,mj->mi", scene.geo_from_cam[exact.obs_image], in_geo)[:, 2]
        share = pixels[:, 1:] / CAMERA.height - 0.5
        pixels -= share * CAMERA.params[0] * in_cam[:, :2] / depth[:, None]
    elif kind != "none":
        pixels += field_of(kind, rng)(pixels, exact.obs_image)
    return adjusted(replace(exact, obs_xy_px=pixels + rng.normal(0, PIXEL_PX, pixels.shape)))


def bundle_of(model: SparseModel) -> BundleInformation:
    return bundle_information(
        Network(
            model.cameras,
            model.image_camera_id,
            model.rotation_cam_from_local,
            model.cam_center_in_local,
            model.point_in_local,
            model.obs_point,
            model.obs_image,
            model.obs_xy_px,
        )
    )


def remarks_of(kind: str, *, timed: bool) -> list[tuple[str, str]]:
    model, rng = model_of(kind), np.random.default_rng(1)
    survey = survey_of(block(turns=False), Noise(fix_m=(2.0, 2.0, 4.0)), WITH_GCPS, rng)
    seconds = INTERVAL_S * np.arange(len(survey.images))
    images = [
        image.model_copy(update={"timestamp_s": float(second) if timed else None})
        for image, second in zip(survey.images, seconds, strict=True)
    ]
    survey = survey.model_copy(update={"images": tuple(images)})
    found = rolling_shutter_of(survey, model, 1.0, bundle_of(model).row_motion)
    return [(remark.code, remark.text) for remark in found]


def test_the_readout_time_of_a_flight_to_and_fro_is_found() -> None:
    ((code, sentence),) = remarks_of(TO_AND_FRO, timed=True)
    assert code == "rolling-shutter-unstated"
    found_s = float(sentence.split("--rolling-shutter (")[1].split(")")[0])
    # A motion that all photographs share hides in the lens and in the scale along the lines.
    assert 0.7 * READOUT_S < found_s < 1.2 * READOUT_S


def test_without_times_the_way_of_the_flight_tells() -> None:
    ((code, _),) = remarks_of(TO_AND_FRO, timed=False)
    assert code == "rolling-shutter-unstated"


@pytest.mark.parametrize("kind", ["none", "thin prism", "k3", "drifting focus"])
def test_no_other_lens_is_taken_for_a_rolling_shutter(kind: str) -> None:
    assert remarks_of(kind, timed=True) == []


def test_rows_that_move_enlarge_the_covariance_of_the_poses() -> None:
    clean, moved = bundle_of(model_of("none")), bundle_of(model_of(TO_AND_FRO))
    assert clean.row_motion is None
    assert moved.row_motion is not None
    # The last row moves by F v T / (2 d): along the lines by about a pixel, across them where it turns only.
    across_px, along_px = moved.row_motion.sigma_px
    assert 0.5 < along_px < 1.5
    assert across_px < along_px
    assert np.trace(moved.sums.poses.toarray()) < np.trace(clean.sums.poses.toarray())


DIFFERS, APART = ["focal-length-differs"], ["focal-length-apart", "not-checked"]


@pytest.mark.parametrize(
    ("source", "factor", "codes"),
    [
        ("exif", 1.8, APART),
        ("option", 0.5, APART),
        ("exif", 1.3, DIFFERS),
        ("exif", 1 / 1.29, DIFFERS),
        ("calibrated", 0.8, DIFFERS),
        ("exif", 1.1, []),  # as rounded as a focal length in millimetres is
        ("exif", 0.9, []),
        ("assumed", 1.3, []),
        ("assumed", 1.8, []),
    ],
)
def test_a_focal_length_far_from_its_tags_is_said(source: str, factor: float, codes: list[str]) -> None:
    """A crop or another equivalent is a third off; half or twice is another lens, or a model that is bent."""
    model = model_of("none")
    survey = survey_of(block(turns=False), Noise(), WITH_GCPS, np.random.default_rng(0))
    (prior,) = survey.cameras
    params = (factor * prior.params[0], prior.width / 2, prior.height / 2)
    tags = {"model": "SIMPLE_PINHOLE", "params": params, "focal_source": source}
    survey = survey.model_copy(update={"cameras": (prior.model_copy(update=tags),)})
    found = focal_length_of(survey, model)
    assert [remark.code for remark in found] == codes
    solved_px = model.camera_of(0).mean_focal_px
    for remark in found[:1]:
        assert f"{params[0]:.0f} px" in remark.sentence and f"{solved_px:.0f} px" in remark.sentence
        assert f"{100 * (solved_px / params[0] - 1):+.0f} %" in remark.sentence
