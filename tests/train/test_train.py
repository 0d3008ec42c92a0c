"""Stage `train` on photographs that were rendered from known Gaussians, from the adjustment to its own."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import astuple, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.stats import chi2

from pipelines.adjust.options import InitSim3Options
from pipelines.core.errors import BackendUnavailableError, DegenerateGeometryError, MissingProductError
from pipelines.core.products import load_json, save_json
from pipelines.core.runner import run_stage
from pipelines.core.stages import (
    ADJUSTMENT,
    BY_NAME,
    GAUSSIANS,
    MODEL,
    SIM3_POSTERIOR,
    SPARSE,
    SURVEY,
    TRAIN_POSTERIOR,
)
from pipelines.core.workspace import Workspace
from pipelines.formats.colmap import read_sparse, write_sparse
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.rotations import log_so3, matrix_from_quat_xyzw
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, read_gaussians
from pipelines.splat.metrics import psnr
from pipelines.splat.rasterizer.api import RasterSettings
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.survey.solution import Solution, TrainedModel
from pipelines.survey.survey import Survey
from pipelines.train.options import PRESETS, RUN_MINUTES, Preset, TrainOptions
from tests.refusals import logged_codes, numbers, refused, said
from tests.scenes import GEO_FROM_LOCAL
from tests.splat_scenes import TRAINING, RenderedFlight, adjust_workspace, ground_height
from tests.threads import single_thread
from tests.trained_workspaces import load_adjustment

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
TRAIN = BY_NAME["train"]
SHORT = {"georeference": "joint", "iterations": 30, "sh_degree": 1, "log_every": 2, "checkpoint_every": 8}
Pairs = list[tuple[Workspace, Workspace]]
FAR = float(chi2.ppf(0.999, 7))


def metrics(workspace: Workspace, folder: str = "train") -> list[dict]:
    lines = (workspace.root / folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines]


def view_psnr(workspace: Workspace, flight: RenderedFlight, split: str) -> float:
    """Mean PSNR of the views of a split, as the trained cameras see them, against renders of the true scene."""
    model, gaussians = load_json(TrainedModel, workspace.path(MODEL)), read_gaussians(workspace.path(GAUSSIANS))
    scene = flight.rendered.scene
    size = scene.camera.width, scene.camera.height
    camera, own_camera = Pinhole(*size, *scene.camera.params), Pinhole(*size, *model.lenses[0].params)
    found = []
    for index, seen_by in enumerate(model.cameras):
        if seen_by.split == split:
            rotation, center = scene.geo_from_cam[index].T, scene.center_in_geo[index]
            truth = _render(flight.rendered.gaussians, rotation, -rotation @ center, camera)
            own = matrix_from_quat_xyzw(seen_by.quat_xyzw)
            found.append(psnr(_render(gaussians, own, np.array(seen_by.translation), own_camera), truth))
    return float(np.mean(found))


def _render(gaussians: Gaussians, rotation: np.ndarray, translation: np.ndarray, camera: Pinhole) -> torch.Tensor:
    pose = torch.eye(4)
    pose[:3, :3], pose[:3, 3] = torch.from_numpy(rotation).float(), torch.from_numpy(translation).float()
    with torch.no_grad():
        view = CpuRasterizer().render(gaussians, pose, camera, RasterSettings(sh_degree=0))
    return view.colour.clamp(0, 1)


def error_of(workspace: Workspace, product: str = MODEL) -> float:
    """Squared normalised error of the similarity of an adjustment."""
    model = load_json(TrainedModel if product == MODEL else Solution, workspace.path(product))
    record = model.geo_from_model
    away = GEO_FROM_LOCAL @ Similarity.from_record(model.model_from_local).inverse() @ model.similarity.inverse()
    pivot = np.array(record.pivot)
    error = np.array([np.log(away.scale), *log_so3(away.rotation), *(away.apply(pivot) - pivot)])
    return float(error @ np.linalg.solve(np.array(record.covariance), error))


def test_photographs_are_learned(trained: Pairs, flights: list[RenderedFlight]) -> None:
    rows = metrics(trained[0][0])
    assert [row["iteration"] for row in rows] == list(range(5, 151, 5))
    start, end = (np.mean([row["psnr"] for row in part]) for part in (rows[:2], rows[-4:]))
    assert end > start + 5.0
    # 800 Gaussians in place of 2 100, after 12 looks at each photograph.
    assert view_psnr(trained[0][0], flights[0], "train") > 23.0
    assert view_psnr(trained[0][0], flights[0], "test") > 22.0
    assert rows[-1]["geo_weight"] == pytest.approx(0.05, rel=1e-3)
    # χ² of the motion for each fix: within the σ of the solution.
    assert all(row["solution"] < 3.0 for row in rows)
    assert rows[-1]["solution"] > 0 and any(rows[-1][f"shift_{axis}"] for axis in "xyz")


def test_training_ends_near_the_adjustment_that_it_starts_from(trained: Pairs) -> None:
    for with_geo, _ in trained:
        start = load_json(Solution, with_geo.path(ADJUSTMENT))
        end = load_adjustment(with_geo)
        model = end.solution
        assert model.model_from_local.scale == pytest.approx(start.model_from_local.scale, rel=1e-12)
        before, after = (np.sqrt(np.diag(each.geo_from_model.covariance)) for each in (start, model))
        np.testing.assert_allclose(after, before, rtol=0.1)
        moved = model.similarity.apply(model.poses.cam_center_in_model) - start.similarity.apply(
            start.poses.cam_center_in_model
        )
        assert 1e-6 < np.abs(moved).max() < 0.3  # the photographs know the cameras better than SfM's points do
        assert error_of(with_geo) < FAR
        assert error_of(with_geo, ADJUSTMENT) < FAR
        assert end.camera_cov.shape == (14, 6, 6)
        assert {each.kind for each in model.measurements} == {"fix", "systematic error"}


def test_without_geographic_losses_the_adjustment_is_kept(trained: Pairs) -> None:
    for _, without in trained:
        assert_kept(without)


def assert_kept(workspace: Workspace) -> None:
    start = load_json(Solution, workspace.path(ADJUSTMENT))
    model = load_json(TrainedModel, workspace.path(MODEL))
    kept = model.model_dump(include=set(Solution.model_fields) - {"cameras"})
    assert kept == start.model_dump(exclude={"cameras"})
    np.testing.assert_array_equal(model.poses.cam_center_in_model, start.poses.cam_center_in_model)
    assert workspace.path(TRAIN_POSTERIOR).read_bytes() == workspace.path(SIM3_POSTERIOR).read_bytes()


class Signalling:
    """A progress that calls `act` when training has come to an iteration."""

    def __init__(self, at: int, act: Callable[[], None]) -> None:
        self.at, self.act, self.seen = at, act, 0

    @contextmanager
    def task(self, name: str, total: int | None = None) -> Iterator[Signalling]:
        self.seen = 0 if name == "training" else -10_000
        yield self

    def advance(self, steps: int = 1, note: str = "", left_s: float | None = None) -> None:
        self.seen += steps
        if self.seen == self.at:
            self.act()


class KilledError(Exception):
    """Stands for the end of the process."""


def kill() -> None:
    raise KilledError


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="module")
def uninterrupted(flights: list[RenderedFlight]) -> Workspace:
    workspace = flights[0].workspace("uninterrupted")
    with single_thread():  # as the runs that it is compared with: sums of many threads differ in the last bit
        run_stage(workspace, TRAIN, SHORT)
    return workspace


@pytest.mark.parametrize(
    ("act", "raised", "saved"),
    [(interrupt, KeyboardInterrupt, 20), (kill, KilledError, 16)],
    ids=["SIGINT", "SIGKILL"],
)
def test_resumed_run_ends_as_an_uninterrupted_one(
    act: Callable[[], None], raised: type, saved: int, uninterrupted: Workspace, flights: list
) -> None:
    workspace = flights[0].workspace(raised.__name__)
    with pytest.raises(raised):
        run_stage(workspace, TRAIN, SHORT, progress=Signalling(20, act))
    with np.load(workspace.root / "train.partial" / "checkpoint.npz") as checkpoint:
        assert checkpoint["iteration"] == saved
    assert not (workspace.root / MODEL).exists()
    assert metrics(workspace, "train.partial")[-1]["iteration"] == 20
    outcome = run_stage(workspace, TRAIN, SHORT, resume="always")
    assert outcome.ran
    # The CPU rasteriser gives the same result on every run: equal to the last bit.
    assert workspace.path(GAUSSIANS).read_bytes() == uninterrupted.path(GAUSSIANS).read_bytes()
    assert workspace.path(MODEL).read_bytes() == uninterrupted.path(MODEL).read_bytes()
    rows, expected = metrics(workspace), metrics(uninterrupted)
    assert [row["iteration"] for row in rows] == list(range(2, 31, 2))
    assert [{**row, "seconds": 0} for row in rows] == [{**row, "seconds": 0} for row in expected]
    assert [row["seconds"] for row in rows] == sorted(row["seconds"] for row in rows)


def test_damaged_checkpoint_is_told_and_training_starts_afresh(
    flights: list[RenderedFlight], caplog: pytest.LogCaptureFixture
) -> None:
    workspace = flights[0].workspace("damaged")
    with pytest.raises(KilledError):
        run_stage(workspace, TRAIN, SHORT, progress=Signalling(10, kill))
    checkpoint = workspace.root / "train.partial" / "checkpoint.npz"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    assert run_stage(workspace, TRAIN, SHORT, resume="always").ran
    assert "interrupted-run-damaged" in logged_codes(caplog)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_without_gpu_is_refused(flights: list[RenderedFlight]) -> None:
    with pytest.raises(BackendUnavailableError, match=r"cuda|CUDA|GPU"):
        run_stage(flights[0].workspace("cuda"), TRAIN, {**SHORT, "backend": "cuda"})


def test_wrong_fix_is_named_and_moves_nothing(flights: list[RenderedFlight]) -> None:
    workspace = flights[0].workspace("outlier")
    survey = load_json(Survey, workspace.path(SURVEY))
    images = list(survey.images)
    fix = images[5].fix
    assert fix is not None
    east, north, up = fix.position_in_geo
    wrong = fix.model_copy(update={"position_in_geo": (east + 9.0, north - 12.0, up)})
    images[5] = images[5].model_copy(update={"fix": wrong})
    save_json(survey.model_copy(update={"images": tuple(images)}), workspace.root / SURVEY)
    adjust_workspace(workspace)
    outcome = run_stage(workspace, TRAIN, {**TRAINING, "iterations": 100})
    assert outcome.manifest.values["gnss_outliers"] == [images[5].name]
    assert error_of(workspace) < FAR
    (rejected,) = [each for each in load_json(TrainedModel, workspace.path(MODEL)).measurements if not each.used]
    assert (rejected.kind, rejected.name) == ("fix", images[5].name)


def test_cameras_can_be_frozen(flights: list[RenderedFlight]) -> None:
    workspace = flights[0].workspace("frozen")
    run_stage(workspace, TRAIN, {**SHORT, "iterations": 4, "georeference": "frozen"})
    assert_kept(workspace)


def test_surface_is_that_of_the_adjusted_cameras(flights: list[RenderedFlight]) -> None:
    """SfM's model is bent as by a wrong lens, to 1.2 m at 20 m; the adjustment is not, and so no product may be."""
    workspace = flights[0].workspace("bent")
    sparse = read_sparse(workspace.path(SPARSE))
    geo = GEO_FROM_LOCAL.apply(sparse.point_in_local)
    geo[:, 2] += 1.2 * (geo[:, :2] ** 2).sum(axis=1) / 20.0**2
    cameras = {
        key: replace(lens, params=lens.params * [1.02, 1.02, 1.0, 1.0]) for key, lens in sparse.cameras.items()
    }
    bent = replace(sparse, point_in_local=GEO_FROM_LOCAL.inverse().apply(geo), cameras=cameras)
    write_sparse(bent, workspace.path(SPARSE))
    run_stage(workspace, TRAIN, {"iterations": 100, "sh_degree": 0})
    model = load_json(TrainedModel, workspace.path(MODEL))
    place = model.similarity.apply(read_gaussians(workspace.path(GAUSSIANS)).means.double().numpy())
    off_m, distance_m = place[:, 2] - ground_height(place[:, 0], place[:, 1]), np.linalg.norm(place[:, :2], axis=1)
    # A quarter of a pixel is 0.25 m of height.
    assert abs(np.median(off_m[distance_m < 10])) < 0.25
    assert abs(np.median(off_m[(distance_m > 17) & (distance_m < 23)])) < 0.25


def test_a_workspace_without_adjustment_is_told_which_stage_makes_it(flights: list[RenderedFlight]) -> None:
    workspace = flights[0].workspace("earlier")
    for product in (ADJUSTMENT, SIM3_POSTERIOR):
        workspace.path(product).unlink()
    with pytest.raises(MissingProductError, match="georef init-sim3"):
        run_stage(workspace, TRAIN, SHORT)


def test_lens_follows_the_cameras_and_is_told(trained: Pairs, flights: list[RenderedFlight]) -> None:
    model = load_json(TrainedModel, trained[0][0].path(MODEL))
    (lens,) = model.lenses
    camera = flights[0].rendered.sparse.cameras[lens.camera_id]
    moved = np.array(lens.params) - camera.params
    assert lens.model == camera.model
    # SfM's is the true one here, which fixes of 5 cm from 45 m away confirm to some thousandths of 90 px.
    assert 1e-6 < np.abs(moved).max() < 1.0


def test_two_cameras_are_needed(flights: list[RenderedFlight]) -> None:
    workspace = flights[0].workspace("test_only")
    survey = load_json(Survey, workspace.path(SURVEY))
    images = tuple(image.model_copy(update={"split": "test"}) for image in survey.images)
    save_json(survey.model_copy(update={"images": images}), workspace.root / SURVEY)
    with refused("too-few-training-images", DegenerateGeometryError):
        run_stage(workspace, TRAIN, SHORT)


BIAS_M = (1.5, -1.0, 3.0)
EVERYTHING = {**SHORT, "gcp_mode": "depth"}


def with_control(workspace: Workspace, offset_m: tuple[float, float, float] = BIAS_M) -> Workspace:
    """The workspace with the surveyed places as control points, and all positions off by as much."""
    survey, images = load_json(Survey, workspace.path(SURVEY)), []
    for image in survey.images:
        assert image.fix is not None
        place = tuple(a + b for a, b in zip(image.fix.position_in_geo, offset_m, strict=True))
        images.append(image.model_copy(update={"fix": image.fix.model_copy(update={"position_in_geo": place})}))
    estimate = ("boresight", "lever-arm")
    update = {
        "images": tuple(images),
        "control_points": survey.check_points,
        "check_points": (),
        "estimate": estimate,
    }
    save_json(survey.model_copy(update=update), workspace.root / SURVEY)
    adjust_workspace(workspace, InitSim3Options(accept_inconsistency=True))
    return workspace


def test_evident_bias_is_estimated_and_told(flights: list[RenderedFlight]) -> None:
    workspace = with_control(flights[0].workspace("biased"))
    outcome = run_stage(workspace, TRAIN, {**TRAINING, "iterations": 120})
    model = load_json(TrainedModel, workspace.path(MODEL))
    (bias,) = [error for error in model.estimated_errors if error.name == "bias"]
    assert (bias.session, bias.unit) == (0, "m")
    assert (np.abs(np.array(bias.value) - BIAS_M) < 4 * np.array(bias.sigma) + 0.02).all()
    assert error_of(workspace) < FAR
    assert 1.0 <= numbers(said(outcome.manifest.cautions, "fixes-shifted"))[0] < 2.0
    assert "bias" in {error["name"] for error in outcome.manifest.values["estimated_errors"]}
    assert outcome.manifest.values["control_outliers"] == []


def test_every_option_together_trains_and_resumes(flights: list[RenderedFlight]) -> None:
    whole, broken = (with_control(flights[0].workspace(name)) for name in ("whole", "broken"))
    run_stage(whole, TRAIN, EVERYTHING)
    with pytest.raises(KilledError):
        run_stage(broken, TRAIN, EVERYTHING, progress=Signalling(20, kill))
    run_stage(broken, TRAIN, EVERYTHING, resume="always")
    assert broken.path(MODEL).read_bytes() == whole.path(MODEL).read_bytes()
    errors = {error.name: error for error in load_json(TrainedModel, whole.path(MODEL)).estimated_errors}
    assert set(errors) == {"bias", "lever-arm", "boresight"}
    assert errors["boresight"].unit == "deg"
    for row in metrics(whole):
        assert {"solution", "relative"} <= set(row)
        assert all(isinstance(value, int | float) for value in row.values())  # as the report's curves ask for
    assert any("control_by_depth" in row for row in metrics(whole))


def test_constant_schedule_starts_at_the_full_weight(flights: list[RenderedFlight]) -> None:
    workspace = flights[0].workspace("constant")
    run_stage(workspace, TRAIN, {**SHORT, "iterations": 4, "geo_schedule": "constant"})
    assert [row["geo_weight"] for row in metrics(workspace)] == [0.05, 0.05]


def test_presets_can_be_changed_in_part() -> None:
    assert TrainOptions(preset="fast").effort == PRESETS["fast"]
    changed = TrainOptions(preset="smoke", iterations=7, max_image_size=64).effort
    assert changed == replace(PRESETS["smoke"], iterations=7, max_image_size=64)
    assert PRESETS["high"] == Preset(2_000, 2_000, 300_000)


def test_each_preset_asks_for_more_than_the_one_before() -> None:
    efforts, minutes = [astuple(preset) for preset in PRESETS.values()], list(RUN_MINUTES.values())
    assert all(less < more for before, after in pairwise(efforts) for less, more in zip(before, after, strict=True))
    assert minutes == sorted(minutes)
