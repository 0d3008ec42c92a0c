"""Heights that nobody flies at, of tables, ground points, logs and EXIF: refused with file, line and field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.formats.exif import GpsTag, PhotoTags
from pipelines.formats.image_file import ImageFile
from pipelines.formats.trajectory_csv import complete
from pipelines.geodesy.vertical import HIGHEST_M, LOWEST_M, impossible_heights
from pipelines.ingest.exif_poses import poses_from_tags
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks
from pipelines.ingest.stage import survey_and_track
from tests.refusals import codes, refused

NAMES = [f"{number}.jpg" for number in range(4)]


def rows(height: str) -> list[str]:
    return [f"46.02{number},7.75,{1650 + number}" for number in range(3)] + [f"46.023,7.75,{height}"]


# Metres, millimetres of a flight at 1650 m and at 60 m, and what a damaged column has.
@pytest.mark.parametrize("height", ["2000050", "1650000", "60000", "-1500", "-32768", "1e30"])
def test_trajectory(tmp_path: Path, height: str) -> None:
    _pictures(tmp_path / "images")
    path = tmp_path / "trajectory.csv"
    lines = [f"{name},{row}" for name, row in zip(NAMES, rows(height), strict=True)]
    path.write_text("\n".join(["name,lat,lon,alt", *lines]) + "\n")
    options = IngestOptions(images=tmp_path / "images", trajectory=path, vertical="ellipsoidal")
    with refused("height-impossible", InputError) as caught:
        survey_and_track(options, None)
    assert (caught.value.path, caught.value.line, caught.value.field) == (path, 5, "height")


@pytest.mark.parametrize(
    "text", ["EPSG:32632\n{x} {y} {z} 10 10 0.jpg a\n", "EPSG:4326\n{lon} {lat} {z} 10 10 0.jpg a\n"]
)
@pytest.mark.parametrize("height", [1_620_000, -9999])
def test_ground_points(tmp_path: Path, text: str, height: float) -> None:
    _pictures(tmp_path / "images")
    path = tmp_path / "gcp_list.txt"
    path.write_text(text.format(x=400_000, y=5_100_000, lon=7.7, lat=46.0, z=height))
    options = IngestOptions(images=tmp_path / "images", gcp=path, vertical="ellipsoidal")
    with refused("height-impossible", InputError) as caught:
        survey_and_track(options, None)
    assert (caught.value.path, caught.value.line, caught.value.field) == (path, 2, "height")


def tagged(*heights: float) -> list[Photo]:
    return [
        Photo(f"{number}.jpg", ImageFile(64, 48, str(number)), PhotoTags(gps=GpsTag(46.02, 7.75, height, None, "")))
        for number, height in enumerate(heights)
    ]


def test_exif() -> None:
    with refused("height-impossible", InputError) as caught:
        poses_from_tags(tagged(2_000_050.0, 2_000_051.0, 1650.0), IngestOptions(), Remarks())
    assert (str(caught.value.path), caught.value.field) == ("0.jpg", "GPSAltitude")
    remarks = Remarks()
    poses = poses_from_tags(tagged(1650.0, 4_294_967.0, 1651.0, 1652.0), IngestOptions(), remarks)
    assert complete(poses.position_in_ecef).tolist() == [True, False, True, True]
    assert "height-impossible" in codes(remarks.warnings)
    assert "1.jpg (4294967 m)" in remarks.warnings[0].sentence


def test_heights_of_real_flights_pass() -> None:
    """The shore of the Dead Sea, a pit below it, Everest by helicopter, a high aeroplane; and none at all."""
    assert not impossible_heights([-430.0, -700.0, 9_500.0, 19_000.0, np.nan, LOWEST_M, HIGHEST_M]).any()


def _pictures(folder: Path) -> None:
    import cv2

    folder.mkdir()
    for number, name in enumerate(NAMES):
        picture = np.random.default_rng(number).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        cv2.imwrite(str(folder / name), picture)
