"""The steps of Containerfile, run without a container, with its folders in a temporary one."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.core.version import described_version
from tests.environments import make_environment, site_packages, without_python

REPOSITORY = Path(__file__).parents[1]
FILES = ("Containerfile", "Containerfile.cuda")
PATIENCE_S = 300.0
# Programs that would change this machine; everything else is run.
LEFT_OUT = ("apt-get", "chown", "useradd")


def instructions(name: str) -> list[tuple[str, str]]:
    """Instructions of a container file, with their arguments."""
    lines = [line for line in (REPOSITORY / name).read_text(encoding="utf-8").splitlines() if line[:1] != "#"]
    whole = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in whole.splitlines() if line]


def tracked_files() -> list[str]:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, check=True, capture_output=True, text=True)
    return [path for path in listed.stdout.split("\0") if path]


@pytest.mark.parametrize("name", FILES)
def test_user_is_not_root_and_health_is_told(name: str) -> None:
    found = instructions(name)
    (user,) = (arguments for word, arguments in found if word == "USER")
    assert user.isdecimal() and int(user) > 0
    words = [word for word, _ in found]
    assert words.index("USER") > max(index for index, (_, text) in enumerate(found) if "pip install" in text)
    assert ("VOLUME", "/work") in found and ("WORKDIR", "/work") in found
    assert ("HEALTHCHECK", 'CMD ["georef", "doctor"]') in found and ("ENTRYPOINT", '["georef"]') in found


@pytest.mark.parametrize("name", FILES)
def test_nothing_that_git_keeps_is_left_out_of_the_copy(name: str) -> None:
    """The version tells of a changed checkout otherwise, and a package may lack files."""
    tops = {path.partition("/")[0] for path in tracked_files()}
    left_out = set((REPOSITORY / ".dockerignore").read_text(encoding="utf-8").split())
    assert not tops & left_out
    assert ("COPY", ". .") in instructions(name)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="the steps are for a shell of Linux")
def test_steps_lead_to_a_program(tmp_path: Path) -> None:
    """Libraries are those of this environment, in place of an index: pip finds what the steps ask for installed."""
    steps = instructions("Containerfile")
    root, programs = tmp_path / "root", make_environment(tmp_path / "venv")
    for name, does in {**dict.fromkeys(LEFT_OUT, ""), "pip": 'exec python -m pip "$@"'}.items():
        (programs / name).write_text(f"#!/bin/sh\n{does}\n", encoding="utf-8")
        (programs / name).chmod(0o755)
    variables = without_python() | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PIP_NO_INDEX": "1",
        "PIP_NO_DEPS": "1",
    }
    folder = root
    folder.mkdir()

    def placed(text: str) -> str:
        """The arguments, with the folders of the image below `root`."""
        return re.sub(r"(?<![\w./:])/(?=(?:source|packages|cache|work|var)\b)", f"{root}/", text)

    for word, arguments in steps:
        words = placed(arguments).split()
        if word == "WORKDIR":
            folder = Path(words[0])
            folder.mkdir(parents=True, exist_ok=True)
        elif word == "ENV":
            variables |= dict(pair.split("=", 1) for pair in words)
        elif word == "COPY" and arguments == ". .":
            for path in tracked_files():
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(REPOSITORY / path, folder / path)
        elif word == "COPY" and words[0] != "--from=package":  # from one stage to the next nothing moves here
            shutil.copy(REPOSITORY / words[0], words[1])
        elif word == "RUN":
            done = subprocess.run(
                ["sh", "-c", placed(arguments)], cwd=folder, env=variables, check=False, capture_output=True,
                text=True, timeout=PATIENCE_S,
            )  # fmt: skip
            assert done.returncode == 0, f"{arguments}: {done.stdout[-1000:]}{done.stderr[-3000:]}"
    assert "backend cpu" in done.stdout  # of the last step, `georef doctor`
    program = programs / "georef"  # as pip wrote it
    told = subprocess.run(
        [program, "--version"], cwd=folder, env=variables, check=True, capture_output=True, text=True
    )
    assert told.stdout.split()[1] == described_version().split()[0]
    assert (site_packages(tmp_path / "venv") / "pipelines/__init__.py").is_file()
