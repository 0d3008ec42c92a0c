"""Plan of a run: what each stage would do, with which options, and why, without doing it."""

import contextlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pipelines.core import staleness
from pipelines.core.errors import InputError
from pipelines.core.manifest import Memo
from pipelines.core.options import StageOptions, flag_name, input_paths, load_toml, read_requests
from pipelines.core.stages import BY_NAME, StageSpec
from pipelines.core.staleness import BY_HAND, Flags
from pipelines.core.workspace import Workspace

Origin = Literal["default", "preset", "georef.toml", "remembered", "command line"]
Action = Literal["run", "resume", "extend", "keep", "perhaps", "refuse"]


@dataclass(frozen=True)
class OptionOrigin:
    """Resolved value of a stage's option, and where it comes from; `remembered` is a flag of an earlier command."""

    stage: str
    flag: str
    value: Any
    origin: Origin


def option_origins(workspace: Workspace, spec: StageSpec, flags: Flags | None = None) -> list[OptionOrigin]:
    """Return a stage's changed options: of `georef.toml`, earlier commands, flags; an InputError: one is invalid.

    The flags are the present request; None: what is remembered.
    """
    remembered = read_requests(workspace.root).get(spec.name, {})
    given = remembered if flags is None else flags
    options = staleness.stage_config(workspace, spec, given)
    table = load_toml(workspace.config_file, BY_NAME).get(spec.name, {})
    plain = options.model_dump(mode="json")  # as options are remembered
    rows = []
    for name in type(options).model_fields:
        origin: Origin = "georef.toml"
        if name in given:
            is_old = flags is None or (name in remembered and remembered[name] == plain[name])
            origin = "remembered" if is_old else "command line"
        elif name not in table:
            continue
        rows.append(OptionOrigin(spec.name, flag_name(type(options), name), getattr(options, name), origin))
    return rows


@dataclass(frozen=True)
class PlannedStage:
    """Plan of a run for a stage, with its reason; the stage's changed options, and all of them.

    The action `perhaps`: it runs, unless the stages before it give the same products as before.
    """

    stage: str
    action: Action
    reason: str
    options: tuple[OptionOrigin, ...]
    resolved: StageOptions

    @property
    def works(self) -> bool:
        """Whether the stage would do anything, wholly or in part."""
        return self.action not in ("keep", "refuse")


def plan(
    workspace: Workspace, stages: tuple[StageSpec, ...], flags: Mapping[str, Flags], *, force: bool = False
) -> list[PlannedStage]:
    """Return what a run of the stages would do; nothing is written. An InputError: a bad option, or no such file.

    Args:
        workspace: may not exist yet.
        stages: in the order of the pipeline.
        flags: all options by stage, the remembered ones among them.
    """
    memo: Memo = {}
    running: set[str] = set()
    planned = []
    for spec in stages:
        stage_flags = flags.get(spec.name, {})
        resolved = staleness.stage_config(workspace, spec, stage_flags)
        action, reason = _action(workspace, spec, stage_flags, resolved, running, memo=memo, force=force)
        if action != "keep":
            running.add(spec.name)
        origins = tuple(option_origins(workspace, spec, stage_flags))
        planned.append(PlannedStage(spec.name, action, reason, origins, resolved))
    return planned


def _action(
    workspace: Workspace,
    spec: StageSpec,
    flags: Flags,
    options: StageOptions,
    running: Collection[str],
    *,
    memo: Memo,
    force: bool,
) -> tuple[Action, str]:
    """Return what a run would do with a stage, after those that run before it."""
    interrupted = staleness.found_interrupted(workspace, spec)
    if force:
        loses = spec.resumable and workspace.partial_product(spec).progress() is not None
        return "run", f"--force; drops an interrupted run: {interrupted}" if loses else "--force"
    try:
        staleness.refuse_loss_by_options(workspace, spec, options)
    except InputError as error:
        return "refuse", str(error)
    product = staleness.finding(workspace, spec, memo)
    if product.by_hand:
        return "keep", BY_HAND
    if product.unreadable:
        return "run", product.unreadable
    manifest = product.manifest
    if manifest is None:
        for name, path in input_paths(options).items():  # no hashes: those of new photographs take minutes
            if not path.exists():
                raise InputError("no-such-file", "does not exist.", path=path, field=flag_name(type(options), name))
        resumes = spec.resumable and workspace.partial(spec).exists()
        return ("resume", f"interrupted: {interrupted}") if resumes else ("run", "never run")
    if product.damaged:
        return "run", staleness.why_damaged(product.damaged)
    changed = staleness.changed_options(options, manifest.config)
    if ahead := [producer.name for producer in staleness.producers(spec) if producer.name in running]:
        return ("run", changed) if changed else ("perhaps", f"after {', '.join(ahead)}")
    present = staleness.request(workspace, spec, flags, memo)
    reason = staleness.why_stale(workspace, present, manifest)
    if staleness.is_unfinished(workspace, present):
        return "resume", f"interrupted beside the finished product: {interrupted}"
    if not reason:
        return "keep", manifest.key_figure
    try:
        staleness.refuse_loss(workspace, spec, options, present.inputs.hashes)
    except InputError as error:
        return "refuse", str(error)
    inputs = staleness.changed_inputs(present.inputs.hashes, manifest.inputs)
    others = staleness.changed_options(options, manifest.config, but=spec.growing)
    return ("extend" if spec.growing and not inputs and not others else "run"), reason


def photograph_folder(workspace: Workspace, image_dir: str) -> Path:
    """Return the folder of photographs that a survey names; if it is gone, the one that `ingest` is to read now.

    The survey names an absolute folder, or one inside the workspace. Whoever reads a photograph compares its hash
    with that of the survey.
    """
    home = workspace.base or workspace
    named = home.root / image_dir
    if named.is_dir():
        return named
    spec = BY_NAME["ingest"]
    with contextlib.suppress(InputError):
        options = staleness.stage_config(home, spec, read_requests(home.root).get(spec.name, {}))
        images: Path | None = getattr(options, "images", None)
        if images is not None and images.is_dir():
            return images
    return named
