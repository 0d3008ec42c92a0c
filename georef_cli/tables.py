"""Tables for people: typed products in, rich renderables out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from rich.console import Group
from rich.table import Table

from georef_cli.markup import shown
from pipelines.compare.table import Comparison, cells, remarks_on
from pipelines.core.cautions import Caution
from pipelines.core.options import notation
from pipelines.core.origins import OptionOrigin
from pipelines.core.runner import Outcome
from pipelines.core.stages import REPORT
from pipelines.core.staleness import StageState
from pipelines.core.workspace import Workspace
from pipelines.scene.report import CheckPointErrors, EvaluationReport, read_report

STATE_STYLE = {
    "current": "green",
    "stale": "yellow",
    "damaged": "red",
    "running": "cyan",
    "interrupted": "yellow",
    "failed": "red",
    "missing": "dim",
}
POINT_COLUMNS = {
    "count": "points",
    "mean_e_m": "mean E",
    "mean_n_m": "mean N",
    "mean_u_m": "mean U",
    "mean_h_m": "mean H",
    "median_h_m": "median H",
    "rmse_e_m": "RMSE E",
    "rmse_n_m": "RMSE N",
    "rmse_h_m": "RMSE H",
    "rmse_v_m": "RMSE V",
    "rmse_3d_m": "RMSE 3D",
    "max_3d_m": "max 3D",
}
FACTOR_COLUMNS = {
    "count": "count",
    "used": "used",
    "redundancy": "redundancy",
    "estimated": "factor",
    "applied": "applied",
    "sigma_source": "σ",
}
IMAGE_COLUMNS = {"views": "views", "psnr": "PSNR dB", "ssim": "SSIM", "lpips": "LPIPS"}
_FORGET = "[dim]georef run WS --forget OPTION drops a remembered one[/]"
Renderable = Group | Table | str


def states(rows: Iterable[StageState], cautions: Mapping[str, Sequence[Caution]]) -> Table:
    """Return the table of `georef status`: stage, state, end, duration, new cautions if any, key figure."""
    table = _table("stage", "state", "finished", "took", *(["cautions"] if cautions else []), "result")
    for column in table.columns[3:-1]:
        column.justify = "right"
    for row in rows:
        remarks = [shown(text) for text in (row.key_figure, row.reason) if text]
        style = STATE_STYLE[row.state]
        table.add_row(
            row.stage,
            f"[{style}]{row.state}[/]",
            when(row.finished),
            duration(row.duration_s),
            *([str(len(cautions.get(row.stage, ())) or "")] if cautions else []),
            " · ".join(remarks),
        )
    return table


def origins(rows: Sequence[OptionOrigin]) -> list[Renderable]:
    """Return the table of options that are no defaults, with where their values come from."""
    if not rows:
        return ["", "[bold]Options[/]: all are defaults"]
    table = _table("stage", "option", "value", "from")
    table.columns[2].overflow = "fold"
    before = ""
    for row in rows:
        table.add_row(row.stage if row.stage != before else "", row.flag, shown(notation(row.value)), row.origin)
        before = row.stage
    return [
        "\n[bold]Options that are no defaults[/]",
        table,
        _FORGET,
    ]


def cautions(by_stage: Mapping[str, Sequence[Caution]]) -> list[Renderable]:
    """Return the cautions, one line each."""
    return [
        f"[bold yellow]caution:[/] {shown(caution.sentence)} ({stage}, {caution.code})"
        for stage, of_stage in by_stage.items()
        for caution in of_stage
    ]


def outcome(workspace: Workspace, result: Outcome) -> list[Renderable]:
    """Return the result of one stage: headline, figures, and the warnings of an earlier run."""
    manifest = result.manifest
    effort = duration(manifest.duration_s) if result.ran else "current, nothing to do"
    parts: list[Renderable] = [f"[bold]{result.stage}[/]: {shown(manifest.key_figure)} ({effort})"]
    if result.stage == "evaluate":
        parts += report_of(workspace)
    elif manifest.values:
        parts.append(_figures(manifest.values))
    if not result.ran:  # the warnings of a stage that just ran are on stderr already
        parts += [f"[yellow]warning:[/] {shown(text)}" for text in manifest.warnings]
    return parts


def outcomes(results: Sequence[Outcome]) -> Table:
    """Return the table of the results of `georef run`, a line for each stage."""
    table = _table("stage", "", "took", "result")
    table.columns[2].justify = "right"
    for result in results:
        manifest = result.manifest
        done = "[green]done[/]" if result.ran else "[dim]current[/]"
        table.add_row(result.stage, done, duration(manifest.duration_s), shown(manifest.key_figure))
        for warning in () if result.ran else manifest.warnings:
            table.add_row("", "[yellow]warning[/]", "", shown(warning))
    return table


def comparison(table: Comparison) -> list[Renderable]:
    """Return the tables of `georef compare`: a line for each configuration, and its distinctive features below."""
    heads = [f"{way}\n{name}" for way in ("camera", "model") for name in ("mean H", "median H", "RMSE H", "RMSE V")]
    del heads[1]  # by camera, mean and median hardly differ
    figures = _table("", "test\nPSNR", "\nSSIM", *heads, "check\npoints", "\ntraining")
    for column in figures.columns[1:]:
        column.justify, column.no_wrap = "right", True
    for row in table.rows:
        figures.add_row(shown(row.configuration), *map(shown, cells(row)))
    notes = [f"[bold]{shown(row.configuration)}[/] {shown(f'{row.title}: {row.note}')}" for row in table.rows]
    remarks = [
        f"[yellow]{shown(row.configuration)}:[/] {shown(text)}" for row in table.rows for text in remarks_on(row)
    ]
    return ["[bold]Test views in dB, check points in metres[/]", figures, "", *notes, *remarks]


def topics(rows: Iterable[Mapping[str, Any]]) -> Table:
    """Return the table of `georef inspect`, a line for each topic."""
    table = _table("topic", "type", "messages", "Hz", "span", "longest gap", "frame", "use", "")
    table.columns[0].overflow = table.columns[1].overflow = "fold"
    for column in table.columns[2:6]:
        column.justify = "right"
    for row in rows:
        span = None if row["first_s"] is None else row["last_s"] - row["first_s"]
        remarks = [
            f"{row['gaps']} gaps" if row["gaps"] else "",
            f"{row['backwards']} backwards" if row["backwards"] else "",
        ]
        remarks += ["no stamps" if row["clock"] == "recording" else "", row["problem"]]
        table.add_row(
            shown(row["name"]),
            shown(row["type"].replace("/msg/", "/")),
            str(row["messages"]),
            _number(row["rate_hz"]),
            duration(span),
            duration(row["longest_gap_s"]),
            shown(row["frame"]),
            f"[green]{shown(row['use'])}[/]",
            shown(", ".join(filter(None, remarks))),
        )
    return table


def report_of(workspace: Workspace) -> list[Renderable]:
    """Return the tables of a workspace's evaluation.

    Raises:
        InputError: the report is damaged.
    """
    return report(read_report(workspace.path(REPORT)))


def report(document: EvaluationReport) -> list[Renderable]:
    """Return the tables of a report: test views, check points, cross-validation, residuals of the fit.

    A residual of the fit is not an accuracy, and a control point is not a check point: they never share a table.
    """
    ways = {"camera": document.checkpoints.camera, "model": document.checkpoints.model}
    crossed = document.cross_validation
    fit = {"gnss": dict(document.fit.gnss), "gcp": dict(document.fit.gcp)}
    factors: dict[str, dict[str, Any]] = {factor.group: dict(factor) for factor in document.variance_factors}
    tables = (
        _rows("Test views", {"test": dict(document.photometric.test)}, IMAGE_COLUMNS),
        _rows("Check points, metres", {way: dict(errors) for way, errors in ways.items()}, POINT_COLUMNS),
        _accuracy(ways),
        _rows(
            "Control points, each left out in turn (cross-validation), metres",
            {} if crossed is None else {"left out": dict(crossed)},
            POINT_COLUMNS,
        ),
        _rows("Residuals of the fit (not an accuracy), metres", fit, POINT_COLUMNS),
        _rows("Variance factors: estimated over stated variance (tie points: in px²)", factors, FACTOR_COLUMNS),
    )
    return [table for table in tables if table is not None]


def duration(seconds: float | None) -> str:
    """Return a duration as `0.4 s`, `12 s`, `3 min 20 s` or `1 h 05 min`; empty for None."""
    if seconds is None:
        return ""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _rows(title: str, rows: Mapping[str, Mapping[str, Any]], columns: Mapping[str, str]) -> Group | None:
    """Return a table under its title, a line for each row, with the columns that any row has; None without any."""
    heads = {key: head for key, head in columns.items() if any(key in row for row in rows.values())}
    if not heads:
        return None
    table = _table("", *heads.values())
    for column in table.columns[1:]:
        column.justify = "right"
    for name, row in rows.items():
        table.add_row(shown(name), *(shown(_number(row.get(key))) for key in heads))
    return Group(f"\n[bold]{title}[/]", table)


def _accuracy(ways: Mapping[str, CheckPointErrors]) -> Group | None:
    """Return the accuracy by the check points after the standard, beside the prediction and the bound."""
    rows = {way: _accuracy_row(errors) for way, errors in ways.items() if errors.with_survey is not None}
    columns = {head: head for row in rows.values() for head in row}
    title = "Accuracy with the check points' own survey (ASPRS, 2nd ed.), prediction and Cramér–Rao bound, metres"
    return _rows(title, rows, columns)


def _accuracy_row(errors: CheckPointErrors) -> dict[str, float | str | None]:
    total, predicted, bound = errors.with_survey, errors.predicted, errors.cramer_rao
    return {
        "RMSE H": None if total is None else total.rmse_h_m,
        "RMSE V": None if total is None else total.rmse_v_m,
        "class H": errors.asprs.horizontal_class,
        "class V": errors.asprs.vertical_class,
        "predicted H": None if predicted is None else predicted.rms_h_m,
        "predicted V": None if predicted is None else predicted.rms_v_m,
        "bound H": None if bound is None else bound.rms_h_m,
        "bound V": None if bound is None else bound.rms_v_m,
    }


def _figures(values: Mapping[str, Any]) -> Table:
    """Return plain values as a table of two columns; nested values are shown by `--json` only."""
    table = _table("", "", header=False)
    table.columns[1].justify = "right"
    for name, value in values.items():
        if isinstance(value, str | int | float) or value is None:
            table.add_row(shown(name), shown(_number(value)))
    return table


def _table(*columns: str, header: bool = True) -> Table:
    return Table(*columns, show_header=header, box=None, pad_edge=False)


def _number(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"
    return str(value)


def when(moment: datetime | None) -> str:
    """Return a time as people write it, in the local zone; empty for None."""
    return "" if moment is None else moment.astimezone().strftime("%Y-%m-%d %H:%M")
