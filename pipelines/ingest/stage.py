"""Stage `ingest`: photographs, positions, attitudes and ground points into one survey in one frame.

Reads: a folder of photographs, a ROS bag or a video; optionally positions, control and check points, marks.
Writes: `ingest/survey.json`; `ingest/images/` with --bag, --video, --copy, HEIC or more than eight bits;
`ingest/masks/` with masks; `ingest/targets.csv` and `.html` with --targets; `ingest/track.npz` where the navigation
was recorded by time.
See docs/inputs.md and docs/bags.md for every format and default.
"""

import logging
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.products import save_json, save_npz
from pipelines.core.progress import SILENT, Progress
from pipelines.core.workspace import StageRun, Summary, Workspace
from pipelines.ingest.bag_flight import count_frames, read_bag
from pipelines.ingest.folder_flight import read_folder
from pipelines.ingest.ground_points import ShownMarks, ends_of, known_distances, read_ground_files, tie_marks
from pipelines.ingest.masks import mask_files, write_masks
from pipelines.ingest.options import IngestOptions, check_options
from pipelines.ingest.photo_depth import with_common_scale
from pipelines.ingest.photo_folder import convert_heif, glance, heif_photographs
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.survey_assembly import assemble_survey, require_placed
from pipelines.ingest.targets import find_targets, numbers_of_points
from pipelines.ingest.video_frames import (
    frame_positions,
    recorded_positions,
    seconds_apart,
    video_length,
    write_frames,
)
from pipelines.survey.navigation import NavigationTrack
from pipelines.survey.survey import Survey

log = logging.getLogger(__name__)


def run(stage: StageRun, options: IngestOptions) -> Summary:
    """Build the survey and save it.

    Raises:
        InputError: anything wrong with the inputs; names file, line and field.
    """
    _refuse_inside_photographs(stage.workspace, options)
    survey, track = survey_and_track(options, stage.out / "images", stage.progress, listing=stage.out)
    survey = write_masks(survey, options, Path(survey.image_dir), stage.out / "masks", stage.progress)
    if options.copy_images and not (stage.out / "images").is_dir():
        _copy_images(survey, stage)
    if (stage.out / "images").is_dir():
        survey = survey.model_copy(update={"image_dir": "ingest/images"})
    save_json(survey, stage.out / "survey.json")
    if track is not None:
        save_npz(stage.out / "track.npz", vars(track))
    for assumption in survey.assumptions:
        log.info("assumed: %s", assumption.text)
    return _summary(survey)


def check_inputs(workspace: Workspace, options: IngestOptions, progress: Progress = SILENT) -> Summary:
    """Return the summary of what `run` would make, or raise as `run`; nothing is written.

    Of photographs, sizes and tags are read: damage behind them is found by `run`. Of a bag, all but the pixels.
    """
    _refuse_inside_photographs(workspace, options)
    heif = [] if options.images is None else heif_photographs(options.images)
    if options.bag is None and options.video is None and not heif:
        survey = survey_and_track(options, None, progress, decode=False)[0]
        mask_files(options, [image.name for image in survey.images], Remarks())
        return _summary(survey)
    remarks = Remarks()
    check_options(options, workspace.root)
    read_ground_files(options, remarks)
    if options.bag is not None:
        frames, located = count_frames(options.bag, options, remarks, progress)
        require_placed(located > 0 or options.gcp is not None or options.distances is not None)
        figure = f"a bag with {frames} frames, {located} of them with a position"
    elif options.video is not None:
        frames = int(video_length(options.video) / seconds_apart(options))
        figure = f"a video of which {frames} frames are taken"
    else:
        require("heif")
        assert options.images is not None
        figure = f"{glance(options.images)[0]} photographs, {len(heif)} of them HEIC"
    return Summary(figure, {}, *(tuple(of_kind) for of_kind in remarks.by_kind))


def _refuse_inside_photographs(workspace: Workspace, options: IngestOptions) -> None:
    """Refuse a workspace whose files would count as photographs."""
    if options.images is not None and workspace.root.resolve().is_relative_to(options.images.resolve()):
        raise InputError(
            "workspace-in-photographs",
            "The workspace lies inside the folder of photographs.",
            path=workspace.root,
            remedy="Choose another place.",
        )


def survey_and_track(
    options: IngestOptions,
    frames: Path | None,
    progress: Progress = SILENT,
    *,
    decode: bool = True,
    listing: Path | None = None,
) -> tuple[Survey, NavigationTrack | None]:
    """Return the survey, and the navigation in the same frame where it was recorded by time; raises as `run`.

    Photographs of a bag or a video, and of a folder with HEIC or bits to scale, are written into `frames`.
    Photographs are decoded to their end, as their hashes need; without `decode`, their heads are read, but for
    targets. What was found of targets is written into the folder `listing`.
    """
    remarks = Remarks()
    check_options(options, frames)
    if options.estimated:
        remarks.assume(
            "rig-as-given",
            f"{', '.join(options.estimated)}: the given value is used until it is estimated after sfm.",
            "`georef run` estimates it.",
        )
    ground = read_ground_files(options, remarks)  # ahead of the photographs, which take minutes
    names = {point.name for file in ground if file is not None for point in file.points} | ends_of(options)
    numbers = numbers_of_points(names, options.targets) if options.targets else {}
    if options.bag is not None and frames is not None:
        flight = read_bag(options.bag, options, frames, remarks, progress)
    elif options.video is not None and frames is not None:
        photographs, time_s = write_frames(options.video, options, frames, remarks, progress)
        recorded = None if options.trajectory is not None else recorded_positions(options.video, remarks)
        table = None if recorded is None else frame_positions(recorded, photographs, time_s)
        flight = read_folder(frames, options, remarks, progress, table=table)
    elif options.images is not None:
        folder = options.images
        if frames is not None and (heif := heif_photographs(folder)):
            convert_heif(folder, heif, frames, remarks, progress)
            folder = frames
        flight = read_folder(folder, options, remarks, progress, decode=decode)
        if frames is not None:
            flight = with_common_scale(flight, frames, remarks, progress)
    else:
        raise InputError(
            "no-photographs-given",
            "Photographs are missing.",
            field="--images",
            remedy="Give their folder, a --bag or a --video.",
        )
    sizes = {photo.name: (photo.file.width, photo.file.height) for photo in flight.photos}
    targets = (
        find_targets(flight.folder, tuple(sizes), options.targets, numbers, progress) if options.targets else None
    )
    marking = ShownMarks({photo.name: photo.tags.orientation for photo in flight.photos}, options.marks_as_shown)
    control, check = (
        None if file is None else tie_marks(file, sizes, options.sigma_mark, remarks, targets, marking=marking)
        for file in ground
    )
    distances = known_distances(options, (control, check), sizes, remarks, targets, marking=marking)
    marking.note(remarks)
    if targets is not None:
        targets.note(remarks)
        if listing is not None:
            targets.write(listing)
    return assemble_survey(flight, control, check, options, remarks, distances=distances)


def _copy_images(survey: Survey, stage: StageRun) -> None:
    names = [image.name for image in survey.images] + [each.name for each in survey.companions]
    with stage.progress.task("copy", len(names)) as task:
        for name in names:
            target = stage.out / "images" / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(Path(survey.image_dir) / name, target)
            task.advance()


def _camera_list(survey: Survey) -> list[dict[str, Any]]:
    """Return the cameras of a survey: model, serial number, sensor, size, focal length, photographs, sharpness."""
    images = Counter(image.camera_id for image in survey.images)
    images.update(each.camera_id for each in survey.companions)
    sharp: dict[int, list[float]] = {}
    for image in survey.images:
        if image.sharpness is not None:
            sharp.setdefault(image.camera_id, []).append(image.sharpness)
    return [
        {
            "camera_id": camera.camera_id,
            "make_model": camera.make_model,
            "serial": camera.serial,
            "sensor": camera.sensor,
            "width": camera.width,
            "height": camera.height,
            "model": camera.model,
            "focal_px": round(camera.params[0], 1),
            "focal_source": camera.focal_source,
            "images": images[camera.camera_id],
            "least_sharp": min(sharp[camera.camera_id]) if camera.camera_id in sharp else None,
        }
        for camera in survey.cameras
    ]


def _summary(survey: Survey) -> Summary:
    counts = {
        "images": len(survey.images),
        "test": len(survey.names("test")),
        "fixes": sum(image.fix is not None for image in survey.images),
        "attitudes": sum(image.attitude is not None for image in survey.images),
        "cameras": len(survey.cameras),
        "control_points": len(survey.control_points),
        "check_points": len(survey.check_points),
        "unmarked_points": len(survey.unmarked_points),
        "distances": len(survey.distances),
        "masks": sum(bool(image.mask_sha256) for image in survey.images),
    }
    key_figure = (
        f"{counts['images']} images, {counts['fixes']} positions, {counts['control_points']} control and "
        f"{counts['check_points']} check points"
        + (f", {counts['unmarked_points']} unmarked" if survey.unmarked_points else "")
        + (f", {counts['distances']} distances" if counts["distances"] else "")
        + (f", {counts['masks']} masks" if counts["masks"] else "")
    )
    if survey.origin is None:
        key_figure += ", in a local metric frame"
    origin = None if survey.origin is None else survey.origin.model_dump()
    values = {
        **counts,
        "origin": origin,
        "vertical": survey.vertical.model_dump(),
        "camera_list": _camera_list(survey),
    }
    return Summary(key_figure, values, survey.warnings, survey.cautions, survey.assumptions)
