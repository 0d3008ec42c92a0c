"""One survey in one frame out of everything that was read, and what is assumed and doubtful about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import Origin, ecef_from_lla, lla_from_ecef, median_lla
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.ingest.fix_sessions import fix_sessions
from pipelines.ingest.flight_record import LEAST_IMAGES, FlightRecord
from pipelines.ingest.ground_points import GroundFile, GroundPoint, require_near, split_checks
from pipelines.ingest.image_poses import ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.survey_records import held_out, image_records, point_records, unmarked_records
from pipelines.scene.calibrated import FIX_RANGE_M
from pipelines.scene.navigation import NavigationTrack, require_estimable
from pipelines.scene.survey import Survey


@dataclass(frozen=True)
class SurveyInputs:
    """Everything that was read for a survey; the files of ground points may be absent."""

    flight: FlightRecord
    control: GroundFile | None
    check: GroundFile | None


def assemble_survey(
    inputs: SurveyInputs, options: IngestOptions, notes: Notes
) -> tuple[Survey, NavigationTrack | None]:
    """Return the survey, and the navigation in the same frame where it was recorded by time.

    The origin is the median of the image positions (of the control points if there are none), rounded to 10⁻⁵
    degrees and a metre. Every `test_every`-th image by name is held out, beginning with the first.

    Raises:
        InputError: nothing has a position, points that are nowhere near the images or of both kinds, or a rig to
            estimate without the navigation for it.
    """
    flight = replace(inputs.flight, poses=_without_far_fixes(inputs.flight, notes))
    poses, files = flight.poses, [file for file in (inputs.control, inputs.check) if file is not None]
    points = split_checks(inputs.control, inputs.check, options.check)
    points.require_checks(options.vegetated)
    control, check = points.control, points.check
    points.note_unmarked(notes)
    located = bool(poses.located.any())
    if located:
        middle_in_ecef = ecef_from_lla(median_lla(poses.located_lla))
        for file in files:
            require_near(file, middle_in_ecef)
    origin = _origin(poses, control)
    _note_coverage(flight, len(control), notes)
    if options.test_every and not held_out(len(flight.photos), options.test_every):
        notes.warn(f"{len(flight.photos)} images are too few to hold any out for testing")
    track = None if flight.navigation is None else flight.navigation.in_geo(origin)
    if options.estimated:
        require_estimable(track, options.estimated, "--estimate" if options.estimate else "--time-offset")
    sessions, session_of = fix_sessions(poses, options, notes)
    survey = Survey(
        origin=origin,
        source_crs=poses.crs_name if located or inputs.control is None else inputs.control.crs_name,
        vertical=_vertical(poses, files, notes),
        image_dir=str(flight.folder),
        cameras=flight.cameras,
        images=image_records(flight, session_of, origin, options),
        sessions=sessions,
        control_points=point_records(control, origin, options),
        check_points=point_records(check, origin, options),
        unmarked_points=unmarked_records(points.unmarked, origin, options),
        assumptions=tuple(notes.assumptions),
        warnings=tuple(notes.warnings),
        cautions=tuple(notes.cautions),
        estimate=options.estimated,
        default_sigmas=_default_sigmas(poses, control, options),
    )
    return survey, track


def _default_sigmas(
    poses: ImagePoses, control: Sequence[GroundPoint], options: IngestOptions
) -> tuple[Literal["fixes", "control points", "marks", "attitudes"], ...]:
    """Return the groups of measurements whose σ neither a file nor an option states."""
    stated = options.model_fields_set
    points_stated = {"sigma_gcp_h", "sigma_gcp_v"} <= stated or (
        bool(control) and all(point.sigma_h_m and point.sigma_v_m for point in control)
    )
    attitudes = np.isfinite(poses.enu_from_cam).all(axis=(1, 2)).any() and options.sigma_attitude is None
    groups: list[tuple[bool, Literal["fixes", "control points", "marks", "attitudes"]]] = [
        ("default" in poses.sigma_source, "fixes"),
        (not points_stated, "control points"),
        ("sigma_mark" not in stated, "marks"),
        (bool(attitudes) and not np.isfinite(poses.sigma_attitude_deg).any(), "attitudes"),
    ]
    return tuple(group for is_default, group in groups if is_default)


def _without_far_fixes(flight: FlightRecord, notes: Notes) -> ImagePoses:
    poses = flight.poses
    if not poses.located.any():
        return poses
    middle_in_ecef = ecef_from_lla(median_lla(poses.located_lla))
    distance_m = np.linalg.norm(poses.position_in_ecef - middle_in_ecef, axis=1)
    far = distance_m > FIX_RANGE_M
    notes.warn_counted(
        [f"{flight.photos[row].name} ({distance_m[row] / 1000:.0f} km)" for row in np.flatnonzero(far).tolist()],
        "position is far from the others and was left out",
        "positions are far from the others and were left out",
    )
    return replace(poses, position_in_ecef=np.where(far[:, None], np.nan, poses.position_in_ecef))


def _origin(poses: ImagePoses, control: Sequence[GroundPoint]) -> Origin:
    places = poses.located_lla
    if not len(places) and control:
        places = lla_from_ecef([point.position_in_ecef for point in control])
    if not len(places):
        raise nowhere()
    lat, lon, alt = median_lla(places)
    return Origin(lat_deg=round(float(lat), 5), lon_deg=round(float(lon), 5), alt_m=round(float(alt)))


def nowhere() -> InputError:
    """Return the error of a survey that nothing places on Earth."""
    return InputError(
        "no image has a position, and there are no ground control points: give --trajectory, --geo or --gcp"
    )


def _note_coverage(flight: FlightRecord, points: int, notes: Notes) -> None:
    located = flight.poses.located
    if flight.poses.source == "exif":
        names = [flight.photos[row].name for row in np.flatnonzero(~located).tolist()]
        notes.warn_counted(names, "image has no position in EXIF", "images have no position in EXIF")
    if not located.any():
        notes.warn(f"no image has a position: {points} ground control points alone place the model")
    elif located.sum() < LEAST_IMAGES and points < LEAST_IMAGES:
        notes.warn(
            f"only {int(located.sum())} positions and {points} control points: three of a kind place a model"
        )


def _vertical(poses: ImagePoses, files: Sequence[GroundFile], notes: Notes) -> VerticalDatum:
    """Return the datum of the image positions, or of the control points if there are none; note all assumptions."""
    datums = {"the images": poses.vertical} if poses.located.any() else {}
    datums |= {file.path.name: file.vertical for file in files}
    for place, datum in datums.items():
        if not datum.stated:
            notes.assume(f"heights of {place} are {datum.name}: {datum.note}")
    stated = [place for place, datum in datums.items() if datum.stated]
    assumed = [place for place, datum in datums.items() if not datum.stated]
    if stated and assumed:
        notes.warn(
            f"the vertical datum of {', '.join(stated)} is stated, that of {', '.join(assumed)} only assumed: they "
            "may differ by a geoid's height, up to 100 m; see --vertical"
        )
    return next(iter(datums.values()))
