"""Survey in the frame `geo` from all inputs that `ingest` has read, with its assumptions and warnings.

Images and surveyed points get their positions, attitudes and covariances in geo. Fixes that share one error, of a
base station, a receiver or a day, form a session, with the σ of that error.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, IntArray, Matrix3, vector3
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy import crs, enu
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import quat_xyzw_from_matrix
from pipelines.ingest import flight_record
from pipelines.ingest.ground_points import GroundFile, GroundPoint, require_near, split_checks, unmarked_points
from pipelines.ingest.height_checks import SIGMA_DATUM_M, height_doubts, known_ground
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.readout_times import with_readouts, with_velocities
from pipelines.ingest.remarks import Remarks, add
from pipelines.survey.navigation import FIX_RANGE_M, NavigationTrack, shown_by
from pipelines.survey.survey import (
    LOCAL_FRAME,
    Attitude,
    Companion,
    Fix,
    FixSession,
    KnownDistance,
    Original,
    RigParameter,
    Survey,
    SurveyedPoint,
    SurveyImage,
    UnmarkedPoint,
    in_usual_order,
)

SIGMA_GIMBAL_DEG = 2.0
SIGMA_TABLE_ATTITUDE_DEG = 1.0
# Gap in time after which the base station may stand elsewhere, and the satellites do.
SESSION_GAP_S = 4 * 3600.0

_LOCAL_CAUTION = (
    "The result is in a local metric frame and has no place on Earth: no image has a position, and there are no "
    "control points. Known distances ({count}) set its scale; its vertical and heading are assumed."
)

SigmaGroup = Literal["fixes", "control points", "marks", "attitudes"]


def assemble_survey(
    flight: flight_record.FlightRecord,
    control: GroundFile | None,
    check: GroundFile | None,
    options: IngestOptions,
    remarks: Remarks,
    *,
    distances: tuple[KnownDistance, ...] = (),
) -> tuple[Survey, NavigationTrack | None]:
    """Return the survey, and the navigation in the same frame where it was recorded by time.

    The origin is the median of the image positions (of the control points if there are none), rounded to 10⁻⁵
    degrees and a metre. Without both, known distances make a survey in a local metric frame. Every `test_every`-th
    image by name is held out, beginning with the first.

    Raises:
        InputError: nothing has a position, and no distance is known; points that are nowhere near the images or of
            both kinds, or a rig to estimate without the navigation for it.
    """
    flight = replace(flight, poses=_without_far_fixes(flight, remarks))
    poses, files = flight.poses, [file for file in (control, check) if file is not None]
    controls, checks = split_checks(control, check, options.check)
    _require_checks(checks, options.vegetated)
    marked, marked_checks = ([point for point in points if point.is_marked] for points in (controls, checks))
    unmarked = unmarked_points(controls, checks, remarks)
    _require_near(files, poses)
    control_distances = sum(distance.use == "control" for distance in distances)
    if poses.located.any() or files or not control_distances:
        require_placed(bool(poses.located.any()) or bool(marked), flight.photos, controls)
        origin = _origin(poses, marked)
        _note_coverage(flight, len(marked), remarks)
    else:
        origin = None
        remarks.caution(LOCAL_FRAME, _LOCAL_CAUTION.format(count=control_distances))
    if options.test_every and not _held_out(len(flight.photos), options.test_every):
        remarks.warn("no-test-images", f"{len(flight.photos)} images are too few to hold any out for testing.")
    track = (
        None
        if flight.navigation is None or origin is None
        else flight_record.track_in_geo(flight.navigation, origin)
    )
    estimated = _to_estimate(options, poses, track)
    doubts = height_doubts(flight, known_ground(files, options.ground_height, options.vertical, flight))
    for doubt in doubts:
        add(remarks.cautions, doubt.remark)
    sigma_zero_m = max((doubt.sigma_m for doubt in doubts), default=0.0)
    sessions, session_of = fix_sessions(poses, options, remarks, sigma_zero_m=sigma_zero_m)
    of_control_m = _sigma_of_transformation(remarks, "control points")
    cameras = with_readouts(flight.cameras, options, remarks)
    images = _images(flight, session_of, origin, options, sigma_zero_m)
    survey = Survey(
        origin=origin,
        transformations=tuple(remarks.transformations),
        sigma_datum_m=(of_control_m, of_control_m, 0.0),
        source_crs=_source_crs(poses, control) if origin is not None else crs.LOCAL_FRAME,
        vertical=crs.local_frame().vertical if origin is None else _vertical(poses, files, remarks),
        image_dir=str(flight.folder),
        cameras=cameras,
        companions=_companions(flight),
        original_dir=None if flight.original_folder is None else str(flight.original_folder),
        originals=tuple(Original(name=name, sha256=sha256) for name, sha256 in flight.originals.items()),
        images=with_velocities(images, cameras, None if track is None else track.positions, options, remarks),
        sessions=sessions,
        control_points=_surveyed(marked, origin, options),
        check_points=_surveyed(marked_checks, origin, options),
        unmarked_points=tuple(
            UnmarkedPoint(**record.model_dump(), use=use)
            for use, points in unmarked.items()
            for record in _surveyed(points, origin, options)
        ),
        distances=distances,
        assumptions=tuple(remarks.assumptions),
        warnings=tuple(remarks.warnings),
        cautions=tuple(remarks.cautions),
        estimate=estimated,
        default_sigmas=_default_sigmas(poses, marked, options),
    )
    return survey, track


def _require_near(files: Sequence[GroundFile], poses: flight_record.ImagePoses) -> None:
    """Refuse files of points that are nowhere near the images."""
    if poses.located.any():
        middle_in_ecef = enu.ecef_from_lla(enu.median_lla(enu.lla_from_ecef(poses.position_in_ecef[poses.located])))
        for file in files:
            require_near(file, middle_in_ecef)


def _to_estimate(
    options: IngestOptions, poses: flight_record.ImagePoses, track: NavigationTrack | None
) -> tuple[RigParameter, ...]:
    """Return the parameters of the rig to estimate: those asked for, and what coarse times leave open.

    Only the photographs' own motion tells the latter. An InputError: what is asked for was not recorded.
    """
    observable = shown_by(track)
    if options.time_offset == "auto" and "time-offset" not in observable:
        raise InputError(
            "navigation-not-recorded",
            "needs navigation with times: a --bag, or a --trajectory without a column of image names",
            field="--time-offset",
        )
    if "lever-arm" in options.estimate and not poses.located.any():
        raise InputError("no-positions", "lever-arm needs positions of the photographs.", field="--estimate")
    if "boresight" in options.estimate and not complete(poses.enu_from_cam.reshape(-1, 9)).any():
        raise InputError(
            "no-attitudes",
            "boresight needs recorded attitudes, and in a bag the camera's mount.",
            field="--estimate",
            remedy="Give --camera-mount YAW,PITCH,ROLL if only the mount is missing.",
        )
    if poses.coarse_times_m and track is not None and not options.time_offset_s:
        return in_usual_order((*options.estimated, "time-offset"))
    return options.estimated


def require_placed(placed: bool, photos: Sequence[Photo] = (), points: Sequence[GroundPoint] = ()) -> None:
    """Refuse a survey that nothing places on Earth, with what its photographs' tags hold instead.

    `points` are control points whose marks do not suffice.
    """
    if not placed and points:
        counts = Counter(len(point.marks) for point in points)
        of_each = ", ".join(
            f"{count} with {marks} mark{'s'[: marks != 1]}" for marks, count in sorted(counts.items(), reverse=True)
        )
        raise InputError(
            "control-points-unmarked",
            (
                "No image has a position, and no control point is marked in two or more photographs: of "
                f"{len(points)} control points there are {of_each}."
            ),
            remedy=(
                "Mark each point in at least 2 photographs, better in all that show it, or give positions with "
                "--trajectory or --geo."
            ),
        )
    if not placed:
        held = f" {_tag_contents(photos)}" if photos else ""
        raise InputError(
            "no-positions",
            f"No image has a position, and there are no ground control points.{held} Give --trajectory, --geo or "
            "--gcp; or, for a result in a local metric frame without a place on Earth, known --distances between "
            "marked points.",
        )


def _source_crs(poses: flight_record.ImagePoses, control: GroundFile | None) -> str:
    """Return the CRS of the positions, else that of the control points; `transformations` has all."""
    return poses.crs_name if poses.located.any() or control is None else control.crs.name


def _sigma_of_transformation(remarks: Remarks, *of: str) -> float:
    """Return the σ of each horizontal axis by the transformations of the named parts of the input; the largest."""
    return max((each.sigma_m for each in remarks.transformations if each.of in of), default=0.0)


def _require_checks(checks: Sequence[GroundPoint], vegetated: Sequence[str]) -> None:
    """Refuse names of points under vegetation that are no check points."""
    known = {point.name for point in checks}
    for name in vegetated:
        if name not in known:
            raise InputError(
                "vegetated-not-a-check",
                f"{name!r} is no check point: there are {', '.join(sorted(known)) or 'none'}.",
                field="--vegetated",
                remedy="Add it with --checkpoints or --check.",
            )


def _images(
    flight: flight_record.FlightRecord,
    session_of: IntArray,
    origin: enu.Origin | None,
    options: IngestOptions,
    sigma_zero_m: float,
) -> tuple[SurveyImage, ...]:
    """Return the photographs with fixes and attitudes in the frame at an origin, and their split."""
    poses = flight.poses
    fixes, attitudes = _fixes(poses, session_of, origin, sigma_zero_m), _attitudes(poses, origin, options)
    test = _held_out(len(flight.photos), options.test_every)
    return tuple(
        SurveyImage(
            name=photo.name,
            camera_id=flight.camera_of[photo.name],
            sha256=photo.file.sha256,
            timestamp_s=float(poses.time_s[row]) if np.isfinite(poses.time_s[row]) else None,
            fix=fixes[row],
            attitude=attitudes[row],
            split="test" if row in test else "train",
            sharpness=None if photo.sharpness is None else round(photo.sharpness, 3),
        )
        for row, photo in enumerate(flight.photos)
    )


def _companions(flight: flight_record.FlightRecord) -> tuple[Companion, ...]:
    return tuple(
        Companion(
            name=each.photo.name,
            camera_id=flight.camera_of[each.photo.name],
            sha256=each.photo.file.sha256,
            beside=each.beside,
            stated_quat_xyzw=flight.rotations.get(each.photo.name),
        )
        for each in flight.accompanying
    )


def _held_out(count: int, every: int) -> range:
    """Return the rows of the test images: every N-th, none where that would leave too few to train on."""
    rows = range(0, count, every) if every else range(0)
    return rows if count - len(rows) >= flight_record.LEAST_IMAGES else range(0)


def _surveyed(
    points: Sequence[GroundPoint], origin: enu.Origin | None, options: IngestOptions
) -> tuple[SurveyedPoint, ...]:
    """Return ground points in the frame at an origin; σ by precedence: option, then file, then default."""
    if not points or origin is None:
        return ()
    stated = options.model_fields_set
    sigma_m = []
    for point in points:
        horizontal_m = (None if "sigma_gcp_h" in stated else point.sigma_h_m) or options.sigma_gcp_h
        vertical_m = (None if "sigma_gcp_v" in stated else point.sigma_v_m) or options.sigma_gcp_v
        sigma_m.append((horizontal_m, horizontal_m, vertical_m))
    position_in_ecef = np.array([point.position_in_ecef for point in points])
    position = enu.enu_from_ecef(position_in_ecef, origin)
    covariance = _turned(np.array(sigma_m), position_in_ecef, origin)
    return tuple(
        SurveyedPoint(
            name=point.name,
            position_in_geo=vector3(position[row]),
            cov_in_geo=_matrix(covariance[row]),
            marks=point.marks,
            land_cover="vegetated" if point.name in options.vegetated else "open",
        )
        for row, point in enumerate(points)
    )


def _fixes(
    poses: flight_record.ImagePoses, session_of: IntArray, origin: enu.Origin | None, sigma_zero_m: float
) -> list[Fix | None]:
    if origin is None:
        return [None] * len(poses.position_in_ecef)
    position = enu.enu_from_ecef(poses.position_in_ecef, origin)
    covariance = _turned(poses.sigma_enu_m, poses.position_in_ecef, origin)
    covariance[:, 2, 2] += sigma_zero_m**2
    common = np.zeros_like(position)
    if poses.along_track_m is not None:
        along = poses.along_track_m @ enu.ecef_from_enu_rotation(enu.lla_of(origin))
        covariance = covariance + np.swapaxes(along, 1, 2) @ along
        common = along[:, 1]
    return [
        Fix(
            position_in_geo=vector3(position[row]),
            cov_in_geo=_matrix(covariance[row]),
            common_along_m=vector3(common[row]),
            source=poses.source,
            sigma_source=poses.sigma_source[row],
            session=int(session_of[row]),
            sigma_zero_m=sigma_zero_m,
        )
        if located
        else None
        for row, located in enumerate(poses.located)
    ]


def _turned(sigma_enu_m: FloatArray, position_in_ecef: FloatArray, origin: enu.Origin) -> FloatArray:
    """Return covariances in geo (N, 3, 3) of σ (N, 3) against north and up at each place (N, 3)."""
    geo_from_enu = enu.geo_from_enu_at(enu.lla_from_ecef(position_in_ecef), origin)
    return geo_from_enu @ (sigma_enu_m[:, :, None] ** 2 * np.swapaxes(geo_from_enu, -1, -2))


def _attitudes(
    poses: flight_record.ImagePoses, origin: enu.Origin | None, options: IngestOptions
) -> list[Attitude | None]:
    """Return attitudes in geo; σ by precedence: option, then file, then the source's default."""
    attitudes: list[Attitude | None] = [None] * len(poses.position_in_ecef)
    rows = np.flatnonzero(np.isfinite(poses.enu_from_cam).all(axis=(1, 2))).tolist()
    geo_from_cam = poses.enu_from_cam[rows]
    if origin is not None:
        # Without a position, north is the origin's: within a survey it turns by minutes of arc.
        located = poses.located[rows, None]
        lla = np.where(located, enu.lla_from_ecef(poses.position_in_ecef[rows]), enu.lla_of(origin))
        geo_from_cam = enu.geo_from_enu_at(lla, origin) @ geo_from_cam
    for row, quat in zip(rows, quat_xyzw_from_matrix(geo_from_cam), strict=True):
        x, y, z, w = (float(value) for value in quat)
        source = poses.attitude_source[row]
        sigma_deg = SIGMA_GIMBAL_DEG if source == "gimbal" else SIGMA_TABLE_ATTITUDE_DEG
        if np.isfinite(poses.sigma_attitude_deg[row]):
            sigma_deg = float(poses.sigma_attitude_deg[row])
        if options.sigma_attitude is not None:
            sigma_deg = options.sigma_attitude
        attitudes[row] = Attitude(quat_xyzw=(x, y, z, w), sigma_deg=sigma_deg, source=source)
    return attitudes


def _matrix(values: FloatArray) -> Matrix3:
    return (vector3(values[0]), vector3(values[1]), vector3(values[2]))


def fix_sessions(
    poses: flight_record.ImagePoses, options: IngestOptions, remarks: Remarks, *, sigma_zero_m: float = 0.0
) -> tuple[tuple[FixSession, ...], IntArray]:
    """Return the sessions, and the session of each of N images (N,), 0 for images without a position.

    Positions of one kind of receiver form a session until a gap of more than four hours. Where the time of one is
    unknown, all of its kind form one session: a session too many would count as an independent check of a common
    error. The σ of that error is that of the option, else of the kind of receiver; where the datum of the heights
    is assumed, and no option states the vertical σ, it includes that of the datum, and always that of a
    doubtful zero.
    """
    given_h, given_v = options.sigma_common_h, options.sigma_common_v
    datum_v_m = SIGMA_DATUM_M if poses.vertical.is_assumed and given_v is None and poses.located.any() else 0.0
    datum_v_m = max(datum_v_m, sigma_zero_m)
    # Positions in WGS84 check a transformation of the control points no better than that is published: WGS84 is a
    # name for realisations that are metres apart, and positions do not tell theirs.
    datum_h_m = _sigma_of_transformation(remarks, "positions", "control points")
    sessions: list[FixSession] = []
    session_of = np.zeros(len(poses.receivers), dtype=np.int64)
    located, sigma_h_m = poses.located, poses.sigma_enu_m[:, :2].max(axis=1)
    for receiver in flight_record.RECEIVERS:
        rows = np.flatnonzero(located & (np.array(poses.receivers) == receiver))
        by_time = _by_time(poses.time_s[rows])
        session_of[rows] = len(sessions) + by_time
        for number in np.unique(by_time):
            kind = flight_record.kind_of_receiver(receiver, float(np.median(sigma_h_m[rows[by_time == number]])))
            horizontal_m, vertical_m = np.hypot(flight_record.COMMON_SIGMA_M[kind], poses.common_sigma_m).tolist()
            h_m, v_m = horizontal_m if given_h is None else given_h, vertical_m if given_v is None else given_v
            source: flight_record.SigmaSource = "default" if given_h is None and given_v is None else "option"
            sessions.append(
                FixSession(
                    receiver=kind,
                    sigma_common_m=(
                        math.hypot(h_m, datum_h_m),
                        math.hypot(h_m, datum_h_m),
                        math.hypot(v_m, datum_v_m),
                    ),
                    sigma_source=source,
                    sigma_datum_m=(datum_h_m, datum_h_m, datum_v_m),
                )
            )
    if datum_v_m > sigma_zero_m:
        remarks.assume(
            "default-datum-sigma",
            f"Nobody stated the datum of the heights: the σ of the error that they share includes {datum_v_m:g} m "
            "for it.",
            "State the datum with --vertical.",
        )
    counts = np.bincount(session_of[located], minlength=len(sessions))
    for kind in flight_record.COMMON_SIGMA_M:
        of_kind = sum(
            int(count) for session, count in zip(sessions, counts, strict=True) if session.receiver == kind
        )
        if of_kind:
            _note_default(kind, of_kind, poses.common_sigma_m, options, remarks)
    return tuple(sessions), session_of


def _by_time(time_s: FloatArray) -> IntArray:
    session = np.zeros(len(time_s), dtype=np.int64)
    if np.isfinite(time_s).all():
        order = np.argsort(time_s, kind="stable")
        session[order[1:]] = np.cumsum(np.diff(time_s[order]) > SESSION_GAP_S)
    return session


def _note_default(
    kind: str, count: int, added_m: tuple[float, float], options: IngestOptions, remarks: Remarks
) -> None:
    horizontal_m, vertical_m = np.round(np.hypot(flight_record.COMMON_SIGMA_M[kind], added_m), 2).tolist()
    defaults = {}
    if options.sigma_common_h is None:
        defaults["--sigma-common-h"] = f"{horizontal_m:g} m horizontal"
    if options.sigma_common_v is None:
        defaults["--sigma-common-v"] = f"{vertical_m:g} m vertical"
    if defaults:
        remarks.assume(
            "default-common-sigma",
            f"The error that the {count} positions of a session share has a σ of {', '.join(defaults.values())} "
            f"({kind}).",
            f"State it with {' and '.join(defaults)}.",
        )


def _only_targets(control: Sequence[GroundPoint], options: IngestOptions) -> bool:
    """Return whether all marks have a σ of their own, as those of targets do."""
    marks = [mark for point in control for mark in point.marks]
    return bool(marks) and all(mark.sigma_px != options.sigma_mark for mark in marks)


def _default_sigmas(
    poses: flight_record.ImagePoses, control: Sequence[GroundPoint], options: IngestOptions
) -> tuple[SigmaGroup, ...]:
    """Return the groups of measurements whose σ neither a file nor an option states."""
    stated = options.model_fields_set
    points_stated = {"sigma_gcp_h", "sigma_gcp_v"} <= stated or (
        bool(control) and all(point.sigma_h_m and point.sigma_v_m for point in control)
    )
    attitudes = np.isfinite(poses.enu_from_cam).all(axis=(1, 2)).any() and options.sigma_attitude is None
    # A gimbal's tags have no σ: one that is set for them is that of a correction by the track.
    of_file = np.isfinite(poses.sigma_attitude_deg) & (np.array(poses.attitude_source, dtype=object) != "gimbal")
    groups: list[tuple[bool, SigmaGroup]] = [
        ("default" in poses.sigma_source, "fixes"),
        (not points_stated, "control points"),
        ("sigma_mark" not in stated and not _only_targets(control, options), "marks"),
        (bool(attitudes) and not of_file.any(), "attitudes"),
    ]
    return tuple(group for is_default, group in groups if is_default)


def _without_far_fixes(flight: flight_record.FlightRecord, remarks: Remarks) -> flight_record.ImagePoses:
    poses = flight.poses
    if not poses.located.any():
        return poses
    middle_in_ecef = enu.ecef_from_lla(enu.median_lla(enu.lla_from_ecef(poses.position_in_ecef[poses.located])))
    distance_m = np.linalg.norm(poses.position_in_ecef - middle_in_ecef, axis=1)
    far = distance_m > FIX_RANGE_M
    remarks.warn_counted(
        "position-far-away",
        [f"{flight.photos[row].name} ({distance_m[row] / 1000:.0f} km)" for row in np.flatnonzero(far).tolist()],
        "Positions far from the others are left out",
    )
    return replace(poses, position_in_ecef=np.where(far[:, None], np.nan, poses.position_in_ecef))


def _origin(poses: flight_record.ImagePoses, control: Sequence[GroundPoint]) -> enu.Origin:
    places = enu.lla_from_ecef(poses.position_in_ecef[poses.located])
    if not len(places) and control:
        places = enu.lla_from_ecef([point.position_in_ecef for point in control])
    lat, lon, alt = enu.median_lla(places)
    return enu.Origin(lat_deg=round(float(lat), 5), lon_deg=round(float(lon), 5), alt_m=round(float(alt)))


def _note_coverage(flight: flight_record.FlightRecord, points: int, remarks: Remarks) -> None:
    located = flight.poses.located
    if flight.poses.source == "exif":
        names = [flight.photos[row].name for row in np.flatnonzero(~located).tolist()]
        remarks.warn_counted("images-without-position", names, "Images have no position in EXIF")
    if not located.any():
        remarks.warn(
            "no-positions", f"No image has a position: {points} ground control points alone georeference the model."
        )
    elif located.sum() < flight_record.LEAST_IMAGES and points < flight_record.LEAST_IMAGES:
        remarks.warn(
            "too-few-positions",
            f"There are {int(located.sum())} positions and {points} control points: at least three fixes or "
            "control points are needed.",
        )


def _vertical(poses: flight_record.ImagePoses, files: Sequence[GroundFile], remarks: Remarks) -> VerticalDatum:
    """Return the datum of the image positions, or of the control points if there are none; note all assumptions."""
    datums = {"the images": poses.vertical} if poses.located.any() else {}
    datums |= {file.path.name: file.crs.vertical for file in files}
    for source, datum in datums.items():
        if not datum.stated:
            remedy = "--vertical states their datum." if datum.is_assumed else ""
            remarks.assume("vertical-datum-assumed", f"Heights of {source} are {datum.name}: {datum.note}.", remedy)
    stated = [source for source, datum in datums.items() if datum.stated]
    assumed = [source for source, datum in datums.items() if not datum.stated]
    if stated and assumed:
        remarks.warn(
            "vertical-datums-mixed",
            f"The vertical datum of {', '.join(stated)} is stated, that of {', '.join(assumed)} only assumed. "
            "They may differ by a geoid's height, up to 100 m.",
            "State both with --vertical.",
        )
    return next(iter(datums.values()))


def _tag_contents(photos: Sequence[Photo]) -> str:
    """Return a sentence on what the tags of photographs hold beside whole positions; empty if nothing."""
    contents = []
    models = sorted({photo.tags.make_model.strip() for photo in photos} - {""})
    if models:
        contents.append(f"the camera ({', '.join(models[:3])})")
    flat = sum(photo.tags.gps is not None and photo.tags.gps.alt_m is None for photo in photos)
    if flat:
        contents.append(f"latitudes and longitudes without a height of {flat}")
    times = [photo.tags.timestamp_s for photo in photos if photo.tags.timestamp_s is not None]
    if times:
        first, last = (
            datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M:%S") for time in (min(times), max(times))
        )
        contents.append(f"times of {len(times)} ({first} to {last})")
    drone = [photo.tags.dji for photo in photos if photo.tags.dji is not None]
    attitudes = sum(bool(tags.gimbal_yaw_pitch_roll_deg or tags.mount_yaw_pitch_roll_deg) for tags in drone)
    if attitudes:
        contents.append(f"attitudes of {attitudes}")
    heights = [tags.relative_altitude_m for tags in drone if tags.relative_altitude_m is not None]
    if heights:
        contents.append(f"heights above take-off of {len(heights)} ({min(heights):.1f} to {max(heights):.1f} m)")
    absolute = [tags.absolute_altitude_m for tags in drone if tags.absolute_altitude_m is not None]
    if absolute:
        contents.append(f"absolute altitudes of {len(absolute)} ({min(absolute):.1f} to {max(absolute):.1f} m)")
    lenses = [photo.tags.lens for photo in photos]
    if focal := sum(bool(lens.focal_mm or lens.focal_35mm_mm) for lens in lenses):
        contents.append(f"focal lengths of {focal}")
    problems = sorted({problem for photo in photos for problem in photo.tags.problems})
    reasons = f" Not used: {'; '.join(problems[:3])}." if problems else ""
    if not contents:
        return f"Their tags hold no time, camera or attitude either.{reasons}"
    return f"The tags of {len(photos)} photographs hold {', '.join(contents)}.{reasons}"
