"""What people look at, on a simulated town: the orthophoto's detail and seams, and an opaque splat.

Cameras are the true ones, so that no SfM takes its time. Training is real; each photograph has its own exposure.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME
from pipelines.core.workspace import Workspace
from pipelines.geometry.cameras import Camera
from pipelines.simulate.lens import Sensor
from pipelines.simulate.mesh import Raycaster
from pipelines.simulate.options import SimulateOptions
from pipelines.simulate.stage import RecordedFlight, fly_survey
from tests.scenes import Measured, Noise, TrueScene, sparse_model, survey_of, write_workspace
from tests.scripts import REPOSITORY, load_script
from tests.splat_scenes import adjust_workspace

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

OPTIONS = {"images": 14, "size": "320x240", "samples": "4", "lens": "pinhole", "seed": 4, "targets": 0}
NOISE = Noise(fix_m=(0.02, 0.02, 0.03), pixel_px=0.2, mark_px=0.1, gcp_m=1e-3)
TEST_VIEWS = (4, 11)
REACH_M = 30.0  # of points around the middle of the scene


def town(rng: np.random.Generator) -> tuple[TrueScene, RecordedFlight, np.ndarray]:
    """Return a town's cameras, tie points and points on level ground, the flight, and who sees each tie point."""
    flight = fly_survey(SimulateOptions.model_validate(OPTIONS))
    lens, poses, caster = flight.world.lens, flight.world.poses, flight.renderer.raycaster
    center, rotation = (np.array([getattr(pose, name) for pose in poses]) for name in ("center", "geo_from_cam"))
    pixel = rng.uniform((0, 0), (lens.width, lens.height), (600, 2))
    hits = []
    for place, turned in zip(center, rotation, strict=True):
        direction = lens.directions(pixel) @ turned.T
        distance = caster.exact_distance(place, direction, caster.first_hits(place, direction))
        hits.append(place + distance[:, None] * direction)
    point = np.concatenate(hits)
    point = point[np.isfinite(point).all(axis=1) & (np.abs(point[:, :2]) < 2 * REACH_M).all(axis=1)]
    seen = np.array([_shown(caster, place, point) for place in center]).T
    around = rng.uniform(-REACH_M, REACH_M, (400, 2))
    ground = np.column_stack([around, _heights(caster, around)])
    corners = [_heights(caster, around + side) for side in ((-4, -4), (-4, 4), (4, -4), (4, 4), (0, 4), (4, 0))]
    level = (np.abs(np.array(corners) - ground[:, 2]) < 0.3).all(axis=0)
    params = np.array([lens.focal_px, *lens.center_px])
    camera = Camera("SIMPLE_PINHOLE", lens.width, lens.height, params)
    kept = seen.sum(axis=1) >= 3
    scene = TrueScene(center, rotation, point[kept], ground[level][:16], camera=camera)
    return scene, flight, seen[kept]


def _heights(caster: Raycaster, plan: np.ndarray) -> np.ndarray:
    down = np.tile([0.0, 0.0, -1.0], (len(plan), 1))
    above = np.column_stack([plan, np.full(len(plan), 200.0)])
    return 200.0 - caster.first_hits(above, down).distance.astype(np.float64)


def _shown(caster: Raycaster, center: np.ndarray, point: np.ndarray) -> np.ndarray:
    arm = point - center
    length = np.linalg.norm(arm, axis=1)
    found = caster.first_hits(center, arm / length[:, None]).distance
    return np.abs(found - length) < 0.2


@pytest.fixture(scope="module")
def delivered(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The town trained and delivered as raster and PLY."""
    root, rng = tmp_path_factory.mktemp("town") / "ws", np.random.default_rng(7)
    scene, flight, seen = town(rng)
    survey, sparse = survey_of(scene, NOISE, Measured(gcps=True), rng), sparse_model(scene, NOISE, rng)
    shown = seen[sparse.obs_point, sparse.obs_image]
    observed = {name: getattr(sparse, name)[shown] for name in ("obs_point", "obs_image", "obs_xy_px")}
    images = tuple(
        image.model_copy(update={"split": "test"}) if number in TEST_VIEWS else image
        for number, image in enumerate(survey.images)
    )
    check = {"check_points": survey.control_points, "control_points": ()}
    workspace = write_workspace(
        root, survey.model_copy(update={"images": images, **check}), replace(sparse, **observed)
    )
    for name, pose, gain in zip(scene.names, flight.world.poses, rng.normal(1.1, 0.09, len(images)), strict=True):
        photo = flight.renderer.photograph(pose, Sensor(float(gain), (1.0, 1.0, 1.0), 1.0, 0.0), rng)
        # The names end in .jpg, whose losses would be noise: the content is PNG, which OpenCV goes by.
        (root / name).write_bytes(cv2.imencode(".png", photo[..., ::-1])[1].tobytes())
    adjust_workspace(workspace)
    training = {"preset": "smoke", "iterations": 150, "max_gaussians": 12_000}
    for stage, options in (
        ("train", training),
        ("export-ply", {}),
        ("export-raster", {"source": True, "terrain": False, "fill": "all"}),
    ):
        run_stage(workspace, BY_NAME[stage], options)
    return workspace


def test_orthophoto_shows_what_the_photographs_show(delivered: Workspace) -> None:
    """Contrast and detail of squares of 4 m are those of the steepest photograph; seams are no steps."""
    pictures = load_script(REPOSITORY / "examples/benchmarks/pictures.py")
    found = pictures.patches(delivered)
    contrast, correlation = np.array([(patch.contrast, patch.correlation) for patch in found]).T
    assert len(found) >= 6
    assert np.median(contrast) > 0.9 and np.median(correlation) > 0.9
    # A lamp post or a tree may hide a place from the steepest photograph.
    assert (contrast > 0.9).mean() > 0.75
    seams = pictures.seams(delivered)
    assert seams.cells > 500
    assert seams.at < 1.1 * seams.beside


def test_splat_is_opaque(delivered: Workspace) -> None:
    """The exported PLY looks the same over white as over black."""
    pictures = load_script(REPOSITORY / "examples/benchmarks/pictures.py")
    found = pictures.opacity(delivered)
    assert found.white > found.black - 0.3
    assert found.alpha_1_percent > 0.95
