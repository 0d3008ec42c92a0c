"""Adjusted cameras on Earth: positions, angles and σ in the terms of a survey."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.camera_table import CameraTable
from pipelines.geodesy.enu import geo_from_enu_at, lla_from_enu
from pipelines.geodesy.grid_axes import grid_from_enu
from pipelines.geometry.rotations import omega_phi_kappa_deg, omega_phi_kappa_jacobian, yaw_pitch_roll_deg
from pipelines.scene.target_crs import TargetCrs
from pipelines.scene.trained_survey import SolvedSurvey


@dataclass(frozen=True)
class CamerasOnEarth:
    """n adjusted cameras in the frame `geo`.

    Attributes:
        name, split: n each.
        geo_from_cam: (n, 3, 3) rotations.
        center_in_geo: (n, 3) metres.
        covariance: (n, 6, 6) of (δθ [rad], δc [m]) along the axes of `geo`; NaN: not known.
    """

    name: tuple[str, ...]
    split: tuple[str, ...]
    geo_from_cam: FloatArray
    center_in_geo: FloatArray
    covariance: FloatArray


def cameras_on_earth(solved: SolvedSurvey, covariance: FloatArray | None) -> CamerasOnEarth:
    """Return the adjusted cameras on Earth.

    Args:
        solved: the survey.
        covariance: (n, 6, 6) as in `CamerasOnEarth`; None: not known.
    """
    cameras, poses, similarity = solved.model.cameras, solved.poses, solved.geo_from_model
    return CamerasOnEarth(
        name=tuple(camera.name for camera in cameras),
        split=tuple(camera.split for camera in cameras),
        geo_from_cam=similarity.rotation @ np.swapaxes(poses.cam_from_model, 1, 2),
        center_in_geo=similarity.apply(poses.cam_center_in_model),
        covariance=np.full((len(cameras), 6, 6), np.nan) if covariance is None else covariance,
    )


def camera_table(cameras: CamerasOnEarth, crs: TargetCrs) -> CameraTable:
    """Return the table of cameras in a CRS.

    ω, φ, κ count from the axes of the CRS at each camera: grid east, grid north, up along the ellipsoid's normal.
    In a CRS without a grid they count from true east and north, as do yaw, pitch, roll and the σ of the position.

    Raises:
        InputError: a camera lies outside the domain of the CRS, or its axes are left-handed.
    """
    lla = lla_from_enu(cameras.center_in_geo, crs.origin)
    enu_from_geo = np.swapaxes(geo_from_enu_at(lla, crs.origin), 1, 2)
    map_from_geo = grid_from_enu(crs.crs, lla) @ enu_from_geo
    angles = omega_phi_kappa_deg(map_from_geo @ cameras.geo_from_cam)
    by_turn = omega_phi_kappa_jacobian(angles) @ map_from_geo
    return CameraTable(
        name=cameras.name,
        split=cameras.split,
        position=crs.xyz_from_geo(cameras.center_in_geo),
        geographic=crs.crs.is_geographic,
        omega_phi_kappa_deg=angles,
        yaw_pitch_roll_deg=yaw_pitch_roll_deg(enu_from_geo @ cameras.geo_from_cam),
        sigma_enu_m=_sigma(enu_from_geo, cameras.covariance[:, 3:, 3:]),
        sigma_angles_deg=np.degrees(_sigma(by_turn, cameras.covariance[:, :3, :3])),
    )


def _sigma(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return σ (n, 3) of quantities with derivatives (n, 3, 3) by others that have covariances (n, 3, 3)."""
    propagated = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    return np.asarray(np.sqrt(np.diagonal(propagated, axis1=1, axis2=2)))
