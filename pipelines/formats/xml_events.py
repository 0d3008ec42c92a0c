"""XML of other programs, read element by element: no tree in memory, no entities, no document type definitions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax import ContentHandler, SAXException

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading

if TYPE_CHECKING:
    from xml.sax.xmlreader import AttributesImpl, Locator

_LONGEST_TAG = 1 << 20  # The parser begins an unfinished tag again with every part of the file.
_MAX_DEPTH = 100
OFF = frozenset({"0", "false"})


class XmlReader(ContentHandler):
    """Base of the readers of one document; `begin`, `end` and `text` get what it holds, in its order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.events = 0
        self.open: list[str] = []  # names of the elements that are open, the outermost first
        self._place: Locator | None = None

    def begin(self, name: str, values: dict[str, str], parent: str) -> None:
        """Take the start of an element, with its attributes."""

    def end(self, name: str) -> None:
        """Take the end of an element, which is no longer among the open ones."""

    def text(self, content: str) -> None:
        """Take a part of the text of the innermost open element."""

    @property
    def line(self) -> int:
        return 1 if self._place is None else int(self._place.getLineNumber() or 1)

    def fault(self, code: str, message: str, field: str | None = None) -> InputError:
        """Return the error of the line that is being read."""
        return InputError(code, message, path=self.path, line=self.line, field=field)

    def setDocumentLocator(self, locator: Locator) -> None:
        self._place = locator

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        self.events += 1
        parent = self.open[-1] if self.open else ""
        self.open.append(name)
        if len(self.open) > _MAX_DEPTH:
            raise self.fault("xml-too-deep", f"the elements are nested more than {_MAX_DEPTH} deep, the limit")
        self.begin(name, {str(key): str(value) for key, value in attrs.items()}, parent)

    def endElement(self, name: str) -> None:
        self.events += 1
        self.open.pop()
        self.end(name)

    def characters(self, content: str) -> None:
        self.events += 1
        self.text(content)


def read_xml(reader: XmlReader, *, limit_bytes: int, kind: str) -> None:
    """Send the file of a reader through it.

    Raises:
        InputError: unreadable, too large for its kind, not well-formed XML, or what the reader refuses.

    Examples:
        >>> class Labels(XmlReader):
        ...     def begin(self, name, values, parent):
        ...         print(self.open, values)
        >>> _ = Path("markers.xml").write_text('<document><marker label="P1"/></document>')
        >>> read_xml(Labels(Path("markers.xml")), limit_bytes=1000, kind="file of markers")
        ['document'] {}
        ['document', 'marker'] {'label': 'P1'}
    """
    from defusedxml.common import DefusedXmlException
    from defusedxml.sax import make_parser

    path = reader.path
    file_size(path, limit_bytes=limit_bytes, kind=kind)
    parser = make_parser()
    parser.forbid_dtd = True
    parser.setContentHandler(reader)
    reader.setDocumentLocator(parser)
    try:
        with reading(path), path.open("rb") as stream:
            while data := stream.read(_LONGEST_TAG):
                before = reader.events
                parser.feed(data)
                if len(data) == _LONGEST_TAG and reader.events == before:
                    raise reader.fault(
                        "xml-tag-too-long", f"a tag is longer than {_LONGEST_TAG >> 20} MiB, the limit"
                    )
        parser.close()
    except (SAXException, DefusedXmlException, ValueError, LookupError) as error:
        message = " ".join(str(error).split())[:200]
        raise InputError("xml-invalid", f"The file is not well-formed XML: {message}", path=path) from error
