"""A folder of photographs: which files are usable images, and their tags."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.validators import stays_inside
from pipelines.formats.exif import PhotoTags, read_tags
from pipelines.formats.image_file import SUFFIXES, ImageFile, header_size, inspect_image, read_bytes, read_head
from pipelines.ingest.notes import Notes


@dataclass(frozen=True)
class Photo:
    """A usable photograph; `name` is relative to its folder, with forward slashes."""

    name: str
    file: ImageFile
    tags: PhotoTags


def scan_folder(root: Path, notes: Notes, progress: Progress = SILENT, *, decode: bool = True) -> list[Photo]:
    """Return every usable photograph below `root`, sorted by name; files that are left out are noted.

    Left out are files that are empty, damaged or too large, links that lead out of the folder, and all but the
    first of identical files. Hidden files and folders are not looked at.

    Args:
        root: the folder.
        notes: files that are left out.
        progress: a step a file.
        decode: whether to decode each file to its end; otherwise its head alone is read, in about a millisecond.

    Raises:
        InputError: no such folder, or no JPEG, PNG or TIFF file in it.
    """
    if not root.is_dir():
        raise InputError("no such folder of photographs", path=root, field="--images")
    paths = sorted(_candidates(root), key=lambda path: path.relative_to(root).as_posix())
    inside = [path for path in paths if path.resolve().is_relative_to(root.resolve())]
    notes.warn_counted(
        [_name(path, root) for path in paths if path not in set(inside)],
        "image is a link that leaves the folder and was left out",
        "images are links that leave the folder and were left out",
    )
    named = [path for path in inside if stays_inside(_name(path, root))]
    notes.warn_counted(
        [ascii(_name(path, root)) for path in inside if path not in set(named)],
        "image has a name that is no text and was left out",
        "images have names that are no text and were left out",
    )
    inside = named
    if not inside:
        raise InputError("holds no JPEG, PNG or TIFF image", path=root, field="--images")
    photos: list[Photo] = []
    damaged: list[str] = []
    inspected = partial(_inspect, root=root, decode=decode)
    with progress.task("images", len(inside)) as task, ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for path, photo in zip(inside, pool.map(inspected, inside), strict=True):
            task.advance()
            if isinstance(photo, Photo):
                photos.append(photo)
            else:
                damaged.append(f"{_name(path, root)} ({photo})")
    notes.warn_counted(damaged, "image was left out", "images were left out")
    return _without_duplicates(photos, notes)


def glance(root: Path) -> tuple[int, int, tuple[int, int]]:
    """Return number and bytes of the image files below `root`, and width and height of the first that is an image.

    No other is read: a folder of hundreds is answered at once.

    Raises:
        InputError: no such folder, or no image in it.
    """
    if not root.is_dir():
        raise InputError("no such folder of photographs", path=root, field="--images")
    paths = sorted(_candidates(root))
    size_px = next(filter(None, (header_size(data) for data in map(_beginning, paths))), None)
    if size_px is None:
        raise InputError("holds no JPEG, PNG or TIFF image", path=root, field="--images")
    return len(paths), sum(path.stat().st_size for path in paths), size_px


def _candidates(root: Path) -> Iterator[Path]:
    for folder, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            if not name.startswith(".") and Path(name).suffix.lower() in SUFFIXES:
                yield Path(folder) / name


def _inspect(path: Path, root: Path, *, decode: bool) -> Photo | str:
    """Return the photograph, or the reason why it is none."""
    try:
        data = read_bytes(path) if decode else read_head(path)
        return Photo(_name(path, root), inspect_image(data, path, decode=decode), read_tags(data))
    except InputError as error:
        return str(error).removeprefix(f"{path}: ")


def _beginning(path: Path) -> bytes:
    """Return the head of a file; nothing of one that cannot be read."""
    try:
        return read_head(path)
    except InputError:
        return b""


def _name(path: Path, root: Path) -> str:
    return path.relative_to(root).as_posix()


def _without_duplicates(photos: list[Photo], notes: Notes) -> list[Photo]:
    first: dict[str, str] = {}
    kept, dropped = [], []
    for photo in photos:
        if photo.file.sha256 in first:
            dropped.append(f"{photo.name} (as {first[photo.file.sha256]})")
        else:
            first[photo.file.sha256] = photo.name
            kept.append(photo)
    notes.warn_counted(
        dropped, "image is a copy of another and was left out", "images are copies of others and were left out"
    )
    return kept
