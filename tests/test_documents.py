"""The documents lead where they say: every relative link is to a file, every anchor to a heading."""

from __future__ import annotations

import pkgutil
import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
DOCUMENTS = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "examples/**/*.md")
    for path in REPOSITORY.glob(pattern)
    if not any(part.startswith(".") for part in path.relative_to(REPOSITORY).parts)
)
LINK = re.compile(r"!?\[[^\]]*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
# `[text][name]` leads to what `[name]: x.md` says at the end of the document.
NAMED_LINK = re.compile(r"\[[^\]]+\]\[([^\]]+)\]")
DEFINITION = re.compile(r"^\[([^\]]+)\]: (\S+)$", re.MULTILINE)
# `docs/x.md` and `tests/…/x.py` named in passing are promises too.
NAMED = re.compile(r"`((?:docs|examples|tests|pipelines|georef_cli)/[\w./-]+\.(?:md|py|toml))`")


def text_of(path: Path) -> str:
    """Without blocks of code."""
    return re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Headings as forges write them into addresses."""
    headings = re.findall(r"^#+\s+(.*)$", text_of(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_links_lead_somewhere(document: Path) -> None:
    defined = dict(DEFINITION.findall(text_of(document)))
    broken = [name for name in NAMED_LINK.findall(text_of(document)) if name not in defined]
    for link in [*LINK.findall(text_of(document)), *defined.values()]:
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = document.parent / name if name else document
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    broken += [name for name in NAMED.findall(text_of(document)) if not (REPOSITORY / name).exists()]
    assert broken == []


def test_there_are_documents_with_links() -> None:
    assert {"README.md", "CONTRIBUTING.md", "inputs.md"} <= {path.name for path in DOCUMENTS}
    assert sum(len(LINK.findall(text_of(path))) for path in DOCUMENTS) > 10


def test_code_named_by_the_conventions_exists() -> None:
    """The table from the paper to the code names modules, and what stands in them."""
    text = (REPOSITORY / "docs/conventions.md").read_text(encoding="utf-8")
    rooms = "|".join(path.parent.name for path in (REPOSITORY / "pipelines").glob("*/__init__.py"))
    names = sorted(set(re.findall(rf"`((?:{rooms})\.[\w.]+)`", text)))
    assert len(names) > 20
    for name in names:
        pkgutil.resolve_name(f"pipelines.{name}")


def test_functions_on_the_walks_through_the_house_exist() -> None:
    """Each of the four walks has five steps, which name functions as `room/file.function`."""
    text = (REPOSITORY / "docs/architecture.md").read_text(encoding="utf-8")
    walks = text.partition("## Four walks")[2].partition("\n## ")[0]
    assert re.findall(r"^(\d)\. ", walks, re.MULTILINE) == 4 * list("12345")
    names = re.findall(r"`([a-z_/]+/\w+\.[\w.]+)`", walks)
    named = [name for name in names if not name.endswith((".ply", ".json", ".html"))]
    assert len(named) >= 20
    for name in named:
        pkgutil.resolve_name(f"pipelines.{name.replace('/', '.')}")


def test_no_time_is_stated_for_a_gpu() -> None:
    """Nothing was timed on one: no cell of a table whose head or row names a GPU is a duration."""
    stated = []
    for document in DOCUMENTS:
        heads: list[str] = []
        for line in text_of(document).splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
            heads = (heads or cells) if cells else []
            stated += [
                f"{document.name}: {line}"
                for head, cell in zip(heads, cells, strict=False)
                if ("GPU" in head or "GPU" in cells[0]) and re.fullmatch(r"[\d.]+ (s|min|h)", cell)
            ]
    assert stated == []
