"""Poses of images from the photographs' own tags: EXIF, and DJI's XMP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.core.types import FloatArray
from pipelines.formats.exif import PhotoTags
from pipelines.formats.pose_table import complete
from pipelines.formats.xmp import RTK_FIXED, RTK_FLOAT
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import assumed_ellipsoidal
from pipelines.geometry.rotations import geo_from_cam
from pipelines.ingest.image_poses import AttitudeSource, ImagePoses
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.position_sigma import with_defaults

# Vertical over horizontal σ of a fix that states only the horizontal one.
_VERTICAL_RATIO = 2.0
_EXIF_NOTE = "EXIF altitude, which is often above a geoid or barometric, taken as ellipsoidal: see --vertical"


def poses_from_tags(photos: Sequence[Photo], options: IngestOptions, notes: Notes) -> ImagePoses:
    """Return positions from EXIF, attitudes and RTK σ from DJI's XMP.

    Raises:
        InputError: `--vertical` names a geoid whose grid is missing.
    """
    xyz = np.array([_lon_lat_alt(photo.tags) for photo in photos])
    located = complete(xyz)
    flat = [photo.name for photo in photos if photo.tags.gps is not None and altitude_m(photo.tags) is None]
    notes.warn_counted(
        flat, "image has a GPS position without altitude", "images have GPS positions without altitude"
    )
    datums = sorted({photo.tags.gps.datum for photo in photos if photo.tags.gps is not None} - {""})
    if datums:
        notes.assume(f"GPSMapDatum {', '.join(datums)} is taken as WGS84")
    crs = parse_crs(WGS84, vertical=options.vertical)
    position_in_ecef = np.full((len(photos), 3), np.nan)
    position_in_ecef[located] = ecef_from_lla(crs.lla_from_xyz(xyz[located]))
    stated = np.array([_stated_sigma(photo.tags) for photo in photos])
    receivers = tuple(_receiver(photo.tags) for photo in photos)
    sigma, sigma_source = with_defaults(stated, receivers, located, options, notes)
    gimbal: list[AttitudeSource] = ["gimbal" for _ in photos]
    return ImagePoses(
        position_in_ecef=position_in_ecef,
        sigma_enu_m=sigma,
        sigma_source=sigma_source,
        receivers=receivers,
        enu_from_cam=gimbal_attitudes(photos),
        attitude_source=tuple(gimbal),
        sigma_attitude_deg=np.full(len(photos), np.nan),
        time_s=photo_times(photos),
        source="exif",
        crs_name=WGS84,
        vertical=crs.vertical if crs.vertical.stated else assumed_ellipsoidal(_EXIF_NOTE),
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


def gimbal_attitudes(photos: Sequence[Photo]) -> FloatArray:
    """Return rotations camera → East-North-Up (N, 3, 3) from DJI's XMP, NaN where it has none."""
    enu_from_cam = np.full((len(photos), 3, 3), np.nan)
    for row, photo in enumerate(photos):
        dji = photo.tags.dji
        if dji is not None and dji.gimbal_yaw_pitch_roll_deg is not None:
            enu_from_cam[row] = geo_from_cam(dji.gimbal_yaw_pitch_roll_deg)
    return enu_from_cam


def _lon_lat_alt(tags: PhotoTags) -> tuple[float, float, float]:
    gps = tags.gps
    return (np.nan, np.nan, np.nan) if gps is None else (gps.lon_deg, gps.lat_deg, _or_nan(altitude_m(tags)))


def _stated_sigma(tags: PhotoTags) -> FloatArray:
    """Return σ east, north, up (3,) that the tags state, NaN if none."""
    if tags.dji is not None and tags.dji.rtk_sigma_enu_m is not None:
        return np.array(tags.dji.rtk_sigma_enu_m)
    if tags.gps is not None and tags.gps.sigma_h_m is not None:
        return tags.gps.sigma_h_m * np.array([1.0, 1.0, _VERTICAL_RATIO])
    return np.full(3, np.nan)


def _receiver(tags: PhotoTags) -> str:
    flag = None if tags.dji is None else tags.dji.rtk_flag
    return {RTK_FIXED: "RTK fixed", RTK_FLOAT: "RTK float"}.get(flag or 0, "single-frequency")


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
