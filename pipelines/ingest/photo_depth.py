"""Photographs with more than eight bits: one scale for all photographs of a camera.

COLMAP and OpenCV read the upper eight of sixteen bits. Cameras of ten, twelve or fourteen bits leave those nearly
black, and thermal cameras write temperatures into a narrow part of the range. Such photographs are copied with
eight bits, by a scale that all photographs of their camera share: one place has one brightness in all of them.
"""

import shutil
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import AnyArray, ByteArray
from pipelines.formats.image_file import deep_pixels, inspect_image, read_bytes
from pipelines.ingest.flight_record import FlightRecord
from pipelines.ingest.photo_folder import Photo
from pipelines.ingest.remarks import Remarks

_USUAL_BITS = (8, 10, 12, 14, 16)  # of sensors
_NARROW = 1 / 8  # of the range of the bits in use: a picture has less contrast than eight bits can show


@dataclass(frozen=True)
class _Scale:
    """Values that become 0 and 255, and how many bits are in use; 0: floating-point numbers."""

    low: float
    high: float
    bits: int

    def to_bytes(self, pixels: AnyArray) -> ByteArray:
        # What is no number, as outside of an orthophoto, becomes black.
        values = np.nan_to_num(pixels.astype(np.float32), nan=self.low, posinf=self.high, neginf=self.low)
        share = (values - self.low) / (self.high - self.low)
        return np.asarray(np.clip(share * 255 + 0.5, 0, 255), dtype=np.uint8)


def with_common_scale(
    flight: FlightRecord, folder: Path, remarks: Remarks, progress: Progress = SILENT
) -> FlightRecord:
    """Return the flight with its photographs in `folder`, if some need a scale; else the flight as it is.

    Photographs keep their names. Those that need no scale are copied as they are.

    Raises:
        InputError: a photograph cannot be read any more.
    """
    of_camera: dict[int, list[Photo]] = {}
    everything = [*flight.photos, *(each.photo for each in flight.accompanying)]
    for photo in everything:
        of_camera.setdefault(flight.camera_of[photo.name], []).append(photo)
    scales = {camera: scale for camera, photos in of_camera.items() if (scale := _scale(photos)) is not None}
    if not scales:
        return flight
    changed: dict[str, Photo] = {}
    with progress.task("bit depth", len(everything)) as task:
        for photo in everything:
            scale = scales.get(flight.camera_of[photo.name])
            changed[photo.name] = _copied(photo, scale, flight.folder / photo.name, folder / photo.name)
            task.advance()
    for camera, scale in scales.items():
        _note(scale, of_camera[camera], remarks)
    photos = [changed[photo.name] for photo in flight.photos]
    accompanying = tuple(replace(each, photo=changed[each.photo.name]) for each in flight.accompanying)
    kept = {
        photo.name: photo.file.sha256
        for photo in everything
        if flight.camera_of[photo.name] in scales and photo.file.values is not None
    }
    if flight.folder.resolve() == folder.resolve():  # converted files, which were replaced
        kept = {}
    return replace(
        flight,
        folder=folder.resolve(),
        photos=photos,
        accompanying=accompanying,
        original_folder=flight.folder if kept else None,
        originals=kept,
    )


def _scale(photos: Iterable[Photo]) -> _Scale | None:
    """Return the scale of a camera's photographs; None: they need none."""
    deep = [photo.file for photo in photos if photo.file.values is not None]
    if not deep:
        return None
    low = min(file.values[0] for file in deep if file.values is not None)
    high = max(file.values[1] for file in deep if file.values is not None)
    if not high > low:
        return None  # pictures of one value, which no scale helps
    if any(file.is_float for file in deep) or low < 0:
        return _Scale(low, high, 0)
    needed = int(high).bit_length()
    bits = next(usual for usual in _USUAL_BITS if needed <= usual)
    if high - low < _NARROW * 2**bits:
        return _Scale(low, high, bits)
    # All sixteen bits are in use, and what reads the upper eight of them loses nothing.
    return None if bits == 16 and all(file.bits == 16 for file in deep) else _Scale(0.0, 2.0**bits - 1, bits)


def _copied(photo: Photo, scale: _Scale | None, source: Path, target: Path) -> Photo:
    """Write a photograph, scaled if it has more than eight bits, and return it as it is now."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if scale is None or photo.file.values is None:
        if source.resolve() != target.resolve():
            shutil.copyfile(source, target)
        return photo
    import cv2

    pixels = deep_pixels(read_bytes(source))
    if pixels is None:
        raise InputError("photograph-damaged", "The photograph cannot be read any more.", path=source)
    _, data = cv2.imencode(target.suffix.lower(), scale.to_bytes(pixels))
    encoded = data.tobytes()
    target.write_bytes(encoded)
    return replace(photo, file=inspect_image(encoded, target))


def _note(scale: _Scale, photos: list[Photo], remarks: Remarks) -> None:
    deep = [photo.file for photo in photos if photo.file.values is not None]
    name = photos[0].tags.make_model.strip() or "the camera"
    kind = "floating-point" if scale.bits == 0 else f"{max(file.bits for file in deep)}-bit"
    values = f"{scale.low:.6g} to {scale.high:.6g}"
    used = f", {scale.bits} bits" if scale.bits else ""
    remarks.assume(
        "image-bit-depth",
        f"The {kind} files of {name} ({len(deep)}) hold values of {values}{used}: copies with 8 bits are used, all "
        "by this one scale.",
    )
