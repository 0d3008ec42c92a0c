"""Command `georef help`."""

from __future__ import annotations

import click

from georef_cli import options
from georef_cli.command import Command
from georef_cli.output import print_json
from georef_cli.topics import TOPICS, topic_text


class TopicType(click.ParamType[str]):
    """Type of an argument that names a topic or a command."""

    name = "topic"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if value not in _names(ctx):
            self.fail(f"{value!r} is no topic and no command. The topics are {', '.join(TOPICS)}.", param, ctx)
        return str(value)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[click.shell_completion.CompletionItem]:
        return [click.shell_completion.CompletionItem(n) for n in _names(ctx) if n.startswith(incomplete)]


def _names(ctx: click.Context | None) -> list[str]:
    group = None if ctx is None or ctx.parent is None else ctx.parent.command
    commands = group.list_commands(ctx) if isinstance(group, click.Group) and ctx is not None else []
    return [*TOPICS, *commands]


def _help(ctx: click.Context, topic: str | None, as_json: bool) -> None:
    if topic is None:
        width = max(map(len, TOPICS))
        rows = [f"  {name:{width}}  {title}" for name, title in TOPICS.items()]
        text = "\n".join(["Topics of `georef help TOPIC`:", *rows, "", "`georef help COMMAND` explains a command."])
    elif topic in TOPICS:
        text = topic_text(topic)
    else:
        assert ctx.parent is not None and isinstance(ctx.parent.command, click.Group)
        explained = ctx.parent.command.get_command(ctx.parent, topic)
        assert explained is not None
        text = explained.get_help(click.Context(explained, info_name=topic, parent=ctx.parent))
    if as_json:
        print_json({"topic": topic, "text": text})
    else:
        click.echo(text.rstrip("\n"))


command = Command(
    "help",
    params=[click.Argument(["topic"], required=False, type=TopicType(), metavar="[TOPIC]"), options.JSON],
    callback=click.pass_context(_help),
    help="""
    Without a topic: the list of the topics.

    \b
    Examples:
      georef help
      georef help heights
      georef help train
    """,
)
