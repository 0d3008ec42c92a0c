"""How the camera sits in the body at each photograph: by the options, else by `/tf`."""

from __future__ import annotations

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.geometry.rig import Rig, frame_from_frd
from pipelines.ingest.bag.messages import BASE
from pipelines.ingest.bag.streams import BagStreams
from pipelines.ingest.bag.trajectories import BagNavigation
from pipelines.ingest.notes import Notes


def rig_at(time_s: FloatArray, navigation: BagNavigation, streams: BagStreams, given: Rig, notes: Notes) -> Rig:
    """Return mount and lever arm at times (N,): of the options, else of `/tf`; NaN where neither tells.

    Args:
        time_s: of the photographs, on the navigation's clock.
        navigation: whose attitudes name the body's frame.
        streams: the frames, and which of them the photographs and positions are of.
        given: rig of the options.
        notes: what was assumed, and what is missing.
    """
    mounts, arms = given.of_each(len(time_s))
    if not len(navigation.attitudes):
        notes.warn("no attitudes: only the photographs tell how the cameras were turned")
        return Rig(mounts, arms, given.nominal_from_cam)
    frames, body, from_frd = streams.transforms, navigation.body_frame, frame_from_frd(navigation.body_axes)
    if body not in frames and BASE in frames and navigation.body_axes == "flu":
        notes.assume(f"the frame {body!r} of the attitudes is not in /tf and is taken as {BASE}")
        body = BASE
    camera = frames.between(body, streams.image_frame, time_s)
    if body == streams.image_frame and navigation.body_axes != "optical":
        camera = None  # a driver that names the body's frame says nothing of the camera's axes
    if given.cam_from_body is None and camera is not None:
        mounts = np.swapaxes(camera[0], 1, 2) @ from_frd
        if "optical" not in streams.image_frame:
            notes.assume(f"the frame {streams.image_frame!r} of the images is optical: x right, y down, z forward")
    elif given.cam_from_body is None:
        notes.warn(
            f"/tf does not link the frames {streams.image_frame!r} of the camera and {body!r} of the attitudes: "
            "the cameras have no attitude; give --camera-mount YAW,PITCH,ROLL"
        )
    if given.antenna_in_body is None:
        antenna = frames.between(body, streams.positions.frame, time_s) if streams.positions else None
        if antenna is not None and camera is not None:
            arms = (antenna[1] - camera[1]) @ from_frd
        else:
            notes.assume("the lever arm is not known: positions are taken for those of the camera; see --lever-arm")
    return Rig(mounts, arms, given.nominal_from_cam)
