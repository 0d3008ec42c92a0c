"""The documentation site: its faults are seen, and docstrings are read as they are meant."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scripts import REPOSITORY, load_script

build_site = load_script(REPOSITORY / ".ci/build_site.py")
shared_entries = load_script(REPOSITORY / "docs/shared_entries.py")

SOUND = """<html><head><link rel="stylesheet" href="style.css"><link rel="next" href="api/room.html"></head>
<body><h1 id="top">A</h1><a href="#top">up</a><a href="api/room.html#f">f</a><a href="https://example.org/x">away</a>
<a href="api">all</a><script src="style.css"></script></body></html>"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A site without faults."""
    (tmp_path / "api").mkdir()
    (tmp_path / "index.html").write_text(SOUND, encoding="utf-8")
    (tmp_path / "style.css").write_text("a { background: url(data:image/svg+xml;base64,AA) }", encoding="utf-8")
    (tmp_path / "api/index.html").write_text('<a href="../index.html">back</a>', encoding="utf-8")
    (tmp_path / "api/room.html").write_text('<h2 id="f">f</h2><a href="/index.html#top">up</a>', encoding="utf-8")
    return tmp_path


def test_sound_site_has_no_faults(site: Path) -> None:
    assert list(build_site.faults_of(site)) == []


@pytest.mark.parametrize(
    ("element", "fault"),
    [
        ('<a href="gone.html">', "links to gone.html, which is not there"),
        ('<a href="api/room.html#g">', "links to api/room.html#g, where there is no such heading"),
        ('<img src="gone.png">', "loads gone.png, which is not there"),
        ('<script src="https://example.org/a.js"></script>', "loads https://example.org/a.js"),
        ('<script src="//example.org/a.js"></script>', "loads //example.org/a.js"),
        ('<link rel="preconnect" href="https://example.org">', "loads https://example.org"),
    ],
)
def test_fault_of_a_page_is_named(site: Path, element: str, fault: str) -> None:
    (site / "faulty.html").write_text(element, encoding="utf-8")
    assert list(build_site.faults_of(site)) == [f"faulty.html: {fault}"]


def test_font_from_elsewhere_is_named(site: Path) -> None:
    (site / "font.css").write_text('@import "https://example.org/font";', encoding="utf-8")
    assert list(build_site.faults_of(site)) == ["font.css: loads https://example.org/font"]


def test_entry_for_several_names_is_repeated() -> None:
    docstring = """Return a surface.

    u, v: not an entry.

Args:
    u, v: (N,) coordinates
        in metres.
    size: of a pixel.
    du, dv: width.

Returns:
    a, b: the sides.
"""
    expected = """Return a surface.

    u, v: not an entry.

Args:
    u: (N,) coordinates
        in metres.
    v: (N,) coordinates
        in metres.
    size: of a pixel.
    du: width.
    dv: width.

Returns:
    a, b: the sides."""
    assert shared_entries.with_one_name_an_entry(docstring) == expected
