"""A release, made in a small repository of its own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from datetime import date
from pathlib import Path

import pytest

from tests.scripts import REPOSITORY

FILES = (".ci/release.py", "pipelines/__init__.py", "CITATION.cff", "examples/webodm/VERSION")
CHANGELOG = "# Changelog\n\n## Unreleased\n\n- Something new.\n\n## 0.0.9 (2020-01-01)\n\n- The first.\n"
Release = Callable[[str], subprocess.CompletedProcess[str]]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository with the files that a release changes, and checks that pass."""
    root = tmp_path / "checkout"
    for name in FILES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes((REPOSITORY / name).read_bytes())
    (root / "CHANGELOG.md").write_text(CHANGELOG, encoding="utf-8")
    (root / ".ci/run").write_text("cat pipelines/__init__.py > ../checked\necho $@ >> ../steps\n", encoding="utf-8")
    git(root, "init", "--quiet")
    git(root, "add", ".")
    git(root, "commit", "--quiet", "--message", "All")
    git(root, "tag", "v0.0.9")
    return root


def git(root: Path, *arguments: str) -> str:
    names = {f"GIT_{who}_{key}": "somebody" for who in ("AUTHOR", "COMMITTER") for key in ("NAME", "EMAIL")}
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, env={**os.environ, **names}).stdout


@pytest.fixture
def release(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> Release:
    """The script, as `make release` calls it."""
    for who in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{who}_NAME", "somebody")
        monkeypatch.setenv(f"GIT_{who}_EMAIL", "somebody")

    def call(version: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, ".ci/release.py", version]
        return subprocess.run(command, cwd=checkout, check=False, capture_output=True, text=True)

    return call


def test_release_is_checked_written_committed_and_tagged(checkout: Path, release: Release) -> None:
    today = date.today().isoformat()
    done = release("0.2.0")
    assert done.returncode == 0, done.stderr
    assert (checkout / "pipelines/__init__.py").read_text(encoding="utf-8").endswith('\n__version__ = "0.2.0"\n')
    assert f"\nversion: 0.2.0\ndate-released: {today}\n" in (checkout / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (checkout / "CHANGELOG.md").read_text(encoding="utf-8")
    assert changelog == CHANGELOG.replace("## Unreleased", f"## 0.2.0 ({today})")
    assert git(checkout, "log", "-1", "--format=%s", "v0.2.0") == "Release 0.2.0\n"
    assert (
        git(checkout, "cat-file", "-t", "v0.2.0") == "tag\n"
    )  # annotated: `git push --follow-tags` takes it along
    assert git(checkout, "status", "--porcelain") == ""
    # The checks saw what was tagged, and the packages were built.
    assert (checkout.parent / "steps").read_text(encoding="utf-8") == "\npackages\n"
    assert '"0.2.0"' in (checkout.parent / "checked").read_text(encoding="utf-8")


def test_next_release_replaces_version_and_date(checkout: Path, release: Release) -> None:
    assert release("0.2.0").returncode == 0
    (checkout / "CHANGELOG.md").write_text(CHANGELOG, encoding="utf-8")
    git(checkout, "commit", "--quiet", "--all", "--message", "More")
    assert release("0.10.0").returncode == 0
    citation = (checkout / "CITATION.cff").read_text(encoding="utf-8")
    assert citation.count("\nversion: ") == citation.count("\ndate-released: ") == 1


def test_failing_checks_leave_everything_as_it_was(checkout: Path, release: Release) -> None:
    (checkout / ".ci/run").write_text("exit 1\n", encoding="utf-8")
    git(checkout, "commit", "--quiet", "--all", "--message", "Fail")
    done = release("0.2.0")
    assert done.returncode != 0
    assert "nothing was released" in done.stderr
    assert git(checkout, "status", "--porcelain") == ""
    assert git(checkout, "tag") == "v0.0.9\n"


def test_a_package_that_fails_takes_the_release_back(checkout: Path, release: Release) -> None:
    (checkout / ".ci/run").write_text('test "$1" != packages\n', encoding="utf-8")
    git(checkout, "commit", "--quiet", "--all", "--message", "Fail")
    before = git(checkout, "rev-parse", "HEAD")
    done = release("0.2.0")
    assert done.returncode != 0
    assert "nothing was released" in done.stderr
    assert (git(checkout, "rev-parse", "HEAD"), git(checkout, "tag")) == (before, "v0.0.9\n")
    assert git(checkout, "status", "--porcelain") == ""


@pytest.mark.parametrize(
    ("version", "reason"),
    [("0.2", "is not a version"), ("v0.2.0", "is not a version"), ("0.0.9", "is not higher than the last release")],
)
def test_unfit_version_is_refused(version: str, reason: str, checkout: Path, release: Release) -> None:
    done = release(version)
    assert done.returncode != 0
    assert reason in done.stderr
    assert not (checkout.parent / "checked").exists()


def test_unclean_tree_is_refused(checkout: Path, release: Release) -> None:
    (checkout / "new").touch()
    assert "not clean" in release("0.2.0").stderr


def test_release_without_changes_is_refused(checkout: Path, release: Release) -> None:
    (checkout / "CHANGELOG.md").write_text(CHANGELOG.replace("- Something new.\n", ""), encoding="utf-8")
    git(checkout, "commit", "--quiet", "--all", "--message", "Nothing")
    assert "has nothing under" in release("0.2.0").stderr
