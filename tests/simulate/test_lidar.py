"""The simulated LiDAR flight agrees with the true scene, through its files alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.formats.trajectory_csv import read_trajectory
from pipelines.geodesy.enu import Origin
from pipelines.simulate.lidar import NOISE, LidarFlight, lidar_files
from pipelines.simulate.mesh import Raycaster
from pipelines.simulate.options import LidarFlightOptions
from pipelines.simulate.scene import SimulatedScene, build_scene
from pipelines.surface.measured_cloud import CloudReader
from pipelines.survey.options import CloudCrs

SHIFT = np.array([0.1, -0.2, 0.05])
ORIGIN = Origin(lat_deg=-33.86, lon_deg=151.21, alt_m=-20.0)


@pytest.fixture(scope="module")
def scene() -> SimulatedScene:
    return build_scene("city", np.random.SeedSequence(3))


def flight_over(scene: SimulatedScene, **options: Any) -> LidarFlight:
    small = {"lidar_density": 2, "lidar_radius": 45}
    return LidarFlight(LidarFlightOptions.model_validate({**small, **options}), scene, np.random.SeedSequence(0))


def depth_below(scene: SimulatedScene, points: np.ndarray) -> np.ndarray:
    """Depths of points below the upper surface of the scene, in metres."""
    up = np.array([[0.0, 0.0, 1.0]])
    down = np.broadcast_to(-up, points.shape)
    return 100.0 - Raycaster(scene.mesh).first_hits(points + 100.0 * up, down).distance.astype(np.float64)


def test_files_hold_the_flight(scene: SimulatedScene, tmp_path: Path) -> None:
    flight = flight_over(scene)
    with lidar_files(tmp_path, ORIGIN) as write:
        strips = list(flight.strips())
        for strip in strips:
            write(strip)
    files = CloudReader(tmp_path / "lidar.laz", CloudCrs())
    assert not files.assumptions  # the CRS states its heights
    (cloud,) = files.chunks(ORIGIN)
    returns, noise = flight.truth().returns, files.tally.noise
    assert len(cloud) + noise == returns
    # One in a thousand, drawn: within five σ of a Poisson count.
    assert abs(noise - 1e-3 * returns) < 5 * np.sqrt(1e-3 * returns)
    valid = np.concatenate([strip.position_in_geo[strip.classification != NOISE] for strip in strips])
    # Half a step of 1 mm in height, and of 1e-9 degrees.
    np.testing.assert_allclose(cloud.position_in_geo, valid, rtol=0, atol=6e-4)
    # The density that was asked for, but for what is missed; walls and crowns add to it.
    assert 0.7 * 2 < returns / 90.0**2 < 1.6 * 2
    track = read_trajectory(tmp_path / "lidar_trajectory.csv")
    assert track.time_s is not None
    assert track.time_s.min() <= cloud.gps_time_s.min() and cloud.gps_time_s.max() <= track.time_s.max()


def test_ground_lies_where_the_shift_puts_it(scene: SimulatedScene) -> None:
    strips = list(flight_over(scene, lidar_shift="0.1,-0.2,0.05").strips())
    points = np.concatenate([strip.position_in_geo[strip.classification == 2] for strip in strips])
    error = -depth_below(scene, points - SHIFT)
    below_sky = np.abs(error) < 0.3  # beside a wall, noise moves a point below the roof
    assert below_sky.mean() > 0.95
    # 0.02 m of noise along beams up to 40° from the vertical.
    assert abs(np.median(error)) < 0.002
    assert 0.014 < 1.4826 * np.median(np.abs(error[below_sky])) < 0.021
    # Both sides of a strip, and both directions of flight, see walls.
    assert np.concatenate([strip.classification == 6 for strip in strips]).mean() > 0.05


def test_a_removed_building_stands_in_the_cloud_alone(scene: SimulatedScene) -> None:
    flight = flight_over(scene, lidar_change="removed")
    strips = list(flight.strips())
    points = np.concatenate([strip.position_in_geo for strip in strips])
    of_change = np.concatenate([strip.of_change for strip in strips])
    assert flight.truth().returns_of_change == of_change.sum() > 0.05 * len(points)
    corners, east_north = np.array(flight.truth().changed_footprint), points[of_change, :2]
    assert (east_north > corners.min(axis=0) - 0.2).all() and (east_north < corners.max(axis=0) + 0.2).all()
    # Nothing but cars and crowns stands on the square where photographs are taken.
    assert np.median(-depth_below(scene, points[of_change])) > 3.0


def test_an_added_building_lacks_in_the_cloud(scene: SimulatedScene) -> None:
    flight = flight_over(scene, lidar_change="added")
    strips = list(flight.strips())
    points = np.concatenate([strip.position_in_geo for strip in strips])
    of_change = np.concatenate([strip.of_change for strip in strips])
    assert flight.truth().returns_of_change == of_change.sum() > 200
    # The building of the photographs stands above what the beams met: ground, but for the hall's outer wall.
    assert np.quantile(points[of_change, 2], 0.9) < 3.0
    assert (depth_below(scene, points[of_change]) > 3.0).mean() > 0.8


def test_missing_lever_arm_turns_with_the_heading(scene: SimulatedScene) -> None:
    plain, missing = (
        list(
            LidarFlight(
                LidarFlightOptions(lidar_density=1, lidar_arm=arm), scene, np.random.SeedSequence(0)
            ).strips()
        )
        for arm in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0))
    )
    shifts = [b.position_in_geo - a.position_in_geo for a, b in zip(plain, missing, strict=True)]
    assert all(np.ptp(shift, axis=0).max() < 1e-9 for shift in shifts)
    np.testing.assert_allclose(shifts[0][0], -shifts[1][0], atol=1e-9)  # neighbouring strips are flown to and fro
    assert np.linalg.norm(shifts[0][0]) == pytest.approx(0.3)
