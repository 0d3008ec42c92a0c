"""Where a mesh lies: what files beside it say of its CRS and of the offset of its coordinates.

Vertices are small numbers in most programs; how they count from the map stands in a file of its own:

- this program's sidecar, `NAME.georef.json`;
- ODM's `coords.txt`, beside the mesh or in `../odm_georeferencing`: a CRS, and an offset in the second line;
- PIX4D's and others' `*offset.xyz` or `*offset.txt` with three numbers, and `NAME.prj`, `*_wkt.prj` with a CRS;
- `metadata.xml` of ContextCapture, DJI Terra and Metashape, beside the mesh or one folder above: SRS, SRSOrigin.

Two files that state different offsets are refused. An offset that the vertices already contain is not added again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.core.products import Remark, load_json
from pipelines.core.types import FloatArray
from pipelines.formats.georef_sidecar import CrsSidecar, GeorefSidecar, sidecar_path
from pipelines.formats.triangle_mesh import TriangleMesh
from pipelines.formats.xml_events import XmlReader, read_xml
from pipelines.geodesy.enu import Origin, ecef_from_enu
from pipelines.geodesy.geotiff_keys import FileCrs

ECEF = "EPSG:4978"
_LARGEST_TEXT = 100_000
_SAME_OFFSET = 1e-3
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_ENU = re.compile(r"ENU:\s*([-+.\d]+)\s*,\s*([-+.\d]+)\s*", re.IGNORECASE)


@dataclass(frozen=True)
class PlaceFile:
    """Statement of a file beside a mesh; empty, None: nothing of that.

    `offset` (3,) is added to the vertices; `enu` is the origin of a tangent frame in which they lie.
    """

    path: Path
    crs: str = ""
    offset: FloatArray | None = None
    enu: Origin | None = None


@dataclass(frozen=True)
class PlacedVertices:
    """Vertices (V, 3) in a CRS, easting or longitude first, what files say of it, and remarks on the offset."""

    position: FloatArray
    crs: FileCrs
    remarks: tuple[Remark, ...] = ()


def placed(mesh: TriangleMesh, *, crs_stated: bool, offset_stated: bool, flag: str) -> PlacedVertices:
    """Return the vertices (V, 3) of a mesh in the CRS that it names itself, or that files beside it name.

    Args:
        crs_stated: whether the user states the CRS: a frame that a file states is then not that of the vertices.
        offset_stated: whether the user states an offset, which counts before those of files and is added later.
        flag: option that names the mesh, for errors.

    Raises:
        InputError: a file beside the mesh that cannot be read, or two that state different offsets.
    """
    path, vertices = mesh.path, mesh.vertices
    beside = sidecar_path(path)
    if beside.is_file() and not offset_stated and not crs_stated:
        return _by_sidecar(path, beside, vertices)
    stated = [PlaceFile(path, mesh.crs, mesh.offset), *_place_files(path)]
    crs = next((one.crs for one in stated if one.crs), "")
    remarks = [*_differing_crs(path, stated, flag)]
    offsets = [one for one in stated if one.offset is not None]
    for one in offsets[1:]:
        if not offset_stated and np.abs(_offset(one) - _offset(offsets[0])).max() > _SAME_OFFSET:
            texts = " and ".join(f"{_metres(_offset(each))} in {each.path.name}" for each in (offsets[0], one))
            message = f"Two files beside the mesh state different offsets: {texts}."
            remedy = f"Give {flag}-offset."
            raise InputError("mesh-offsets-differ", message, path=path, field=flag, remedy=remedy)
    enu = next((one.enu for one in stated if one.enu is not None), None)
    shift = np.zeros(3) if offset_stated or not offsets else _offset(offsets[0])
    if shift.any():
        name, middle = offsets[0].path.name, np.median(vertices, axis=0)
        if np.linalg.norm((middle - shift)[:2]) < np.linalg.norm(middle[:2]):
            sentence = (
                f"{path.name}: the offset {_metres(shift)} of {name} was not added, since the vertices lie around "
                f"{_metres(middle)} already."
            )
            remarks.append(Remark(code=f"{flag.removeprefix('--')}-offset-included", sentence=sentence))
            shift = np.zeros(3)
        else:
            sentence = f"{path.name}: the offset {_metres(shift)} of {name} was added to its vertices."
            remarks.append(Remark(code=f"{flag.removeprefix('--')}-offset-added", sentence=sentence))
    if enu is not None and not crs_stated:
        return PlacedVertices(ecef_from_enu(vertices + shift, enu), FileCrs(wkt=ECEF), tuple(remarks))
    return PlacedVertices(vertices + shift, FileCrs(wkt=crs), tuple(remarks))


def _by_sidecar(path: Path, sidecar: Path, vertices: FloatArray) -> PlacedVertices:
    try:
        in_frame = load_json(GeorefSidecar, sidecar)
    except InputError:
        in_crs = load_json(CrsSidecar, sidecar)
        return PlacedVertices(vertices, FileCrs(wkt=in_crs.crs_wkt))
    if in_frame.crs_id is None:
        message = f"{sidecar.name} says that the mesh lies in a local metric frame, without a place on Earth."
        raise InputError("not-on-earth", message, path=path)
    return PlacedVertices(in_frame.ecef_from_file().apply(vertices), FileCrs(wkt=ECEF))


def _place_files(path: Path) -> Iterator[PlaceFile]:
    folder = path.parent
    for coords in (folder / "coords.txt", folder.parent / "odm_georeferencing" / "coords.txt"):
        if coords.is_file():
            yield _odm_coords(coords)
            break
    for metadata in (folder / "metadata.xml", folder.parent / "metadata.xml"):
        if metadata.is_file():
            yield _metadata(metadata)
            break
    names = sorted(one for one in folder.iterdir() if one.is_file())
    for one in names:
        if re.fullmatch(r"(.*[_-])?offset\.(xyz|txt)", one.name, re.IGNORECASE):
            yield PlaceFile(one, offset=_three_numbers(one))
    for one in names:
        if one.suffix.lower() == ".prj" and (one.stem == path.stem or one.stem.lower().endswith("_wkt")):
            yield PlaceFile(one, crs=" ".join(_small_text(one).split()))


def _odm_coords(path: Path) -> PlaceFile:
    """Return ODM's statement: its CRS, and the easting and northing that its vertices lack."""
    lines = [line.strip() for line in _small_text(path).splitlines() if line.strip()]
    numbers = _numbers(lines[1]) if len(lines) > 1 else []
    if len(numbers) not in {2, 3}:
        message = "Expected a CRS in the first line, and easting and northing in the second, as ODM writes them."
        raise InputError("mesh-offset", message, path=path, line=2)
    return PlaceFile(path, lines[0], np.array([*numbers, 0.0][:3]))


def _three_numbers(path: Path) -> FloatArray:
    numbers = _numbers(_small_text(path))
    if len(numbers) != 3:
        message = f"Expected the three numbers of an offset, found {len(numbers)}."
        raise InputError("mesh-offset", message, path=path)
    return np.array(numbers)


class _Metadata(XmlReader):
    """SRS and SRSOrigin of a `metadata.xml`."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.texts = {"SRS": "", "SRSOrigin": ""}

    def text(self, content: str) -> None:
        if self.open[-1] in self.texts and len(self.texts[self.open[-1]]) < _LARGEST_TEXT:
            self.texts[self.open[-1]] += content


def _metadata(path: Path) -> PlaceFile:
    reader = _Metadata(path)
    read_xml(reader, limit_bytes=_LARGEST_TEXT, kind="metadata.xml")
    srs, origin = reader.texts["SRS"].strip(), reader.texts["SRSOrigin"]
    numbers = _numbers(origin)
    if len(numbers) not in {0, 2, 3}:
        message = f"Expected the three numbers of SRSOrigin, found {len(numbers)}."
        raise InputError("mesh-offset", message, path=path, field="SRSOrigin")
    offset = np.array([*numbers, 0.0][:3]) if numbers else None
    enu = _ENU.fullmatch(srs)
    if enu is None:
        return PlaceFile(path, srs, offset)
    lat, lon = float(enu[1]), float(enu[2])
    if abs(lat) > 90 or abs(lon) > 180:
        message = f"The origin {srs!r} is no latitude and longitude in degrees."
        raise InputError("mesh-offset", message, path=path, field="SRS")
    return PlaceFile(path, offset=offset, enu=Origin(lat_deg=lat, lon_deg=lon, alt_m=0.0))


def _differing_crs(path: Path, stated: list[PlaceFile], flag: str) -> Iterator[Remark]:
    said = [one for one in stated if one.crs or one.enu is not None]
    texts = [" ".join(one.crs.split()).lower() or "enu" for one in said]
    if len(set(texts)) > 1:
        listed = ", ".join(f"{(one.crs or 'ENU')[:60]!r} in {one.path.name}" for one in said)
        sentence = f"{path.name}: files beside it name its CRS in different words: {listed}. The first counts."
        code, remedy = f"{flag.removeprefix('--')}-crs-stated-twice", f"{flag}-crs overrules them."
        yield Remark(code=code, sentence=sentence, remedy=remedy)


def _offset(one: PlaceFile) -> FloatArray:
    return np.zeros(3) if one.offset is None else one.offset


def _metres(values: FloatArray) -> str:
    return ", ".join(f"{value:.3f}" for value in values)


def _numbers(text: str) -> list[float]:
    numbers = [float(text_of_number) for text_of_number in _NUMBER.findall(text)[:10]]
    return numbers if all(abs(number) < 1e9 for number in numbers) else []


def _small_text(path: Path) -> str:
    file_size(path, limit_bytes=_LARGEST_TEXT, kind="place of a mesh")
    with reading(path):
        return path.read_bytes().decode("utf-8-sig", "replace")
