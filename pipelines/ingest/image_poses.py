"""Positions and attitudes of images on Earth, with σ: from the photographs' own tags or from a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import BoolArray, FloatArray, IntArray
from pipelines.formats.exif import PhotoTags
from pipelines.formats.pose_table import PoseTable, complete
from pipelines.formats.xmp import RTK_FIXED, RTK_FLOAT
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import ecef_from_lla, lla_from_ecef, median_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalChoice, VerticalDatum, assumed_ellipsoidal
from pipelines.geometry.rotations import geo_from_cam, quat_xyzw_from_matrix
from pipelines.ingest.notes import Notes
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.pose_matching import interpolate, match_by_name
from pipelines.ingest.pose_tables import usable_rows

SigmaSource = Literal["file", "option", "default"]
AttitudeSource = Literal["gimbal", "csv", "geo.txt", "bag"]
# σ horizontal and vertical in metres where the file is silent, by kind of receiver.
SIGMA_M = {
    "RTK fixed": (0.02, 0.03),
    "RTK float": (0.5, 1.0),
    "single-frequency": (2.5, 5.0),
    "unknown receiver": (5.0, 10.0),
}
KINDS = tuple(SIGMA_M)  # from the best to the worst
# Vertical over horizontal σ of a fix that states only the horizontal one.
_VERTICAL_RATIO = 2.0
_DISAGREEMENT_M = 2_000.0
_EXIF_NOTE = "EXIF altitude, which is often above a geoid or barometric, taken as ellipsoidal: see --vertical"


@dataclass(frozen=True)
class PoseOptions:
    """How to read positions: options of `ingest` under the same names."""

    crs: str | None = None
    vertical: VerticalChoice | None = None
    max_gap_s: float = 1.0
    time_offset_s: float = 0.0
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None


@dataclass(frozen=True)
class Measured:
    """What was measured of N images; NaN rows where nothing was.

    Attributes:
        lla: (N, 3) WGS84 latitude, longitude, ellipsoidal height.
        sigma_enu_m: (N, 3).
        sigma_source: (N,) who gave σ.
        quat_xyzw: (N, 4) rotation camera → East-North-Up at the camera.
        attitude_source: (N,) where it is from.
        time_s: (N,) seconds since 1970 UTC.
        source: where positions are from.
        crs_name: their CRS.
        vertical: what their heights counted from.
        sigma_attitude_deg: (N,) σ that the attitudes state, NaN where none; None for none at all.
        recorded: the table that images were matched with by time, Earth-centred; None where it was by name.
    """

    lla: FloatArray
    sigma_enu_m: FloatArray
    sigma_source: tuple[SigmaSource, ...]
    quat_xyzw: FloatArray
    attitude_source: tuple[AttitudeSource, ...]
    time_s: FloatArray
    source: Literal["exif", "csv", "geo.txt", "bag"]
    crs_name: str
    vertical: VerticalDatum
    sigma_attitude_deg: FloatArray | None = None
    recorded: PoseTable | None = None

    @property
    def located(self) -> BoolArray:
        """(N,) which images have a position."""
        return complete(self.lla)


def from_tags(photos: Sequence[Photo], options: PoseOptions, notes: Notes) -> Measured:
    """Positions from EXIF, attitudes and RTK σ from DJI's XMP.

    Raises:
        InputError: `--vertical` names a geoid whose grid is missing.
    """
    xyz = np.array([_xyz(photo.tags) for photo in photos])
    known = complete(xyz)
    flat = [photo.name for photo in photos if photo.tags.gps is not None and altitude_m(photo.tags) is None]
    notes.warn_counted(
        flat, "image has a GPS position without altitude", "images have GPS positions without altitude"
    )
    datums = sorted({photo.tags.gps.datum for photo in photos if photo.tags.gps is not None} - {""})
    if datums:
        notes.assume(f"GPSMapDatum {', '.join(datums)} is taken as WGS84")
    crs = parse_crs(WGS84, vertical=options.vertical)
    lla = np.full((len(photos), 3), np.nan)
    lla[known] = crs.lla_from_xyz(xyz[known])
    gimbal: list[AttitudeSource] = ["gimbal" for _ in photos]
    rows = [_tag_sigma(photo.tags) for photo in photos]
    sigma, source = with_defaults([row[0] for row in rows], [row[1] for row in rows], known, options, notes)
    vertical = crs.vertical if crs.vertical.stated else assumed_ellipsoidal(_EXIF_NOTE)
    return Measured(
        lla=lla,
        sigma_enu_m=sigma,
        sigma_source=source,
        quat_xyzw=_gimbals(photos),
        attitude_source=tuple(gimbal),
        time_s=np.array([_or_nan(photo.tags.timestamp_s) for photo in photos]),
        source="exif",
        crs_name=WGS84,
        vertical=vertical,
    )


def from_table(table: PoseTable, photos: Sequence[Photo], options: PoseOptions, notes: Notes) -> Measured:
    """Positions, and attitudes if it has them, from a CSV trajectory or `geo.txt`; else attitudes from XMP.

    Rows are matched by name if the table has names, else by time. An image without a row has no position here,
    even if its EXIF has one: two receivers are not mixed unseen.

    Raises:
        InputError: no row with a position, no CRS for x,y,z, contradicting options, impossible coordinates, or no
            image matched.
    """
    table = usable_rows(table, notes)
    crs = _crs_of(table, options, notes)
    images = [photo.name for photo in photos]
    rows = match_by_name(table, images, notes) if table.names is not None else table
    rows = _with_heights(rows, photos, crs, notes) if rows.names is not None else rows
    lla = crs.lla_from_xyz(rows.xyz, path=table.path, lines=rows.lines.tolist())
    note_operation(crs, lla, notes)
    if table.sigma_enu_m is not None and "foot" in crs.units[0]:
        notes.assume(f"σ in {table.path.name} are in metres, although {crs.name} counts in feet")
    _compare_with_exif(median_lla(lla), photos, table.path, notes)
    cartesian, by_time = replace(rows, xyz=ecef_from_lla(lla)), None
    if rows.names is not None:
        at = np.array([images.index(name) for name in rows.names])
    else:
        by_time = cartesian
        cartesian, at = _match_by_time(cartesian, photos, options, notes)
    count = len(photos)
    absent = np.setdiff1d(np.arange(count), at)
    notes.warn_counted(
        [images[index] for index in absent],
        f"image has no position in {table.path.name}",
        f"images have no position in {table.path.name}",
    )
    sigma, sigma_source = with_defaults(
        list(_spread(cartesian.sigma_enu_m, at, count, 3)),
        ["unknown receiver"] * count,
        np.isin(np.arange(count), at),
        options,
        notes,
    )
    quat, recorded = _gimbals(photos), _spread(cartesian.quat_xyzw, at, count, 4)
    from_file = complete(recorded)
    quat[from_file] = recorded[from_file]
    attitude_source: list[AttitudeSource] = [table.source if one else "gimbal" for one in from_file]
    times = _spread(None if cartesian.time_s is None else cartesian.time_s[:, None], at, count, 1)[:, 0]
    from_exif = np.array([_or_nan(photo.tags.timestamp_s) for photo in photos])
    return Measured(
        lla=_spread(lla_from_ecef(cartesian.xyz), at, count, 3),
        sigma_enu_m=sigma,
        sigma_source=sigma_source,
        quat_xyzw=quat,
        attitude_source=tuple(attitude_source),
        time_s=np.where(np.isfinite(times), times, from_exif),
        source=table.source,
        crs_name=crs.name,
        vertical=crs.vertical,
        recorded=by_time,
    )


def note_operation(crs: PointCrs, lla: FloatArray, notes: Notes) -> None:
    """Record how well the way from a CRS to WGS84 is known, where that may matter."""
    if not len(lla):
        return
    operation = crs.operation(lla)
    if operation.accuracy_m is None or operation.accuracy_m >= 0.5:
        known = "an unknown accuracy" if operation.accuracy_m is None else f"{operation.accuracy_m:g} m"
        notes.assume(f"{crs.name} is brought to WGS84 by “{operation.name}”, published with {known}")
    if operation.missing_grids:
        notes.warn(f"{crs.name}: a better way to WGS84 needs the PROJ grid {', '.join(operation.missing_grids)}")
    if crs.height_unit != "metre":
        notes.assume(f"heights of {crs.name} are in {crs.height_unit}")


def settle_vertical(crs: PointCrs, options: PoseOptions, place: Path | str, notes: Notes) -> None:
    """Say so when a file states its own vertical datum although `--vertical` names one."""
    if options.vertical is not None and crs.states_vertical and crs.vertical.name != options.vertical.name:
        notes.assume(
            f"heights of {place} are {crs.vertical.name}, as its CRS says; --vertical does not apply to them"
        )


def _crs_of(table: PoseTable, options: PoseOptions, notes: Notes) -> PointCrs:
    place = table.path
    if table.crs_text is not None:
        crs = parse_crs(table.crs_text, vertical=options.vertical, path=place, line=1)
        settle_vertical(crs, options, place.name, notes)
        return crs
    if options.crs is None:
        if not table.geographic:
            raise InputError("columns x,y,z need their CRS: give --crs, e.g. --crs EPSG:32632", path=place)
        notes.assume(f"latitude and longitude in {place.name} are WGS84 ({WGS84})")
        return parse_crs(WGS84, vertical=options.vertical)
    crs = parse_crs(options.crs, vertical=options.vertical, field="--crs")
    if table.geographic and not crs.is_geographic:
        raise InputError(f"{place.name} has latitude and longitude, but {crs.name} has none", field="--crs")
    if options.vertical is not None and crs.states_vertical and crs.vertical.name != options.vertical.name:
        raise InputError(f"contradicts --crs {crs.name}, whose heights are {crs.vertical.name}", field="--vertical")
    return crs


def _compare_with_exif(middle: FloatArray, photos: Sequence[Photo], path: Path, notes: Notes) -> None:
    """Tell when a table and EXIF disagree by kilometres: a wrong zone passes all other checks."""
    found = [(tags.gps.lat_deg, tags.gps.lon_deg, 0.0) for tags in (photo.tags for photo in photos) if tags.gps]
    if not found:
        return
    exif, table = ecef_from_lla(np.stack([median_lla(found), middle * [1.0, 1.0, 0.0]]))
    distance_m = float(np.linalg.norm(exif - table))
    if distance_m > _DISAGREEMENT_M:
        notes.warn(
            f"positions in {path.name} are {distance_m / 1000:.0f} km from those in EXIF: wrong CRS or zone?"
        )


def _with_heights(rows: PoseTable, photos: Sequence[Photo], crs: PointCrs, notes: Notes) -> PoseTable:
    """Fill heights that the table lacks from EXIF, and leave out the rows where that has none either."""
    lacking = np.flatnonzero(np.isnan(rows.xyz[:, 2]))
    if not len(lacking) or rows.names is None:
        return rows
    altitude = {photo.name: altitude_m(photo.tags) for photo in photos}
    xyz = rows.xyz.copy()
    if crs.height_unit == "metre":
        xyz[lacking, 2] = [_or_nan(altitude.get(rows.names[row])) for row in lacking]
    filled = complete(xyz)
    if filled[lacking].any():
        notes.assume(f"heights that {rows.path.name} lacks are from EXIF ({int(filled[lacking].sum())})")
    places = [f"{rows.path.name}:{line}" for line in rows.lines[~filled]]
    notes.warn_counted(places, "row has no height and was left out", "rows have no height and were left out")
    if not filled.any():
        raise InputError("has no heights (z), and EXIF has none either", path=rows.path)
    return replace(rows, xyz=xyz).take(filled)


def _match_by_time(
    table: PoseTable, photos: Sequence[Photo], options: PoseOptions, notes: Notes
) -> tuple[PoseTable, IntArray]:
    times = np.array([_or_nan(photo.tags.timestamp_s) for photo in photos])
    timeless = [photo.name for photo in photos if photo.tags.timestamp_s is None]
    notes.warn_counted(timeless, "image has no time in EXIF", "images have no time in EXIF")
    if len(timeless) == len(photos):
        raise InputError("has no column image, and no image has a time in EXIF", path=table.path, field="timestamp")
    if any(photo.tags.time_source == "assumed UTC" for photo in photos):
        notes.assume("EXIF times without a zone are UTC")
    max_gap_s, offset_s = options.max_gap_s, options.time_offset_s
    rows, found = interpolate(table, times + offset_s, max_gap_s)
    if not found.any():
        raise InputError(
            f"covers {_span(np.asarray(table.time_s))}, the images {_span(times)}: none fits, with gaps of "
            f"{max_gap_s:g} s at most. Is the camera's clock in another time zone? Is --max-gap too small?",
            path=table.path,
            field="timestamp",
        )
    return replace(rows, time_s=times[found]), np.flatnonzero(found)


def _span(times: FloatArray) -> str:
    ends = (datetime.fromtimestamp(float(end), UTC) for end in (np.nanmin(times), np.nanmax(times)))
    return " to ".join(end.strftime("%Y-%m-%d %H:%M:%S UTC") for end in ends)


def altitude_m(tags: PhotoTags) -> float | None:
    """Return the height of a photograph that has a GPS position: EXIF's, else that of DJI's XMP."""
    if tags.gps is None:
        return None
    if tags.gps.alt_m is None and tags.dji is not None:
        return tags.dji.absolute_altitude_m
    return tags.gps.alt_m


def _tag_sigma(tags: PhotoTags) -> tuple[FloatArray, str]:
    """σ that the tags state (NaN if none), and the kind of receiver."""
    dji, gps = tags.dji, tags.gps
    kind = "single-frequency"
    if dji is not None and dji.rtk_flag in (RTK_FIXED, RTK_FLOAT):
        kind = "RTK fixed" if dji.rtk_flag == RTK_FIXED else "RTK float"
    if dji is not None and dji.rtk_sigma_enu_m is not None:
        return np.array(dji.rtk_sigma_enu_m), kind
    if gps is not None and gps.sigma_h_m is not None:
        return gps.sigma_h_m * np.array([1.0, 1.0, _VERTICAL_RATIO]), kind
    return np.full(3, np.nan), kind


def with_defaults(
    stated: Sequence[FloatArray], kinds: Sequence[str], known: BoolArray, options: PoseOptions, notes: Notes
) -> tuple[FloatArray, tuple[SigmaSource, ...]]:
    """σ (N, 3) by precedence: option, then file, then the receiver's default; and which it was."""
    result = np.array(
        [np.where(np.isfinite(row), row, _default(kind)) for row, kind in zip(stated, kinds, strict=True)]
    )
    from_file = complete(np.array(stated))
    if options.sigma_h_m is not None:
        result[:, :2] = options.sigma_h_m
    if options.sigma_v_m is not None:
        result[:, 2] = options.sigma_v_m
    for kind in sorted(set(kinds)):
        rows = known & ~from_file & np.array([one == kind for one in kinds])
        h, v = SIGMA_M[kind]
        parts = [f"{h:g} m horizontal"] if options.sigma_h_m is None else []
        parts += [f"{v:g} m vertical"] if options.sigma_v_m is None else []
        if rows.any() and parts:
            notes.assume(f"σ of positions without one ({int(rows.sum())}): {', '.join(parts)} ({kind})")
    overridden = options.sigma_h_m is not None or options.sigma_v_m is not None
    sources: list[SigmaSource] = ["option" if overridden else "file" if one else "default" for one in from_file]
    return result, tuple(sources)


def _default(kind: str) -> FloatArray:
    h, v = SIGMA_M[kind]
    return np.array([h, h, v])


def _gimbals(photos: Sequence[Photo]) -> FloatArray:
    """(N, 4) rotations camera → East-North-Up from DJI's XMP, NaN where there are none."""
    result = np.full((len(photos), 4), np.nan)
    for row, photo in enumerate(photos):
        dji = photo.tags.dji
        if dji is not None and dji.gimbal_yaw_pitch_roll_deg is not None:
            result[row] = quat_xyzw_from_matrix(geo_from_cam(dji.gimbal_yaw_pitch_roll_deg))
    return result


def _spread(values: FloatArray | None, at: IntArray, count: int, width: int) -> FloatArray:
    """Rows (K, width) put at places `at` (K,) of `count`, NaN elsewhere."""
    result = np.full((count, width), np.nan)
    if values is not None:
        result[at] = values
    return result


def _xyz(tags: PhotoTags) -> tuple[float, float, float]:
    gps = tags.gps
    return (np.nan, np.nan, np.nan) if gps is None else (gps.lon_deg, gps.lat_deg, _or_nan(altitude_m(tags)))


def _or_nan(value: float | None) -> float:
    return np.nan if value is None else value
