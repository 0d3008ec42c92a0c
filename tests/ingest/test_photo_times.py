"""Times of photographs in the ways that cameras write them, against a track by time: places, σ and what is said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from pipelines.formats.exif import read_tags
from pipelines.formats.image_file import ImageFile
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.geodesy.enu import Origin, ecef_from_enu, enu_from_ecef, lla_from_ecef
from pipelines.ingest.flight_record import ImagePoses, gap_limit
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.photo_times import with_times
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.table_poses import poses_from_table
from tests.photos import ASCII, RATIONAL, SHORT, Entry, Exif, jpeg
from tests.refusals import codes, numbers, said

ORIGIN = Origin(lat_deg=46.0, lon_deg=7.75, alt_m=1600.0)
START_S = 1715680800.0  # 2024-05-14 10:00:00 UTC
SPEED_M_S = 12.0
EXPOSURE_S = START_S + 2.35 + 3.07 * np.arange(10)
CLOCK, SUBSEC, ZONE, ZONE_HOURS, STAMP, DAY = 0x9003, 0x9291, 0x9011, 0x882A, 7, 0x1D
Write = Callable[[float], Exif]


def text_of(time_s: float, digits: int = 0, mark: str = ".") -> str:
    """EXIF's text of a time, cut off to so many digits."""
    whole = int(time_s // 1)
    text = datetime.fromtimestamp(whole, UTC).strftime("%Y:%m:%d %H:%M:%S")
    return f"{text}{mark}{fraction(time_s, digits)}" if digits else text


def fraction(time_s: float, digits: int = 3) -> str:
    return f"{int((time_s % 1.0) * 10**digits + 1e-4):0{digits}d}"


def clock(time_s: float, *, digits: int = 3, zone: str = "") -> list[Entry]:
    entries: list[Entry] = [(CLOCK, ASCII, text_of(time_s))]
    entries += [(SUBSEC, ASCII, fraction(time_s, digits))] if digits else []
    return entries + ([(ZONE, ASCII, zone)] if zone else [])


def stamp(time_s: float, denominator: int = 1000, *, shown_s: float | None = None) -> list[Entry]:
    """GPSTimeStamp cut off to a fraction of a second, with the day of another time if one is given."""
    of_day = time_s % 86_400.0
    seconds = (int((of_day % 60.0) * denominator + 1e-4), denominator)
    day = datetime.fromtimestamp(time_s if shown_s is None else shown_s, UTC).strftime("%Y:%m:%d")
    return [
        (STAMP, RATIONAL, [(int(of_day // 3600), 1), (int(of_day % 3600 // 60), 1), seconds]),
        (DAY, ASCII, day),
    ]


def track(rate_hz: float = 5.0, jitter_s: float = 0.0) -> PoseTable:
    """Rows of a straight flight to the east, at times that jitter."""
    time_s = np.arange(-2.0, 34.0, 1.0 / rate_hz)
    time_s = time_s + np.random.default_rng(1).uniform(-jitter_s, jitter_s, len(time_s))
    lla = lla_from_ecef(ecef_from_enu(np.column_stack([SPEED_M_S * time_s, 0 * time_s, 0 * time_s]), ORIGIN))
    return PoseTable(
        path=Path("track.csv"),
        source="csv",
        lines=np.arange(len(lla)) + 2,
        names=None,
        time_s=START_S + time_s,
        xyz=lla[:, [1, 0, 2]],
        geographic=True,
        sigma_enu_m=np.tile([0.02, 0.02, 0.03], (len(lla), 1)),
    )


@dataclass(frozen=True)
class Placed:
    """Errors (n,) along the track in metres, σ along it (n,), and what was said."""

    off_m: np.ndarray
    sigma_m: np.ndarray
    remarks: Remarks
    poses: ImagePoses


def placed(write: Write, table: PoseTable | None = None) -> Placed:
    remarks = Remarks()
    photos = [
        Photo(f"{row}.jpg", ImageFile(64, 48, str(row)), read_tags(jpeg(exif=write(float(when)))))
        for row, when in enumerate(EXPOSURE_S)
    ]
    poses = poses_from_table(table or track(), with_times(photos, remarks), IngestOptions(), remarks)
    assert poses.located.all() and poses.along_track_m is not None
    east = enu_from_ecef(poses.position_in_ecef, ORIGIN)[:, 0]
    along_m = np.linalg.norm(poses.along_track_m, axis=(1, 2))
    return Placed(
        east - SPEED_M_S * (EXPOSURE_S - START_S), np.hypot(poses.sigma_enu_m[:, 0], along_m), remarks, poses
    )


def stale(time_s: float, every_s: float = 3.7) -> float:
    """Time of the last fix of a receiver that has one each few seconds."""
    return START_S + np.floor((time_s - START_S) / every_s) * every_s


EXACT: dict[str, Write] = {
    "zone": lambda t: Exif(photo=clock(t + 7200, zone="+02:00")),
    "zone without a colon": lambda t: Exif(photo=clock(t - 12_600, zone="-0330")),
    "zone in hours": lambda t: Exif(photo=[*clock(t + 7200), (ZONE_HOURS, SHORT, 2)]),
    "fraction in the text": lambda t: Exif(photo=[(CLOCK, ASCII, text_of(t, 3)), (ZONE, ASCII, "+00:00")]),
    "fraction after a comma": lambda t: Exif(photo=[(CLOCK, ASCII, text_of(t, 2, ",") + "Z")]),
    "zone in the text": lambda t: Exif(photo=[(CLOCK, ASCII, text_of(t + 3600, 3) + "+01:00")]),
    "fraction twice": lambda t: Exif(
        photo=[(CLOCK, ASCII, text_of(t, 3)), (SUBSEC, ASCII, fraction(t)), (ZONE, ASCII, "Z")]
    ),
    "negative fraction": lambda t: Exif(
        photo=[(CLOCK, ASCII, text_of(t + 1)), (SUBSEC, ASCII, f"-{fraction(1 - t % 1)}"), (ZONE, ASCII, "+00:00")]
    ),
    "receiver in whole seconds": lambda t: Exif(photo=clock(t + 3600), gps=stamp(t, 1)),
    "receiver five times a second": lambda t: Exif(
        photo=clock(t + 3600), gps=stamp(np.floor(5 * t + 1e-6) / 5, 1000)
    ),
    "receiver with fractions, clock in whole seconds": lambda t: Exif(photo=clock(t, digits=0), gps=stamp(t)),
    "receiver as text": lambda t: Exif(
        photo=clock(t + 5 * 3600, digits=0),
        gps=[(STAMP, ASCII, text_of(t, 3)[11:]), (DAY, ASCII, text_of(t)[:10].replace(":", "-"))],
    ),
    "receiver without its day": lambda t: Exif(photo=clock(t + 7200), gps=stamp(t)[:1]),
    "receiver that lost 1024 weeks": lambda t: Exif(photo=clock(t), gps=stamp(t, 1, shown_s=t - 619_315_200.0)),
    "summer time forgotten": lambda t: Exif(photo=clock(t + 7200, zone="+01:00"), gps=stamp(t, 1)),
    "clock 0.65 s late of the receiver": lambda t: Exif(photo=clock(t + 0.65), gps=stamp(t)),
    "clock with microseconds 0.65 s late": lambda t: Exif(photo=clock(t + 0.65, digits=6), gps=stamp(t)),
    "hours that are seconds": lambda t: Exif(
        photo=clock(t), gps=[(STAMP, RATIONAL, [(549_455_200, 1), (0, 1), (0, 1)]), (DAY, ASCII, "2024:05:14")]
    ),
    "minutes out of range": lambda t: Exif(
        photo=clock(t), gps=[(STAMP, RATIONAL, [(10, 1), (75, 1), (0, 1)]), (DAY, ASCII, "2024:05:14")]
    ),
    "receiver that never had a time": lambda t: Exif(
        photo=clock(t), gps=[(STAMP, RATIONAL, [(0, 1), (0, 1), (0, 1)]), (DAY, ASCII, "1980:01:06")]
    ),
}


@pytest.mark.parametrize("name", EXACT)
def test_a_photograph_is_where_it_was_taken(name: str) -> None:
    """Times with two or three digits place photographs at 12 m/s to 0.12 m, a digit's worth."""
    found = placed(EXACT[name])
    assert np.abs(found.off_m).max() < 0.13
    if "0.65" not in name:  # where half of the difference is a σ that all times share
        assert found.sigma_m.max() < 0.1


def _said_values(found: Placed, code: str) -> list[float]:
    return numbers(said(found.remarks.assumptions, code))


def test_clocks_that_differ_are_said_with_both_values_and_widen_sigma() -> None:
    found = placed(EXACT["clock 0.65 s late of the receiver"])
    assert -0.65 in _said_values(found, "photo-times-differ")


@pytest.mark.parametrize("digits", [0, 1])
def test_a_last_fix_that_is_seconds_old_loses(digits: int) -> None:
    """Its time jumps against the camera's clock, by up to 3.7 s: 44 m."""
    found = placed(lambda t: Exif(photo=clock(t), gps=stamp(stale(t), 10**digits)))
    assert np.abs(found.off_m).max() < 0.13
    assert "photo-times-differ" in codes(found.remarks.assumptions)


@pytest.mark.parametrize(
    "write",
    [
        lambda t: Exif(photo=clock(t, digits=0, zone="+00:00")),
        lambda t: Exif(photo=[*clock(t, digits=0), (SUBSEC, ASCII, "00"), (ZONE, ASCII, "+00:00")]),
        lambda t: Exif(photo=clock(t + 3600, digits=0), gps=stamp(t, 1)),
        lambda t: Exif(gps=stamp(t, 1)),
    ],
    ids=["clock", "fractions of zero", "clock and receiver", "receiver"],
)
def test_whole_seconds_are_a_sigma_along_the_track(write: Write) -> None:
    """What is cut off, 0 to 1 s, is 0.5 ± 0.29 s: its root mean square at 12 m/s is 6.9 m."""
    found = placed(write)
    ratio = np.sqrt((found.off_m**2).mean()) / np.median(found.sigma_m)
    assert 0.7 < ratio < 1.4
    assert np.median(found.sigma_m) == pytest.approx(SPEED_M_S * np.sqrt(1 / 12 + 1 / 4), rel=0.02)
    assert found.poses.along_track_m is not None
    along = found.poses.along_track_m[:, :2]
    np.testing.assert_allclose(np.abs(along @ _east()), np.linalg.norm(along, axis=2), rtol=1e-3)
    # An estimated time offset removes what all photographs share, half a second, and leaves 0.29 s.
    assert np.median(np.linalg.norm(along, axis=2), axis=0) == pytest.approx(
        [0.289 * SPEED_M_S, 0.5 * SPEED_M_S], rel=0.02
    )
    assert "photo-times-coarse" in codes(found.remarks.cautions)


def _east() -> np.ndarray:
    lon = np.radians(ORIGIN.lon_deg)
    return np.array([-np.sin(lon), np.cos(lon), 0.0])


def test_a_receiver_in_gps_time_loses() -> None:
    found = placed(lambda t: Exif(photo=clock(t), gps=stamp(t + 18.0)))
    assert np.abs(found.off_m).max() < 0.13
    assert 18.0 in _said_values(found, "photo-times-differ")


def test_what_bends_between_two_rows_of_a_slow_track_is_a_sigma() -> None:
    """A circle of 60 m at 12 m/s, a row each 4 s: the chord is up to 5 m off, and σ says so."""
    table = track(0.25)
    assert table.time_s is not None
    angle = SPEED_M_S * (table.time_s - START_S) / 60.0
    around = np.column_stack([60.0 * np.sin(angle), 60.0 * np.cos(angle), 0.0 * angle])
    table = replace(table, xyz=lla_from_ecef(ecef_from_enu(around, ORIGIN))[:, [1, 0, 2]])
    poses = placed(EXACT["zone"], table).poses
    true = SPEED_M_S * (EXPOSURE_S - START_S) / 60.0
    off = enu_from_ecef(poses.position_in_ecef, ORIGIN)[:, :2] - 60.0 * np.column_stack(
        [np.sin(true), np.cos(true)]
    )
    assert poses.along_track_m is not None
    sigma_m = np.linalg.norm(poses.along_track_m, axis=(1, 2))
    assert np.linalg.norm(off, axis=1).max() > 3.0
    assert (np.linalg.norm(off, axis=1) < 1.5 * sigma_m + 0.1).all()


@pytest.mark.parametrize(
    ("rate_hz", "jitter_s"), [(1.0, 0.04), (1.0, 0.3), (0.5, 0.1), (0.2, 0.0)], ids=["4 %", "30 %", "2 s", "5 s"]
)
def test_a_slow_track_whose_stamps_jitter_is_interpolated(rate_hz: float, jitter_s: float) -> None:
    found = placed(EXACT["zone"], track(rate_hz, jitter_s))
    assert np.abs(found.off_m).max() < 0.02  # a straight line at one speed


def test_a_gap_is_long_by_the_rate_of_the_track() -> None:
    auto = IngestOptions()
    assert gap_limit(np.arange(0.0, 60.0, 0.2), auto) == 1.0
    assert gap_limit(np.arange(0.0, 60.0, 1.0), auto) == pytest.approx(2.5)
    with_pause = np.concatenate([np.arange(0.0, 60.0, 1.0), np.arange(600.0, 660.0, 1.0)])
    assert gap_limit(with_pause, auto) == pytest.approx(2.5)
    assert gap_limit(with_pause, IngestOptions(max_gap=7.0)) == 7.0
