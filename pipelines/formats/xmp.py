"""Properties of XMP packets: attributes, elements, lists and structures, found by their names in any namespace.

Makers put the same names under prefixes and namespaces of their own. defusedxml refuses entities and document
types.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from xml.etree.ElementTree import Element, ParseError

from pipelines.formats.tables import with_decimal_point

_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_NOT_NAMES = (_RDF, "adobe:ns:meta/", "http://www.w3.org/XML/1998/namespace")
_RDF_ATTRIBUTES = frozenset({"about", "ID", "parseType", "resource"})
_ROOT = re.compile(rb"<(x:xmpmeta|x:xapmeta|[\w.-]*:?RDF)\b")
_MAX_PACKET_BYTES = 4 * 1024 * 1024
_MAX_PROPERTIES = 10_000
_MAX_TEXT = 4096
_NUMBER = re.compile(r"\s*([+-]?(?:\d+[.,]?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(?:/\s*(\d+))?\s*(?:m|°|deg)?\s*$")


class XmpError(ValueError):
    """A packet exists, but cannot be read."""


@dataclass(frozen=True)
class XmpProperty:
    """A property that has a text; a list has one for each item."""

    namespace: str
    name: str
    within: str  # name of the structure it is a field of, empty if of none
    text: str


@dataclass(frozen=True)
class Xmp:
    """All properties of a photograph's packets, in the order of the file."""

    properties: tuple[XmpProperty, ...] = ()

    def texts(self, name: str, *, within: str | None = None, namespace: str | None = None) -> tuple[str, ...]:
        """Return the different texts of a property, in order, by its name without regard to case.

        `within` asks for the fields of one structure ("" for those of none), `namespace` for a part of the
        namespace's address.
        """
        texts_of_name = [
            each.text
            for each in self.named(name)
            if (within is None or each.within.casefold() == within.casefold())
            and (namespace is None or namespace.casefold() in each.namespace.casefold())
        ]
        return tuple(dict.fromkeys(texts_of_name))

    def named(self, name: str) -> tuple[XmpProperty, ...]:
        """Return all properties of a name, in order, without regard to case."""
        return tuple(self._by_name.get(name.casefold(), ()))

    def text(self, *names: str, within: str | None = None, namespace: str | None = None) -> str | None:
        """Return the first text of the first property of these names that has one."""
        for name in names:
            if texts := self.texts(name, within=within, namespace=namespace):
                return texts[0]
        return None

    def number(self, *names: str, within: str | None = None, namespace: str | None = None) -> float | None:
        """Return the first finite number of these properties; a unit of metres or degrees may follow it."""
        for name in names:
            for text in self.texts(name, within=within, namespace=namespace):
                if (value := number_of(text)) is not None:
                    return value
        return None

    def __bool__(self) -> bool:
        return bool(self.properties)

    @cached_property
    def _by_name(self) -> dict[str, list[XmpProperty]]:
        names: dict[str, list[XmpProperty]] = {}
        for each in self.properties:
            names.setdefault(each.name.casefold(), []).append(each)
        return names


def number_of(text: str) -> float | None:
    """Return a finite number or fraction that a text states, with or without metres or degrees behind it.

    Some programs write a comma for the decimal point, in the language of their user.
    """
    match = _NUMBER.match(text)
    if match is None or (match[2] is not None and float(match[2]) == 0.0):
        return None
    value = float(with_decimal_point(match[1])) / float(match[2] or 1.0)
    return value if math.isfinite(value) else None


def read_packets(packets: Iterable[bytes], problems: list[str]) -> Xmp:
    """Return the properties of packets; those that cannot be read are added to the problems.

    Examples:
        >>> packet = (
        ...     b'<r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><r:Description '
        ...     b'xmlns:d="http://www.dji.com/drone-dji/1.0/" d:RelativeAltitude="+50.00" d:RtkFlag="50"/></r:RDF>'
        ... )
        >>> read_packets([packet], []).number("RelativeAltitude")  # metres above the take-off
        50.0
    """
    properties: list[XmpProperty] = []
    for packet in packets:
        try:
            properties += read_packet(packet)
        except XmpError as error:
            if (problem := str(error)) not in problems:
                problems.append(problem)
    return Xmp(tuple(properties[:_MAX_PROPERTIES]))


def read_packet(packet: bytes) -> list[XmpProperty]:
    """Return the properties of a packet.

    Raises:
        XmpError: a packet that is too long or not well formed.

    Examples:
        >>> packet = (
        ...     b'<r:RDF xmlns:r="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><r:Description '
        ...     b'xmlns:d="http://www.dji.com/drone-dji/1.0/" d:RelativeAltitude="+50.00" d:RtkFlag="50"/></r:RDF>'
        ... )
        >>> [(one.name, one.text) for one in read_packet(packet)]
        [('RelativeAltitude', '+50.00'), ('RtkFlag', '50')]
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import fromstring

    if len(packet) > _MAX_PACKET_BYTES:
        raise XmpError(f"the XMP packet is longer than {_MAX_PACKET_BYTES // 1024**2} MiB")
    begin = _ROOT.search(packet)
    text = packet[begin.start() :] if begin is not None else packet
    end = text.rfind(b">")
    # What follows the root is padding and a closing instruction, which need not be valid.
    if begin is not None and (close := text.rfind(b"</" + begin[1] + b">")) >= 0:
        end = close + len(begin[1]) + 2
    try:
        root: Element = fromstring(text[: end + 1], forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise XmpError(f"the XMP packet is not well formed: {error}") from error
    return _properties(root)


def _properties(root: Element) -> list[XmpProperty]:
    properties: list[XmpProperty] = []
    # Element, and the two names around it: the property, and the structure that the property is in.
    stack: list[tuple[Element, tuple[str, str], str]] = [(root, ("", ""), "")]
    while stack and len(properties) < _MAX_PROPERTIES:
        element, around, within = stack.pop()
        space, name = _split(element.tag)
        # Lists and descriptions of RDF stand between a property and its values.
        if space in _NOT_NAMES:
            space, name = around
        else:
            within = around[1]
        for key, text in element.attrib.items():
            attribute_space, attribute = _split(key)
            if attribute_space not in _NOT_NAMES and attribute not in _RDF_ATTRIBUTES:
                properties.append(XmpProperty(attribute_space, attribute, name, text[:_MAX_TEXT]))
        text = (element.text or "").strip()
        if text and name and not len(element):
            properties.append(XmpProperty(space, name, within, text[:_MAX_TEXT]))
        stack += [(child, (space, name), within) for child in reversed(element)]
    return properties


def _split(tag: object) -> tuple[str, str]:
    """Return namespace and local name of an element or attribute."""
    space, _, name = str(tag).rpartition("}")
    return space.removeprefix("{"), name
