"""Errors point by point: the list, the file, and the tables on a terminal."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from georef_cli.tables import coordinate_tables, error_tables
from pipelines.evaluate.coordinates import write_point_table
from pipelines.geodesy.enu import ecef_from_enu, ecef_from_lla
from pipelines.survey.headline import point_lines
from pipelines.survey.report import (
    Coordinates,
    EvaluationReport,
    PointCoordinates,
    PointError,
    PointResidual,
    PredictedPointError,
)
from pipelines.survey.survey import Survey
from tests.reports import check_points_with, cross_validation_with, report_with
from tests.scenes import material

FIRST, SECOND = "Pfeiler [Nord] 17", "P2"


def error(name: str, *values: float | None, blunder: bool = False) -> PointError:
    east, north, up = values or (None, None, None)
    return PointError(name=name, rays=5, de_m=east, dn_m=north, du_m=up, blunder=blunder)


@pytest.fixture
def survey() -> Survey:
    _, _, survey = material(images=3, points=20)
    point = {"cov_in_geo": np.eye(3).tolist(), "marks": ()}
    update = {
        "check_points": [
            {"name": FIRST, "position_in_geo": (10.0, -20.0, 3.0), **point},
            {"name": SECOND, "position_in_geo": (0.0, 0.0, 0.0), **point},
        ],
        "control_points": [{"name": "G1", "position_in_geo": (5.0, 5.0, 5.0), **point}],
    }
    return Survey.model_validate({**survey.model_dump(), **update})


@pytest.fixture
def report() -> EvaluationReport:
    predicted = PredictedPointError(
        **error(FIRST, 0.03, -0.04, 0.12).model_dump(), sigma_e_m=0.01, sigma_n_m=0.02, sigma_u_m=0.03
    )
    made = report_with(
        triangulated=check_points_with(points=(predicted, error(SECOND))),
        surface=check_points_with(points=(error(FIRST, 3.0, 4.0, 0.0, blunder=True), error(SECOND))),
        crossed=cross_validation_with(points=(error("G1", 0.1, 0.2, 0.2),)),
    )
    coordinates = Coordinates(
        crs="EPSG:2056+5728", units=("metre", "metre", "metre"), heights="EPSG:5728", operation="x",
        operation_accuracy_m=None, origin=(2600000.0, 1200000.0, 400.0),
        points=(
            PointCoordinates(
                name=FIRST, surveyed=(2600010.0, 1199980.0, 403.0), triangulated=(2600010.03, 1199979.96, 403.12),
                surface=(2600013.0, 1199984.0, 403.0),
            ),
            PointCoordinates(name=SECOND, surveyed=(2600000.0, 1200000.0, 400.0), triangulated=None, surface=None),
        ),
    )  # fmt: skip
    residual = PointResidual(name="G1", rays=4, de_m=0.01, dn_m=0.0, du_m=0.0)
    fit = made.fit.model_copy(update={"gcp": made.fit.gcp.model_copy(update={"points": (residual,)})})
    return made.model_copy(update={"coordinates": coordinates, "fit": fit})


def test_every_point_and_way_is_listed(report: EvaluationReport) -> None:
    lines = [(line.row.name, line.use, line.way, line.is_blunder) for line in point_lines(report)]
    assert lines == [
        (FIRST, "check", "triangulated", False),
        (FIRST, "check", "surface", True),
        (SECOND, "check", "triangulated", False),
        (SECOND, "check", "surface", False),
        ("G1", "control", "left out", False),
        ("G1", "control", "fit", False),
    ]


def test_file_has_place_error_and_coordinates(report: EvaluationReport, survey: Survey, tmp_path: Path) -> None:
    """Nine decimals of a degree are a tenth of a millimetre."""
    write_point_table(tmp_path / "points.csv", report, survey)
    with (tmp_path / "points.csv").open(encoding="utf-8", newline="") as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 6
    first, on_surface, unmeasured, *_, fit = rows
    place = [float(first[name]) for name in ("latitude_deg", "longitude_deg", "ellipsoidal_height_m")]
    expected = ecef_from_enu((10.0, -20.0, 3.0), survey.origin)
    np.testing.assert_allclose(ecef_from_lla(place), expected, rtol=0, atol=2e-4)
    assert (first["dh_m"], first["d3_m"], first["sigma_n_m"], first["blunder"]) == (
        "0.0500",
        "0.1300",
        "0.0200",
        "0",
    )
    assert (on_surface["dh_m"], on_surface["sigma_n_m"], on_surface["blunder"]) == ("5.0000", "", "1")
    assert (unmeasured["de_m"], unmeasured["d3_m"], unmeasured["x"]) == ("", "", "2600000.0000")
    assert (first["crs"], first["x"], first["x_measured"]) == ("EPSG:2056+5728", "2600010.0000", "2600010.0300")
    assert (on_surface["x_measured"], unmeasured["x_measured"]) == ("2600013.0000", "")
    assert (fit["measured"], fit["blunder"], fit["crs"], fit["east_m"]) == ("fit", "", "", "5.0000")


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_a_terminal(report: EvaluationReport, width: int) -> None:
    console = Console(width=width, file=io.StringIO(), highlight=False)
    for table in (*error_tables(report), *coordinate_tables(report)):
        console.print(table)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert max(map(len, text.splitlines())) <= width
    (line,) = [line for line in text.splitlines() if "triangulated  " in line and "+0.030" in line]
    figures = ["5", "+0.030", "-0.040", "+0.120", "0.050", "0.022", "0.030"]
    assert line.split()[-8:] == ["triangulated", *figures]  # a narrow terminal folds the long name before it
    assert line.startswith(FIRST if width > 80 else FIRST.split(maxsplit=1)[0])
    assert "! off by more than three times the class" in text and "2600010.0300  1199979.9600  403.1200" in text
    assert "Control points one by one, each left out in turn" in text and "(not an accuracy)" in text
