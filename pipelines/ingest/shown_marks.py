"""Marks made on photographs as EXIF's orientation shows them, brought to the pixels as they are stored.

Browsers and most programs for marking turn a photograph as EXIF says; cameras, COLMAP and this program count pixels
as they are stored (EXIF 2.32, tag 0x0112).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from pipelines.ingest.remarks import Remarks, shortened

_UPRIGHT = 1
_QUARTER_TURNS = range(5, 9)


def shown_size(orientation: int, width: int, height: int) -> tuple[int, int]:
    """Return width and height of a picture as shown, of those as stored."""
    return (height, width) if orientation in _QUARTER_TURNS else (width, height)


def stored_pixel(orientation: int, x: float, y: float, width: int, height: int) -> tuple[float, float]:
    """Return the stored place of a place in a shown picture, in pixels from its left and upper edge.

    Width and height are those as stored.
    """
    return {
        2: (width - x, y),
        3: (width - x, height - y),
        4: (x, height - y),
        5: (y, x),
        6: (y, height - x),
        7: (width - y, height - x),
        8: (width - y, x),
    }.get(orientation, (x, y))


@dataclass
class ShownMarks:
    """How marks were made: as the pictures are shown, or as they are stored; and which marks that concerns."""

    orientations: Mapping[str, int] = field(default_factory=dict)  # by name; EXIF's number, 1 where it has none
    as_shown: bool = False
    marks: int = 0  # in pictures that EXIF turns
    images: set[str] = field(default_factory=set)  # such pictures

    def stored(self, image: str, x: float, y: float, size: tuple[int, int]) -> tuple[float, float]:
        """Return the stored place of a mark in an image of a stored size (width, height)."""
        orientation = self.orientations.get(image, _UPRIGHT)
        if orientation == _UPRIGHT:
            return x, y
        self.marks += 1
        self.images.add(image)
        return stored_pixel(orientation, x, y, *size) if self.as_shown else (x, y)

    def why_outside(self, image: str, x: float, y: float, size: tuple[int, int]) -> str | None:
        """Return why a mark outside its image lies inside it as shown, or as stored; None: it does not."""
        orientation = self.orientations.get(image, _UPRIGHT)
        if orientation == _UPRIGHT:
            return None
        width, height = size if self.as_shown else shown_size(orientation, *size)
        if not (0.0 <= x <= width and 0.0 <= y <= height):
            return None
        if self.as_shown:
            return "It lies inside the picture as stored: remove --marks-as-shown."
        return (
            f"EXIF turns this photograph (orientation {orientation}), and the mark lies inside the picture as "
            f"shown, {width}×{height} px. If marks were made on turned pictures, give --marks-as-shown."
        )

    def note(self, remarks: Remarks) -> None:
        """Note how marks in turned pictures were read."""
        where = f"{self.marks} marks in {len(self.images)} photographs that EXIF turns"
        if self.as_shown and not self.marks:
            remarks.warn("no-mark-turned", "EXIF turns no marked photograph: --marks-as-shown changes nothing.")
        elif self.as_shown:
            remarks.assume("marks-as-shown", f"{where} were made on the pictures as shown: they are turned back.")
        elif self.marks:
            remarks.warn(
                "marks-as-stored",
                f"{where} ({shortened(sorted(self.images))}) are read in pixels as stored. If they were made on "
                "the pictures as shown, give --marks-as-shown.",
            )
