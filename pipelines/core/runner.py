"""Runner of the stages in a workspace; those whose product is current are skipped."""

import contextlib
import importlib
import logging
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from pipelines.core import errors, staleness
from pipelines.core.files import remove, replace_text
from pipelines.core.fingerprints import library_versions
from pipelines.core.lock import WriteLock
from pipelines.core.manifest import MANIFEST, Manifest, Memo, record_files
from pipelines.core.options import REQUESTS, read_requests, remember, remembered, require_available
from pipelines.core.products import union
from pipelines.core.progress import AT_END, SILENT, Progress
from pipelines.core.sentences import duration
from pipelines.core.stages import STAGES, StageSpec, products_of
from pipelines.core.staleness import BY_HAND, Flags, Request
from pipelines.core.workspace import Resume, StageRun, Summary, Workspace

log = logging.getLogger(__name__)


@contextmanager
def clean_up_after_refusal(workspace: Workspace) -> Iterator[None]:
    """Remove what a command wrote, if it fails before the first product of a new workspace.

    Files of others in the folder stay, `georef.toml` among them. An interrupted command keeps what it has written:
    it can be completed. The workspace is not locked by this process.
    """
    missing = [folder for folder in (workspace.root, *workspace.root.parents) if not folder.exists()]
    is_new = workspace.base is None and not workspace.has_begun()
    try:
        yield
    except errors.WorkspaceBusyError:
        raise
    except errors.GeorefError:
        if is_new and not workspace.has_product():
            with contextlib.suppress(OSError, errors.GeorefError):
                _clear(workspace, missing)
        raise


def _clear(workspace: Workspace, missing: Sequence[Path]) -> None:
    """Remove lock, logs, requests and partial products, and the folders that were missing, if they are empty."""
    if not workspace.root.is_dir():
        return
    lock = WriteLock(workspace.root)
    with lock.hold("cleaning up"):
        for spec in STAGES:
            remove(workspace.partial(spec))
            workspace.log_file(spec).unlink(missing_ok=True)
        (workspace.root / REQUESTS).unlink(missing_ok=True)
        lock.discard()
    for folder in (workspace.root / "logs", *missing):
        with contextlib.suppress(OSError):  # of others, or not empty
            folder.rmdir()


# Numbers that no matrix, no float and no product can hold.
_WITHOUT_SOLUTION = (np.linalg.LinAlgError, OverflowError, FloatingPointError, RecursionError, ValidationError)
# Errors that are the result of a run: to continue it would lead to them again.
_RESULTS = (errors.ConvergenceError, errors.DegenerateGeometryError)


@dataclass(frozen=True)
class Outcome:
    """Result of a requested stage: its manifest, and whether the stage ran or was skipped as current."""

    stage: str
    ran: bool
    manifest: Manifest


@errors.storage_failures()
def run_stage(
    workspace: Workspace,
    spec: StageSpec,
    flags: Flags,
    *,
    force: bool = False,
    renew: bool = False,
    resume: Resume = "never",
    progress: Progress = SILENT,
    position: str = "",
) -> Outcome:
    """Run one stage, unless its product is current or was put there by hand.

    The flags are remembered for `run_pipeline`, unless the stage refuses its input.

    Args:
        flags: only the options that the user gave, by field.
        force: run even if the product is current, and start afresh.
        renew: run even if the product is current, with all that its parts have left.
        resume: whether to continue an interrupted run (see `Workspace.begin`), or to extend a finished product.
        position: position of the stage in a longer run, for the log: `stage 2 of 8`.

    Raises:
        BackendUnavailableError: an option needs an extra that is not installed.
        InputError: the stage refuses its input, or the request would drop what an interrupted run has done.
        GeorefError: any other known failure; the previous product stays whole.
    """
    if spec.reads:
        staleness.must_exist(workspace)
    with clean_up_after_refusal(workspace), workspace.lock(spec.name):
        memo: Memo = {}
        requested = staleness.request(workspace, spec, flags, memo, progress)
        staleness.warn_of_stale_inputs(workspace, spec, memo)
        staleness.refuse_damaged_inputs(workspace, spec, memo)
        previous = None if force or renew else _current(workspace, requested, memo)
        if previous is not None and resume != "never" and _goes_on(workspace, requested):
            previous = None
        if previous is None:
            require_available(requested.options)
            if not force:
                staleness.refuse_loss(workspace, spec, requested.options, requested.inputs.hashes)
        before = read_requests(workspace.written).get(spec.name, {})
        remember(workspace.written, {spec.name: flags})
        if previous is not None:
            return Outcome(spec.name, False, _with_present_files(workspace, requested, previous))
        try:
            manifest = _execute(workspace, requested, "never" if force else resume, progress, position)
        except errors.InputError:
            remember(workspace.written, {spec.name: before})
            raise
        return Outcome(spec.name, True, manifest)


@errors.storage_failures()
def run_pipeline(
    workspace: Workspace,
    stages: tuple[StageSpec, ...],
    flags: Mapping[str, Flags],
    *,
    forget: Mapping[str, Collection[str]] | None = None,
    force: bool = False,
    progress: Progress = SILENT,
    around: Callable[[StageSpec], AbstractContextManager[None]] = lambda _: nullcontext(),
) -> list[Outcome]:
    """Run stages in order; current ones are skipped, interrupted ones resumed. A GeorefError: the first failure.

    All options are checked and remembered before the first stage begins, for two reasons: a bad option of a late
    stage costs no hours, and a run that is killed early is later completed with the same options.

    Args:
        flags: options by stage; they override the remembered options of the stage.
        forget: remembered options by stage that no longer count.
        force: run also the stages whose product is current, and start all afresh.
        around: makes the context in which a stage runs.
    """
    if stages[0].reads:
        staleness.must_exist(workspace)
    before = read_requests(workspace.root)
    flags_by_stage = remembered(workspace.root, [spec.name for spec in stages], flags, forget)
    for spec in stages:
        options = staleness.stage_config(workspace, spec, flags_by_stage[spec.name])
        if force or not (workspace.root / spec.product).exists():  # else it may be current, and need no extra
            require_available(options)
        if not force:
            staleness.refuse_loss_by_options(workspace, spec, options)
    outcomes: list[Outcome] = []
    with clean_up_after_refusal(workspace):
        with workspace.lock("run"):
            remember(workspace.root, flags_by_stage)
        try:
            for number, spec in enumerate(stages, start=1):
                with around(spec):
                    outcome = run_stage(
                        workspace,
                        spec,
                        flags_by_stage[spec.name],
                        force=force,
                        resume="if-same",
                        progress=progress,
                        position=f"stage {number} of {len(stages)}",
                    )
                outcomes.append(outcome)
        except (errors.InputError, errors.MissingProductError):
            done = {outcome.stage for outcome in outcomes}
            refused = [spec.name for spec in stages if spec.name not in done]
            with workspace.lock("run"):
                remember(workspace.root, {name: before.get(name, {}) for name in refused})
            raise
    return outcomes


def _goes_on(workspace: Workspace, requested: Request) -> bool:
    """Return whether to go on with an interrupted run beside a current product, and tell what lies there.

    Such runs are those of `--force`, or of other options that were tried in between. What cannot be continued is
    deleted; what another request can continue stays.
    """
    spec, partial = requested.spec, workspace.partial_product(requested.spec)
    if not partial.folder.exists() or workspace.placed_by_hand(spec):
        return False
    interrupted = staleness.found_interrupted(workspace, spec)
    if staleness.is_unfinished(workspace, requested):
        log.info("%s: an interrupted run lies beside the finished product: %s", spec.name, interrupted)
        return True
    if spec.resumable and partial.progress() is not None:
        command = staleness.continuing_command(workspace, spec)
        log.warning(
            "%s: an interrupted run lies beside this product (%s). `%s` continues it; --force drops it.",
            spec.name, interrupted, command, extra={"code": "interrupted-run-kept"},
        )  # fmt: skip
        return False
    log.info("%s: a run that did not end left nothing to go on with, and is dropped: %s", spec.name, interrupted)
    remove(partial.folder)
    return False


def _execute(
    workspace: Workspace, requested: Request, resume: Resume, progress: Progress, position: str
) -> Manifest:
    spec, resolved = requested.spec, requested.options.model_dump(mode="json")
    partial = workspace.partial_product(spec)
    if spec.resumable and partial.folder.exists():
        interrupted = staleness.found_interrupted(workspace, spec)
        if resume != "never" and partial.is_of(requested.token):
            log.info("%s: goes on with an interrupted run: %s", spec.name, interrupted)
        else:
            log.warning(
                "%s: the stage starts afresh, and its interrupted run is dropped (%s).",
                spec.name, interrupted, extra={"code": "interrupted-run-dropped"},
            )  # fmt: skip
    started, clock = datetime.now(UTC).replace(microsecond=0), time.monotonic()
    summary = _run(workspace, requested, resume, progress, position)
    for product in products_of(spec):
        if not (partial.folder / product.removeprefix(f"{spec.folder}/")).exists():
            raise RuntimeError(f"{spec.module} did not write {product}")
    for warning in summary.warnings:
        log.warning("%s: %s", spec.name, warning.text, extra={"code": warning.code})
    carried = set(union(*staleness.cautions_by_stage(workspace, before=spec).values()))
    for caution in summary.cautions:
        if caution not in carried:
            log.warning("%s: %s", spec.name, caution.text, extra={AT_END: True})
    manifest = Manifest(
        stage=spec.name,
        product_version=spec.product_version,
        config=resolved,
        inputs=requested.inputs.hashes,
        versions=library_versions(),
        started=started,
        duration_s=round(time.monotonic() - clock, 3),
        key_figure=summary.key_figure,
        values=summary.values,
        warnings=summary.warnings,
        cautions=summary.cautions,
        files=record_files(partial.folder, spec.working),
        input_files=requested.inputs.files,
    )
    workspace.set_aside(staleness.finding(workspace, spec, {}).damaged)
    workspace.commit(spec, manifest)
    log.info("%s: %s (%s)", spec.name, summary.key_figure, duration(manifest.duration_s))
    return manifest


def _with_present_files(workspace: Workspace, requested: Request, manifest: Manifest) -> Manifest:
    """Return the manifest of a current product with its input files as they are now, saved if they were moved.

    Their content is the same, but their times may differ: without new records each look would read them again.
    """
    if (
        workspace.outside
        or requested.inputs.files == manifest.input_files
        or not workspace.manifest(requested.spec)
    ):
        return manifest
    renewed = manifest.model_copy(update={"input_files": requested.inputs.files})
    replace_text(workspace.root / requested.spec.folder / MANIFEST, f"{renewed.model_dump_json(indent=1)}\n")
    return renewed


def _run(workspace: Workspace, requested: Request, resume: Resume, progress: Progress, position: str) -> Summary:
    """Run the module of a stage; afresh, if the partial product to be continued is damaged."""
    spec, token, afresh = requested.spec, requested.token, resume == "never"
    out, resumed = workspace.begin(spec, token, resume)
    extends = None if afresh else staleness.extendable_product(workspace, requested)
    log.info("%s: %s%s", spec.name, "resumed" if resumed else "started", f", {position}" if position else "")
    try:
        with errors.storage_failures(out):
            module = importlib.import_module(spec.module)
            if spec.in_parts and module.made_in_parts(workspace, requested.options):
                module = importlib.import_module(spec.in_parts)
            try:
                summary: Summary = module.run(
                    StageRun(workspace, out, progress, resumed, extends, afresh), requested.options
                )
            except errors.DamagedPartialError as error:
                log.warning(
                    "%s: the stage starts afresh, because its interrupted run is damaged: %s",
                    spec.name, error, extra={"code": "interrupted-run-damaged"},
                )  # fmt: skip
                out, _ = workspace.begin(spec, token, "never")
                summary = module.run(StageRun(workspace, out, progress, afresh=afresh), requested.options)
    except errors.GeorefError as error:
        workspace.partial_product(spec).fail(str(error), worthless=isinstance(error, _RESULTS))
        raise
    # Products that were edited by hand have numbers that no stage writes.
    except _WITHOUT_SOLUTION as error:
        cause = " ".join(str(error).split())[:200]
        degenerate = errors.DegenerateGeometryError(
            "no-solution",
            f"The products that {spec.name} reads lead to no solution ({cause}). If they were edited, "
            f"`georef run {workspace.root} --force` makes them again.",
        )
        workspace.partial_product(spec).fail(str(degenerate), worthless=True)
        raise degenerate from error
    return summary


def _current(workspace: Workspace, requested: Request, memo: Memo) -> Manifest | None:
    """Return the manifest of a product that need not be made again, or None."""
    spec = requested.spec
    product = staleness.finding(workspace, spec, memo, by_content=True)
    if product.by_hand:
        log.info("%s: %s was %s and is kept; --force replaces it", spec.name, spec.product, BY_HAND)
        return Manifest(
            stage=spec.name,
            config={},
            inputs=requested.inputs.hashes,
            versions={},
            started=datetime.now(UTC).replace(microsecond=0),
            duration_s=0.0,
            key_figure=BY_HAND,
            values={},
            warnings=[],
        )
    if product.unreadable or product.damaged:
        cause = product.unreadable or f"{staleness.why_damaged(product.damaged)}."
        code = "manifest-damaged" if product.unreadable else "product-damaged"
        log.warning("%s: the product is made again, because %s", spec.name, cause, extra={"code": code})
    elif (manifest := product.manifest) is not None:
        reason = staleness.why_stale(workspace, requested, manifest)
        log.info("%s: %s", spec.name, f"made again: {reason}" if reason else f"current: {manifest.key_figure}")
        return None if reason else manifest
    return None
