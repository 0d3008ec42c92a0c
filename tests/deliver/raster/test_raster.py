"""Rasters of a model whose surface is known exactly: level ground with a chequerboard, and a tower on it.

The Gaussians are laid on the surface by hand, so that all errors are those of the export.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
import torch
from rio_cogeo.cogeo import cog_validate

from pipelines.adjust.geolocate import geolocate
from pipelines.adjust.options import GeolocateOptions
from pipelines.core.errors import InputError
from pipelines.core.products import load_json, save_json, save_npz
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MODEL, POINTS
from pipelines.core.workspace import Workspace
from pipelines.deliver.raster_mosaic import INTERPOLATED, MEASURED
from pipelines.formats.georef_sidecar import CrsSidecar, sidecar_path
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.cameras import Camera, Pinhole
from pipelines.geometry.rotations import exp_so3, matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.splat.gaussians import Gaussians, transformed, write_gaussians
from pipelines.splat.rasterizer.api import RasterSettings, Render
from pipelines.splat.rasterizer.cpu import CpuRasterizer
from pipelines.splat.sh import sh_from_rgb
from pipelines.surface.measured_area import area_of
from pipelines.survey.navigation import load_survey
from pipelines.survey.options import FilledAreaOptions
from pipelines.survey.solution import SolvedCamera, TrainedModel, read_sfm, read_solution
from tests.refusals import codes, refused
from tests.scenes import (
    Measured,
    Noise,
    TrueScene,
    looking_at,
    sparse_model,
    survey_of,
    trained_model,
    write_workspace,
)
from tests.trained_workspaces import load_adjustment, write_adjustment

CAMERA = Camera("PINHOLE", 192, 144, np.array([220.0, 220.0, 96.0, 72.0]))
GEO_FROM_MODEL = Similarity(1.7, exp_so3(np.array([0.3, -0.2, 1.0])), np.array([12.0, -7.0, 4.0]))
TOWER_M, TOWER_HEIGHT_M = 3.0, 9.0  # half width
SQUARE_M = 4.0
GSD = 0.15  # about a pixel of the cameras
UTM = "EPSG:32632"


def surface_gaussians(scatter_m: float = 0.002) -> Gaussians:
    """Return flat, opaque Gaussians in `geo` on ground, roof and walls; `scatter_m` is the σ of their heights."""
    step, sigma = SQUARE_M / 27, 0.08  # borders of squares lie in the middle between Gaussians
    grid = np.arange(-4 * SQUARE_M + step / 2, 4 * SQUARE_M, step)
    east, north = (axis.ravel() for axis in np.meshgrid(grid, grid))
    on_roof = (np.abs(east) < TOWER_M) & (np.abs(north) < TOWER_M)
    # Blending goes by height. On perfectly level ground the Earth's curvature would decide which of two lies above.
    rough = np.random.default_rng(2).normal(0, scatter_m, east.shape)
    level = np.column_stack([east, north, np.where(on_roof, TOWER_HEIGHT_M, 0.0) + rough])
    dark = (np.floor(east / SQUARE_M) + np.floor(north / SQUARE_M)) % 2 == 0
    colour = np.where(on_roof[:, None], [0.8, 0.2, 0.1], np.where(dark[:, None], 0.15, 0.85))
    along = np.arange(-TOWER_M + step / 2, TOWER_M, step)
    height = np.arange(step / 2, TOWER_HEIGHT_M, step)
    a, h = (axis.ravel() for axis in np.meshgrid(along, height))
    walls, wall_scales = [], []
    for sign in (-1, 1):
        walls += [np.column_stack([np.full_like(a, sign * TOWER_M), a, h])]
        wall_scales += [np.tile([0.01, sigma, sigma], (len(a), 1))]
        walls += [np.column_stack([a, np.full_like(a, sign * TOWER_M), h])]
        wall_scales += [np.tile([sigma, 0.01, sigma], (len(a), 1))]
    means = np.concatenate([level, *walls])
    scales = np.concatenate([np.tile([sigma, sigma, 0.01], (len(level), 1)), *wall_scales])
    colour = np.concatenate([colour, np.tile([0.1, 0.2, 0.9], (len(means) - len(level), 1))])
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
        torch.from_numpy(np.log(scales)).float(),
        torch.full((len(means),), 4.0),
        sh_from_rgb(torch.from_numpy(colour)).float()[:, None],
    )


def flown_scene(rng: np.random.Generator) -> TrueScene:
    center = np.array([[e, n, 30.0] for e in (-9, -3, 3, 9) for n in (-9, -3, 3, 9)], dtype=float)
    points = np.column_stack([rng.uniform(-15, 15, (500, 2)), np.zeros(500)])
    return TrueScene(
        center,
        looking_at(center, center * [0.7, 0.7, 0] + [0.0, 1e-3, 0.0]),
        points,
        np.zeros((0, 3)),
        camera=CAMERA,
        geo_from_local=GEO_FROM_MODEL,
    )


def write_trained(root: Path, scatter_m: float = 0.002) -> Workspace:
    """Return a workspace with the model, as `train` would leave it."""
    rng = np.random.default_rng(0)
    scene, gaussians = flown_scene(rng), surface_gaussians(scatter_m)
    noise = Noise(pixel_px=0.2)
    survey, sparse = survey_of(scene, noise, Measured(), rng), sparse_model(scene, noise, rng)
    workspace = write_workspace(root, survey, sparse)
    cameras = tuple(
        SolvedCamera(
            name=name,
            split="train",
            quat_xyzw=tuple(quat_xyzw_from_matrix(rotation).tolist()),
            translation=tuple(translation.tolist()),
        )
        for name, rotation, translation in zip(
            sparse.image_name, sparse.rotation_cam_from_local, sparse.translation_cam_from_local, strict=True
        )
    )
    save_npz(root / POINTS, vars(geolocate(survey, sparse, GeolocateOptions()).points))
    save_json(trained_model(GEO_FROM_MODEL, max_image_size=192, cameras=cameras), root / MODEL)
    write_gaussians(root / GAUSSIANS, transformed(gaussians, GEO_FROM_MODEL.inverse()))
    write_adjustment(workspace)
    _write_photographs(root, scene, gaussians)
    return workspace


def seen_by(scene: TrueScene, camera: int, gaussians: Gaussians) -> Render:
    pose, rotation = np.eye(4), scene.geo_from_cam[camera]
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ scene.center_in_geo[camera]
    pinhole, settings = (
        Pinhole(CAMERA.width, CAMERA.height, *CAMERA.params),
        RasterSettings(sh_degree=0, depth=True),
    )
    with torch.no_grad():
        return CpuRasterizer().render(gaussians, torch.from_numpy(pose).float(), pinhole, settings)


def _write_photographs(folder: Path, scene: TrueScene, gaussians: Gaussians) -> None:
    """Render every view: cells that the photographs do not confirm do not count."""
    for camera, name in enumerate(scene.names):
        view = seen_by(scene, camera, gaussians)
        rgb = (255 * view.colour.clamp(0, 1)).round().byte().numpy()
        # The names end in .jpg, whose losses would be noise: the content is PNG, which OpenCV goes by.
        (folder / name).write_bytes(cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    made = write_trained(tmp_path_factory.mktemp("raster") / "ws")
    options = {"contours": 1.0, "contours_of": "surface", "colours": "splat", "fill": "all"}
    run_stage(made, BY_NAME["export-raster"], {"crs": UTM, "gsd": GSD, **options})
    return made


def in_utm(points_in_geo: np.ndarray, workspace: Workspace) -> np.ndarray:
    """Return points (N, 3) in UTM, by pyproj alone."""
    from pipelines.survey.navigation import load_survey

    lat, lon, height = lla_from_enu(points_in_geo, load_survey(workspace).origin).T
    east, north = pyproj.Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(lon, lat)
    return np.column_stack([east, north, height])


def at(path: Path, xyz: np.ndarray, band: int = 1) -> np.ndarray:
    """Return the values of the cells at places."""
    with rasterio.open(path) as raster:
        return np.array([value[band - 1] for value in raster.sample(xyz[:, :2])], dtype=np.float64)


def test_heights_are_those_of_ground_and_roof(workspace: Workspace) -> None:
    """To a tenth of a cell: the Gaussians lie on the surface, and only blending and the grid err."""
    rng = np.random.default_rng(1)
    ground = rng.uniform(-9, 9, (300, 3)) * [1, 1, 0]
    ground = ground[np.abs(ground[:, :2]).max(axis=1) > TOWER_M + 0.5]
    roof = rng.uniform(-1, 1, (100, 3)) * [TOWER_M - 0.4, TOWER_M - 0.4, 0] + [0, 0, TOWER_HEIGHT_M]
    for points in (ground, roof):
        xyz = in_utm(points, workspace)
        off = at(workspace.path("raster/dsm.tif"), xyz) - xyz[:, 2]
        assert np.sqrt(np.mean(off**2)) < 0.1 * GSD


def test_level_ground_lies_where_the_cameras_see_it(tmp_path: Path) -> None:
    """Gaussians of a training scatter about the surface, and the upper ones hide the lower: the surface is what the
    cameras see of them. Shrunken ones alone would be 0.2 cells lower.
    """
    scatter_m = 0.05
    scattered = write_trained(tmp_path / "ws", scatter_m)
    run_stage(scattered, BY_NAME["export-raster"], {"crs": UTM, "gsd": GSD, "colours": "splat", "fill": "all"})
    scene, off = flown_scene(np.random.default_rng(0)), []
    gaussians = surface_gaussians(scatter_m)
    fx, fy, cx, cy = CAMERA.params[:4]
    for camera in range(len(scene.names)):
        depth = seen_by(scene, camera, gaussians).expected_depth
        assert depth is not None
        row, column = np.mgrid[20 : CAMERA.height - 20 : 8, 20 : CAMERA.width - 20 : 8].reshape(2, -1)
        ray = np.column_stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(len(row))])
        place = (
            scene.center_in_geo[camera] + (ray * depth.numpy()[row, column, None]) @ scene.geo_from_cam[camera].T
        )
        place = place[(np.abs(place[:, :2]).max(axis=1) < 9) & (np.abs(place[:, :2]).max(axis=1) > TOWER_M + 1)]
        xyz = in_utm(place, scattered)
        off += (at(scattered.path("raster/dsm.tif"), xyz) - xyz[:, 2])[place[:, 2] < 1].tolist()
    assert len(off) > 1000
    assert abs(np.nanmedian(off)) < 0.05 * GSD


def test_roof_ends_at_its_edges(workspace: Workspace) -> None:
    """Profiles across the tower pass half its height within a cell of its walls; Gaussians reach over them."""
    along = np.linspace(-0.7, 0.7, 15) * TOWER_M
    across = np.arange(TOWER_M - 1.0, TOWER_M + 1.0, GSD / 8)
    off = []
    for axis in (0, 1):
        for sign in (-1, 1):
            places = np.zeros((len(along), len(across), 3))
            places[..., axis], places[..., 1 - axis] = sign * across, along[:, None]
            xyz = in_utm(places.reshape(-1, 3), workspace)
            above = at(workspace.path("raster/dsm.tif"), xyz) - xyz[:, 2]
            high = above.reshape(len(along), len(across)) > TOWER_HEIGHT_M / 2
            off += (across[0] + high.sum(axis=1) * GSD / 8 - TOWER_M).tolist()
    assert np.median(np.abs(off)) <= GSD  # 1.3 cells without shrinking them


def test_walls_do_not_lean(workspace: Workspace) -> None:
    """Roof and foot of a wall lie at the same place: a cell beyond it is ground, a cell within it roof."""
    beside = np.linspace(-TOWER_M + 0.5, TOWER_M - 0.5, 12)
    for side in (-1.0, 1.0):
        for axis in (0, 1):
            edge = np.zeros((len(beside), 3))
            edge[:, axis], edge[:, 1 - axis] = side * TOWER_M, beside
            outwards = np.zeros(3)
            outwards[axis] = side
            for step, height in ((2.5 * GSD, 0.0), (-1.5 * GSD, TOWER_HEIGHT_M)):
                xyz = in_utm(edge + step * outwards, workspace)
                off = at(workspace.path("raster/dsm.tif"), xyz) - (xyz[:, 2] + height)
                assert np.median(np.abs(off)) < 0.2
                red = at(workspace.path("raster/orthophoto.tif"), xyz, band=1)
                blue = at(workspace.path("raster/orthophoto.tif"), xyz, band=3)
                # Red over blue is the roof; the wall would be blue over red, the ground is grey.
                assert np.median(red - blue) > 60 if height else abs(np.median(red - blue)) < 40


def test_chequerboard_corners_are_at_their_surveyed_places(workspace: Workspace) -> None:
    """To half a cell: where the four squares around a corner balance, found by the saddle of the grey values."""
    corners = np.array([[e, n, 0.0] for e in (-8, -4, 0, 8, 4) for n in (-8, 8)], dtype=float)
    with rasterio.open(workspace.path("raster/orthophoto.tif")) as raster:
        grey, inverse = raster.read(1).astype(np.float64), ~raster.transform
    for place in in_utm(corners, workspace):
        column, row = inverse * (place[0], place[1])
        found = _saddle(grey, column, row)
        assert np.hypot(found[0] - column, found[1] - row) < 0.5


def _saddle(grey: np.ndarray, column: float, row: float, reach: int = 6) -> tuple[float, float]:
    """Return the saddle of a quadratic that is fitted to the smoothed grey values around a place."""
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(grey, 2.0)
    x0, y0 = int(column), int(row)
    y, x = np.mgrid[y0 - reach : y0 + reach + 1, x0 - reach : x0 + reach + 1]
    u, v = (x + 0.5 - column).ravel(), (y + 0.5 - row).ravel()
    design = np.stack([u * u, u * v, v * v, u, v, np.ones_like(u)], axis=1)
    a, b, c, d, e, _ = np.linalg.lstsq(design, smooth[y, x].ravel(), rcond=None)[0]
    du, dv = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e])
    return column + du, row + dv


def test_rasters_are_valid_and_say_where_they_are(workspace: Workspace) -> None:
    for name in ("orthophoto", "dsm", "dtm", "sigma_h", "sigma_v", "sigma_dtm", "measured"):
        path = workspace.path(f"raster/{name}.tif")
        valid, errors, warnings = cog_validate(path)
        assert (valid, errors, warnings) == (True, [], [])
        sidecar = load_json(CrsSidecar, sidecar_path(path))
        with rasterio.open(path) as raster:
            assert raster.crs.to_epsg() == 32632
            assert raster.tags()["GEOREF_VERTICAL_DATUM"] == sidecar.vertical_datum.name == "ellipsoidal"
            assert float(raster.tags()["GEOREF_MEDIAN_CELL_SIGMA_V_M"]) == pytest.approx(
                sidecar.sigma.median_sigma_v_m, abs=1e-4
            )


@pytest.mark.parametrize(("height", "sigma"), [("dsm", "sigma_v"), ("dtm", "sigma_dtm")])
def test_a_sidecar_states_the_heights_and_sigma_of_its_own_raster(
    workspace: Workspace, height: str, sigma: str
) -> None:
    """Under the tower the terrain is bridged: it has no cell as high as the tower, and larger σ."""
    values = {}
    for name in (height, sigma):
        with rasterio.open(workspace.path(f"raster/{name}.tif")) as raster:
            values[name] = raster.read(1)[np.isfinite(raster.read(1))]
    for name in (height, sigma):
        sidecar = load_json(CrsSidecar, sidecar_path(workspace.path(f"raster/{name}.tif")))
        assert sidecar.sigma is not None
        assert sidecar.sigma.largest_sigma_v_m == pytest.approx(float(values[sigma].max()), rel=0.02)
        assert sidecar.sigma.median_sigma_v_m == pytest.approx(float(np.median(values[sigma])), rel=0.02)
        assert sidecar.bounds[1][2] == pytest.approx(float(values[height].max()), abs=0.05)


def test_sigma_is_that_of_georeference_and_surface(workspace: Workspace) -> None:
    """On a surface without noise it is the σ that is predicted for the place."""
    grid = load_adjustment(workspace).grid
    assert grid is not None
    points = np.array([[-8.0, 6, 0], [0, 10, 0], [7, -7, 0]])
    expected, xyz = np.sqrt(np.diagonal(grid.cov_at(points), axis1=1, axis2=2)), in_utm(points, workspace)
    horizontal, vertical = (at(workspace.path(f"raster/{name}.tif"), xyz) for name in ("sigma_h", "sigma_v"))
    np.testing.assert_allclose(vertical, expected[:, 2], rtol=0.03)
    np.testing.assert_allclose(horizontal, np.hypot(expected[:, 0], expected[:, 1]), rtol=0.1)


def test_rasters_are_whole_inside_the_area_and_empty_outside(workspace: Workspace) -> None:
    import pyogrio
    import shapely

    with rasterio.open(workspace.path("raster/measured.tif")) as raster:
        mask, cell_m2 = raster.read(1), raster.transform.a**2
    with rasterio.open(workspace.path("raster/dsm.tif")) as raster:
        known = raster.read_masks(1) > 0
    with rasterio.open(workspace.path("raster/orthophoto.tif")) as raster:
        np.testing.assert_array_equal(raster.read(4) > 0, known)
    np.testing.assert_array_equal(mask > 0, known)
    solution, survey = read_solution(workspace), load_survey(workspace)
    sfm = read_sfm(workspace, solution)
    area = area_of(FilledAreaOptions(fill="all"), workspace, solution, sfm, survey)
    assert known.sum() * cell_m2 == pytest.approx(1e4 * area.hectares, rel=0.01)
    # Corners lie beyond the images of all but two cameras, and most of what three see is measured.
    assert known.mean() < 0.95
    assert (mask == MEASURED).sum() > 0.9 * known.sum()
    # The walls' feet: a part, in WGS84, for what is interpolated, to the cells that its outline is drawn of.
    _, _, shapes, (area_m2,) = pyogrio.raw.read(workspace.path("raster/interpolated.geojson"))
    assert area_m2.sum() == pytest.approx((mask == INTERPOLATED).sum() * cell_m2, rel=0.02)
    east, north = pyproj.Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(
        *shapely.get_coordinates(shapely.from_wkb(shapes)).T
    )
    with rasterio.open(workspace.path("raster/measured.tif")) as raster:
        assert (east >= raster.bounds.left - 1e-3).all()
        assert (north <= raster.bounds.top + 1e-3).all()


def test_terrain_runs_under_the_tower(workspace: Workspace) -> None:
    """Open ground to a tenth of a cell, as the surface; under the tower, to its σ, which says so."""
    rng = np.random.default_rng(3)
    places = rng.uniform(-9, 9, (400, 3)) * [1, 1, 0]
    beside = np.abs(places[:, :2]).max(axis=1)
    for chosen, limit in ((beside > TOWER_M + 1.0, 0.1 * GSD), (beside < TOWER_M, 0.15)):
        xyz = in_utm(places[chosen], workspace)
        off = at(workspace.path("raster/dtm.tif"), xyz) - xyz[:, 2]
        sigma = at(workspace.path("raster/sigma_dtm.tif"), xyz)
        assert np.sqrt(np.mean(off**2)) < limit
        assert np.sqrt(np.mean((off / sigma) ** 2)) < 1.4
    assert sigma.min() > 0.1


def test_contours_of_the_terrain_leave_the_tower_out(workspace: Workspace, tmp_path: Path) -> None:
    import pyogrio

    copy = Workspace(shutil.copytree(workspace.root, tmp_path / "ws"))
    outcome = run_stage(copy, BY_NAME["export-raster"], {"crs": UTM, "gsd": GSD, "contours": 1.0})
    base = in_utm(np.zeros((1, 3)), copy)[0, 2]
    _, _, shapes, (height, _) = pyogrio.raw.read(copy.path("raster/contours.gpkg"))
    assert len(shapes) == outcome.manifest.values["contour_lines"]
    assert (np.abs(height - base) < 1.0).all()


def test_without_the_library_there_is_no_terrain(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Workspace(shutil.copytree(workspace.root, tmp_path / "ws"))
    monkeypatch.setitem(sys.modules, "CSF", None)
    outcome = run_stage(copy, BY_NAME["export-raster"], {"crs": UTM, "gsd": 0.3})
    assert codes(outcome.manifest.warnings) == ["no-terrain"]
    assert not (copy.root / "raster/dtm.tif").exists()
    assert run_stage(copy, BY_NAME["export-raster"], {"gsd": 0.3, "terrain": False}).manifest.warnings == ()


def test_contours_run_around_the_tower(workspace: Workspace) -> None:
    import pyogrio

    fields, _, _, (height, _) = pyogrio.raw.read(workspace.path("raster/contours.gpkg"))
    assert fields["crs"] == UTM
    base = in_utm(np.zeros((1, 3)), workspace)[0, 2]
    assert ((height > base - 0.5) & (height < base + TOWER_HEIGHT_M + 0.5)).all()
    assert len(set(height)) >= TOWER_HEIGHT_M - 1
    assert workspace.path("raster/contours.dxf").stat().st_size > 1000


@pytest.mark.parametrize(
    ("flags", "code"),
    [
        ({"crs": "EPSG:4326"}, "gsd-in-degrees"),
        ({"crs": "EPSG:4326", "gsd": 0.05}, "gsd-too-large"),
        ({"crs": "EPSG:4978", "gsd": 0.05}, "crs-geocentric"),
        ({"crs": "EPSG:999999"}, "crs-unknown"),
        ({"gsd": 1e-5}, "too-many-cells"),
        ({"crs": "EPSG:2056+3855"}, "grid-not-installed"),
    ],
    ids=["degrees", "metres", "geocentric", "unknown", "cells", "grid"],
)
def test_bad_requests_are_refused(workspace: Workspace, flags: dict[str, object], code: str) -> None:
    with refused(code, InputError):
        run_stage(workspace, BY_NAME["export-raster"], flags)
    assert workspace.path("raster/dsm.tif").exists()


def test_a_disk_that_is_too_small_is_said_before_the_work(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type(shutil.disk_usage(workspace.root))(2**40, 2**40, 100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: usage)
    with refused("disk-space", InputError) as error:
        run_stage(workspace, BY_NAME["export-raster"], {"gsd": 0.3})
    assert "--gsd" in str(error.value)
    assert not (workspace.root / "raster.partial/parts").exists()


WAVE_M = 1.0  # of a texture that the splat does not have: seven pixels of the photographs


def texture(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return 25.0 * np.sin(2 * np.pi * east / WAVE_M) * np.sin(2 * np.pi * north / WAVE_M)


@pytest.fixture(scope="module")
def textured(workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The same survey: its photographs show a fine texture of the ground, each at its own exposure."""
    root = tmp_path_factory.mktemp("textured") / "ws"
    shutil.copytree(workspace.root, root, ignore=shutil.ignore_patterns("raster", "cache", "logs", ".lock*"))
    made = Workspace(root)
    model = load_json(TrainedModel, made.path(MODEL))
    cameras = []
    u, v = np.meshgrid(np.arange(CAMERA.width) + 0.5, np.arange(CAMERA.height) + 0.5)
    fx, fy, cx, cy = CAMERA.params
    for number, camera in enumerate(model.cameras):
        rotation = GEO_FROM_MODEL.rotation @ matrix_from_quat_xyzw(camera.quat_xyzw).T
        in_model = -matrix_from_quat_xyzw(camera.quat_xyzw).T @ np.array(camera.translation)
        center = GEO_FROM_MODEL.apply(in_model[None])[0]
        ray = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1) @ rotation.T
        ground = center[:2] + ray[..., :2] * (-center[2] / ray[..., 2:])
        picture = cv2.imread(str(root / camera.name)).astype(np.float64)
        gain = 1.0 + 0.15 * (-1) ** number
        picture = gain * (0.8 * picture + 25 + texture(ground[..., 0], ground[..., 1])[..., None])
        data = cv2.imencode(".png", np.clip(picture, 0, 255).round().astype(np.uint8))[1].tobytes()
        (root / camera.name).write_bytes(data)
        exposure = tuple(tuple(gain * float(row == column) for column in range(4)) for row in range(3))
        cameras.append(camera.model_copy(update={"exposure": exposure}))
    save_json(model.model_copy(update={"cameras": tuple(cameras)}), root / MODEL)
    # The model lacks the texture: the photographs confirm little of it.
    run_stage(
        made, BY_NAME["export-raster"], {"crs": UTM, "gsd": GSD, "source": True, "terrain": False, "fill": "all"}
    )
    return made


def test_orthophoto_is_that_of_the_photographs(textured: Workspace) -> None:
    """Detail that only the photographs have, at their contrast, and no step where the photograph changes."""
    with rasterio.open(textured.root / "raster/orthophoto.tif") as raster:
        colour, alpha = raster.read(1).astype(np.float64), raster.read(4)
        row, column = np.mgrid[: raster.height, : raster.width]
        east, north = raster.xy(row.ravel(), column.ravel())
    place = np.column_stack([np.reshape(east, -1), np.reshape(north, -1)])
    origin = in_utm(np.zeros((1, 3)), textured)[0]
    # Some metres from the origin, the axes of UTM and of `geo` differ by the convergence alone.
    turn = in_utm(np.array([[0.0, 10.0, 0.0]]), textured)[0] - origin
    angle = np.arctan2(turn[0], turn[1])
    shifted = (place - origin[:2]) @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    shifted = shifted / np.hypot(*turn[:2]) * 10.0
    expected = texture(shifted[:, 0], shifted[:, 1]).reshape(colour.shape)
    within = (np.abs(shifted) < 3.2 * SQUARE_M).all(axis=1).reshape(colour.shape)
    within &= (np.abs(shifted) > 2.5 * TOWER_M).any(axis=1).reshape(colour.shape) & (alpha == 255)
    detail = colour - cv2.boxFilter(colour, -1, (13, 13))
    # Inside of one square of the chequerboard, whose edges are detail too.
    away = np.abs(shifted / SQUARE_M - np.round(shifted / SQUARE_M)).min(axis=1).reshape(colour.shape) * SQUARE_M
    inner = within & (away > 7 * GSD)
    assert inner.sum() > 2000
    # The photographs' pixels are about as large as the cells: interpolation takes some of the contrast.
    assert np.corrcoef(detail[inner], expected[inner])[0, 1] > 0.9
    assert 0.6 < detail[inner].std() / expected[inner].std() < 1.1

    with rasterio.open(textured.root / "raster/source.tif") as raster:
        source = raster.read(1)
    names = json.loads((textured.root / "raster/source.json").read_text())
    assert len(np.unique(source[inner])) > 4 and source.max() < len(names) and names[0] == ""
    # 15 % of gain either way is a step of 30 grey levels and more, if it is not undone.
    broad = cv2.boxFilter(colour, -1, (5, 5))
    step = np.abs(np.diff(broad, axis=1))
    changes = (np.diff(source.astype(int), axis=1) != 0) & inner[:, 1:] & inner[:, :-1]
    same = ~changes & inner[:, 1:] & inner[:, :-1]
    assert changes.sum() > 50
    assert np.median(step[changes]) < np.median(step[same]) + 1.0


def test_holes_are_filled_up_to_a_width(workspace: Workspace) -> None:
    """Nothing beyond the measured surface is painted; --fill all, and a boundary, ask for more."""
    shares = {}
    for fill in (0.0, None, "all"):
        options = {"crs": UTM, "gsd": GSD, "terrain": False, "hillshade": False, "fill": fill}
        outcome = run_stage(workspace, BY_NAME["export-raster"], options)
        values = outcome.manifest.values
        shares[fill] = (values["measured"], values["interpolated"], values["delivered_ha"])
    assert shares[0.0][1] <= shares[None][1] <= shares["all"][1]
    assert shares[None][1] <= 0.1 + 1e-6
    assert shares[None][0] + shares[None][1] == pytest.approx(1.0, abs=0.01)
    assert shares[0.0][2] <= shares[None][2] <= shares["all"][2]


def test_rasters_end_where_their_own_cells_are_measured(workspace: Workspace) -> None:
    """Cells that fewer views than asked for show lie in the area of the other products, and are not painted."""
    options = {"crs": UTM, "gsd": GSD, "terrain": False, "hillshade": False, "min_views": 6}
    values = run_stage(workspace, BY_NAME["export-raster"], options).manifest.values
    assert values["delivered_ha"] < 0.9 * values["area_ha"]
    # A tenth of the outline's cells, whose border is drawn to a quarter of a cell.
    assert values["interpolated"] < 0.11
    assert values["measured"] > 0.89
