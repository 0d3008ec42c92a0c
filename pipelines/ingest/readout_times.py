"""Rolling shutters: readout times of cameras, and the velocity at each photograph, from positions and times.

Readout times are measurements that OpenDroneMap collects (github.com/OpenDroneMap/RSCalibration, in its
`opendm/rollingshutter.py`); DJI's cameras with a mechanical shutter are not among them.
"""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from pipelines.core.types import FloatArray, vector3
from pipelines.geometry.trajectory import Trajectory
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.survey.survey import CameraPrior, SurveyImage

# Milliseconds by EXIF's model, in capitals.
_READOUT_MS = {
    "FC200": 74, "FC220": 64, "FC2103": 32, "FC300C": 33, "FC300S": 33, "FC300X": 33, "FC3170": 27, "FC330": 33,
    "FC3411": 32, "FC350": 30, "FC3582": 26, "FC7203": 25, "L1D-20C": 56, "XT701": 25, "E90": 44, "X-T2": 35,
}  # fmt: skip
_CROPPED_MS = {"FC7203": 19, "L1D-20C": 47}  # of photographs wider than 3:2, which have fewer rows
_HALF_WINDOW_S = 0.5  # of a recorded trajectory, for the velocity at a photograph
_LONGEST_GAP_S = 10.0  # between photographs: beyond, they do not tell the velocity between them


def with_readouts(
    cameras: Sequence[CameraPrior], options: IngestOptions, remarks: Remarks
) -> tuple[CameraPrior, ...]:
    """Return the cameras with their readout times: the option's, else the table's, else zero."""
    result = []
    for camera in cameras:
        model = camera.make_model.split()[-1].upper() if camera.make_model.strip() else ""
        wide = camera.width * 2 > camera.height * 3.05
        milliseconds = (_CROPPED_MS if wide and model in _CROPPED_MS else _READOUT_MS).get(model, 0)
        readout_s = milliseconds / 1000 if options.rolling_shutter is None else options.rolling_shutter
        if milliseconds and options.rolling_shutter is None:
            remarks.assume(
                "rolling-shutter",
                f"The rows of a photograph of {camera.make_model} are read in {milliseconds} ms, as OpenDroneMap "
                "has measured.",
                "State it with --rolling-shutter; 0 for a mechanical shutter.",
            )
        result.append(camera.model_copy(update={"readout_s": readout_s}))
    return tuple(result)


def with_velocities(
    images: Sequence[SurveyImage],
    cameras: Sequence[CameraPrior],
    track: Trajectory | None,
    options: IngestOptions,
    remarks: Remarks,
) -> tuple[SurveyImage, ...]:
    """Return the images with the velocity of each camera that has a rolling shutter.

    The `track` of positions in geo, on the navigation's clock, gives velocities; without one, a spline through the
    positions of the photographs.
    """
    rolling = {camera.camera_id for camera in cameras if camera.readout_s > 0}
    if not any(image.camera_id in rolling for image in images):
        return tuple(images)
    unknown = (np.nan, np.nan, np.nan)
    time_s = np.array([np.nan if image.timestamp_s is None else image.timestamp_s for image in images])
    if track is None:
        position = np.array([unknown if image.fix is None else image.fix.position_in_geo for image in images])
        velocity = _between_photographs(time_s, position)
    else:
        middle_s = time_s + options.time_offset_s
        ends = [track.at(middle_s + side * _HALF_WINDOW_S).position for side in (-1, 1)]
        velocity = (ends[1] - ends[0]) / (2 * _HALF_WINDOW_S)
    result, lost = [], []
    for image, moving in zip(images, velocity, strict=True):
        known = bool(np.isfinite(moving).all())
        if image.camera_id in rolling and not known:
            lost.append(image.name)
        wanted = known and image.camera_id in rolling
        result.append(image.model_copy(update={"velocity_in_geo": vector3(moving)}) if wanted else image)
    remarks.warn_counted(
        "velocity-unknown",
        lost,
        "Images of a rolling shutter have no velocity (positions and times before and after), and stay as they are",
    )
    return tuple(result)


def _between_photographs(time_s: FloatArray, position: FloatArray) -> FloatArray:
    """Return velocities (N, 3), NaN where unknown: slopes of a spline through photographs without a long gap."""
    velocity = np.full((len(time_s), 3), np.nan)
    known = np.flatnonzero(np.isfinite(time_s) & np.isfinite(position).all(axis=1))
    clock_s, first = np.unique(time_s[known], return_index=True)
    rows = known[first]
    for leg in np.split(np.arange(len(rows)), np.flatnonzero(np.diff(clock_s) > _LONGEST_GAP_S) + 1):
        if len(leg) > 1:
            spline = CubicSpline(clock_s[leg], position[rows[leg]], bc_type="natural")
            velocity[rows[leg]] = spline(clock_s[leg], 1)
    return velocity
