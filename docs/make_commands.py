"""Write docs/commands.md from the commands themselves: `python docs/make_commands.py [--print]`."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

import click

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from georef_cli.command import COMMANDS, Command, shared_options  # noqa: E402
from georef_cli.main import cli  # noqa: E402
from georef_cli.topics import TOPICS, topic_text  # noqa: E402

INTRODUCTION = """# Commands

Made by `python docs/make_commands.py` from the help of commands and [topics](#topics); a test compares them.

Results go to stdout, everything else to stderr and to `logs/<stage>.log` in the workspace;
[For scripts](#for-scripts) has exit codes and the form of a failure with `--json`. Its `kind` is one of `usage`,
`input`, `missing-product`, `busy`, `geometry`, `inconsistent`, `convergence`, `resources`, `backend`, `storage`,
`crash`, `cluster`, `interrupted`, `failed`, or `defect` for an exception that nobody foresaw; its `code` names the
failure itself. Keys without a value are null.

Every command takes these options, before or after its name:

SHARED
"""
TOPICS_HEAD = """## Topics

The texts of `georef help TOPIC`.
"""


def describe(name: str) -> str:
    """The section of one command: text, options, examples."""
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    text, _, examples = (command.help or "").partition("\b\nExamples:\n")
    arguments = " ".join(param.make_metavar(click.Context(command)) for param in _of(command, click.Argument))
    assert isinstance(command, Command)
    rows = [_row(option) for option in command.own_params if isinstance(option, click.Option) and not option.hidden]
    calls = "\n".join(line.strip() for line in examples.strip().splitlines())
    return "\n".join(
        [
            f"## georef {name}\n",
            f"`{' '.join(filter(None, ('georef', name, arguments)))} [OPTIONS]`\n",
            _escape(text.strip()) + "\n",
            "| option | meaning |\n|---|---|",
            *rows,
            f"\n```sh\n{calls}\n```\n",
        ]
    )


def explain(topic: str) -> str:
    """The section of one topic of `georef help`: its text as the terminal shows it."""
    title, _, text = topic_text(topic).strip().partition("\n")
    return f"### {title}\n\n" + textwrap.indent(text.strip("\n"), "    ") + "\n"


def _row(option: click.Option) -> str:
    return f"| `{_spelling(option)}` | {_escape(option.help or '')} |"


def _of(command: click.Command, kind: type) -> list[Any]:
    return [param for param in command.params if isinstance(param, kind)]


def _spelling(option: click.Option) -> str:
    names = ", ".join(option.opts)
    if option.secondary_opts:
        return f"{names} / {', '.join(option.secondary_opts)}"
    if option.is_flag:
        return names
    choices = getattr(option.type, "choices", None)
    value = f"{{{', '.join(choices)}}}" if choices else option.metavar or option.type.name.upper()
    return f"{names} {value}"


def _escape(text: str) -> str:
    return text.replace("<", "\\<").replace("*", "\\*")


def main() -> None:
    """Write the document, or print it."""
    shared = "\n".join(["| option | meaning |\n|---|---|", *(_row(option) for option in shared_options())])
    sections = [*(describe(name) for name in COMMANDS), TOPICS_HEAD, *map(explain, TOPICS)]
    document = "\n".join([INTRODUCTION.replace("SHARED", shared), *sections]).rstrip() + "\n"
    if "--print" in sys.argv:
        sys.stdout.write(document)
    else:
        (ROOT / "docs/commands.md").write_text(document, encoding="utf-8")


if __name__ == "__main__":
    main()
