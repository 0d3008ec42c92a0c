"""From what the instruments measured to where the cameras were: lever arm and boresight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.pose_table import complete
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geometry.rig import Rig
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.ingest.image_poses import Measured
from pipelines.ingest.notes import Notes


def with_rig(measured: Measured, rig: Rig, names: Sequence[str], notes: Notes) -> Measured:
    """Positions of the antenna brought to the camera, attitudes of the nominal camera to the true one.

    Raises:
        InputError: a lever arm without the mount, whose axes it is given in.
    """
    known = complete(measured.quat_xyzw)
    enu_from_nominal = np.full((len(known), 3, 3), np.nan)
    enu_from_nominal[known] = matrix_from_quat_xyzw(measured.quat_xyzw[known])
    ecef = np.full((len(known), 3), np.nan)
    ecef[measured.located] = ecef_from_lla(measured.lla[measured.located])
    if rig.antenna_in_body is not None:
        if rig.cam_from_body is None:
            raise InputError(
                "is given in the body's axes: give --camera-mount YAW,PITCH,ROLL too", field="--lever-arm"
            )
        arm = np.tile(rig.antenna_in_body, (len(known), 1))
        ecef = camera_places(ecef, enu_from_nominal @ rig.cam_from_body, arm, names, notes)
    lla, quat = np.full(ecef.shape, np.nan), np.full((len(known), 4), np.nan)
    lla[complete(ecef)] = lla_from_ecef(ecef[complete(ecef)])
    quat[known] = quat_xyzw_from_matrix(enu_from_nominal[known] @ rig.nominal_from_cam)
    return replace(measured, lla=lla, quat_xyzw=quat)


def camera_places(
    antenna_in_ecef: FloatArray, enu_from_body: FloatArray, arm: FloatArray, names: Sequence[str], notes: Notes
) -> FloatArray:
    """Camera centres (N, 3) of antennas (N, 3) at lever arms (N, 3) in bodies (N, 3, 3); all Earth-centred metres.

    Where the lever arm is not known (NaN), the antenna stands for the camera. Where it is, but not the attitude,
    there is no position: it could be off by the arm in any direction.
    """
    found = antenna_in_ecef.copy()
    moved = complete(found) & complete(arm) & np.asarray(np.nan_to_num(arm).any(axis=1))
    turned = np.isfinite(enu_from_body).all(axis=(1, 2))
    lost = np.flatnonzero(moved & ~turned)
    notes.warn_counted(
        [names[row] for row in lost.tolist()],
        "position is without an attitude to apply the lever arm by, and was left out",
        "positions are without attitudes to apply the lever arm by, and were left out",
    )
    found[lost] = np.nan
    rows = moved & turned
    ecef_from_body = ecef_from_enu_rotation(lla_from_ecef(found[rows])) @ enu_from_body[rows]
    found[rows] -= np.einsum("nij,nj->ni", ecef_from_body, arm[rows])
    return found
