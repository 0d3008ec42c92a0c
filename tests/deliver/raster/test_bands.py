"""Bands of a rig of four lenses over level ground, whose reflectance is known in each band.

Photographs are rays through each lens onto a smooth pattern; counts are what DJI's constants make of its
reflectance. The solution differs from SfM as adjustments do: its focal length and flying height are 1 % larger,
which the photographs of level ground do not tell apart.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyproj
import pytest
import rasterio
import torch

from pipelines.core.errors import InputError
from pipelines.core.products import Remark, load_json, save_json
from pipelines.core.progress import SILENT
from pipelines.core.runner import run_stage
from pipelines.core.stages import BY_NAME, GAUSSIANS, MODEL, RIG_MODEL, SURVEY
from pipelines.core.workspace import Workspace
from pipelines.deliver.bands import BandPictures, band_pictures
from pipelines.formats.colmap import write_sparse
from pipelines.geodesy.enu import lla_from_enu
from pipelines.geometry.cameras import Camera, undistort
from pipelines.geometry.rotations import exp_so3, quat_xyzw_from_matrix
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, transformed, write_gaussians
from pipelines.splat.sh import sh_from_rgb
from pipelines.survey.navigation import load_survey
from pipelines.survey.solution import SolvedCamera, SolvedLens, read_sfm, read_trained
from pipelines.survey.survey import Companion, Original, Survey
from tests.band_photographs import band_tiff, dji_band, exposed, polynomial
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
from tests.trained_workspaces import write_adjustment

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 192, 144
LENSES = (
    Camera("PINHOLE", WIDTH, HEIGHT, np.array([220.0, 220.0, 96.0, 72.0])),
    Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([223.0, 95.0, 73.0, -0.05])),
    Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([216.5, 97.5, 71.0, -0.04])),
    Camera("SIMPLE_RADIAL", WIDTH, HEIGHT, np.array([221.0, 96.0, 71.5, -0.06])),
)
OFFSET_M = np.array([[0.0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0.03, 0.03, 0.002]])
TURN = np.radians([[0.0, 0, 0], [0.5, -0.3, 0.2], [-0.4, 0.6, -0.3], [0.2, 0.4, 0.5]])
SENSORS, CENTRES_NM = ("green", "nir", "red", "red-edge"), (560.0, 840.0, 650.0, 730.0)
DARKEST, CONTRAST = np.array([0.05, 0.30, 0.04, 0.12]), np.array([0.10, 0.35, 0.16, 0.20])  # of reflectance
IN_ORDER = (0, 2, 3, 1)  # by wavelength
GEO_FROM_MODEL = Similarity(1.7, exp_so3(np.array([0.3, -0.2, 1.0])), np.array([12.0, -7.0, 4.0]))
LARGER = 1.01  # focal length and height of the solution, over those of SfM
HEIGHT_M, GROUND_M, GSD = 30.0, 12.0, 0.15
BLACK, BRIGHTENS = 4096, (1e-5, 8e-6, 0.0, 0.0, 0.0, 0.0)


def pattern(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A smooth pattern of 0 to 1, with waves of 1.2 to 6 m: a pixel is 0.14 m."""
    rng, total = np.random.default_rng(5), np.zeros_like(east)
    for _ in range(24):
        length, angle, phase = rng.uniform(1.2, 6.0), rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / length * (np.cos(angle) * east + np.sin(angle) * north) + phase)
    return np.clip(0.5 + total / 20, 0.0, 1.0)


def ground_gaussians() -> Gaussians:
    step = 0.15
    grid = np.arange(-GROUND_M + step / 2, GROUND_M, step)
    east, north = (axis.ravel() for axis in np.meshgrid(grid, grid))
    rough = np.random.default_rng(2).normal(0, 0.002, east.shape)
    colour = np.repeat(pattern(east, north)[:, None], 3, axis=1)
    return Gaussians(
        torch.from_numpy(np.column_stack([east, north, rough])).float(),
        torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(east), 1),
        torch.tensor([0.08, 0.08, 0.01]).log().repeat(len(east), 1),
        torch.full((len(east),), 4.0),
        sh_from_rgb(torch.from_numpy(colour)).float()[:, None],
    )


def rig_name(name: str, lens: int) -> str:
    return name if lens == 0 else f"{SENSORS[lens]}_{name}"


def rig_of(sparse: SparseModel) -> SparseModel:
    """The SfM model with the companions, which follow the photographs of the reference lens."""
    turns, names, cameras = [], [], []
    shifts = []
    for lens, (turn, offset) in enumerate(zip(TURN, OFFSET_M, strict=True)):
        lens_from_reference = exp_so3(turn)
        shift = -lens_from_reference @ offset / GEO_FROM_MODEL.scale
        turns.append(lens_from_reference @ sparse.rotation_cam_from_local)
        shifts.append(sparse.translation_cam_from_local @ lens_from_reference.T + shift)
        names += [rig_name(name, lens) for name in sparse.image_name]
        cameras += [lens + 1] * len(sparse.image_name)
    return replace(
        sparse,
        cameras={lens + 1: camera for lens, camera in enumerate(LENSES)},
        image_id=np.arange(1, len(names) + 1),
        image_name=tuple(names),
        image_camera_id=np.array(cameras),
        rotation_cam_from_local=np.concatenate(turns),
        translation_cam_from_local=np.concatenate(shifts),
    )


def with_rig(survey: Survey) -> Survey:
    priors = tuple(
        survey.cameras[0].model_copy(
            update={
                "camera_id": lens + 1,
                "model": camera.model,
                "params": tuple(camera.params.tolist()),
                "sensor": sensor,
            }
        )
        for lens, (camera, sensor) in enumerate(zip(LENSES, SENSORS, strict=True))
    )
    companions = tuple(
        Companion(name=rig_name(image.name, lens), camera_id=lens + 1, sha256="", beside=image.name)
        for lens in range(1, len(LENSES))
        for image in survey.images
    )
    originals = tuple(Original(name=each.name, sha256="") for each in (*survey.images, *companions))
    update = {"cameras": priors, "companions": companions, "originals": originals, "original_dir": "originals"}
    return survey.model_copy(update={**update, "image_dir": "copies"})


def write_band(root: Path, name: str, lens: int, shown: np.ndarray, more: Mapping[str, object]) -> None:
    """Write counts of a pattern (H, W) through DJI's constants; each instant has its own exposure and light."""
    rng = np.random.default_rng(int(name[-7:-4]))
    exposure_us, irradiance = int(rng.integers(800, 1200)), float(rng.uniform(800, 1000))
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    vignetting = polynomial(np.hypot(column - 94.0, row - 70.0), BRIGHTENS)
    reflectance = DARKEST[lens] + CONTRAST[lens] * shown
    counts = BLACK + 65535 * reflectance * exposure_us * 1e-6 * irradiance / 1.05 / vignetting
    stated: dict[str, object] = {
        "BandName": SENSORS[lens], "BlackLevel": BLACK, "SensorGain": 1.0, "ExposureTime": exposure_us,
        "Irradiance": irradiance, "SensorGainAdjustment": 1.05, "VignettingData": ",".join(map(str, BRIGHTENS)),
        "CalibratedOpticalCenterX": 94.0, "CalibratedOpticalCenterY": 70.0, "CentralWavelength": CENTRES_NM[lens],
        "WavelengthFWHM": 26,
    }  # fmt: skip
    stated = {key: value for key, value in {**stated, **more}.items() if value is not None}
    # The names end in .jpg: the content is TIFF, which is what counts.
    data = band_tiff(np.round(counts).astype(np.uint16), dji_band(**stated), tags=exposed(exposure_us * 1e-6))
    (root / "originals" / rig_name(name, lens)).write_bytes(data)


def shown_by(center: np.ndarray, geo_from_cam: np.ndarray, lens: int) -> np.ndarray:
    """The pattern (H, W) as a lens shows it, along the rays through the middles of its pixels."""
    at = center + geo_from_cam @ OFFSET_M[lens]
    rotation = geo_from_cam @ exp_so3(TURN[lens]).T
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    slope = undistort(LENSES[lens], np.stack([column, row], axis=-1).reshape(-1, 2))
    ray = np.column_stack([slope, np.ones(len(slope))]) @ rotation.T
    hit = at - ray * (at[2] / ray[:, 2])[:, None]
    return pattern(hit[:, 0], hit[:, 1]).reshape(HEIGHT, WIDTH)


def write_rig(root: Path) -> Workspace:
    """Return a workspace of the rig, as `train` would leave it."""
    rng = np.random.default_rng(0)
    center = np.array([[e, n, HEIGHT_M] for e in (-5, 0, 5) for n in (-5, 0, 5)], dtype=float)
    points = np.column_stack([rng.uniform(-11, 11, (400, 2)), np.zeros(400)])
    facing = looking_at(center, center * [1, 1, 0] + [0.0, 1e-9, 0.0])
    scene = TrueScene(center, facing, points, np.zeros((0, 3)), camera=LENSES[0], geo_from_local=GEO_FROM_MODEL)
    noise = Noise(pixel_px=0.2)
    sparse = sparse_model(scene, noise, rng)
    workspace = write_workspace(root, with_rig(survey_of(scene, noise, Measured(), rng)), sparse)
    write_sparse(rig_of(sparse), root / RIG_MODEL)
    higher = GEO_FROM_MODEL.inverse().apply(center * [1, 1, LARGER])
    cameras = tuple(
        SolvedCamera(
            name=name,
            split="train",
            quat_xyzw=tuple(quat_xyzw_from_matrix(rotation).tolist()),
            translation=tuple((-rotation @ place).tolist()),
        )
        for name, rotation, place in zip(sparse.image_name, sparse.rotation_cam_from_local, higher, strict=True)
    )
    params = tuple((LENSES[0].params * [LARGER, LARGER, 1, 1]).tolist())
    lens = SolvedLens(camera_id=1, model="PINHOLE", params=params)
    model = trained_model(GEO_FROM_MODEL, max_image_size=WIDTH, cameras=cameras)
    save_json(model.model_copy(update={"lenses": (lens,)}), root / MODEL)
    write_gaussians(root / GAUSSIANS, transformed(ground_gaussians(), GEO_FROM_MODEL.inverse()))
    write_adjustment(workspace)
    for folder in ("copies", "originals"):
        (root / folder).mkdir()
    for name, place, rotation in zip(scene.names, center, facing, strict=True):
        for number in range(len(LENSES)):
            shown = shown_by(place, rotation, number)
            write_band(root, name, number, shown, {})
            copy = cv2.imencode(".png", np.round(255 * shown).astype(np.uint8))[1].tobytes()
            (root / "copies" / rig_name(name, number)).write_bytes(copy)
    return workspace


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    return write_rig(tmp_path_factory.mktemp("bands") / "ws")


@pytest.fixture(scope="module")
def delivered(workspace: Workspace) -> tuple[Workspace, list[str]]:
    """The workspace with its rasters, and the codes of what was said."""
    options = {"crs": "EPSG:32632", "gsd": GSD, "terrain": False, "hillshade": False, "fill": "all"}
    outcome = run_stage(workspace, BY_NAME["export-raster"], {**options, "bands": True})
    return workspace, codes(outcome.manifest.warnings)


def truth_at_cells(workspace: Workspace, raster: rasterio.DatasetReader) -> np.ndarray:
    """The pattern (H, W) in the middles of a raster's cells, by pyproj alone; UTM is affine over 30 m."""
    origin = load_json(Survey, workspace.path(SURVEY)).origin
    assert origin is not None
    corner = np.array([[e, n, 0.0] for e in (-GROUND_M, GROUND_M) for n in (-GROUND_M, GROUND_M)])
    lla = lla_from_enu(corner, origin)
    to_utm = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True)
    utm = np.column_stack([*to_utm.transform(lla[:, 1], lla[:, 0]), np.ones(4)])
    middle = utm.mean(axis=0) - [0, 0, 1]
    geo_from_utm = np.linalg.lstsq(utm - middle, corner[:, :2], rcond=None)[0]
    column, row = np.meshgrid(np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5)
    x, y = raster.transform * (column, row)
    plan = np.stack([x, y, np.ones_like(x)], axis=-1) - middle
    east, north = np.moveaxis(plan @ geo_from_utm, -1, 0)
    return pattern(east, north)


def shifts(one: np.ndarray, other: np.ndarray, size: int = 24) -> np.ndarray:
    """Shifts (T, 2) in cells between two rasters of the pattern, by least squares on tiles of their middle.

    Phase correlation scatters by 0.2 cells here: the pattern has few frequencies. It is the same in all bands,
    though, so that its slopes tell shifts of a hundredth.
    """
    north, east = np.gradient(one)
    row, column = (side // 2 - 2 * size for side in one.shape)
    found = []
    for i, j in np.ndindex(4, 4):
        tile = (slice(row + i * size, row + (i + 1) * size), slice(column + j * size, column + (j + 1) * size))
        slopes = np.column_stack([-east[tile].ravel(), -north[tile].ravel(), np.ones(size * size)])
        found.append(np.linalg.lstsq(slopes, (other - one)[tile].ravel(), rcond=None)[0][:2])
    return np.array(found)


def test_bands_meet_to_a_tenth_of_a_pixel_and_have_their_reflectance(
    delivered: tuple[Workspace, list[str]],
) -> None:
    """All lenses show one pattern. Interpolation by OpenCV's cubic kernel moves details by up to 0.045 px.

    Of a lens that was projected by itself, the 1 % of focal length would move details by up to 1 px at the rim.
    """
    workspace, said = delivered
    with rasterio.open(workspace.path("raster/bands.tif")) as raster:
        values, truth = raster.read(masked=True).filled(np.nan), truth_at_cells(workspace, raster)
        assert raster.descriptions == (
            "green, 560 nm: relative reflectance", "red, 650 nm: relative reflectance",
            "red-edge, 730 nm: relative reflectance", "nir, 840 nm: relative reflectance",
            "NDVI: (nir - red) / (nir + red)",
        )  # fmt: skip
        assert raster.tags(4)["wavelength"] == "840"
        assert raster.tags(4, ns="IMAGERY") == {"CENTRAL_WAVELENGTH_UM": "0.84", "FWHM_UM": "0.026"}
    with rasterio.open(workspace.path("raster/orthophoto.tif")) as ortho:
        assert ortho.shape == values.shape[1:]
    middle = tuple(slice(side // 2 - 48, side // 2 + 48) for side in truth.shape)
    assert np.isfinite(values[:, *middle]).all()
    shown = [(values[band] - DARKEST[lens]) / CONTRAST[lens] for band, lens in enumerate(IN_ORDER)]
    found = np.array([shifts(shown[0], each) for each in shown[1:]])
    against_truth = np.array([shifts(truth, each) for each in shown])
    print(np.abs(found).max(axis=(1, 2)), np.abs(against_truth).max(axis=(1, 2)))
    assert np.abs(found).max() <= 0.1
    assert np.abs(against_truth).max() <= 0.4  # of the surface and its place, too, which all bands share
    for band, lens in enumerate(IN_ORDER):
        error = (values[band] - DARKEST[lens] - CONTRAST[lens] * truth)[middle]
        print(SENSORS[lens], np.sqrt(np.mean(error**2)) / CONTRAST[lens], np.median(error) / CONTRAST[lens])
        # Their shift against the truth, on slopes of the pattern of 0.04 of its range a cell (RMS).
        assert np.sqrt(np.mean(error**2)) < 0.02 * CONTRAST[lens]
        assert abs(np.median(error)) < 0.002 * CONTRAST[lens]
    red, nir = (DARKEST[lens] + CONTRAST[lens] * truth for lens in (2, 1))
    assert np.abs(values[4] - (nir - red) / (nir + red))[middle].max() < 0.05
    assert said == ["bands-relative"]


def copy_of(workspace: Workspace, root: Path) -> Workspace:
    shutil.copytree(workspace.root, root, ignore=shutil.ignore_patterns("raster*", "cache"))
    return Workspace(root)


def bands_of(workspace: Workspace) -> tuple[BandPictures, tuple[Remark, ...]]:
    model = read_trained(workspace)
    sfm, survey = read_sfm(workspace, model), load_survey(workspace)
    return band_pictures(workspace, model, sfm, survey, SILENT)


def test_a_band_without_a_constant_has_counts(workspace: Workspace, tmp_path: Path) -> None:
    """One photograph without irradiance makes its band counts, in full depth; the index is left out."""
    changed = copy_of(workspace, tmp_path / "ws")
    write_band(changed.root, "image_003.jpg", 1, np.full((HEIGHT, WIDTH), 0.5), {"Irradiance": None})
    pictures, remarks = bands_of(changed)
    quantities = {lens.sensor: lens.quantity for lens in pictures.bands.lenses}
    assert quantities == dict.fromkeys(SENSORS, "relative reflectance") | {"nir": "counts"}
    assert pictures.bands.ndvi is None
    assert codes(remarks) == ["bands-as-counts", "bands-relative"]
    u, v, z = (np.full((1, 1), value, dtype=np.float32) for value in (96.0, 72.0, HEIGHT_M / 1.7))
    values, _ = pictures.at(3, pictures._pinholes[3], u, v, z)
    assert values[0, 0, 3] > 4 * 255  # of more than eight bits


def test_an_instant_without_a_band_is_left_out(workspace: Workspace, tmp_path: Path) -> None:
    changed = copy_of(workspace, tmp_path / "ws")
    survey = load_json(Survey, changed.path(SURVEY))
    kept = tuple(each for each in survey.companions if each.name != "nir_image_004.jpg")
    save_json(survey.model_copy(update={"companions": kept}), changed.path(SURVEY))
    rig = rig_of(sparse_of(changed))
    rows = np.array([row for row, name in enumerate(rig.image_name) if name != "nir_image_004.jpg"])
    shutil.rmtree(changed.path(RIG_MODEL))
    write_sparse(rig.of_images(rows), changed.root / RIG_MODEL)
    pictures, remarks = bands_of(changed)
    assert "bands-instants-left-out" in codes(remarks)
    assert [pictures.has(camera) for camera in range(9)] == [camera != 4 for camera in range(9)]


def sparse_of(workspace: Workspace) -> SparseModel:
    return read_sfm(workspace, read_trained(workspace))


@pytest.mark.parametrize("unit", ["degrees Celsius", "kelvin"])
def test_a_thermal_camera_has_degrees(workspace: Workspace, tmp_path: Path, unit: str) -> None:
    changed = copy_of(workspace, tmp_path / "ws")
    survey = load_json(Survey, changed.path(SURVEY))
    camera = survey.cameras[0].model_copy(update={"sensor": "thermal"})
    update = {"cameras": (camera,), "companions": (), "originals": survey.originals[: len(survey.images)]}
    save_json(survey.model_copy(update=update), changed.path(SURVEY))
    for image in survey.images:
        degrees = np.full((HEIGHT, WIDTH), 21.5 + (273.15 if unit == "kelvin" else 0.0), dtype=np.float32)
        (changed.root / "originals" / image.name).write_bytes(band_tiff(degrees, None))
    pictures, remarks = bands_of(changed)
    assert [band.unit for band in pictures.bands.described()] == ["°C"]
    u, v, z = (np.full((1, 1), value, dtype=np.float32) for value in (90.0, 60.0, 17.0))
    assert pictures.at(0, pictures._pinholes[0], u, v, z)[0][0, 0, 0] == pytest.approx(21.5, abs=1e-3)
    assert codes(remarks) == ["bands-degrees-assumed"]


def test_photographs_of_three_colours_have_no_bands(workspace: Workspace, tmp_path: Path) -> None:
    changed = copy_of(workspace, tmp_path / "ws")
    survey = load_json(Survey, changed.path(SURVEY))
    update = {"companions": (), "cameras": survey.cameras[:1], "originals": (), "original_dir": None}
    save_json(survey.model_copy(update=update), changed.path(SURVEY))
    for image in survey.images:
        colours = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
        (changed.root / "copies" / image.name).write_bytes(cv2.imencode(".png", colours)[1].tobytes())
    with refused("no-bands", InputError):
        bands_of(changed)
