"""The report of `evaluate`: documents that are refused, and keys that exist only in some cases."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.core.errors import InputError
from pipelines.core.products import Remark, save_json
from pipelines.survey.report import (
    Coordinates,
    EvaluationReport,
    PointCoordinates,
    PointError,
    PredictedPointError,
    read_report,
)
from tests.refusals import refused
from tests.reports import check_points_with, report_with

CAUTION = Remark(code="prediction-rejected", sentence="The predicted σ are too small.")
MEASURED = {"name": "P1", "rays": 4, "de_m": 0.01, "dn_m": -0.02, "du_m": 0.1 + 0.2, "blunder": False}
UNMEASURED = {"name": "P2", "rays": 1, "de_m": None, "dn_m": None, "du_m": None, "blunder": False}


def document_of(report: EvaluationReport, path: Path) -> dict[str, Any]:
    """The JSON document that is written of a report."""
    save_json(report, path)
    document: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return document


def test_report_is_read_as_written(tmp_path: Path) -> None:
    sigma = {"sigma_e_m": 1e-5, "sigma_n_m": 0.02, "sigma_u_m": 0.03}
    unknown = dict.fromkeys(sigma)
    camera = check_points_with(
        count=1, points=(PredictedPointError(**MEASURED, **sigma), PredictedPointError(**UNMEASURED, **unknown))
    )
    model = check_points_with(count=1, points=(PointError(**MEASURED), PointError(**UNMEASURED)))
    report = report_with(test={"views": 3, "psnr": 24.0}, triangulated=camera, surface=model, cautions=(CAUTION,))
    document = document_of(report, tmp_path / "report.json")
    assert read_report(tmp_path / "report.json") == report
    rows = document["checkpoints"]
    assert rows["triangulated"]["points"] == [{**MEASURED, **sigma}, {**UNMEASURED, **unknown}]
    assert rows["surface"]["points"] == [MEASURED, UNMEASURED]  # without prediction there is no key for it


def test_keys_that_were_not_asked_for_are_absent_and_unknown_figures_are_null(tmp_path: Path) -> None:
    document = document_of(report_with(), tmp_path / "report.json")
    assert "coordinates" not in document
    assert document["cross_validation"] is None
    assert document["accuracy"] == {"cells": 0, "reason": "the scene has too few points"}
    assert document["cautions"] == []
    test = document["photometric"]["test"]
    assert test == {"views": 0, "psnr": None, "psnr_compensated": None, "ssim": None, "lpips": None, "per_view": []}
    with_reason = report_with(test={"lpips_reason": "no weights"})
    assert document_of(with_reason, tmp_path / "other.json")["photometric"]["test"]["lpips_reason"] == "no weights"


def test_coordinates_of_an_unmeasured_point_are_null(tmp_path: Path) -> None:
    point = PointCoordinates(name="P1", surveyed=(1.0, 2.0, 3.0), triangulated=(1.0, 2.0, 3.5), surface=None)
    coordinates = Coordinates(
        crs="EPSG:32632",
        units=("metre", "metre", "metre"),
        heights="ellipsoidal",
        operation="UTM zone 32N",
        operation_accuracy_m=None,
        origin=(0.0, 0.0, 0.0),
        points=(point,),
    )
    report = report_with().model_copy(update={"coordinates": coordinates})
    document = document_of(report, tmp_path / "report.json")["coordinates"]
    assert document["operation_accuracy_m"] is None
    row = {"name": "P1", "surveyed": [1.0, 2.0, 3.0], "triangulated": [1.0, 2.0, 3.5], "surface": None}
    assert document["points"] == [row]
    assert read_report(tmp_path / "report.json") == report


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"[]",
        b"{}",
        b"\xff",
        b"[" * 100_000,
        b'{"photometric": {"test": {}}}',
        b'{"photometric": {"test": null}, "checkpoints": {}}',
        b'{"checkpoints": {"triangulated": null, "surface": null}}',
        b'{"fit": {}}',
    ],
)
def test_content_that_is_no_report_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_bytes(content)
    with refused("report-invalid", InputError) as error:
        read_report(path)
    assert error.value.path == path and "`georef evaluate --force`" in error.value.remedy


def test_figures_of_the_wrong_kind_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    document = document_of(report_with(), path)
    document["checkpoints"]["surface"]["mean_h_m"] = "far"
    path.write_text(json.dumps(document), encoding="utf-8")
    with refused("report-invalid", InputError) as raised:
        read_report(path)
    assert raised.value.field == "checkpoints.surface.mean_h_m"


def test_report_that_cannot_be_read_is_not_called_another_thing(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        read_report(tmp_path)
    assert error.value.code != "report-invalid"
