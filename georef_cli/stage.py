"""Common part of the commands of single stages: build the command, run the stage, print its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import click

from georef_cli import boundary, options
from georef_cli.command import Command, merged_verbosity
from georef_cli.display import is_told, progress_for
from georef_cli.dry_run import announce_training, print_dry_run
from georef_cli.output import print_outcome
from pipelines.core import runner
from pipelines.core.stages import BY_NAME
from pipelines.core.staleness import must_exist
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
        flags = {self.spec.name: self.flags(ctx, values)}
        print_dry_run(
            workspace,
            (self.spec,),
            flags,
            force=values["force"],
            as_json=values["as_json"],
            progress=progress_for(ctx.obj),
        )

    def flags(self, ctx: click.Context, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the options of this and earlier commands."""
        given = options.given(ctx, self.spec.options.model_fields)
        forget = options.forgotten(self.spec.options, values["forget"])
        return runner.remembered(values["workspace"], self.spec, given, forget)

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
        announce_training(workspace, (self.spec,), {self.spec.name: flags}, force=values["force"])
        with boundary.logged_to_file(workspace, self.spec):
            return runner.run_stage(
                workspace,
                self.spec,
                flags,
                force=values["force"],
                resume=resume,
                progress=progress_for(ctx.obj),
            )
