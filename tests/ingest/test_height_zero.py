"""Heights whose zero is doubtful: above the take-off, below the ground; and the σ of an assumed datum."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from pipelines.geodesy.vertical import MOST_GEOID_M, parse_vertical
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.photos import ASCII, Exif, dji_xmp, gps_entries, jpeg, write_flight
from tests.refusals import codes, numbers

ELLIPSOIDAL = parse_vertical("ellipsoidal")
CLIMB = (0.3, 12.5, 60.1, 80.2, 80.4)
MISSION = (80.1, 80.3, 80.2, 80.0, 80.4)
DOUBTS = {"heights-above-takeoff", "cameras-below-ground", "cameras-far-above-ground", "heights-begin-at-zero"}


def flight(folder: Path, heights: Sequence[float], relative: Sequence[float] | None = None) -> Path:
    """Write photographs 8 m apart with heights in EXIF, and those above the take-off in DJI's XMP."""
    folder.mkdir()
    for index, height in enumerate(heights):
        photo = [(0x9003, ASCII, f"2024:05:01 12:00:{index:02d}"), (0x9011, ASCII, "+00:00")]
        exif = Exif(photo=photo, gps=gps_entries(46.02, 7.75 + 1e-4 * index, height))
        xmp = None
        if relative is not None:
            xmp = dji_xmp(AbsoluteAltitude=f"{height:+.2f}", RelativeAltitude=f"{relative[index]:+.2f}")
        (folder / f"{index}.jpg").write_bytes(jpeg(index, exif=exif, xmp=xmp))
    return folder


def survey_of(**options: object) -> Survey:
    return survey_and_track(IngestOptions(**options), None)[0]


def sigma_up_m(survey: Survey) -> float:
    """Return the least σ of a height, with all that it shares with others."""
    return min(float(image.fix.cov_in_geo[2][2]) ** 0.5 for image in survey.images if image.fix is not None)


def doubts_of(survey: Survey) -> set[str]:
    return DOUBTS & set(codes(survey.cautions))


@pytest.mark.parametrize("heights", [CLIMB, MISSION])
def test_heights_that_equal_those_above_the_takeoff_are_unknown(tmp_path: Path, heights: Sequence[float]) -> None:
    survey = survey_of(images=flight(tmp_path / "a", heights, heights))
    assert doubts_of(survey) == {"heights-above-takeoff"}
    (caution,) = (one for one in survey.cautions if one.code == "heights-above-takeoff")
    assert numbers(caution.sentence)[:3] == [len(heights), min(heights), max(heights)]
    # Unknown: more than any datum is off, for each fix and for what they share.
    assert sigma_up_m(survey) > MOST_GEOID_M and survey.sessions[0].sigma_common_m[2] > MOST_GEOID_M
    # Against each other the heights are as good as before: SfM is levelled by them.
    fix = survey.images[0].fix
    assert fix is not None and fix.cov_apart[2][2] == pytest.approx(
        5.0**2, rel=0.01
    )  # resolution of the tags included


def test_a_datum_that_the_user_states_does_not_hide_them(tmp_path: Path) -> None:
    survey = survey_of(images=flight(tmp_path / "a", MISSION, MISSION), vertical=parse_vertical("ellipsoidal"))
    assert doubts_of(survey) == {"heights-above-takeoff"}


def test_a_table_of_such_heights_is_the_same(tmp_path: Path) -> None:
    folder = flight(tmp_path / "a", MISSION, MISSION)
    rows = [f"{index}.jpg,46.02,{7.75 + 1e-4 * index:.4f},{height}" for index, height in enumerate(MISSION)]
    (tmp_path / "t.csv").write_text("\n".join(["image,lat,lon,alt", *rows]) + "\n")
    survey = survey_of(images=folder, trajectory=tmp_path / "t.csv")
    assert doubts_of(survey) == {"heights-above-takeoff"} and sigma_up_m(survey) > MOST_GEOID_M


def test_heights_beside_those_above_the_takeoff_are_believed(tmp_path: Path) -> None:
    absolute = np.array(MISSION) + 158.5
    survey = survey_of(images=flight(tmp_path / "a", absolute.tolist(), MISSION))
    assert not doubts_of(survey) and sigma_up_m(survey) == pytest.approx(5.0, rel=0.01)
    # A beach: the take-off lies 3 m above the sea, and the first photograph is taken there.
    low = survey_of(images=flight(tmp_path / "b", (np.array(CLIMB) + 3.0).tolist(), CLIMB))
    assert not doubts_of(low)


def test_heights_that_begin_at_zero_are_a_hypothesis_unless_a_datum_is_stated(tmp_path: Path) -> None:
    folder = flight(tmp_path / "a", CLIMB)
    doubtful = survey_of(images=folder)
    assert doubts_of(doubtful) == {"heights-begin-at-zero"} and sigma_up_m(doubtful) >= 30.0
    assert not doubts_of(survey_of(images=folder, vertical=ELLIPSOIDAL))
    assert not doubts_of(survey_of(images=flight(tmp_path / "b", MISSION)))


def points(path: Path, height: float) -> Path:
    rows = [
        f"{7.7501 + 1e-4 * point:.4f} 46.0201 {height + point:.2f} 10.5 20.5 {image}.jpg P{point}"
        for point in range(3)
        for image in range(2)
    ]
    path.write_text("\n".join(["EPSG:4979", *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("ground", "code"),
    [(2551.0, "cameras-below-ground"), (-900.0, "cameras-far-above-ground"), (150.0, "cameras-below-ground")],
)
@pytest.mark.parametrize("by", ["gcp", "checkpoints", "ground_height"])
def test_cameras_below_or_far_above_the_ground(tmp_path: Path, ground: float, code: str, by: str) -> None:
    folder = flight(tmp_path / "a", MISSION)
    given = ground if by == "ground_height" else points(tmp_path / "p.txt", ground)
    survey = survey_of(images=folder, **{by: given})
    assert doubts_of(survey) == {code}
    # The σ covers what is known of the error: the ground differs from the cameras by so much.
    assert sigma_up_m(survey) > abs(ground - 80.0) - 10.0


@pytest.mark.parametrize("by", ["gcp", "ground_height"])
@pytest.mark.parametrize("ground", [20.0, 75.0, -250.0])
def test_cameras_above_the_ground_are_believed(tmp_path: Path, ground: float, by: str) -> None:
    folder = flight(tmp_path / "a", MISSION)
    given = ground if by == "ground_height" else points(tmp_path / "p.txt", ground)
    assert not doubts_of(survey_of(images=folder, **{by: given}))


def test_the_ground_height_is_in_the_datum_of_the_heights(tmp_path: Path) -> None:
    """The CRS of Swiss heights needs no grid that is missing here: without one, the datum itself is refused."""
    folder = flight(tmp_path / "a", MISSION)
    survey = survey_of(images=folder, ground_height=115.0, vertical=ELLIPSOIDAL)
    assert doubts_of(survey) == {"cameras-below-ground"}
    assert not doubts_of(survey_of(images=folder, ground_height=95.0, vertical=ELLIPSOIDAL))


def test_sigma_of_an_assumed_datum_is_common_to_all_fixes(tmp_path: Path) -> None:
    write_flight(tmp_path / "a", 4)
    assumed = survey_of(images=tmp_path / "a")
    stated = survey_of(images=tmp_path / "a", vertical=ELLIPSOIDAL)
    # Half of what any geoid is off; the receiver's own 3 m stand beside it.
    assert assumed.sessions[0].sigma_common_m[2] == pytest.approx(np.hypot(50.0, 3.0))
    assert stated.sessions[0].sigma_common_m[2] == 3.0
    assert "default-datum-sigma" in codes(assumed.assumptions)
    assert "default-datum-sigma" not in codes(stated.assumptions)
    for one in (assumed, stated):
        assert sigma_up_m(one) == pytest.approx(5.0, rel=0.01)
    # Who states the common error knows it.
    known = survey_of(images=tmp_path / "a", sigma_common_v=0.4)
    assert known.sessions[0].sigma_common_m[2] == 0.4
