"""The test views in stage `evaluate`: figures, renders, and the cases without figures."""

from __future__ import annotations

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.core.products import load_json, save_json
from pipelines.core.runner import Outcome, run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MODEL
from pipelines.core.workspace import Workspace
from pipelines.report.plots.charts import band_height_px
from pipelines.splat.gaussians import read_gaussians, write_gaussians
from pipelines.survey.photographs import render_name
from pipelines.survey.solution import TrainedModel
from tests.reports import report_of
from tests.splat_scenes import TEST_VIEWS

pytestmark = pytest.mark.usefixtures("one_thread")
EVALUATE = BY_NAME["evaluate"]


def test_test_views_are_those_held_out(evaluated: tuple[Workspace, Outcome]) -> None:
    workspace, outcome = evaluated
    test = report_of(workspace)["photometric"]["test"]
    assert test["views"] == 2
    assert [row["image"] for row in test["per_view"]] == [f"image_{index:03d}.jpg" for index in TEST_VIEWS]
    assert test["psnr"] == pytest.approx(np.mean([row["psnr"] for row in test["per_view"]]))
    assert 30.0 < test["psnr"] < 60.0  # the Gaussians are the true ones, the cameras nearly
    assert 0.5 < test["ssim"] < 1.0
    # The orbit looks at one place from all sides: its training views show all ground of the others.
    assert test["covered_share"] == pytest.approx(np.mean([row["covered_share"] for row in test["per_view"]]))
    assert test["covered_share"] > 0.5
    assert abs(test["psnr_covered"] - test["psnr"]) < 3
    assert test["lpips"] is None
    assert "weights" in test["lpips_reason"]
    assert outcome.manifest.values["psnr"] == test["psnr"]
    assert f"test PSNR {test['psnr']:.2f} dB" in outcome.manifest.key_figure


def test_renders_stand_beside_the_photographs(evaluated: tuple[Workspace, Outcome]) -> None:
    workspace, _ = evaluated
    renders = sorted((workspace.root / "evaluate" / "renders").iterdir())
    assert [path.name for path in renders] == ["image_003.png"]
    strip = cv2.imread(str(renders[0]))
    band = band_height_px(96)
    assert strip.shape == (72 + band, 3 * 96, 3)
    assert [int((part < 128).any()) for part in np.split(strip[:band], 3, axis=1)] == [1, 1, 1]  # labels
    strip = strip[band:]
    photo = cv2.imread(str(workspace.root / "photos" / "image_003.jpg"))
    np.testing.assert_array_equal(strip[:, :96], photo)
    shown = np.abs(photo.astype(float) - strip[:, 96:192])
    np.testing.assert_allclose(strip[:, 192:], np.minimum(3 * shown, 255), atol=4)


def test_equal_images_are_reported_at_the_cap(altered: Workspace) -> None:
    """An empty model against black photographs: PSNR has no limit, JSON no infinity."""
    model = load_json(TrainedModel, altered.path(MODEL))
    save_json(model.model_copy(update={"background": (0.0, 0.0, 0.0)}), altered.root / MODEL)
    gaussians = read_gaussians(altered.path(GAUSSIANS))
    write_gaussians(
        altered.root / GAUSSIANS, replace(gaussians, logit_opacities=0 * gaussians.logit_opacities - 20)
    )
    shutil.rmtree(altered.root / "photos")
    (altered.root / "photos").mkdir()
    for camera in model.cameras:
        black = cv2.imencode(".png", np.zeros((72, 96, 3), dtype=np.uint8))[1]
        (altered.root / "photos" / camera.name).write_bytes(black.tobytes())
    run_stage(altered, EVALUATE, {"renders": 0})
    test = report_of(altered)["photometric"]["test"]
    assert (test["psnr"], test["psnr_compensated"], test["ssim"]) == (100.0, 100.0, 1.0)


def test_a_test_view_is_compared_at_the_exposure_of_its_tie_points(altered: Workspace) -> None:
    """Photographs at 0.7 of the light, as their exposures in the model say: the same figures but for 8 bits."""
    run_stage(altered, EVALUATE, {"renders": 0})
    before = report_of(altered)["photometric"]["test"]
    model, gain = load_json(TrainedModel, altered.path(MODEL)), 0.7
    for camera in model.cameras:
        path = altered.root / "photos" / camera.name
        dark = cv2.imencode(".png", np.rint(gain * cv2.imread(str(path))))[1]
        path.write_bytes(dark.tobytes())
    told, found = {"known": tuple(map(tuple, (gain * np.eye(3, 4)).tolist())), "unknown": None}, {}
    for name, exposure in told.items():
        cameras = tuple(camera.model_copy(update={"exposure": exposure}) for camera in model.cameras)
        save_json(model.model_copy(update={"cameras": cameras}), altered.root / MODEL)
        run_stage(altered, EVALUATE, {"renders": 0})
        found[name] = report_of(altered)["photometric"]["test"]
    # Errors of 0.7 of the light are 3.1 dB smaller.
    assert found["known"]["psnr"] == pytest.approx(before["psnr"] - 20 * np.log10(gain), abs=1.0)
    assert found["unknown"]["psnr"] < before["psnr"] - 5


def test_without_test_views_there_are_no_figures(altered: Workspace) -> None:
    model = load_json(TrainedModel, altered.path(MODEL))
    cameras = tuple(camera.model_copy(update={"split": "train"}) for camera in model.cameras)
    save_json(model.model_copy(update={"cameras": cameras}), altered.root / MODEL)
    outcome = run_stage(altered, EVALUATE, {})
    test = report_of(altered)["photometric"]["test"]
    assert (test["views"], test["psnr"], test["ssim"], test["lpips"]) == (0, None, None, None)
    assert "no test views" in outcome.manifest.key_figure


def test_images_of_one_name_in_two_folders_have_renders_of_their_own() -> None:
    assert render_name("day 1/DJI_0001.JPG") == "day 1_DJI_0001.png"
    assert len({render_name(f"{folder}/DJI_0001.JPG") for folder in ("a", "b", "a/b")}) == 3
