"""Polygons and lines of KML (OGC 12-007r2), longitude first, in WGS84.

Rings are closed where their last corner is not the first again, as Google Earth shows them. Links to other files
are not followed, and a document that declares entities is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import shapely

from pipelines.core.errors import InputError

_DEEPEST = 200
_ROOTS = ("kml", "Document", "Folder", "Placemark")
_COMMA = re.compile(r"\s*,\s*")


def read_kml(data: bytes, refusal: Callable[..., InputError]) -> list[Any]:
    """Return the polygons, lines and points of a document in UTF-8 as shapes in plan.

    Raises:
        InputError: by `refusal`: no KML, not well-formed, with entities of its own, or a coordinate that is no
            number.

    Examples:
        >>> line = b"<LineString><coordinates>7,46,0 7.1,46.2,0</coordinates></LineString>"
        >>> shapes = read_kml(b"<kml><Placemark>" + line + b"</Placemark></kml>", InputError)
        >>> [shape.wkt for shape in shapes]
        ['LINESTRING (7 46, 7.1 46.2)']
    """
    from pyexpat import ExpatError, ParserCreate

    reader = _Reader(refusal)
    parser = ParserCreate("utf-8")
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.EntityDeclHandler = reader.entity
    try:
        parser.Parse(data, True)
    except ExpatError as error:
        raise refusal(
            "boundary-unreadable", f"is no well-formed KML: {error}.", remedy="Write it again."
        ) from error
    return reader.shapes


class _Reader:
    """Reader of one document, element by element."""

    def __init__(self, refusal: Callable[..., InputError]) -> None:
        self._refusal = refusal
        self._open: list[str] = []
        self._text: list[str] = []
        self._outer: list[tuple[float, float]] = []
        self._holes: list[list[tuple[float, float]]] = []
        self._track: list[tuple[float, float]] = []
        self.shapes: list[Any] = []

    def start(self, name: str, _: dict[str, str]) -> None:
        name = name.rpartition(":")[2]
        if not self._open and name not in _ROOTS:
            raise self._refusal("boundary-format", f"is XML, but no KML: its root is <{name[:40]}>.")
        self._open.append(name)
        if len(self._open) > _DEEPEST:
            raise self._refusal("boundary-unreadable", f"has elements deeper than {_DEEPEST}, the limit.")
        self._text.clear()
        if name == "Polygon":
            self._outer, self._holes = [], []
        elif name == "Track":
            self._track = []

    def entity(self, name: str, *_: object) -> None:
        raise self._refusal(
            "boundary-entities", f"declares the entity {name[:40]}, which is not read.", remedy="Remove it."
        )

    def text(self, text: str) -> None:
        if self._open[-1] in ("coordinates", "coord"):
            self._text.append(text)

    def end(self, name: str) -> None:
        name = self._open.pop()
        if name == "coordinates":
            self._coordinates(self._places(_COMMA.sub(",", "".join(self._text)).split(), ","))
        elif name == "coord":
            self._track += self._places([" ".join("".join(self._text).split())], " ")
        elif name == "Track" and len(self._track) > 1:
            self.shapes.append(shapely.LineString(self._track))
        elif name == "Polygon" and len(self._outer) > 2:
            self.shapes.append(shapely.Polygon(self._outer, self._holes))

    def _places(self, words: list[str], separator: str) -> list[tuple[float, float]]:
        places = []
        for word in words:
            values = word.split(separator)
            try:
                places.append((float(values[0]), float(values[1])))
            except (ValueError, IndexError):
                message = f"has the coordinates {word[:60]!r}, which are no longitude and latitude."
                raise self._refusal("boundary-unreadable", message) from None
        return places

    def _coordinates(self, places: list[tuple[float, float]]) -> None:
        """Take the places of the element that has just ended, by the elements around it."""
        kind = self._open[-1] if self._open else ""
        if kind == "Point":
            self.shapes += [shapely.Point(place) for place in places]
        elif kind == "LineString" and len(places) > 1:
            self.shapes.append(shapely.LineString(places))
        elif kind == "LinearRing" and len(places) > 2:
            if "Polygon" not in self._open:
                self.shapes.append(shapely.Polygon(places))
            elif "innerBoundaryIs" in self._open:
                self._holes.append(places)
            elif not self._outer:
                self._outer = places
