"""Make a release: `make release VERSION=0.2.0`, or `python .ci/release.py 0.2.0`.

1. The version must be higher than the last release, the working tree clean, and CHANGELOG.md must tell of changes.
2. The version is written into pipelines/__init__.py (its only source), CITATION.cff, CHANGELOG.md and the VERSION
   of the engine of WebODM.
3. `.ci/run` checks that state. If it fails, the files are put back.
4. The state is committed and tagged.
5. `.ci/run packages` builds the packages of the tag into dist/ and tries the wheel. If it fails, commit and tag are
   taken back. Nothing is pushed.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VERSION = re.compile(r"\d+\.\d+\.\d+")
SOURCE, CITATION, CHANGELOG = "pipelines/__init__.py", "CITATION.cff", "CHANGELOG.md"
ENGINE = "examples/webodm/VERSION"
UNRELEASED = "## Unreleased\n"


def git(*arguments: str) -> str:
    """Return what a git command prints."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def edited(name: str, pattern: str, text: str) -> str:
    """Return the content of a file with the one line that matches `pattern` replaced."""
    content, count = re.subn(pattern, text, (ROOT / name).read_text(encoding="utf-8"), flags=re.MULTILINE)
    if count != 1:
        raise SystemExit(f"{name}: {count} lines match {pattern!r}; one is wanted")
    return content


def released(version: str, day: date) -> dict[str, str]:
    """Return the content of the files that a release changes, by name."""
    citation = f"version: {version}\ndate-released: {day.isoformat()}\n"
    return {
        SOURCE: edited(SOURCE, r'^__version__ = ".+"$', f'__version__ = "{version}"'),
        CITATION: edited(CITATION, r"^version: .+\n(?:date-released: .+\n)?", citation),
        ENGINE: f"{version}\n",
        CHANGELOG: edited(CHANGELOG, rf"^{UNRELEASED}", f"## {version} ({day.isoformat()})\n"),
    }


def why_not(version: str) -> str | None:
    """Return what stands in the way of a release, or None."""
    if not VERSION.fullmatch(version):
        return f"{version} is not a version such as 0.2.0"
    tags = [tag.removeprefix("v") for tag in git("tag", "--list", "v*").split()]
    releases = sorted((tag for tag in tags if VERSION.fullmatch(tag)), key=_numbers)
    if releases and _numbers(version) <= _numbers(releases[-1]):
        return f"{version} is not higher than the last release, {releases[-1]}"
    if git("status", "--porcelain"):
        return "the working tree is not clean: commit or stash first"
    changes = (ROOT / CHANGELOG).read_text(encoding="utf-8").partition(UNRELEASED)[2].partition("\n## ")[0]
    if not changes.strip():
        return f"{CHANGELOG} has nothing under {UNRELEASED.strip()!r}"
    return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))


def write(files: dict[str, str]) -> None:
    """Write files of the repository."""
    for name, content in files.items():
        (ROOT / name).write_text(content, encoding="utf-8", newline="\n")


def check_with(check: Callable[[], None], files: dict[str, str]) -> None:
    """Put new files in place and check them; whatever ends the check puts the old ones back."""
    before = {name: (ROOT / name).read_text(encoding="utf-8") for name in files}
    write(files)
    try:
        check()
    except BaseException:
        write(before)
        raise


def run_checks(*steps: str) -> None:
    """Run `.ci/run`, or some of its steps.

    Raises:
        SystemExit: a check failed.
    """
    # Without its path, Windows would take the bash of its Linux subsystem.
    bash = shutil.which("bash") or "bash"
    if subprocess.run([bash, ".ci/run", *steps], cwd=ROOT, check=False).returncode:
        raise SystemExit("the checks failed: nothing was released")


def tag_and_pack(version: str) -> None:
    """Tag the commit of a release and build its packages; whatever ends that takes tag and commit back."""
    git("tag", "--annotate", f"v{version}", "--message", f"GeoRefGS {version}")
    try:
        run_checks("packages")
    except BaseException:
        git("tag", "--delete", f"v{version}")
        git("reset", "--hard", "HEAD^")
        raise


def main() -> None:
    """Make the release that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("version", help="such as 0.2.0")
    version: str = parser.parse_args().version
    if reason := why_not(version):
        raise SystemExit(reason)
    files = released(version, date.today())
    check_with(run_checks, files)
    git("add", *files)
    git("commit", "--message", f"Release {version}")
    tag_and_pack(version)
    published = "`git push --follow-tags`, and publish dist/"
    sys.stdout.write(f"released {version}: look at it, then {published}\n")


if __name__ == "__main__":
    main()
