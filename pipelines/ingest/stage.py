"""Stage `ingest`: photographs, positions, attitudes and ground points into one survey in one frame.

Reads: a folder of photographs or a ROS bag; optionally a CSV trajectory or `geo.txt`, `gcp_list.txt`, check points.
Writes: `ingest/survey.json`; `ingest/images/` with --bag or --copy; `ingest/track.npz` where the navigation was
recorded by time. See docs/inputs.md and docs/bags.md for every format and default.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from pipelines.core.errors import InputError
from pipelines.core.products import save_json
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray, Matrix3, Vector3
from pipelines.core.workspace import StageRun, Summary
from pipelines.formats.pose_table import complete
from pipelines.geodesy import enu
from pipelines.geodesy.enu import Origin
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.geometry.rotations import matrix_from_quat_xyzw, quat_xyzw_from_matrix
from pipelines.ingest.ground_points import GroundFile, GroundPoint, read_ground_file, require_near, split_checks
from pipelines.ingest.image_poses import Measured
from pipelines.ingest.intake import LEAST_IMAGES, pose_options, take_in
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.scene.navigation import NavigationTrack, require_estimable
from pipelines.scene.survey import Attitude, Fix, Survey, SurveyedPoint, SurveyImage

log = logging.getLogger(__name__)

SIGMA_GIMBAL_DEG = 2.0
SIGMA_TABLE_ATTITUDE_DEG = 1.0
# A fix further than this from the middle of all is a blunder.
_FIX_RANGE_M = 100_000.0


def run(stage: StageRun, config: IngestOptions) -> Summary:
    """Build the survey and save it.

    Raises:
        InputError: anything wrong with the inputs; names file, line and field.
    """
    if config.images is not None and stage.workspace.root.resolve().is_relative_to(config.images.resolve()):
        message = "the workspace lies inside the folder of photographs: put it elsewhere"
        raise InputError(message, path=stage.workspace.root)
    survey, track = survey_and_track(config, stage.out / "images", stage.progress)
    if config.bag is not None:
        survey = survey.model_copy(update={"image_dir": "ingest/images"})
    elif config.copy_images:
        survey = _copied(survey, stage)
    save_json(survey, stage.out / "survey.json")
    if track is not None:
        track.save(stage.out / "track.npz")
    for assumption in survey.assumptions:
        log.info("assumed: %s", assumption)
    return _summary(survey)


def build_survey(config: IngestOptions, progress: Progress = SILENT) -> Survey:
    """Everything that was measured, in one East-North-Up frame; reads files, writes none: not for bags.

    The origin is the median of the image positions (of the control points if there are none), rounded to 10⁻⁵
    degrees and a metre. Every `test_every`-th image by name is held out, beginning with the first.

    Raises:
        InputError: as `run`.
    """
    return survey_and_track(config, None, progress)[0]


def survey_and_track(
    config: IngestOptions, frames: Path | None, progress: Progress = SILENT
) -> tuple[Survey, NavigationTrack | None]:
    """As `build_survey`, and the navigation in the same frame where it has been recorded by time.

    Args:
        config: options.
        frames: where the photographs of a bag are written.
        progress: whom to tell.

    Raises:
        InputError: as `run`.
    """
    notes = Notes()
    taken = take_in(config, frames, notes, progress)
    photos = taken.photos
    measured = _without_far_fixes(taken.measured, photos, notes)
    sizes = {photo.name: (photo.file.width, photo.file.height) for photo in photos}
    control_file, check_file = (
        read_ground_file(path, sizes, config.sigma_mark, pose_options(config), notes) if path is not None else None
        for path in (config.gcp, config.checkpoints)
    )
    control, check = split_checks(control_file, check_file, config.check)
    if measured.located.any():
        middle = enu.median_lla(measured.lla[measured.located])
        require_near(control_file, middle)
        require_near(check_file, middle)
    origin = _origin(measured, control)
    _note_coverage(measured, photos, len(control), notes)
    if config.test_every and not _held_out(len(photos), config.test_every):
        notes.warn(f"{len(photos)} images are too few to hold any out for testing")
    track = taken.track(origin)
    if config.estimated:
        require_estimable(track, config.estimated, "--estimate" if config.estimate else "--time-offset")
    survey = Survey(
        origin=origin,
        source_crs=measured.crs_name if control_file is None or measured.located.any() else control_file.crs_name,
        vertical=_vertical(measured, control_file, check_file, notes),
        image_dir=str(taken.folder),
        cameras=taken.cameras,
        images=_images(photos, taken.camera_of, measured, origin, config),
        control_points=_surveyed(control, origin, config),
        check_points=_surveyed(check, origin, config),
        assumptions=tuple(notes.assumptions),
        warnings=tuple(notes.warnings),
        estimate=config.estimated,
    )
    return survey, track


def _without_far_fixes(measured: Measured, photos: Sequence[Photo], notes: Notes) -> Measured:
    known = measured.located
    if not known.any():
        return measured
    middle = enu.ecef_from_lla(enu.median_lla(measured.lla[known]))
    distance_m = np.linalg.norm(enu.ecef_from_lla(measured.lla) - middle, axis=1)
    far = known & (distance_m > _FIX_RANGE_M)
    notes.warn_counted(
        [f"{photos[row].name} ({distance_m[row] / 1000:.0f} km)" for row in np.flatnonzero(far).tolist()],
        "position is far from the others and was left out",
        "positions are far from the others and were left out",
    )
    return replace(measured, lla=np.where(far[:, None], np.nan, measured.lla))


def _origin(measured: Measured, control: Sequence[GroundPoint]) -> Origin:
    places = measured.lla[measured.located]
    if not len(places):
        places = np.array([point.lla for point in control]).reshape(-1, 3)
    if not len(places):
        raise InputError(
            "no image has a position, and there are no ground control points: give --trajectory, --geo or --gcp"
        )
    lat, lon, alt = enu.median_lla(places)
    return Origin(lat_deg=round(float(lat), 5), lon_deg=round(float(lon), 5), alt_m=round(float(alt)))


def _note_coverage(measured: Measured, photos: Sequence[Photo], points: int, notes: Notes) -> None:
    known = measured.located
    if measured.source == "exif":
        names = [photo.name for photo, one in zip(photos, known, strict=True) if not one]
        notes.warn_counted(names, "image has no position in EXIF", "images have no position in EXIF")
    if not known.any():
        notes.warn(f"no image has a position: {points} ground control points alone place the model")
    elif known.sum() < LEAST_IMAGES and points < LEAST_IMAGES:
        notes.warn(f"only {int(known.sum())} positions and {points} control points: three of a kind place a model")


def _vertical(
    measured: Measured, control: GroundFile | None, check: GroundFile | None, notes: Notes
) -> VerticalDatum:
    """The datum of the image positions, or of the control points if there are none; all assumptions noted."""
    places = {"the images": measured.vertical} if measured.located.any() else {}
    places |= {file.path.name: file.vertical for file in (control, check) if file is not None}
    for place, datum in places.items():
        if not datum.stated:
            notes.assume(f"heights of {place} are {datum.name}: {datum.note}")
    stated = [place for place, datum in places.items() if datum.stated]
    assumed = [place for place, datum in places.items() if not datum.stated]
    if stated and assumed:
        notes.warn(
            f"the vertical datum of {', '.join(stated)} is stated, that of {', '.join(assumed)} only assumed: they "
            "may differ by a geoid's height, up to 100 m; see --vertical"
        )
    return next(iter(places.values()))


def _images(
    photos: Sequence[Photo], camera_of: dict[str, int], measured: Measured, origin: Origin, config: IngestOptions
) -> tuple[SurveyImage, ...]:
    fixes, attitudes = _fixes(measured, origin), _attitudes(measured, origin, config)
    held_out = _held_out(len(photos), config.test_every)
    return tuple(
        SurveyImage(
            name=photo.name,
            camera_id=camera_of[photo.name],
            sha256=photo.file.sha256,
            timestamp_s=float(measured.time_s[row]) if np.isfinite(measured.time_s[row]) else None,
            fix=fixes[row],
            attitude=attitudes[row],
            split="test" if row in held_out else "train",
        )
        for row, photo in enumerate(photos)
    )


def _fixes(measured: Measured, origin: Origin) -> list[Fix | None]:
    position = enu.enu_from_lla(measured.lla, origin)
    geo_from_enu = enu.geo_from_enu_at(measured.lla, origin)
    covariance = geo_from_enu @ (measured.sigma_enu_m[:, :, None] ** 2 * np.swapaxes(geo_from_enu, -1, -2))
    return [
        Fix(
            position_in_geo=_vector(position[row]),
            cov_in_geo=_matrix(covariance[row]),
            source=measured.source,
            sigma_source=measured.sigma_source[row],
        )
        if located
        else None
        for row, located in enumerate(measured.located)
    ]


def _attitudes(measured: Measured, origin: Origin, config: IngestOptions) -> list[Attitude | None]:
    found: list[Attitude | None] = [None] * len(measured.lla)
    rows = np.flatnonzero(complete(measured.quat_xyzw))
    # Without a position, north is the origin's: within a survey it turns by minutes of arc.
    place = np.where(measured.located[rows, None], measured.lla[rows], enu.lla_of(origin))
    rotation = enu.geo_from_enu_at(place, origin) @ matrix_from_quat_xyzw(measured.quat_xyzw[rows])
    for row, quat in zip(rows, quat_xyzw_from_matrix(rotation), strict=True):
        source = measured.attitude_source[row]
        default_deg = SIGMA_GIMBAL_DEG if source == "gimbal" else SIGMA_TABLE_ATTITUDE_DEG
        x, y, z, w = (float(value) for value in quat)
        stated = np.nan if measured.sigma_attitude_deg is None else measured.sigma_attitude_deg[row]
        sigma_deg = float(stated) if np.isfinite(stated) else default_deg
        sigma_deg = sigma_deg if config.sigma_attitude is None else config.sigma_attitude
        found[row] = Attitude(quat_xyzw=(x, y, z, w), sigma_deg=sigma_deg, source=source)
    return found


def _held_out(count: int, every: int) -> range:
    """Rows of the test images: every N-th, none where that would leave too few to train on."""
    held_out = range(0, count, every) if every else range(0)
    return held_out if count - len(held_out) >= LEAST_IMAGES else range(0)


def _surveyed(points: Sequence[GroundPoint], origin: Origin, config: IngestOptions) -> tuple[SurveyedPoint, ...]:
    sigma_m = np.array([config.sigma_gcp_h, config.sigma_gcp_h, config.sigma_gcp_v])
    found = []
    for point in points:
        geo_from_enu = enu.geo_from_enu_at(point.lla, origin)
        found.append(
            SurveyedPoint(
                name=point.name,
                position_in_geo=_vector(enu.enu_from_lla(point.lla, origin)),
                cov_in_geo=_matrix(geo_from_enu * sigma_m**2 @ geo_from_enu.T),
                marks=point.marks,
            )
        )
    return tuple(found)


def _copied(survey: Survey, stage: StageRun) -> Survey:
    """Copy the images into the stage's folder, and the survey that refers to them there."""
    with stage.progress.task("copy", len(survey.images)) as task:
        for image in survey.images:
            target = stage.out / "images" / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(survey.image_dir) / image.name, target)
            task.advance()
    return survey.model_copy(update={"image_dir": "ingest/images"})


def _summary(survey: Survey) -> Summary:
    counts = {
        "images": len(survey.images),
        "test": len(survey.names("test")),
        "fixes": sum(image.fix is not None for image in survey.images),
        "attitudes": sum(image.attitude is not None for image in survey.images),
        "cameras": len(survey.cameras),
        "control_points": len(survey.control_points),
        "check_points": len(survey.check_points),
    }
    key_figure = (
        f"{counts['images']} images, {counts['fixes']} positions, {counts['control_points']} control and "
        f"{counts['check_points']} check points"
    )
    values = {**counts, "origin": survey.origin.model_dump(), "vertical": survey.vertical.model_dump()}
    return Summary(key_figure, values, survey.warnings)


def _vector(values: ArrayLike) -> Vector3:
    x, y, z = (float(value) for value in np.asarray(values))
    return (x, y, z)


def _matrix(values: FloatArray) -> Matrix3:
    return (_vector(values[0]), _vector(values[1]), _vector(values[2]))
