"""What people see of products: documents in, rich renderables out."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from pipelines.compare.table import Comparison, cells, remarks_on
from pipelines.core.errors import InputError
from pipelines.core.runner import Outcome
from pipelines.core.stages import REPORT
from pipelines.core.staleness import StageState
from pipelines.core.workspace import Workspace

STATE_STYLE = {
    "current": "green",
    "stale": "yellow",
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
# Column: where its figure is in a row of `checkpoints`.
ACCURACY_COLUMNS = {
    "RMSE H": ("with_survey", "rmse_h_m"),
    "RMSE V": ("with_survey", "rmse_v_m"),
    "class H": ("asprs", "horizontal_class"),
    "class V": ("asprs", "vertical_class"),
    "predicted H": ("predicted", "rms_h_m"),
    "predicted V": ("predicted", "rms_v_m"),
    "bound H": ("cramer_rao", "rms_h_m"),
    "bound V": ("cramer_rao", "rms_v_m"),
}
IMAGE_COLUMNS = {"views": "views", "psnr": "PSNR dB", "ssim": "SSIM", "lpips": "LPIPS"}
SECTIONS = ("photometric", "checkpoints", "fit")
Renderable = Group | Table | str


def states(rows: Iterable[StageState]) -> Table:
    """`georef status`: stage, state, when, how long, key figure."""
    table = _table("stage", "state", "finished", "took", "result")
    table.columns[3].justify = "right"
    for row in rows:
        remarks = [escape(text) for text in (row.key_figure, row.reason) if text]
        style = STATE_STYLE[row.state]
        table.add_row(
            row.stage,
            f"[{style}]{row.state}[/]",
            _when(row.finished),
            duration(row.duration_s),
            " · ".join(remarks),
        )
    return table


def outcome(workspace: Workspace, result: Outcome) -> list[Renderable]:
    """The result of one stage: headline, figures, and what was warned of when it ran earlier."""
    manifest = result.manifest
    how = duration(manifest.duration_s) if result.ran else "current, nothing to do"
    parts: list[Renderable] = [f"[bold]{result.stage}[/]: {escape(manifest.key_figure)} ({how})"]
    if result.stage == "evaluate":
        parts += report_of(workspace)
    elif manifest.values:
        parts.append(_figures(manifest.values))
    if not result.ran:  # those of a stage that just ran stand on stderr already
        parts += [f"[yellow]warning:[/] {escape(text)}" for text in manifest.warnings]
    return parts


def outcomes(results: Sequence[Outcome]) -> Table:
    """The results of `georef run`, a line a stage."""
    table = _table("stage", "", "took", "result")
    table.columns[2].justify = "right"
    for result in results:
        manifest = result.manifest
        done = "[green]done[/]" if result.ran else "[dim]current[/]"
        table.add_row(result.stage, done, duration(manifest.duration_s), escape(manifest.key_figure))
        for warning in () if result.ran else manifest.warnings:
            table.add_row("", "[yellow]warning[/]", "", escape(warning))
    return table


def comparison(table: Comparison) -> list[Renderable]:
    """`georef compare`: a line a configuration, and what sets it apart below."""
    heads = [f"{way}\n{name}" for way in ("camera", "model") for name in ("mean H", "median H", "RMSE H", "RMSE V")]
    del heads[1]  # by camera, mean and median hardly differ
    shown = _table("", "test\nPSNR", "\nSSIM", *heads, "check\npoints", "\ntraining")
    for column in shown.columns[1:]:
        column.justify, column.no_wrap = "right", True
    for row in table.rows:
        shown.add_row(row.configuration, *cells(row))
    notes = [f"[bold]{row.configuration}[/] {escape(f'{row.title}: {row.note}')}" for row in table.rows]
    remarks = [f"[yellow]{row.configuration}:[/] {escape(text)}" for row in table.rows for text in remarks_on(row)]
    return ["[bold]Test views in dB, check points in metres[/]", shown, "", *notes, *remarks]


def topics(rows: Iterable[Mapping[str, Any]]) -> Table:
    """`georef inspect`: a line a topic."""
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
            escape(row["name"]),
            escape(row["type"].replace("/msg/", "/")),
            str(row["messages"]),
            _number(row["rate_hz"]),
            duration(span),
            duration(row["longest_gap_s"]),
            escape(row["frame"]),
            f"[green]{row['use']}[/]",
            escape(", ".join(filter(None, remarks))),
        )
    return table


def report_of(workspace: Workspace) -> list[Renderable]:
    """The tables of a workspace's evaluation.

    Raises:
        InputError: the report was replaced by something else.
    """
    path = workspace.path(REPORT)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid JSON: {error}", path=path) from error
    if not isinstance(document, dict) or not all(isinstance(document.get(name, {}), dict) for name in SECTIONS):
        raise InputError("not a report: make it again with `georef evaluate --force`", path=path)
    return report(document)


def report(document: Mapping[str, Any]) -> list[Renderable]:
    """The tables of `evaluate/report.json`: test views, check points, cross-validation, residuals of the fit.

    A fit residual is not an accuracy, and a control point no check point: they never share a table.
    """
    views = _rows("Test views", document.get("photometric", {}), IMAGE_COLUMNS)
    check = _rows("Check points, metres", document.get("checkpoints", {}), POINT_COLUMNS)
    crossed = {"left out": document.get("cross_validation")}
    cross = _rows("Control points, each left out in turn (cross-validation), metres", crossed, POINT_COLUMNS)
    fit = _rows("Residuals of the fit (not an accuracy), metres", document.get("fit", {}), POINT_COLUMNS)
    tables = (views, check, _accuracy(document.get("checkpoints", {})), cross, fit)
    return [table for table in tables if table is not None]


def duration(seconds: float | None) -> str:
    """`0.4 s`, `12 s`, `3 min 20 s`, `1 h 05 min`."""
    if seconds is None:
        return ""
    if seconds < 10:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _rows(title: str, section: Mapping[str, Any], columns: Mapping[str, str]) -> Group | None:
    """One table under its title, a row a member of `section`, with those columns that any row has."""
    rows = {name: row for name, row in section.items() if isinstance(row, Mapping)}
    shown = {key: head for key, head in columns.items() if any(key in row for row in rows.values())}
    if not shown:
        return None
    table = _table("", *shown.values())
    for column in table.columns[1:]:
        column.justify = "right"
    for name, row in rows.items():
        table.add_row(name, *(_number(row.get(key)) for key in shown))
    return Group(f"\n[bold]{title}[/]", table)


def _accuracy(checkpoints: Mapping[str, Any]) -> Group | None:
    """What the check points say after the standard, beside what was predicted and what is possible."""
    rows = {
        way: {head: (found.get(part) or {}).get(key) for head, (part, key) in ACCURACY_COLUMNS.items()}
        for way, found in checkpoints.items()
        if isinstance(found, Mapping) and found.get("with_survey")
    }
    columns = {head: head for head in ACCURACY_COLUMNS}
    title = "Accuracy with the check points' own survey (ASPRS, 2nd ed.), prediction and Cramér–Rao bound, metres"
    return _rows(title, rows, columns)


def _figures(values: Mapping[str, Any]) -> Table:
    """Plain values as a two-column table; what is nested is for `--json`."""
    table = _table("", "", header=False)
    table.columns[1].justify = "right"
    for name, value in values.items():
        if isinstance(value, str | int | float) or value is None:
            table.add_row(escape(name), escape(_number(value)))
    return table


def _table(*columns: str, header: bool = True) -> Table:
    return Table(*columns, show_header=header, box=None, pad_edge=False)


def _number(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) >= 100 else f"{value:.3f}"
    return str(value)


def _when(moment: datetime | None) -> str:
    return "" if moment is None else moment.astimezone().strftime("%Y-%m-%d %H:%M")
