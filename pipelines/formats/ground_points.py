"""Surveyed points and their image marks, as the files of surveyors list them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError

Xyz = tuple[float, float, float]


@dataclass(frozen=True)
class ListedPoint:
    """Surveyed point of a file.

    Attributes:
        line: where it stands first.
        name: of the point.
        xyz: coordinates in the order of the file's `GroundPoints.in_order_of_crs`.
        sigma_h_m: horizontal σ that the file states, metres.
        sigma_v_m: vertical σ.
        is_check: whether the file calls it a check point.
    """

    line: int
    name: str
    xyz: Xyz
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    is_check: bool = False


@dataclass(frozen=True)
class ListedMark:
    """Place of a surveyed point in an image, pixels of the full image as the file has them."""

    line: int
    name: str
    image: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class GroundPoints:
    """Surveyed points of a file.

    Attributes:
        path: of the file.
        kind: of the file, for people.
        points: in the order of the file, names without repeats.
        marks: of these points; a file of another kind may have them.
        crs_text: CRS that the file states; None: it states none.
        crs_line: line of the CRS.
        geographic: whether the file calls its columns longitude and latitude; None if the CRS alone decides.
        in_order_of_crs: whether the first two coordinates stand in the order of the axes of the CRS; otherwise
            easting or longitude is first.
        unknown_columns: names in the header that mean nothing here.
        left_out: places of marks that the file itself does not count as made by a person.
    """

    path: Path
    kind: str
    points: tuple[ListedPoint, ...]
    marks: tuple[ListedMark, ...] = ()
    crs_text: str | None = None
    crs_line: int = 1
    geographic: bool | None = None
    in_order_of_crs: bool = False
    unknown_columns: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()


def without_repeats(points: list[ListedPoint], path: Path) -> tuple[ListedPoint, ...]:
    """Return the first line of each point.

    Raises:
        InputError: a point has other coordinates in a later line.
    """
    first: dict[str, ListedPoint] = {}
    for point in points:
        other = first.setdefault(point.name, point)
        if point.xyz != other.xyz:
            message = f"{point.name} has other coordinates in line {other.line}"
            raise InputError(message, path=path, line=point.line, field="x y z")
    return tuple(first.values())
