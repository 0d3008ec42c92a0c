"""Photographs without any position: known distances make a survey in a local metric frame, nothing makes none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.core.errors import InputError
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import LOCAL_FRAME, Survey
from tests.photos import dji_xmp, jpeg
from tests.refusals import codes, refused, said

MARKS = "image,label,x,y\n" + "".join(
    f"{image}.jpg,{name},{x},20\n" for image in "ab" for name, x in (("P", 10), ("Q", 40))
)


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Return a folder of photographs without positions, beside marks of two points and their distance."""
    (folder := tmp_path / "images").mkdir()
    for seed, name in enumerate("abc"):
        xmp = dji_xmp(GimbalYawDegree="+90", GimbalPitchDegree="-90", GimbalRollDegree="0") if name == "a" else None
        (folder / f"{name}.jpg").write_bytes(jpeg(seed=seed, xmp=xmp))
    (tmp_path / "marks.csv").write_text(MARKS)
    (tmp_path / "bars.csv").write_text("from,to,distance,sigma\nP,Q,2.5,0.005\n")
    return folder


def surveyed(folder: Path, **options: Any) -> Survey:
    beside = {"marks": folder.parent / "marks.csv", "distances": folder.parent / "bars.csv"}
    return survey_and_track(IngestOptions.model_validate({"images": folder, **beside, **options}), None)[0]


def test_distances_alone_make_a_local_frame(photographs: Path) -> None:
    survey = surveyed(photographs)
    assert survey.origin is None and survey.source_crs == "local metric frame, not on Earth"
    assert survey.vertical.name == "local frame"
    assert [image.fix for image in survey.images] == [None] * 3 and not survey.sessions
    assert [distance.name for distance in survey.distances] == ["P–Q"]
    assert "no place on Earth" in said(survey.cautions, LOCAL_FRAME)
    assert "no-positions" not in codes(survey.warnings)
    attitude = survey.images[0].attitude
    assert attitude is not None
    # Looking straight down with the top of the photograph to the east.
    np.testing.assert_allclose(np.abs(attitude.quat_xyzw), [0.5**0.5, 0.5**0.5, 0, 0], atol=1e-6)


def test_nothing_that_sets_a_scale_is_refused_with_the_choices(photographs: Path) -> None:
    with refused("no-positions", InputError) as caught:
        surveyed(photographs, marks=None, distances=None)
    assert all(flag in str(caught.value) for flag in ("--trajectory", "--geo", "--gcp", "--distances"))
    (photographs.parent / "bars.csv").write_text("from,to,distance,sigma,use\nP,Q,2.5,0.005,check\n")
    with refused("no-positions", InputError):
        surveyed(photographs)


def test_check_points_need_a_place_on_earth(photographs: Path) -> None:
    points = photographs.parent / "checkpoints.txt"
    points.write_text(
        "EPSG:4979\n" + "".join(f"7.0 46.0 500 {x} 20 {i}.jpg P\n" for i, x in (("a", 10), ("b", 11)))
    )
    (photographs.parent / "marks.csv").write_text("".join(MARKS.splitlines(keepends=True)[k] for k in (0, 2, 4)))
    with refused("no-positions", InputError):
        surveyed(photographs, checkpoints=points)
