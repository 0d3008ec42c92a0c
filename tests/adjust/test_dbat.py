"""Our adjustment of five aerial photographs against the figures of a program that is not ours.

The measurements and the report are those of the Damped Bundle Adjustment Toolbox (Börlin and Grussenmeyer), folder
`data/script/sxb`. They are not part of this repository: the test needs a folder of survey data, named by
GEOREF_DATA, with `dbat_sxb` in it. `pytest tests/adjust/test_dbat.py -s` prints the table of
examples/benchmarks/results/accuracy.md.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.geometry.cameras import Camera
from pipelines.geometry.network import Network
from pipelines.geometry.rotations import omega_phi_kappa_deg, omega_phi_kappa_jacobian
from tests.raw_bundle import AdjustedBundle, SurveyedPoints, adjust_bundle

FOLDER = Path(os.environ.get("GEOREF_DATA", "no-data")) / "dbat_sxb"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="GEOREF_DATA names no folder with dbat_sxb")

PIXEL_MM = 0.006
CAMERA = Camera("PINHOLE", 8858, 12996, np.array([123.9392, 123.9392, 26.577, 38.811]) / PIXEL_MM)
ORIGIN = np.array([1_000_000.0, 112_400.0, 0.0])  # of a local frame: coordinates of 10⁶ m cost digits
CHECK_POINTS = (351, 410)


def rows_of(name: str) -> np.ndarray:
    """Numbers of a table, without its comments; labels are NaN."""
    return np.genfromtxt(FOLDER / name, delimiter=",", comments="#")


@dataclass(frozen=True)
class Measured:
    """Network with approximate cameras and points, σ of its observations, control points, and the points' names."""

    network: Network
    sigma_px: np.ndarray
    control: SurveyedPoints
    name: np.ndarray


def measured() -> Measured:
    parts = [rows_of("markpts.txt"), rows_of("smartpts.txt")]
    rows = np.concatenate(parts)
    sigma_px = np.repeat([0.5, 1.0], [len(part) for part in parts])
    name, point = np.unique(rows[:, 0].astype(int), return_inverse=True)
    image, xy = rows[:, 1].astype(int) - 1, rows[:, 2:]
    control = rows_of("sxb-control.txt")
    control = control[~np.isin(control[:, 0], CHECK_POINTS)]
    surveyed = SurveyedPoints(
        np.searchsorted(name, control[:, 0].astype(int)),
        control[:, 2:5] - ORIGIN,
        np.array([np.diag(sigma**2) for sigma in control[:, 5:8]]),
    )
    rotation, center = resected(surveyed, point, image, xy)
    positions = on_the_ground(rotation, center, point, image, xy, surveyed.position_in_world[:, 2].mean())
    positions[surveyed.point] = surveyed.position_in_world
    network = Network({1: CAMERA}, np.ones(5, dtype=int), rotation, center, positions, point, image, xy)
    return Measured(network, sigma_px, surveyed, name)


def resected(
    surveyed: SurveyedPoints, point: np.ndarray, image: np.ndarray, xy: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Approximate rotations and centres of the five cameras, each from the control points that it shows."""
    f, _, x0, y0 = CAMERA.params
    matrix, poses = np.array([[f, 0, x0], [0, f, y0], [0, 0, 1]]), []
    for camera in range(5):
        mine = np.flatnonzero((image == camera) & np.isin(point, surveyed.point))
        among = np.searchsorted(surveyed.point[np.argsort(surveyed.point)], point[mine])
        place = surveyed.position_in_world[np.argsort(surveyed.point)][among]
        found, turn, shift = cv2.solvePnP(place, xy[mine], matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        assert found
        rotation = cv2.Rodrigues(turn)[0]
        poses.append((rotation, -rotation.T @ shift[:, 0]))
    return np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])


def on_the_ground(
    rotation: np.ndarray, center: np.ndarray, point: np.ndarray, image: np.ndarray, xy: np.ndarray, height: float
) -> np.ndarray:
    """Approximate points: mean of their rays' hits on a horizontal plane."""
    f, _, x0, y0 = CAMERA.params
    ray = np.einsum("mji,mj->mi", rotation[image], np.column_stack([(xy - [x0, y0]) / f, np.ones(len(xy))]))
    hit = center[image] + (height - center[image, 2:]) / ray[:, 2:] * ray
    count = np.bincount(point)
    return np.column_stack([np.bincount(point, hit[:, axis]) / count for axis in range(3)])


@cache
def solved() -> tuple[Measured, AdjustedBundle]:
    given = measured()
    return given, adjust_bundle(given.network, given.sigma_px, given.control)


@dataclass(frozen=True)
class Published:
    """Figures of the report: of cameras (5, 6) as ω, φ, κ, X, Y, Z, of points as (x, y, z, σx, σy, σz) by name."""

    sigma0: float
    camera: np.ndarray
    camera_sigma: np.ndarray
    point: dict[int, np.ndarray]


@cache
def published() -> Published:
    text = (FOLDER / "report.txt").read_text(encoding="utf-8")
    cameras = text[text.index("Photograph Standard Deviations") : text.index("Quality")]
    value, sigma = (
        np.array(re.findall(rf"{word}: +(-?[\d.]+)", cameras), dtype=float).reshape(5, 6)
        for word in ("Value", "Deviation")
    )
    points = {}
    for section in text.split("Posterior")[1:]:
        for line in section[: section.index("Diff")].splitlines():
            if re.match(r" +\d+,", line):
                numbers = [float(part) for part in line.split(",")[:7]]
                points[int(numbers[0])] = np.array(numbers[1:])
    return Published(float(re.search(r"Sigma0: +([\d.]+)", text)[1]), value, sigma, points)


def cameras_of(found: AdjustedBundle) -> tuple[np.ndarray, np.ndarray]:
    """ω, φ, κ in degrees, X, Y, Z in metres (5, 6), and their σ a posteriori."""
    map_from_cam = np.swapaxes(found.network.cam_from_world, 1, 2)
    angles = omega_phi_kappa_deg(map_from_cam)
    turn, cov = omega_phi_kappa_jacobian(angles), found.camera_cov
    of_angles = np.einsum("nij,njk,nik->ni", turn, cov[:, :3, :3], turn)
    variance = np.column_stack([of_angles * np.degrees(1.0) ** 2, np.diagonal(cov[:, 3:, 3:], axis1=1, axis2=2)])
    return np.column_stack([angles, found.network.cam_center_in_world + ORIGIN]), found.sigma0 * np.sqrt(variance)


def points_of(found: AdjustedBundle) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, 3) and their σ a posteriori."""
    variance = np.diagonal(found.point_cov, axis1=1, axis2=2)
    return found.network.point_in_world + ORIGIN, found.sigma0 * np.sqrt(variance)


def test_sigma0_and_redundancy_are_those_published() -> None:
    _, found = solved()
    assert found.redundancy == 1261  # 2392 coordinates of marks and 42 of control points less 1173 unknowns
    assert found.sigma0 == pytest.approx(published().sigma0, rel=1e-3)


def test_cameras_are_those_published() -> None:
    # Half a pixel of the convention would move the cameras by 4 cm, and sigma0 by nothing: ours is theirs.
    value, sigma = cameras_of(solved()[1])
    np.testing.assert_allclose(value[:, :3], published().camera[:, :3], atol=2e-6)
    np.testing.assert_allclose(value[:, 3:], published().camera[:, 3:], atol=2e-4)
    ratio = sigma / published().camera_sigma
    for camera, rows in enumerate(zip(sigma, published().camera_sigma, ratio, strict=True), 1):
        for unknown, ours, theirs, quotient in zip(("ω", "φ", "κ", "X", "Y", "Z"), *rows, strict=True):
            print(f"| {camera} | {unknown} | {ours:.3g} | {theirs:.3g} | {quotient:.3f} |")
    np.testing.assert_allclose(ratio, 1.0, atol=5e-3)  # three digits are published


def test_points_are_those_published() -> None:
    given, found = solved()
    position, sigma = points_of(found)
    for name, row in published().point.items():
        place = np.searchsorted(given.name, name)
        np.testing.assert_allclose(position[place], row[:3], atol=6e-4)
        np.testing.assert_allclose(sigma[place], row[3:], rtol=5e-3)
    assert len(published().point) == 16
    total = np.linalg.norm(sigma, axis=1)
    extremes = (
        (total.min(), total.argmin(), 0.052, 422),
        (total.max(), total.argmax(), 0.64, 65265),
        (sigma[:, 0].max(), sigma[:, 0].argmax(), 0.18, 65265),
        (sigma[:, 1].max(), sigma[:, 1].argmax(), 0.095, 65297),
        (sigma[:, 2].max(), sigma[:, 2].argmax(), 0.61, 65561),
    )
    for value, place, theirs, name in extremes:
        assert value == pytest.approx(theirs, rel=0.02)  # two digits are published
        assert given.name[place] == name
