"""Common part of the commands of single stages: build the command, run the stage, print its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from georef_cli import boundary, options
from georef_cli.command import Command
from georef_cli.display import is_told, progress_for
from georef_cli.output import print_outcome
from pipelines.core import runner
from pipelines.core.stages import BY_NAME
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
                options.force_option(),
                options.json_option(),
            ],
            help=doc,
            callback=click.pass_context(self.act),
        )

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
        flags = options.given(ctx, self.spec.options.model_fields)
        workspace = values["workspace"]
        forget = options.forgotten(self.spec.options, values["forget"])
        flags = runner.remembered(workspace, self.spec, flags, forget)
        with boundary.logged_to_file(workspace, self.spec):
            return runner.run_stage(
                workspace,
                self.spec,
                flags,
                force=values["force"],
                resume=resume,
                progress=progress_for(ctx.obj),
            )
