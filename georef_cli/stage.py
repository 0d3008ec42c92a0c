"""Common part of the commands of single stages: build the command, run the stage, print its result.

Copies of products outside the workspace: complete or absent, and never over a file by accident.

Common part of the commands of deliverables: run the stage, and copy what it made to where the user wants it.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from georef_cli import boundary, options
from georef_cli.command import Command, merged_verbosity
from georef_cli.display import is_told, progress_for
from georef_cli.forecast import announce_training, print_dry_run
from georef_cli.output import print_outcome
from pipelines.core import runner
from pipelines.core.errors import InputError, storage_failures
from pipelines.core.files import remove, replace_file, replace_folder
from pipelines.core.manifest import MANIFEST
from pipelines.core.options import remembered
from pipelines.core.stages import BY_NAME, StageSpec
from pipelines.core.staleness import must_exist
from pipelines.core.validators import require_text
from pipelines.core.workspace import Resume


class StageCommand(Command):
    """Command `georef STAGE WS …`: the options of the stage, `--force` and `--json`.

    Args:
        name: of the stage.
        doc: help, with examples.
        extra: further options, passed to `act`.
    """

    def __init__(self, name: str, doc: str, extra: Sequence[click.Option] = ()) -> None:
        self.spec = BY_NAME[name]
        super().__init__(
            name,
            params=[
                options.workspace_argument(),
                *options.stage_options(self.spec.options),
                *extra,
                options.forget_option(),
                options.dry_run_option(),
                options.force_option(),
                options.json_option(),
            ],
            help=doc,
            callback=click.pass_context(self.act),
        )

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, or show what it would do."""
        if not ctx.params.pop("dry_run"):
            return super().invoke(ctx)
        ctx.obj = merged_verbosity(ctx)
        with boundary.logged_to_stderr(ctx.obj):
            self.show_plan(ctx, ctx.params)
        return 0

    def show_plan(self, ctx: click.Context, values: Mapping[str, Any]) -> None:
        """Print what the command would do."""
        workspace = values["workspace"]
        if self.spec.reads:
            must_exist(workspace)
        print_dry_run(
            workspace,
            (self.spec,),
            self.flags(ctx, values),
            force=values["force"],
            as_json=values["as_json"],
            progress=progress_for(ctx.obj),
        )

    def flags(self, ctx: click.Context, values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the options of this and earlier commands, by stage."""
        name = self.spec.name
        given = options.given(ctx, self.spec.options.model_fields)
        forget = options.forgotten(self.spec.options, values["forget"])
        return remembered(values["workspace"].root, [name], {name: given}, {name: forget})

    def act(self, ctx: click.Context, **values: Any) -> None:
        """Run the stage and print its result."""
        outcome = self.run(ctx, values)
        print_outcome(values["workspace"], outcome, as_json=values["as_json"], told=is_told(ctx.obj))

    def run(self, ctx: click.Context, values: Mapping[str, Any], *, resume: Resume = "if-same") -> runner.Outcome:
        """Return the outcome of the stage with the options that the user gave, now or before.

        Args:
            ctx: has the verbosity, and the origin of the options' values.
            values: of all options.
            resume: whether to continue an interrupted run.

        Raises:
            GeorefError: the stage failed.
        """
        workspace, flags = values["workspace"], self.flags(ctx, values)
        announce_training(workspace, (self.spec,), flags, force=values["force"])
        with boundary.logged_to_file(workspace, self.spec):
            return runner.run_stage(
                workspace,
                self.spec,
                flags[self.spec.name],
                force=values["force"],
                resume=resume,
                progress=progress_for(ctx.obj),
            )


def refuse_other_format(target: Path, spec: StageSpec, *, folder: bool) -> None:
    """Refuse a target whose name says another format than the stage writes, or a folder with other content.

    Args:
        target: path that the user gave.
        spec: the stage.
        folder: whether it delivers a folder.

    Raises:
        InputError: the suffix of the name is not that of the product, or the folder is not an older deliverable.
    """
    suffix = Path(spec.product).suffix
    if folder and target.is_dir() and not (target / Path(spec.product).name).exists():
        raise InputError(
            f"is a folder that {spec.name} did not write, and would be replaced: give a new name", path=target
        )
    if folder and target.suffix and not target.is_dir():
        raise InputError(f"{spec.name} writes a folder, not a {target.suffix} file: give a folder", path=target)
    if not folder and target.suffix.lower() != suffix:
        named = f"a {target.suffix} file" if target.suffix else "a name without a suffix"
        raise InputError(f"{spec.name} writes {suffix}, not {named}: end the name with {suffix}", path=target)


def check_target(target: Path, *, overwrite: bool) -> None:
    """Check, before the work begins, that its result can be written to `target`.

    Raises:
        InputError: the folder is missing, or the target exists and may not be replaced.
    """
    require_text(target)
    if not target.parent.is_dir():
        raise InputError("no such folder: make it first", path=target.parent)
    if target.exists() and not overwrite:
        raise InputError("exists already: --force replaces it", path=target)


def deliver(source: Path, target: Path) -> None:
    """Copy a file and its sidecars (`source.*`) to `target`.

    The copies appear, or replace older files, when all of them are complete.

    Raises:
        StorageError: the target cannot be written.
    """
    family = sorted(source.parent.glob(f"{source.name}*"))
    targets = [target.with_name(target.name + member.name.removeprefix(source.name)) for member in family]
    drafts = [path.with_name(f".{path.name}.partial") for path in targets]
    try:
        with storage_failures():
            _copy(family, drafts, targets)
    finally:
        for draft in drafts:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)


def deliver_folder(source: Path, target: Path) -> None:
    """Copy a stage's folder, without its manifest, to `target`, where it appears when it is complete.

    Raises:
        StorageError: the target cannot be written.
    """
    draft, aside = (target.with_name(f".{target.name}.{part}") for part in ("partial", "old"))
    try:
        with storage_failures():
            remove(draft)
            shutil.copytree(source, draft, ignore=shutil.ignore_patterns(MANIFEST))
            replace_folder(draft, target, aside)
    finally:
        with contextlib.suppress(OSError):
            remove(draft)
            if target.exists():
                remove(aside)


def _copy(family: list[Path], drafts: list[Path], targets: list[Path]) -> None:
    for member, draft in zip(family, drafts, strict=True):
        shutil.copyfile(member, draft)
    for draft, path in zip(drafts, targets, strict=True):
        replace_file(draft, path)


class DeliverableCommand(StageCommand):
    """Command `georef export-… WS [--to PATH]` of a stage that makes something to hand over.

    Args:
        name: of the stage.
        doc: help, with examples.
        folder: whether the deliverable is the stage's whole folder; otherwise it is one file with its sidecars.
        extra: further options, passed to `act`.
    """

    def __init__(self, name: str, doc: str, *, folder: bool = False, extra: Sequence[click.Option] = ()) -> None:
        self.folder = folder
        what = "the folder" if folder else "the file and its sidecar"
        super().__init__(
            name,
            doc,
            extra=[
                *extra,
                click.Option(
                    ["--to", "-o", "target"],
                    type=click.Path(resolve_path=True, path_type=Path),
                    metavar="FOLDER" if folder else "FILE",
                    help=f"Copy {what} here as well; what exists is replaced only with --force.",
                ),
            ],
        )

    def act(self, ctx: click.Context, **values: Any) -> None:
        """Run the stage, copy its result to the user's path, and print it.

        Raises:
            InputError: the path exists already, cannot be written, or names another format.
        """
        workspace, target = values["workspace"], values["target"]
        if target is not None:
            refuse_other_format(target, self.spec, folder=self.folder)
            check_target(target, overwrite=values["force"])
        outcome = self.run(ctx, values)
        if target is not None:
            with workspace.lock(self.spec.name):
                product = workspace.path(self.spec.product)
                if self.folder:
                    deliver_folder(workspace.root / self.spec.folder, target)
                else:
                    deliver(product, target)
        print_outcome(workspace, outcome, as_json=values["as_json"], told=is_told(ctx.obj))
