"""From files in one CRS to a report in another, through the commands, where the Earth is visibly round.

Two groups of cameras, 10 km apart on either side of a place, over points at height zero. Trajectory, control and
check points are written by closed formulas (tests/map_projections.py), the frames in between are PROJ's topocentric
ones: nothing of `pipelines.geodesy` has a part in the truth.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pyproj import Geod, Transformer
from scipy.sparse import bsr_matrix
from scipy.spatial.transform import Rotation

from pipelines.adjust.posterior import Posterior, save_posterior
from pipelines.adjust.system import NormalMatrix
from pipelines.core.products import load_json, save_json
from pipelines.core.stages import GAUSSIANS, MODEL, REPORT, SPARSE, SURVEY, TRAIN_POSTERIOR
from pipelines.formats.colmap import read_sparse, write_sparse
from pipelines.geometry.cameras import Camera
from pipelines.geometry.similarity import Similarity
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.gaussians import Gaussians, write_gaussians
from pipelines.survey.solution import SolvedCamera, TrainedModel
from pipelines.survey.survey import Survey
from tests.cli_runs import Georef
from tests.map_projections import US_FOOT_M, long_island, utm
from tests.photos import jpeg
from tests.refusals import codes
from tests.scenes import trained_model

CAMERA = Camera("PINHOLE", 64, 48, np.array([40.0, 40.0, 32.0, 24.0]))
HALF_M, HEIGHT_M = 5_000.0, 60.0
Mapping = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Grid:
    """A CRS: its name here, and x, y, z of latitude, longitude, height (N, 3)."""

    crs: str
    of_lla: Mapping


def zone(number: int, meridian_side: float | None = None) -> Grid:
    """A UTM zone; near the date line with longitudes that run on to the side of `meridian_side`."""

    def mapped(lla: np.ndarray) -> np.ndarray:
        lon = lla[:, 1] if meridian_side is None else meridian_side + (lla[:, 1] - meridian_side + 180) % 360 - 180
        return np.column_stack([utm(number).xy_m(np.column_stack([lla[:, 0], lon])), lla[:, 2]])

    return Grid(f"EPSG:{32600 + number}", mapped)


FEET = Grid("EPSG:2263", lambda lla: np.column_stack([long_island(lla), lla[:, 2]]) / US_FOOT_M)
NEW_FEET = Grid("EPSG:6539", FEET.of_lla)


def ecef_of(lla: np.ndarray) -> np.ndarray:
    """Earth-centred coordinates by PROJ."""
    proj = Transformer.from_pipeline("+proj=pipeline +step +proj=cart +ellps=WGS84")
    return np.stack(proj.transform(*np.radians(lla[:, 1::-1]).T, lla[:, 2], radians=True), axis=-1)


GEOCENTRIC = Grid("EPSG:4978", ecef_of)


@dataclass(frozen=True)
class Site:
    """Cameras and points; the first and last three points are control, those in between check points."""

    camera_lla: np.ndarray  # (8, 3)
    point_lla: np.ndarray  # (10, 3)

    @property
    def names(self) -> list[str]:
        """Names of the images."""
        return [f"image_{index}.jpg" for index in range(len(self.camera_lla))]

    @property
    def rotation_ecef_from_cam(self) -> np.ndarray:
        """(8, 3, 3) of cameras that look straight down where they are, their upper edge to the north."""
        lat, lon = np.radians(self.camera_lla[:, 0]), np.radians(self.camera_lla[:, 1])
        enu = Rotation.from_euler("ZY", np.column_stack([lon, -lat])).as_matrix()[:, :, [1, 2, 0]]
        return enu @ np.diag([1.0, -1.0, -1.0])

    def pixels(self) -> np.ndarray:
        """(8, 10, 2) of each point in each camera, outside the picture where it is not seen."""
        offset = ecef_of(self.point_lla)[None] - ecef_of(self.camera_lla)[:, None]
        in_cam = np.einsum("nji,npj->npi", self.rotation_ecef_from_cam, offset)
        fx, fy, cx, cy = CAMERA.params
        xy = in_cam[:, :, :2] / np.maximum(in_cam[:, :, 2:], 1.0) * [fx, fy] + [cx, cy]
        return np.where(in_cam[:, :, 2:] > 0, xy, -1.0)


def site(lat: float, lon: float) -> Site:
    """Groups 5 km east and west of a place."""
    geod = Geod(ellps="WGS84")
    cameras, points = [], []
    for azimuth in (-90.0, 90.0):
        middle_lon, middle_lat, _ = geod.fwd(lon, lat, azimuth, HALF_M)
        for turn, reach in zip((10.0, 100.0, 190.0, 280.0), (20.0, 24.0, 18.0, 26.0), strict=True):
            east, north, _ = geod.fwd(middle_lon, middle_lat, turn, reach)
            cameras.append([north, east, HEIGHT_M])
        for turn, reach in zip((0.0, 75.0, 140.0, 215.0, 290.0), (4.0, 7.0, 5.0, 8.0, 6.0), strict=True):
            east, north, _ = geod.fwd(middle_lon, middle_lat, turn, reach)
            points.append([north, east, 0.0])
    return Site(np.array(cameras), np.array(points))


def write_inputs(folder: Path, made: Site, track: Grid, control: Grid, check: Grid) -> tuple[object, ...]:
    """Photographs, trajectory and points; the arguments of `georef ingest`."""
    images = folder / "photos"
    images.mkdir()
    for index, name in enumerate(made.names):
        (images / name).write_bytes(jpeg(index, size=(CAMERA.width, CAMERA.height)))
    rows = [
        f"{name},{x:.6f},{y:.6f},{z:.6f},0.05,0.05,0.08"
        for name, (x, y, z) in zip(made.names, track.of_lla(made.camera_lla), strict=True)
    ]
    (folder / "track.csv").write_text("\n".join(["image,x,y,z,sigma_e,sigma_n,sigma_u", *rows]) + "\n")
    pixels = made.pixels()
    inside = ((pixels > 0) & (pixels < [CAMERA.width, CAMERA.height])).all(axis=2)
    assert (inside.sum(axis=0) >= 2).all()
    for file, grid, chosen in (("gcp.txt", control, [0, 1, 2, 7, 8, 9]), ("check.txt", check, [3, 4, 5, 6])):
        xyz = grid.of_lla(made.point_lla)
        rows = [
            f"{xyz[j, 0]:.6f} {xyz[j, 1]:.6f} {xyz[j, 2]:.6f} {pixels[i, j, 0]:.8f} {pixels[i, j, 1]:.8f} "
            f"{made.names[i]} P{j}"
            for j in chosen
            for i in np.flatnonzero(inside[:, j])
        ]
        (folder / file).write_text("\n".join([grid.crs, *rows]) + "\n")
    return (
        "--images", images, "--trajectory", folder / "track.csv", "--crs", track.crs, "--gcp", folder / "gcp.txt",
        "--checkpoints", folder / "check.txt", "--vertical", "ellipsoidal", "--test-every", 0,
    )  # fmt: skip


def write_perfect_model(root: Path, made: Site) -> None:
    """What a flawless reconstruction and training would leave."""
    origin = load_json(Survey, root / SURVEY).origin
    topocentric = Transformer.from_pipeline(
        f"+proj=topocentric +ellps=WGS84 +lat_0={origin.lat_deg} +lon_0={origin.lon_deg} +h_0={origin.alt_m}"
    )
    center = np.stack(topocentric.transform(*ecef_of(made.camera_lla).T), axis=-1)
    zero, axes = (np.stack(topocentric.transform(*x), axis=-1) for x in (np.zeros((3, 1)), 1e6 * np.eye(3)))
    turn = (axes - zero).T / 1e6  # geo from Earth-centred, to 1e-15
    shift = np.round(center.mean(axis=0))
    cam_from_model = np.swapaxes(turn @ made.rotation_ecef_from_cam, 1, 2)
    translation = -np.einsum("nij,nj->ni", cam_from_model, center - shift)
    count = len(made.names)
    write_sparse(
        SparseModel(
            {1: CAMERA}, np.arange(1, count + 1), tuple(made.names), np.ones(count, dtype=np.int64), cam_from_model,
            translation, np.array([1]), np.zeros((1, 3)), np.zeros((1, 3), dtype=np.uint8), np.ones(1),
            np.array([0]), np.array([0]), np.array([[32.0, 24.0]]),
        ),
        root / SPARSE,
    )  # fmt: skip
    cameras = tuple(
        SolvedCamera(
            name=name,
            split="train",
            quat_xyzw=tuple(Rotation.from_matrix(rotation).as_quat().tolist()),
            translation=tuple(place.tolist()),
        )
        for name, rotation, place in zip(made.names, cam_from_model, translation, strict=True)
    )
    model = trained_model(Similarity(translation=shift), max_image_size=64, cameras=cameras)
    save_json(model, root / MODEL)
    write_flawless_posterior(root, model)
    # One far from everything: on the rendered surface, no point is found.
    speck = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 1, 3)
    )
    write_gaussians(root / GAUSSIANS, speck)


def write_flawless_posterior(root: Path, model: TrainedModel) -> None:
    """Cameras of 1 mm and 1 mrad, independent of each other, under an exact lens."""
    n = len(model.cameras)
    normal = NormalMatrix(
        bsr_matrix(1e6 * np.eye(6 * n), blocksize=(6, 6)), np.zeros((0, 6 * n)), np.zeros((0, 0)), np.eye(n, 3)
    )
    covariances = np.tile(1e-6 * np.eye(6), (n, 1, 1))
    none = np.zeros(0, dtype=np.int64)
    sparse, followed = read_sparse(root / SPARSE), np.zeros((7, 6 * n))
    save_posterior(Posterior(model, sparse, normal, followed, none, covariances), root / TRAIN_POSTERIOR)


def coordinates_of(root: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((root / REPORT).read_text(encoding="utf-8"))["coordinates"]
    return found


@pytest.mark.parametrize(
    ("place", "track", "control", "check", "wanted"),
    [
        pytest.param((50.0, 6.0), zone(31), zone(32), zone(31), (zone(32), zone(31)), id="between zones 31 and 32"),
        pytest.param((70.0, 12.0), zone(33), zone(32), zone(32), (zone(33), GEOCENTRIC), id="70 degrees north"),
        pytest.param(
            (52.0, 180.0), zone(60, 180.0), zone(1, -180.0), zone(60, 180.0), (zone(1, -180.0),), id="date line"
        ),
        pytest.param((40.75, -73.6), FEET, NEW_FEET, FEET, (NEW_FEET, zone(18)), id="feet"),
        pytest.param((40.75, -73.6), GEOCENTRIC, FEET, GEOCENTRIC, (FEET,), id="Earth-centred to feet"),
    ],
)
@pytest.mark.usefixtures("one_thread")
def test_positions_agree_across_crs_and_10_km(
    real_georef: Georef,
    tmp_path: Path,
    place: tuple[float, float],
    track: Grid,
    control: Grid,
    check: Grid,
    wanted: tuple[Grid, ...],
) -> None:
    made, root = site(*place), tmp_path / "ws"
    result = real_georef("ingest", root, *write_inputs(tmp_path, made, track, control, check))
    assert result.code == 0, result.err
    survey = load_json(Survey, root / SURVEY)
    # The two groups lie a chord apart: 10 km less a millimetre, whatever scale the projection has there.
    fixes = np.array([image.fix.position_in_geo for image in survey.images if image.fix is not None])
    through_earth = np.linalg.norm(ecef_of(made.camera_lla)[0] - ecef_of(made.camera_lla)[4:], axis=1)
    # The files have micrometres (feet: a third), the shift from NAD83 is 0; GRS80 is 0.1 mm flatter at the poles.
    np.testing.assert_allclose(np.linalg.norm(fixes[0] - fixes[4:], axis=1), through_earth, rtol=1e-9, atol=1e-5)
    points = [point.position_in_geo for point in (*survey.control_points, *survey.check_points)]
    # At height zero, 5 km from the middle and less than 60 m below the origin: 5000² / 2R = 2.0 m lower still.
    np.testing.assert_allclose([u + survey.origin.alt_m for _, _, u in points], -1.96, atol=0.03)
    write_perfect_model(root, made)
    for grid in wanted:
        result = real_georef("evaluate", root, "--crs", grid.crs, "--renders", 0, "--backend", "cpu")
        assert result.code == 0, result.err
        found = coordinates_of(root)
        assert (found["crs"], found["heights"]) == (grid.crs, "ellipsoidal")
        truth = grid.of_lla(made.point_lla)[3:7]
        unit_m = US_FOOT_M if "foot" in found["units"][0] else 1.0
        for kind in ("surveyed", "triangulated"):
            xyz = np.array([row[kind] for row in found["points"]])
            assert np.linalg.norm((xyz - truth) * unit_m, axis=1).max() < 1e-3
        assert [row["name"] for row in found["points"]] == ["P3", "P4", "P5", "P6"]
        assert [row["surface"] for row in found["points"]] == [None] * 4


@pytest.mark.usefixtures("one_thread")
def test_a_geoid_that_is_not_installed_stops_both_ends(real_georef: Georef, tmp_path: Path) -> None:
    """One message that names the grid and the way to get it; nothing is written."""
    made, root = site(50.0, 6.0), tmp_path / "ws"
    above_geoid = Grid("EPSG:32631+5773", zone(31).of_lla)
    arguments = write_inputs(tmp_path, made, zone(31), above_geoid, zone(31))
    refused = real_georef("ingest", root, *arguments)
    refused.assert_failed(1)
    assert f"error: {tmp_path}/gcp.txt: " in refused.err and "EGM96 height" in refused.err
    assert "us_nga_egm96_15.tif" in refused.err and "pyproj sync --file us_nga_egm96_15.tif" in refused.err
    assert not (root / SURVEY).exists()

    (tmp_path / "gcp.txt").write_text((tmp_path / "gcp.txt").read_text().replace("+5773", ""))
    assert real_georef("ingest", root, *arguments).code == 0
    write_perfect_model(root, made)
    for crs, message in (
        ("EPSG:32631+5773", "us_nga_egm96_15.tif"),
        ("EPSG:99999", "[--crs]"),
        ("EPSG:2263", "EPSG:2263"),
    ):
        refused = real_georef("evaluate", root, "--crs", crs, "--backend", "cpu")
        refused.assert_failed(2 if "error: [--crs]" in refused.err else 1)
        assert refused.err.count("error:") == 1 and message in refused.err
        assert not (root / REPORT).exists()


@pytest.mark.usefixtures("one_thread")
def test_sigmas_stay_metres_where_coordinates_are_feet(real_georef: Georef, tmp_path: Path) -> None:
    made, root = site(40.75, -73.6), tmp_path / "ws"
    assert real_georef("ingest", root, *write_inputs(tmp_path, made, FEET, FEET, FEET)).code == 0
    survey = load_json(Survey, root / SURVEY)
    fix = survey.images[0].fix
    assert fix is not None
    np.testing.assert_allclose(fix.cov_in_geo, np.diag([0.05**2, 0.05**2, 0.08**2]), rtol=0, atol=1e-5)
    assert {"sigma-in-metres", "height-unit"} <= set(codes(survey.assumptions))
