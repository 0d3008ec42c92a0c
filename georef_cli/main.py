"""Group `georef`: a table of commands, each imported when it is called.

A module of `georef_cli.commands` holds a `command`, or a function of that name that returns one of several by name.

`georef --help` reads the table alone, to answer at once. It imports no command module, and therefore neither the
validation library nor any heavier one.
"""

import importlib
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import click

from georef_cli import boundary
from georef_cli.command import Command, merged_verbosity, shared_options
from georef_cli.native_lines import native_lines_logged
from pipelines.core.stages import CHANGE, CLEAN, DELIVERABLES, PIPELINE, SPLAT, StageSpec
from pipelines.core.version import described_version

PROGRAM = "georef"

# Idle threads of OpenMP sleep instead of spinning. Spinning threads take the time of the busy one if another
# program uses a core: on two cores, training was six times slower. OpenMP reads the variable when it is loaded, and
# no import above loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


@dataclass(frozen=True)
class HelpLine:
    """Line of `georef --help` below the heading of its section."""

    section: str
    help: str
    module: str = ""  # of several commands, in `georef_cli.commands`; empty: a module of its own


# Stages whose commands do more than run them, in modules of their own.
_OF_THEIR_OWN = frozenset({"sfm", "calibrate", "evaluate", "export-ply"})


def _of_stages(*stages: StageSpec) -> dict[str, HelpLine]:
    return {
        spec.name: HelpLine(
            "Stages" if spec in PIPELINE and spec.product != SPLAT else "Deliverables",
            spec.title,
            "" if spec.name in _OF_THEIR_OWN else "stages",
        )
        for spec in stages
        if not spec.called
    }


COMMANDS: dict[str, HelpLine] = {
    "simulate": HelpLine("Start", "Simulate a survey whose truth is known exactly."),
    "inspect": HelpLine("Start", "Show what a ROS bag holds, and what ingest would choose."),
    "run": HelpLine("Pipeline", "Run all stages, or some, skipping what is current."),
    "batch": HelpLine("Pipeline", "Run many missions, and put their results into one table."),
    "blocks": HelpLine("Pipeline", "Train a large survey in blocks, and merge them."),
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


class LazyGroup(click.Group):
    """Group whose subcommands are modules of `georef_cli.commands`, imported one at a time."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        found = importlib.import_module(f"georef_cli.commands.{command_module(cmd_name)}").command
        command = found if isinstance(found, Command) else found(cmd_name)
        assert isinstance(command, Command)
        return command

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
    """From drone flights to georeferenced 3D Gaussian splats.

    Every command works on a workspace, the folder of a survey's products.

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
