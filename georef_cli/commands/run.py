"""Command `georef run`."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import click

from georef_cli import boundary, options
from georef_cli.command import Command
from georef_cli.display import is_logged, progress_for
from georef_cli.estimate import RunTimeLeft, announced_estimate, keep_times, print_dry_run
from georef_cli.options import SET, settings
from georef_cli.output import evaluated_cameras, print_outcomes
from pipelines.core import runner
from pipelines.core.errors import GeorefError
from pipelines.core.options import OptionValue, names_of_flags, remembered
from pipelines.core.progress import SILENT, ProgressTask
from pipelines.core.sentences import about
from pipelines.core.stages import BY_NAME, DELIVERABLES, MODEL, PIPELINE, StageSpec, named_deliverables, stage_slice
from pipelines.core.staleness import must_exist
from pipelines.core.workspace import Workspace
from pipelines.ingest.options import IngestOptions
from pipelines.jobs import pace
from pipelines.survey.headline import outdated, with_newest_solution
from pipelines.survey.options import AreaOptions, CrsOptions

if TYPE_CHECKING:
    from pipelines.deliver.overview import Overview

log = logging.getLogger(__name__)

# Options of later stages that `run` offers too, with the stages that they are for. All other options are set in
# georef.toml, or with the stage's own command.
_EFFORT = ("preset", "iterations", "max_image_size", "max_gaussians", "crop_size", "blocks")
_LIDAR = (
    *("lidar", "lidar_crs", "lidar_vertical", "lidar_offset", "lidar_up"),
    *("lidar_trajectory", "lidar_sigma", "lidar_register", "lidar_held_out"),
    *("depth_unit", "depth_along", "depth_camera"),
)
_IN_AREA = (
    "train",
    "evaluate",
    *(
        f"export-{name}"
        for name in ("ply", "measurable", "raster", "cloud", "mesh", "spz", "sog", "tiles", "html", "opf")
    ),
)
LATER: dict[str, tuple[str, ...]] = {
    "mapper": ("sfm",),
    "import_model": ("sfm",),
    "triangulate": ("sfm",),
    "earlier": ("sfm",),
    "max_residual": ("init-sim3",),
    "accept_inconsistency": ("ingest", "init-sim3"),
    **dict.fromkeys(_EFFORT, ("train",)),
    "backend": ("train", "evaluate"),
    **dict.fromkeys(_LIDAR, ("train",)),
    **dict.fromkeys(("tolerance_h", "tolerance_v"), ("evaluate",)),
    "seed": ("sfm", "init-sim3", "train"),
    **dict.fromkeys(AreaOptions.model_fields, _IN_AREA),
    "fill": _IN_AREA[1:],
}
OWNERS: dict[str, tuple[str, ...]] = {**dict.fromkeys(IngestOptions.model_fields, ("ingest",)), **LATER}
DELIVER = click.Option(
    ["--deliver"],
    metavar="NAMES",
    help=f"Make these as well: {', '.join(spec.name.removeprefix('export-') for spec in DELIVERABLES)}, with "
    "commas, or all. Their options are set in georef.toml or with their own commands.",
)


def _run(ctx: click.Context, **values: OptionValue) -> None:
    try:
        stages = stage_slice(values["first"], values["last"])
    except GeorefError as error:
        raise click.UsageError(str(error)) from error
    workspace, wanted = values["workspace"], deliverables(values["deliver"])
    trains = any(spec.name == "train" for spec in stages)
    if wanted and not trains and not (workspace.root / MODEL).exists():
        raise click.UsageError("--deliver needs a trained model, which this run does not make: leave out --to.")
    stages += wanted
    flags = _flags(ctx, stages, settings(values["settings"], stages, _later(stages)))
    forget, force = _forgotten(values["forget"], stages), values["force"]
    if stages[0].reads:
        must_exist(workspace)
    flags_by_stage = remembered(workspace.root, [spec.name for spec in stages], flags, forget)
    if values["dry_run"]:
        print_dry_run(
            workspace,
            stages,
            flags_by_stage,
            force=force,
            as_json=values["as_json"],
            progress=progress_for(ctx.obj),
            given=flags,
        )
        return
    before, estimate = pace.ticks(), announced_estimate(workspace, stages, flags_by_stage, force=force)
    time_left = RunTimeLeft({} if estimate is None else estimate.seconds)
    progress = progress_for(ctx.obj)
    # A program that follows several runs shows how many stages of each are done; bars and lines name the stages.
    with (progress if ctx.obj.json_progress else SILENT).task("stages", len(stages)) as done:
        outcomes = runner.run_pipeline(
            workspace,
            stages,
            flags,
            forget=forget,
            force=force,
            progress=progress,
            around=lambda spec: _counted(workspace, spec, done, time_left, trains=trains),
        )
    keep_times(estimate, outcomes, before)
    newest = with_newest_solution(workspace)
    solved = evaluated_cameras(newest) if stages[-1].name == "init-sim3" else None
    print_outcomes(
        newest,
        outcomes,
        _overview(newest),
        solved,
        cautions=outdated(workspace, newest),
        as_json=values["as_json"],
        logged=is_logged(ctx.obj),
    )


@contextlib.contextmanager
def _counted(
    workspace: Workspace, spec: StageSpec, done: ProgressTask, time_left: RunTimeLeft, *, trains: bool
) -> Iterator[None]:
    """Log a stage to its file, say what time the run has left, and count the stage when it has ended."""
    if trains and spec.name == "sfm":  # which leaves time, and comes before the first use of the kernels
        from pipelines.train.compilation import start_compilation

        start_compilation()
    with boundary.logged_to_file(workspace, spec):
        if time_left.seconds:
            log.info("run: about %s left", about(time_left.seconds))
        done.advance(0, spec.name, time_left.seconds)
        time_left.begin()
        yield
    time_left.end(spec.name)
    done.advance(1, spec.name, time_left.seconds)


def _overview(workspace: Workspace) -> Overview | None:
    """Return the overview of what the run has reached; None before training."""
    if not workspace.has(MODEL):
        return None
    from pipelines.deliver.overview import overview

    try:
        return overview(workspace, CrsOptions())
    except GeorefError as error:  # The run has succeeded all the same.
        log.debug("no overview of the result: %s", error)
        return None


def deliverables(text: str | None) -> tuple[StageSpec, ...]:
    """Return the stages of the deliverables in a text, such as `raster,cloud` or `all`."""
    try:
        return named_deliverables(text)
    except ValueError as error:
        raise click.UsageError(f"--deliver: {error}") from error


def _forgotten(names: Sequence[str], stages: Sequence[StageSpec]) -> dict[str, list[str]]:
    """Return the fields that the user names with `--forget`, by stage."""
    if "all" in names:
        return {spec.name: list(spec.options.model_fields) for spec in stages}
    by_stage: dict[str, list[str]] = {}
    for name in names:
        for spec in stages:
            with contextlib.suppress(ValueError):
                by_stage.setdefault(spec.name, []).extend(names_of_flags(spec.options, [name]))
        if not any(by_stage.values()):
            raise click.UsageError(f"--forget: {name!r} is no option of the stages to run.")
    return by_stage


def _later(stages: tuple[StageSpec, ...]) -> tuple[StageSpec, ...]:
    """Return the stages of the pipeline after the last that runs."""
    return PIPELINE[PIPELINE.index(stages[-1]) + 1 :] if stages[-1] in PIPELINE else ()


def _flags(
    ctx: click.Context, stages: tuple[StageSpec, ...], flags: dict[str, dict[str, OptionValue]]
) -> dict[str, dict[str, Any]]:
    """Return the given options by stage, those of `--set` among them."""
    running, last = {spec.name for spec in stages}, PIPELINE.index(stages[-1]) if stages[-1] in PIPELINE else None
    for name, value in options.given(ctx, OWNERS).items():
        owners = [owner for owner in OWNERS[name] if owner in running]
        if not owners:
            flag = options.stage_option(BY_NAME[OWNERS[name][0]].options, name).opts[0]
            owned = " and ".join(OWNERS[name])
            before = [spec.name for spec in PIPELINE[:last]]
            if last is None or set(before) & set(OWNERS[name]):
                raise click.UsageError(f"{flag} is for {owned}, which is not among the stages to run.")
            log.warning(options.NOT_REACHED, flag, owned, extra={"code": "option-not-used"})
        for owner in owners:
            flags.setdefault(owner, {})[name] = value
    return flags


# Options by section of the help; the ten that most runs need come first.
SECTIONS: dict[str, tuple[str, ...]] = {
    "Most runs need": (
        "images", "trajectory", "vertical", "crs", "gcp", "checkpoints", "preset", "deliver", "dry_run", "last",
    ),
    "Which stages": ("first", "force", "forget", "settings", "as_json"),
    "Photographs": (
        "sensor", "bag", "video", "image_topic", "fix_topic", "attitude_topic", "every", "skip_blurred", "focal_px",
        "rolling_shutter", "rig", "masks", "mask", "mask_sky", "copy_images", "test_every",
    ),
    "Positions and attitudes": (
        "geo", "events", "origin", "ground_height", "time_offset", "estimate", "lever_arm", "camera_mount",
        "boresight", "max_gap", "accept_inconsistency", "max_residual",
    ),
    "Their σ": ("sigma_h", "sigma_v", "sigma_common_h", "sigma_common_v", "sigma_attitude"),
    "Ground points and distances": (
        "marks", "marks_as_shown", "targets", "distances", "gcp_crs", "check", "vegetated", "sigma_gcp_h",
        "sigma_gcp_v", "sigma_mark", "sigma_distance",
    ),
    "Required accuracy": ("tolerance_h", "tolerance_v"),
    "Reconstruction and training": (
        "mapper", "import_model", "triangulate", "earlier", *_EFFORT, "backend", "seed", *_LIDAR,
    ),
    "Area": (*AreaOptions.model_fields, "fill"),
}  # fmt: skip
STAGE_NAME = click.Choice([spec.name for spec in PIPELINE])

command = Command(
    "run",
    params=[
        options.WORKSPACE,
        click.Option(["--from", "first"], type=STAGE_NAME, help="First stage to run."),
        click.Option(["--to", "last"], type=STAGE_NAME, help="Last stage to run."),
        *(options.stage_option(BY_NAME[owners[0]].options, name) for name, owners in OWNERS.items()),
        DELIVER,
        SET,
        options.FORGET,
        options.DRY_RUN,
        options.flag("--force", text="Run the stages even if their products are current."),
        options.JSON,
    ],
    callback=click.pass_context(_run),
    sections=SECTIONS,
    help="""
        What was interrupted is resumed. Options that a stage was given before are remembered, so that a later
        run needs only what changes: `georef status WS --options` shows them, --forget drops one. Options that are
        not listed here are given with --set, in WS/georef.toml, or with the stage's own command.

        \b
        Examples:
          georef run flight --images photos --preset fast
          georef run flight --images photos --preset high --dry-run
          georef run flight --images photos --gcp gcp_list.txt --to init-sim3
          georef run flight --from train --iterations 2000
          georef run flight --set train.sh_degree=1 --set evaluate.cross_validate=true
          georef run flight --forget gcp
          georef run flight
        """,
)
