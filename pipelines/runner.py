"""The conductor: runs stages in a workspace, skips what is current, and tells the state of each."""

from __future__ import annotations

import hashlib
import importlib
import json
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from importlib import metadata
from typing import Any, Literal

from pipelines.config import StageConfig, load_toml, resolve
from pipelines.errors import GeorefError, InputError, MissingProductError
from pipelines.progress import SILENT, Progress
from pipelines.stages import CONFIGS, PIPELINE, StageSpec, producer_of
from pipelines.workspace import Manifest, StageRun, Summary, Workspace, fingerprints, now

log = logging.getLogger(__name__)

VERSIONED = ("georefgs", "numpy", "pycolmap", "torch", "numba", "pyproj")
State = Literal["missing", "current", "stale", "interrupted"]


@dataclass(frozen=True)
class Outcome:
    """Result of asking for a stage: its manifest, and whether it was run or skipped as current."""

    stage: str
    ran: bool
    manifest: Manifest


@dataclass(frozen=True)
class StageState:
    """One row of `georef status`."""

    stage: str
    state: State
    reason: str
    finished: datetime | None
    duration_s: float | None
    key_figure: str


def stage_config(workspace: Workspace, spec: StageSpec, flags: Mapping[str, Any]) -> StageConfig:
    """Options of a stage: default < `georef.toml` < flags.

    Raises:
        InputError: unknown or invalid option.
    """
    tables = load_toml(workspace.config_file, CONFIGS)
    return resolve(spec.config, tables.get(spec.name, {}), flags, workspace.config_file)


def run_stage(
    workspace: Workspace,
    spec: StageSpec,
    flags: Mapping[str, Any],
    *,
    force: bool = False,
    resume: bool = False,
    progress: Progress = SILENT,
) -> Outcome:
    """Run one stage, unless its product is current.

    Args:
        flags: options given by the user (only those given).
        force: run even if current, and start afresh.
        resume: continue an interrupted run with the same inputs and options.

    Raises:
        GeorefError: any known failure; the previous product is left whole.
    """
    with workspace.lock():
        config = stage_config(workspace, spec, flags)
        workspace.remember(spec.name, dict(flags))
        inputs = fingerprints(workspace, spec, config)
        previous = workspace.manifest(spec)
        resolved = config.model_dump(mode="json")
        if previous and not force and previous.inputs == inputs and previous.config == resolved:
            log.info("%s: current, nothing to do", spec.name)
            return Outcome(spec.name, False, previous)
        warn_if_upstream_stale(workspace, spec)
        token = hashlib.sha256(json.dumps([resolved, inputs], sort_keys=True).encode()).hexdigest()
        out, resumed = workspace.begin(spec, token, resume=resume and not force)
        started, clock = now(), time.monotonic()
        log.info("%s: %s", spec.name, "resumed" if resumed else "started")
        run = importlib.import_module(spec.module).run
        summary: Summary = run(StageRun(workspace, out, progress, resumed), config)
        for warning in summary.warnings:
            log.warning("%s: %s", spec.name, warning)
        manifest = Manifest(
            stage=spec.name,
            config=resolved,
            inputs=inputs,
            versions=_versions(),
            started=started,
            duration_s=round(time.monotonic() - clock, 3),
            key_figure=summary.key_figure,
            values=summary.values,
            warnings=list(summary.warnings),
        )
        workspace.commit(spec, manifest)
        log.info("%s: %s (%.1f s)", spec.name, summary.key_figure, manifest.duration_s)
        return Outcome(spec.name, True, manifest)


def warn_if_upstream_stale(workspace: Workspace, spec: StageSpec) -> None:
    """Say so when a stage is about to build on a product whose own inputs have changed."""
    for name in sorted({producer_of(product).name for product in spec.reads}):
        state = next(row for row in status(workspace) if row.stage == name)
        if state.state == "stale":
            log.warning("%s builds on %s, which is stale (%s)", spec.name, name, state.reason)


def status(workspace: Workspace) -> list[StageState]:
    """The state of every stage, in order.

    Raises:
        InputError: there is no such directory.
    """
    if not workspace.root.is_dir():
        raise InputError("no such workspace: `georef ingest` makes one", path=workspace.root)
    rows: list[StageState] = []
    stale: set[str] = set()
    for spec in PIPELINE:
        row = _state(workspace, spec, stale)
        if row.state == "stale":
            stale.add(spec.name)
        rows.append(row)
    return rows


def _state(workspace: Workspace, spec: StageSpec, stale: set[str]) -> StageState:
    manifest = workspace.manifest(spec)
    interrupted = workspace.partial(spec).exists()
    if manifest is None:
        state: State = "interrupted" if interrupted else "missing"
        return StageState(spec.name, state, "", None, None, "")
    reason = _why_stale(workspace, spec, manifest, stale)
    return StageState(
        spec.name,
        "stale" if reason else "current",
        reason or ("a newer run was interrupted" if interrupted else ""),
        manifest.started,
        manifest.duration_s,
        manifest.key_figure,
    )


def _why_stale(workspace: Workspace, spec: StageSpec, manifest: Manifest, stale: set[str]) -> str:
    try:
        config = spec.config.model_validate(manifest.config)
        inputs = fingerprints(workspace, spec, config)
    except (MissingProductError, InputError) as error:
        return str(error)
    except ValueError:
        return "made by a version with other options"
    changed = [name for name in inputs if manifest.inputs.get(name) != inputs[name]]
    if changed:
        return f"{', '.join(changed)} changed"
    upstream = [name for name in dict.fromkeys(producer_of(p).name for p in spec.reads) if name in stale]
    return f"{', '.join(upstream)} is stale" if upstream else ""


def run_pipeline(
    workspace: Workspace,
    stages: tuple[StageSpec, ...],
    flags: Mapping[str, Mapping[str, Any]],
    *,
    force: bool = False,
    progress: Progress = SILENT,
) -> list[Outcome]:
    """Run stages in order, skipping what is current and resuming what was interrupted.

    A stage without flags is asked for with the flags that it was last asked for with.

    Raises:
        GeorefError: the first failure.
    """
    if not stages:
        raise GeorefError("no stage to run")
    outcomes = []
    for spec in stages:
        asked = flags.get(spec.name) or workspace.requests().get(spec.name, {})
        outcomes.append(run_stage(workspace, spec, asked, force=force, resume=True, progress=progress))
    return outcomes


def _versions() -> dict[str, str]:
    found = {}
    for name in VERSIONED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
