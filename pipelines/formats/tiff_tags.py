"""Tags of a TIFF structure, as EXIF is one: a directory's entries, each as its numbers or its text.

Pillow stops a directory at the first tag that lies beyond the end, and warns on standard error. Here such a tag is
left out alone. Fractions are kept as written: one whose sign was lost is told by its numerator.
"""

import struct
from collections.abc import Collection
from dataclasses import dataclass

TIFF = (b"II*\x00", b"MM\x00*")
ASCII, _UTF8, _UNDEFINED = 2, 129, 7
# size in bytes and the letter of `struct`, by TIFF's type; a fraction is two numbers
_TYPES = {
    1: (1, "B"), 3: (2, "H"), 4: (4, "I"), 5: (8, "I"), 6: (1, "b"), 8: (2, "h"), 9: (4, "i"), 10: (8, "i"),
    11: (4, "f"), 12: (8, "d"), 13: (4, "I"), ASCII: (1, ""), _UNDEFINED: (1, ""), _UTF8: (1, ""),
}  # fmt: skip
_RATIONALS = (5, 10)
_MAX_ENTRIES = 4096
_MAX_TAG_BYTES = 64 * 1024
_MAX_DIRECTORY_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True)
class Tag:
    """Value of a tag, as stored."""

    kind: int  # TIFF's type
    data: bytes
    order: str  # of the bytes, as of `struct`

    @property
    def is_text(self) -> bool:
        return self.kind in (ASCII, _UTF8)

    @property
    def text(self) -> str:
        """Text up to its end, without blanks around it; empty if the tag holds numbers."""
        if not self.is_text:
            return ""
        return self.data.split(b"\x00", 1)[0].decode("utf-8", "replace").strip("\x00 ")

    @property
    def fractions(self) -> tuple[tuple[float, float], ...]:
        """Numerators and denominators (1 of a number that is no fraction); none of a text."""
        size, letter = _TYPES[self.kind]
        if not letter:
            return ()
        count = len(self.data) // size
        if self.kind in _RATIONALS:
            numbers = struct.unpack(f"{self.order}{2 * count}{letter}", self.data[: size * count])
            return tuple(zip(numbers[::2], numbers[1::2], strict=True))
        return tuple(
            (value, 1) for value in struct.unpack(f"{self.order}{count}{letter}", self.data[: size * count])
        )


def read_directory(
    block: bytes, at: int | None = None, *, wanted: Collection[int] | None = None, limit_bytes: int = _MAX_TAG_BYTES
) -> dict[int, Tag]:
    """Return the tags of the directory at an offset, of the first one without it; all tags, or those wanted.

    Tags of an unknown type, beyond the block's end or longer than `limit_bytes` are left out. Nothing is raised.

    Examples:
        >>> entry = struct.pack("<HHII", 0x0112, 3, 1, 6)  # Orientation, a short, one value
        >>> block = b"II" + struct.pack("<HIH", 42, 8, 1) + entry + bytes(4)
        >>> {tag: value.fractions for tag, value in read_directory(block).items()}
        {274: ((6, 1),)}
    """
    if block[:4] not in TIFF:
        return {}
    order = "<" if block[:2] == b"II" else ">"
    tags: dict[int, Tag] = {}
    budget_bytes = max(_MAX_DIRECTORY_BYTES, limit_bytes)
    try:
        if at is None:
            (at,) = struct.unpack_from(order + "I", block, 4)
        (count,) = struct.unpack_from(order + "H", block, at)
        for entry in range(min(count, _MAX_ENTRIES)):
            offset = at + 2 + 12 * entry
            number, kind, values = struct.unpack_from(order + "HHI", block, offset)
            if kind not in _TYPES or number in tags or (wanted is not None and number not in wanted):
                continue
            size = _TYPES[kind][0] * values
            begin = offset + 8 if size <= 4 else struct.unpack_from(order + "I", block, offset + 8)[0]
            if size <= min(limit_bytes, budget_bytes) and begin + size <= len(block):
                tags[number] = Tag(kind, block[begin : begin + size], order)
                budget_bytes -= size
    except struct.error:  # the directory itself is cut off: what was read of it counts
        pass
    return tags
