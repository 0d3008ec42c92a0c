"""Progress and tables."""

from __future__ import annotations

import io
import logging
import re
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from georef_cli import display, tables
from georef_cli.output import print_rich
from georef_cli.verbosity import Verbosity
from pipelines.compare.table import ComparedRow, Comparison, PointAccuracy
from pipelines.core.products import Remark
from pipelines.core.progress import SILENT
from pipelines.core.runner import Outcome
from pipelines.core.sentences import duration
from pipelines.core.staleness import StageState
from pipelines.core.workspace import Manifest, Workspace
from pipelines.survey.report import AsprsStatement, ByAxis, PredictedSigma, TotalRmse, VegetatedAccuracy
from tests.reports import check_points_with, cross_validation_with, report_with

REPORT = report_with(
    test={"views": 6, "psnr": 24.31, "ssim": 0.812},
    triangulated=check_points_with(count=30, mean_h_m=0.014, rmse_h_m=0.016, rmse_v_m=0.021, rmse_3d_m=0.0264),
    surface=check_points_with(count=28, mean_h_m=0.035, rmse_h_m=0.041, rmse_v_m=0.05, rmse_3d_m=0.065),
    gnss={"count": 42, "rmse_h_m": 1.5, "rmse_v_m": 3.1},
)


def text_of(*parts: Any, width: int = 120) -> str:
    console = Console(file=io.StringIO(), width=width)
    for part in parts:
        console.print(part)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


class TestReport:
    def test_numbers_stand_under_their_names(self) -> None:
        lines = text_of(*tables.report(REPORT)).splitlines()
        head = next(line for line in lines if "RMSE H" in line)
        camera = next(line for line in lines if line.startswith("triangulated"))
        for name, value in [("points", "30"), ("mean H", "0.014"), ("RMSE V", "0.021"), ("RMSE 3D", "0.026")]:
            end = head.index(name) + len(name)  # figures are right-aligned under the heads
            assert camera[:end].endswith(value)

    def test_fit_is_not_called_an_accuracy(self) -> None:
        checks, fit = [text_of(part) for part in tables.report(REPORT)[1:]]
        assert "gnss" not in checks
        assert "triangulated" not in fit
        assert "not an accuracy" in fit

    def test_accuracy_has_class_prediction_and_bound(self) -> None:
        camera = check_points_with(
            count=30,
            rmse_h_m=0.016,
            with_survey=TotalRmse(rmse_h_m=0.018, rmse_v_m=0.023, rmse_3d_m=0.0292),
            asprs=AsprsStatement(
                points=30,
                horizontal_class="2 cm",
                vertical_class="3 cm",
                class_3d="3 cm",
                vegetated=VegetatedAccuracy(count=4, rmse_v_m=0.111),
                area_km2=None,
                least_points=30,
                enough_points=True,
                statement="tested on 30 check points",
            ),
            predicted=PredictedSigma(
                count=30, rms_h_m=0.017, rms_v_m=0.022, normalised_error_squared=ByAxis(e=1.0, n=1.0, u=1.0)
            ),
        )
        crossed = cross_validation_with(count=8, rmse_h_m=0.044)
        parts = tables.report(report_with(triangulated=camera, crossed=crossed))
        check, accuracy, cross = [text_of(part) for part in parts[:3]]
        line = next(line for line in accuracy.splitlines() if line.startswith("triangulated"))
        classes = ["2", "cm", "3", "cm", "3", "cm"]
        assert line.split() == ["triangulated", "0.018", "0.023", "0.029", "0.111", *classes, "0.017", "0.022"]
        assert "0.044" in cross
        assert "0.044" not in check

    def test_unknown_is_a_dash_where_another_row_is_known(self) -> None:
        parts = [text_of(part) for part in tables.report(REPORT)]
        assert "–" not in "".join(parts[:2]) and "LPIPS" not in parts[0] and "max 3D" not in parts[1]
        beside = report_with(
            triangulated=check_points_with(count=3, rmse_h_m=0.1), surface=check_points_with(count=2)
        )
        assert text_of(*tables.report(beside)).splitlines()[-1].split() == ["surface", "2", "–"]

    def test_parts_that_are_not_there_have_no_table(self) -> None:
        """No table of dashes: nothing was measured, and cross-validation is made on request only."""
        assert tables.report(report_with()) == []

    def test_impossible_cross_validation_counts_no_points(self) -> None:
        reason = "the measurements leave the similarity open"
        crossed = cross_validation_with().model_copy(update={"reason": reason})
        document = report_with().model_copy(update={"cross_validation": crossed})
        (part,) = tables.report(document)
        assert text_of(part).splitlines()[-1] == "not possible: the measurements leave the similarity open"


class TestWidths:
    """Nothing is cut off: figures turn on their side, other tables have fewer columns."""

    def errors(self, base: float) -> dict[str, Any]:
        return {name: base + 0.001 * i for i, name in enumerate(list(tables.POINT_COLUMNS)[1:])}

    @pytest.mark.parametrize("width", [80, 120])
    def test_every_figure_of_a_report_is_shown(self, width: int) -> None:
        ways = {"triangulated": self.errors(0.1), "surface": self.errors(0.2)}
        points = {way: check_points_with(count=47, **errors) for way, errors in ways.items()}
        (part,) = tables.report(report_with(**points))
        text = text_of(part, width=width)
        assert max(map(len, text.splitlines())) <= width and "…" not in text
        figures = [f"{value:.3f}" for errors in ways.values() for value in errors.values()]
        assert sorted(re.findall(r"\d\.\d{3}", text)) == sorted(figures)
        assert all(head in text for head in tables.POINT_COLUMNS.values())
        assert (len(text.splitlines()) < 6) is (width == 120), "a line a way where there is room"

    @pytest.mark.parametrize("width", [80, 120])
    def test_comparison(self, width: int) -> None:
        accuracy = PointAccuracy(count=47, mean_h_m=0.111, median_h_m=0.122, rmse_h_m=0.133, rmse_v_m=0.144)
        rows = tuple(
            ComparedRow(
                configuration=name, title=name, note="n", test_psnr=24.5, test_ssim=0.9, triangulated=accuracy,
                surface=accuracy, training_s=100.0,
            )
            for name in ("baseline", *"ABCDE")
        )  # fmt: skip
        table = tables.comparison(Comparison(options={}, rows=rows))[1]
        text = text_of(table, width=width)
        assert max(map(len, text.splitlines())) <= width and "…" not in text
        assert text.count("0.133") == 2 * len(rows)

    @pytest.mark.parametrize("width", [80, 120])
    def test_states(self, width: int) -> None:
        end = datetime(2026, 1, 1, 12, tzinfo=UTC)
        row = StageState("export-raster", "interrupted", "ingest/survey.json changed", end, 7260.0, "3 files")
        text = text_of(tables.states([row], {}), width=width)
        words = " ".join(text.split())
        for part in ("export-raster", "interrupted", "2 h 01 min", "3 files", "survey.json"):
            assert part in words
        assert ("2026-01-01" in words) is (width == 120)

    @pytest.mark.parametrize("width", [80, 120])
    def test_bar_keeps_to_one_line_with_labelled_times(self, width: int) -> None:
        console = Console(file=io.StringIO(), force_terminal=True, width=width)
        with display.BarProgress(console).task("training", 30_000) as task:
            task.advance(12_345, "24.3 dB, 1000 k Gaussians", left_s=4000.0)
            task.advance(1, left_s=3999.0)
        assert isinstance(console.file, io.StringIO)
        lines = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", console.file.getvalue()).replace("\r", "\n").splitlines()
        bars = [line for line in lines if line.strip()]
        assert all(line.startswith("training") and len(line) <= width for line in bars)
        last = bars[-1]
        assert "12346/30000" in last and "0:00 so far" in last and "1:06:39 left" in last
        assert "24.3 dB" in last
        assert ("it/s" in last) is (width == 120)


def test_task_without_steps_has_no_bar() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with display.BarProgress(console).task("depth maps", 0) as task:
        task.advance()
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue() == ""


HOSTILE = "[red]a[/] [/] [link=file:///x]b[/link] :smile:"


def test_markup_in_names_is_printed_as_it_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a style, nor a crash by an end without a beginning, nor a picture."""
    row = {
        **dict.fromkeys(("name", "type", "frame", "use", "problem"), HOSTILE),
        **dict.fromkeys(("first_s", "last_s", "rate_hz", "longest_gap_s")),
        "messages": 1, "gaps": 0, "backwards": 0, "clock": "recording",
    }  # fmt: skip
    state = StageState("ingest", "failed", HOSTILE, key_figure=HOSTILE)
    remark = Remark(code="hostile", sentence=HOSTILE)
    manifest = Manifest(
        stage="ingest", config={}, inputs={}, versions={}, started=datetime(2026, 1, 1, tzinfo=UTC),
        duration_s=1.0, key_figure=HOSTILE, values={HOSTILE: HOSTILE}, warnings=(remark,),
    )  # fmt: skip
    outcome = Outcome("ingest", False, manifest)
    cautions = {"ingest": [remark]}
    parts = [tables.topics([row]), tables.states([state], cautions), tables.outcomes([outcome])]
    parts += [*tables.outcome(Workspace(Path("ws")), outcome), *tables.cautions(cautions)]
    for part in parts:
        with (capture := io.StringIO()), monkeypatch.context() as patched:
            patched.setattr("sys.stdout", capture)
            patched.setattr("georef_cli.output.PIPED_WIDTH", 1000)
            print_rich(part)
            assert HOSTILE in capture.getvalue()
    bar = display.BarProgress(Console(file=io.StringIO(), width=200, force_terminal=True))
    with bar.task(HOSTILE, 2) as task:
        task.advance(note=HOSTILE)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, ""), (0.44, "0.4 s"), (12.2, "12 s"), (59.7, "1 min 00 s"), (200, "3 min 20 s"), (3900, "1 h 05 min")],
)
def test_duration(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


class TestLines:
    def test_short_task_is_one_line(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.INFO), display.LineProgress().task("features", 48) as task:
            for _ in range(48):
                task.advance(note="9 000 a image")
        assert caplog.messages == ["features: 48/48 after 0 s, 9 000 a image"]

    def test_long_task_is_told_twice_a_minute(
        self, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        clock = 0.0
        monkeypatch.setattr(display.time, "monotonic", lambda: clock)
        with caplog.at_level(logging.INFO), display.LineProgress().task("train") as task:
            for _ in range(100):
                clock += 1.0
                task.advance()
        assert len(caplog.messages) == 4
        assert caplog.messages[0] == "train: 30 after 30 s"


class TestBars:
    def test_bar_tells_count_speed_and_note(self) -> None:
        console = Console(file=io.StringIO(), force_terminal=True, width=140)
        with display.BarProgress(console).task("train", 200) as task:
            for _ in range(200):
                task.advance(note="psnr 23.1 dB")
        assert isinstance(console.file, io.StringIO)
        last = console.file.getvalue()
        assert "200/200" in last
        assert "it/s" in last
        assert "psnr 23.1 dB" in last

    def test_nested_and_consecutive_tasks(self) -> None:
        console = Console(file=io.StringIO(), force_terminal=True, width=140)
        progress = display.BarProgress(console)
        with progress.task("mapping", 2) as outer:
            with progress.task("adjustment") as inner:
                inner.advance()
            outer.advance(2)
        with progress.task("undistortion", 1) as later:
            later.advance()
        assert isinstance(console.file, io.StringIO)
        for name in ("mapping", "adjustment", "undistortion"):
            assert name in console.file.getvalue()

    def test_bar_is_closed_by_an_error(self) -> None:
        progress = display.BarProgress(Console(file=io.StringIO(), force_terminal=True))
        with pytest.raises(ValueError, match="diverged"), progress.task("train", 2):
            raise ValueError("diverged")
        with progress.task("train", 1) as task:  # a live display left open would refuse another
            task.advance()


def test_log_lines_on_a_terminal_are_marked_and_verbatim() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=140, color_system="standard")
    handler = display.ConsoleHandler(console)
    for level, text in [(logging.INFO, "sfm: started"), (logging.WARNING, "only [red]30[/red] of 48")]:
        handler.handle(logging.LogRecord("pipelines.sfm.stage", level, "", 0, text, None, None))
    assert isinstance(console.file, io.StringIO)
    plain, marked = console.file.getvalue().splitlines()
    assert plain == "sfm: started"
    assert "warning: only [red]30[/red] of 48" in marked
    assert marked.startswith("\x1b[33m")


def test_quiet_is_silent() -> None:
    assert display.progress_for(Verbosity(quiet=True)) is SILENT


def test_finished_bars_make_room() -> None:
    """Of more tasks than the terminal has lines, the first to end go first; those that run all stay."""
    console = Console(force_terminal=True, width=100, height=10, file=io.StringIO())
    progress = display.BarProgress(console)
    with progress.task("missions", 20) as missions, progress.task("long", 5):
        for number in range(20):
            with progress.task(f"mission {number}", 3) as task:
                task.advance(3)
            missions.advance()
        assert progress._bars is not None
        shown = [task.description for task in progress._bars.tasks]
    assert shown == ["missions", "long", *(f"mission {number}" for number in range(16, 20))]
