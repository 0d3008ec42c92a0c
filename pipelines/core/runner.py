"""Runner of the stages in a workspace; stages whose product is current are skipped."""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from pydantic import ValidationError

from pipelines import __version__
from pipelines.core.cautions import union
from pipelines.core.errors import (
    DamagedPartialError,
    DegenerateGeometryError,
    GeorefError,
    InputError,
    MissingProductError,
    storage_failures,
)
from pipelines.core.manifest import MANIFEST, Manifest, Memo, record_files
from pipelines.core.options import input_paths
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import StageSpec, producer_of, products_of
from pipelines.core.staleness import (
    BY_HAND,
    Flags,
    Request,
    cautions_by_stage,
    must_exist,
    request,
    stage_config,
    status,
    why_damaged,
    why_stale,
)
from pipelines.core.workspace import Resume, StageRun, Summary, Workspace, now

log = logging.getLogger(__name__)

# Numbers that no matrix, no float and no product can hold.
_WITHOUT_SOLUTION = (np.linalg.LinAlgError, OverflowError, FloatingPointError, RecursionError, ValidationError)
LIBRARIES = ("numpy", "pycolmap", "torch", "numba", "pyproj")


@dataclass(frozen=True)
class Outcome:
    """Result of a requested stage: its manifest, and whether the stage ran or was skipped as current."""

    stage: str
    ran: bool
    manifest: Manifest


@storage_failures()
def run_stage(
    workspace: Workspace,
    spec: StageSpec,
    flags: Flags,
    *,
    force: bool = False,
    resume: Resume = "never",
    progress: Progress = SILENT,
) -> Outcome:
    """Run one stage, unless its product is current or was put there by hand.

    The flags are remembered for `run_pipeline`, unless the stage refuses its input.

    Args:
        workspace: holds the products that the stage reads, and receives its product.
        spec: the stage.
        flags: only the options that the user gave, by field.
        force: run even if the product is current, and start afresh.
        resume: whether to continue an interrupted run; see `Workspace.begin`.
        progress: shows the stage's tasks.

    Raises:
        GeorefError: any known failure; the previous product stays whole.
    """
    if spec.reads:
        must_exist(workspace)
    with workspace.lock(spec.name):
        memo: Memo = {}
        asked = request(workspace, spec, flags, memo, progress)
        _warn_of_stale_inputs(workspace, spec, memo)
        _refuse_damaged_inputs(workspace, spec, memo)
        before = workspace.requests().get(spec.name, {})
        workspace.remember({spec.name: flags})
        previous = None if force else _current(workspace, asked, memo)
        if previous is not None:
            return Outcome(spec.name, False, _with_present_files(workspace, asked, previous))
        try:
            manifest = _execute(workspace, asked, "never" if force else resume, progress)
        except InputError:
            workspace.remember({spec.name: before})
            raise
        return Outcome(spec.name, True, manifest)


@storage_failures()
def run_pipeline(
    workspace: Workspace,
    stages: tuple[StageSpec, ...],
    flags: Mapping[str, Flags],
    *,
    force: bool = False,
    progress: Progress = SILENT,
    around: Callable[[StageSpec], AbstractContextManager[None]] = lambda _: nullcontext(),
) -> list[Outcome]:
    """Run stages in order; current stages are skipped, and interrupted ones are resumed.

    All options are checked and remembered before the first stage begins, for two reasons: a bad option of a late
    stage costs no hours, and a run that is killed early is later completed with the same options.

    Args:
        workspace: holds the products of all stages.
        stages: the stages, in the order of the pipeline.
        flags: options by stage; they override the remembered options of the stage.
        force: run also the stages whose product is current, and start all afresh.
        progress: shows the tasks of the stages.
        around: makes the context in which a stage runs.

    Raises:
        GeorefError: the first failure.
    """
    if stages[0].reads:
        must_exist(workspace)
    before = workspace.requests()
    asked = {spec.name: remembered(workspace, spec, flags.get(spec.name, {})) for spec in stages}
    for spec in stages:
        stage_config(workspace, spec, asked[spec.name])
    with workspace.lock("run"):
        workspace.remember(asked)
    outcomes: list[Outcome] = []
    try:
        for spec in stages:
            with around(spec):
                outcome = run_stage(
                    workspace, spec, asked[spec.name], force=force, resume="if-same", progress=progress
                )
            outcomes.append(outcome)
    except (InputError, MissingProductError):
        done = {outcome.stage for outcome in outcomes}
        refused = [spec.name for spec in stages if spec.name not in done]
        with workspace.lock("run"):
            workspace.remember({name: before.get(name, {}) for name in refused})
        raise
    return outcomes


def remembered(workspace: Workspace, spec: StageSpec, flags: Flags) -> dict[str, Any]:
    """Return the options that a stage was last requested with, overridden by `flags`."""
    return {**workspace.requests().get(spec.name, {}), **flags}


def _execute(workspace: Workspace, asked: Request, resume: Resume, progress: Progress) -> Manifest:
    spec, resolved = asked.spec, asked.options.model_dump(mode="json")
    token = _token(asked, resolved)
    if resume == "never" and spec.resumable and workspace.partial(spec).exists():
        log.warning("%s: starts afresh; what an interrupted run had done is dropped", spec.name)
    started, clock = now(), time.monotonic()
    summary = _run(workspace, asked, token, resume, progress)
    out = workspace.partial(spec)
    for product in products_of(spec):
        if not (out / product.removeprefix(f"{spec.folder}/")).exists():
            raise RuntimeError(f"{spec.module} did not write {product}")
    for warning in summary.warnings:
        log.warning("%s: %s", spec.name, warning)
    carried = set(union(*cautions_by_stage(workspace, before=spec).values()))
    for caution in summary.cautions:
        if caution not in carried:
            log.warning("%s: %s", spec.name, caution.sentence)
    manifest = Manifest(
        stage=spec.name,
        config=resolved,
        inputs=asked.inputs.hashes,
        versions=_versions(),
        started=started,
        duration_s=round(time.monotonic() - clock, 3),
        key_figure=summary.key_figure,
        values=summary.values,
        warnings=list(summary.warnings),
        cautions=summary.cautions,
        files=record_files(out, spec.working),
        input_files=asked.inputs.files,
    )
    workspace.set_aside(_damaged(workspace, spec, {}, by_content=False))
    workspace.commit(spec, manifest)
    log.info("%s: %s (%.1f s)", spec.name, summary.key_figure, manifest.duration_s)
    return manifest


def _token(asked: Request, resolved: Mapping[str, Any]) -> str:
    """Return the hash of inputs and options that an interrupted run is continued with; paths may change."""
    paths = input_paths(asked.options)
    values = {name: value for name, value in resolved.items() if name not in paths}
    return hashlib.sha256(json.dumps([values, asked.inputs.hashes], sort_keys=True).encode()).hexdigest()


def _with_present_files(workspace: Workspace, asked: Request, manifest: Manifest) -> Manifest:
    """Return the manifest of a current product with its input files as they are now, saved if they were moved.

    Their content is the same, but their times may differ: without new records each look would read them again.
    """
    if asked.inputs.files == manifest.input_files or not workspace.manifest(asked.spec):
        return manifest
    renewed = manifest.model_copy(update={"input_files": asked.inputs.files})
    workspace.renew(asked.spec, renewed)
    return renewed


def _run(workspace: Workspace, asked: Request, token: str, resume: Resume, progress: Progress) -> Summary:
    """Run the module of a stage; afresh, if the partial product to be continued is damaged.

    Raises:
        GeorefError: a known failure, which is recorded.
    """
    spec = asked.spec
    run = importlib.import_module(spec.module).run
    out, resumed = workspace.begin(spec, token, resume)
    log.info("%s: %s", spec.name, "resumed" if resumed else "started")
    try:
        with storage_failures():
            try:
                summary: Summary = run(StageRun(workspace, out, progress, resumed), asked.options)
            except DamagedPartialError as error:
                log.warning("%s: starts afresh; what the interrupted run left is damaged (%s)", spec.name, error)
                out, _ = workspace.begin(spec, token, "never")
                summary = run(StageRun(workspace, out, progress), asked.options)
    except GeorefError as error:
        workspace.fail(spec, str(error))
        raise
    # Products that were edited by hand have numbers that no stage writes.
    except _WITHOUT_SOLUTION as error:
        cause = " ".join(str(error).split())[:200]
        degenerate = DegenerateGeometryError(
            f"the products that {spec.name} reads lead to no solution ({cause}): were they edited? "
            f"`georef run {workspace.root} --force` makes them again"
        )
        workspace.fail(spec, str(degenerate))
        raise degenerate from error
    return summary


def _current(workspace: Workspace, asked: Request, memo: Memo) -> Manifest | None:
    """Return the manifest of a product that need not be made again, or None."""
    spec = asked.spec
    if workspace.placed_by_hand(spec):
        log.info("%s: %s was %s and is kept; --force replaces it", spec.name, spec.product, BY_HAND)
        return Manifest(
            stage=spec.name,
            config={},
            inputs=asked.inputs.hashes,
            versions={},
            started=now(),
            duration_s=0.0,
            key_figure=BY_HAND,
            values={},
            warnings=[],
        )
    try:
        manifest = workspace.manifest(spec)
    except InputError as error:
        log.warning("%s: made again, because %s", spec.name, error)
        return None
    if manifest is None:
        return None
    damage = why_damaged(workspace.damaged(spec, manifest, memo, by_content=True))
    if damage:
        log.warning("%s: damaged, made again: %s", spec.name, damage)
        return None
    reason = why_stale(workspace, asked, manifest)
    log.info("%s: %s", spec.name, f"made again: {reason}" if reason else "current, nothing to do")
    return None if reason else manifest


def _warn_of_stale_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Log a warning for each stale stage whose product `spec` reads."""
    producers = {producer_of(part.product).name for part in spec.reads}
    for row in status(workspace, memo, before=spec):
        if row.stage in producers and row.state == "stale":
            log.warning("%s builds on %s, which is stale (%s)", spec.name, row.stage, row.reason)


def _refuse_damaged_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Refuse to build on a product that is not as its stage wrote it.

    Raises:
        InputError: a file of a stage that `spec` reads has changed since that stage ended.
    """
    for producer in dict.fromkeys(producer_of(part.product) for part in spec.reads):
        files = _damaged(workspace, producer, memo, by_content=True)
        if files:
            raise InputError(
                f"{why_damaged(files)}: `georef run {(workspace.base or workspace).root}` makes it again; to "
                f"keep it as it is, delete {producer.folder}/{MANIFEST}",
                path=workspace.root,
            )


def _damaged(workspace: Workspace, spec: StageSpec, memo: Memo, *, by_content: bool) -> list[str]:
    """Return the files of a finished product that differ from its manifest; none without a readable manifest."""
    try:
        manifest = workspace.manifest(spec)
    except InputError:
        return []
    return [] if manifest is None else workspace.damaged(spec, manifest, memo, by_content=by_content)


def _versions() -> dict[str, str]:
    versions = {"georefgs": __version__}
    for name in LIBRARIES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions
