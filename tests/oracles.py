"""Slow plain references that the fast code is tested against."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.formats.splat_ply import SplatArrays
from pipelines.formats.spz import decode_spz
from pipelines.geometry.intersection import UncertainCameras


def read_spz(path: Path) -> SplatArrays:
    return decode_spz(path.read_bytes(), path)


def map_from_cam(omega_phi_kappa_deg: np.ndarray | list[float]) -> np.ndarray:
    """Rotations (..., 3, 3) camera → map axes of ω, φ, κ (..., 3) in degrees: inverts `omega_phi_kappa_deg`."""
    angles = np.asarray(omega_phi_kappa_deg, dtype=np.float64)
    turned = Rotation.from_euler("XYZ", angles.reshape(-1, 3), degrees=True).as_matrix()
    return turned.reshape(*angles.shape[:-1], 3, 3) @ np.diag([1.0, -1.0, -1.0])


def intersect_one(xy: np.ndarray, views: list[int], of: UncertainCameras) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and covariance (3, 3) of one point from its rays, without outliers.

    Each ray's error across itself comes from numerical derivatives of its direction by attitude and pixel.
    """
    centers, directions = [], []
    for ray, view in zip(xy, views, strict=True):
        centers.append(of.center_in_geo[view])
        directions.append(_direction(ray, of.rotation_geo_from_cam[view]))
    position = _weighted(centers, directions, [np.eye(3)] * len(xy))[0]
    covariance = np.zeros((3, 3))
    for _ in range(2):
        covs = []
        for ray, view in zip(xy, views, strict=True):
            distance = np.linalg.norm(position - of.center_in_geo[view])
            covs.append(of.cov_center_in_geo[view] + distance**2 * _direction_cov(ray, view, of))
        position, covariance = _weighted(centers, directions, covs)
    return position, covariance


def _direction(ray: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    direction = rotation @ np.array([*ray, 1.0])
    return direction / np.linalg.norm(direction)


def _direction_cov(ray: np.ndarray, view: int, of: UncertainCameras) -> np.ndarray:
    rotation, step = of.rotation_geo_from_cam[view], 1e-6
    columns = []
    for axis in np.eye(3):
        turned = Rotation.from_rotvec(step * axis).as_matrix() @ rotation
        columns.append((_direction(ray, turned) - _direction(ray, rotation)) / step * of.sigma_attitude_rad[view])
    for axis in np.eye(2):
        moved = _direction(ray + step * axis, rotation)
        columns.append((moved - _direction(ray, rotation)) / step * of.sigma_ray[view])
    jacobian = np.array(columns).T
    return jacobian @ jacobian.T


def _weighted(
    centers: list[np.ndarray], directions: list[np.ndarray], covs: list[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for center, direction, cov in zip(centers, directions, covs, strict=True):
        across = np.linalg.svd(direction[None])[2][1:]
        information = across.T @ np.linalg.inv(across @ cov @ across.T) @ across
        normal += information
        right += information @ center
    return np.linalg.solve(normal, right), np.linalg.inv(normal)
