"""The table of `georef compare`: what is read from reports, and how figures are told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipelines.compare.table import (
    ComparedRow,
    Comparison,
    PointAccuracy,
    cells,
    figures_of,
    markdown,
    remarks_on,
    write_comparison,
)
from pipelines.core.errors import InputError

GOOD = PointAccuracy(count=3, mean_h_m=0.0123, median_h_m=0.01, rmse_h_m=0.015, rmse_v_m=25.128)
ROW = ComparedRow(
    configuration="E", title="full", note="everything", test_psnr=25.317, test_ssim=0.87, camera=GOOD, model=GOOD,
    training_s=61.4, warnings=("one fix is wrong",),
)  # fmt: skip
FAILED = ComparedRow(configuration="A", title="plain", note="nothing", failure="it diverged")


def test_figures_are_told_to_what_they_are_worth() -> None:
    by_model = ("0.0123", "0.0100", "0.0150", "25.13")
    assert cells(ROW) == ("25.32", "0.8700", "0.0123", "0.0150", "25.13", *by_model, "3", "61 s")
    assert cells(FAILED) == (*["–"] * 9, "0", "–")
    fewer = ROW.model_copy(update={"model": GOOD.model_copy(update={"count": 2})})
    assert cells(fewer)[-2] == "3, 2"


def test_remarks_say_why_a_row_is_empty() -> None:
    assert remarks_on(ROW) == ("one fix is wrong",)
    assert remarks_on(FAILED) == ("failed: it diverged",)


def test_markdown_is_one_table_with_notes() -> None:
    text = markdown(Comparison(options={"preset": "fast"}, rows=(ROW, FAILED)))
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 4
    assert len({line.count("|") for line in table}) == 1
    assert "- **A** plain: nothing." in text
    assert "- A: failed: it diverged" in text
    assert "All trained with: preset fast." in text


def test_files_are_written_when_they_say_something_new(tmp_path: Path) -> None:
    table = Comparison(options={}, rows=(ROW,))
    write_comparison(tmp_path, table)
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert set(times) == {"table.json", "table.md", "plot.png"}
    write_comparison(tmp_path, table)
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times
    (tmp_path / "plot.png").unlink()
    write_comparison(tmp_path, table)
    assert (tmp_path / "plot.png").exists()
    write_comparison(tmp_path, Comparison(options={}, rows=(FAILED,)))
    assert Comparison.model_validate_json((tmp_path / "table.json").read_text("utf-8")).rows == (FAILED,)
    assert "it diverged" in (tmp_path / "table.md").read_text("utf-8")


@pytest.mark.parametrize(
    "document",
    ["", "[]", "{}", '{"photometric": {"test": {}}}', '{"photometric": {"test": null}, "checkpoints": {}}'],
)
def test_what_is_no_report_is_refused(document: str, tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text(document, encoding="utf-8")
    with pytest.raises(InputError, match="not a report"):
        figures_of(path)


def test_figures_of_the_wrong_kind_are_refused(tmp_path: Path) -> None:
    points = {"count": 1, "mean_h_m": "far", "rmse_h_m": 1, "rmse_v_m": 1, "points": []}
    report = {"photometric": {"test": {"psnr": 1, "ssim": 1}}, "checkpoints": {"camera": points, "model": points}}
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report), encoding="utf-8")
    with pytest.raises(InputError, match="not a report"):
        figures_of(path)
