"""Errors of check and control points, one line for each."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Group
from rich.table import Table

from georef_cli.markup import shown
from pipelines.core.stages import REPORT
from pipelines.core.workspace import Workspace
from pipelines.scene.report import read_report
from pipelines.scene.report_points import PointLine, point_lines

_TITLES = {
    "check": "Check points one by one, metres",
    "left out": "Control points one by one, each left out in turn, metres",
    "fit": "Residuals of control points one by one (not an accuracy), metres",
}


def point_tables(workspace: Workspace) -> list[Group]:
    """Return the tables of a workspace's points; none of a kind that there is not.

    Raises:
        InputError: the report is damaged.
    """
    lines = point_lines(read_report(workspace.path(REPORT)))
    groups = {
        "check": [line for line in lines if line.use == "check"],
        "left out": [line for line in lines if line.way == "left out"],
        "fit": [line for line in lines if line.way == "fit"],
    }
    return [
        Group(f"\n[bold]{_TITLES[name]}[/]", _table(of_group, with_way=name == "check"))
        for name, of_group in groups.items()
        if of_group
    ]


def _table(lines: Sequence[PointLine], *, with_way: bool) -> Table:
    has_sigma = any(line.sigma_m is not None for line in lines)
    heads = ["point", *(["by"] if with_way else []), "rays", "E", "N", "U", "H"]
    table = Table(*heads, *(["σ H", "σ U"] if has_sigma else []), "", box=None, pad_edge=False)
    for column in table.columns[1 + with_way : -1]:
        column.justify, column.no_wrap = "right", True
    for line in lines:
        error, sigma = line.error_m, line.sigma_m
        lengths = ["–"] * 4 if error is None else [*(f"{value:+.3f}" for value in error), _length(error[:2])]
        predicted = ["–"] * 2 if sigma is None else [_length(sigma[:2]), f"{sigma[2]:.3f}"]
        table.add_row(
            shown(line.row.name),
            *([line.way] if with_way else []),
            str(line.row.rays),
            *lengths,
            *(predicted if has_sigma else []),
            "[red]blunder[/]" if line.is_blunder else "",
        )
    return table


def _length(values: Sequence[float]) -> str:
    return f"{math.hypot(*values):.3f}"
