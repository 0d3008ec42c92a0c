"""Base of all commands: the options that each of them takes, before or after its name."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import fields
from types import MappingProxyType
from typing import Any

import click

from georef_cli import boundary
from georef_cli.verbosity import Verbosity
from pipelines.core.machine import limit_threads

_VERBOSITY = tuple(field.name for field in fields(Verbosity))


class Command(click.Command):
    """Command of the program: its arguments and options, and those that all commands share.

    The indentation of its help is removed. `sections` name options by heading, in the order of the help; the others
    follow below "Further options".
    """

    def __init__(
        self,
        name: str,
        *,
        help: str,
        params: Sequence[click.Parameter] = (),
        sections: Mapping[str, Sequence[str]] = MappingProxyType({}),
        **more: Any,
    ) -> None:
        self.own_params, self.sections = tuple(params), sections
        super().__init__(name, help=inspect.cleandoc(help), params=[*params, *shared_options()], **more)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command with the verbosity of its own line and of the group's options together."""
        ctx.obj = merged_verbosity(ctx)
        with boundary.logged_to_stderr(ctx.obj):
            return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the command's own options by section, and below them those of all commands."""
        given = [param for param in self.get_params(ctx) if isinstance(param, click.Option)]
        own = {param.name or "": param for param in given if param in self.own_params}
        groups: dict[str, list[click.Option]] = {
            title: [own.pop(name) for name in names if name in own] for title, names in self.sections.items()
        }
        groups["Further options" if self.sections else "Options"] = list(own.values())
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
