"""What a user asks of the program itself: the machine, topics of help, completion in the shell."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.shell_completion import BashComplete

from georef_cli.command import COMMANDS
from georef_cli.main import PROGRAM, cli
from georef_cli.topics import TOPICS, topic_text
from pipelines.core.errors import BackendUnavailableError
from pipelines.core.extras import Part
from pipelines.core.fingerprints import NOT_INSTALLED
from pipelines.core.machine import available_cores
from pipelines.jobs import machine
from pipelines.train.options import PRESETS
from tests.cli.test_help import examples_in, unheard
from tests.cli_runs import REPOSITORY, Georef


def test_doctor_tells_what_there_is_and_why_not(real_georef: Georef, monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen_backend(name: str) -> str:
        if name == "cuda":
            raise BackendUnavailableError("no-gpu-give-backend", "no GPU: give --backend cpu")
        return name

    monkeypatch.setattr(machine, "chosen_backend", chosen_backend)
    parts = Part("NVIDIA driver", None, "install it"), Part("C++ compiler", "g++ 12", "")
    monkeypatch.setattr(machine, "running_parts", lambda: parts[:1])
    monkeypatch.setattr(machine, "compiling_parts", lambda: parts[1:])
    monkeypatch.setattr(machine, "kernels_ready", lambda: None)
    monkeypatch.setenv("CHROMIUM", "/opt/chromium")
    offered = real_georef("doctor", "--json").document
    assert offered["cores"] == available_cores()
    assert offered["memory_bytes"] > offered["free_bytes"] > 0
    assert offered["backends"] == [
        {"name": "cpu", "available": True, "reason": ""},
        {"name": "cuda", "available": False, "reason": "no GPU: give --backend cpu"},
    ]
    assert offered["cuda_parts"] == [
        {"name": "NVIDIA driver", "found": None, "remedy": "install it"},
        {"name": "C++ compiler", "found": "g++ 12", "remedy": ""},
    ]
    assert offered["cuda_kernels"] is None
    assert offered["chromium"] == "/opt/chromium"
    assert offered["versions"]["numpy"] != NOT_INSTALLED
    text = real_georef("doctor").out
    words = " ".join(text.split())
    assert "backend cuda no: no GPU that torch sees; it needs one, and all below NVIDIA driver" in words
    assert "NVIDIA driver missing: install it C++ compiler g++ 12 kernels not compiled yet" in words
    assert "/opt/chromium" in text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("option", [("--backend", "cuda"), ("--set", "evaluate.backend=cuda")])
def test_run_refuses_cuda_before_its_first_stage(
    real_georef: Georef, tmp_path: Path, option: tuple[str, str]
) -> None:
    (tmp_path / "photos").mkdir()
    result = real_georef("run", tmp_path / "ws", "--images", tmp_path / "photos", *option)
    result.assert_failed(1, "cuda-unavailable")
    assert not (tmp_path / "ws").exists()
    assert real_georef("run", tmp_path / "ws", "--images", tmp_path / "photos").error["code"] != "cuda-unavailable"


@pytest.mark.parametrize("topic", TOPICS)
def test_topic_fits_a_terminal_and_its_commands_parse(topic: str) -> None:
    text = topic_text(topic)
    assert max(map(len, text.splitlines())) <= 80
    for line in examples_in(text):
        assert unheard(re.split(r"\s{3,}", line)[0]) == [], line


def test_help_names_every_command_on_one_screen(real_georef: Georef) -> None:
    lines = real_georef("--help").out.splitlines()
    assert len(lines) <= 58 and max(map(len, lines)) <= 80
    named = {line.split()[0] for line in lines if line.startswith("  ")}
    assert {name.partition(" ")[0] for name in COMMANDS} <= named
    told = " ".join(lines)
    assert all(name.partition(" ")[2] in told for name in COMMANDS)


def test_help_lists_topics_and_explains_commands(real_georef: Georef) -> None:
    listing = real_georef("help").out
    assert all(f"  {name} " in listing for name in TOPICS)
    assert real_georef("help", "train").out == real_georef("train", "--help").out
    presets = real_georef("help", "presets", "--json").document["text"]
    assert all(str(preset.iterations) in presets for preset in PRESETS.values())
    result = real_georef("help", "hights", "--json")
    result.assert_failed(2)
    assert "'hights' is no topic and no command" in result.err


def test_presets_are_explained_where_they_are_chosen(real_georef: Georef) -> None:
    for command in ("train", "run", "compare"):
        text = " ".join(real_georef(command, "--help").out.split())
        assert "fast: 800 iterations, 480 px, 80000 Gaussians, about 2 min" in text, command


@pytest.mark.parametrize(
    ("words", "last", "expected"),
    [
        ([], "exp", {"export-ply", "export-raster", "export-cloud"}),
        (["run", "flight"], "--pre", {"--preset"}),
        (["run", "flight", "--preset"], "s", {"smoke", "standard"}),
        (["help"], "he", {"heights"}),
        (["status", "flight"], "--thr", {"--threads"}),
    ],
)
def test_shell_completes(words: list[str], last: str, expected: set[str]) -> None:
    completion = BashComplete(cli, {}, PROGRAM, "_GEOREF_COMPLETE")
    assert expected <= {item.value for item in completion.get_completions(words, last)}


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({"_GEOREF_COMPLETE": "zsh_source"}, "#compdef georef"),
        ({"_GEOREF_COMPLETE": "fish_source"}, "complete --no-files --command georef"),
        ({"_GEOREF_COMPLETE": "bash_source"}, "complete -o nosort -F _georef_completion georef"),
        ({"_GEOREF_COMPLETE": "bash_complete", "COMP_WORDS": "georef stat", "COMP_CWORD": "1"}, "plain,status"),
    ],
)
def test_program_answers_the_shell(variables: dict[str, str], told: str) -> None:
    """As the lines of `georef help completion` ask."""
    done = subprocess.run(
        [sys.executable, "-c", "from georef_cli.main import main; main()"],
        capture_output=True, text=True, check=True, env={**os.environ, **variables, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert told in done.stdout
