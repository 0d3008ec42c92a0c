"""Take apart the entries of docstrings that describe several parameters at once, for the API pages.

`u, v: (N,) texture coordinates.` becomes an entry for u and one for v, with the same text. The pages are made from
docstrings of Google's style, which knows one name an entry.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

SECTIONS = ("Args:", "Attributes:")
SHARED = re.compile(r" {4}(\w+(?:, \w+)+)(: .*)")


class SharedEntries(griffe.Extension):
    """Read every docstring as if each of its entries had one name."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of an object that has been read."""
        if obj.docstring is not None:
            obj.docstring.value = with_one_name_an_entry(obj.docstring.value)


def with_one_name_an_entry(docstring: str) -> str:
    """Return a docstring whose entries for several names are repeated for each of them."""
    lines: list[str] = []
    names: list[str] = []
    text: list[str] = []
    in_section = False

    def repeat() -> None:
        for name in names:
            lines.extend([f"    {name}{text[0]}", *text[1:]])
        names.clear()

    for line in docstring.splitlines():
        if names and line.startswith(" " * 5):
            text.append(line)
            continue
        repeat()
        if line and not line.startswith(" "):
            in_section = line in SECTIONS
        shared = SHARED.fullmatch(line) if in_section else None
        if shared:
            names, text = shared[1].split(", "), [shared[2]]
        else:
            lines.append(line)
    repeat()
    return "\n".join(lines)
