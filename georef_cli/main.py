"""Group `georef`: the commands of the table, each imported when it is called.

`georef --help` reads the table alone, to answer at once. It imports no command module, and therefore neither the
validation library nor any heavier one.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from difflib import get_close_matches
from typing import Any

import click

from georef_cli import boundary
from georef_cli.command import COMMANDS, TOGETHER, Command, command_module, merged_verbosity, shared_options
from georef_cli.native_lines import native_lines_logged
from pipelines.core.stages import BY_NAME
from pipelines.core.version import described_version

PROGRAM = "georef"

# Idle threads of OpenMP sleep instead of spinning. Spinning threads take the time of the busy one if another
# program uses a core: on two cores, training was six times slower. OpenMP reads the variable when it is loaded, and
# no import above loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


class LazyGroup(click.Group):
    """Group whose subcommands are modules of `georef_cli.commands`, imported one at a time."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"georef_cli.commands.{command_module(cmd_name)}")
        if cmd_name in BY_NAME:
            made: Command = module.stage_command(cmd_name)
            return made
        held = (each for each in vars(module).values() if isinstance(each, Command))
        return next(each for each in held if each.name == cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Return the command that the first word names, or the first two, and the words behind it."""
        pair = " ".join(args[:2])
        if pair in COMMANDS:
            return pair, self.get_command(ctx, pair), args[2:]
        seconds = [name.partition(" ")[2] for name in COMMANDS if name.startswith(f"{args[0]} ")]
        if seconds and args[0] not in COMMANDS:
            ctx.fail(f"{PROGRAM} {args[0]} needs one of: {', '.join(seconds)}.")
        if args[0] not in COMMANDS and not args[0].startswith("-"):
            near = get_close_matches(args[0], COMMANDS, n=3, cutoff=0.5)
            hint = f" Did you mean {' or '.join(near)}?" if near else f" `{PROGRAM} --help` lists the commands."
            ctx.fail(f"No such command {args[0]!r}.{hint}")
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        ctx.obj = merged_verbosity(ctx)
        return super().invoke(ctx)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands from the table, without an import."""
        for section in dict.fromkeys(entry.section for entry in COMMANDS.values()):
            with formatter.section(section):
                lines = {
                    name.partition(" ")[0]: TOGETHER.get(name.partition(" ")[0], entry.help)
                    for name, entry in COMMANDS.items()
                    if entry.section == section
                }
                formatter.write_dl(list(lines.items()))


def _tell_version(ctx: click.Context, _option: click.Parameter, is_asked: bool) -> None:
    if is_asked and not ctx.resilient_parsing:
        click.echo(f"{PROGRAM} {described_version()}")
        ctx.exit()


@click.group(
    name=PROGRAM,
    cls=LazyGroup,
    params=list(shared_options()),
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.option(
    "--version", is_flag=True, expose_value=False, is_eager=True, callback=_tell_version, help="Show the version."
)
def cli() -> None:
    """From drone flights to georeferenced 3D Gaussian splats. Every command works on a workspace,
    the folder of a survey's products.

    \b
    Examples:
      georef run flight --images photos
      georef help start
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `georef`: run the command line and exit with its code."""
    sys.excepthook = boundary.safe_traceback
    words = list(sys.argv[1:] if arguments is None else arguments)
    # Scheduler and workers of a cluster are Dask's, and its processes tell on standard error what they do.
    with nullcontext() if words[:1] == ["cluster"] else native_lines_logged():
        code = boundary.guarded(cli, arguments)
    sys.exit(code)
