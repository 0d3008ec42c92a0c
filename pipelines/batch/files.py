"""Files of a batch: its table as JSON and as a page, beside the missions."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from pipelines import __version__
from pipelines.batch.table import BatchTable
from pipelines.core.durable import replace_text
from pipelines.core.workspace import now
from pipelines.pages.page import Page, Section, write_page
from pipelines.pages.text import moment

_ROOM = __name__.rpartition(".")[0]


def json_file(folder: Path, batch: str) -> Path:
    """Return the path of a batch's table as JSON."""
    return folder / f"{batch}.batch.json"


def page_file(folder: Path, batch: str) -> Path:
    """Return the path of a batch's page."""
    return folder / f"{batch}.batch.html"


def write_batch(folder: Path, table: BatchTable) -> None:
    """Write the table as JSON and as a page; existing files are replaced when the new ones are complete.

    Raises:
        OSError: a file cannot be written; the existing one stays.
    """
    write_page(batch_page(table), _ROOM, page_file(folder, table.batch))
    replace_text(json_file(folder, table.batch), table.model_dump_json(indent=1) + "\n")


def batch_page(table: BatchTable) -> Page:
    """Return the page of a batch."""
    links = {row.mission: quote(row.report) for row in table.missions if row.report is not None}
    remarks = [row for row in table.missions if row.warnings or row.cautions]
    failed = [row for row in table.missions if row.failure is not None]
    facts = {"table": table, "links": links, "remarks": remarks, "failed": failed}
    states = ", ".join(f"{count} {state}" for state, count in table.counts.items())
    return Page(
        title=f"Batch: {table.batch}",
        subtitle=f"{len(table.missions)} missions: {states}",
        about={"Program": f"GeoRefGS {__version__}", "Made": moment(now())},
        sections=(
            Section("missions", "Missions", "missions.html", facts),
            *([Section("failures", "Failures", "failures.html", facts)] if failed else []),
            *([Section("remarks", "Warnings and cautions", "remarks.html", facts)] if remarks else []),
        ),
        document=table.model_dump(mode="json"),
    )
