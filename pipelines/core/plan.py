"""Plan of a run: what each stage would do, and why, without doing it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal

from pipelines.core.errors import InputError
from pipelines.core.guards import damaged_product, is_unfinished, refuse_loss, refuse_loss_by_options
from pipelines.core.manifest import Memo
from pipelines.core.options import StageOptions, flag_name, input_paths
from pipelines.core.origins import OptionOrigin, option_origins
from pipelines.core.stages import StageSpec, producer_of
from pipelines.core.staleness import (
    BY_HAND,
    Flags,
    changed_inputs,
    changed_options,
    found_interrupted,
    request,
    stage_config,
    why_damaged,
    why_stale,
)
from pipelines.core.workspace import Workspace

Action = Literal["run", "resume", "extend", "keep", "perhaps", "refuse"]


@dataclass(frozen=True)
class PlannedStage:
    """What a run would do with a stage.

    Attributes:
        stage: the subcommand.
        action: `perhaps`: it runs, unless the stages before it give the same products as before.
        reason: cause of the action.
        options: those whose value is no default, with their origins.
        resolved: all options.
    """

    stage: str
    action: Action
    reason: str
    options: tuple[OptionOrigin, ...]
    resolved: StageOptions


def plan(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool = False
) -> list[PlannedStage]:
    """Return what a run of the stages would do; nothing is written.

    Args:
        workspace: may not exist yet.
        stages: in the order of the pipeline.
        flags: all options by stage, the remembered ones among them.
        force: run also what is current.

    Raises:
        InputError: an option is unknown or invalid, or a file that an option names does not exist.
    """
    memo: Memo = {}
    running: set[str] = set()
    planned = []
    for spec in stages:
        asked = flags.get(spec.name, {})
        resolved = stage_config(workspace, spec, asked)
        action, reason = _action(workspace, spec, asked, running, memo, force=force)
        if action != "keep":
            running.add(spec.name)
        origins = tuple(option_origins(workspace, spec, asked))
        planned.append(PlannedStage(spec.name, action, reason, origins, resolved))
    return planned


def _action(
    workspace: Workspace, spec: StageSpec, asked: Flags, running: Collection[str], memo: Memo, *, force: bool
) -> tuple[Action, str]:
    partial, found = workspace.partial_product(spec), found_interrupted(workspace, spec)
    if force:
        loses = spec.resumable and partial.progress() is not None
        return "run", f"--force; drops an interrupted run: {found}" if loses else "--force"
    options = stage_config(workspace, spec, asked)
    try:
        refuse_loss_by_options(workspace, spec, options)
    except InputError as error:
        return "refuse", str(error)
    if workspace.placed_by_hand(spec):
        return "keep", BY_HAND
    try:
        manifest = workspace.manifest(spec)
    except InputError as error:
        return "run", str(error)
    ahead = [name for part in spec.reads if (name := producer_of(part.product).name) in running]
    if manifest is None:
        _require_inputs(options)  # not their hashes, which take minutes for photographs that no run has read
        resumes = spec.resumable and partial.exists()
        return ("resume", f"interrupted: {found}") if resumes else ("run", "never run")
    damage = why_damaged(damaged_product(workspace, spec, memo, by_content=False))
    if damage:
        return "run", damage
    changed = changed_options(options, manifest.config)
    if ahead and not changed:
        return "perhaps", f"after {', '.join(dict.fromkeys(ahead))}"
    if ahead:
        return "run", changed
    present = request(workspace, spec, asked, memo)
    reason = why_stale(workspace, present, manifest)
    if is_unfinished(workspace, present):
        return "resume", f"interrupted beside the finished product: {found}"
    if not reason:
        return "keep", manifest.key_figure
    try:
        refuse_loss(workspace, present)
    except InputError as error:
        return "refuse", str(error)
    inputs = changed_inputs(present.inputs.hashes, manifest.inputs)
    grown = spec.growing and not inputs and not changed_options(options, manifest.config, but=spec.growing)
    return ("extend" if grown else "run"), reason


def _require_inputs(options: StageOptions) -> None:
    """Refuse a missing input.

    Raises:
        InputError: a path that an option names does not exist.
    """
    for name, path in input_paths(options).items():
        if not path.exists():
            raise InputError("no such file or folder", path=path, field=flag_name(type(options), name))
