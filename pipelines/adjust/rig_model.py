"""Equations of a calibration, with their derivatives: cameras by the navigation equal cameras by SfM.

With the antenna p and the body A as recorded, the mount M, camera centres c and rotations C in local, the
similarity geo ← local (s, R, t), the time offset δ, the boresight B and the lever arm l:

    position:  p(t + δ) − A(t + δ) l = s R c + t
    attitude:  A(t + δ) M B = R C
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pipelines.core.types import BoolArray, FloatArray
from pipelines.geometry.rotations import log_so3, right_jacobian_inverse_so3
from pipelines.geometry.similarity import Similarity, jacobian_at
from pipelines.geometry.trajectory import Trajectory

# Columns of the parameters: similarity (ln s, rotation, translation), offset in s, boresight in rad, arm in m.
SIMILARITY, ROTATION = slice(0, 7), slice(1, 4)
OFFSET, BORESIGHT, ARM = slice(7, 8), slice(8, 11), slice(11, 14)
# Time on either side of an image over which velocities are measured: between neighbouring fixes noise dominates.
DIFFERENCE_S = 0.5


@dataclass(frozen=True)
class RigData:
    """Cameras of n images by navigation and by SfM, and c control points.

    Attributes:
        positions: trajectory of the antenna in geo, on the navigation's clock.
        attitudes: rotations of the body in geo, on the same clock; at most one sample if none were recorded.
        time_s: (n,) camera clock.
        center_in_local: (n, 3) projection centres of SfM.
        cam_from_local: (n, 3, 3) rotations of SfM.
        cam_from_body: (n, 3, 3) mount, NaN where unknown.
        antenna_in_body: (n, 3) lever arm to start from, metres.
        control_in_local: (c, 3) control points, intersected from their marks.
        control_in_geo: (c, 3) control points as surveyed, metres.
        control_cov_in_local: (c, 3, 3) covariances of the intersections.
        control_cov_in_geo: (c, 3, 3) covariances of the survey, m².
        pixel_rad: angle of a pixel.
        footprint_in_local: width of a pixel at the distance of the scene.
    """

    positions: Trajectory
    attitudes: Trajectory
    time_s: FloatArray
    center_in_local: FloatArray
    cam_from_local: FloatArray
    cam_from_body: FloatArray
    antenna_in_body: FloatArray
    control_in_local: FloatArray
    control_in_geo: FloatArray
    control_cov_in_local: FloatArray
    control_cov_in_geo: FloatArray
    pixel_rad: float
    footprint_in_local: float

    @property
    def has_attitudes(self) -> bool:
        """Whether attitudes were recorded."""
        return len(self.attitudes) > 1


@dataclass(frozen=True)
class RigState:
    """Values of the unknowns.

    Attributes:
        geo_from_local: the similarity.
        offset_s: navigation clock minus camera clock.
        boresight: (3, 3) nominal ← true camera.
        arm: (3,) metres, added to `RigData.antenna_in_body`.
    """

    geo_from_local: Similarity
    offset_s: float
    boresight: FloatArray
    arm: FloatArray


def usable_images(data: RigData, offset_s: float) -> BoolArray:
    """Return the mask (n,) of the images that the navigation covers, with a margin for differentiation by time."""
    usable = np.ones(len(data.time_s), dtype=bool)
    for recorded in [data.positions, data.attitudes] if data.has_attitudes else [data.positions]:
        for shift in (-DIFFERENCE_S, 0.0, DIFFERENCE_S):
            usable &= recorded.covers(data.time_s + offset_s + shift)
    return usable


def cameras_by_navigation(
    data: RigData, offset_s: float, arm: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return the used cameras by the navigation: centres (k, 3) in geo, and rotations geo ← body (k, 3, 3).

    Args:
        data: navigation and rig.
        offset_s: navigation clock minus camera clock.
        arm: (3,) metres, added to the lever arm of `data`.
        used: (n,) mask of k images.

    Returns:
        Without attitudes, the antenna's positions, and no rotations (0, 3, 3).
    """
    time_s = data.time_s[used] + offset_s
    place = data.positions.at(time_s).position
    if not data.has_attitudes:
        return place, np.empty((0, 3, 3))
    bodies = data.attitudes.at(time_s).rotation
    return place - np.einsum("nij,nj->ni", bodies, data.antenna_in_body[used] + arm), bodies


def residuals_of(data: RigData, state: RigState, used: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals of positions (k, 3) in metres, and of attitudes (j, 3) in radians, axes of the camera.

    Args:
        data: cameras and navigation.
        state: values of the unknowns.
        used: (n,) mask of k images; j of them have a mount.
    """
    place, bodies = cameras_by_navigation(data, state.offset_s, state.arm, used)
    position = place - state.geo_from_local.apply(data.center_in_local[used])
    if not len(bodies):
        return position, np.empty((0, 3))
    known = has_mount(data, used)
    by_navigation = rotations_by_navigation(data, state, bodies, used)
    by_sfm = state.geo_from_local.rotation @ np.swapaxes(data.cam_from_local[used][known], 1, 2)
    return position, log_so3(np.swapaxes(by_sfm, 1, 2) @ by_navigation)


def has_mount(data: RigData, used: BoolArray) -> BoolArray:
    """Return the mask (k,) of the used images whose mount is known."""
    return np.asarray(np.isfinite(data.cam_from_body[used]).all(axis=(1, 2)))


def rotations_by_navigation(data: RigData, state: RigState, bodies: FloatArray, used: BoolArray) -> FloatArray:
    """Return the rotations geo ← cam (j, 3, 3) by the navigation, of the used images with a mount.

    Args:
        data: has the mounts.
        state: has the boresight.
        bodies: (k, 3, 3) rotations geo ← body of the used images.
        used: (n,) mask of k images.
    """
    known = has_mount(data, used)
    return np.asarray(bodies[known] @ np.swapaxes(data.cam_from_body[used][known], 1, 2) @ state.boresight)


def derivatives_of(
    data: RigData, state: RigState, used: BoolArray, pivot: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of `residuals_of` by the parameters: positions (k, 3, 14) and attitudes (j, 3, 14).

    The derivatives by the time offset are central differences over `DIFFERENCE_S` on either side. All others are
    analytic.

    Args:
        data: cameras and navigation.
        state: values of the unknowns.
        used: (n,) mask of k images; j of them have a mount.
        pivot: (3,) in geo, of the similarity's parameters.
    """
    mapped = state.geo_from_local.apply(data.center_in_local[used])
    _, bodies = cameras_by_navigation(data, state.offset_s, state.arm, used)
    ahead, behind = (
        residuals_of(data, replace(state, offset_s=state.offset_s + shift), used)
        for shift in (DIFFERENCE_S, -DIFFERENCE_S)
    )
    by_position = np.zeros((len(mapped), 3, 14))
    by_position[:, :, SIMILARITY] = -jacobian_at(mapped, pivot)
    by_position[:, :, OFFSET] = ((ahead[0] - behind[0]) / (2 * DIFFERENCE_S))[..., None]
    if not len(bodies):
        return by_position, np.zeros((0, 3, 14))
    by_position[:, :, ARM] = -bodies
    _, attitude = residuals_of(data, state, used)
    turned = right_jacobian_inverse_so3(attitude)
    by_attitude = np.zeros((len(attitude), 3, 14))
    by_attitude[:, :, ROTATION] = -turned @ np.swapaxes(rotations_by_navigation(data, state, bodies, used), 1, 2)
    by_attitude[:, :, BORESIGHT] = turned
    by_attitude[:, :, OFFSET] = ((ahead[1] - behind[1]) / (2 * DIFFERENCE_S))[..., None]
    return by_position, by_attitude
