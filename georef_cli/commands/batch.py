"""Command `georef batch`, and its tables."""

import logging
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.commands.cluster import ENGINE, engine_for
from georef_cli.commands.run import DELIVER, OWNERS, STAGE_NAME, deliverables
from georef_cli.display import progress_for
from georef_cli.estimate import RunEstimate, checked_inputs, estimate_run
from georef_cli.options import SET, settings
from georef_cli.output import print_json, print_result, print_rich
from georef_cli.tables import WIDE, ByWidth, Renderable, literal, plain_table
from pipelines.core.errors import GeorefError
from pipelines.core.figures import ACCURACY_H, ACCURACY_V, CHECK_POINTS, MISSING
from pipelines.core.json_values import Json
from pipelines.core.options import OptionValue, input_paths, remembered
from pipelines.core.plan import plan
from pipelines.core.progress import Progress
from pipelines.core.sentences import about, duration
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import stage_config
from pipelines.jobs.batch import BatchTable, PlannedMission
from pipelines.jobs.missions import Mission, load_missions

log = logging.getLogger(__name__)

FAILED = 1


def _batch(ctx: click.Context, **values: OptionValue) -> int:
    from pipelines.jobs.batch import page_file, run_batch

    flags = settings(values["settings"], BY_NAME.values())
    listed = load_missions(values["missions"], OWNERS, values["last"], values["deliver"], flags)
    deliverables(values["deliver"])  # refuses a bad name
    progress = progress_for(ctx.obj)
    estimates = [_planned(mission, check=values["dry_run"], progress=progress) for mission in listed.missions]
    planned = [mission for mission, _ in estimates]
    engine = engine_for(values, values["at_a_time"])
    if values["dry_run"]:
        rows = dry_rows(estimates)
        if values["as_json"]:
            print_json({"batch": listed.name, "missions": rows})
        else:
            together = engine.together([row.job(listed.folder) for row in planned if not row.is_current])
            print_rich(*dry_tables(rows, together))
        return FAILED if any(row.refusal for row in planned) else 0
    table = run_batch(listed, planned, engine, progress)
    parts = batch_tables(table, page_file(listed.folder, listed.name))
    print_result(table.model_dump(mode="json"), *parts, as_json=values["as_json"])
    return 0 if table.is_complete else FAILED


def _planned(mission: Mission, *, check: bool, progress: Progress) -> tuple[PlannedMission, RunEstimate | None]:
    """Return a mission with what its run needs; the estimate is None where the run will be refused, or unknown."""
    try:
        flags = remembered(mission.workspace.root, [spec.name for spec in mission.stages], mission.flags)
        rows = plan(mission.workspace, mission.stages, flags)
        actions = {row.stage: row.action for row in rows}
        if check:
            checked_inputs(mission.workspace, rows, progress)
        configs = [stage_config(mission.workspace, spec, flags[spec.name]) for spec in mission.stages]
    except GeorefError as error:
        return PlannedMission(mission, {}, refusal=str(error)), None
    try:
        run = estimate_run(mission.workspace, mission.stages, flags, force=False)
    except GeorefError as error:  # The run itself will tell it.
        log.debug("%s: no estimate: %s", mission.name, error)
        run = None
    inputs = tuple(path for config in configs for path in input_paths(config).values())
    if run is None or run.training is None:
        return PlannedMission(mission, actions, inputs=inputs), run
    on_gpu = run.training.backend == "cuda"
    return PlannedMission(mission, actions, 0 if on_gpu else run.training.peak_bytes, on_gpu, inputs), run


_STYLE = {"done": "green", "current": "green", "failed": "red", "interrupted": "yellow", "waiting": "dim"}
_ACCURACY = ("accuracy", ACCURACY_H.label, ACCURACY_V.label)


def batch_tables(table: BatchTable, page: Path) -> list[Renderable]:
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
        wide.add_row(literal(row.mission), state, took, photographs, *accuracy, checks, psnr, remarks)
        narrow.add_row(literal(row.mission), state, took, *accuracy, remarks)
    failures = [
        f"[red]{literal(row.mission)}[/] {literal(row.failure)}"
        + ("" if row.log is None else f" [dim]{literal(row.log)}[/]")
        for row in table.missions
        if row.failure is not None
    ]
    counts = f"\n{len(table.missions)} missions: {table.states}. All of it is in {literal(str(page))}"
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


def dry_tables(rows: Sequence[Json], together: int) -> list[Renderable]:
    """Return the table of the rows of a dry run, in which some missions run together."""
    table = plain_table("mission", "photographs", "about", "memory", "stages to run", right=[1, 2, 3])
    for row in rows:
        stages = ", ".join(stage for stage, action in row["stages"].items() if action != "keep")
        table.add_row(
            literal(row["mission"]),
            MISSING if row["photographs"] is None else str(row["photographs"]),
            about(row["seconds"] or None),
            f"{row['peak_bytes'] / 2**30:.1f} GiB",
            f"[red]refused:[/] {literal(row['refusal'])}" if row["refusal"] else stages or "nothing to do",
        )
    return [
        table,
        f"\n{together} at a time. [dim]Nothing was run. Times are for one mission alone on an idle machine.[/]",
    ]


command = Command(
    "batch",
    params=[
        click.Argument(["missions"], type=options.FILE),
        click.Option(
            ["--at-a-time"],
            type=click.IntRange(min=1),
            metavar="N",
            help="Run at most this many missions at a time (default: as many as cores and predicted memory allow).",
        ),
        click.Option(["--to", "last"], type=STAGE_NAME, help="Last stage to run, of every mission."),
        DELIVER,
        SET,
        *ENGINE,
        options.DRY_RUN,
        options.JSON,
    ],
    callback=click.pass_context(_batch),
    help="""
        MISSIONS is a TOML file with [defaults] and one table a mission, or a folder of mission folders
        (docs/batch.md). A mission is a workspace: georef run completes it, in a process of its own, several at a
        time; it skips what is current and resumes what was interrupted. One that fails is reported, and the others
        finish. The table is also written beside the missions, as NAME.batch.json and NAME.batch.html. Ctrl-C stops
        all missions, which save their work; the same command goes on. Exit code 1: a mission failed.

        \b
        Examples:
          georef batch missions.toml --dry-run
          georef batch missions.toml
          georef batch flights --set train.preset=fast --deliver report
          georef batch missions.toml --at-a-time 2 --json
          georef batch missions.toml --cluster tls://head:8786 --certificates certificates
        """,
)
