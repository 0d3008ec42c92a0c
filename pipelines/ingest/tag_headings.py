"""Attitudes of photographs by their tags, with headings compared: gimbal's and aircraft's yaw, EXIF's direction.

A gimbal's pitch is −90° where it looks down. The tags that PIX4D has defined, of senseFly, Parrot, Sentera, Autel
and others, describe what the camera is mounted on: their pitch is 0° where it looks down.

A gimbal that integrates its own turning may be off by a constant of each start, with the aircraft's compass right
beside it. At nadir both state the same angle, that of the image's upper edge: a gimbal's yaw and roll turn about
nearly the same axis there, and only both together tell it. Where they differ, the flight's own motion decides: an
aircraft that flies nose first has the yaw of its track. Else the aircraft's yaw counts with a σ that covers both.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.exif import DjiTags
from pipelines.geometry.rotations import exp_so3, geo_from_cam, geo_from_mounted_cam, log_so3
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

_NADIR_SINE = float(np.sin(np.radians(70.0)))  # of the view's dip from which the gimbal's heading is the aircraft's
_APART_DEG = 15.0  # what compass, gimbal and turns explain
_ALONG_DEG = 10.0
_LEAST = 3
_START_GAP_S = 300.0
_MOST_GAP_S = 30.0  # between photographs whose positions give a direction of flight
_LEAST_STEP_M = 3.0
_SIGMA_DEG = 5.0  # of a heading that the motion has corrected, and of an attitude without a gimbal
_BACKWARD_DEG = -45.0  # pitch of a mount below which its camera would look backward


@dataclass(frozen=True)
class TaggedAttitudes:
    """Attitudes of N photographs."""

    enu_from_cam: FloatArray  # (N, 3, 3), NaN without one
    sigma_deg: FloatArray  # (N,) NaN where the default of a gimbal counts


@dataclass(frozen=True)
class _Headings:
    """Headings of N photographs in degrees, NaN where unknown, and the number of each one's start."""

    gimbal: FloatArray
    aircraft: FloatArray
    track: FloatArray  # direction of flight
    start: IntArray


def tagged_attitudes(
    photos: Sequence[Photo], lon_lat: FloatArray, time_s: FloatArray, remarks: Remarks
) -> TaggedAttitudes:
    """Return the attitudes that the tags of photographs state; `lon_lat` (N, 2) in degrees, with times (N,)."""
    tags = [photo.tags.dji or DjiTags() for photo in photos]
    angles, mounted = _angles(tags, remarks)
    second = "the aircraft's yaw"
    aircraft = np.array([np.nan if one.flight_yaw_deg is None else one.flight_yaw_deg for one in tags])
    if not np.isfinite(aircraft).any():
        second = "EXIF's GPSImgDirection"
        directions = (photo.tags.direction_deg for photo in photos)
        aircraft = np.array([np.nan if one is None else one for one in directions])
    enu_from_cam = np.full((len(photos), 3, 3), np.nan)
    known = np.isfinite(angles).all(axis=1)
    enu_from_cam[known & ~mounted] = geo_from_cam(angles[known & ~mounted])
    enu_from_cam[known & mounted] = geo_from_mounted_cam(angles[known & mounted])
    headings = _Headings(_headings_deg(enu_from_cam), aircraft, _track(lon_lat, time_s), _starts(time_s))
    sigma_deg, nadir = np.full(len(photos), np.nan), -enu_from_cam[:, 2, 2] >= _NADIR_SINE
    starts = [headings.start == number for number in np.unique(headings.start)]
    if any(_disagrees(headings, rows & nadir, _LEAST) for rows in starts):
        for rows in starts:
            if _disagrees(headings, rows & nadir, 1):
                heading_deg, sigma_deg[rows] = _of_start(headings, nadir, rows, second, remarks)
                clockwise_rad = np.radians(heading_deg - headings.gimbal[rows])
                enu_from_cam[rows] = exp_so3(clockwise_rad[:, None] * [0.0, 0.0, -1.0]) @ enu_from_cam[rows]
    return TaggedAttitudes(enu_from_cam, np.where(mounted & np.isnan(sigma_deg), _SIGMA_DEG, sigma_deg))


def _angles(tags: Sequence[DjiTags], remarks: Remarks) -> tuple[FloatArray, BoolArray]:
    """Return the yaw, pitch and roll (N, 3) that tags state, NaN without, and which are those of a mount (N,)."""
    unknown = (np.nan, np.nan, np.nan)
    gimbal = np.array([one.gimbal_yaw_pitch_roll_deg or unknown for one in tags]).reshape(-1, 3)
    mount = np.array([one.mount_yaw_pitch_roll_deg or unknown for one in tags]).reshape(-1, 3)
    stated, of_gimbal = np.isfinite(mount[:, 0]), np.isfinite(gimbal[:, 0])
    if not stated.any():
        return gimbal, stated
    as_gimbal = float(np.median(mount[stated, 1])) < _BACKWARD_DEG
    both = stated & of_gimbal
    if both.any():
        second = (geo_from_cam if as_gimbal else geo_from_mounted_cam)(mount[both])
        apart = np.linalg.norm(log_so3(np.swapaxes(geo_from_cam(gimbal[both]), 1, 2) @ second), axis=1)
        if (apart_deg := float(np.degrees(np.median(apart)))) > _APART_DEG:
            remarks.caution(
                "attitudes-apart",
                f"XMP states two attitudes of {int(both.sum())} photographs, the gimbal's and one in PIX4D's tags, "
                f"which differ by {apart_deg:.0f}°. The gimbal's are used.",
            )
    mounted = stated & ~of_gimbal
    if as_gimbal and mounted.any():
        remarks.assume(
            "pitch-as-of-gimbal",
            f"The pitch in PIX4D's tags of {int(mounted.sum())} photographs is {np.median(mount[stated, 1]):.0f}°, "
            "with which a camera would look backward by PIX4D's definition (0° down, 90° ahead): it is taken as a "
            "gimbal's, −90° down.",
        )
    return np.where(of_gimbal[:, None], gimbal, mount), mounted & (not as_gimbal)


def _headings_deg(enu_from_cam: FloatArray) -> FloatArray:
    """Return the headings (N,) of images, clockwise from north, NaN without an attitude.

    It is the direction of the image's upper edge where a camera looks down by more than 45°, else of its view.
    """
    down = -enu_from_cam[:, 2, 2] > np.sqrt(0.5)
    east_north = np.where(down[:, None], -enu_from_cam[:, :2, 1], enu_from_cam[:, :2, 2])
    return np.degrees(np.arctan2(east_north[:, 0], east_north[:, 1]))


def _disagrees(headings: _Headings, rows: BoolArray, least: int) -> bool:
    """Return whether two headings of photographs that look down, at least so many, differ by more than turns do."""
    apart = np.abs(_wrapped(headings.gimbal[rows] - headings.aircraft[rows]))
    apart = apart[np.isfinite(apart)]
    return len(apart) >= least and float(np.median(apart)) > _APART_DEG


def _of_start(
    headings: _Headings, nadir: BoolArray, rows: BoolArray, second: str, remarks: Remarks
) -> tuple[FloatArray, FloatArray]:
    """Return headings and σ (n,) of the photographs of one start; NaN where nothing speaks against it."""
    gimbal, aircraft, track = headings.gimbal[rows], headings.aircraft[rows], headings.track[rows]
    apart = _wrapped(gimbal - aircraft)
    tell = nadir[rows] & np.isfinite(apart)
    undisputed = np.full(len(gimbal), np.nan)
    middle = _middle(apart[tell])
    known = np.isfinite(apart)
    says = (
        f"The gimbal's yaw and {second} of {int(tell.sum())} photographs that look down differ by "
        f"{np.median(np.abs(apart[tell])):.0f}° ({gimbal[tell][0]:.0f}° and {aircraft[tell][0]:.0f}° in the first)"
    )
    of_gimbal, of_aircraft = (_share_along(each[tell], track[tell]) for each in (gimbal, aircraft))
    if of_gimbal > 0.5 > of_aircraft:
        remarks.caution("headings-apart", f"{says}. The gimbal's follows the direction of flight, and is used.")
        return gimbal, undisputed
    if of_aircraft > 0.5 > of_gimbal:
        remarks.caution(
            "headings-apart",
            f"{says}. {second.capitalize()} follows the direction of flight: the gimbal's is corrected by "
            f"{-middle:+.0f}°, with a σ of {_SIGMA_DEG:g}°.",
        )
        straight = tell & (np.abs(_wrapped(aircraft - track)) < _ALONG_DEG)
        corrected = gimbal - _middle(apart[straight])
        return np.where(known, corrected, gimbal), np.where(known, _SIGMA_DEG, undisputed)
    remarks.caution(
        "headings-apart",
        f"{says}, and the direction of flight does not tell which is right. {second.capitalize()} is used, with "
        "the difference as σ.",
    )
    return np.where(known, aircraft, gimbal), np.where(known, np.maximum(np.abs(apart), _SIGMA_DEG), undisputed)


def _track(lon_lat: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return the direction of flight at each of N photographs, degrees; NaN where no neighbour tells it."""
    track = np.full(len(time_s), np.nan)
    known = np.flatnonzero(np.isfinite(time_s) & np.isfinite(lon_lat).all(axis=1))
    order = known[np.argsort(time_s[known], kind="stable")]
    if len(order) < _LEAST:
        return track
    scale = 111_320.0 * np.array([np.cos(np.radians(np.median(lon_lat[order, 1]))), 1.0])
    step = np.diff(lon_lat[order], axis=0) * scale
    usable = (np.linalg.norm(step, axis=1) > _LEAST_STEP_M) & (np.diff(time_s[order]) < _MOST_GAP_S)
    direction = np.degrees(np.arctan2(step[:, 0], step[:, 1]))
    # A photograph in the middle of a line: the steps before and after it have one direction.
    straight = usable[1:] & usable[:-1] & (np.abs(_wrapped(np.diff(direction))) < _ALONG_DEG)
    track[order[1:-1][straight]] = direction[1:][straight]
    return track


def _starts(time_s: FloatArray) -> IntArray:
    """Return the number of the start of each photograph; one where times are missing."""
    start = np.zeros(len(time_s), dtype=np.int64)
    if np.isfinite(time_s).all():
        order = np.argsort(time_s, kind="stable")
        start[order[1:]] = np.cumsum(np.diff(time_s[order]) > _START_GAP_S)
    return start


def _share_along(heading: FloatArray, track: FloatArray) -> float:
    """Return the share of photographs on straight lines whose heading is the direction of flight; 0 of too few."""
    known = np.isfinite(heading) & np.isfinite(track)
    if known.sum() < _LEAST:
        return 0.0
    return float((np.abs(_wrapped(heading[known] - track[known])) < _ALONG_DEG).mean())


def _middle(angles_deg: FloatArray) -> float:
    """Return the median of angles that may wrap around."""
    around = np.angle(np.exp(1j * np.radians(angles_deg)).mean(), deg=True)
    return float(around + np.median(_wrapped(angles_deg - around)))


def _wrapped(degrees: FloatArray) -> FloatArray:
    return (degrees + 180.0) % 360.0 - 180.0
