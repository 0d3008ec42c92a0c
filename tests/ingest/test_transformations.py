"""Accuracy of the transformations of the input's coordinates, from the file to the σ of the survey."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipelines.geodesy.crs import parse_crs
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.stage import survey_and_track
from pipelines.survey.survey import Survey
from tests.photos import write_flight
from tests.refusals import codes, numbers, said

# CRS, a place in its area, and the accuracy that PROJ states where no grid is installed; renamed: no shift.
OLD = {
    "EPSG:27572": (47.0, 2.5, 2.0),  # NTF
    "EPSG:23031": (41.4, 2.1, None),  # ED50, which has a grid
    "EPSG:28406": (55.0, 33.0, 3.0),  # Pulkovo 1942
    "EPSG:21781": (46.9, 7.4, 1.5),  # CH1903
    "EPSG:31467": (50.0, 9.0, None),  # DHDN, which has a grid
}
RENAMED = {
    "EPSG:25832": (50.0, 9.0),
    "EPSG:2154": (47.0, 2.5),
    "EPSG:2263": (40.7, -74.0),  # US survey feet
    "EPSG:28355": (-37.0, 147.0),
    "EPSG:32632": (50.0, 9.0),
}


def survey_of(tmp_path: Path, crs: str, lat: float, lon: float, *, as_positions: bool = False) -> Survey:
    """Return a survey with positions in WGS84 and control points in a CRS, or the other way round."""
    names = write_flight(tmp_path / "images", 4, lat=lat, lon=lon, alt=120.0, positions=not as_positions)
    places = [(lat + 1e-4 * number, lon + 1e-4 * number, 20.0) for number in range(4)]
    xyz = parse_crs(crs).xyz_from_lla(places)
    options = IngestOptions(images=tmp_path / "images")
    if as_positions:
        rows = [f"{name} {x:.4f} {y:.4f} {z:.3f}" for name, (x, y, z) in zip(names, xyz, strict=True)]
        (tmp_path / "geo.txt").write_text("\n".join([crs, *rows]) + "\n")
        options = options.model_copy(update={"geo": tmp_path / "geo.txt"})
    else:
        rows = [
            f"{x:.4f} {y:.4f} {z:.3f} 10.5 20.5 {name} P{index}"
            for index, (x, y, z) in enumerate(xyz)
            for name in names[:2]
        ]
        (tmp_path / "gcp.txt").write_text("\n".join([crs, *rows]) + "\n")
        options = options.model_copy(update={"gcp": tmp_path / "gcp.txt"})
    return survey_and_track(options, None)[0]


@pytest.mark.parametrize("crs", OLD)
def test_control_points_share_the_error_of_their_transformation(tmp_path: Path, crs: str) -> None:
    lat, lon, accuracy_m = OLD[crs]
    survey = survey_of(tmp_path, crs, lat, lon)
    (used,) = survey.transformations
    assert (used.of, used.crs, used.file) == ("control points", crs, "gcp.txt")
    assert used.accuracy_m is not None and (accuracy_m is None or used.accuracy_m == accuracy_m)
    # The published accuracy is horizontal: each axis has its part of √2.
    assert survey.sigma_datum_m == pytest.approx((used.accuracy_m / 2**0.5, used.accuracy_m / 2**0.5, 0.0))
    sentence = said(survey.cautions, "transformation-accuracy")
    assert used.accuracy_m in numbers(sentence)
    assert all(grid in sentence for grid in used.missing_grids) and crs in sentence
    # Positions do not refute the control points by less.
    assert survey.sessions[0].sigma_common_m[0] > survey.sigma_datum_m[0]


@pytest.mark.parametrize("crs", RENAMED)
def test_another_name_of_wgs84_adds_no_error(tmp_path: Path, crs: str) -> None:
    survey = survey_of(tmp_path, crs, *RENAMED[crs])
    assert "transformation-accuracy" not in codes(survey.cautions)
    assert survey.sigma_datum_m == (0.0, 0.0, 0.0) and survey.sessions[0].sigma_datum_m[:2] == (0.0, 0.0)
    assert [used.crs for used in survey.transformations] == [crs]


def test_positions_share_the_error_of_their_transformation(tmp_path: Path) -> None:
    lat, lon, accuracy_m = OLD["EPSG:27572"]
    survey = survey_of(tmp_path, "EPSG:27572", lat, lon, as_positions=True)
    assert accuracy_m is not None
    assert survey.sessions[0].sigma_datum_m[0] == pytest.approx(accuracy_m / 2**0.5)
    assert survey.sessions[0].sigma_common_m[0] > accuracy_m / 2**0.5
    assert survey.sigma_datum_m == (0.0, 0.0, 0.0)
    assert "transformation-accuracy" in codes(survey.cautions)
