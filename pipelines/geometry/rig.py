"""How camera, antenna and body are put together: mount, boresight, lever arm.

The body is Forward-Right-Down. The mount is the planned rotation between body and camera; the boresight is the
small rotation from the true camera axes to those that the mount says.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.types import FloatArray
from pipelines.geometry.rotations import ENU_FROM_NED, exp_so3, geo_from_cam

FLU_FROM_FRD = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Rig:
    """Mount, lever arm and boresight of one camera, or mount and lever arm of each of N photographs.

    Attributes:
        cam_from_body: (3, 3) or (N, 3, 3) mount; None or NaN where nothing is known of it.
        antenna_in_body: (3,) or (N, 3) lever arm: metres from the camera's centre, forward-right-down; None or NaN
            where nothing is known of it.
        nominal_from_cam: (3, 3) boresight.
    """

    cam_from_body: FloatArray | None = None
    antenna_in_body: FloatArray | None = None
    nominal_from_cam: FloatArray = field(default_factory=lambda: np.eye(3))

    def of_each(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the mount (N, 3, 3) and the lever arm (N, 3) of each of N photographs, NaN where unknown."""
        mounts = np.nan if self.cam_from_body is None else self.cam_from_body
        arms = np.nan if self.antenna_in_body is None else self.antenna_in_body
        return np.broadcast_to(mounts, (count, 3, 3)).copy(), np.broadcast_to(arms, (count, 3)).copy()


def with_rig(antenna: FloatArray, frame_from_body: FloatArray, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Return camera centres (N, 3) and rotations frame ← camera (N, 3, 3), from the navigation of N photographs.

    Where the lever arm is not known, the antenna stands for the camera. A lever arm without an attitude gives no
    centre, because the arm could point anywhere; no mount or no attitude gives no rotation: both are NaN.

    Args:
        antenna: (N, 3) metres in any Cartesian frame, or in one for each photograph.
        frame_from_body: (N, 3, 3) attitudes of the body, forward-right-down, in that frame.
        rig: of the photographs.
    """
    mounts, arms = rig.of_each(len(antenna))
    arms = np.nan_to_num(arms)
    center, moved = antenna.copy(), arms.any(axis=1)
    center[moved] -= np.einsum("nij,nj->ni", frame_from_body[moved], arms[moved])
    return center, frame_from_body @ np.swapaxes(mounts, -1, -2) @ rig.nominal_from_cam


def mount(yaw_pitch_roll_deg: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) body → camera of yaw, pitch, roll (Z-Y-X) from the body's forward axis.

    (0, 0, 0) looks ahead, (0, −90, 0) straight down with the top of the image ahead.
    """
    return np.asarray(geo_from_cam(yaw_pitch_roll_deg).T @ ENU_FROM_NED)


def boresight(rotation_vector_deg: ArrayLike) -> FloatArray:
    """Return the rotation (3, 3) true → nominal camera axes of a rotation vector (3,) in degrees."""
    return exp_so3(np.radians(np.asarray(rotation_vector_deg, dtype=np.float64)))


def frame_from_frd(axes: str) -> FloatArray:
    """Return the rotation (3, 3) from forward-right-down into a frame's own axes: "frd", "flu" or "optical"."""
    if axes == "optical":
        return mount([0.0, 0.0, 0.0])
    return FLU_FROM_FRD.copy() if axes == "flu" else np.eye(3)
