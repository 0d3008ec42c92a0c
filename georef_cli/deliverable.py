"""Common part of the commands of deliverables: run the stage, and copy what it made to where the user wants it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from georef_cli.delivery import check_target, deliver, deliver_folder, refuse_other_format
from georef_cli.display import is_told
from georef_cli.output import print_outcome
from georef_cli.stage import StageCommand


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
