"""Poses of images from the photographs' own tags, EXIF and DJI's XMP, and a table's positions against these.

EXIF is not used where a table is given. But two receivers that disagree by far more than their σ are a
inconsistency that nothing later would notice: heights in feet, another zone, exchanged axes, times that are off.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from pipelines.core.errors import InconsistencyError, InputError
from pipelines.core.products import Remark
from pipelines.core.sentences import listed
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.exif import RTK_FIXED, RTK_FLOAT, PhotoTags
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_enu_rotation, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import (
    ELLIPSOIDAL,
    FOOT_M,
    HEIGHT_REMEDY,
    MOST_GEOID_M,
    VerticalDatum,
    impossible_heights,
)
from pipelines.geometry.statistics import (
    blunders_among,
    mad_sigma,
    median_spacing,
    scatter_about_median,
    two_groups,
)
from pipelines.ingest.flight_record import COMMON_SIGMA_M, ImagePoses, kind_of_receiver, with_defaults
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks, add
from pipelines.ingest.tag_headings import tagged_attitudes
from pipelines.ingest.tag_positions import tagged_positions

# Vertical over horizontal σ of a fix that states only the horizontal one.
_VERTICAL_RATIO = 2.0
_RECEIVER = {RTK_FIXED: "RTK fixed", RTK_FLOAT: "RTK float"}
_SEA_LEVEL_NOTE = "but GPSAltitudeRef says that they count from sea level"
_EXIF_NOTE = "EXIF's altitude is often above a geoid or barometric"
_OR_GO_ON = "Correct the wrong file, or continue with --accept-inconsistency."
_SIGMAS, _LEAST_M = 4.0, 1.0
_MOST_INCONSISTENT = 1 / 3
_COMMON_SIGMAS = 3.0  # of a constant difference, which no number of positions explains
# Another unit shows if heights differ by this many times what σ allow, and that unit leaves this part of a height.
_EVIDENT, _UNIT_PART = 2.0, 0.05
_KILOMETRES_M = 2_000.0
_LEAST_TIMED = 6  # photographs, for a velocity


def poses_from_tags(photos: Sequence[Photo], options: IngestOptions, remarks: Remarks) -> ImagePoses:
    """Return positions from EXIF and XMP, attitudes and RTK σ from XMP.

    Raises:
        InputError: `--vertical` names a geoid whose grid is missing.
    """
    tagged, time_s = tagged_positions(photos, remarks), photo_times(photos)
    xyz = tagged.xyz.copy()
    impossible = impossible_heights(xyz[:, 2])
    if impossible.any():
        names = [f"{photos[int(row)].name} ({xyz[row, 2]:.0f} m)" for row in np.flatnonzero(impossible)]
        if 2 * len(names) > np.isfinite(xyz[:, 2]).sum():
            message = f"The height is impossible ({len(names)} photographs, first {names[0]}): {HEIGHT_REMEDY}"
            raise InputError(
                "height-impossible", message, path=photos[int(np.argmax(impossible))].name, field="GPSAltitude"
            )
        remarks.warn_counted("height-impossible", names, "Images have an impossible height, which is not used")
        xyz[impossible] = np.nan
    located = complete(xyz)
    flat = [photos[row].name for row in np.flatnonzero(np.isfinite(xyz[:, 0]) & ~located).tolist()]
    remarks.warn_counted(
        "image-without-altitude", flat, "Images have a GPS position without altitude, which is not used"
    )
    crs = parse_crs(WGS84, vertical=options.vertical)
    position_in_ecef = np.full((len(photos), 3), np.nan)
    position_in_ecef[located] = ecef_from_lla(crs.lla_from_xyz(xyz[located]))
    stated = np.array([_stated_sigma(photo.tags) for photo in photos])
    flags = [0 if photo.tags.dji is None else photo.tags.dji.rtk_flag or 0 for photo in photos]
    receivers = tuple(_RECEIVER.get(flag, "single-frequency") for flag in flags)
    sigma, sigma_source = with_defaults(stated, receivers, located, options, remarks)
    free = [options.sigma_h is None, options.sigma_h is None, options.sigma_v is None]
    sigma = np.where(free, np.hypot(sigma, tagged.sigma_m), sigma)
    attitudes = tagged_attitudes(photos, xyz[:, :2], time_s, remarks)
    note = _SEA_LEVEL_NOTE if any(photo.tags.says_sea_level for photo in photos) else _EXIF_NOTE
    assumed = VerticalDatum(name=ELLIPSOIDAL, stated=False, note=note)
    return ImagePoses(
        position_in_ecef=position_in_ecef,
        sigma_enu_m=sigma,
        sigma_source=sigma_source,
        receivers=receivers,
        enu_from_cam=attitudes.enu_from_cam,
        attitude_source=tuple("gimbal" for _ in photos),
        sigma_attitude_deg=attitudes.sigma_deg,
        time_s=time_s,
        source="exif",
        crs_name=WGS84,
        vertical=crs.vertical if crs.vertical.stated else assumed,
        common_sigma_m=tagged.common_sigma_m,
    )


def altitude_m(tags: PhotoTags) -> float | None:
    """Return the height of a photograph that has a GPS position: EXIF's, else that of DJI's XMP."""
    if tags.gps is None:
        return None
    if tags.gps.alt_m is None and tags.dji is not None:
        return tags.dji.absolute_altitude_m
    return tags.gps.alt_m


def photo_times(photos: Sequence[Photo]) -> FloatArray:
    """Return seconds since 1970 UTC (N,), NaN where a photograph has no time."""
    return np.array([_or_nan(photo.tags.timestamp_s) for photo in photos])


def time_sigmas(photos: Sequence[Photo]) -> tuple[FloatArray, FloatArray]:
    """Return the σ (N,) in s of the times of the photographs, and of an error that all times share."""
    sigma = np.array([(photo.tags.time_sigma_s, photo.tags.time_common_s) for photo in photos]).reshape(-1, 2)
    return sigma[:, 0], sigma[:, 1]


def _stated_sigma(tags: PhotoTags) -> FloatArray:
    """Return σ east, north, up (3,) that the tags state, NaN if none."""
    if tags.dji is not None and tags.dji.rtk_sigma_enu_m is not None:
        return np.array(tags.dji.rtk_sigma_enu_m)
    horizontal_m = None if tags.gps is None else tags.gps.sigma_h_m
    vertical_m = None if tags.dji is None else tags.dji.sigma_v_m
    if horizontal_m is None and tags.dji is not None:
        horizontal_m = tags.dji.sigma_h_m
    if horizontal_m is None:
        return np.full(3, np.nan)
    return np.array([horizontal_m, horizontal_m, vertical_m or _VERTICAL_RATIO * horizontal_m])


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value


def compare_with_exif(
    poses: ImagePoses, photos: Sequence[Photo], path: Path, options: IngestOptions, remarks: Remarks
) -> None:
    """Compare the positions of a table, whose file is `path`, with those of EXIF; what differs is a caution.

    Raises:
        InconsistencyError: most positions differ beyond the σ of both, and the options do not accept that.
    """
    # Stated σ are those of the table: a track good to centimetres says nothing about the photographs' receiver.
    own_sigma = options.model_copy(update={"sigma_h": None, "sigma_v": None})
    exif = poses_from_tags(photos, own_sigma, Remarks())
    both = np.flatnonzero(poses.located & exif.located)
    if not len(both):
        return
    lla = lla_from_ecef(exif.position_in_ecef[both])
    enu_from_ecef = np.swapaxes(ecef_from_enu_rotation(lla), 1, 2)
    apart = np.einsum("nij,nj->ni", enu_from_ecef, poses.position_in_ecef[both] - exif.position_in_ecef[both])
    sigma = np.hypot(poses.sigma_enu_m[both], exif.sigma_enu_m[both])
    if poses.along_track_m is not None:
        along_m = np.linalg.norm(poses.along_track_m[both], axis=(1, 2))
        sigma = np.hypot(sigma, along_m[:, None] * [1.0, 1.0, 0.0])
    in_table = lla_from_ecef(poses.position_in_ecef[both])[:, 2]
    from_ecef, origin = enu_from_ecef[len(both) // 2], exif.position_in_ecef[both[len(both) // 2]]
    in_enu = [(each.position_in_ecef[both] - origin) @ from_ecef.T for each in (exif, poses)]
    places = _Places(
        name=tuple(photos[int(row)].name for row in both),
        exif=in_enu[0][:, :2],
        table=in_enu[1][:, :2],
        sigma_m=sigma[:, :2],
        time_s=exif.time_s[both],
        common_m=float(np.hypot(_common_sigma(poses, both), _common_sigma(exif, both))),
    )
    heights_m = np.column_stack([in_table, lla[:, 2]])
    differences = (_horizontal(places, path), _heights(places.name, heights_m, apart[:, 2], sigma[:, 2], path))
    for fatal, caution in filter(None, differences):
        if fatal and not options.accept_inconsistency:
            raise InconsistencyError(
                caution.code,
                f"{path}: {caution.sentence}",
                remedy=" ".join(filter(None, (caution.remedy, _OR_GO_ON))),
            )
        add(remarks.cautions, caution)


@dataclass(frozen=True)
class _Places:
    """Horizontal positions of n photographs by EXIF and by the table, metres east and north, with the σ of both."""

    name: tuple[str, ...]
    exif: FloatArray  # (n, 2)
    table: FloatArray  # (n, 2)
    sigma_m: FloatArray  # (n, 2)
    time_s: FloatArray  # (n,) NaN where unknown
    common_m: float  # σ along an axis of the difference of the errors that all positions of a receiver share


def _horizontal(places: _Places, path: Path) -> tuple[bool, Remark] | None:
    """Return the caution of positions that differ, and whether it is fatal."""
    distance = np.hypot(*(places.table - places.exif).T)
    allowed = np.maximum(_SIGMAS * np.hypot(*places.sigma_m.T), _LEAST_M)
    inconsistent = distance > allowed
    if not inconsistent.any():
        return _constant(places, path)
    if inconsistent.mean() <= _MOST_INCONSISTENT:
        return False, _few(places.name, distance, inconsistent, "positions", path)
    code, cause = _cause(places, float(np.median(distance)), float(np.median(allowed)) / _SIGMAS)
    sentence = f"{int(inconsistent.sum())} of {len(distance)} positions in {path.name} {cause}"
    return True, Remark(code=code, sentence=sentence)


def _constant(places: _Places, path: Path) -> tuple[bool, Remark] | None:
    """Return the caution of positions that each differ by no more than their σ, but all in the same way."""
    apart = places.table - places.exif
    shift, count = np.median(apart, axis=0), len(apart)
    own_m = np.maximum(np.median(places.sigma_m, axis=0), mad_sigma(apart[:, 0] - shift[0]))
    limit_m = np.maximum(_COMMON_SIGMAS * np.hypot(places.common_m, own_m * (np.pi / 2 / count) ** 0.5), _LEAST_M)
    if (np.abs(shift) <= limit_m).all():
        return None
    sentence = (
        f"The positions in {path.name} and in EXIF differ by a constant of {shift[0]:+.1f} m east and "
        f"{shift[1]:+.1f} m north, where σ {places.common_m:.1f} m is expected of what two receivers do not share. "
        f"Those in {path.name} are used. Is one in another datum, or from a base station with wrong coordinates?"
    )
    return False, Remark(code="receivers-apart", sentence=sentence)


def _common_sigma(poses: ImagePoses, rows: IntArray) -> float:
    """Return the horizontal σ of the error that positions of the most usual receiver share."""
    kinds = Counter(poses.receivers[int(row)] for row in rows)
    sigma_m = float(np.median(poses.sigma_enu_m[rows, :2].max(axis=1)))
    own_m = COMMON_SIGMA_M[kind_of_receiver(kinds.most_common(1)[0][0], sigma_m)][0]
    return float(np.hypot(own_m, poses.common_sigma_m[0]))


def _few(names: Sequence[str], apart_m: FloatArray, bad: BoolArray, what: str, path: Path) -> Remark:
    """Return the caution of the few positions or heights that differ, where most agree."""
    worst = np.flatnonzero(bad)[np.argsort(-apart_m[bad], kind="stable")]
    sentence = (
        f"{len(worst)} of {len(names)} {what} in {path.name} differ from those in EXIF, by far more than σ, and "
        f"the others agree: {listed([f'{names[row]} {apart_m[row]:.1f} m' for row in worst])}. Those in "
        f"{path.name} are used."
    )
    return Remark(code=f"exif-few-{what}", sentence=sentence)


def _cause(places: _Places, typical_m: float, sigma_m: float) -> tuple[str, str]:
    """Return the code, and the end of a sentence on how most positions differ.

    The first pattern counts that leaves less than half of the median distance.
    `sigma_m` is the σ of that distance.
    """
    apart, names = places.table - places.exif, places.name
    if typical_m > _KILOMETRES_M:
        cause = (
            f"are {typical_m / 1000:.0f} km from those in EXIF. Is it another CRS or zone, or are axes exchanged?"
        )
        return "exif-far-away", cause
    if scatter_about_median(apart) < 0.2 * typical_m:
        east, north = np.median(apart, axis=0)
        cause = (
            f"are shifted by {east:+.1f} m east and {north:+.1f} m north against EXIF. Is it another datum, or a "
            "base station with wrong coordinates?"
        )
        return "exif-shift", cause
    swapped = (places.table - places.table.mean(axis=0))[:, ::-1] - (places.exif - places.exif.mean(axis=0))
    if scatter_about_median(swapped) < 0.5 * scatter_about_median(apart):
        return "exif-axes-exchanged", "are mirrored against those in EXIF: east and north are exchanged."
    if (groups := two_groups(apart)) is not None:
        second = listed([names[row] for row in np.flatnonzero(groups.second)])
        cause = (
            f"differ from those in EXIF: {int(groups.second.sum())} are shifted by {groups.apart[0]:+.1f} m east "
            f"and {groups.apart[1]:+.1f} m north against the others ({second}). Is it another base station?"
        )
        return "exif-two-groups", cause
    if (bad := blunders_among(apart, sigma_m)) is not None and bad.mean() < 0.5:
        off = np.hypot(*(apart - np.median(apart, axis=0)).T)
        rows = np.flatnonzero(bad)[np.argsort(-off[bad], kind="stable")]
        blunders = listed([f"{names[row]} {off[row]:.1f} m" for row in rows])
        return "exif-blunders", f"differ from those in EXIF, and the others agree. Blunders: {blunders}."
    differ = f"differ from those in EXIF by {typical_m:.1f} m"
    nearest, at = KDTree(places.exif).query(places.table)
    if (offset := _clock_offset(places)) is not None:
        return "exif-times-off", f"{differ}, along the track: the times are off by about {offset:+.1f} s."
    if float(np.median(nearest)) < max(2.0 * sigma_m, 0.2 * typical_m) and (at != np.arange(len(at))).mean() > 0.5:
        cause = f"{differ}, but lie where other photographs were taken. Are rows of other images, or times off?"
        return "exif-other-images", cause
    if typical_m < median_spacing(places.exif) / 2:
        return "exif-noise", f"{differ}, without any pattern: the σ of the table or of EXIF is too small."
    return "exif-no-pattern", f"{differ}, in changing directions. Are times off, or rows of other images?"


def _clock_offset(places: _Places) -> float | None:
    """Return the time in s by which the table's positions are later, if that explains half of the difference."""
    order = np.argsort(places.time_s, kind="stable")
    time_s = places.time_s[order]
    if len(order) < _LEAST_TIMED or not np.isfinite(time_s).all() or np.diff(time_s).min() <= 0.0:
        return None
    velocity = np.gradient(places.exif[order], time_s, axis=0)
    apart = (places.table - places.exif)[order]
    offset = float((velocity * apart).sum() / max((velocity**2).sum(), 1e-9))
    residual_m = scatter_about_median(apart - offset * velocity)
    return offset if residual_m < 0.5 * scatter_about_median(apart) else None


def _heights(
    names: Sequence[str], heights_m: FloatArray, apart_m: FloatArray, sigma_m: FloatArray, path: Path
) -> tuple[bool, Remark] | None:
    """Return the caution of heights (n, 2) of table and EXIF that are too far apart (n,) for the σ (n,) of both."""
    offset, spread = float(np.median(apart_m)), mad_sigma(apart_m)
    allowed = max(_SIGMAS * float(np.median(sigma_m)), _LEAST_M)
    if abs(offset) <= allowed:
        off_m = np.abs(apart_m - offset)
        bad = off_m > np.maximum(_SIGMAS * sigma_m, _LEAST_M)
        return (False, _few(names, off_m, bad, "heights", path)) if bad.any() else None
    for factor, cause in ((FOOT_M, "in feet, and taken for metres"), (1 / FOOT_M, "in metres, and taken for feet")):
        residual_m = abs(float(np.median(heights_m[:, 0] * factor - heights_m[:, 1])))
        tolerance = max(_UNIT_PART * abs(float(np.median(heights_m[:, 1]))), allowed / _SIGMAS)
        if abs(offset) > _EVIDENT * allowed and residual_m < tolerance:
            sentence = f"The heights in {path.name} are {cause}: those in EXIF are {factor:.4g} times as large."
            return True, Remark(code="feet", sentence=sentence)
    sentence = (
        f"The heights in {path.name} differ from those in EXIF by {offset:+.1f} m (± {spread:.1f} m): one counts "
        "from the ellipsoid, the other from a geoid, the take-off or a barometer's zero."
    )
    remedy = "State the datum with --vertical."
    return abs(offset) > MOST_GEOID_M, Remark(code="heights-apart", sentence=sentence, remedy=remedy)
