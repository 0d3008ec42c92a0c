"""Command `georef blocks`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from georef_cli import boundary, job_tables, options
from georef_cli.command import Command
from georef_cli.display import is_told, progress_for
from georef_cli.engines import ENGINE, asked_engine
from georef_cli.estimate import announced_estimate
from georef_cli.output import print_json, print_outcome, print_result, print_rich
from pipelines.core import runner, stages
from pipelines.core.options import remember, remembered
from pipelines.core.products import load_json
from pipelines.core.staleness import Flags, must_exist, stage_config
from pipelines.core.workspace import Workspace
from pipelines.survey.survey import Survey

if TYPE_CHECKING:
    from pipelines.train.blocks.parts import Parts

TRAIN = stages.BY_NAME["train"]
ACTIONS = ("plan", "scaffold", "train", "seams", "merge")


def _blocks(ctx: click.Context, **values: Any) -> None:
    place, number = values["place"], values["number"]
    if len(place) > 2 or (len(place) == 2 and place[0] not in ACTIONS):
        raise click.UsageError(f"The form of the command is `georef blocks [{'|'.join(ACTIONS)}] WS`.")
    action = place[0] if len(place) == 2 else ""
    workspace = Workspace(Path(place[-1]).resolve())
    must_exist(workspace)
    given = options.given(ctx, TRAIN.options.model_fields)
    if number is not None and action != "train":
        raise click.UsageError("--id is for `georef blocks train`.")
    if given and (action in ("scaffold", "seams", "merge") or number is not None):
        raise click.UsageError("Options of the training belong to `georef blocks` or `georef blocks plan`.")
    by_action = {"scaffold": stages.TRAIN_SCAFFOLD, "seams": stages.TRAIN_SEAMS}
    part = by_action.get(action) if number is None else stages.TRAIN_BLOCK
    with asked_engine(values):
        from pipelines.train.blocks.parts import Parts

        asked = remembered(workspace.root, [TRAIN.name], {TRAIN.name: given})
        resolved: Any = stage_config(workspace, TRAIN, asked[TRAIN.name])
        parts = Parts(workspace, resolved)
        if part is not None:
            _run_part(ctx, parts, part, values)
        elif action == "plan":
            _plan(ctx, parts, asked, values)
        elif action == "train":
            _train(ctx, parts, asked, values)
        else:
            _all(ctx, parts, asked, values, only_merge=action == "merge")


def _plan(ctx: click.Context, parts: Parts, asked: Mapping[str, Flags], values: dict[str, Any]) -> None:
    from pipelines.train.estimate import block_processor_s
    from pipelines.train.options import TrainOptions

    workspace = parts.workspace
    with workspace.lock("blocks plan"):
        remember(workspace.root, asked)
    with boundary.logged_to_file(parts.variant(), stages.PLAN_BLOCKS):
        outcome = parts.run(stages.PLAN_BLOCKS, force=values["force"], progress=progress_for(ctx.obj))
    plan = parts.plan()
    if values["as_json"]:
        print_json({"stage": outcome.stage, "ran": outcome.ran, **plan.model_dump(mode="json")})
        return
    assert isinstance(parts.options, TrainOptions)
    states, photo_px = parts.states(plan), load_json(Survey, workspace.path(stages.SURVEY)).largest_photograph_px
    # On a GPU nothing was measured.
    processor_s = None if parts.on_gpu() else block_processor_s(plan, photo_px, parts.options)
    print_rich(*job_tables.block_table(plan, states, processor_s))


def _run_part(ctx: click.Context, parts: Parts, spec: stages.StageSpec, values: dict[str, Any]) -> None:
    """Run a part as a job does: without the workspace's lock, which the process that started the job may hold."""
    number, force, progress = values["number"], values["force"], progress_for(ctx.obj)
    if number is not None:
        parts.plan().block(number)
    elif spec is stages.TRAIN_SCAFFOLD and (force or parts.why_missing(stages.SOLVE)):
        parts.run(stages.SOLVE, force=force, progress=progress)
    variant = parts.variant(number)
    with boundary.logged_to_file(variant, spec):
        outcome = parts.run(spec, number, force=force, progress=progress)
    print_outcome(variant, outcome, as_json=values["as_json"], told=is_told(ctx.obj))


def _train(ctx: click.Context, parts: Parts, asked: Mapping[str, Flags], values: dict[str, Any]) -> None:
    from pipelines.train.blocks.stage import train_blocks

    workspace = parts.workspace
    with workspace.lock("blocks train"):
        remember(workspace.root, asked)
        plan = train_blocks(parts, progress_for(ctx.obj), force=values["force"])
    document = {"blocks": [training.model_dump(mode="json") for training in parts.trainings(plan)]}
    print_result(document, *job_tables.block_table(plan, parts.states(plan)), as_json=values["as_json"])


def _all(
    ctx: click.Context, parts: Parts, asked: Mapping[str, Flags], values: dict[str, Any], *, only_merge: bool
) -> None:
    from pipelines.train.blocks.stage import require_trained

    workspace = parts.workspace
    if only_merge:
        require_trained(parts, parts.plan())
    announced_estimate(workspace, (TRAIN,), asked, force=values["force"])
    with boundary.logged_to_file(workspace, TRAIN):
        outcome = runner.run_stage(
            workspace,
            TRAIN,
            asked[TRAIN.name],
            force=values["force"] and not only_merge,
            renew=not parts.is_merged() and (workspace.root / stages.BLOCK_RECORD).exists(),
            resume="if-same",
            progress=progress_for(ctx.obj),
        )
    print_outcome(workspace, outcome, as_json=values["as_json"], told=is_told(ctx.obj))


command = Command(
    "blocks",
    params=[
        click.Argument(["place"], nargs=-1, required=True, metavar="[plan|scaffold|train|seams|merge] WS"),
        click.Option(["--id", "number"], type=click.IntRange(min=0), help="Train this block only."),
        *options.stage_options(TRAIN.options),
        *ENGINE,
        options.flag("--force", text="Run even what is current, and start afresh."),
        options.JSON,
    ],
    callback=click.pass_context(_blocks),
    help="""Train a large survey in blocks, and merge them into one model.

        The survey is divided into blocks of equal load; cameras, lens and exposures are solved once for all; a
        coarse model of the whole stands in for the world around each block; the blocks are trained as processes of
        their own, as many at a time as memory and cores allow; and train/ receives the merged model, as from georef
        train. What is current is kept, and what was interrupted goes on. georef run and georef train do the same
        where one training would not fit into memory, or with --blocks.

        plan divides only, and shows the blocks. train trains only, all blocks or that of --id. merge joins blocks
        that are trained. The options are those of georef train, and are remembered as its own.

        \b
        Examples:
          georef blocks flight --blocks 4
          georef blocks plan town --preset high --max-gaussians 20000000
          georef blocks plan town --block-memory 16
          georef blocks train town --id 7
          georef blocks town --cluster tls://10.0.0.1:8786 --certificates certificates
          georef blocks merge town
        """,
)
