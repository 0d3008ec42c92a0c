"""Which program has solved the cameras at a path, and their reader: a file is recognised by its content."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.files import file_size, reading
from pipelines.formats import metashape_cameras, nerfstudio, opensfm, opf, realityscan
from pipelines.formats.colmap import FILES as COLMAP_FILES
from pipelines.formats.solved_cameras import PhotoSize, SolvedCameras

_HEAD_BYTES = 1 << 20
_COLMAP_FILES = frozenset(f"{name}{suffix}" for name in COLMAP_FILES for suffix in (".bin", ".txt"))
# Where the programs put their files, below the folder that is given; the first one found is read.
_PLACES = (
    "*.opf",
    "opensfm/reconstruction.json",
    "reconstruction.json",
    "odm_report/shots.geojson",
    "shots.geojson",
    "transforms.json",
)
# Files that people take for exported cameras, and what to do instead.
_ADVICE = {
    ".psx": "Metashape's project: give what File ▸ Export ▸ Export Cameras writes (Agisoft XML)",
    ".psz": "Metashape's project: give what File ▸ Export ▸ Export Cameras writes (Agisoft XML)",
    ".p4d": "PIX4Dmapper's project: give an OPF project (.opf), as PIX4Dmatic exports it",
    ".p4m": "PIX4Dmatic's project: export it as OPF, and give the .opf file",
    ".rcproj": "RealityScan's project: export Internal/External camera parameters (CSV)",
    ".rsproj": "RealityScan's project: export Internal/External camera parameters (CSV)",
    ".db": "COLMAP's database, which has no poses: give the folder of the model",
    ".ply": "a PLY, which has no cameras",
}
_READABLE = (
    "COLMAP's model (a folder), an OPF project (.opf), Metashape's cameras (Agisoft XML), OpenSfM's or ODM's "
    "reconstruction.json, ODM's shots.geojson, nerfstudio's transforms.json, and RealityScan's CSV of internal and "
    "external camera parameters"
)


@dataclass(frozen=True)
class ForeignFile:
    """File of solved cameras, with its reader, and whether it comes with observed points."""

    path: Path
    read: Callable[[Path, PhotoSize], SolvedCameras]
    has_points: bool


def foreign_file(path: Path) -> ForeignFile | None:
    """Return the file of another program's cameras at or below a path; None: COLMAP's model is to be looked for.

    Raises:
        InputError: a file that is none of these; says what it is, as far as known.
    """
    if path.is_dir():
        inside = (_recognised(candidate) for candidate in _candidates(path))
        return next((file for file in inside if file is not None), None)
    if not path.exists() or path.name in _COLMAP_FILES:
        return None
    file = _recognised(path)
    if file is None:
        kind = _ADVICE.get(path.suffix.lower(), _kind(path))
        message = f"The file has no cameras that can be imported: it is {kind}. These are read: {_READABLE}."
        raise InputError("not-solved-cameras", message, path=path)
    return file


def _candidates(folder: Path) -> Iterator[Path]:
    for place in _PLACES:
        yield from (file for file in sorted(folder.glob(place)) if file.is_file())


def _recognised(path: Path) -> ForeignFile | None:
    """Return a file with the reader that its first mebibyte asks for."""
    file_size(path)
    with reading(path), path.open("rb") as stream:
        data = stream.read(_HEAD_BYTES)
    head = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig", "replace")
    text = head.lstrip()
    if text.startswith("<") and re.search(r"<(chunk|cameras)\b", text) and "<document" in text:
        return ForeignFile(path, metashape_cameras.read_metashape, has_points=False)
    if text.startswith(("{", "[")):
        return _json(path, text)
    lines = [(number, line) for number, line in enumerate(head.splitlines()[:20], start=1) if line.strip()]
    if realityscan.header_line(lines) is not None:
        return ForeignFile(path, realityscan.read_camera_csv, has_points=False)
    return None


def _json(path: Path, text: str) -> ForeignFile | None:
    keys = set(re.findall(r'"([A-Za-z_]{1,40})"\s*:', text))
    if opf.PROJECT in text:
        return ForeignFile(path, opf.read_opf, opf.has_tracks(path))
    if text.startswith("[") and ({"shots", "cameras"} & keys or text.split() == ["[]"]):
        return ForeignFile(path, opensfm.read_reconstruction, path.with_name(opensfm.TRACKS).is_file())
    if "features" in keys and {"filename", "rotation", "translation"} <= keys:
        return ForeignFile(path, opensfm.read_shots, has_points=False)
    if "frames" in keys and "transform_matrix" in keys:
        return ForeignFile(path, nerfstudio.read_transforms, has_points=False)
    return None


def _kind(path: Path) -> str:
    with reading(path), path.open("rb") as stream:
        text = stream.read(_HEAD_BYTES).decode("utf-8", "replace").lstrip()
    if '"projection_type"' in text:
        return "a list of lenses, as ODM's cameras.json: poses are in shots.geojson or reconstruction.json"
    if "opf-calibrated-cameras" in text:
        return "a part of an OPF project: give the project itself (.opf)"
    if text.startswith(("{", "[")):
        return "JSON of another form"
    if text.startswith("<"):
        return "XML of another form"
    return f"a file {path.suffix or 'without a suffix'} of another form"
