"""Common part of the commands of single stages: build the command, run the stage, print and deliver its result.

Copies of products outside the workspace are complete or absent, and never over a file by accident.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from rich.console import RenderableType

from georef_cli import boundary, options
from georef_cli.command import Command, merged_verbosity
from georef_cli.display import is_logged, progress_for
from georef_cli.estimate import announced_estimate, print_dry_run
from georef_cli.output import print_outcome
from pipelines.core import runner
from pipelines.core.errors import InputError, storage_failures
from pipelines.core.files import remove, replace_file, replace_folder
from pipelines.core.manifest import MANIFEST
from pipelines.core.options import OptionValue, remembered
from pipelines.core.stages import BY_NAME, StageSpec
from pipelines.core.staleness import Flags, must_exist
from pipelines.core.validators import require_text
from pipelines.core.workspace import Workspace


class StageCommand(Command):
    """Command `georef STAGE WS …`: the options of the stage, `--force` and `--json`.

    Its help is the docstring of the stage's options below the title of the stage.

    Args:
        extra: further options.
        before: argument before the workspace, which is an option of the stage.
        announced: whether the log begins with the estimate of the work.
        more: returns what is printed below the figures, from the workspace and the values of the options.
    """

    def __init__(
        self,
        name: str,
        extra: Sequence[click.Option] = (),
        *,
        before: click.Argument | None = None,
        announced: bool = False,
        more: Callable[[Workspace, Flags], Sequence[RenderableType]] = lambda *_: (),
    ) -> None:
        self.spec, self._more, self._announced = BY_NAME[name], more, announced
        is_folder = self.spec.delivers == "folder"
        target = click.Option(
            ["--to", "-o", "target"],
            type=options.FILE,
            metavar="FOLDER" if is_folder else "FILE",
            help=f"Copy {'the folder' if is_folder else 'the file and its sidecar'} here as well; what exists is "
            "replaced only with --force. A workspace that cannot be written stays as it is.",
        )
        super().__init__(
            name,
            title=self.spec.title,
            params=[
                *([] if before is None else [before]),
                options.WORKSPACE,
                *(
                    one
                    for one in options.stage_options(self.spec.options)
                    if before is None or one.name != before.name
                ),
                *extra,
                *([target] if self.spec.delivers else []),
                options.FORGET,
                options.DRY_RUN,
                options.flag("--force", text="Run even if the product is current."),
                options.JSON,
            ],
            help=options.help_of(self.spec.options),
            callback=click.pass_context(self.act),
        )

    def renews(self, workspace: Workspace, flags: Flags) -> bool:
        """Return whether a product that is current is made again from its parts; here never."""
        return False

    def invoke(self, ctx: click.Context) -> Any:
        if not ctx.params.pop("dry_run"):
            return super().invoke(ctx)
        ctx.obj = merged_verbosity(ctx)
        with boundary.logged_to_stderr(ctx.obj):
            workspace = ctx.params["workspace"]
            if self.spec.reads:
                must_exist(workspace)
            print_dry_run(
                workspace,
                (self.spec,),
                self._flags(ctx, ctx.params),
                force=ctx.params["force"],
                as_json=ctx.params["as_json"],
                progress=progress_for(ctx.obj),
            )
        return 0

    def _flags(self, ctx: click.Context, values: Flags) -> dict[str, dict[str, Any]]:
        """Return the options of this and earlier commands, by stage."""
        name = self.spec.name
        given = options.given(ctx, self.spec.options.model_fields)
        forget = options.forgotten(self.spec.options, values["forget"])
        return remembered(values["workspace"].root, [name], {name: given}, {name: forget})

    def act(self, ctx: click.Context, **values: OptionValue) -> None:
        """Run the stage, copy its result to the user's path, and print it.

        Raises:
            InputError: the path exists already, cannot be written, or names another format.
            GeorefError: the stage failed.
        """
        workspace, force, target = values["workspace"], values["force"], values.get("target")
        delivers, is_folder = self.spec.delivers, self.spec.delivers == "folder"
        if self.spec.reads:
            must_exist(workspace)
        if target is not None:
            check_target(target, self.spec, folder=is_folder, overwrite=force)
        flags = self._flags(ctx, values)
        if self._announced:
            announced_estimate(workspace, (self.spec,), flags, force=force)
        with _writable(workspace, target) if delivers else nullcontext(workspace) as writable:
            with boundary.logged_to_file(writable, self.spec):
                outcome = runner.run_stage(
                    writable,
                    self.spec,
                    flags[self.spec.name],
                    force=force,
                    renew=self.renews(workspace, flags[self.spec.name]),
                    resume="always" if values.get("resume") else "if-same",
                    progress=progress_for(ctx.obj),
                )
            if target is not None:
                with writable.lock(self.spec.name):
                    made = writable.written if outcome.ran else writable.root
                    if is_folder:
                        deliver_folder(made / self.spec.folder, target)
                    else:
                        deliver(made / self.spec.product, target)
        more = self._more(workspace, values)
        print_outcome(workspace, outcome, *more, as_json=values["as_json"], logged=is_logged(ctx.obj))


@contextmanager
def _writable(workspace: Workspace, target: Path | None) -> Iterator[Workspace]:
    """Yield the workspace; one that cannot be written, with a folder beside the target that takes what is written.

    Raises:
        InputError: the workspace cannot be written, and there is no target.
    """
    if workspace.is_writable():
        yield workspace
        return
    if target is None:
        message = "cannot be written."
        remedy = "Give --to: the result is made there, and the workspace stays as it is."
        raise InputError("workspace-read-only", message, path=workspace.root, remedy=remedy)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as folder:
        yield replace(workspace, outside=Path(folder))


def check_target(target: Path, spec: StageSpec, *, folder: bool, overwrite: bool) -> None:
    """Refuse, before the work begins, a target to which the result cannot be written, or may not; make its folder.

    Its name says another format than the stage writes; it is a folder with other content, or in one that cannot be
    made; or it exists and may not be replaced.
    """
    suffix = Path(spec.product).suffix
    if folder and target.is_dir() and not (target / Path(spec.product).name).exists():
        message = f"is a folder that {spec.name} did not write, and would be replaced."
        remedy = "Give a new name."
        raise InputError("target-not-replaced", message, path=target, remedy=remedy)
    if folder and target.suffix and not target.is_dir():
        message = f"is the name of a {target.suffix} file, but {spec.name} writes a folder."
        remedy = "Give a folder."
        raise InputError("target-suffix", message, path=target, remedy=remedy)
    if not folder and target.suffix.lower() != suffix:
        message = f"is not the name of a {suffix} file, which {spec.name} writes. End the name with {suffix}."
        raise InputError("target-suffix", message, path=target)
    require_text(target)
    if target.exists() and not overwrite:
        raise InputError("target-exists", "exists already.", path=target, remedy="--force replaces it.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        message = f"cannot be made: {error.strerror}."
        remedy = "Give --to a path in another folder."
        raise InputError("target-folder", message, path=target.parent, remedy=remedy) from error
    if not os.access(target.parent, os.W_OK):
        message = "cannot be written."
        remedy = "Give --to a path in another folder."
        raise InputError("target-folder", message, path=target.parent, remedy=remedy)


def deliver(source: Path, target: Path) -> None:
    """Copy a file and its sidecars (`source.*`) to `target`, which get their names when all are complete."""
    family = sorted(source.parent.glob(f"{source.name}*"))
    targets = [target.with_name(target.name + member.name.removeprefix(source.name)) for member in family]
    drafts = [path.with_name(f".{path.name}.partial") for path in targets]
    try:
        with storage_failures():
            for member, draft in zip(family, drafts, strict=True):
                shutil.copyfile(member, draft)
            for draft, path in zip(drafts, targets, strict=True):
                replace_file(draft, path)
    finally:
        for draft in drafts:
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)


def deliver_folder(source: Path, target: Path) -> None:
    """Copy a stage's folder, without its manifest, to `target`, where it appears when it is complete."""
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
