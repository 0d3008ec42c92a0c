"""Points that were surveyed but not marked yet are offered for marking."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.formats.ground_points import read_ground_points
from pipelines.survey.survey import Survey, SurveyedPoint
from pipelines.view.marking import mark_texts, points_to_mark
from tests.scenes import material


def test_unmarked_points_are_offered_and_written_once_marked(tmp_path: Path) -> None:
    _, _, survey = material(images=3, points=20)
    place = {"position_in_geo": (1.0, 2.0, 3.0), "cov_in_geo": np.eye(3).tolist(), "marks": ()}
    document = {
        **survey.model_dump(),
        "control_points": [{"name": "G1", **place}],
        "unmarked_points": [{"name": "G2", **place, "use": "control"}, {"name": "C1", **place, "use": "check"}],
    }

    def xyz_of(points: tuple[SurveyedPoint, ...]) -> np.ndarray:
        return np.array([point.position_in_geo for point in points]).reshape(-1, 3) + 1000

    points = points_to_mark(Survey.model_validate(document), xyz_of)
    assert [(point.name, point.is_check, point.xyz) for point in points] == [
        ("G1", False, (1001.0, 1002.0, 1003.0)),
        ("G2", False, (1001.0, 1002.0, 1003.0)),
        ("C1", True, (1001.0, 1002.0, 1003.0)),
    ]
    marked = [point.with_mark("a.jpg", (1.5, 2.5)) for point in points if point.name == "G2"]
    path = tmp_path / "gcp_list.txt"
    path.write_text(mark_texts("EPSG:32632", marked)[path.name], "utf-8")
    assert [(mark.name, mark.image, mark.x_px) for mark in read_ground_points(path).marks] == [("G2", "a.jpg", 1.5)]
