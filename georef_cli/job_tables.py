"""Tables of many jobs for people: missions of a batch, blocks of a training."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from georef_cli.estimate import RunEstimate
from georef_cli.layout import ByWidth, plain_table, shown
from georef_cli.tables import WIDE, Renderable
from pipelines.core.figures import ACCURACY_H, ACCURACY_V, CHECK_POINTS, MISSING
from pipelines.core.sentences import about, duration
from pipelines.jobs.batch import BatchTable, PlannedMission

if TYPE_CHECKING:
    from pipelines.survey.block_plan import BlockPlan

_STYLE = {"done": "green", "current": "green", "failed": "red", "interrupted": "yellow", "waiting": "dim"}
_ACCURACY = ("accuracy", ACCURACY_H.label, ACCURACY_V.label)


def batch(table: BatchTable, page: Path) -> list[Renderable]:
    """Return the table of a batch, its failures, and where the page of it is."""
    wide = plain_table(
        *("mission", "state", "took", "photographs", *_ACCURACY, CHECK_POINTS.label, "PSNR", "remarks"),
        right=(2, 3, 5, 6, 7, 8, 9),
    )
    narrow = plain_table("mission", "state", "took", *_ACCURACY, "remarks", right=(2, 4, 5, 6))
    for row in table.missions:
        state = f"[{_STYLE[row.state]}]{row.state}[/]"
        headline, images = row.accuracy, MISSING if row.images is None else str(row.images)
        accuracy = [MISSING] * 3
        if headline is not None:
            accuracy = [headline.kind, ACCURACY_H.text(headline.rmse_h_m), ACCURACY_V.text(headline.rmse_v_m)]
        photographs = images if row.images is None or row.registered is None else f"{row.registered} of {images}"
        took = duration(row.processing_s if row.seconds is None else row.seconds)
        remarks = str(len(row.warnings) + len(row.cautions) or "")
        checks = CHECK_POINTS.text(None if headline is None else headline.check_points)
        psnr = MISSING if row.test_psnr is None else f"{row.test_psnr:.2f}"
        wide.add_row(shown(row.mission), state, took, photographs, *accuracy, checks, psnr, remarks)
        narrow.add_row(shown(row.mission), state, took, *accuracy, remarks)
    failures = [
        f"[red]{shown(row.mission)}[/] {shown(row.failure)}"
        + ("" if row.log is None else f" [dim]{shown(row.log)}[/]")
        for row in table.missions
        if row.failure is not None
    ]
    counts = f"\n{len(table.missions)} missions: {table.states}. All of it is in {shown(str(page))}"
    return [ByWidth(WIDE, wide, narrow), *(["", *failures] if failures else []), counts]


def dry_rows(missions: Iterable[tuple[PlannedMission, RunEstimate | None]]) -> list[dict[str, Any]]:
    """Return what a batch would do, a row for each mission, as plain values."""
    return [
        {
            "mission": planned.mission.name,
            "workspace": str(planned.mission.workspace.root),
            "stages": dict(planned.actions),
            "refusal": planned.refusal,
            "photographs": run.photographs.count if run is not None and run.photographs is not None else None,
            "seconds": None if run is None else sum(value or 0.0 for value in run.seconds.values()),
            "peak_bytes": planned.peak_bytes,
        }
        for planned, run in missions
    ]


def dry_run(rows: Sequence[dict[str, Any]], together: int) -> list[Renderable]:
    """Return the table of the rows of a dry run, in which some missions run together."""
    table = plain_table("mission", "photographs", "about", "memory", "stages to run", right=[1, 2, 3])
    for row in rows:
        stages = ", ".join(stage for stage, action in row["stages"].items() if action != "keep")
        table.add_row(
            shown(row["mission"]),
            MISSING if row["photographs"] is None else str(row["photographs"]),
            about(row["seconds"] or None),
            f"{row['peak_bytes'] / 2**30:.1f} GiB",
            f"[red]refused:[/] {shown(row['refusal'])}" if row["refusal"] else stages or "nothing to do",
        )
    return [
        table,
        f"\n{together} at a time. [dim]Nothing was run. Times are for one mission alone on an idle machine.[/]",
    ]


def block_table(
    plan: BlockPlan, states: Mapping[int, str], processor_s: Mapping[int, float] | None = None
) -> list[Renderable]:
    """Return the blocks of a plan, with what is known of their training, by number of the block.

    A block is `trained`, or there is a reason why it must be. The time is that of one core; None: unknown.
    """
    heads = ["block", "photographs", "Gaussians", "in a view", "memory"] + ["processor time"] * bool(processor_s)
    table = plain_table(*heads, "", right=list(range(len(heads))))
    for block in plan.blocks:
        table.add_row(
            str(block.id),
            str(len(block.cameras)),
            f"{block.gaussians:,}".replace(",", " "),
            f"{block.visible:,.0f}".replace(",", " "),
            f"{block.peak_bytes / 2**30:.1f} GiB",
            *([about(processor_s[block.id])] if processor_s else []),
            shown(states.get(block.id, "")),
        )
    number = len(plan.blocks)
    whole = f"{number} blocks of {plan.photographs} photographs, {plan.gaussians} Gaussians in all"
    if plan.memory_bytes is not None:
        whole += f", for workers with {plan.memory_bytes / 2**30:.1f} GiB"
    if processor_s:
        whole += f"; about {about(sum(processor_s.values()))} of one core for all of them"
    return [table, whole]
