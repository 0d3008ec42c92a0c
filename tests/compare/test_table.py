"""The table of `georef compare`: figures of reports, and their text."""

from __future__ import annotations

from pathlib import Path

from pipelines.compare.table import (
    PAGE,
    ComparedRow,
    Comparison,
    PointAccuracy,
    cells,
    markdown,
    remarks_on,
    write_comparison,
)
from pipelines.core.products import Remark
from tests.reports import check_points_with

GOOD = PointAccuracy(count=3, mean_h_m=0.0123, median_h_m=0.01, rmse_h_m=0.015, rmse_v_m=25.128)
ROW = ComparedRow(
    configuration="E", title="full", note="everything", test_psnr=25.317, test_psnr_covered=26.25, test_ssim=0.87,
    triangulated=GOOD, surface=GOOD,
    training_s=61.4, warnings=(Remark(code="fixes-rejected", sentence="One fix is wrong."),),
)  # fmt: skip
FAILED = ComparedRow(configuration="A", title="plain", note="nothing", failure="it diverged")


def test_figures_are_told_to_what_they_are_worth() -> None:
    on_surface = ("0.0100", "0.0150", "25.13")
    assert cells(ROW) == ("25.32", "26.25", "0.8700", "0.0150", "25.13", *on_surface, "3", "61 s")
    assert cells(FAILED) == (*["–"] * 8, "0", "–")
    fewer = ROW.model_copy(update={"surface": GOOD.model_copy(update={"count": 2})})
    assert cells(fewer)[-2] == "3, 2"


def test_remarks_say_why_a_row_is_empty() -> None:
    assert remarks_on(ROW) == ("One fix is wrong.",)
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
    write_comparison(tmp_path, table, "flight")
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert set(times) == {"table.json", "table.md", "plot.png", PAGE}
    write_comparison(tmp_path, table, "flight")
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == times
    for name in ("plot.png", PAGE):
        (tmp_path / name).unlink()
        write_comparison(tmp_path, table, "flight")
        assert (tmp_path / name).exists()
    write_comparison(tmp_path, Comparison(options={}, rows=(FAILED,)), "flight")
    assert Comparison.model_validate_json((tmp_path / "table.json").read_text("utf-8")).rows == (FAILED,)
    assert "it diverged" in (tmp_path / "table.md").read_text("utf-8")


def test_figures_are_those_of_the_report() -> None:
    errors = check_points_with(count=3, mean_h_m=0.0123, median_h_m=0.01, rmse_h_m=0.015, rmse_v_m=25.128)
    assert PointAccuracy.model_validate(errors, from_attributes=True) == GOOD
    assert PointAccuracy.model_validate(check_points_with(), from_attributes=True) == PointAccuracy()
