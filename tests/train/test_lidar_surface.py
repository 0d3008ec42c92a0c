"""LiDAR of a town of boxes in training: points of the depth loss and to start from, free space, the trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import Origin, lla_from_enu
from pipelines.geometry.cameras import CameraPoses, Pinhole
from pipelines.surface.lidar_cloud import ScannerTrack
from pipelines.survey.options import CloudCrs
from pipelines.train.lidar import free_space
from pipelines.train.lidar_surface import CloudVerdict, FusedSurface
from tests.refusals import refused
from tests.towns import EXTRA, FOCAL_PX, HOUSES, PIXEL_M, SIZE, TOWN, WITH_EXTRA, scanned, surface_of, views_of

CAMERA = Pinhole(*SIZE, FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2)
VIEWS = views_of(TOWN)


@dataclass(frozen=True)
class FakeScene:
    train: np.ndarray
    poses: CameraPoses


class TownMaps:
    """Depth maps of the town without their left halves; red photographs."""

    def __init__(self) -> None:
        self.scene = FakeScene(np.arange(12), CameraPoses(VIEWS.cam_from_world, VIEWS.center_in_world))
        self._depth = VIEWS.depth_m.reshape(12, SIZE[1], SIZE[0]).copy()
        self._depth[:, :, : SIZE[0] // 2] = 0.0

    def camera(self, index: int) -> Pinhole:
        return CAMERA

    def depth(self, index: int) -> np.ndarray:
        return self._depth[index]

    def rgb(self, index: int) -> np.ndarray:
        return np.tile(np.array([200, 10, 10], np.uint8), (SIZE[1], SIZE[0], 1))


def fused() -> FusedSurface:
    cloud = scanned(TOWN)
    nothing = np.zeros(len(cloud), dtype=bool)
    judged = CloudVerdict(nothing, np.full(len(cloud), 0.9), ())
    return FusedSurface(cast(Any, TownMaps()), cloud, judged, PIXEL_M)


def test_depth_loss_has_lidar_that_views_see_where_stereo_found_nothing() -> None:
    surface = fused()
    hidden = unseen = 0
    for index in range(12):
        points, weight = surface.depth_loss_points(index, 3)
        alone = points[len(surface.points(index, 3)) :]
        assert len(weight) == len(points) and len(alone) > 50
        in_cam = (alone - VIEWS.center_in_world[index]) @ VIEWS.cam_from_world[index].T
        column = FOCAL_PX * in_cam[:, 0] / in_cam[:, 2] + SIZE[0] / 2
        assert (column < SIZE[0] / 2).all()
        # One point for a cell of 3 × 3 pixels, as dense as points of stereo.
        row = FOCAL_PX * in_cam[:, 1] / in_cam[:, 2] + SIZE[1] / 2
        assert len(np.unique(np.stack([row, column]) // 3, axis=1).T) == len(alone)
        true = TOWN.distance(VIEWS.center_in_world[index], alone - VIEWS.center_in_world[index])
        hidden += int((true < 0.98).sum())
        unseen += len(alone)
    # A pixel is 0.75 m wide: a point beside an edge may lie in a pixel of the edge.
    assert hidden < 0.01 * unseen


def test_training_starts_on_lidar_where_stereo_found_nothing() -> None:
    cut = fused()
    drawn = cut.sample(600, 0)
    assert len(drawn.rgb) <= 600
    np.testing.assert_array_equal(drawn.rgb, np.broadcast_to([200, 10, 10], drawn.rgb.shape))
    west = cut.sample(600, 0, lambda points: points[:, 0] < 0)
    assert (west.point_in_model[:, 0] < 0.2).all()  # planes of the LiDAR may lie across the limit by their noise


def test_space_that_beams_have_crossed_is_free_unless_photographs_show_something_there() -> None:
    cloud = scanned(TOWN)
    nothing = np.zeros(len(cloud), dtype=bool)
    now = surface_of(WITH_EXTRA)
    space = free_space(cloud, nothing, now)
    assert space is not None

    def is_free(place: tuple[float, float, float]) -> bool:
        cell = np.floor((np.array(place) - space.low_in_model) / space.cell_m).astype(int)
        return bool(space.free[tuple(cell)])

    assert is_free((-8.0, 12.0, 6.0)) and is_free((0.0, 20.0, 9.0))
    inside = (HOUSES[0][0] + HOUSES[0][1]) / 2
    assert not is_free(tuple(inside))
    top = (EXTRA[0] + EXTRA[1]) / 2 + [0, 0, (EXTRA[1] - EXTRA[0])[2] / 2]
    assert not is_free(tuple(top))  # built since the flight
    assert free_space(cloud, ~nothing, now) is None
    assert free_space(replace(cloud, scanner_in_model=None), nothing, now) is None


def test_walls_are_grazed_and_the_ground_is_not() -> None:
    cloud = scanned(TOWN)
    incidence = cloud.incidence()
    ground, wall = np.abs(cloud.normal_in_model[:, 2]) > 0.99, np.abs(cloud.normal_in_model[:, 2]) < 0.1
    # Beams leave the vertical by 40° at most.
    # These normals leave the vertical by 8° at most, or the level by 6°.
    assert (incidence[ground] > np.cos(np.radians(48))).all()
    assert (incidence[wall] < np.sin(np.radians(46))).all()
    assert np.isnan(replace(cloud, scanner_in_model=None).incidence()).all()


ORIGIN = Origin(lat_deg=46.0, lon_deg=7.7, alt_m=500.0)


def track_file(folder: Path, time_s: np.ndarray, place: np.ndarray) -> Path:
    lla = lla_from_enu(place, ORIGIN)
    rows = [f"{t:.3f},{lat:.11f},{lon:.11f},{alt:.4f}" for t, (lat, lon, alt) in zip(time_s, lla, strict=True)]
    path = folder / "track.csv"
    path.write_text("\n".join(["timestamp,latitude,longitude,altitude", *rows]) + "\n")
    return path


def test_the_scanner_is_found_by_time(tmp_path: Path) -> None:
    time_s = np.arange(100.0, 120.0)
    place = np.stack([8.0 * (time_s - 100), np.zeros(20), np.full(20, 60.0)], axis=1)
    track = ScannerTrack.read(track_file(tmp_path, time_s, place), CloudCrs(), ORIGIN)
    at = track.at(np.array([100.5, 110.25, 118.75, np.nan]))
    np.testing.assert_allclose(at[:3, 0], [4.0, 82.0, 150.0], atol=0.01)
    np.testing.assert_allclose(at[:3, 2], 60.0, atol=0.01)
    assert np.isnan(at[3]).all()


def test_another_clock_is_refused(tmp_path: Path) -> None:
    track = ScannerTrack.read(track_file(tmp_path, np.arange(20.0), np.zeros((20, 3))), CloudCrs(), ORIGIN)
    with refused("times-outside-trajectory", InputError):
        track.at(np.arange(5000.0, 5100.0))


def test_a_track_without_times_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "track.csv"
    path.write_text("latitude,longitude,altitude\n46,7.7,500\n")
    with pytest.raises(InputError, match="timestamp"):
        ScannerTrack.read(path, CloudCrs(), ORIGIN)
    path.write_text("image,latitude,longitude,altitude\na.jpg,46,7.7,500\n")
    with refused("no-timestamps", InputError) as error:
        ScannerTrack.read(path, CloudCrs(), ORIGIN)
    assert error.value.field == "--lidar-trajectory"


def test_a_track_in_projected_coordinates_needs_a_crs(tmp_path: Path) -> None:
    path = tmp_path / "track.csv"
    path.write_text("timestamp,x,y,z\n1,400000,5000000,500\n")
    with refused("crs-unknown", InputError):
        ScannerTrack.read(path, CloudCrs(), ORIGIN)
