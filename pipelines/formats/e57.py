"""E57 files (ASTM E2807): scans of terrestrial scanners, read in chunks and placed by their poses.

The XML section is read first, by a parser without entities: what it promises is compared with the size of the file
before libE57Format decodes a point. Cartesian and spherical coordinates are read, of any type of number. A point
whose scan calls it invalid, or that has no range, is what the scanner has not met.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.extras import require
from pipelines.core.files import file_size, reading
from pipelines.core.types import FloatArray
from pipelines.formats.cloud_ply import CloudChunk, check_precision
from pipelines.geodesy.geotiff_keys import FileCrs
from pipelines.geometry.rotations import matrix_from_quat_xyzw

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_HEADER = struct.Struct("<8sIIQQQQ")  # signature, version (2), bytes of the file, place and length of the XML, page
_SIGNATURE, _PAGE, _CHECKSUM = b"ASTM-E57", 1024, 4
_MOST_XML = 64 * 1024 * 1024
_MOST_SCANS = 100_000
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_LARGEST_CRS = 100_000  # characters

_E57File = Any  # pye57.libe57.ImageFile


@dataclass(frozen=True)
class Scan:
    """Scan of a file: p_file = R p_scan + t. `fields` are those of its points, `single` whether in 32 bits."""

    number: int
    count: int
    fields: frozenset[str]
    single: bool
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))  # (3, 3)
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))  # (3,)

    @property
    def coordinates(self) -> tuple[str, ...]:
        return _CARTESIAN if self.fields.issuperset(_CARTESIAN) else _SPHERICAL

    @property
    def validity(self) -> str:
        """Name of the field that says which points are invalid; empty: none does."""
        name = "cartesianInvalidState" if self.coordinates == _CARTESIAN else "sphericalInvalidState"
        return name if name in self.fields else ""


@dataclass(frozen=True)
class E57File:
    """E57 file whose header has been checked; see `CloudFile`."""

    path: Path
    count: int
    crs: FileCrs
    scans: tuple[Scan, ...]

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """Yield the points of all scans in chunks of at most `size`; those that are invalid count as withheld.

        Raises:
            InputError: the file is damaged, or its coordinates are too large for the precision of their type.
        """
        from pye57 import libe57

        try:
            file = libe57.ImageFile(str(self.path), "r")
        except Exception as error:
            raise _damaged(self.path, error) from error
        try:
            for scan in self.scans:
                yield from self._chunks_of(file, scan, size)
        finally:
            file.close()

    def _chunks_of(self, file: _E57File, scan: Scan, size: int) -> Iterator[CloudChunk]:
        from pye57 import libe57

        capacity, done = min(size, scan.count), 0
        names = (*scan.coordinates, *((scan.validity,) if scan.validity else ()))
        columns = {name: np.empty(capacity, np.int8 if name == scan.validity else np.float64) for name in names}
        try:
            buffers = libe57.VectorSourceDestBuffer()
            for name, column in columns.items():
                buffers.append(libe57.SourceDestBuffer(file, name, column, capacity, True, True))
            reader = file.root()["data3D"][scan.number]["points"].reader(buffers)
            while read := int(reader.read()):
                done += read
                yield self._chunk(scan, {name: column[:read] for name, column in columns.items()})
            reader.close()
        except (InputError, GeneratorExit):
            raise
        except Exception as error:
            raise _damaged(self.path, error) from error
        if done != scan.count:
            message = f"Scan {scan.number} promises {scan.count} points, the file holds {done}."
            raise InputError("size-differs", message, path=self.path)

    def _chunk(self, scan: Scan, columns: dict[str, np.ndarray]) -> CloudChunk:
        local = np.column_stack([columns[name] for name in scan.coordinates])
        is_range = scan.coordinates == _SPHERICAL
        met = np.isfinite(local).all(axis=1) & (local[:, 0] > 0 if is_range else local.any(axis=1))
        if scan.validity:
            met &= columns[scan.validity] == 0
        local[~met] = 0.0
        if scan.single:
            check_precision(local[:, :1] if is_range else local, np.float32, self.path)
        cartesian = _from_spherical(local) if is_range else local
        in_file = cartesian @ scan.rotation.T + scan.translation
        return CloudChunk(in_file, np.zeros(len(met), np.uint8), np.zeros(len(met), bool), ~met, None)


def open_e57(path: Path) -> E57File:
    """Return an E57 file whose statements agree with its size.

    Raises:
        InputError: no such file, not a readable E57 file, or one without points.
        BackendUnavailableError: pye57 is missing; names the extra.

    Examples:
        >>> import pye57
        >>> scan = pye57.E57("scan.e57", mode="w")
        >>> places = np.array([[10.0, 20.0, 498.5], [10.5, 20.0, 498.75]])
        >>> scan.write_scan_raw({f"cartesian{axis}": places[:, at] for at, axis in enumerate("XYZ")})
        >>> scan.close()
        >>> file = open_e57(Path("scan.e57"))
        >>> file.count, next(file.chunks(1000)).position.tolist()
        (2, [[10.0, 20.0, 498.5], [10.5, 20.0, 498.75]])
    """
    require("scans")
    size = file_size(path)
    root = _xml_of(path, size)
    scans = [_scan(path, number, element) for number, element in enumerate(_children(root, "data3D"))]
    if len(scans) > _MOST_SCANS:
        raise InputError("too-many-scans", f"The file has {len(scans)} scans (limit {_MOST_SCANS}).", path=path)
    bits = sum(scan.count * width for scan, width in scans)
    count = sum(scan.count for scan, _ in scans)
    if count < 1 or bits > 8 * size:
        message = f"The scans promise {count} points of {bits // 8} bytes in all, the file has {size}."
        raise InputError("size-differs", f"{message} It is empty, cut off or damaged.", path=path)
    text = " ".join(_text(root, "coordinateMetadata").split())
    crs = FileCrs(wkt=text if len(text) <= _LARGEST_CRS else "")
    return E57File(path, count, crs, tuple(scan for scan, _ in scans if scan.count))


def _xml_of(path: Path, size: int) -> Element:
    """Return the root of the XML section, which lies on pages that end with a checksum."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.ElementTree import ParseError, fromstring

    with reading(path), path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or not head.startswith(_SIGNATURE):
            raise InputError("not-an-e57", "The file is not an E57 file.", path=path)
        _, _, _, stated, offset, length, page = _HEADER.unpack(head)
        pages = math.ceil((length + offset % _PAGE) / (_PAGE - _CHECKSUM))
        if page != _PAGE or length > _MOST_XML or offset + length > size:
            message = (
                f"The header states {stated} bytes and XML of {length} bytes at {offset}; the file has {size}."
            )
            raise InputError("size-differs", f"{message} It is cut off, damaged or too large.", path=path)
        start = offset // _PAGE * _PAGE
        file.seek(start)
        data = file.read(pages * _PAGE)
    logical = b"".join(data[at : at + _PAGE - _CHECKSUM] for at in range(0, len(data), _PAGE))
    text = logical[offset - start : offset - start + length]
    try:
        root: Element = fromstring(text, forbid_dtd=True)
    except (ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise _damaged(path, error) from error
    return root


def _scan(path: Path, number: int, element: Element) -> tuple[Scan, int]:
    """Return a scan, and the bits of a point."""
    points = _child(element, "points")
    prototype = [] if points is None else _children(points, "prototype")
    stated = "0" if points is None else points.get("recordCount", "0")
    if not stated.isdecimal() or len(stated) > 18:
        raise InputError("size-differs", f"Scan {number} states {stated[:30]!r} points.", path=path)
    count, names = int(stated), frozenset(_name(one) for one in prototype)
    if count and not (names.issuperset(_CARTESIAN) or names.issuperset(_SPHERICAL)):
        message = (
            f"Scan {number} has neither cartesian nor spherical coordinates: {', '.join(sorted(names))[:200]}."
        )
        raise InputError("e57-coordinates", message, path=path)
    try:
        bits = sum(_bits(one) for one in prototype)
        rotation, translation = _pose(element)
    except ValueError as error:
        raise _damaged(path, error) from error
    if count > 1 and bits == 0:
        raise InputError("size-differs", f"Scan {number} states {count} points of no bits.", path=path)
    wanted = _CARTESIAN if names.issuperset(_CARTESIAN) else _SPHERICAL
    single = any(_name(one) in wanted and one.get("precision") == "single" for one in prototype)
    return Scan(number, count, names, single, rotation, translation), bits


def _bits(element: Element) -> int:
    """Return the bits of a field of a point; a ValueError: its limits are no numbers."""
    kind = element.get("type", "")
    if kind == "Float":
        return 32 if element.get("precision") == "single" else 64
    if kind not in {"Integer", "ScaledInteger"}:
        return 0
    low, high = int(element.get("minimum", -(2**63))), int(element.get("maximum", 2**63 - 1))
    return max(high - low, 0).bit_length()


def _pose(element: Element) -> tuple[FloatArray, FloatArray]:
    """Return rotation (3, 3) and translation (3,) of a scan; unstated: none; a ValueError: no numbers."""
    pose = _child(element, "pose")
    if pose is None:
        return np.eye(3), np.zeros(3)
    turn, shift = _child(pose, "rotation"), _child(pose, "translation")
    quat = [1.0, 0, 0, 0] if turn is None else [_number(turn, axis) for axis in "wxyz"]
    translation = np.zeros(3) if shift is None else np.array([_number(shift, axis) for axis in "xyz"])
    length = float(np.linalg.norm(quat))
    if not np.isfinite([*quat, *translation]).all() or abs(length - 1) > 1e-3:
        raise ValueError(f"a pose has a quaternion of length {length:.4g}, or numbers that are not finite")
    w, x, y, z = np.array(quat) / length
    return matrix_from_quat_xyzw([x, y, z, w]), translation


def _number(element: Element, name: str) -> float:
    """Return a number of an element; one that is stated by its tag alone is 0."""
    return float(_text(element, name) or 0.0)


def _name(element: Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _child(element: Element, name: str) -> Element | None:
    return next((one for one in element if _name(one) == name), None)


def _children(element: Element, name: str) -> list[Element]:
    child = _child(element, name)
    return [] if child is None else list(child)


def _text(element: Element, name: str) -> str:
    child = _child(element, name)
    return "" if child is None or child.text is None else child.text.strip()


def _from_spherical(local: FloatArray) -> FloatArray:
    """Return x, y, z (P, 3) of range, azimuth from x to y, and elevation (P, 3), angles in radians."""
    reach, azimuth, elevation = local.T
    level = reach * np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), reach * np.sin(elevation)])


def _damaged(path: Path, error: Exception) -> InputError:
    message = f"The E57 file is damaged: {' '.join(str(error).split())[:200]}"
    return InputError("file-damaged", message, path=path)
