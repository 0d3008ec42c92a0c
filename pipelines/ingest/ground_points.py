"""Control and check points on Earth, with their marks tied to the survey's images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.odm import GroundMark, read_ground_points
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.ingest.image_names import ImageNames
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.reference_system import note_operation, stated_crs
from pipelines.scene.survey import Mark

_LEAST_MARKS = 2
# Two names at one place are one point; a point this far from the cameras is in another country.
_SAME_PLACE_M = 1e-3
_RANGE_M = 50_000.0


@dataclass(frozen=True)
class GroundPoint:
    """A surveyed point: position (3,) in ECEF, its marks, and the line where it first stands."""

    name: str
    position_in_ecef: FloatArray
    marks: tuple[Mark, ...]
    line: int


@dataclass(frozen=True)
class GroundFile:
    """The points of one file."""

    path: Path
    crs_name: str
    vertical: VerticalDatum
    points: tuple[GroundPoint, ...]


def read_ground_file(
    path: Path, sizes: Mapping[str, tuple[int, int]], options: IngestOptions, notes: Notes
) -> GroundFile:
    """Read a `gcp_list.txt` and tie it to images.

    Marks in images that are not here are left out and noted, and so are points with fewer than two marks left.

    Args:
        path: the file.
        sizes: width and height of each image by name.
        options: vertical datum, and σ of a mark.
        notes: what was left out.

    Raises:
        InputError: a malformed file, one name at two places, two marks of a point in one image, a mark outside its
            image, impossible coordinates, or no mark in any image here.
    """
    listed = read_ground_points(path)
    crs = stated_crs(listed.crs_text, path, options, notes)
    first = _first_lines(listed.marks, path)
    xyz = np.array([mark.xyz for mark in first.values()])
    lla = crs.lla_from_xyz(xyz, path=path, lines=[mark.line for mark in first.values()])
    note_operation(crs, lla, notes)
    marks = _marks_by_point(listed.marks, sizes, options.sigma_mark, path, notes)
    position_in_ecef = ecef_from_lla(lla)
    points, lonely = [], []
    for row, (name, mark) in enumerate(first.items()):
        if len(marks[name]) < _LEAST_MARKS:
            lonely.append(f"{name} ({path.name}:{mark.line})")
        else:
            points.append(GroundPoint(name, position_in_ecef[row], tuple(marks[name].values()), mark.line))
    notes.warn_counted(
        lonely,
        "ground point has marks in fewer than 2 images and was left out",
        "ground points have marks in fewer than 2 images and were left out",
    )
    return GroundFile(path, crs.name, crs.vertical, tuple(points))


def split_checks(
    control: GroundFile | None, check: GroundFile | None, names: Sequence[str]
) -> tuple[tuple[GroundPoint, ...], tuple[GroundPoint, ...]]:
    """Return control and check points, after making check points of the control points in `names`.

    Raises:
        InputError: a name that is no control point, or a point that is both.
    """
    points = () if control is None else control.points
    usable = {point.name for point in points}
    for name in names:
        if name not in usable:
            message = f"{name!r} is no usable point there: it has {', '.join(sorted(usable))}"
            raise InputError(message, path=None if control is None else control.path, field="--check")
    listed = () if check is None else check.points
    for point in listed:
        twin = next((other for other in points if _are_one(other, point)), None)
        if check is not None and twin is not None:
            message = (
                f"{point.name} is also control point {twin.name} (line {twin.line}): it can be one of them only"
            )
            raise InputError(message, path=check.path, line=point.line)
    kept = tuple(point for point in points if point.name not in names)
    return kept, (*listed, *(point for point in points if point.name in names))


def require_near(file: GroundFile, middle_in_ecef: FloatArray) -> None:
    """Refuse points that are nowhere near the cameras, whose middle is (3,) in ECEF.

    Raises:
        InputError: a point more than 50 km away.
    """
    for point in file.points:
        distance_m = float(np.linalg.norm(point.position_in_ecef - middle_in_ecef))
        if distance_m > _RANGE_M:
            message = f"{point.name} is {distance_m / 1000:.0f} km from the images: wrong CRS, or x and y swapped?"
            raise InputError(message, path=file.path, line=point.line)


def _are_one(first: GroundPoint, second: GroundPoint) -> bool:
    """Return whether two points have one name or one place."""
    distance_m = float(np.linalg.norm(first.position_in_ecef - second.position_in_ecef))
    return first.name == second.name or distance_m < _SAME_PLACE_M


def _first_lines(marks: tuple[GroundMark, ...], path: Path) -> dict[str, GroundMark]:
    """Return the first line of each point."""
    first: dict[str, GroundMark] = {}
    for mark in marks:
        other = first.setdefault(mark.name, mark)
        if mark.xyz != other.xyz:
            message = f"{mark.name} has other coordinates in line {other.line}"
            raise InputError(message, path=path, line=mark.line, field="x y z")
    return first


def _marks_by_point(
    listed: tuple[GroundMark, ...],
    sizes: Mapping[str, tuple[int, int]],
    sigma_px: float,
    path: Path,
    notes: Notes,
) -> dict[str, dict[str, Mark]]:
    """Return marks by point and image."""
    names = ImageNames(sizes)
    marks: dict[str, dict[str, Mark]] = {mark.name: {} for mark in listed}
    unknown = []
    for mark in listed:
        image = names.find(mark.image, path=path, line=mark.line)
        if image is None:
            unknown.append(f"{path.name}:{mark.line} ({mark.image})")
            continue
        width, height = sizes[image]
        if not (0.0 <= mark.x_px <= width and 0.0 <= mark.y_px <= height):
            raise InputError(
                f"the mark of {mark.name} at ({mark.x_px:g}, {mark.y_px:g}) lies outside {image} ({width}×{height} "
                "pixels): was it made on an image of another size?",
                path=path,
                line=mark.line,
                field="px py",
            )
        if image in marks[mark.name]:
            raise InputError(f"{mark.name} is marked in {image} already", path=path, line=mark.line, field="image")
        marks[mark.name][image] = Mark(image=image, x_px=mark.x_px, y_px=mark.y_px, sigma_px=sigma_px)
    if len(unknown) == len(listed):
        message = f"names none of the images: it has {listed[0].image!r} …, the folder {min(sizes)!r} …"
        raise InputError(message, path=path, field="image")
    notes.warn_counted(unknown, "mark is in an image that is not here", "marks are in images that are not here")
    return marks
