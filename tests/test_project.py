"""The files around the code agree with it: version, hosted checks, forms, API pages, types for users."""

from __future__ import annotations

import re
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from ruamel.yaml import YAML

import pipelines
from pipelines.core.extras import CORE_MB, EXTRAS, SIZES_MB
from pipelines.core.version import described_commit
from tests.cli_runs import finish, start

REPOSITORY = Path(__file__).parents[1]
FORMS = sorted((REPOSITORY / ".github/ISSUE_TEMPLATE").glob("*.yml"))


def load_yaml(path: Path) -> Any:
    return YAML(typ="safe").load(path.read_text(encoding="utf-8"))


def project() -> dict[str, Any]:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))


class TestVersion:
    def test_package_is_built_with_it(self) -> None:
        assert project()["project"]["dynamic"] == ["version"]
        assert project()["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "pipelines.__version__"}
        assert re.fullmatch(r"\d+\.\d+\.\d+", pipelines.__version__)

    def test_command_line_tells_it(self) -> None:
        commit = described_commit(REPOSITORY)
        assert commit is None or re.search(r"\b[0-9a-f]{7,}|^v\d", commit)
        about = pipelines.__version__ if commit is None else f"{pipelines.__version__} ({commit})"
        assert finish(start("--version")).out == f"georef {about}\n"

    def test_citation_has_it(self) -> None:
        assert str(load_yaml(REPOSITORY / "CITATION.cff")["version"]) == pipelines.__version__

    def test_changelog_is_at_it(self) -> None:
        """Above the version's own part there is nothing but changes that are not released."""
        headings = re.findall(r"^## (\S+)", (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
        assert headings[0] == "Unreleased" or headings[0] == pipelines.__version__


def test_citation_names_the_paper() -> None:
    """The keys that the format's schema 1.2.0 asks for, and the paper."""
    citation = load_yaml(REPOSITORY / "CITATION.cff")
    assert str(citation["cff-version"]) == "1.2.0"
    assert all(citation[key] for key in ("message", "title", "authors"))
    (paper,) = citation["references"]
    assert all(paper[key] for key in ("type", "title", "authors"))
    assert paper["doi"] == "10.3390/drones10030195"


class TestHostedChecks:
    def job(self) -> Any:
        (job,) = load_yaml(REPOSITORY / ".github/workflows/ci.yml")["jobs"].values()
        return job

    def test_run_what_every_change_must_pass(self) -> None:
        runs = [step for step in self.job()["steps"] if "run" in step]
        assert [(step["run"], step["shell"]) for step in runs] == [(".ci/run", "bash")]

    def test_cover_every_python_and_system_that_the_package_claims(self) -> None:
        """The package claims what was run; the hosted checks ask for more."""
        matrix, about = self.job()["strategy"]["matrix"], project()["project"]
        claims = "\n".join(about["classifiers"])
        pythons = re.findall(r"Python :: (3\.\d+)$", claims, re.MULTILINE)
        assert pythons == matrix["python"][: len(pythons)]
        assert about["requires-python"] == f">={pythons[0]}"
        systems = {"ubuntu-latest": "Linux", "macos-latest": "MacOS", "windows-latest": "Windows"}
        claimed = set(re.findall(r"System ::.* (\w+)$", claims, re.M))
        assert "Linux" in claimed
        assert claimed <= {systems[name] for name in matrix["system"]}


def test_extras_are_those_that_the_errors_name() -> None:
    """Each library of an error is installed by the extra that the error names, and all by `all`."""
    installed = {
        extra: {re.split(r"[^\w-]", wanted)[0] for wanted in libraries}
        for extra, libraries in project()["project"]["optional-dependencies"].items()
    }
    for extra, (_, libraries) in EXTRAS.items():
        assert set(libraries) <= installed[extra]
    assert project()["project"]["optional-dependencies"]["all"] == [f"georefgs[{','.join(EXTRAS)}]"]


def test_sizes_are_about_what_is_installed() -> None:
    """What an extra adds are its libraries, and theirs that an installation without extras lacks."""
    wanted = project()["project"]
    core = closure(wanted["dependencies"])
    # The lists give no size of compiled Python, which may be as much again; another version may be a third larger.
    assert 0.7 * megabytes(core) < CORE_MB < 2.0 * megabytes(core)
    for extra in EXTRAS:
        added = megabytes(closure(wanted["optional-dependencies"][extra]) - core)
        assert 0.7 * added - 1 < SIZES_MB[extra] < 2.5 * added + 2, extra


def closure(requirements: list[str]) -> set[str]:
    """The installed distributions that requirements bring, directly or not."""
    found: set[str] = set()
    waiting = [(Requirement(line), frozenset({""})) for line in requirements]
    while waiting:
        wanted, extras = waiting.pop()
        name = re.sub("[-_.]+", "-", wanted.name).lower()
        if wanted.marker is not None and not any(wanted.marker.evaluate({"extra": extra}) for extra in extras):
            continue
        if name not in found or wanted.extras:
            found.add(name)
            inner = frozenset(wanted.extras) | {""}
            waiting += [(Requirement(line), inner) for line in metadata.requires(name) or []]
    return found


def megabytes(distributions: set[str]) -> float:
    """Size by the lists that the distributions bring."""
    return sum(file.size or 0 for name in distributions for file in metadata.files(name) or []) / 1e6


@pytest.mark.parametrize("path", [path for path in FORMS if path.name != "config.yml"], ids=lambda path: path.stem)
def test_form_of_an_issue_is_complete(path: Path) -> None:
    form = load_yaml(path)
    assert form["name"] and form["description"]
    fields = [part for part in form["body"] if part["type"] != "markdown"]
    names = [part["id"] for part in fields]
    assert len(names) == len(set(names))
    assert all(part["attributes"]["label"] for part in fields)


def test_every_room_has_its_api_page() -> None:
    rooms = {path.parent.name for path in (REPOSITORY / "pipelines").glob("*/__init__.py")}
    pages = {path.stem: path.read_text(encoding="utf-8") for path in (REPOSITORY / "docs/api").glob("*.md")}
    overview = pages.pop("index")
    assert set(pages) == rooms
    for room, text in pages.items():
        assert f"::: pipelines.{room}\n" in text
        assert f"({room}.md)" in overview
        assert f"api/{room}.md" in (REPOSITORY / "mkdocs.yml").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", ["georef_cli", "pipelines"])
def test_types_are_delivered(package: str) -> None:
    assert (REPOSITORY / package / "py.typed").is_file()
    assert "py.typed" in project()["tool"]["setuptools"]["package-data"][package]
