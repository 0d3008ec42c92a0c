"""Help and documents: every command explains itself, and every example that is printed parses."""

from __future__ import annotations

import contextlib
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.core import ParameterSource

from georef_cli.command import COMMANDS
from georef_cli.main import cli
from tests.cli_runs import Georef

REPOSITORY = Path(__file__).parents[2]
DOCUMENTS = [*REPOSITORY.glob("README.md"), *sorted(REPOSITORY.glob("docs/*.md"))]


def command_of(name: str) -> click.Command:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return command


def examples_in(text: str) -> list[str]:
    """Lines that call georef, with continuation lines joined."""
    joined = re.sub(r"\\\n\s*", " ", text)
    return [line.strip().removeprefix("$ ") for line in joined.splitlines() if re.match(r"\s*(\$ )?georef ", line)]


def unheard(line: str) -> list[str]:
    """Parse a command line as click would, and run nothing; return its options that did not reach the command."""
    words = shlex.split(line.partition(" | ")[0].partition(" > ")[0], comments=True)[1:]
    spans = [(start, start + count) for start in range(len(words)) for count in (2, 1)]
    start, end = next(span for span in spans if " ".join(words[slice(*span)]) in COMMANDS)
    name = " ".join(words[start:end])
    context = cli.make_context("georef", words[:end])
    parsed = command_of(name).make_context(name, words[end:], parent=context)
    heard = {
        option
        for parameter in parsed.command.params
        if parsed.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE
        for option in (*parameter.opts, *parameter.secondary_opts)
    }
    options = [word.partition("=")[0] for word in words[end:] if word.startswith("--")]
    return [option for option in options if option not in heard]


@pytest.mark.parametrize("name", COMMANDS)
def test_command_explains_itself(name: str) -> None:
    command = command_of(name)
    assert command.name == name
    examples = examples_in(command.help or "")
    assert examples
    assert all(f" {name} " in f"{line} " for line in examples)
    for parameter in command.params:
        assert isinstance(parameter, click.Argument) or getattr(parameter, "help", None)
    assert "--json" in [option for parameter in command.params for option in parameter.opts]


@pytest.mark.parametrize("name", COMMANDS)
def test_examples_of_the_help_parse(name: str) -> None:
    for line in examples_in(command_of(name).help or ""):
        assert unheard(line) == [], line


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_examples_of_the_documents_parse(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(?:sh|console|bash|text)?\n(.*?)^```", text, re.M | re.S)
    for line in [example for block in blocks for example in examples_in(block)]:
        with contextlib.suppress(click.exceptions.Exit):  # --help and --version end here
            assert unheard(line) == [], line


def test_commands_document_is_current() -> None:
    made = subprocess.run(
        [sys.executable, REPOSITORY / "docs/make_commands.py", "--print"],
        capture_output=True, text=True, check=True, cwd=REPOSITORY,
    )  # fmt: skip
    written = (REPOSITORY / "docs/commands.md").read_text(encoding="utf-8")
    assert made.stdout == written, "run `python docs/make_commands.py` and commit docs/commands.md"


def test_the_help_of_run_begins_with_what_most_runs_need(real_georef: Georef) -> None:
    """Every option stands in one section, and ten stand in the first."""
    text = real_georef("run", "--help").out
    head, _, rest = text.partition("Most runs need:")
    first, _, others = rest.partition("Which stages:")
    shown = re.findall(r"^  (--[a-z-]+)", first, re.MULTILINE)
    assert "--images" not in head.split("Examples:")[0] and len(shown) == 10
    assert not set(shown) & set(re.findall(r"^  (--[a-z-]+)", others, re.MULTILINE))
    further = text.partition("Further options:")[2].partition("Options of all commands:")[0]
    assert set(re.findall(r"--[a-z-]+", further)) <= {"--help"}  # a new option gets a section


@pytest.mark.parametrize(("typed", "meant"), [("statsu", "status"), ("export-rater", "export-raster")])
def test_a_mistyped_command_gets_a_suggestion(real_georef: Georef, typed: str, meant: str) -> None:
    ended = real_georef(typed, "flight")
    assert ended.code == 2 and f"Did you mean {meant}" in ended.err
