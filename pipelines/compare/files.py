"""Files of `georef compare`: the table as JSON and as Markdown, its bars, and the page of both."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipelines import __version__
from pipelines.compare.table import ComparedRow, Comparison, markdown, panels, remarks_on
from pipelines.core.durable import replace_text
from pipelines.pages.page import Page, Section, render_page
from pipelines.pages.pictures import png_file
from pipelines.plots.bars import write_bars

JSON, MARKDOWN, PLOT, PAGE = "table.json", "table.md", "plot.png", "comparison.html"
_ROOM = __name__.rpartition(".")[0]


def write_comparison(folder: Path, table: Comparison, survey: str) -> None:
    """Write `table.json`, `table.md`, `plot.png` and `comparison.html`, unless the files already hold this table.

    Args:
        folder: to write into.
        table: of the configurations.
        survey: name of the workspace, for the page.
    """
    json_path, markdown_path, page_path = folder / JSON, folder / MARKDOWN, folder / PAGE
    json_text, markdown_text = table.model_dump_json(indent=1) + "\n", markdown(table)
    is_held = _holds(json_path, json_text) and _holds(markdown_path, markdown_text)
    if is_held and (folder / PLOT).exists() and page_path.exists():
        return
    write_bars(folder / PLOT, panels(table.rows))
    replace_text(page_path, render_page(comparison_page(table, folder / PLOT, survey), _ROOM))
    replace_text(markdown_path, markdown_text)
    replace_text(json_path, json_text)


def comparison_page(table: Comparison, plot: Path, survey: str) -> Page:
    """Return the page of a comparison.

    Args:
        table: of the configurations.
        plot: PNG of its bars.
        survey: name of the workspace.
    """
    facts: dict[str, Any] = {
        "rows": table.rows,
        "bars": png_file(plot),
        "remarks": [(row, remarks_on(row)) for row in table.rows if remarks_on(row)],
        "options": table.options,
    }
    return Page(
        title=f"Comparison: {survey}",
        subtitle="One survey, trained and measured in several configurations",
        about={"Program": f"GeoRefGS {__version__}", "Configurations": _names(table.rows)},
        sections=(
            Section("figures", "Figures", "figures.html", facts),
            Section("configurations", "Configurations", "configurations.html", facts),
        ),
        document=table.model_dump(mode="json"),
    )


def _names(rows: tuple[ComparedRow, ...]) -> str:
    return ", ".join(row.configuration for row in rows)


def _holds(path: Path, text: str) -> bool:
    return path.exists() and path.read_text(encoding="utf-8") == text
