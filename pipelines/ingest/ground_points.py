"""Control and check points on Earth, with their marks tied to the survey's images.

Files of ground points, each read as what its content shows it to be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats import ground_points, metashape
from pipelines.formats.ground_points import GroundPoints, ListedMark, read_marks
from pipelines.formats.tables import beginning, is_number, separator_of, split
from pipelines.geodesy.crs import PointCrs, parse_crs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.geodesy.operations import WGS84
from pipelines.geodesy.vertical import VerticalDatum
from pipelines.ingest.notes import Notes, shortened
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.photo_folder import ImageNames
from pipelines.ingest.reference_system import note_operation, stated_crs
from pipelines.survey.survey import Mark


def read_ground_points(path: Path, notes: Notes) -> GroundPoints:
    """Read ground points; the kind of the file follows from its content, and is noted.

    1. XML: Metashape's markers.
    2. A line that begins with `#Label`: Metashape's reference.
    3. A first line of four or more cells between commas, semicolons or tabs: PIX4D's table of points.
    4. Anything else: OpenDroneMap's `gcp_list.txt`.

    Raises:
        InputError: the file cannot be read as what it seems to be.
    """
    head = beginning(path)
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    if head.lstrip().startswith("<"):
        listed = metashape.read_markers_xml(path)
    elif any(metashape.HEADER.match(line) for line in lines):
        listed = metashape.read_markers(path)
    elif _begins_a_table([line for line in lines if not line.startswith("#")], path):
        listed = ground_points.read_point_table(path)
    else:
        return ground_points.read_ground_points(path)
    notes.assume(f"{path.name} is read as {listed.kind}")
    notes.warn_counted(
        [f"{path.name} ({name})" for name in listed.unknown_columns],
        "column is unknown and was ignored",
        "columns are unknown and were ignored",
    )
    notes.warn_counted(
        list(listed.left_out),
        "mark is not pinned, so placed by Metashape itself, and was left out",
        "marks are not pinned, so placed by Metashape itself, and were left out",
    )
    checks = [point.name for point in listed.points if point.is_check]
    if checks:
        notes.assume(f"points that are not enabled in {path.name} are check points: {shortened(checks)}")
    return listed


def crs_of_points(listed: GroundPoints, options: IngestOptions, notes: Notes) -> PointCrs:
    """Return the CRS of ground points: that of their file, else `--gcp-crs`, else WGS84 for latitude and longitude.

    Raises:
        InputError: the CRS is none, or none is named.
    """
    path = listed.path
    if listed.crs_text is not None:
        if options.gcp_crs is not None:
            notes.assume(f"{path.name} states its CRS; --gcp-crs does not apply to it")
        return stated_crs(listed.crs_text, path, options, notes, line=listed.crs_line)
    if options.gcp_crs is not None:
        crs = parse_crs(options.gcp_crs, vertical=options.vertical, field="--gcp-crs")
    elif listed.geographic:
        notes.assume(f"latitude and longitude in {path.name} are WGS84 ({WGS84})")
        crs = parse_crs(WGS84, vertical=options.vertical)
    else:
        raise InputError(f"{path.name} states no CRS: give it, e.g. EPSG:32632 or EPSG:4326", field="--gcp-crs")
    if listed.geographic and not crs.is_geographic:
        raise InputError(f"{path.name} has latitude and longitude, but {crs.name} has none", field="--gcp-crs")
    return crs


def east_first(listed: GroundPoints, crs: PointCrs, notes: Notes) -> FloatArray:
    """Return coordinates (J, 3) with the easting or longitude first; the order that was assumed is noted."""
    xyz = np.array([point.xyz for point in listed.points]).reshape(-1, 3)
    first, second = ("latitude", "longitude") if crs.is_geographic else ("northing", "easting")
    if listed.in_order_of_crs:
        order = (first, second) if crs.northing_first else (second, first)
        notes.assume(
            f"{listed.path.name} has no header: the {order[0]} stands before the {order[1]}, as in the definition "
            f"of {crs.name}"
        )
        return xyz[:, [1, 0, 2]] if crs.northing_first else xyz
    if crs.northing_first and not listed.geographic and not crs.is_geographic:
        notes.assume(f"x in {listed.path.name} is the easting, although {crs.name} has the northing first")
    return xyz


def _begins_a_table(lines: list[str], path: Path) -> bool:
    """Return whether the first line is a row or header of a table, and not a CRS, which may have commas too."""
    if not lines or any(sign in lines[0] for sign in '["=+'):
        return False
    separator = separator_of(lines[0])
    cells = [] if separator is None else split(lines[0], separator, path=path, line=1)
    return len(cells) >= 4 and (all(map(is_number, cells[1:4])) or not any(map(is_number, cells)))


_LEAST_MARKS = 2
# Two names at one place are one point; a point this far from the cameras is in another country.
_SAME_PLACE_M = 1e-3
_RANGE_M = 50_000.0

Use = Literal["control", "check"]


@dataclass(frozen=True)
class GroundPoint:
    """A surveyed point.

    Attributes:
        name: of the point.
        position_in_ecef: (3,) metres.
        marks: of the point, in images that are here.
        line: where the point first stands.
        sigma_h_m: horizontal σ of the file; None: it states none.
        sigma_v_m: vertical σ.
        is_check: whether the file calls it a check point.
    """

    name: str
    position_in_ecef: FloatArray
    marks: tuple[Mark, ...]
    line: int
    sigma_h_m: float | None = None
    sigma_v_m: float | None = None
    is_check: bool = False

    @property
    def is_marked(self) -> bool:
        """Whether the marks place the point."""
        return len(self.marks) >= _LEAST_MARKS


UnmarkedPoints = Mapping[Use, tuple[GroundPoint, ...]]


@dataclass(frozen=True)
class GroundFile:
    """The points of one file."""

    path: Path
    crs_name: str
    vertical: VerticalDatum
    points: tuple[GroundPoint, ...]


@dataclass(frozen=True)
class SortedPoints:
    """The points of a survey by use: those that are marked, and those that have too few marks."""

    control: tuple[GroundPoint, ...]
    check: tuple[GroundPoint, ...]
    unmarked: UnmarkedPoints

    def require_checks(self, names: Sequence[str]) -> None:
        """Refuse names of points under vegetation that are no check points.

        Raises:
            InputError: a name that no check point has.
        """
        checks = {point.name for point in (*self.check, *self.unmarked["check"])}
        for name in names:
            if name not in checks:
                raise InputError(
                    f"{name!r} is no check point: there are {', '.join(sorted(checks)) or 'none'} (--checkpoints, "
                    "--check)",
                    field="--vegetated",
                )

    def note_unmarked(self, notes: Notes) -> None:
        """Note the points that enter nothing."""
        notes.warn_counted(
            [f"{point.name} ({use})" for use, points in self.unmarked.items() for point in points],
            "ground point has marks in fewer than 2 images, and enters nothing until it is marked",
            "ground points have marks in fewer than 2 images, and enter nothing until they are marked",
        )


@dataclass(frozen=True)
class PlacedPoints:
    """Points of a file with their places, not yet tied to images.

    Attributes:
        listed: as the file has them.
        crs: of the file.
        position_in_ecef: (J, 3) metres.
    """

    listed: GroundPoints
    crs: PointCrs
    position_in_ecef: FloatArray


@dataclass(frozen=True)
class ListedGround:
    """Control and check points as their files list them, and the marks of a table of marks."""

    control: PlacedPoints | None
    check: PlacedPoints | None
    marks: tuple[ListedMark, ...]


def list_ground_points(options: IngestOptions, notes: Notes) -> ListedGround:
    """Read the files of control and check points, and the table of marks.

    Marks of the table that name no point are noted.

    Args:
        options: the files, CRS and vertical datum.
        notes: what was assumed and left out.

    Raises:
        InputError: a malformed file, no CRS, one name at two places, or impossible coordinates.
    """
    control, check = (
        None if path is None else _placed(read_ground_points(path, notes), options, notes)
        for path in (options.gcp, options.checkpoints)
    )
    marks = () if options.marks is None else read_marks(options.marks)
    known = {point.name for file in (control, check) if file is not None for point in file.listed.points}
    name = "" if options.marks is None else options.marks.name
    notes.warn_counted(
        [f"{name}:{mark.line} ({mark.name})" for mark in marks if mark.name not in known],
        "mark names no ground point",
        "marks name no ground point",
    )
    return ListedGround(control, check, marks)


def tie_ground_points(
    ground: ListedGround, sizes: Mapping[str, tuple[int, int]], options: IngestOptions, notes: Notes
) -> tuple[GroundFile | None, GroundFile | None]:
    """Return control and check points with their marks in the images; marks in images that are not here are noted.

    Args:
        ground: as listed.
        sizes: width and height of each image by name.
        options: σ of a mark.
        notes: what was left out.

    Raises:
        InputError: two marks of a point in one image, a mark outside its image, or no mark in any image here.
    """
    ties = _Ties(sizes, options, notes)
    control, check = (
        None if file is None else _ground_file(file, ground.marks, ties) for file in (ground.control, ground.check)
    )
    return control, check


def split_checks(control: GroundFile | None, check: GroundFile | None, names: Sequence[str]) -> SortedPoints:
    """Return control and check points; those of `names`, and those that the file calls so, are check points.

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
    kept = tuple(point for point in points if point.name not in names and not point.is_check)
    checks = (*listed, *(point for point in points if point.name in names or point.is_check))
    return SortedPoints(
        control=tuple(point for point in kept if point.is_marked),
        check=tuple(point for point in checks if point.is_marked),
        unmarked={
            "control": tuple(point for point in kept if not point.is_marked),
            "check": tuple(point for point in checks if not point.is_marked),
        },
    )


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


@dataclass(frozen=True)
class _Ties:
    """What ties marks to images: sizes by name, the σ of a mark, and where to note what does not fit."""

    sizes: Mapping[str, tuple[int, int]]
    options: IngestOptions
    notes: Notes


def _placed(listed: GroundPoints, options: IngestOptions, notes: Notes) -> PlacedPoints:
    crs = crs_of_points(listed, options, notes)
    xyz = east_first(listed, crs, notes)
    lla = crs.lla_from_xyz(xyz, path=listed.path, lines=[point.line for point in listed.points])
    note_operation(crs, lla, notes)
    return PlacedPoints(listed, crs, ecef_from_lla(lla))


def _ground_file(placed: PlacedPoints, apart: Sequence[ListedMark], ties: _Ties) -> GroundFile:
    """Return the points of a file with its own marks and those of the table of marks."""
    listed = placed.listed
    marks: dict[str, dict[str, Mark]] = {point.name: {} for point in listed.points}
    _add_marks(marks, listed.marks, listed.path, ties)
    if ties.options.marks is not None:
        _add_marks(marks, [mark for mark in apart if mark.name in marks], ties.options.marks, ties)
    points = tuple(
        GroundPoint(
            name=point.name,
            position_in_ecef=position,
            marks=tuple(marks[point.name].values()),
            line=point.line,
            sigma_h_m=point.sigma_h_m,
            sigma_v_m=point.sigma_v_m,
            is_check=point.is_check,
        )
        for point, position in zip(listed.points, placed.position_in_ecef, strict=True)
    )
    return GroundFile(listed.path, placed.crs.name, placed.crs.vertical, points)


def _add_marks(marks: dict[str, dict[str, Mark]], listed: Sequence[ListedMark], path: Path, ties: _Ties) -> None:
    """Add the marks of a file, by point and image."""
    names = ImageNames(ties.sizes)
    unknown = []
    for mark in listed:
        image = names.find(mark.image, path=path, line=mark.line)
        if image is None:
            unknown.append(f"{path.name}:{mark.line} ({mark.image})")
            continue
        width, height = ties.sizes[image]
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
        sigma_px = ties.options.sigma_mark
        marks[mark.name][image] = Mark(image=image, x_px=mark.x_px, y_px=mark.y_px, sigma_px=sigma_px)
    if listed and len(unknown) == len(listed):
        message = f"names none of the images: it has {listed[0].image!r} …, the folder {min(ties.sizes)!r} …"
        raise InputError(message, path=path, field="image")
    ties.notes.warn_counted(
        unknown, "mark is in an image that is not here", "marks are in images that are not here"
    )
