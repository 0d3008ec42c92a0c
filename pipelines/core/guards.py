"""Checks ahead of a stage: stale or damaged inputs, and earlier work that would be lost or can be extended."""

from __future__ import annotations

import logging
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.manifest import MANIFEST, Manifest, Memo
from pipelines.core.options import StageOptions
from pipelines.core.stages import StageSpec, producer_of
from pipelines.core.staleness import (
    Request,
    changed_inputs,
    changed_options,
    continuing_command,
    found_interrupted,
    status,
    why_damaged,
)
from pipelines.core.workspace import Workspace

log = logging.getLogger(__name__)


def warn_of_stale_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Log a warning for each stale stage whose product `spec` reads."""
    producers = {producer_of(part.product).name for part in spec.reads}
    for row in status(workspace, memo, before=spec):
        if row.stage in producers and row.state == "stale":
            log.warning("%s builds on %s, which is stale (%s)", spec.name, row.stage, row.reason)


def refuse_damaged_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Refuse to build on a product that is not as its stage wrote it.

    Raises:
        InputError: a file of a stage that `spec` reads has changed since that stage ended.
    """
    for producer in dict.fromkeys(producer_of(part.product) for part in spec.reads):
        files = damaged_product(workspace, producer, memo, by_content=True)
        if files:
            raise InputError(
                f"{why_damaged(files)}: `georef run {(workspace.base or workspace).root}` makes it again; to "
                f"keep it as it is, delete {producer.folder}/{MANIFEST}",
                path=workspace.root,
            )


def damaged_product(workspace: Workspace, spec: StageSpec, memo: Memo, *, by_content: bool) -> list[str]:
    """Return the files of a finished product that differ from its manifest; none without a readable manifest."""
    manifest = _readable_manifest(workspace, spec)
    return [] if manifest is None else workspace.damaged(spec, manifest, memo, by_content=by_content)


def _readable_manifest(workspace: Workspace, spec: StageSpec) -> Manifest | None:
    try:
        return workspace.manifest(spec)
    except InputError:
        return None


def extendable_product(workspace: Workspace, asked: Request) -> Path | None:
    """Return the folder of a finished product that differs from the request in growing options only, or None."""
    spec, manifest = asked.spec, _readable_manifest(workspace, asked.spec)
    if not spec.growing or manifest is None or damaged_product(workspace, spec, {}, by_content=False):
        return None
    changed = changed_options(asked.options, manifest.config, but=spec.growing)
    return None if changed or changed_inputs(asked.inputs.hashes, manifest.inputs) else workspace.root / spec.folder


def is_unfinished(workspace: Workspace, asked: Request) -> bool:
    """Return whether an interrupted run for the same request lies there, which a run would go on with.

    What a run has left that failed by its nature, such as a training that diverged, leads to the same failure.
    """
    partial = workspace.partial_product(asked.spec)
    worthless = partial.failure() is not None and partial.progress() is None
    return asked.spec.resumable and partial.is_of(asked.token) and not worthless


def refuse_loss(workspace: Workspace, asked: Request) -> None:
    """Refuse a request that would drop what an interrupted run for another request has done.

    Raises:
        InputError: names the work that would be lost, the difference, and how to continue or drop the run.
    """
    partial = workspace.partial_product(asked.spec)
    before = partial.request()
    if partial.progress() is None or before is None:
        return
    config, inputs = before
    reason = changed_options(asked.options, config) or changed_inputs(asked.inputs.hashes, inputs)
    if reason:
        raise _loss(workspace, asked.spec, reason)


def refuse_loss_by_options(workspace: Workspace, spec: StageSpec, options: StageOptions) -> None:
    """Refuse options that would drop an interrupted run, before its inputs are known.

    With the options of a finished product, nothing may have to be run.

    Raises:
        InputError: as `refuse_loss`.
    """
    partial, made = workspace.partial_product(spec), _readable_manifest(workspace, spec)
    before = partial.request()
    if partial.progress() is None or before is None or (made and not changed_options(options, made.config)):
        return
    if reason := changed_options(options, before[0]):
        raise _loss(workspace, spec, reason)


def _loss(workspace: Workspace, spec: StageSpec, reason: str) -> InputError:
    command = continuing_command(workspace, spec)
    how = "" if reason.startswith("option") else " with the former input"
    return InputError(
        f"an interrupted {spec.name} would be lost ({found_interrupted(workspace, spec)}), because {reason}: "
        f"`{command}`{how} continues it, --force drops it",
        path=workspace.partial(spec),
        hint=f"{command}, or --force",
    )
