"""Section of the LiDAR: what the record of the training says stands on the page."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipelines.core.figures import DEPTH_ERRORS
from pipelines.core.products import Remark, save_json
from pipelines.core.stages import LIDAR, LIDAR_MAP
from pipelines.core.workspace import Workspace
from pipelines.report.page import Page, Section, render_page
from pipelines.report.plots.maps import DrawnArea, write_lidar_map
from pipelines.report.record import lidar_facts
from pipelines.survey.lidar_report import DepthErrors, HeldOutDepths, LidarArea, LidarRegistration, LidarReport


def area(kind: str, area_m2: float) -> LidarArea:
    return LidarArea.model_validate({
        "kind": kind, "area_m2": area_m2, "points": 9, "center_in_geo": (1, 2, 3), "lat_deg": 46.020003,
        "lon_deg": 7.75,
    })  # fmt: skip


REPORT_OF_TRAINING = LidarReport(
    crs=("ETRS89 / UTM 32N",), read=1_295_739, noise=0, withheld=0, overlap=0, outside=0, points=126_255,
    voxel_m=0.339,
    registration=LidarRegistration(
        shift_m=(0.1, -0.02, 0.004), sigma_m=(0.021, 0.021, 0.023), sigma_comparison_m=(0.001,) * 3, points=9000,
        spread_m=0.019, wall_bias_m=0.0, removed=True,
    ),
    rejected_share=0.0265, confidence=0.9,
    areas=(area("removed", 616.4), area("added", 20.2), area("removed", 30.0)),
    assumptions=(Remark(code="lidar-heights", sentence="The heights were taken as ellipsoidal."),),
)  # fmt: skip


def test_the_page_says_what_the_training_has_recorded(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    (tmp_path / "train").mkdir()
    assert lidar_facts(workspace) is None
    save_json(REPORT_OF_TRAINING, tmp_path / LIDAR)
    points = np.random.default_rng(0).uniform(0, 50, (500, 3))
    write_lidar_map(tmp_path / LIDAR_MAP, points, [DrawnArea("removed", 4.0, np.array([[9.0, 9.0]]), 2.0)])
    facts = lidar_facts(workspace)
    assert facts is not None
    page = Page("", "", {}, (Section("lidar", "LiDAR", "lidar.html", facts),), {})
    html = render_page(page, "pipelines.report")
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))
    for words in (
        "126 255 points", "of 1 295 739", "ETRS89 / UTM 32N", "taken as ellipsoidal",
        "east 0.100 0.021 beyond 3 σ", "up 0.004 0.023 within 3 σ", "was estimated in the adjustment and taken out",
        "616.4 LiDAR only 46.020003", "20.2 photographs only",
    ):  # fmt: skip
        assert words in text
    assert html.count("data:image/png") + html.count("data:image/webp") + html.count("data:image/jpeg") >= 1


def test_errors_at_held_out_points_stand_on_the_page(tmp_path: Path) -> None:
    """Figures of the report's document, under the words of the one table of figures."""
    (tmp_path / "train").mkdir()
    save_json(REPORT_OF_TRAINING, tmp_path / LIDAR)
    before = DepthErrors(points=812, bias_m=-0.031, median_m=0.062, abs_90_m=0.4)
    after = DepthErrors(points=812, bias_m=0.002, median_m=0.021, abs_90_m=0.1)
    found = HeldOutDepths(
        share=0.05, points=900, changed=3, unseen=40, known_before=830, known_after=880, before=before, after=after
    )
    facts, document = lidar_facts(Workspace(tmp_path)), {"held_out": found.model_dump()}
    html = render_page(
        Page("", "", {}, (Section("lidar", "LiDAR", "lidar.html", facts),), document), "pipelines.report"
    )
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))
    assert all(figure.label in text for figure in DEPTH_ERRORS.values())
    assert "before 812 −0.031 0.062 0.400" in text and "after 812 +0.002 0.021 0.100" in text
