"""Table of the commands, and their base: the options that each of them takes, before or after its name.

Each command is a row of the table. Its module in `georef_cli.commands` is imported when it is called.
"""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import click

from georef_cli import boundary
from georef_cli.verbosity import Verbosity
from pipelines.core.machine import limit_threads
from pipelines.core.stages import CHANGE, CLEAN, DELIVERABLES, PIPELINE, SPLAT, StageSpec

_VERBOSITY = tuple(field.name for field in fields(Verbosity))


@dataclass(frozen=True)
class HelpLine:
    """Line of `georef --help` below the heading of its section, which begins the help of the command, too."""

    section: str
    help: str
    module: str = ""  # of several commands, in `georef_cli.commands`; empty: a module of its own


def _of_stages(*stages: StageSpec) -> dict[str, HelpLine]:
    return {
        spec.name: HelpLine(
            "Stages" if spec in PIPELINE and spec.product != SPLAT else "Deliverables",
            spec.title,
            "stages",
        )
        for spec in stages
        if not spec.called
    }


COMMANDS: dict[str, HelpLine] = {
    "simulate": HelpLine("Start", "Simulate a survey whose truth is known exactly."),
    "inspect": HelpLine("Start", "Show what a ROS bag or splat holds, and what ingest would choose."),
    "run": HelpLine("Pipeline", "Run all stages, or some, skipping what is current."),
    "batch": HelpLine("Pipeline", "Run many missions, and put their results into one table."),
    "compare": HelpLine("Pipeline", "Run the ablation and put its figures into one table."),
    "cluster certificates": HelpLine(
        "Pipeline", "Make the certificate that the machines of a cluster share.", "cluster"
    ),
    "cluster scheduler": HelpLine("Pipeline", "Start the scheduler of a cluster.", "cluster"),
    "cluster worker": HelpLine("Pipeline", "Lend this machine to a cluster.", "cluster"),
    "status": HelpLine("Pipeline", "Show the state of every stage."),
    "info": HelpLine("Pipeline", "Show where on Earth the result is, and what each file is for."),
    "view": HelpLine("Pipeline", "See the trained model in a browser, and measure in it."),
    "marks": HelpLine("Pipeline", "Propose marks of ground points in the photographs that lack them."),
    **_of_stages(*PIPELINE, CLEAN, *DELIVERABLES, CHANGE),
    "help": HelpLine("Start", "Explain a topic, such as heights or options, or a command."),
    "doctor": HelpLine("Start", "Show what this machine offers: memory, GPU, backends, geoid grids."),
}
# Commands of two words are one line of the help, so that it fits on a screen.
TOGETHER = {"cluster": "Lend machines to a cluster: certificates, scheduler, worker."}


def command_module(name: str) -> str:
    """Return the module in `georef_cli.commands` that defines a command of the table."""
    return COMMANDS[name].module or name.replace("-", "_")


class Command(click.Command):
    """Command of the program: its arguments and options, and those that all commands share.

    Args:
        help: text below the title; its indentation is removed.
        title: first sentence of the help; by default that of the table.
        sections: options by heading, in the order of the help; the others follow below "Further options".
    """

    def __init__(
        self,
        name: str,
        *,
        help: str,
        title: str = "",
        params: Sequence[click.Parameter] = (),
        sections: Mapping[str, Sequence[str]] = MappingProxyType({}),
        **more: Any,  # of `click.Command`
    ) -> None:
        self.own_params, self.sections = tuple(params), sections
        text = f"{title or COMMANDS[name].help}\n\n{inspect.cleandoc(help)}"
        super().__init__(name, help=text, params=[*params, *shared_options()], **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command with the verbosity of its own line and of the group's options together."""
        ctx.obj = merged_verbosity(ctx)
        with boundary.logged_to_stderr(ctx.obj):
            return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the command's own options by section, and below them those of all commands."""
        given = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        own_options = {param.name or "": param for param in given if param in self.own_params}
        groups: dict[str, list[click.Option]] = {
            title: [own_options.pop(name) for name in names if name in own_options]
            for title, names in self.sections.items()
        }
        groups["Further options" if self.sections else "Options"] = list(own_options.values())
        groups["Options of all commands"] = [param for param in given if param not in self.own_params]
        for title, params in groups.items():
            records = [record for param in params if (record := param.get_help_record(ctx)) is not None]
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def shared_options() -> list[click.Option]:
    """Return the options of verbosity, and that of the threads, which takes effect when it is parsed."""
    return [
        click.Option(["-v", "--verbose"], is_flag=True, help="Show more messages."),
        click.Option(["-q", "--quiet"], is_flag=True, help="Show warnings and errors only."),
        click.Option(["--traceback"], is_flag=True, help="Show where in the program an error was raised."),
        click.Option(
            ["--json-progress"], is_flag=True, help="Write messages and progress to stderr as lines of JSON."
        ),
        click.Option(
            ["-j", "--threads"],
            type=click.IntRange(min=1),
            metavar="N",
            expose_value=False,
            callback=_limit_threads,
            help="Use at most so many threads (default: one a core).",
        ),
    ]


def merged_verbosity(ctx: click.Context) -> Verbosity:
    """Return the verbosity of a context and of its parents, and take its options out of the parameters."""
    above = ctx.obj if isinstance(ctx.obj, Verbosity) else Verbosity()
    merged = Verbosity(**{name: ctx.params.pop(name) or getattr(above, name) for name in _VERBOSITY})
    if merged.verbose and merged.quiet:
        raise click.UsageError("--verbose and --quiet exclude each other.", ctx)
    return merged


def _limit_threads(ctx: click.Context, _param: click.Parameter, count: int | None) -> None:
    if count is not None and not ctx.resilient_parsing:
        limit_threads(count)
