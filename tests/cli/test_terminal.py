"""What reaches the terminal: bytes of stdout and stderr of real processes, with names and texts that attack it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.core.sentences import printable, printable_lines
from tests.cli_runs import REPOSITORY, WITH_FAKES, Georef

ATTACK = "\x1b[31m\x1b]0;title\x07\x9b2J\u202egpj\u2066\r\nerror: forged"
UNSAFE = (b"\x1b", b"\x07", "\x9b".encode(), "\u202e".encode(), "\u2066".encode(), b"\r")
ATTACKING = f"""
import logging
from tests import fakes
from pipelines.core.errors import InputError
from pipelines.core.products import Remark
from pipelines.core.workspace import Summary
attack = {ATTACK!r}
def ingest(stage, options):
    logging.getLogger("pipelines.ingest").warning("camera %s", attack)
    if options.test_every == 7:
        raise InputError("image-missing", "no such image", path=f"photos/{{attack}}.jpg")
    if options.test_every == 9:
        raise ZeroDivisionError(attack)
    fakes.write_products(stage, fakes.STAGES[0], "text")
    return Summary(f"camera {{attack}}", {{attack: attack}}, (Remark(code="attack", sentence=attack),))
fakes.install(ingest=ingest)
from georef_cli.main import main
main()
"""


def run(*arguments: object, code: str = ATTACKING) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", code, *(os.fsencode(str(argument)) for argument in arguments)]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(command, check=False, capture_output=True, env=environment, timeout=60)


def assert_safe(output: bytes) -> None:
    assert not [sign for sign in UNSAFE if sign in output], output
    assert b"Traceback" in output or b"\nerror: forged" not in output
    output.decode("utf-8")


@pytest.mark.slow
def test_texts_of_others_never_steer_the_terminal(tmp_path: Path, photos: Path) -> None:
    workspace = tmp_path / "flight"
    for arguments in (
        ("ingest", workspace, "--images", photos),
        ("ingest", workspace, "--images", photos),  # warnings repeated from the manifest
        ("ingest", workspace, "--images", photos, "--test-every", 7),
        ("status", workspace),  # the message of the failure
        ("status", workspace, "--json"),
        ("--traceback", "ingest", workspace, "--images", photos, "--test-every", 7),
        ("status", f"{workspace}{ATTACK}"),
        ("status", workspace, f"--{ATTACK}"),
    ):
        result = run(*arguments)
        assert_safe(result.stdout)
        assert_safe(result.stderr)
        assert b"\\x1b[31m" in result.stdout + result.stderr or b"\\u001b[31m" in result.stdout, arguments
    defect = run("ingest", workspace, "--images", photos, "--test-every", 9)
    assert_safe(defect.stderr)
    assert b"ZeroDivisionError: \\x1b[31m" in defect.stderr
    assert_safe((workspace / "logs/ingest.log").read_bytes())


@pytest.mark.parametrize(
    ("text", "safe"),
    [
        ("IMG_0001.JPG σ ≥ 1 😀 é", "IMG_0001.JPG σ ≥ 1 😀 é"),
        ("a\nb\tc", "a\\nb\\tc"),
        ("\x1b]0;x\x07", "\\x1b]0;x\\x07"),
        ("\x9b2J\x85\u2028", "\\x9b2J\\x85\\u2028"),
        ("\u202ea\u2066b\u200f", "\\u202ea\\u2066b\\u200f"),
        (os.fsdecode(b"\xff.jpg") if sys.platform != "win32" else "\udcff.jpg", "\\xff.jpg"),
        ("क्\u200dष", "क्\u200dष"),  # a joiner belongs to the word
    ],
)
def test_printable(text: str, safe: str) -> None:
    assert printable(text) == safe
    assert printable_lines("a\nb\x1b") == "a\nb\\x1b"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems refuse such names themselves")
@pytest.mark.parametrize("command", ["ingest", "run", "status"])
@pytest.mark.parametrize(
    "name", [os.fsdecode(b"caf\xe9"), "a" * 300, "file/ws"], ids=["not UTF-8", "too long", "in a file"]
)
def test_workspace_that_cannot_be(tmp_path: Path, photos: Path, georef: Georef, command: str, name: str) -> None:
    (tmp_path / "file").write_text("")
    images = () if command == "status" else ("--images", photos)
    result = georef(command, tmp_path / name, *images)
    assert result.code == 1, result.err
    result.err.encode("utf-8")
    lines = result.err.splitlines()
    assert [line.startswith("error: ") for line in lines] == [True], lines
    assert result.out == ""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems refuse such names themselves")
def test_folder_of_photographs_whose_name_is_not_utf8(tmp_path: Path, photos: Path) -> None:
    odd = tmp_path / os.fsdecode(b"caf\xe9")
    photos.rename(odd)
    result = run("ingest", tmp_path / "flight", "--images", odd, code=WITH_FAKES)
    assert result.returncode == 1
    assert result.stderr.endswith(b"caf\\xe9 [--images]: has a name that is not UTF-8 text. Rename it.\n"), (
        result.stderr
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")
def test_output_on_a_full_disk(tmp_path: Path, photos: Path) -> None:
    """Neither the log, nor stderr, nor stdout bring forth a traceback or a `Logging error`."""
    workspace = tmp_path / "flight"
    (workspace / "logs").mkdir(parents=True)
    (workspace / "logs/ingest.log").symlink_to("/dev/full")
    result = run("ingest", workspace, "--images", photos)
    assert result.returncode == 0
    assert b"Logging error" not in result.stderr
    assert b"Traceback" not in result.stderr
    full = subprocess.run(
        ["bash", "-c", '"$@" > /dev/full', "_", sys.executable, "-c", WITH_FAKES, "status", str(workspace)],
        check=False,
        capture_output=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )
    assert (full.returncode, full.stderr) == (1, b"error: workspace or output: the disk is full.\n")
