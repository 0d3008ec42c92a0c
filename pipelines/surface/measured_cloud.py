"""Measured geometry in the survey's frame: the only way in which clouds and meshes of other programs are read.

1. Headers are checked, and each file's CRS is found or refused, before work starts. Meshes are sampled.
2. Chunks are transformed in float64. Noise, withdrawn points and overlap are dropped.
3. One point a voxel is kept, a measured one. Memory holds no more than a multiple of the kept points: where they
   would become too many, the voxels grow.
"""

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.products import Remark, union
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import ByteArray, FloatArray, IntArray, Rows, joined_rows, rows_of
from pipelines.formats.cloud_ply import CloudChunk, CloudFile, open_cloud_ply
from pipelines.formats.e57 import open_e57
from pipelines.formats.las import open_las
from pipelines.formats.mesh_glb import read_glb_mesh
from pipelines.formats.mesh_place import placed
from pipelines.formats.triangle_mesh import TriangleMesh, has_faces, read_obj, read_ply_mesh
from pipelines.geodesy.cloud_crs import PlacedCrs, place_crs
from pipelines.geodesy.crs import PointCrs
from pipelines.geodesy.enu import Origin, ecef_from_lla, enu_from_ecef
from pipelines.geodesy.geotiff_keys import FileCrs
from pipelines.geometry.footprints import voxel_keys
from pipelines.surface.mesh import meets_box, samples, triangle_areas
from pipelines.survey.options import CLOUD_SUFFIXES, CloudCrs

log = logging.getLogger(__name__)

NOISE_CLASSES = (7, 18)  # low and high noise
_CLOUDS: dict[str, Callable[[Path], CloudFile]] = {
    ".las": open_las,
    ".laz": open_las,
    ".ply": open_cloud_ply,
    ".e57": open_e57,
}
_MESHES = {".obj": read_obj, ".glb": read_glb_mesh}
_MESH_POINTS = 5_000_000  # on a mesh, where nobody says how dense they are to be
_FINEST_M = 0.01
_CHUNK = 1_000_000
_MOST_FILES = 10_000
_KEY_SIDE = 2**21 - 1  # voxels along an axis for which a key of 63 bits is unique
_SPACING_CHANGE = 2**0.5  # of the voxels, where the points would become too many


@dataclass(frozen=True)
class Thinning:
    """How many points to keep, and where: one a voxel, in a box."""

    voxel_m: float
    most: int = 20_000_000  # limit of the points; beyond, the voxels grow
    low_in_geo: FloatArray | float = -np.inf  # (3,) corners of the box outside which points are dropped
    high_in_geo: FloatArray | float = np.inf


@dataclass(frozen=True)
class MeasuredCloud(Rows):
    """P points in geo."""

    position_in_geo: FloatArray  # (P, 3) metres
    classification: ByteArray  # (P,) class of LAS; 0: never classified
    weight: IntArray  # (P,) int64, number of measured points in its voxel
    gps_time_s: FloatArray  # (P,) time of the file; NaN: none
    voxel_m: float  # side of the voxels at the end
    station: IntArray  # (P,) int64, row of the place in `stations_in_geo` from which it was measured; -1: unknown


@dataclass(frozen=True)
class MeshFile:
    """Mesh whose vertices (V, 3) lie in the file's CRS, and what files beside it say of that."""

    mesh: TriangleMesh
    crs: FileCrs
    remarks: tuple[Remark, ...]

    @property
    def path(self) -> Path:
        return self.mesh.path

    @property
    def count(self) -> int:
        return len(self.mesh.faces)


@dataclass
class ReadTally:
    """Numbers of points by what became of them."""

    read: int = 0
    noise: int = 0
    withheld: int = 0
    overlap: int = 0
    outside: int = 0


class MeasuredFiles(Protocol):
    """Files of measured geometry, checked: points in geo in chunks, and what was remarkable about them."""

    tally: ReadTally
    crs_names: tuple[str, ...]
    notes: tuple[Remark, ...]

    @property
    def assumptions(self) -> tuple[Remark, ...]: ...
    @property
    def stations_in_geo(self) -> FloatArray | None:
        """Places (S, 3) from which the points were measured; None: unknown."""

    def chunks(
        self, origin: Origin, progress: Progress = SILENT, thinning: Thinning | None = None
    ) -> Iterator[MeasuredCloud]:
        """Yield all valid points, as dense as a thinning needs them."""


class CloudReader:
    """Files of one or several clouds or meshes, whose headers and CRS have been checked.

    Args:
        path: file, or folder whose clouds and meshes are taken, also from its subfolders.

    Attributes:
        crs_names: names of the CRSs of the files, without repetition.
        notes: where files and options disagree, and units that were converted.
        assumptions: sentences on what the files do not say.

    Raises:
        InputError: no file, an unreadable one, or one without a CRS; a CRS that PROJ cannot use.
    """

    stations_in_geo: FloatArray | None = None

    def __init__(self, path: Path, stated: CloudCrs) -> None:
        self._files = [_opened(file, stated) for file in _paths(path, stated)]
        self._offset = np.zeros(3) if stated.offset is None else np.array(stated.offset, dtype=np.float64)
        self._placed = [
            place_crs(file.crs, file.path, crs=stated.crs, vertical=stated.vertical, flag=stated.flag)
            for file in self._files
        ]
        self.count = sum(file.count for file in self._files)
        self.tally = ReadTally()
        crs = [one.crs for one in self._placed]
        silent = {(_short_name(one.name), one.height_unit) for one in crs if not one.vertical.stated}
        self.crs_names = tuple(dict.fromkeys(_short_name(one.name) for one in crs))
        heights = tuple(
            Remark(
                code=f"{stated.flag.removeprefix('--')}-heights",
                sentence=f"The heights of the cloud were taken as ellipsoidal, in {unit}: {name} has no vertical "
                "part.",
                remedy=f"{stated.flag}-vertical states one.",
            )
            for name, unit in sorted(silent)
        )
        of_meshes = [remark for file in self._files if isinstance(file, MeshFile) for remark in file.remarks]
        of_crs = [remark for one in self._placed for remark in one.remarks]
        self.notes = union(*(_few(one) for one in _by_code([*of_crs, *of_meshes])))
        self.assumptions = union(self.notes, heights)

    def chunks(
        self, origin: Origin, progress: Progress = SILENT, thinning: Thinning | None = None
    ) -> Iterator[MeasuredCloud]:
        """Yield all valid points in geo, in chunks; an InputError: damage, points outside the CRS, no grid.

        Of meshes, these are points on the triangles in the box of the `thinning`, two to the side of a voxel; None:
        5 million on a whole mesh.
        """
        with progress.task("lidar", self.count) as task:
            for file, placed_crs in zip(self._files, self._placed, strict=True):
                to_geo = _ToGeo(placed_crs, self._offset, file.path, origin)
                if isinstance(file, MeshFile):
                    for place in _sampled(to_geo(file.mesh.vertices), file.mesh.faces, thinning):
                        self.tally.read += len(place)
                        none = np.zeros(len(place), np.uint8)
                        yield _measured(place, none, None)
                    task.advance(file.count)
                    continue
                for raw in file.chunks(_CHUNK):
                    chunk = self._valid(raw, file.path)
                    if len(chunk):
                        yield _measured(to_geo(chunk.position), chunk.classification, chunk.gps_time_s)
                    task.advance(len(raw))

    def _valid(self, chunk: CloudChunk, path: Path) -> CloudChunk:
        """Return the points that count, and note the others."""
        if not np.isfinite(chunk.position).all():
            raise InputError("not-finite", "contains coordinates that are not finite.", path=path)
        noise = np.isin(chunk.classification, NOISE_CLASSES)
        keep = ~(noise | chunk.withheld | chunk.overlap)
        self.tally.read += len(chunk)
        self.tally.noise += int(noise.sum())
        self.tally.withheld += int((chunk.withheld & ~noise).sum())
        self.tally.overlap += int((chunk.overlap & ~noise & ~chunk.withheld).sum())
        return rows_of(chunk, keep)


class _ToGeo:
    """Points of one file brought from its CRS to geo. One operation serves them: neighbours keep their distance."""

    def __init__(self, placed_crs: PlacedCrs, offset: FloatArray, path: Path, origin: Origin) -> None:
        self._placed, self._offset, self._path, self._origin = placed_crs, offset, path, origin
        self._serving: PointCrs | None = None

    def __call__(self, position: FloatArray) -> FloatArray:
        """Return points (P, 3) of the file in geo; an InputError: outside the CRS, no grid."""
        crs, xyz = self._placed.crs, (position + self._offset) * self._placed.scale
        with _explained(self._placed):
            lla = (self._serving or crs).lla_from_xyz(xyz, path=self._path)
        self._serving = self._serving or crs.serving(lla)
        return enu_from_ecef(ecef_from_lla(lla), self._origin)


def _measured(place: FloatArray, classification: ByteArray, time_s: FloatArray | None) -> MeasuredCloud:
    count = len(place)
    known = np.full(count, np.nan) if time_s is None else time_s
    station = np.full(count, -1, np.int64)
    return MeasuredCloud(place, classification, np.ones(count, np.int64), known, 0.0, station)


def _sampled(vertices: FloatArray, faces: IntArray, thinning: Thinning | None) -> Iterator[FloatArray]:
    """Yield points (P, 3) on the triangles (F, 3) of vertices (V, 3) in geo."""
    if thinning is None:
        area = float(triangle_areas(vertices, faces).sum())
        spacing_m = max(_FINEST_M, (area / _MESH_POINTS) ** 0.5)
    else:
        faces = faces[meets_box(vertices, faces, thinning.low_in_geo, thinning.high_in_geo)]
        spacing_m = thinning.voxel_m / 2
    yield from samples(vertices, faces, spacing_m, _CHUNK)


def read_thinned(
    files: MeasuredFiles, origin: Origin, thinning: Thinning, progress: Progress = SILENT
) -> MeasuredCloud:
    """Return the first point of each voxel that the clouds meet; errors as of `CloudReader.chunks`, or no point.

    Memory holds at most three times `thinning.most` points.
    """
    voxel_m, held = thinning.voxel_m, 0
    waiting: list[MeasuredCloud] = []
    for chunk in files.chunks(origin, progress, thinning):
        place = chunk.position_in_geo
        inside = np.asarray(((place >= thinning.low_in_geo) & (place <= thinning.high_in_geo)).all(axis=1))
        files.tally.outside += int((~inside).sum())
        part = _thinned([rows_of(chunk, inside)], voxel_m)
        waiting, held = [*waiting, part], held + len(part)
        if held > 2 * thinning.most:
            merged = _limited(waiting, voxel_m, thinning.most)
            waiting, held, voxel_m = [merged], len(merged), merged.voxel_m
    if not held:
        raise InputError(
            "no-overlap",
            f"None of the {files.tally.read} points lies in the scene of the photographs: the cloud is of another "
            f"place, or its CRS ({', '.join(files.crs_names)}) is wrong.{_remarks_text(files.notes)}",
        )
    cloud = _limited(waiting, voxel_m, thinning.most)
    log.info(
        "lidar: %d of %d points kept in voxels of %.3f m; dropped: %d noise, %d withheld, %d overlap, %d outside",
        len(cloud), files.tally.read, cloud.voxel_m, files.tally.noise, files.tally.withheld, files.tally.overlap,
        files.tally.outside,
    )  # fmt: skip
    return cloud


def _limited(parts: list[MeasuredCloud], voxel_m: float, most: int) -> MeasuredCloud:
    """Return the points of all parts, thinned until they are no more than `most`."""
    cloud = _thinned(parts, voxel_m)
    while len(cloud) > most:
        cloud = _thinned([cloud], cloud.voxel_m * _SPACING_CHANGE)
    return cloud


def _thinned(parts: list[MeasuredCloud], voxel_m: float) -> MeasuredCloud:
    """Return the first point of each voxel, with the number of points in the voxel."""
    cloud = replace(joined_rows(parts), voxel_m=voxel_m)
    position = cloud.position_in_geo
    if not len(position):
        return cloud
    low, high = position.min(axis=0), position.max(axis=0)
    if not (high - low < _KEY_SIDE * voxel_m).all():
        reach_m = float((high - low).max())
        raise InputError(
            "cloud-too-large",
            f"The points extend over {reach_m / 1000:.0f} km, too far for voxels of {voxel_m:g} m.",
        )
    keys = voxel_keys(position, voxel_m)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    weight = np.bincount(inverse, cloud.weight).astype(np.int64)
    order = np.argsort(first)
    return replace(rows_of(cloud, first[order]), weight=weight[order])


def _short_name(name: str) -> str:
    """Return the name that a WKT gives its CRS; any other text itself."""
    match = re.match(r'\w+\["([^"]+)"', name)
    return match[1] if match else name


@contextmanager
def _explained(placed: PlacedCrs) -> Iterator[None]:
    """Add to the error of points that cannot be placed what is remarkable about their CRS."""
    try:
        yield
    except InputError as error:
        if not placed.remarks:
            raise
        message = error.message + _remarks_text(placed.remarks)
        raise InputError(
            error.code, message, path=error.path, line=error.line, field=error.field, remedy=error.remedy
        ) from error


def _remarks_text(remarks: Sequence[Remark]) -> str:
    return "".join(f" {remark.text}" for remark in remarks)


def _by_code(remarks: Sequence[Remark]) -> list[list[Remark]]:
    remarks_of: dict[str, list[Remark]] = {}
    for remark in remarks:
        remarks_of.setdefault(remark.code, []).append(remark)
    return list(remarks_of.values())


def _few(remarks: Sequence[Remark]) -> tuple[Remark, ...]:
    """Return the remarks of one code on many files as one, which counts the others."""
    first = remarks[0]
    more = "" if len(remarks) == 1 else f" {len(remarks) - 1} more of the files are so."
    return (first.model_copy(update={"sentence": first.sentence + more}),)


def suffixes_in(path: Path) -> set[str]:
    """Return the suffixes, in lower case, of a file or of the files in a folder that are not hidden."""
    if not path.is_dir():
        return {path.suffix.lower()}
    files = (file for file in path.rglob("*") if not any(part[0] == "." for part in file.relative_to(path).parts))
    return {file.suffix.lower() for file in files}


def _paths(path: Path, stated: CloudCrs) -> list[Path]:
    """Return the files of a path in the order of their names."""
    if not path.is_dir():
        return [path]
    files = sorted(
        file
        for file in path.rglob("*")
        if file.suffix.lower() in CLOUD_SUFFIXES
        and not any(part[0] == "." for part in file.relative_to(path).parts)
    )
    if not files:
        message = f"No file of this folder is one of {_listed_suffixes()}."
        raise InputError("no-cloud-files", message, path=path, field=stated.flag)
    if len(files) > _MOST_FILES:
        raise InputError(
            "too-many-files", f"{len(files)} files (limit {_MOST_FILES}).", path=path, field=stated.flag
        )
    return files


def _listed_suffixes() -> str:
    return ", ".join(sorted(CLOUD_SUFFIXES))


def _opened(path: Path, stated: CloudCrs) -> CloudFile | MeshFile:
    suffix = path.suffix.lower()
    read_mesh = _MESHES.get(suffix)
    if suffix == ".ply" and has_faces(path):
        read_mesh = read_ply_mesh
    if read_mesh is not None:
        return _placed_mesh(read_mesh(path), stated)
    reader = _CLOUDS.get(suffix)
    if reader is None:
        raise InputError("format-unknown", f"Expected {_listed_suffixes()}.", path=path, field=stated.flag)
    return reader(path)


def _placed_mesh(mesh: TriangleMesh, stated: CloudCrs) -> MeshFile:
    if stated.up is not None:
        mesh = mesh.with_up(stated.up)
    place = placed(
        mesh, crs_stated=stated.crs is not None, offset_stated=stated.offset is not None, flag=stated.flag
    )
    remarks = list(place.remarks)
    if not mesh.states_axes:
        sentence = (
            f"{mesh.path.name}: its axes were taken as easting, northing and height, in this order: an OBJ does "
            f"not say which axis is up."
        )
        code, remedy = f"{stated.flag.removeprefix('--')}-axes", f"{stated.flag}-up states it."
        remarks.append(Remark(code=code, sentence=sentence, remedy=remedy))
    return MeshFile(replace(mesh, vertices=place.position), place.crs, tuple(remarks))
