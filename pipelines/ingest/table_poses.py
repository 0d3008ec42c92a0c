"""Poses of images from a table: its usable rows on Earth, brought to the images by name or by time."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray, rows_of
from pipelines.formats.trajectory_csv import PoseTable, complete
from pipelines.geodesy.crs import PointCrs, grid_from_enu
from pipelines.geodesy.enu import ecef_from_lla, lla_from_ecef
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.geometry.trajectory import Trajectory
from pipelines.ingest.exif_poses import altitude_m, compare_with_exif, photo_times, time_sigmas
from pipelines.ingest.flight_record import RECEIVERS, ImagePoses, along_track, gap_limit, with_defaults
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.reference_system import (
    crs_of_table,
    in_units_of,
    note_operation,
    note_unread,
    require_heights,
)
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.tag_headings import tagged_attitudes
from pipelines.ingest.written_values import UNKNOWN_SIGMA_M, digits_sigma_m, zero_heights
from pipelines.survey.image_names import ImageNames


def poses_from_table(
    table: PoseTable, photos: Sequence[Photo], options: IngestOptions, remarks: Remarks
) -> ImagePoses:
    """Return positions, and attitudes if the table has them; else attitudes from XMP.

    Rows are matched by name if the table has names, else by time. An image without a row has no position here,
    even if its EXIF has one: two receivers are not mixed unseen.

    Raises:
        InconsistencyError: the positions disagree with those in EXIF.
        InputError: no row with a position, no CRS for x,y,z, options that exclude each other, impossible
            coordinates, or no image matched.
    """
    table = usable_rows(table, remarks)
    crs = crs_of_table(table, options, remarks)
    images = [photo.name for photo in photos]
    if table.names is not None:
        table = _with_heights(match_by_name(table, images, remarks), photos, crs, remarks)
    zero, unknown = zero_heights(
        table.xyz[:, 2], [f"{table.path.name}:{line}" for line in table.lines], table.path.name, remarks
    )
    table = table.take(~zero)
    measured = _measured(table, crs, options, remarks)
    receiver = np.full(len(table.lines), RECEIVERS[-1]) if table.receiver is None else table.receiver
    time_s = photo_times(photos)
    recorded, along_track_m = None, None
    if table.names is not None:
        row_by_name = {name: row for row, name in enumerate(images)}
        rows = [row_by_name[name] for name in table.names]
        at_images = _spread(measured, rows, len(photos))
        time_s = np.where(np.isfinite(at_images.time_s), at_images.time_s, time_s)
        row_of = dict(zip(rows, receiver, strict=True))
        receivers = tuple(str(row_of.get(row, RECEIVERS[-1])) for row in range(len(photos)))
    else:
        order = np.argsort(measured.time_s, kind="stable")
        order = order[np.isfinite(measured.time_s[order])]
        recorded = rows_of(measured, order)
        at_images = match_by_time(recorded, photos, table.path, options, remarks)
        receivers = _worse_neighbour(receiver[order], recorded.time_s, time_s + options.time_offset_s)
        along_track_m = along_track(recorded, time_s + options.time_offset_s, time_sigmas(photos))
    located = complete(at_images.position)
    remarks.warn_counted(
        "images-without-position",
        [images[row] for row in np.flatnonzero(~located)],
        f"Images have no position in {table.path.name}",
    )
    sigma, sigma_source = with_defaults(at_images.sigma_m, receivers, located, options, remarks)
    digits_h, digits_v = digits_sigma_m(
        table.xyz[:, :2], table.xyz[:, 2], degrees="degree" in crs.units[0], of=table.path.name, remarks=remarks
    )
    # A file that states σ states them of its values as written.
    default = np.array([source == "default" for source in sigma_source])[:, None]
    sigma = np.where(default, np.hypot(sigma, [digits_h, digits_h, digits_v]), sigma)
    lla = np.full((len(photos), 3), np.nan)
    lla[located] = lla_from_ecef(at_images.position[located])
    attitudes = tagged_attitudes(photos, lla[:, 1::-1], time_s, remarks)
    from_file = np.asarray(np.isfinite(at_images.rotation).all(axis=(1, 2)))
    poses = ImagePoses(
        position_in_ecef=at_images.position,
        sigma_enu_m=sigma,
        sigma_source=sigma_source,
        receivers=receivers,
        enu_from_cam=np.where(from_file[:, None, None], at_images.rotation, attitudes.enu_from_cam),
        attitude_source=tuple(table.source if row else "gimbal" for row in from_file),
        sigma_attitude_deg=np.where(from_file, np.nan, attitudes.sigma_deg),
        time_s=time_s,
        source=table.source,
        crs_name=crs.name,
        vertical=crs.vertical,
        common_sigma_m=(0.0, UNKNOWN_SIGMA_M if unknown else 0.0),
        recorded=recorded,
        along_track_m=along_track_m,
    )
    _note_coarse_times(poses, photos, remarks)
    compare_with_exif(poses, photos, table.path, options, remarks)
    return poses


def _note_coarse_times(poses: ImagePoses, photos: Sequence[Photo], remarks: Remarks) -> None:
    """Note that times good to a step or less make positions along the track worse than the table states."""
    if not poses.coarse_times_m:
        return
    sigma_s = float(np.median(np.hypot(*time_sigmas(photos))[poses.located]))
    remarks.caution(
        "photo-times-coarse",
        f"The times of the photographs have a σ of {sigma_s:.2g} s, which at {poses.coarse_times_m / sigma_s:.1f} "
        f"m/s is {poses.coarse_times_m:.2g} m along the track. Photographs with fractions of a second in EXIF, or "
        "positions by image name, have none of it.",
    )


def usable_rows(table: PoseTable, remarks: Remarks) -> PoseTable:
    """Return the rows that have a position, without repeats of a moment where rows have no names.

    The rows that are left out are noted, and so are unknown columns and times without a zone. A row of `geo.txt`
    may lack its height.

    Raises:
        InputError: no row has a position.
    """
    file = table.path.name
    remarks.warn_counted(
        "unknown-column",
        [f"{file}:{table.header_line} ({name or 'unnamed'})" for name in table.unknown_columns],
        "Columns are unknown and are ignored",
    )
    note_unread(table, remarks)
    if table.zoneless_times:
        remarks.assume("time-zone", f"Times without a zone in {file} are UTC.")
    needed, gaps = (2, "NaN") if table.source == "geo.txt" else (3, "empty or NaN")
    located = complete(table.xyz[:, :needed])
    places = [f"{file}:{line}" for line in table.lines[~located]]
    remarks.warn_counted("row-without-position", places, f"Rows have no position ({gaps})")
    if not located.any():
        raise InputError("file-without-positions", "No row has a position.", path=table.path)
    table = table.take(located)
    if table.names is not None or table.time_s is None:
        return table
    _, first = np.unique(table.time_s, return_index=True)
    repeated = np.setdiff1d(np.arange(len(table.lines)), first)
    remarks.warn_counted(
        "row-repeats-time",
        [f"{file}:{line}" for line in table.lines[repeated]],
        "Rows that repeat an earlier time are left out",
    )
    return table.take(np.sort(first))


def match_by_name(table: PoseTable, images: list[str], remarks: Remarks) -> PoseTable:
    """Return the rows that belong to `images`, with the images' own names; the other rows are noted.

    Raises:
        InputError: two rows for one image, a name that leaves the folder or is ambiguous, or no match at all.
    """
    index, fault = ImageNames(images), partial(InputError, path=table.path, field="image")
    row_of: dict[str, int] = {}
    unknown, loose = [], []
    for row, text in enumerate(table.names or ()):
        line = int(table.lines[row])
        name = index.find(text, path=table.path, line=line)
        if name is None:
            unknown.append(f"{table.path.name}:{line} ({text})")
            continue
        if name in row_of:
            before = int(table.lines[row_of[name]])
            raise fault("image-twice", f"{name} already has a row, in line {before}.", line=line)
        if Path(text.replace("\\", "/")).name != Path(name).name:
            loose.append(f"{table.path.name}:{line} ({text} for {name})")
        row_of[name] = row
    if not row_of:
        raise fault(
            "no-image-matched",
            f"The file names none of the images: it has {(table.names or ('nothing',))[0]!r} …, the folder "
            f"{images[0]!r} …",
        )
    remarks.warn_counted("row-of-unknown-image", unknown, "Rows name no image here")
    remarks.warn_counted("image-name-differs", loose, "Rows name their images with another case or without suffix")
    matched = table.take(np.array(list(row_of.values()), dtype=np.int64))
    return replace(matched, names=tuple(row_of))


def match_by_time(
    trajectory: Trajectory, photos: Sequence[Photo], path: Path, options: IngestOptions, remarks: Remarks
) -> Trajectory:
    """Return the trajectory at the times of the photographs (N rows), NaN where it does not reach.

    Raises:
        InputError: no row or no photograph has a time, or none of them lies within the trajectory.
    """
    fault = partial(InputError, path=path, field="timestamp")
    if not len(trajectory):
        raise fault("file-without-times", "No row has a time.")
    time_s = photo_times(photos)
    timeless = [photo.name for photo in photos if photo.tags.timestamp_s is None]
    remarks.warn_counted("image-without-time", timeless, "Images have no time in EXIF")
    if len(timeless) == len(photos):
        raise fault("images-without-times", "The file has no column image, and no image has a time in EXIF.")
    if any(photo.tags.time_source == "assumed UTC" for photo in photos):
        remarks.assume("time-zone", "EXIF times without a zone are UTC.")
    matched = trajectory.at(time_s + options.time_offset_s)
    if not complete(matched.position).any():
        raise fault(
            "times-apart",
            f"The file covers {_span(trajectory.time_s)}, the images {_span(time_s)}: no image lies within it, "
            f"with gaps of at most {trajectory.max_gap_s:g} s. Is the camera's clock in another time zone "
            "(--time-offset)? Is --max-gap too small?",
        )
    return matched


def _span(time_s: FloatArray) -> str:
    ends = (datetime.fromtimestamp(float(end), UTC) for end in (np.nanmin(time_s), np.nanmax(time_s)))
    return " to ".join(end.strftime("%Y-%m-%d %H:%M:%S UTC") for end in ends)


def _with_heights(table: PoseTable, photos: Sequence[Photo], crs: PointCrs, remarks: Remarks) -> PoseTable:
    """Fill heights that a table by name lacks from EXIF, and leave out the rows where that has none either."""
    lacking = np.flatnonzero(np.isnan(table.xyz[:, 2]))
    if not len(lacking) or table.names is None:
        return table
    xyz = table.xyz.copy()
    if crs.height_unit == "metre":
        altitude = {photo.name: altitude_m(photo.tags) for photo in photos}
        heights = [altitude[table.names[row]] for row in lacking]
        xyz[lacking, 2] = [np.nan if height is None else height for height in heights]
    filled = complete(xyz)
    if filled[lacking].any():
        remarks.assume(
            "heights-from-exif", f"{int(filled[lacking].sum())} heights that {table.path.name} lacks are from EXIF."
        )
    places = [f"{table.path.name}:{line}" for line in table.lines[~filled]]
    remarks.warn_counted("row-without-height", places, "Rows without a height are left out")
    if not filled.any():
        message = "The file has no heights (z), and EXIF has none either."
        remedy = "Add a column of heights."
        raise InputError("no-heights", message, path=table.path, remedy=remedy)
    return replace(table, xyz=xyz).take(filled)


def _measured(table: PoseTable, crs: PointCrs, options: IngestOptions, remarks: Remarks) -> Trajectory:
    """Return the rows Earth-centred, in the order of the file; NaN where a row has no time, attitude or σ."""
    xyz = in_units_of(crs, table.xyz, table)
    lla = crs.lla_from_xyz(xyz, path=table.path, lines=table.lines.tolist())
    require_heights(lla, table.path, table.lines.tolist())
    note_operation(crs, lla, table.path, "positions", remarks)
    if table.sigma_enu_m is not None and "foot" in crs.units[0]:
        remarks.assume(
            "sigma-in-metres", f"σ in {table.path.name} are in metres, although {crs.name} counts in feet."
        )
    enu_from_cam = np.full((len(lla), 3, 3), np.nan)
    if table.quat_xyzw is not None:
        turned = complete(table.quat_xyzw)
        enu_from_cam[turned] = matrix_from_quat_xyzw(table.quat_xyzw[turned])
        if table.attitudes_of_grid:
            grid_axes = grid_from_enu(crs, lla[turned])
            enu_from_cam[turned] = np.swapaxes(grid_axes, 1, 2) @ enu_from_cam[turned]
            remarks.assume(
                "angles-of-grid", f"Omega, phi and kappa in {table.path.name} count from the axes of {crs.name}."
            )
    measured_s = np.full(len(lla), np.nan) if table.time_s is None else table.time_s
    return Trajectory.from_samples(
        measured_s,
        position=ecef_from_lla(lla),
        rotation=enu_from_cam,
        sigma_m=table.sigma_enu_m,
        max_gap_s=np.inf if table.names is not None else gap_limit(measured_s, options),
    )


def _spread(samples: Trajectory, rows: Sequence[int], count: int) -> Trajectory:
    """Return samples of N images of which a table has only those at `rows`; NaN for the others."""
    source = np.full(count, -1)
    source[rows] = np.arange(len(rows))
    spread = rows_of(samples, source)
    for values in (spread.time_s, spread.position, spread.rotation, spread.sigma_m):
        values[source < 0] = np.nan
    return spread


def _worse_neighbour(receivers: NDArray[np.str_], time_s: FloatArray, at_s: FloatArray) -> tuple[str, ...]:
    """Return the kinds of receiver (N,) at times (N,): the worse of the rows before and after, by time (K,)."""
    rank = np.array([RECEIVERS.index(receiver) for receiver in receivers])
    after = np.clip(np.searchsorted(time_s, at_s), 0, len(time_s) - 1)
    return tuple(RECEIVERS[row] for row in np.maximum(rank[np.clip(after - 1, 0, None)], rank[after]))
