"""Check and control points one by one: errors, and coordinates in a CRS of the user's."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Group
from rich.table import Table

from georef_cli.markup import shown
from pipelines.core.figures import SHORT_WAYS
from pipelines.scene.report import EvaluationReport
from pipelines.scene.report_points import PointLine, point_lines

_TITLES = {
    "check": "Check points one by one, metres",
    "left out": "Control points one by one, each left out in turn, metres",
    "fit": "Residuals of control points one by one (not an accuracy), metres",
}

_BLUNDER = "[red]![/] off by more than three times the class that the other points meet"


def error_tables(report: EvaluationReport) -> list[Group]:
    """Return the tables of the errors of a report; none of a kind of points that there is not."""
    lines = point_lines(report)
    groups = {
        "check": [line for line in lines if line.use == "check"],
        "left out": [line for line in lines if line.way == "left out"],
        "fit": [line for line in lines if line.way == "fit"],
    }
    tables = [
        Group(f"\n[bold]{_TITLES[name]}[/]", _table(of_group, with_way=name == "check"))
        for name, of_group in groups.items()
        if of_group
    ]
    return [*tables, *([Group(_BLUNDER)] if any(line.is_blunder for line in lines) else [])]


def coordinate_tables(report: EvaluationReport) -> list[Group]:
    """Return the check points in the CRS of `--crs`, as surveyed and as measured; nothing without that option."""
    listed = report.coordinates
    if listed is None:
        return []
    table = Table("point", "", "x", "y", "z", box=None, pad_edge=False)
    for column in table.columns[2:]:
        column.justify, column.no_wrap = "right", True
    table.add_row("origin", "", *listed.texts(listed.origin))
    for point in listed.points:
        for way, xyz in (
            ("surveyed", point.surveyed),
            (SHORT_WAYS["camera"], point.camera),
            (SHORT_WAYS["model"], point.model),
        ):
            name = shown(point.name) if way == "surveyed" else ""
            table.add_row(name, way, *(text or "–" for text in listed.texts(xyz)))
    units = listed.units[0] if len(set(listed.units)) == 1 else ", ".join(listed.units)
    title = f"Check points in {shown(listed.crs)}, {shown(units)}; x is the easting or longitude"
    return [Group(f"\n[bold]{title}[/]", table, f"Heights: {shown(listed.heights)}.")]


def _table(lines: Sequence[PointLine], *, with_way: bool) -> Table:
    has_sigma = any(line.sigma_m is not None for line in lines)
    heads = ["point", *(["measured"] if with_way else []), "rays", "E", "N", "U", "H"]
    table = Table(*heads, *(["σ H", "σ U"] if has_sigma else []), "", box=None, pad_edge=False)
    for column in table.columns[1:-1]:
        column.justify, column.no_wrap = "right", True
    if with_way:
        table.columns[1].justify = "left"
    for line in lines:
        error, sigma = line.error_m, line.sigma_m
        lengths = ["–"] * 4 if error is None else [*(f"{value:+.3f}" for value in error), _length(error[:2])]
        predicted = ["–"] * 2 if sigma is None else [_length(sigma[:2]), f"{sigma[2]:.3f}"]
        table.add_row(
            shown(line.row.name),
            *([SHORT_WAYS[line.way]] if with_way else []),
            str(line.row.rays),
            *lengths,
            *(predicted if has_sigma else []),
            "[red]![/]" if line.is_blunder else "",
        )
    return table


def _length(values: Sequence[float]) -> str:
    return f"{math.hypot(*values):.3f}"
