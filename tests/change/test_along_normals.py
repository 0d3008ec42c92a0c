"""Change along normals: a wall that moves, and ground that does not, from clouds with their covariances."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from pipelines.change.along_normals import FILE
from pipelines.change.options import ChangeOptions
from pipelines.change.stage import run
from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import CLOUD
from pipelines.core.workspace import StageRun, Workspace
from pipelines.formats.cloud_ply import CloudPoints
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.formats.geotiff import raster_frame
from pipelines.formats.las import LazWriter, read_surface
from pipelines.geodesy.crs import parse_crs
from pipelines.survey.change_report import Change
from tests.change_pairs import GROUND_M, town_pair
from tests.refusals import refused

NOISE_M, MOVED_M = 0.03, 0.25
HALF_M, WALL_M, PER_M2 = 20.0, 8.0, 60.0  # points in a square metre


def write_cloud(workspace: Workspace, rng: np.random.Generator, wall_m: float, *, per_m2: float = PER_M2) -> None:
    """Write level ground, and before it a wall that faces south, moved south by `wall_m`."""
    raster = workspace.root / "raster" / "dsm.tif"
    frame, sidecar = raster_frame(raster), load_json(CrsSidecar, sidecar_path(raster))
    middle = np.array([frame.west + frame.columns * frame.step_x / 2, frame.north - frame.rows * frame.step_y / 2])
    count = int(4 * HALF_M**2 * per_m2)
    ground = np.column_stack([rng.uniform(-HALF_M, HALF_M, (count, 2)), np.zeros(count)])
    count = int(2 * HALF_M * WALL_M * per_m2)
    wall = np.column_stack(
        [rng.uniform(-HALF_M, HALF_M, count), np.full(count, 5.0 - wall_m), rng.uniform(0.5, WALL_M, count)]
    )
    normal = np.repeat([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], [len(ground), len(wall)], axis=0)
    place = np.concatenate([ground, wall]) + rng.normal(0, NOISE_M, len(normal))[:, None] * normal
    place += [*middle, GROUND_M]
    across = NOISE_M * normal
    datum = np.diag([0.01, 0.01, 0.02]) ** 2
    cloud = CloudPoints(
        place,
        normal.astype(np.float32),
        np.zeros(normal.shape, np.uint8),
        (datum + across[:, :, None] * across[:, None]).astype(np.float32),
        np.ones(len(normal), np.uint8),
    )
    path = workspace.root / CLOUD
    path.parent.mkdir()
    wkt1 = parse_crs(sidecar.crs_wkt).wkt1
    with LazWriter(path, wkt1=wkt1, angular=False, near=[*middle, 0.0], software="test") as writer:
        writer.write(cloud)
    save_json(sidecar, sidecar_path(path))


@pytest.mark.slow
def test_a_wall_has_moved_and_the_ground_has_not(tmp_path: Path) -> None:
    before, after = town_pair(tmp_path, changed=False).workspaces
    rng = np.random.default_rng(2)
    options = ChangeOptions(before=before.root, stable_auto=True, along_normals=True)
    (out := tmp_path / "out").mkdir()
    with refused("missing-product", MissingProductError):
        run(StageRun(after, out), options)
    write_cloud(before, rng, 0.0)
    write_cloud(after, rng, MOVED_M)
    run(StageRun(after, out), options)
    found = laspy.read(out / FILE)
    distance, sigma, lod = (np.asarray(found[name]) for name in ("distance", "sigma", "lod"))
    level = np.asarray(found["nz"]) > 0.9
    facing = (np.asarray(found["ny"]) < -0.9) & np.isfinite(distance)
    assert level.sum() > 1000 and facing.sum() > 200
    np.testing.assert_allclose(lod, 1.96 * sigma, rtol=1e-3)
    # The median of means of thirty points.
    assert np.nanmedian(distance[facing]) == np.clip(np.nanmedian(distance[facing]), 0.24, 0.26)
    assert (found["significant"][facing] == 1).mean() > 0.95
    assert (found["significant"][level] == 1).mean() <= 0.05
    # Each surface's own σ stays, as its errors may be common to neighbours: never less than both together.
    assert np.nanmedian(sigma[facing]) >= np.hypot(NOISE_M, NOISE_M)
    figures = load_json(Change, out / "change.json").along_normals
    assert figures is not None and figures.points == len(distance)
    assert figures.measured == int(np.isfinite(distance).sum())


def test_clouds_without_sigma_or_of_another_crs_are_refused(tmp_path: Path) -> None:
    before, after = town_pair(tmp_path, changed=False).workspaces
    rng = np.random.default_rng(2)
    for workspace in (before, after):
        write_cloud(workspace, rng, 0.0, per_m2=2.0)  # refused before any of them is compared
    path = before.root / CLOUD
    (first, *_) = read_surface(path, 100)
    assert len(first) == 100 and np.isfinite(first.cov_m2).all()
    sidecar = load_json(CrsSidecar, sidecar_path(path))
    save_json(sidecar.model_copy(update={"crs_wkt": parse_crs("EPSG:32633").wkt}), sidecar_path(path))
    options = ChangeOptions(before=before.root, stable_auto=True, along_normals=True)
    (out := tmp_path / "out").mkdir()
    with refused("epochs-differ-in-crs", InputError):
        run(StageRun(after, out), options)
    save_json(sidecar, sidecar_path(path))
    cloud = laspy.read(path)
    cloud.remove_extra_dims(["cov_ee"])
    cloud.write(path)
    with refused("cloud-without-sigma", InputError):
        run(StageRun(after, out), options)
