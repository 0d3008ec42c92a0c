"""Plan of a run: what each stage would do, and why, without doing it.

Origin of each option's value: default, `georef.toml`, an earlier request, or the present command line.

Folder of a survey's photographs, also after it was moved.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipelines.core.errors import InputError
from pipelines.core.manifest import Memo
from pipelines.core.options import StageOptions, flag_name, input_paths, load_toml
from pipelines.core.stages import BY_NAME, StageSpec, producer_of
from pipelines.core.staleness import (
    BY_HAND,
    Flags,
    changed_inputs,
    changed_options,
    damaged_product,
    found_interrupted,
    is_unfinished,
    refuse_loss,
    refuse_loss_by_options,
    request,
    stage_config,
    why_damaged,
    why_stale,
)
from pipelines.core.workspace import Workspace

Origin = Literal["default", "georef.toml", "remembered", "command line"]


@dataclass(frozen=True)
class OptionOrigin:
    """Value of an option, and where the value comes from.

    Attributes:
        stage: the subcommand.
        flag: of the command line.
        value: the resolved value.
        origin: `remembered` is a flag of an earlier command.
    """

    stage: str
    flag: str
    value: Any
    origin: Origin


def option_origins(workspace: Workspace, spec: StageSpec, flags: Flags | None = None) -> list[OptionOrigin]:
    """Return the options of a stage whose value is no default, with their origins.

    Args:
        workspace: holds `georef.toml` and the remembered options.
        spec: the stage.
        flags: the present request; None: what is remembered.

    Raises:
        InputError: an option is unknown or invalid.
    """
    remembered = workspace.requests().get(spec.name, {})
    asked = remembered if flags is None else flags
    options = stage_config(workspace, spec, asked)
    table = load_toml(workspace.config_file, BY_NAME).get(spec.name, {})
    rows = []
    for name in type(options).model_fields:
        origin: Origin = "default"
        if name in asked:
            is_old = flags is None or (name in remembered and remembered[name] == _plain(options, name))
            origin = "remembered" if is_old else "command line"
        elif name in table:
            origin = "georef.toml"
        if origin != "default":
            rows.append(OptionOrigin(spec.name, flag_name(type(options), name), getattr(options, name), origin))
    return rows


def names_of_flags(options_type: type[StageOptions], flags: Collection[str]) -> list[str]:
    """Return the fields of the flags that a user names, without dashes in front: `gcp`, `max-image-size`.

    Raises:
        ValueError: no option has one of the names.
    """
    by_flag = {flag_name(options_type, name).removeprefix("--"): name for name in options_type.model_fields}
    named = [text.removeprefix("--").replace("_", "-") for text in flags]
    unknown = [text for text in named if text not in by_flag]
    if unknown:
        raise ValueError(f"{unknown[0]!r} is no option; the options are {', '.join(by_flag)}")
    return [by_flag[text] for text in named]


def _plain(options: StageOptions, name: str) -> Any:
    """Return an option's value as JSON has it, the form in which it is remembered."""
    return options.model_dump(mode="json")[name]


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


def photograph_folder(workspace: Workspace, image_dir: str) -> Path:
    """Return the folder of photographs that a survey names; if it is gone, the one that `ingest` is to read now.

    Whoever reads a photograph compares its hash with that of the survey.

    Args:
        workspace: of the survey.
        image_dir: of the survey: absolute, or inside the workspace.
    """
    home = workspace.base or workspace
    named = home.root / image_dir
    if named.is_dir():
        return named
    spec = BY_NAME["ingest"]
    with contextlib.suppress(InputError):
        images: Path | None = getattr(stage_config(home, spec, home.requests().get(spec.name, {})), "images", None)
        if images is not None and images.is_dir():
            return images
    return named
