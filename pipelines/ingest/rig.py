"""From the places and attitudes that the instruments measured to those of the cameras: lever arm and boresight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.pose_table import complete
from pipelines.geodesy.enu import ecef_from_enu_rotation, lla_from_ecef
from pipelines.geometry.rig import Rig, boresight, mount, with_rig
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions


def given_rig(options: IngestOptions) -> Rig:
    """Return the rig that the options state."""
    return Rig(
        cam_from_body=None if options.camera_mount is None else mount(options.camera_mount),
        antenna_in_body=None if options.lever_arm is None else np.array(options.lever_arm),
        nominal_from_cam=boresight(options.boresight),
    )


def body_mount(rig: Rig) -> FloatArray:
    """Return the mount (3, 3); where none is stated, the camera's nominal axes stand for the body's."""
    return np.eye(3) if rig.cam_from_body is None else rig.cam_from_body


def at_cameras(poses: ImagePoses, rig: Rig, names: Sequence[str], notes: Notes) -> ImagePoses:
    """Bring positions of the antenna to the camera, and attitudes of the nominal camera to the true one.

    Raises:
        InputError: a lever arm without the mount, whose axes it is given in.
    """
    if rig.antenna_in_body is not None and rig.cam_from_body is None:
        raise InputError("is given in the body's axes: give --camera-mount YAW,PITCH,ROLL too", field="--lever-arm")
    mounted = replace(rig, cam_from_body=body_mount(rig))
    enu_from_body = poses.enu_from_cam @ body_mount(rig)
    position_in_ecef, enu_from_cam = camera_poses(poses.position_in_ecef, enu_from_body, mounted, names, notes)
    return replace(poses, position_in_ecef=position_in_ecef, enu_from_cam=enu_from_cam)


def camera_poses(
    antenna_in_ecef: FloatArray, enu_from_body: FloatArray, rig: Rig, names: Sequence[str], notes: Notes
) -> tuple[FloatArray, FloatArray]:
    """Return camera centres in ECEF (N, 3) and attitudes camera → East-North-Up (N, 3, 3), NaN where unknown.

    A position that a lever arm would move, but without an attitude to move it by, is left out and noted.

    Args:
        antenna_in_ecef: (N, 3) metres.
        enu_from_body: (N, 3, 3) attitudes against north and up at the antenna.
        rig: of the photographs.
        names: of the photographs, for the note.
        notes: positions that were left out.
    """
    # With the antenna at zero, its own East-North-Up is a Cartesian frame that needs no place on Earth.
    offset_in_enu, enu_from_cam = with_rig(np.zeros_like(antenna_in_ecef), enu_from_body, rig)
    located = complete(antenna_in_ecef)
    lost = np.flatnonzero(located & ~complete(offset_in_enu))
    notes.warn_counted(
        [names[row] for row in lost.tolist()],
        "position is without an attitude to apply the lever arm by, and was left out",
        "positions are without attitudes to apply the lever arm by, and were left out",
    )
    ecef_from_enu = ecef_from_enu_rotation(lla_from_ecef(antenna_in_ecef[located]))
    position_in_ecef = antenna_in_ecef.copy()
    position_in_ecef[located] += np.einsum("nij,nj->ni", ecef_from_enu, offset_in_enu[located])
    return position_in_ecef, enu_from_cam
