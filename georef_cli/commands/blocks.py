"""Command `georef blocks`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from georef_cli import boundary, job_tables, options
from georef_cli.command import Command
from georef_cli.display import is_told, progress_for
from georef_cli.engines import asked_engine, engine_options
from georef_cli.forecast import announce_training
from georef_cli.output import print_json, print_outcome, print_rich
from pipelines.core import runner
from pipelines.core.products import load_json
from pipelines.core.stages import (
    BLOCK_RECORD,
    BY_NAME,
    PLAN_BLOCKS,
    SOLVE,
    SURVEY,
    TRAIN_BLOCK,
    TRAIN_SCAFFOLD,
    TRAIN_SEAMS,
    StageSpec,
)
from pipelines.core.staleness import must_exist, stage_config
from pipelines.core.workspace import Workspace
from pipelines.survey.survey import Survey

if TYPE_CHECKING:
    from pipelines.survey.block_plan import BlockPlan
    from pipelines.train.blocks.parts import Parts

TRAIN = BY_NAME["train"]
ACTIONS = ("plan", "scaffold", "train", "seams", "merge")


def _blocks(ctx: click.Context, **values: Any) -> None:
    action, workspace = _place(values["place"])
    must_exist(workspace)
    given = options.given(ctx, TRAIN.options.model_fields)
    number = values["number"]
    if number is not None and action != "train":
        raise click.UsageError("--id is for `georef blocks train`.")
    if given and (action in ("scaffold", "seams", "merge") or number is not None):
        raise click.UsageError("options of the training are given to `georef blocks` or `georef blocks plan`.")
    with asked_engine(values):
        _act(ctx, action, workspace, given, values)


def _act(
    ctx: click.Context, action: str, workspace: Workspace, given: dict[str, Any], values: dict[str, Any]
) -> None:
    number = values["number"]
    if action == "plan":
        _plan(ctx, workspace, given, values)
    elif action == "scaffold":
        _run_part(ctx, workspace, TRAIN_SCAFFOLD, None, values)
    elif action == "seams":
        _run_part(ctx, workspace, TRAIN_SEAMS, None, values)
    elif action == "train" and number is not None:
        _run_part(ctx, workspace, TRAIN_BLOCK, number, values)
    elif action == "train":
        _train(ctx, workspace, given, values)
    else:
        _all(ctx, workspace, given, values, only_merge=action == "merge")


def _place(place: Sequence[str]) -> tuple[str, Workspace]:
    """Return action and workspace of the arguments `[ACTION] WS`; without an action, all of them are meant.

    Raises:
        click.UsageError: there are more arguments, or the first of two is no action.
    """
    if len(place) > 2 or (len(place) == 2 and place[0] not in ACTIONS):
        raise click.UsageError(f"expected `georef blocks [{'|'.join(ACTIONS)}] WS`.")
    action = place[0] if len(place) == 2 else ""
    return action, Workspace(Path(place[-1]).resolve())


def _parts(workspace: Workspace, flags: dict[str, Any]) -> Parts:
    """Return the parts of the training with the options that it was requested with, and others.

    Raises:
        InputError: an unknown or invalid option.
    """
    from pipelines.train.blocks.parts import Parts

    asked = runner.remembered(workspace, TRAIN, flags)
    resolved: Any = stage_config(workspace, TRAIN, asked)
    return Parts(workspace, resolved)


def _plan(ctx: click.Context, workspace: Workspace, given: dict[str, Any], values: dict[str, Any]) -> None:
    parts = _parts(workspace, given)
    with workspace.lock("blocks plan"):
        workspace.remember({TRAIN.name: runner.remembered(workspace, TRAIN, given)})
    with boundary.logged_to_file(parts.whole, PLAN_BLOCKS):
        outcome = parts.run(PLAN_BLOCKS, force=values["force"], progress=progress_for(ctx.obj))
    _print_plan(parts, outcome, values)


def _print_plan(parts: Parts, outcome: runner.Outcome, values: dict[str, Any]) -> None:
    plan = parts.plan()
    if values["as_json"]:
        print_json({"stage": outcome.stage, "ran": outcome.ran, **plan.model_dump(mode="json")})
    else:
        print_rich(*job_tables.plan(plan, parts.states(plan), _processor_s(parts, plan)))


def _processor_s(parts: Parts, plan: BlockPlan) -> dict[int, float] | None:
    """Return the predicted time of one core for each block; None on a GPU, where nothing was measured."""
    from pipelines.train.forecast import block_processor_s
    from pipelines.train.options import TrainOptions

    assert isinstance(parts.options, TrainOptions)
    survey = load_json(Survey, parts.workspace.path(SURVEY))
    return None if parts.on_gpu() else block_processor_s(plan, survey.largest_photograph_px, parts.options)


def _run_part(
    ctx: click.Context, workspace: Workspace, spec: StageSpec, number: int | None, values: dict[str, Any]
) -> None:
    """Run a part as one job does: without the lock of the workspace, which its parent may hold."""
    parts = _parts(workspace, {})
    progress = progress_for(ctx.obj)
    if number is not None:
        parts.plan().block(number)
    elif spec is TRAIN_SCAFFOLD and (values["force"] or parts.why_missing(SOLVE)):
        parts.run(SOLVE, force=values["force"], progress=progress)
    variant = parts.place(number)
    with boundary.logged_to_file(variant, spec):
        outcome = parts.run(spec, number, force=values["force"], progress=progress)
    print_outcome(variant, outcome, as_json=values["as_json"], told=is_told(ctx.obj))


def _train(ctx: click.Context, workspace: Workspace, given: dict[str, Any], values: dict[str, Any]) -> None:
    from pipelines.train.blocks.stage import train_blocks

    parts = _parts(workspace, given)
    with workspace.lock("blocks train"):
        workspace.remember({TRAIN.name: runner.remembered(workspace, TRAIN, given)})
        plan = train_blocks(parts, progress_for(ctx.obj), force=values["force"])
    if values["as_json"]:
        print_json({"blocks": [parts.training(block).model_dump(mode="json") for block in plan.blocks]})
    else:
        print_rich(*job_tables.plan(plan, parts.states(plan)))


def _all(
    ctx: click.Context, workspace: Workspace, given: dict[str, Any], values: dict[str, Any], *, only_merge: bool
) -> None:
    from pipelines.train.blocks.stage import require_trained

    parts = _parts(workspace, given)
    if only_merge:
        require_trained(parts, parts.plan())
    flags = runner.remembered(workspace, TRAIN, given)
    announce_training(workspace, (TRAIN,), {TRAIN.name: flags}, force=values["force"])
    with boundary.logged_to_file(workspace, TRAIN):
        outcome = runner.run_stage(
            workspace,
            TRAIN,
            flags,
            force=values["force"] and not only_merge,
            renew=not parts.is_merged() and (workspace.root / BLOCK_RECORD).exists(),
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
        *engine_options(),
        options.force_option("Run even what is current, and start afresh."),
        options.json_option(),
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
