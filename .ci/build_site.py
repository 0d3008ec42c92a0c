"""Build the documentation into site/, strictly: `python .ci/build_site.py`.

Zensical refuses links of the documents that lead nowhere. This script also refuses:

- entries of docstrings for parameters that do not exist;
- links of the finished pages that lead nowhere, those made from docstrings among them;
- images, styles and scripts from another host: they need a network, and tell that host who reads.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "site"
DOCSTRING_WARNING = "griffe: "
LOADING_RELATIONS = {"stylesheet", "icon", "preload", "modulepreload", "prefetch", "preconnect", "dns-prefetch"}
LOADED_BY_STYLE = re.compile(r"(?:url\(|@import)\s*[\"']?((?:https?:)?//[^\"')\s]+)")


@dataclass
class Page(HTMLParser):
    """Anchors and references of a page.

    Attributes:
        anchors: names that a link can lead to.
        links: addresses that a reader may follow.
        loaded: addresses that the browser loads by itself.
    """

    anchors: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Sort the attributes of one element."""
        given = {name: value for name, value in attrs if value}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag == "link" and "href" in given:
            loads = LOADING_RELATIONS & set(given.get("rel", "").split())
            (self.loaded if loads else self.links).append(given["href"])
        if "src" in given:
            self.loaded.append(given["src"])


@cache
def page(path: Path) -> Page:
    """Return the parsed page of a file."""
    parsed = Page()
    parsed.feed(path.read_text(encoding="utf-8"))
    return parsed


def faults_of(site: Path) -> Iterator[str]:
    """Yield the faults of a finished site, each with its file: broken links, and loads from another host."""
    for path in sorted(site.rglob("*.html")):
        where = path.relative_to(site).as_posix()
        for address in page(path).loaded:
            if urlsplit(address).netloc:
                yield f"{where}: loads {address}"
            elif why := _why_broken(site, path, address):
                yield f"{where}: loads {address}, {why}"
        for address in page(path).links:
            if why := _why_broken(site, path, address):
                yield f"{where}: links to {address}, {why}"
    for path in sorted(site.rglob("*.css")):
        for address in LOADED_BY_STYLE.findall(path.read_text(encoding="utf-8")):
            yield f"{path.relative_to(site).as_posix()}: loads {address}"


def _why_broken(site: Path, source: Path, address: str) -> str | None:
    parts = urlsplit(address)
    if parts.scheme or parts.netloc:
        return None
    name = unquote(parts.path)
    target = site / name.lstrip("/") if name.startswith("/") else source.parent / name if name else source
    if target.is_dir():
        target /= "index.html"
    if not target.is_file():
        return "which is not there"
    if parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in page(target).anchors:
        return "where there is no such heading"
    return None


def build() -> list[str]:
    """Build the site and return the warnings about docstrings.

    Raises:
        SystemExit: the build failed.
    """
    command = [sys.executable, "-m", "zensical", "build", "--strict", "--clean"]
    done = subprocess.run(
        command, cwd=ROOT, check=False, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    sys.stdout.write(done.stdout)
    if done.returncode:
        raise SystemExit(done.returncode)
    return [line for line in done.stdout.splitlines() if line.startswith(DOCSTRING_WARNING)]


def main() -> None:
    """Build the site, and fail if it has a fault."""
    faults = [*build(), *faults_of(SITE)]
    if faults:
        raise SystemExit("\n".join(faults))
    count = sum(1 for _ in SITE.rglob("*.html"))
    sys.stdout.write(
        f"{count} pages in {SITE.relative_to(ROOT)}/: all links lead somewhere, nothing is loaded from elsewhere\n"
    )


if __name__ == "__main__":
    main()
