"""Heights whose zero is doubtful: above the take-off, below or far above the ground that is known.

Drones write heights of a barometer, which count from the take-off, into tags of heights above sea level or the
ellipsoid. Nothing later would notice: such a flight is whole, and lies as far off as its take-off lies high.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipelines.core.figures import length_text
from pipelines.core.products import Remark
from pipelines.core.types import FloatArray
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import lla_from_ecef
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalChoice
from pipelines.ingest.flight_record import FlightRecord
from pipelines.ingest.ground_points import GroundFile

# σ of an assumed datum: half of the largest distance between the ellipsoid and any geoid, rounded.
SIGMA_DATUM_M = 50.0
# σ of a zero that is the take-off: nine tenths of the land lie within it of the ellipsoid.
SIGMA_TAKE_OFF_M = 1000.0
_SAME_M, _MOST = 0.11, 0.9  # heights with one decimal, of nine photographs in ten
_NEAR_ZERO_M, _CLIMB_M = 5.0, 15.0  # of a flight that begins on the ground
_BELOW_M, _BELOW_STATED_M = 10.0, 30.0  # by which cameras lie below all of the ground that is known
_FAR_M, _FAR_EXTENTS = 500.0, 3.0  # above the ground, and above so many times the width of the flight
_LEAST = 3  # photographs


@dataclass(frozen=True)
class HeightDoubt:
    """Why the zero of a flight's heights is doubtful, and its σ in metres."""

    remark: Remark
    sigma_m: float


@dataclass(frozen=True)
class KnownGround:
    """Ground whose heights (K,) above the ellipsoid are known, and who knows them."""

    source: str
    height_m: FloatArray
    stated: bool  # whether the datum of these heights is stated


def known_ground(
    files: Sequence[GroundFile],
    ground_height_m: float | None,
    vertical: VerticalChoice | None,
    flight: FlightRecord,
) -> tuple[KnownGround, ...]:
    """Return the heights of surveyed points, and that of `--ground-height`, in the datum of `--vertical`."""
    sources = []
    for file in files:
        if file.points:
            heights = lla_from_ecef([point.position_in_ecef for point in file.points])[:, 2]
            sources.append(
                KnownGround(f"the points of {file.path.name}", heights, not file.crs.vertical.is_assumed)
            )
    located = flight.poses.located
    if ground_height_m is not None and located.any():
        lat, lon, _ = np.median(lla_from_ecef(flight.poses.position_in_ecef[located]), axis=0)
        crs = parse_crs(WGS84, vertical=vertical)
        height = crs.lla_from_xyz([[lon, lat, ground_height_m]])[:, 2]
        sources.append(KnownGround("the terrain of the stated height", height, not crs.vertical.is_assumed))
    return tuple(sources)


def height_doubts(flight: FlightRecord, ground: Sequence[KnownGround]) -> tuple[HeightDoubt, ...]:
    """Return every reason to doubt the zero of the heights of a flight; the first is the best founded.

    1. Heights equal those above the take-off, which the photographs hold beside them.
    2. All cameras lie below the known ground, or far above it.
    3. Heights whose datum nobody stated, also those of a message with one datum by definition, begin near zero and
       climb, as above the take-off.
    """
    poses = flight.poses
    rows = np.flatnonzero(poses.located)
    if len(rows) < _LEAST:
        return ()
    cam_center_in_ecef = poses.position_in_ecef[rows]
    height = lla_from_ecef(cam_center_in_ecef)[:, 2]
    doubts = _equal_to_relative(flight, rows, height)
    width_m = float(np.linalg.norm(np.ptp(cam_center_in_ecef, axis=0)))
    doubts += tuple(
        doubt
        for each in ground
        if (doubt := _against_ground(height, each, width_m, stated=not poses.vertical.is_assumed)) is not None
    )
    if not doubts and not poses.vertical.stated and not _has_relative(flight, rows):
        doubts += _begins_near_zero(height, poses.time_s[rows])
    return doubts


def _relative_m(flight: FlightRecord, rows: np.ndarray) -> FloatArray:
    """Return the heights above the take-off (N,) that photographs state; NaN where none does."""
    tags = [flight.photos[row].tags.dji for row in rows.tolist()]
    stated = [None if dji is None else dji.relative_altitude_m for dji in tags]
    return np.array([np.nan if value is None else value for value in stated])


def _has_relative(flight: FlightRecord, rows: np.ndarray) -> bool:
    return bool(np.isfinite(_relative_m(flight, rows)).mean() > _MOST)


def _equal_to_relative(flight: FlightRecord, rows: np.ndarray, height: FloatArray) -> tuple[HeightDoubt, ...]:
    """Return the doubt of heights that are those above the take-off, as the tags of the photographs have them.

    Compared is the height as it was read, before any geoid: that of EXIF or DJI's absolute one, and that of a table
    where a table has the positions.
    """
    relative = _relative_m(flight, rows)
    tags = [flight.photos[row].tags for row in rows.tolist()]
    read = {"used": height, "GPSAltitude": _numbers([None if tag.gps is None else tag.gps.alt_m for tag in tags])}
    if flight.poses.source != "exif":
        read.pop("GPSAltitude")
    for values in read.values():
        both = np.isfinite(values) & np.isfinite(relative)
        if both.sum() < _LEAST or np.mean(np.abs(values[both] - relative[both]) <= _SAME_M) < _MOST:
            continue
        low, high = float(relative[both].min()), float(relative[both].max())
        sentence = (
            f"The heights of {int(both.sum())} photographs count from the take-off: they equal RelativeAltitude "
            f"({low:.1f} to {high:.1f} m). The height of the take-off is unknown, and so is every height of the "
            "result."
        )
        remedy = "Give control points with heights (--gcp), or positions with heights (--trajectory)."
        remark = Remark(code="heights-above-takeoff", sentence=sentence, remedy=remedy)
        return (HeightDoubt(remark, SIGMA_TAKE_OFF_M),)
    return ()


def _numbers(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values])


def _against_ground(height: FloatArray, ground: KnownGround, width_m: float, *, stated: bool) -> HeightDoubt | None:
    """Return the doubt of cameras (N,) that all lie below the ground, or farther above it than any drone flies."""
    below_m = float(ground.height_m.min() - height.max())
    above_m = float(height.min() - ground.height_m.max())
    allowed_m = _BELOW_STATED_M if stated and ground.stated else _BELOW_M
    apart_m = float(np.median(ground.height_m) - np.median(height))
    if below_m > allowed_m:
        code, what = "cameras-below-ground", f"All cameras lie below {ground.source}, by {length_text(apart_m)}"
    elif above_m > max(_FAR_M, _FAR_EXTENTS * width_m):
        code, what = (
            "cameras-far-above-ground",
            f"All cameras lie {length_text(-apart_m)} above {ground.source}, and the flight is only "
            f"{length_text(width_m)} wide",
        )
    else:
        return None
    low, high = float(height.min()), float(height.max())
    sentence = (
        f"{what} (medians). The heights of the cameras, {low:.1f} to {high:.1f} m, may count from the take-off, or "
        "one side has another datum or unit. Their zero counts as unknown: control points decide the heights."
    )
    remedy = "Check both, and state the datum with --vertical."
    return HeightDoubt(Remark(code=code, sentence=sentence, remedy=remedy), max(SIGMA_DATUM_M, abs(apart_m)))


def _begins_near_zero(height: FloatArray, time_s: FloatArray) -> tuple[HeightDoubt, ...]:
    """Return the doubt of heights (N,) that begin within metres of zero, and climb; the first in time counts."""
    order = np.argsort(time_s, kind="stable") if np.isfinite(time_s).all() else np.arange(len(time_s))
    first, top = float(height[order[0]]), float(height.max())
    if abs(first) > _NEAR_ZERO_M or top - first < _CLIMB_M or float(height.min()) < -_NEAR_ZERO_M:
        return ()
    sentence = (
        f"The heights begin at {first:.1f} m and climb to {top:.1f} m: they may count from the take-off, and "
        "nobody stated their datum. Where the take-off lies at sea level they may be right."
    )
    remedy = (
        "Then state it with --vertical. Else give control points with heights (--gcp), or positions with heights "
        "(--trajectory)."
    )
    return (HeightDoubt(Remark(code="heights-begin-at-zero", sentence=sentence, remedy=remedy), SIGMA_DATUM_M),)
