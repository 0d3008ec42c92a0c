"""Command `georef batch`."""

import logging
from typing import Any

import click

from georef_cli import job_tables, options
from georef_cli.command import Command
from georef_cli.commands.run import DELIVER, OWNERS, STAGE_NAME, deliverables
from georef_cli.display import progress_for
from georef_cli.engines import ENGINE, engine_for
from georef_cli.estimate import RunEstimate, checked_inputs, estimate_run
from georef_cli.options import SET, settings
from georef_cli.output import print_json, print_result, print_rich
from pipelines.core.errors import GeorefError
from pipelines.core.options import input_paths, remembered
from pipelines.core.plan import plan
from pipelines.core.progress import Progress
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import stage_config
from pipelines.jobs.batch import PlannedMission
from pipelines.jobs.missions import Mission, load_missions

log = logging.getLogger(__name__)

FAILED = 1


def _batch(ctx: click.Context, **values: Any) -> int:
    from pipelines.jobs.batch import page_file, run_batch

    flags = settings(values["settings"], BY_NAME.values())
    listed = load_missions(values["missions"], OWNERS, values["last"], values["deliver"], flags)
    deliverables(values["deliver"])  # refuses a bad name
    progress = progress_for(ctx.obj)
    estimates = [_planned(mission, check=values["dry_run"], progress=progress) for mission in listed.missions]
    planned = [mission for mission, _ in estimates]
    engine = engine_for(values, values["at_a_time"])
    if values["dry_run"]:
        rows = job_tables.dry_rows(estimates)
        if values["as_json"]:
            print_json({"batch": listed.name, "missions": rows})
        else:
            together = engine.together([row.job(listed.folder) for row in planned if not row.is_current])
            print_rich(*job_tables.dry_run(rows, together))
        return FAILED if any(row.refusal for row in planned) else 0
    table = run_batch(listed, planned, engine, progress)
    shown = job_tables.batch(table, page_file(listed.folder, listed.name))
    print_result(table.model_dump(mode="json"), *shown, as_json=values["as_json"])
    return 0 if table.is_complete else FAILED


def _planned(mission: Mission, *, check: bool, progress: Progress) -> tuple[PlannedMission, RunEstimate | None]:
    """Return a mission with what its run needs; the estimate is None where the run will be refused, or unknown."""
    try:
        asked = remembered(mission.workspace.root, [spec.name for spec in mission.stages], mission.flags)
        rows = plan(mission.workspace, mission.stages, asked)
        actions = {row.stage: row.action for row in rows}
        if check:
            checked_inputs(mission.workspace, rows, progress)
        configs = [stage_config(mission.workspace, spec, asked[spec.name]) for spec in mission.stages]
    except GeorefError as error:
        return PlannedMission(mission, {}, refusal=str(error)), None
    try:
        run = estimate_run(mission.workspace, mission.stages, asked, force=False)
    except GeorefError as error:  # The run itself will tell it.
        log.debug("%s: no estimate: %s", mission.name, error)
        run = None
    inputs = tuple(path for config in configs for path in input_paths(config).values())
    if run is None or run.training is None:
        return PlannedMission(mission, actions, inputs=inputs), run
    on_gpu = run.training.backend == "cuda"
    return PlannedMission(mission, actions, 0 if on_gpu else run.training.peak_bytes, on_gpu, inputs), run


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
    help="""Run many missions, several at a time, and put their results into one table.

        MISSIONS is a TOML file with [defaults] and one table a mission, or a folder of mission folders
        (docs/batch.md). A mission is a workspace: georef run completes it, in a process of its own, skips what is
        current and resumes what was interrupted. One that fails is reported, and the others finish. The table is
        also written beside the missions, as NAME.batch.json and NAME.batch.html. Ctrl-C stops all missions, which
        save their work; the same command goes on. Exit code 1: a mission failed.

        \b
        Examples:
          georef batch missions.toml --dry-run
          georef batch missions.toml
          georef batch flights --set train.preset=fast --deliver report
          georef batch missions.toml --at-a-time 2 --json
          georef batch missions.toml --cluster tls://head:8786 --certificates certificates
        """,
)
