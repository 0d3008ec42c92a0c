"""Positions of a table against those of EXIF: what is wrong is named, and what is everyday is let through."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from pipelines.core.errors import InconsistencyError
from pipelines.formats.exif import GpsTag, PhotoTags
from pipelines.formats.image_file import ImageFile
from pipelines.geodesy.enu import Origin, ecef_from_enu, ecef_from_lla, lla_from_ecef
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.ingest.exif_poses import compare_with_exif
from pipelines.ingest.flight_record import ImagePoses
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from tests.refusals import numbers, refused

ORIGIN = Origin(lat_deg=46.0, lon_deg=7.75, alt_m=1600.0)
PATH = Path("t.csv")
_ANGLE = np.linspace(0, 2 * np.pi, 12, endpoint=False)
TRACK = np.column_stack([90 * np.cos(_ANGLE), 60 * np.sin(_ANGLE), 80 + 5 * np.cos(3 * _ANGLE)])
HALF = np.array([1, 0, 0, 1, 0, 1, 1, 0, 1, 0, 0, 1])  # of the photographs, in no order
SCATTERED = np.random.default_rng(3).normal(0, [60.0, 60.0, 0.0], TRACK.shape)
BLUNDERS = np.isin(np.arange(12), [1, 4, 5, 8, 10])  # 42 %


def photos_at(positions: np.ndarray) -> list[Photo]:
    """Photographs whose EXIF has these positions (n, 3) in geo, of a receiver without corrections."""
    lla = lla_from_ecef(ecef_from_enu(positions, ORIGIN))
    tags = [PhotoTags(gps=GpsTag(*map(float, place), None, "")) for place in lla]
    return [Photo(f"{row}.jpg", ImageFile(64, 48, str(row)), tag) for row, tag in enumerate(tags)]


def table_of(positions_in_ecef: np.ndarray) -> ImagePoses:
    """Poses of a table with RTK."""
    count = len(positions_in_ecef)
    return ImagePoses(
        position_in_ecef=positions_in_ecef,
        sigma_enu_m=np.tile([0.02, 0.02, 0.03], (count, 1)),
        sigma_source=("file",) * count,
        receivers=("unknown receiver",) * count,
        enu_from_cam=np.full((count, 3, 3), np.nan),
        attitude_source=("csv",) * count,
        sigma_attitude_deg=np.full(count, np.nan),
        time_s=np.full(count, np.nan),
        source="csv",
        crs_name="EPSG:4979",
        vertical=VerticalDatum(name="ellipsoidal", stated=True),
    )


def compared(positions: np.ndarray, options: IngestOptions | None = None) -> Remarks:
    """Remarks of a table with these positions (n, 3) in geo, whose photographs are on `TRACK`."""
    remarks = Remarks()
    table = table_of(ecef_from_enu(positions, ORIGIN))
    compare_with_exif(table, photos_at(TRACK), PATH, options or IngestOptions(), remarks)
    return remarks


def test_receivers_that_differ_by_metres_agree() -> None:
    noise = np.random.default_rng(0).normal(0, [2.5, 2.5, 5.0], TRACK.shape)
    assert compared(TRACK + noise).cautions == []


def test_sigma_stated_for_the_table_is_not_that_of_exif() -> None:
    noise = np.random.default_rng(0).normal(0, [2.5, 2.5, 5.0], TRACK.shape)
    assert compared(TRACK + noise, IngestOptions(sigma_h=0.02, sigma_v=0.03)).cautions == []


@pytest.mark.parametrize(
    ("positions", "code", "says"),
    [
        (TRACK[:, [1, 0, 2]], "exif-axes-exchanged", "t.csv"),
        (np.roll(TRACK, 1, axis=0), "exif-other-images", "t.csv"),
        (np.random.default_rng(1).permutation(TRACK), "exif-other-images", "t.csv"),
        (TRACK + HALF[:, None] * [30.0, 0.0, 0.0], "exif-two-groups", r"6 .*[+-]30.0 m east .*[+-]0.0 m north"),
        (TRACK + BLUNDERS[:, None] * SCATTERED, "exif-blunders", "1.jpg"),
        (TRACK + np.random.default_rng(2).normal(0, [17, 17, 0], TRACK.shape), "exif-noise", "t.csv"),
        (TRACK + np.array([60.0, 80.0, 0.0]), "exif-shift", r"\+60.0 m east .*\+80.0 m north"),
        (TRACK + np.array([30_000.0, 0.0, 0.0]), "exif-far-away", "30 km"),
        (TRACK - [0.0, 0.0, 1600.0], "heights-apart", r"-1600.0 m"),
    ],
    ids=["mirrored", "late", "others", "half", "blunders", "noise", "shifted", "zone", "take-off"],
)
def test_inconsistencies_are_named_and_can_be_accepted(positions: np.ndarray, code: str, says: str) -> None:
    with refused(code, InconsistencyError) as error:
        compared(positions)
    assert re.search(says, str(error.value))
    (caution,) = compared(positions, IngestOptions(accept_inconsistency=True)).cautions
    assert caution.code == code


@pytest.mark.parametrize("factor", [1 / 0.3048, 0.3048])
def test_heights_in_feet_are_recognised(factor: float) -> None:
    lla = lla_from_ecef(ecef_from_enu(TRACK, ORIGIN)) * [1.0, 1.0, factor]
    with refused("feet", InconsistencyError) as error:
        compare_with_exif(table_of(ecef_from_lla(lla)), photos_at(TRACK), PATH, IngestOptions(), Remarks())
    assert numbers(str(error.value))[-1] == pytest.approx(1 / factor, abs=1e-3)


def test_a_clock_offset_is_named_with_its_size() -> None:
    time_s, late_s = np.arange(12) * 8.0, 6.0
    late = CubicSpline([*time_s, 96.0], np.vstack([TRACK, TRACK[:1]]), bc_type="periodic")(time_s + late_s)
    photos = [
        replace(photo, tags=replace(photo.tags, timestamp_s=float(when)))
        for photo, when in zip(photos_at(TRACK), time_s, strict=True)
    ]
    with refused("exif-times-off", InconsistencyError) as error:
        compare_with_exif(table_of(ecef_from_enu(late, ORIGIN)), photos, PATH, IngestOptions(), Remarks())
    assert 5.0 <= numbers(str(error.value))[-1] < 7.0


def test_a_geoid_between_the_heights_is_a_caution() -> None:
    (caution,) = compared(TRACK - [0.0, 0.0, 52.0]).cautions
    assert caution.code == "heights-apart"
    assert numbers(caution.sentence)[0] == -52.0


@pytest.mark.parametrize(("east_m", "north_m"), [(12.0, 0.0), (0.0, -9.0), (-7.0, 7.0)])
def test_a_constant_shift_beyond_what_receivers_share_is_said(east_m: float, north_m: float) -> None:
    """Each position is within its σ of 2.5 m and four of them; that all are off alike is none of chance."""
    noise = np.random.default_rng(0).normal(0, [1.0, 1.0, 3.0], TRACK.shape)
    (caution,) = compared(TRACK + noise + [east_m, north_m, 0.0]).cautions
    assert caution.code == "receivers-apart"
    east, north = (float(part) for part in re.findall(r"([+-]\d+\.\d) m", caution.sentence))
    assert (east, north) == pytest.approx((east_m, north_m), abs=1.0)


def test_a_shift_that_receivers_have_against_each_other_is_not_said() -> None:
    noise = np.random.default_rng(0).normal(0, [2.5, 2.5, 5.0], TRACK.shape)
    assert compared(TRACK + noise + [2.0, -1.5, 3.0]).cautions == []
