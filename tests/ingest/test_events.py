"""Events tied to photographs: without names by order and intervals, of multispectral cameras by lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.geodesy.enu import ecef_from_lla, enu_from_ecef
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.formats.test_surveyors_tables import DEGREES, SECOND, TAIL, WEEK
from tests.photos import ASCII, Exif, jpeg
from tests.refusals import codes, refused, said

IRREGULAR_S = (0.31, 4.33, 8.3, 15.65, 19.66, 24.78, 27.2, 33.4)
STEADY_S = tuple(2.0 * k + 0.4 for k in range(8))


def place(seconds: float) -> tuple[float, float, float]:
    return 46.02 + 2e-5 * seconds, 7.75 + 3e-5 * seconds, 500.0 + seconds


def photographs(
    folder: Path, times_s: tuple[float, ...], *, clock_s: float, names: list[str] | None = None
) -> list[str]:
    """Write photographs with whole seconds of a camera's clock that is ahead by `clock_s`; return their names."""
    folder.mkdir()
    names = names or [f"DSC{411 + at:05d}.JPG" for at in range(len(times_s))]
    for at, (name, seconds) in enumerate(zip(names, times_s, strict=True)):
        second = 12 * 3600 + int(seconds + clock_s)
        moment = f"2024:05:01 {second // 3600:02d}:{second // 60 % 60:02d}:{second % 60:02d}"
        (folder / name).write_bytes(jpeg(at, exif=Exif(photo=[(0x9003, ASCII, moment)])))
    return names


def events(path: Path, times_s: tuple[float, ...]) -> Path:
    rows = ""
    for seconds in times_s:
        lat, lon, alt = place(seconds)
        rows += f"2024/05/01 12:00:{18 + seconds:06.3f}   {lat:.9f}    {lon:.9f}  {alt:.4f}{TAIL}"
    path.write_text(DEGREES.format(clock="GPST") + rows)
    return path


def table(path: Path, times_s: tuple[float, ...]) -> Path:
    rows = (f"{1714564800 + seconds:.3f},{','.join(map(str, place(seconds)))}\n" for seconds in times_s)
    path.write_text("timestamp,latitude,longitude,altitude\n" + "".join(rows))
    return path


def ingested(folder: Path, trajectory: Path, **options: object) -> Survey:
    given = IngestOptions(images=folder, trajectory=trajectory, vertical="ellipsoidal", **options)  # type: ignore[arg-type]
    return survey_and_track(given, None)[0]


def off_m(survey: Survey, time_of: dict[str, float]) -> dict[str, float]:
    return {
        image.name: float(
            np.linalg.norm(
                np.array(image.fix.position_in_geo)
                - enu_from_ecef(ecef_from_lla(place(time_of[image.name])), survey.origin)
            )
        )
        for image in survey.images
        if image.fix is not None
    }


@pytest.mark.parametrize("clock_s", [7237.0, -37.0, 0.0])
@pytest.mark.parametrize("times_s", [IRREGULAR_S, STEADY_S])
@pytest.mark.parametrize("kind", ["reach_events.pos", "positions.csv"])
def test_one_row_for_each_photograph(tmp_path: Path, kind: str, times_s: tuple[float, ...], clock_s: float) -> None:
    """Rows have the place to millimetres; two seconds of flight are 6 m."""
    if kind == "positions.csv" and times_s is STEADY_S:
        pytest.skip("a table with a steady rate is a track")
    names = photographs(tmp_path / "images", times_s, clock_s=clock_s)
    file = (events if kind.endswith(".pos") else table)(tmp_path / kind, times_s)
    survey = ingested(tmp_path / "images", file)
    off = off_m(survey, dict(zip(names, times_s, strict=True)))
    assert len(off) == len(times_s) and max(off.values()) < 0.01
    assert "8 of 8" in said(survey.assumptions, "rows-tied-by-order")


def test_missing_photographs_and_events(tmp_path: Path) -> None:
    """A deleted photograph, and a shutter that the receiver has missed: irregular intervals tell."""
    names = photographs(tmp_path / "images", IRREGULAR_S[1:], clock_s=3600.0)
    survey = ingested(tmp_path / "images", events(tmp_path / "a_events.pos", IRREGULAR_S))
    off = off_m(survey, dict(zip(names, IRREGULAR_S[1:], strict=True)))
    assert len(off) == 7 and max(off.values()) < 0.01
    survey = ingested(tmp_path / "images", events(tmp_path / "b_events.pos", (*IRREGULAR_S[:3], *IRREGULAR_S[4:])))
    off = off_m(survey, dict(zip(names, IRREGULAR_S[1:], strict=True)))
    assert len(off) == 6 and max(off.values()) < 0.01


def test_what_fits_in_several_ways_is_refused(tmp_path: Path) -> None:
    """Every two seconds, and one photograph less than events: the first or the last may be missing."""
    photographs(tmp_path / "images", STEADY_S[1:], clock_s=3600.0)
    with refused("events-not-tied", InputError) as error:
        ingested(tmp_path / "images", events(tmp_path / "reach_events.pos", STEADY_S))
    assert "several ways" in error.value.message
    with refused("events-not-tied", InputError) as error:
        ingested(tmp_path / "images", events(tmp_path / "other_events.pos", tuple(3.7 * k**1.1 for k in range(8))))
    assert "no way" in error.value.message


def mrk(path: Path, count: int, step_s: float) -> Path:
    rows = ""
    for at in range(count):
        lat, lon, alt = place(step_s * at)
        rows += (
            f"{at + 1}\t{SECOND + step_s * at:.6f}\t[{WEEK}]\t0,N\t0,E\t0,V\t{lat:.8f},Lat\t{lon:.8f},Lon\t"
            f"{alt:.3f},Ellh\t0.01, 0.01, 0.02\t50,Q\n"
        )
    path.write_text(rows)
    return path


@pytest.mark.parametrize("lenses", [("0.JPG", "1.TIF", "2.TIF"), ("0.JPG",)])
@pytest.mark.parametrize("step_s", [1.0, 2.7])
def test_last_digit_of_a_multispectral_camera_is_its_lens(
    tmp_path: Path, lenses: tuple[str, ...], step_s: float
) -> None:
    """One step is 3 m and more; the events reach beyond the tenfold numbers."""
    names = [f"DJI_{event:03d}{lens}" for event in range(1, 5) for lens in lenses]
    times = tuple(step_s * (event - 1) for event in range(1, 5) for _ in lenses)
    photographs(tmp_path / "images", times, clock_s=7200.0, names=names)
    survey = ingested(tmp_path / "images", mrk(tmp_path / "flight_Timestamp.MRK", 60, step_s))
    off = off_m(survey, dict(zip(names, times, strict=True)))
    assert len(off) == len(names) and max(off.values()) < 0.01
    assert "event-numbers-of-lenses" in codes(survey.assumptions)


def test_numbers_of_one_lens_stay(tmp_path: Path) -> None:
    """Photographs 10 to 15 of a camera with one lens, whose digits could be lenses."""
    names = [f"DJI_{number:04d}.JPG" for number in range(10, 16)]
    times = tuple(2.0 * (number - 1) for number in range(10, 16))
    photographs(tmp_path / "images", times, clock_s=7200.0, names=names)
    survey = ingested(tmp_path / "images", mrk(tmp_path / "flight_Timestamp.MRK", 30, 2.0))
    off = off_m(survey, dict(zip(names, times, strict=True)))
    assert len(off) == 6 and max(off.values()) < 0.01
    assert "event-numbers-of-lenses" not in codes(survey.assumptions)
