"""Pages for people: a frame with style, contents and sections, which every report of the package shares.

A page is one file. It holds its style and its pictures, has no script, and loads nothing: its own policy forbids
both. Texts of users (names of points, of photographs, of workspaces) enter through the escaping of jinja2 only, and
their control characters are written as escapes.

A room that makes a page has a folder `templates/` with one template a section. The templates hold all HTML; Python
gives them typed facts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.core.durable import replace_text
from pipelines.core.printable import printable_lines
from pipelines.pages.text import FORMS, formatted

if TYPE_CHECKING:
    from jinja2 import Environment

_FRAME = "frame.html"


@dataclass(frozen=True)
class Section:
    """Section of a page.

    Attributes:
        anchor: name that links lead to: lower-case letters and hyphens.
        title: its heading.
        template: file in the `templates/` of the page's room.
        facts: what the template shows, under the name `facts`.
    """

    anchor: str
    title: str
    template: str
    facts: object


@dataclass(frozen=True)
class Page:
    """Content of a page.

    Attributes:
        title: heading.
        subtitle: line below it.
        about: name and value of each line of the head, such as the time at which the page was made.
        sections: in order.
        document: JSON document that figures of the page are taken from by their path (`figure` in `macros.html`).
    """

    title: str
    subtitle: str
    about: Mapping[str, str]
    sections: Sequence[Section]
    document: Mapping[str, Any] = field(default_factory=dict)


def render_page(page: Page, room: str) -> str:
    """Return the HTML of a page.

    Args:
        page: its content.
        room: package with the folder `templates/` of its sections, such as `pipelines.report`.

    Raises:
        jinja2.UndefinedError: a template names a fact that does not exist.
    """
    return _environment(room).get_template(_FRAME).render(page=page, document=page.document)


def write_page(page: Page, room: str, path: Path) -> None:
    """Write the HTML of a page; an existing file is replaced when the new one is complete.

    Raises:
        OSError: the file cannot be written; the existing one stays.
    """
    replace_text(path, render_page(page, room))


def value_at(document: Any, path: str) -> Any:
    """Return the value at a path of keys and indices: `checkpoints.camera.points.3.de_m`.

    None where a part on the way is None: a part of a report that does not exist has no figures.

    Raises:
        KeyError, IndexError: the document has no such path.
    """
    for key in path.split("."):
        if document is None:
            return None
        document = document[int(key)] if isinstance(document, list) else document[key]
    return document


def _environment(room: str) -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(room), PackageLoader("pipelines.pages")]),
        autoescape=True,
        finalize=lambda value: printable_lines(value) if type(value) is str else value,  # not of markup
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= FORMS
    environment.globals |= {"value_at": value_at, "formatted": formatted}
    return environment
