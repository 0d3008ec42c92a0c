"""A folder of photographs: which files are usable images, which of them a name in a table means, and their cameras.

Cameras are those before any reconstruction: focal length in pixels from a photograph's lens tags.
"""

import math
import os
import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Literal

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.sentences import listed
from pipelines.core.validators import stays_inside
from pipelines.formats.exif import PhotoTags, read_tags
from pipelines.formats.heif import heif_size, jpeg_of_heif
from pipelines.formats.image_file import (
    HEIF_SUFFIXES,
    SUFFIXES,
    VIDEO_SUFFIXES,
    ImageFile,
    header_size,
    inspect_image,
    read_bytes,
    read_head,
)
from pipelines.ingest.camera_identity import Fisheye, Serials, fisheye_of, grouped_by_serials, serials_of
from pipelines.ingest.remarks import Remarks
from pipelines.survey.survey import CameraPrior


@dataclass(frozen=True)
class Photo:
    """A usable photograph; `name` is relative to its folder, with forward slashes.

    `sensor` is that of `ingest.sensors`, empty where nothing tells one. `sharpness` is over that of the photographs
    around it, None where nothing tells it.
    """

    name: str
    file: ImageFile
    tags: PhotoTags
    sensor: str = ""
    sharpness: float | None = None


def scan_folder(root: Path, remarks: Remarks, progress: Progress = SILENT, *, decode: bool = True) -> list[Photo]:
    """Return every usable photograph below `root`, sorted by name; files that are left out are noted.

    Left out are files that are empty, damaged or too large, links that lead out of the folder, thumbnails by the
    name of file or folder, and all but the first of identical files. Hidden files and folders are not looked at.

    Each file is decoded to its end; without `decode` its head alone is read, in about a millisecond.

    Raises:
        InputError: no such folder, or no JPEG, PNG or TIFF file in it.
    """
    paths = list(_candidates(root))
    names, inside = (path.relative_to(root).as_posix() for path in paths), _inside(root, paths)
    remarks.warn_counted(
        "image-link-outside",
        sorted(set(names) - set(inside)),
        "Images that are links out of the folder are left out",
    )
    usable = [name for name in inside if stays_inside(name)]
    remarks.warn_counted(
        "image-name-not-text",
        [ascii(name) for name in sorted(set(inside) - set(usable))],
        "Images with names that are not text are left out",
    )
    usable = _without_thumbnails(usable, remarks)
    if not usable:
        videos = sorted(path.name for path in root.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES)
        hint = f" Take photographs from a video by --video {root / videos[0]}." if videos else ""
        message = f"The folder has no JPEG, PNG or TIFF image.{hint}"
        raise InputError("no-images", message, path=root, field="--images")
    photos: list[Photo] = []
    damaged: list[str] = []
    inspected = partial(_inspect, root=root, decode=decode)
    with progress.task("images", len(usable)) as task, ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for name, photo in zip(usable, pool.map(inspected, usable), strict=True):
            task.advance()
            if isinstance(photo, Photo):
                photos.append(photo)
            else:
                damaged.append(f"{name} ({photo})")
    remarks.warn_counted("image-unreadable", damaged, "Images cannot be read and are left out")
    return _without_duplicates(photos, remarks)


def _inside(root: Path, paths: Iterable[Path]) -> list[str]:
    """Return the names, sorted, of the files that do not lead out of a folder as links."""
    home = root.resolve()
    return sorted(path.relative_to(root).as_posix() for path in paths if path.resolve().is_relative_to(home))


def heif_photographs(root: Path) -> list[str]:
    """Return the names of the HEIC photographs below `root`; none if there is no such folder."""
    return _inside(root, _files_below(root, HEIF_SUFFIXES))


def convert_heif(
    root: Path, names: Sequence[str], folder: Path, remarks: Remarks, progress: Progress = SILENT
) -> None:
    """Copy the photographs below `root` into `folder`, those in HEIC, `names`, as JPEG with `.jpg` added.

    COLMAP and OpenCV read no HEIC. What does not decode is left out, and noted.

    Raises:
        BackendUnavailableError: the library that reads HEIC is not installed.
    """
    damaged = []
    with progress.task("HEIC", len(names)) as task:
        for name in names:
            try:
                jpeg = jpeg_of_heif(root / name)
            except InputError as error:
                damaged.append(f"{name} ({str(error).removeprefix(f'{root / name}: ')})")
            else:
                (target := folder / f"{name}.jpg").parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(jpeg)
            task.advance()
    for name in _inside(root, _candidates(root)):
        (target := folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(root / name, target)
    remarks.warn_counted("image-unreadable", damaged, "Images cannot be read and are left out")
    remarks.assume("heif-converted", f"{len(names) - len(damaged)} HEIC photographs are converted to JPEG.")


def glance(root: Path) -> tuple[int, int, tuple[int, int]]:
    """Return number and bytes of the image files below `root`, and width and height of the first that is an image.

    No other is read: a folder of hundreds is answered at once.

    Raises:
        InputError: no such folder, or no image in it.
    """
    paths = sorted((*_candidates(root), *_files_below(root, HEIF_SUFFIXES)))
    size_px = next(filter(None, map(_size_by_header, paths)), None)
    if size_px is None:
        raise InputError("no-images", "The folder has no JPEG, PNG or TIFF image.", path=root, field="--images")
    return len(paths), sum(path.stat().st_size for path in paths), size_px


def _size_by_header(path: Path) -> tuple[int, int] | None:
    if path.suffix.lower() not in HEIF_SUFFIXES:
        return header_size(_beginning(path))
    try:
        return heif_size(path)
    except InputError:
        return None


def _candidates(root: Path) -> Iterator[Path]:
    if not root.is_dir():
        raise InputError(
            "no-image-folder", "The folder of photographs does not exist.", path=root, field="--images"
        )
    return _files_below(root, SUFFIXES)


def _files_below(root: Path, suffixes: frozenset[str]) -> Iterator[Path]:
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if not name.startswith(".") and Path(name).suffix.lower() in suffixes:
                yield Path(folder) / name


def _inspect(name: str, root: Path, *, decode: bool) -> Photo | str:
    """Return the photograph, or the reason why it is none."""
    path = root / name
    try:
        data = read_bytes(path) if decode else read_head(path)
        return Photo(name, inspect_image(data, path, decode=decode), read_tags(data))
    except InputError as error:
        return str(error).removeprefix(f"{path}: ")


def _beginning(path: Path) -> bytes:
    """Return the head of a file; nothing of one that cannot be read."""
    try:
        return read_head(path)
    except InputError:
        return b""


# Folders and files of servers, viewers and file managers: Synology, QNAP, freedesktop, Windows, Sony, galleries.
_THUMBNAIL_FOLDER = re.compile(
    r"@eadir|@__thumb|[._-]?(thumb|thumbs|thumbnail|thumbnails|thmbnl|thm)|image[_-]?previews?|\$recycle\.bin|"
    r"[@#]recycle|__macosx",
    re.IGNORECASE,
)
_THUMBNAIL_FILE = re.compile(
    r"synophoto_thumb.*|(thumb|thumbnail)[._-].*|.*[._-](thumb|thumbnail|thumbs)", re.IGNORECASE
)


def _without_thumbnails(names: list[str], remarks: Remarks) -> list[str]:
    """Return the names that are no thumbnails' by folder or file; all if there are no others."""
    thumbnails = {
        name
        for name in names
        if any(_THUMBNAIL_FOLDER.fullmatch(part) for part in PurePosixPath(name).parts[:-1])
        or _THUMBNAIL_FILE.fullmatch(PurePosixPath(name).stem)
    }
    if len(thumbnails) == len(names):
        return names
    remarks.warn_counted("image-thumbnails", sorted(thumbnails), "Thumbnails and deleted files are left out")
    return [name for name in names if name not in thumbnails]


def _without_duplicates(photos: list[Photo], remarks: Remarks) -> list[Photo]:
    first: dict[str, str] = {}
    kept, dropped = [], []
    for photo in photos:
        if photo.file.sha256 in first:
            dropped.append(f"{photo.name} (as {first[photo.file.sha256]})")
        else:
            first[photo.file.sha256] = photo.name
            kept.append(photo)
    remarks.warn_counted("image-copies", dropped, "Images that are copies of others are left out")
    return kept


# Longer side of the sensor in mm, for cameras that survey; a crop to 16:9 keeps the full width.
_SENSOR_WIDTH_MM = {
    "FC220": 6.17, "FC2103": 6.17, "FC2204": 6.17, "FC2403": 6.17, "FC300C": 6.17, "FC300S": 6.17,
    "FC300X": 6.17, "FC330": 6.17, "FC350": 6.17, "FC7203": 6.17, "FC7303": 6.17, "FC3170": 6.4,
    "FC3582": 9.6, "FC8482": 9.6, "FC3411": 13.2, "FC6310": 13.2, "FC6310R": 13.2, "FC6310S": 13.2,
    "FC6510": 13.2, "L1D-20C": 13.2, "FC550": 17.3, "FC6520": 17.3, "L2D-20C": 17.3, "M3E": 17.3,
    "M4E": 17.3, "FC6540": 23.5, "ZENMUSEP1": 35.9,
}  # fmt: skip
_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# Without any lens tag: between a wide drone lens (0.6) and a phone's (0.8 …); OpenDroneMap starts with it too.
ASSUMED_RATIO = 0.85
FocalSource = Literal["exif", "assumed"]


_NEAR_PART = 0.15  # what whole millimetres, and counting by the diagonal or by the width, make of an equivalent
_LEAST_PART, _MOST_PART = 0.2, 20.0  # of the longer side, beyond which a focal length is nonsense


def focal_px(tags: PhotoTags, width: int, height: int) -> tuple[float, FocalSource, str]:
    """Return the focal length in pixels of a stored image, its source, and a phrase on it.

    In this order: real focal length and the sensor's width in a table; a drone's own calibration in XMP; real focal
    length and focal plane resolution (scaled by how much smaller the image is than when it was taken), unless it
    contradicts the next, as that of a preview or of another unit does; 35 mm equivalent by the diagonal (CIPA
    DCG-001); else 0.85 of the longer side. The phrase names all that differ from what is used.
    """
    by_source = _focal_lengths(tags, width, height)
    if not by_source:
        return ASSUMED_RATIO * max(width, height), "assumed", f"assumed as {ASSUMED_RATIO:g} of the longer side"
    if (
        "plane" in by_source
        and "equivalent" in by_source
        and not _near(by_source["plane"][0], by_source["equivalent"][0])
    ):
        by_source["plane"] = by_source.pop("plane")  # behind the equivalent
    (focal, origin), *others = by_source.values()
    apart = [f"{value:.0f} px {how}" for value, how in others if not _near(value, focal)]
    return focal, "exif", f"{origin}{f', and not {listed(apart)}' if apart else ''}"


def _focal_lengths(tags: PhotoTags, width: int, height: int) -> dict[str, tuple[float, str]]:
    """Return the focal lengths in pixels that the tags state and that are no nonsense, with a phrase on each."""
    lens, long_side = tags.lens, max(width, height)
    scale = long_side / (lens.taken_width_px or long_side)
    sensor_mm = _SENSOR_WIDTH_MM.get(tags.model.strip().upper())
    by_source: dict[str, tuple[float, str]] = {}
    if lens.focal_mm and sensor_mm:
        focal = lens.focal_mm * lens.zoom / sensor_mm * long_side
        by_source["sensor"] = (focal, f"from {lens.focal_mm:g} mm on a sensor {sensor_mm:g} mm wide")
    calibrated = tags.xmp.number("CalibratedFocalLength") or tags.xmp.number("X", within="CalibratedFocalLength")
    if calibrated is not None:
        by_source["calibrated"] = (calibrated * scale, "from CalibratedFocalLength in XMP")
    if lens.focal_mm and lens.px_per_mm:
        focal = lens.focal_mm * lens.zoom * lens.px_per_mm * scale
        by_source["plane"] = (focal, f"from {lens.focal_mm:g} mm and the focal plane resolution")
    if lens.focal_35mm_mm:
        focal = lens.focal_35mm_mm / _FILM_DIAGONAL_MM * math.hypot(width, height)
        by_source["equivalent"] = (focal, f"from {lens.focal_35mm_mm:g} mm on 35 mm film")
    usual = (_LEAST_PART * long_side, _MOST_PART * long_side)
    return {name: each for name, each in by_source.items() if usual[0] < each[0] < usual[1]}


def _near(one: float, other: float) -> bool:
    return abs(one / other - 1.0) < _NEAR_PART


def camera_priors(
    photos: Sequence[Photo], given_focal_px: float | None, remarks: Remarks
) -> tuple[tuple[CameraPrior, ...], dict[str, int]]:
    """Return a prior for each camera, and the id of each image's camera by name.

    Photographs of one camera agree in size, model, focal length, sensor, lens model and serial numbers. A given
    focal length counts instead of EXIF's. How each was found is noted.
    """
    alike: dict[tuple[object, ...], list[Photo]] = {}
    for photo in photos:
        width, height = photo.file.width, photo.file.height
        fisheye = fisheye_of(photo.tags, width, height)
        focal = given_focal_px or _focal(photo, fisheye)[0]
        key = (width, height, photo.tags.make_model.strip(), round(focal, 1), photo.sensor, fisheye is None)
        alike.setdefault(key, []).append(photo)
    cameras: list[CameraPrior] = []
    camera_of: dict[str, int] = {}
    for members in alike.values():
        serials = [serials_of(photo.tags) for photo in members]
        first: dict[int, int] = {}
        for photo, serial, number in zip(members, serials, grouped_by_serials(serials), strict=True):
            if number not in first:
                first[number] = len(cameras) + 1
                cameras.append(_camera_prior(photo, len(cameras) + 1, serial, given_focal_px, remarks))
            camera_of[photo.name] = first[number]
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) > 1:
        listed = ", ".join(f"{width}×{height}" for width, height in sizes)
        remarks.warn("image-sizes", f"The images have {len(sizes)} sizes ({listed}): each is a camera of its own.")
    return tuple(cameras), {photo.name: camera_of[photo.name] for photo in photos}


def _focal(photo: Photo, fisheye: Fisheye | None) -> tuple[float, FocalSource, str]:
    """Return the focal length of a photograph in pixels, its source, and a phrase on it."""
    width, height = photo.file.width, photo.file.height
    if fisheye is not None and fisheye.focal_px is not None:
        return fisheye.focal_px, "exif", "from the fisheye's own calibration in XMP"
    focal, source, origin = focal_px(photo.tags, width, height)
    if fisheye is None or source != "assumed":
        return focal, source, origin
    return math.hypot(width, height) / math.pi, "assumed", "assumed as that of 180° across the diagonal"


def _camera_prior(
    photo: Photo, number: int, serials: Serials, given_focal_px: float | None, remarks: Remarks
) -> CameraPrior:
    width, height, name = photo.file.width, photo.file.height, photo.tags.make_model.strip()
    fisheye = fisheye_of(photo.tags, width, height)
    focal, source, origin = _focal(photo, fisheye)
    if given_focal_px is not None:
        focal, origin = given_focal_px, "as the user states"
    kind = f" ({photo.sensor})" if photo.sensor else ""
    remarks.assume(
        "focal-length",
        f"The focal length of {name or 'the camera'}{kind} at {width}×{height} is {focal:.1f} px, {origin}.",
    )
    centre = (width / 2.0, height / 2.0) if fisheye is None else fisheye.centre_px
    if fisheye is not None:
        remarks.assume(
            "fisheye-lens",
            f"The lens of {name or 'the camera'}{kind} is a fisheye by its tags: COLMAP's OPENCV_FISHEYE is used.",
            "--camera-model does not apply to it.",
        )
    return CameraPrior(
        camera_id=number,
        model="SIMPLE_RADIAL" if fisheye is None else "OPENCV_FISHEYE",
        width=width,
        height=height,
        params=(focal, *centre, 0.0)
        if fisheye is None
        else (focal, focal, *centre, fisheye.k1, fisheye.k2, 0.0, 0.0),
        focal_source=source if given_focal_px is None else "option",
        make_model=name,
        serial=serials.number,
        sensor=photo.sensor,
    )
