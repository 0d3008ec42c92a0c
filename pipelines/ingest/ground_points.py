"""Control and check points on Earth, out of files recognised by their content, with marks tied to the images.

Marks made on photographs as EXIF's orientation shows them are brought to the pixels as they are stored: browsers
and most programs for marking turn a photograph as EXIF says; cameras, COLMAP and this program count pixels as they
are stored (EXIF 2.32, tag 0x0112).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import FloatArray
from pipelines.formats import ground_points, metashape, opf
from pipelines.formats.ground_points import GroundPoints, ListedMark
from pipelines.formats.tables import beginning, is_number, separator_of, split
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import ecef_from_lla
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.reference_system import (
    crs_of_points,
    east_first,
    in_units_of,
    is_projected,
    note_operation,
    note_unread,
    require_heights,
)
from pipelines.ingest.remarks import Remarks, shortened
from pipelines.ingest.targets import Targets
from pipelines.survey.image_names import ImageNames
from pipelines.survey.survey import KnownDistance, Mark, PointMarks

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
            remarks.warn("no-mark-turned", "EXIF turns no marked photograph.", "--marks-as-shown changes nothing.")
        elif self.as_shown:
            remarks.assume("marks-as-shown", f"{where} were made on the pictures as shown: they are turned back.")
        elif self.marks:
            remarks.warn(
                "marks-as-stored",
                f"{where} ({shortened(sorted(self.images))}) are read in pixels as stored.",
                "If they were made on the pictures as shown, give --marks-as-shown.",
            )


_LEAST_MARKS = 2
# Two names at one place are one point; a point this far from the cameras is in another country.
_SAME_PLACE_M = 1e-3
_RANGE_M = 50_000.0

Use = Literal["control", "check"]
Kind = Literal["control points", "check points"]
_CONTROL: Kind = "control points"
_CHECK: Kind = "check points"

_FEWEST_FRACTIONS = 3  # marks, of which all lie within the first pixel


@dataclass(frozen=True)
class GroundPoint:
    """A surveyed point (3,) in ECEF: the line where it first stands, σ if stated, marks in images that are here."""

    name: str
    position_in_ecef: FloatArray
    line: int
    sigma_h_m: float | None
    sigma_v_m: float | None
    is_check: bool
    marks: tuple[Mark, ...] = ()

    @property
    def is_marked(self) -> bool:
        """Whether the marks place the point."""
        return len(self.marks) >= _LEAST_MARKS


@dataclass(frozen=True)
class GroundFile:
    """The points of a file, their CRS, and their marks as listed, by file: in it, or in a table of marks."""

    path: Path
    crs: PointCrs
    points: tuple[GroundPoint, ...]
    listed_marks: tuple[tuple[Path, Sequence[ListedMark]], ...]


def read_ground_files(options: IngestOptions, remarks: Remarks) -> tuple[GroundFile | None, GroundFile | None]:
    """Return control and check points on Earth, not yet tied to images.

    Marks of the table of marks that name no point are noted.

    Raises:
        InputError: a malformed file, no CRS, one name at two places, or impossible coordinates.
    """
    control, check = (
        None if path is None else _placed(_recognised(path, options, remarks), of, options, remarks)
        for path, of in ((options.gcp, _CONTROL), (options.checkpoints, _CHECK))
    )
    if options.marks is None:
        return control, check
    marks = ground_points.read_marks(options.marks)
    known = {point.name for file in (control, check) if file is not None for point in file.points}
    known |= ends_of(options)
    remarks.warn_counted(
        "mark-of-unknown-point",
        [f"{options.marks.name}:{mark.line} ({mark.name})" for mark in marks if mark.name not in known],
        "Marks name no ground point",
    )
    return (
        None if control is None else _with_table_of_marks(control, options.marks, marks),
        None if check is None else _with_table_of_marks(check, options.marks, marks),
    )


def ends_of(options: IngestOptions) -> set[str]:
    """Return the names of the ends of measured distances."""
    if options.distances is None:
        return set()
    return {name for distance in ground_points.read_distances(options.distances) for name in distance.ends}


def _with_table_of_marks(file: GroundFile, path: Path, marks: Sequence[ListedMark]) -> GroundFile:
    names = {point.name for point in file.points}
    of_file = tuple(mark for mark in marks if mark.name in names)
    return replace(file, listed_marks=(*file.listed_marks, (path, of_file)))


def _recognised(path: Path, options: IngestOptions, remarks: Remarks) -> GroundPoints:
    """Read ground points; the kind of the file follows from its content, and is noted.

    1. JSON of an OPF project: its control points.
    2. XML: Metashape's markers.
    3. A line that begins with `#Label`: Metashape's reference.
    4. A first line of four or more cells between commas, semicolons or tabs: PIX4D's table of points.
    5. A row of four cells between spaces, the last three numbers: a list of points.
    6. Anything else: OpenDroneMap's `gcp_list.txt`.
    """
    head = beginning(path)
    lines = [line.strip() for line in head.splitlines() if line.strip()]
    if head.lstrip().startswith("{") and opf.PROJECT in head:
        listed = opf.read_opf_points(path)
    elif head.lstrip().startswith("<"):
        listed = metashape.read_markers_xml(path)
    elif any(metashape.HEADER.match(line) for line in lines):
        listed = metashape.read_markers(path)
    elif _begins_a_table([line for line in lines if not line.startswith("#")], path):
        listed = ground_points.read_point_table(path, projected=is_projected(options.gcp_crs, "--gcp-crs"))
    elif ground_points.is_point_list(lines):
        listed = ground_points.read_point_list(path)
    else:
        return ground_points.read_ground_points(path)
    remarks.assume("file-kind", f"{path.name} is read as {listed.kind}.")
    remarks.warn_counted(
        "unknown-column",
        [f"{path.name} ({name})" for name in listed.unknown_columns],
        "Columns are unknown and are ignored",
    )
    note_unread(listed, remarks)
    remarks.warn_counted(
        "mark-not-pinned", listed.left_out, "Marks that are not pinned (Metashape set them itself) are left out"
    )
    checks = [point.name for point in listed.points if point.is_check]
    if checks:
        remarks.assume(
            "points-not-enabled",
            f"Points that are not enabled in {path.name} are check points: {shortened(checks)}.",
        )
    return listed


def _begins_a_table(lines: list[str], path: Path) -> bool:
    """Return whether the first line is a row or header of a table, and not a CRS, which may have commas too."""
    if not lines or any(sign in lines[0] for sign in '["=+'):
        return False
    separator = separator_of(lines[0])
    cells = [] if separator is None else split(lines[0], separator, path=path, line=1)
    return len(cells) >= 4 and (all(map(is_number, cells[1:4])) or not any(map(is_number, cells)))


def _placed(listed: GroundPoints, of: Kind, options: IngestOptions, remarks: Remarks) -> GroundFile:
    crs = crs_of_points(listed, options, remarks)
    xyz = in_units_of(crs, east_first(listed, crs, remarks), listed)
    lines = [point.line for point in listed.points]
    lla = crs.lla_from_xyz(xyz, path=listed.path, lines=lines)
    require_heights(lla, listed.path, lines)
    note_operation(crs, lla, listed.path, of, remarks)
    points = tuple(
        GroundPoint(point.name, position, point.line, point.sigma_h_m, point.sigma_v_m, point.is_check)
        for point, position in zip(listed.points, ecef_from_lla(lla), strict=True)
    )
    return GroundFile(listed.path, crs, points, ((listed.path, listed.marks),))


def tie_marks(
    file: GroundFile,
    sizes: Mapping[str, tuple[int, int]],
    sigma_px: float,
    remarks: Remarks,
    targets: Targets | None = None,
    *,
    marking: ShownMarks | None = None,
) -> GroundFile:
    """Return the points of a file with their marks in the images; marks in images that are not here are noted.

    `sizes` has width and height of each image by name. `targets` are marks where the file has none. `marking` turns
    marks that were made on pictures as shown.

    Raises:
        InputError: two marks of a point in one image, a mark outside its image, or no mark in any image here.
    """
    marks = _tied(
        [point.name for point in file.points],
        file.listed_marks,
        sizes,
        sigma_px,
        remarks,
        targets=targets,
        marking=marking or ShownMarks(),
    )
    return replace(file, points=tuple(replace(point, marks=marks[point.name]) for point in file.points))


def _tied(
    points: Sequence[str],
    listed_marks: Sequence[tuple[Path, Sequence[ListedMark]]],
    sizes: Mapping[str, tuple[int, int]],
    sigma_px: float,
    remarks: Remarks,
    *,
    targets: Targets | None,
    marking: ShownMarks,
) -> dict[str, tuple[Mark, ...]]:
    """Return the marks of points by name; raises as `tie_marks`."""
    names = ImageNames(sizes)
    marks: dict[str, dict[str, Mark]] = {name: {} for name in points}
    for path, listed in listed_marks:
        unknown = []
        for mark in listed:
            image = names.find(mark.image, path=path, line=mark.line)
            if image is None:
                unknown.append(f"{path.name}:{mark.line} ({mark.image})")
                continue
            (width, height), fault = sizes[image], partial(InputError, path=path, line=mark.line)
            x_px, y_px = marking.stored(image, mark.x_px, mark.y_px, sizes[image])
            if not (0.0 <= x_px <= width and 0.0 <= y_px <= height):
                turned = marking.why_outside(image, mark.x_px, mark.y_px, sizes[image])
                raise fault(
                    "mark-outside-image" if turned is None else "mark-on-turned-picture",
                    f"The mark of {mark.name} at ({mark.x_px:g}, {mark.y_px:g}) lies outside {image} "
                    f"({width}×{height} px). {turned or 'Was it made on an image of another size?'}",
                    field="px py",
                )
            if image in marks[mark.name]:
                raise fault("mark-twice", f"{mark.name} is already marked in {image}.", field="image")
            marks[mark.name][image] = Mark(image=image, x_px=x_px, y_px=y_px, sigma_px=mark.sigma_px or sigma_px)
        if listed and len(unknown) == len(listed):
            raise InputError(
                "no-image-matched",
                f"The file names none of the images: it has {listed[0].image!r} …, the folder {min(sizes)!r} …",
                path=path,
                field="image",
            )
        _require_pixels(path, listed, sizes)
        remarks.warn_counted("mark-in-unknown-image", unknown, "Marks are in images that are not here")
    by_hand = {name: tuple(of_point.values()) for name, of_point in marks.items()}
    return by_hand if targets is None else {name: targets.beside(name, mine) for name, mine in by_hand.items()}


def _require_pixels(path: Path, listed: Sequence[ListedMark], sizes: Mapping[str, tuple[int, int]]) -> None:
    """Refuse marks all of which lie within the first pixel: they are fractions of the image's sides."""
    within = all(mark.x_px <= 1.0 and mark.y_px <= 1.0 for mark in listed)
    if len(listed) >= _FEWEST_FRACTIONS and within and min(map(min, sizes.values())) > 2:
        raise InputError(
            "marks-are-fractions",
            (
                f"All {len(listed)} marks lie within the first pixel of their images: they are fractions of the "
                "width and height."
            ),
            path=path,
            field="px py",
            remedy="Write them in pixels.",
        )


def known_distances(
    options: IngestOptions,
    files: Sequence[GroundFile | None],
    sizes: Mapping[str, tuple[int, int]],
    remarks: Remarks,
    targets: Targets | None = None,
    *,
    marking: ShownMarks | None = None,
) -> tuple[KnownDistance, ...]:
    """Return the measured distances of `--distances`, whose ends are points of files, of `--marks`, or targets.

    Raises:
        InputError: a malformed file, or an end with marks in fewer than two images.
    """
    if options.distances is None:
        return ()
    listed = ground_points.read_distances(options.distances)
    marks = {point.name: point.marks for file in files if file is not None for point in file.points}
    others = sorted({name for distance in listed for name in distance.ends} - marks.keys())
    listed_marks: list[tuple[Path, Sequence[ListedMark]]] = []
    if others and options.marks is not None:
        of_ends = tuple(mark for mark in ground_points.read_marks(options.marks) if mark.name in others)
        listed_marks.append((options.marks, of_ends))
    marks |= _tied(
        others,
        listed_marks,
        sizes,
        options.sigma_mark,
        remarks,
        targets=targets,
        marking=marking or ShownMarks(),
    )
    for distance in listed:
        for end, name in zip(("from", "to"), distance.ends, strict=True):
            if len(marks[name]) < _LEAST_MARKS:
                raise InputError(
                    "distance-end-unmarked",
                    f"{name} has marks in {len(marks[name])} images.",
                    path=options.distances,
                    line=distance.line,
                    field=end,
                    remedy="Mark it in two or more: --marks.",
                )
    silent = sum(distance.sigma_m is None for distance in listed)
    if silent:
        remarks.assume(
            "default-distance-sigma",
            f"{silent} distances have a σ of {options.sigma_distance:g} m.",
            "State it in the file, or with --sigma-distance.",
        )
    return tuple(
        KnownDistance(
            ends=(_marked(distance.ends[0], marks), _marked(distance.ends[1], marks)),
            distance_m=distance.distance_m,
            sigma_m=distance.sigma_m or options.sigma_distance,
            use="check" if distance.is_check else "control",
        )
        for distance in listed
    )


def _marked(name: str, marks: Mapping[str, tuple[Mark, ...]]) -> PointMarks:
    return PointMarks(name=name, marks=marks[name])


def split_checks(
    control: GroundFile | None, check: GroundFile | None, names: Sequence[str]
) -> tuple[tuple[GroundPoint, ...], tuple[GroundPoint, ...]]:
    """Return control and check points; those of `names`, and those that the file calls so, are check points.

    Raises:
        InputError: a name that is no control point, or a point that is both.
    """
    points = () if control is None else control.points
    usable = {point.name for point in points}
    for name in names:
        if name not in usable:
            raise InputError(
                "check-not-a-point",
                f"{name!r} is no control point with coordinates: the file has {', '.join(sorted(usable))}.",
                path=None if control is None else control.path,
                field="--check",
            )
    listed = () if check is None else check.points
    for point in listed:
        twin = next((other for other in points if _are_one(other, point)), None)
        if check is not None and twin is not None:
            raise InputError(
                "point-control-and-check",
                f"{point.name} is also control point {twin.name} (line {twin.line}).",
                path=check.path,
                line=point.line,
                remedy="Remove one of them.",
            )
    moved = [point.name in names or point.is_check for point in points]
    kept = tuple(point for point, is_check in zip(points, moved, strict=True) if not is_check)
    return kept, (*listed, *(point for point, is_check in zip(points, moved, strict=True) if is_check))


def unmarked_points(
    control: Sequence[GroundPoint], check: Sequence[GroundPoint], remarks: Remarks
) -> dict[Use, list[GroundPoint]]:
    """Return the points whose marks do not place them, by use; they are noted, as they enter nothing."""
    points: dict[Use, list[GroundPoint]] = {
        "control": [point for point in control if not point.is_marked],
        "check": [point for point in check if not point.is_marked],
    }
    remarks.warn_counted(
        "point-unmarked",
        [f"{point.name} ({use})" for use, of_use in points.items() for point in of_use],
        "Ground points with marks in fewer than 2 images are not used until they are marked",
    )
    return points


def _are_one(first: GroundPoint, second: GroundPoint) -> bool:
    """Return whether two points have one name or one place."""
    distance_m = float(np.linalg.norm(first.position_in_ecef - second.position_in_ecef))
    return first.name == second.name or distance_m < _SAME_PLACE_M


def require_near(file: GroundFile, middle_in_ecef: FloatArray) -> None:
    """Refuse a file with a point more than 50 km from the cameras, whose middle is (3,) in ECEF."""
    for point in file.points:
        distance_m = float(np.linalg.norm(point.position_in_ecef - middle_in_ecef))
        if distance_m > _RANGE_M:
            raise InputError(
                "point-far-away",
                f"{point.name} is {distance_m / 1000:.0f} km from the images. Is the CRS wrong, or are x and y "
                "swapped?",
                path=file.path,
                line=point.line,
            )
