"""Commands of the stages: title, text and flags come from the table of stages and the options; some do more."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import click
from rich.console import Group, RenderableType
from rich.table import Table

from georef_cli import boundary, options
from georef_cli.commands.cluster import ENGINE, requested_engine
from georef_cli.display import is_logged, progress_for
from georef_cli.options import flag
from georef_cli.output import print_json, print_outcome, print_rich
from georef_cli.stage import StageCommand
from georef_cli.tables import Renderable, coordinate_tables, error_tables, literal, plain_table
from pipelines.core import stages
from pipelines.core.options import OptionValue, StageOptions, remember
from pipelines.core.products import load_json
from pipelines.core.sentences import about
from pipelines.core.staleness import Flags, must_exist, stage_config
from pipelines.core.workspace import Workspace
from pipelines.survey.report import read_report
from pipelines.survey.survey import Survey

if TYPE_CHECKING:
    from pipelines.survey.block_plan import BlockPlan
    from pipelines.survey.navigation import RigCalibration
    from pipelines.train.blocks.parts import Parts


def stage_command(name: str) -> StageCommand:
    """Return the command of a stage."""
    match name:
        case "sfm":
            return _SfmCommand(name, (_CHUNK, *ENGINE))
        case "calibrate":
            return StageCommand(name, more=_calibrated)
        case "train":
            return _TrainCommand(name, (_RESUME, _PART, *ENGINE), announced=True)
        case "evaluate":
            return StageCommand(name, (_POINTS,), more=_evaluated)
        case "export-ply":
            return _PlyCommand(name, (_MEASURABLE, *options.stage_options(_of_measurable(), _ONLY_MEASURABLE)))
        case "change":
            return StageCommand(name, before=click.Argument(["before"], type=options.FOLDER, metavar="WS1"))
    return StageCommand(name)


_CHUNK = click.Option(
    ["--chunk"],
    metavar="NAME",
    hidden=True,
    help="Work on this chunk of a large survey only, beside a `georef sfm` that has planned it.",
)


class _SfmCommand(StageCommand):
    """Command of `sfm`, whose jobs call it with `--chunk`."""

    def act(self, ctx: click.Context, **values: OptionValue) -> None:
        name = values.pop("chunk")
        if name is None:
            with requested_engine(values):
                super().act(ctx, **values)
            return
        from pipelines.sfm.chunks import work_chunk

        worked = work_chunk(values["workspace"], name, progress_for(ctx.obj))
        if values["as_json"]:
            print_json({"chunk": name, "ran": worked})


_COMPONENTS = {"boresight": ("x", "y", "z"), "lever-arm": ("forward", "right", "down"), "time-offset": ("",)}


def _calibrated(workspace: Workspace, values: Flags) -> tuple[RenderableType, ...]:
    if values["as_json"]:
        return ()
    from pipelines.survey.navigation import RigCalibration

    calibration = load_json(RigCalibration, workspace.path(stages.RIG))
    if not calibration.estimates:
        return ()
    parts = [] if calibration.rms_position_m is None else [f"{calibration.rms_position_m:.3f} m an axis"]
    parts += [] if calibration.rms_attitude_deg is None else [f"{calibration.rms_attitude_deg:.2f}°"]
    images, points = calibration.images, calibration.control_points
    left_over = f"left over: {', '.join(parts)} ({images} images, {points} control points)"
    return _estimates(calibration), literal(left_over)


def _estimates(calibration: RigCalibration) -> Table:
    table = plain_table("", "estimated", "± σ", "ingest", "unit", "", right=(1, 2, 3))
    for estimate in calibration.estimates:
        applied = "applied" if estimate in calibration.applied else "[dim]not applied[/]"
        columns = (estimate.value, estimate.sigma, estimate.start, estimate.observable)
        components = zip(_COMPONENTS[estimate.name], *columns, strict=True)
        for component, value, sigma, start, observable in components:
            name = f"{estimate.name} {component}".strip()
            remark = applied if observable else "[yellow]not observable in this flight[/]"
            table.add_row(name, f"{value:.4f}", f"{sigma:.4f}", f"{start:.4f}", estimate.unit, remark)
    return table


def _part(_ctx: click.Context, _param: click.Parameter, name: str | None) -> str | None:
    if name is None or name.isdecimal() or name in _PARTS:
        return name
    raise click.BadParameter(f"{name!r} is neither the number of a block nor one of {', '.join(_PARTS)}.")


_PARTS = {"plan": stages.PLAN_BLOCKS, "scaffold": stages.TRAIN_SCAFFOLD, "seams": stages.TRAIN_SEAMS}
_PART = click.Option(
    ["--part"],
    metavar="PART",
    callback=_part,
    help="Work on this part of a training in blocks only: plan (divide the survey, and show the blocks), or the "
    "number of a block.",
)
_RESUME = flag("--resume", text="Continue the interrupted run; refuse other options.")


class _TrainCommand(StageCommand):
    """Command of `train`, whose jobs in a training in blocks call it with `--part`."""

    def act(self, ctx: click.Context, **values: OptionValue) -> None:
        part = values.pop("part")
        with requested_engine(values):
            if part is None:
                super().act(ctx, **values)
            elif part == "plan":
                self._plan(ctx, values)
            else:
                self._run_part(ctx, part, values)

    def renews(self, workspace: Workspace, flags: Flags) -> bool:
        """Return whether a block was trained again, so that the model is merged anew."""
        if not (workspace.root / stages.BLOCK_RECORD).exists():
            return False
        resolved: Any = stage_config(workspace, self.spec, flags)
        return resolved.lidar is None and self._parts(workspace, flags).is_outdated()  # with LiDAR: no blocks

    def _parts(self, workspace: Workspace, flags: Flags) -> Parts:
        from pipelines.train.blocks.parts import Parts

        resolved: Any = stage_config(workspace, self.spec, flags)
        return Parts(workspace, resolved)

    def _plan(self, ctx: click.Context, values: dict[str, OptionValue]) -> None:
        """Divide the survey into blocks, remember the options, and show the plan."""
        from pipelines.train.estimate import block_processor_s

        workspace = values["workspace"]
        must_exist(workspace)
        flags = self._flags(ctx, values)
        parts = self._parts(workspace, flags[self.spec.name])
        with workspace.lock("plan of blocks"):
            remember(workspace.root, flags)
        with boundary.logged_to_file(parts.variant(), stages.PLAN_BLOCKS):
            outcome = parts.run(stages.PLAN_BLOCKS, force=values["force"], progress=progress_for(ctx.obj))
        plan = parts.plan()
        if values["as_json"]:
            print_json({"stage": outcome.stage, "ran": outcome.ran, **plan.model_dump(mode="json")})
            return
        photo_px = load_json(Survey, workspace.path(stages.SURVEY)).largest_photograph_px
        # On a GPU nothing was measured.
        processor_s = None if parts.on_gpu() else block_processor_s(plan, photo_px, parts.options)
        print_rich(*block_table(plan, parts.states(plan), processor_s))

    def _run_part(self, ctx: click.Context, part: str, values: dict[str, OptionValue]) -> None:
        """Run a part as a job does: without the workspace's lock, which the process that started it may hold."""
        if options.given(ctx, self.spec.options.model_fields):
            raise click.UsageError(
                "Options of the training belong to `georef train` without --part, or to the plan."
            )
        workspace, force, progress = values["workspace"], values["force"], progress_for(ctx.obj)
        must_exist(workspace)
        parts = self._parts(workspace, self._flags(ctx, values)[self.spec.name])
        spec, number = _PARTS.get(part, stages.TRAIN_BLOCK), int(part) if part.isdecimal() else None
        if number is not None:
            parts.plan().block(number)
        elif spec is stages.TRAIN_SCAFFOLD and (force or parts.why_missing(stages.SOLVE)):
            parts.run(stages.SOLVE, force=force, progress=progress)
        variant = parts.variant(number)
        with boundary.logged_to_file(variant, spec):
            outcome = parts.run(spec, number, force=force, progress=progress)
        print_outcome(variant, outcome, as_json=values["as_json"], logged=is_logged(ctx.obj))


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
            literal(states.get(block.id, "")),
        )
    number = len(plan.blocks)
    whole = f"{number} blocks of {plan.photographs} photographs, {plan.gaussians} Gaussians in all"
    if plan.memory_bytes is not None:
        whole += f", for workers with {plan.memory_bytes / 2**30:.1f} GiB"
    if processor_s:
        whole += f"; about {about(sum(processor_s.values()))} of one core for all of them"
    return [table, whole]


_POINTS = flag("--points", text="Print the errors of every check and control point.")


def _evaluated(workspace: Workspace, values: Flags) -> list[Group]:
    """Return coordinates, and errors point by point if they are wanted."""
    report = read_report(workspace.path(stages.REPORT))
    return [*coordinate_tables(report), *(error_tables(report) if values["points"] else [])]


_MEASURABLE = flag(
    "--measurable",
    text="Write splat.measurable.ply, with discs on the surface, for viewers that measure by centres.",
)
_ONLY_MEASURABLE = ("disc_spacing", "appearance_passes")


def _of_measurable() -> type[StageOptions]:
    return stages.BY_NAME["export-measurable"].options


class _PlyCommand(StageCommand):
    """Command of `export-ply`, or with --measurable of `export-measurable`."""

    def invoke(self, ctx: click.Context) -> Any:
        if ctx.params.pop("measurable"):
            return StageCommand("export-measurable").invoke(ctx)
        if given := options.given(ctx, _ONLY_MEASURABLE):
            name = options.stage_option(_of_measurable(), next(iter(given))).opts[0]
            raise click.UsageError(f"{name} is for --measurable, which is not given.")
        return super().invoke(ctx)
