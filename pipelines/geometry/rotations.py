"""Rotations: quaternions, matrices, exponential map, the gimbal's yaw, pitch, roll, and photogrammetry's ω, φ, κ.

All functions are batched over leading dimensions and work in float64. Quaternions carry their order in the name.
"""

import warnings

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from pipelines.core.types import FloatArray

# Columns: the gimbal's forward, right and down axes seen from a camera (x right, y down, z forward).
_CAM_FROM_GIMBAL: FloatArray = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
# A camera's right, down and forward axes seen from the aircraft (forward, right, down) below which it looks down.
_MOUNT_FROM_CAM: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
# Photogrammetry's image axes (x right, y up, z backward) seen from a camera.
_CAM_FROM_PHOTO = np.diag([1.0, -1.0, -1.0])
# Also the attitude in East-North-Up of a body (forward, right, down) that is level and heads north.
ENU_FROM_NED: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_LOCKED = 1e-9  # cosine of φ below which ω and κ turn about the same axis


def matrix_from_quat_xyzw(quat_xyzw: ArrayLike) -> FloatArray:
    """Return rotation matrices (…, 3, 3) of quaternions (…, 4), which need not be of unit length."""
    quat = np.asarray(quat_xyzw, dtype=np.float64)
    return np.asarray(Rotation.from_quat(quat.reshape(-1, 4)).as_matrix()).reshape(*quat.shape[:-1], 3, 3)


def quat_xyzw_from_matrix(rotation: ArrayLike) -> FloatArray:
    """Return unit quaternions (…, 4) with w ≥ 0 of rotation matrices (…, 3, 3)."""
    matrix = np.asarray(rotation, dtype=np.float64)
    quat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(quat).reshape(*matrix.shape[:-2], 4)


def exp_so3(rotation_vector: ArrayLike) -> FloatArray:
    """Return rotation matrices (…, 3, 3) of rotation vectors (…, 3) in radians."""
    vector = np.asarray(rotation_vector, dtype=np.float64)
    return np.asarray(Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()).reshape(*vector.shape[:-1], 3, 3)


def log_so3(rotation: ArrayLike) -> FloatArray:
    """Return rotation vectors (…, 3) in radians, of length ≤ π, of rotation matrices (…, 3, 3)."""
    matrix = np.asarray(rotation, dtype=np.float64)
    return np.asarray(Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec()).reshape(matrix.shape[:-1])


def right_jacobian_inverse_so3(rotation_vector: ArrayLike) -> FloatArray:
    """Return the derivatives (…, 3, 3) of log(exp(φ) exp(δ)) by δ at zero, of rotation vectors φ (…, 3), |φ| < π.

    I + ½ [φ]× + (1/θ² − (1 + cos θ) / (2 θ sin θ)) [φ]×² (Chirikjian, Stochastic Models II, 2012, eq. 10.86).
    """
    vector = np.asarray(rotation_vector, dtype=np.float64)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    safe = np.where(angle < 1e-4, 1.0, angle)
    quadratic = 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe))
    cross = skew(vector)
    # Its Taylor series at zero begins with 1/12.
    return np.eye(3) + 0.5 * cross + np.where(angle < 1e-4, 1.0 / 12.0, quadratic) * (cross @ cross)


def rotation_towards(direction: ArrayLike) -> FloatArray:
    """Return a rotation (3, 3) cam ← frame of a camera that looks along a unit vector (3,); any roll."""
    z = np.asarray(direction, dtype=np.float64)
    least = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(least, z) / np.linalg.norm(np.cross(least, z))
    return np.stack([x, np.cross(z, x), z])


def skew(vector: ArrayLike) -> FloatArray:
    """Return cross-product matrices (…, 3, 3): `skew(a) @ b = a × b`."""
    v = np.asarray(vector, dtype=np.float64)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def geo_from_cam(yaw_pitch_roll_deg: ArrayLike) -> FloatArray:
    """Return rotations (…, 3, 3) camera → East-North-Up of gimbal angles (…, 3) in degrees.

    The angles turn North-East-Down into the gimbal's forward-right-down axes, in the order Z-Y-X (yaw, pitch,
    roll). Pitch −90 looks straight down; the camera looks along the gimbal's forward axis.
    """
    angles = np.asarray(yaw_pitch_roll_deg, dtype=np.float64)
    turned = np.asarray(Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True).as_matrix())
    return np.asarray(ENU_FROM_NED @ turned.reshape(*angles.shape[:-1], 3, 3) @ _CAM_FROM_GIMBAL.T)


def geo_from_mounted_cam(yaw_pitch_roll_deg: ArrayLike) -> FloatArray:
    """Return rotations (…, 3, 3) camera → East-North-Up of the angles (…, 3) in degrees of what it is mounted on.

    The angles turn North-East-Down into forward, right, down of an aircraft, in the order Z-Y-X. The camera looks
    down, the upper edge of its image is forward: with pitch 90 it looks at the horizon (PIX4D's yaw, pitch, roll).
    """
    angles = np.asarray(yaw_pitch_roll_deg, dtype=np.float64)
    turned = np.asarray(Rotation.from_euler("ZYX", angles.reshape(-1, 3), degrees=True).as_matrix())
    return np.asarray(ENU_FROM_NED @ turned.reshape(*angles.shape[:-1], 3, 3) @ _MOUNT_FROM_CAM)


def yaw_pitch_roll_deg(geo_from_cam_rotation: ArrayLike) -> FloatArray:
    """Return gimbal angles (…, 3) in degrees of rotations (…, 3, 3) camera → East-North-Up: inverts `geo_from_cam`.

    For a camera that looks straight down or up, yaw and roll turn about the same axis: roll is then zero.
    """
    return _angles_deg("ZYX", ENU_FROM_NED.T @ np.asarray(geo_from_cam_rotation, np.float64) @ _CAM_FROM_GIMBAL)


def omega_phi_kappa_deg(map_from_cam_rotation: ArrayLike) -> FloatArray:
    """Return photogrammetric angles ω, φ, κ (…, 3) in degrees of rotations (…, 3, 3) camera → map axes.

    R_x(ω) R_y(φ) R_z(κ) turns image axes (x right, y up, z backward) into map axes (east, north, up). With
    ω = φ = κ = 0 a camera looks straight down, and the upper edge of its image faces north (Bäumker and Heimes
    2001, New calibration and computing method for direct georeferencing; PIX4D has the same angles).
    ω and κ lie within ±180°, φ within ±90°. With φ = ±90°, ω and κ turn about the same axis: κ is then zero.
    """
    return _angles_deg("XYZ", np.asarray(map_from_cam_rotation, np.float64) @ _CAM_FROM_PHOTO)


def map_from_cam(omega_phi_kappa_deg: ArrayLike) -> FloatArray:
    """Return rotations (…, 3, 3) camera → map axes of ω, φ, κ (…, 3) in degrees: inverts `omega_phi_kappa_deg`."""
    angles = np.asarray(omega_phi_kappa_deg, dtype=np.float64)
    turned = np.asarray(Rotation.from_euler("XYZ", angles.reshape(-1, 3), degrees=True).as_matrix())
    return np.asarray(turned.reshape(*angles.shape[:-1], 3, 3) @ _CAM_FROM_PHOTO.T)


def _angles_deg(order: str, rotation: FloatArray) -> FloatArray:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        angles = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_euler(order, degrees=True)
    return np.asarray(angles).reshape(*rotation.shape[:-2], 3)


def omega_phi_kappa_jacobian(omega_phi_kappa_deg: ArrayLike) -> FloatArray:
    """Return derivatives (…, 3, 3) of ω, φ, κ (…, 3) in degrees by a small rotation δθ about the map axes.

    R' = Exp(δθ) R. Changes of the angles and δθ are in the same unit; NaN at φ = ±90°.
    """
    omega, phi, _ = np.moveaxis(np.radians(np.asarray(omega_phi_kappa_deg, dtype=np.float64)), -1, 0)
    # The axes of the three turns in map axes: x; then y, turned by ω; then z, turned by ω and φ.
    axes = np.zeros((*omega.shape, 3, 3))
    axes[..., 0, 0] = 1.0
    axes[..., 1, 1], axes[..., 2, 1] = np.cos(omega), np.sin(omega)
    axes[..., 0, 2] = np.sin(phi)
    axes[..., 1, 2], axes[..., 2, 2] = -np.sin(omega) * np.cos(phi), np.cos(omega) * np.cos(phi)
    locked = np.abs(np.cos(phi)) < _LOCKED
    axes[locked] = np.eye(3)
    jacobian = np.linalg.inv(axes)
    jacobian[locked] = np.nan
    return np.asarray(jacobian)
