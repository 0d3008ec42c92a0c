"""Control and check points on Earth, with their marks tied to the survey's images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats.odm import GroundMark, read_ground_points
from pipelines.geodesy.crs import parse_crs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.ingest.image_names import ImageNames
from pipelines.ingest.image_poses import PoseOptions, note_operation, settle_vertical
from pipelines.ingest.notes import Notes
from pipelines.scene.survey import Mark

_LEAST_MARKS = 2
# Two names at one place are one point; a point this far from the cameras is in another country.
_SAME_PLACE_M = 1e-3
_RANGE_M = 50_000.0


@dataclass(frozen=True)
class GroundPoint:
    """A surveyed point: WGS84 position (3,), its marks, and the line where it first stands."""

    name: str
    lla: FloatArray
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
    path: Path, sizes: Mapping[str, tuple[int, int]], sigma_px: float, options: PoseOptions, notes: Notes
) -> GroundFile:
    """Read a `gcp_list.txt` and tie it to images.

    Marks in images that are not here are left out and noted, and so are points with fewer than two marks left.

    Args:
        path: the file.
        sizes: width and height of each image by name.
        sigma_px: σ of a mark.
        options: for the vertical datum.
        notes: what was left out.

    Raises:
        InputError: a malformed file, one name at two places, two marks of a point in one image, a mark outside its
            image, impossible coordinates, or no mark in any image here.
    """
    listed = read_ground_points(path)
    crs = parse_crs(listed.crs_text, vertical=options.vertical, path=path, line=1)
    settle_vertical(crs, options, path.name, notes)
    first = _first_lines(listed.marks, path)
    xyz = np.array([mark.xyz for mark in first.values()])
    lla = crs.lla_from_xyz(xyz, path=path, lines=[mark.line for mark in first.values()])
    note_operation(crs, lla, notes)
    marks = _marks_by_point(listed.marks, sizes, sigma_px, path, notes)
    points, lonely = [], []
    for row, (name, mark) in enumerate(first.items()):
        if len(marks[name]) < _LEAST_MARKS:
            lonely.append(f"{name} ({path.name}:{mark.line})")
        else:
            points.append(GroundPoint(name, lla[row], tuple(marks[name].values()), mark.line))
    notes.warn_counted(
        lonely,
        "ground point has marks in fewer than 2 images and was left out",
        "ground points have marks in fewer than 2 images and were left out",
    )
    return GroundFile(path, crs.name, crs.vertical, tuple(points))


def split_checks(
    control: GroundFile | None, check: GroundFile | None, names: Sequence[str]
) -> tuple[tuple[GroundPoint, ...], tuple[GroundPoint, ...]]:
    """Control and check points, after making check points of the control points in `names`.

    Raises:
        InputError: a name that is no control point, or a point that is both.
    """
    points = () if control is None else control.points
    known = {point.name for point in points}
    for name in names:
        if name not in known:
            message = f"{name!r} is no usable point there: it has {', '.join(sorted(known))}"
            raise InputError(message, path=None if control is None else control.path, field="--check")
    listed = () if check is None else check.points
    for point in listed:
        twin = next((one for one in points if one.name == point.name or _apart_m(one, point) < _SAME_PLACE_M), None)
        if check is not None and twin is not None:
            message = (
                f"{point.name} is also control point {twin.name} (line {twin.line}): it can be one of them only"
            )
            raise InputError(message, path=check.path, line=point.line)
    kept = tuple(point for point in points if point.name not in names)
    return kept, (*listed, *(point for point in points if point.name in names))


def require_near(file: GroundFile | None, middle_lla: FloatArray) -> None:
    """Refuse points that are nowhere near the cameras, whose middle is `middle_lla` (3,).

    Raises:
        InputError: a point more than 50 km away.
    """
    for point in () if file is None else file.points:
        distance_m = float(np.linalg.norm(ecef_from_lla(point.lla) - ecef_from_lla(middle_lla)))
        if file is not None and distance_m > _RANGE_M:
            message = f"{point.name} is {distance_m / 1000:.0f} km from the images: wrong CRS, or x and y swapped?"
            raise InputError(message, path=file.path, line=point.line)


def _apart_m(first: GroundPoint, second: GroundPoint) -> float:
    return float(np.linalg.norm(ecef_from_lla(first.lla) - ecef_from_lla(second.lla)))


def _first_lines(marks: tuple[GroundMark, ...], path: Path) -> dict[str, GroundMark]:
    """The first line of each point."""
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
    """Marks by point and image."""
    names = ImageNames(sizes)
    found: dict[str, dict[str, Mark]] = {mark.name: {} for mark in listed}
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
        if image in found[mark.name]:
            raise InputError(f"{mark.name} is marked in {image} already", path=path, line=mark.line, field="image")
        found[mark.name][image] = Mark(image=image, x_px=mark.x_px, y_px=mark.y_px, sigma_px=sigma_px)
    if len(unknown) == len(listed):
        message = f"names none of the images: it has {listed[0].image!r} …, the folder {min(sizes)!r} …"
        raise InputError(message, path=path, field="image")
    notes.warn_counted(unknown, "mark is in an image that is not here", "marks are in images that are not here")
    return found
