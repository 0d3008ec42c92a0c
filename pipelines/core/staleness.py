"""State of every stage, which `run`, `status` and `--dry-run` ask for here, and the checks ahead of a stage.

A product is current if its inputs and options are those of now. A stage warns of stale inputs, and refuses damaged
ones, and a request that would lose what an interrupted run has done.
"""

import json
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Literal

from pipelines.core.errors import InputError, MissingProductError
from pipelines.core.fingerprints import Fingerprints, fingerprints, hashes_of
from pipelines.core.lock import WriteLock
from pipelines.core.manifest import MANIFEST, Manifest, Memo
from pipelines.core.options import (
    OptionValue,
    StageOptions,
    as_flags,
    decisive_fields,
    load_toml,
    read_requests,
    resolve,
)
from pipelines.core.product_parts import whole_products
from pipelines.core.products import Remark, union
from pipelines.core.progress import SILENT, Progress
from pipelines.core.stages import (
    BY_NAME,
    CHANGE,
    CLEAN,
    DELIVERABLES,
    OF_NO_STAGE,
    PIPELINE,
    StageSpec,
    producer_of,
    products_of,
)
from pipelines.core.validators import require_text
from pipelines.core.workspace import Workspace

log = logging.getLogger(__name__)

BY_HAND = "put there by hand"
State = Literal["missing", "current", "stale", "damaged", "running", "interrupted", "failed"]
Flags = Mapping[str, OptionValue]


@dataclass(frozen=True)
class StageState:
    """Row of `georef status`: a stage, its product, and the run that made it.

    Attributes:
        reason: why the product is not current, or why the latest run failed.
        interrupted: what an interrupted run has left, and what goes on with it; empty without one.
    """

    stage: str
    state: State
    reason: str
    finished: datetime | None = None
    duration_s: float | None = None
    key_figure: str = ""
    interrupted: str = ""


@dataclass(frozen=True)
class Request:
    """Stage with its present options and the fingerprints of its present inputs."""

    spec: StageSpec
    options: StageOptions
    inputs: Fingerprints

    @property
    def token(self) -> str:
        """Text of the request: equal texts mean equal options and inputs."""
        values = self.options.model_dump(mode="json")
        decisive = {name: values[name] for name in decisive_fields(type(self.options))}
        return json.dumps([decisive, self.inputs.hashes], sort_keys=True)


def request(
    workspace: Workspace, spec: StageSpec, flags: Flags, memo: Memo, progress: Progress = SILENT
) -> Request:
    """Return the options (default < `georef.toml` < flags) and the inputs of a stage.

    Raises:
        MissingProductError: a product that the stage reads does not exist.
        InputError: an unknown or invalid option, or a missing file.
    """
    options, made = stage_config(workspace, spec, flags), _readable_manifest(workspace, spec)
    known = None if made is None else made.input_files
    return Request(spec, options, fingerprints(workspace, spec, options, memo, known=known, progress=progress))


def stage_config(workspace: Workspace, spec: StageSpec, flags: Flags) -> StageOptions:
    """Return the options of a stage: default < `georef.toml` < flags; an InputError names an invalid one."""
    tables = load_toml(workspace.config_file, BY_NAME)
    return resolve(spec.options, tables.get(spec.name, {}), flags, workspace.config_file, stage=spec.name)


def why_stale(workspace: Workspace, requested: Request, manifest: Manifest) -> str:
    """Return the reason why a product is stale; empty if its inputs and options are unchanged.

    Input files count by content: a path that differs is no other option.
    """
    if manifest.product_version != requested.spec.product_version:
        return "made by another version of georef"
    of_inputs = changed_inputs(requested.inputs.hashes, manifest.inputs)
    changed = changed_options(requested.options, manifest.config) or of_inputs
    if changed:
        return changed
    gone = [product for product in products_of(requested.spec) if not (workspace.root / product).exists()]
    return f"{', '.join(gone)} is gone" if gone else ""


def is_made_from(workspace: Workspace, spec: StageSpec, products: Sequence[str], memo: Memo) -> bool:
    """Return whether a finished product was made from these whole products as they are, or without those missing.

    A product without a manifest that can be read counts as made from them: nothing tells otherwise.
    """
    made = None if spec.folder in workspace.lent else _readable_manifest(workspace, spec)
    if made is None:
        return True
    present: dict[str, str] = {}
    for part in whole_products(*products, optional=True):
        present.update(hashes_of(workspace, part, memo))
    return all(present.get(product) == made.inputs.get(product) for product in products)


def changed_options(options: StageOptions, config: Flags, but: Collection[str] = ()) -> str:
    """Return which options but those of `but` differ from recorded ones, as a reason; empty if none does."""
    try:
        before = type(options).model_validate(config)
    except ValueError:
        return "made by a version with other options"
    decisive = [name for name in decisive_fields(type(options)) if name not in but]
    names = [name for name in decisive if getattr(before, name) != getattr(options, name)]
    return f"option {', '.join(names)} changed" if names else ""


def found_interrupted(workspace: Workspace, spec: StageSpec) -> str:
    """Return what an interrupted run has left: how far it came, when, and with which options."""
    partial = workspace.partial_product(spec)
    options, defaults = _options_of_partial(workspace, spec), spec.options.model_fields
    if options is None:
        return partial.how_far()
    changed = [name for name in decisive_fields(spec.options) if getattr(options, name) != defaults[name].default]
    return partial.how_far() + (f", with {as_flags(options, changed)}" if changed else "")


def continuing_command(workspace: Workspace, spec: StageSpec) -> str:
    """Return the command that goes on with an interrupted run, as long as the inputs are those of that run."""
    command = workspace.command_of(spec)
    before = _options_of_partial(workspace, spec)
    if before is None or workspace.base is not None:
        return command
    now = stage_config(workspace, spec, read_requests(workspace.root).get(spec.name, {}))
    other = [name for name in decisive_fields(spec.options) if getattr(now, name) != getattr(before, name)]
    return f"{command} {as_flags(before, other)}".rstrip()


def _options_of_partial(workspace: Workspace, spec: StageSpec) -> StageOptions | None:
    """Return the options of an interrupted run; None if they cannot be read, or are of another version."""
    before = workspace.partial_product(spec).request()
    try:
        return None if before is None else spec.options.model_validate(before[0])
    except ValueError:
        return None


def changed_inputs(inputs: Mapping[str, str], recorded: Mapping[str, str]) -> str:
    """Return which inputs differ from recorded ones, as a reason; empty if none does."""
    names = sorted({*inputs, *recorded})
    changed = [name for name in names if recorded.get(name) != inputs.get(name)]
    return f"{', '.join(changed)} changed" if changed else ""


def why_damaged(files: Sequence[str]) -> str:
    """Return the reason why a product with these changed files is damaged; empty without any."""
    if not files:
        return ""
    names = f"{', '.join(files[:3])}{' …' if len(files) > 3 else ''}"
    return (
        f"{names} is not as the stage wrote it" if len(files) == 1 else f"{names} are not as the stage wrote them"
    )


@dataclass(frozen=True)
class Finding:
    """Content of the folder of a stage.

    Attributes:
        manifest: None: there is none that can be read.
        by_hand: whether all products are there without a manifest.
        unreadable: why the manifest cannot be read; empty: it can, or there is none.
        damaged: files that differ from the manifest's records, by workspace path.
    """

    manifest: Manifest | None = None
    by_hand: bool = False
    unreadable: str = ""
    damaged: tuple[str, ...] = ()


def finding(workspace: Workspace, spec: StageSpec, memo: Memo, *, by_content: bool = False) -> Finding:
    """Return what lies in the folder of a stage; memo and `by_content` are as for `damaged_files`."""
    if workspace.placed_by_hand(spec):
        return Finding(by_hand=True)
    try:
        manifest = workspace.manifest(spec)
    except InputError as error:
        return Finding(unreadable=str(error))
    damaged = [] if manifest is None else workspace.damaged(spec, manifest, memo, by_content=by_content)
    return Finding(manifest, damaged=tuple(damaged))


def status(workspace: Workspace, memo: Memo | None = None, before: StageSpec | None = None) -> list[StageState]:
    """Return the state of every stage of the pipeline, in order, and of the deliverables that there are.

    Only the stages ahead of `before` are returned, if it is given. The memo of hashes by path is extended.

    Raises:
        InputError: the directory does not exist, or its `georef.toml` or `requests.json` is not valid.
    """
    must_exist(workspace)
    memo = {} if memo is None else memo
    requests, writer = read_requests(workspace.root), WriteLock(workspace.root).activity()
    begun = [
        spec
        for spec in ((CLEAN, *DELIVERABLES, CHANGE) if before is None else ())
        if (workspace.root / spec.folder).exists() or workspace.partial(spec).exists()
    ]
    rows: list[StageState] = []
    stale: set[str] = set()
    for spec in (*_ahead_of(before), *begun):
        row = _state(workspace, spec, requests.get(spec.name, {}), memo, stale)
        if row.state in ("stale", "damaged"):
            stale.add(spec.name)
        rows.append(replace(row, state="running", reason="") if spec.name == writer else row)
    return rows


def _state(workspace: Workspace, spec: StageSpec, flags: Flags, memo: Memo, stale: Collection[str]) -> StageState:
    """Return the state of a stage, which the stale stages upstream make stale."""
    if spec.folder in workspace.lent:  # The runs of the lending workspace keep it current.
        return StageState(spec.name, "current", "")
    product = finding(workspace, spec, memo)
    if product.by_hand:
        return StageState(spec.name, "current", BY_HAND)
    failure, interrupted = workspace.partial_product(spec).failure(), _interrupted(workspace, spec)
    if product.unreadable:
        return StageState(spec.name, "stale", product.unreadable)
    manifest, damage = product.manifest, why_damaged(product.damaged)
    if manifest is None:
        state: State = "failed" if failure else "interrupted" if interrupted else "missing"
        return StageState(spec.name, state, failure or "", interrupted=interrupted)
    reason = damage
    if not damage:
        stage_config(workspace, spec, flags)  # a bad georef.toml is an error, not a state
        try:
            reason = why_stale(workspace, request(workspace, spec, flags, memo), manifest)
        except (MissingProductError, InputError) as error:
            reason = str(error)
    upstream = [producer.name for producer in producers(spec) if producer.name in stale]
    if upstream and not reason:
        reason = f"{', '.join(upstream)} {'are' if len(upstream) > 1 else 'is'} stale"
    later = f"a later run failed: {failure}" if failure else ""
    return StageState(
        spec.name,
        "damaged" if damage else "stale" if reason else "current",
        "; ".join(filter(None, (reason, later))),
        manifest.finished,
        manifest.duration_s,
        manifest.key_figure,
        interrupted,
    )


def _interrupted(workspace: Workspace, spec: StageSpec) -> str:
    """Return what an interrupted run has left, and what goes on with it; empty without one, or if it failed."""
    partial = workspace.partial_product(spec)
    if not partial.folder.exists() or partial.is_worthless():
        return ""
    command = f"; `{continuing_command(workspace, spec)}` goes on with it" if spec.resumable else ""
    return f"an interrupted run: {found_interrupted(workspace, spec)}{command}"


def producers(spec: StageSpec) -> list[StageSpec]:
    """Return the stages whose products a stage reads, each once, in the order in which it reads them."""
    products = (part.product for part in spec.reads if part.product not in OF_NO_STAGE)
    return list(dict.fromkeys(map(producer_of, products)))


def cautions_by_stage(workspace: Workspace, before: StageSpec | None = None) -> dict[str, tuple[Remark, ...]]:
    """Return the cautions of a workspace's products, each under the first stage that has it, in order.

    Only the stages of the pipeline ahead of `before` are read, if it is given. A damaged manifest tells none.
    """
    by_stage: dict[str, tuple[Remark, ...]] = {}
    known: set[Remark] = set()
    for spec in (*_ahead_of(before), *(DELIVERABLES if before is None else ())):
        manifest = _readable_manifest(workspace, spec)
        new = () if manifest is None else tuple(c for c in union(manifest.cautions) if c not in known)
        known.update(new)
        if new:
            by_stage[spec.name] = new
    return by_stage


def document_of_cautions(by_stage: Mapping[str, Sequence[Remark]]) -> list[dict[str, str]]:
    """Return cautions by stage as they stand in JSON documents."""
    return [
        {"stage": stage, **caution.model_dump()} for stage, cautions in by_stage.items() for caution in cautions
    ]


def _ahead_of(before: StageSpec | None) -> tuple[StageSpec, ...]:
    return PIPELINE[: PIPELINE.index(before) if before in PIPELINE else len(PIPELINE)]


def _readable_manifest(workspace: Workspace, spec: StageSpec) -> Manifest | None:
    try:
        return workspace.manifest(spec)
    except InputError:
        return None


def must_exist(workspace: Workspace) -> None:
    """Refuse a workspace that does not exist."""
    require_text(workspace.root)
    if not workspace.root.is_dir():
        raise InputError(
            "no-workspace", "does not exist.", path=workspace.root, remedy="`georef ingest` makes a workspace."
        )


def warn_of_stale_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Log a warning for each stale stage whose product `spec` reads."""
    read = {producer.name for producer in producers(spec)}
    for row in status(workspace, memo, before=spec):
        if row.stage in read and row.state == "stale":
            log.warning(
                "%s builds on %s, which is stale (%s).",
                spec.name, row.stage, row.reason, extra={"code": "input-stale"},
            )  # fmt: skip


def refuse_damaged_inputs(workspace: Workspace, spec: StageSpec, memo: Memo) -> None:
    """Refuse to build on a product that is not as its stage wrote it."""
    for producer in producers(spec):
        damage = why_damaged(finding(workspace, producer, memo, by_content=True).damaged)
        if damage:
            message = (
                f"{damage}. `georef run {(workspace.base or workspace).root}` makes it again. To "
                f"keep it as it is, delete {producer.folder}/{MANIFEST}."
            )
            raise InputError("product-damaged", message, path=workspace.root)


def extendable_product(workspace: Workspace, requested: Request) -> Path | None:
    """Return the folder of a finished product that differs from the request in growing options only, or None."""
    spec = requested.spec
    product = finding(workspace, spec, {}) if spec.growing else Finding()
    if product.manifest is None or product.damaged:
        return None
    changed = changed_options(requested.options, product.manifest.config, but=spec.growing)
    changed = changed or changed_inputs(requested.inputs.hashes, product.manifest.inputs)
    return None if changed else workspace.root / spec.folder


def is_unfinished(workspace: Workspace, requested: Request) -> bool:
    """Return whether an interrupted run for the same request lies there, which a run would go on with.

    What a run has left that failed by its nature, such as a training that diverged, leads to the same failure.
    """
    partial = workspace.partial_product(requested.spec)
    return requested.spec.resumable and partial.is_of(requested.token) and not partial.is_worthless()


def refuse_loss(
    workspace: Workspace, spec: StageSpec, options: StageOptions, hashes: Mapping[str, str] | None = None
) -> None:
    """Refuse options and hashes of inputs, as far as known, that would drop what an interrupted run has done.

    The InputError names the work that would be lost, the difference, and how to continue or drop the run.
    """
    partial = workspace.partial_product(spec)
    before = partial.request()
    if partial.progress() is None or before is None:
        return
    reason = changed_options(options, before[0]) or ("" if hashes is None else changed_inputs(hashes, before[1]))
    if reason:
        command = continuing_command(workspace, spec)
        how = "" if reason.startswith("option") else " with the former input"
        message = (
            f"holds an interrupted run of {spec.name} ({found_interrupted(workspace, spec)}), which would be lost, "
            f"because {reason}."
        )
        remedy = f"`{command}`{how} continues it; --force drops it."
        raise InputError("interrupted-run-lost", message, path=partial.folder, remedy=remedy)


def refuse_loss_by_options(workspace: Workspace, spec: StageSpec, options: StageOptions) -> None:
    """Refuse options that would drop an interrupted run, before its inputs are known.

    With the options of a finished product, nothing may have to be run.
    """
    made = _readable_manifest(workspace, spec)
    if made is None or changed_options(options, made.config):
        refuse_loss(workspace, spec, options)
