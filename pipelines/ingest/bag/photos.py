"""Photographs out of a bag: which frames to take, and each as a file, one at a time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import FloatArray
from pipelines.formats.bag.images import BadImageError, ImageWriter, sharpness
from pipelines.formats.bag.reader import Bag, UndecodableError
from pipelines.formats.exif import PhotoTags
from pipelines.formats.image_file import inspect_image
from pipelines.ingest.bag.streams import SampleTimes
from pipelines.ingest.notes import Notes
from pipelines.ingest.options import Every, IngestOptions
from pipelines.ingest.photo_folder import Photo

# A frame is blurred if it is less than half as sharp as the frames around it.
_BLURRED = 0.5
_NEIGHBOURS = 15
_LEAST_NEIGHBOURS = 3
_STEP_SLACK_S = 1e-6


@dataclass
class _FrameChooser:
    """Tells which frames are due."""

    every: Every | None
    last: FloatArray | None = None  # time, or place, of the frame taken last

    def due(self, time_s: float, place: FloatArray | None) -> bool:
        if self.every is None or self.last is None:
            return self.every is None or self.every.unit == "s" or place is not None
        if self.every.unit == "s":
            return bool(time_s - self.last[0] >= self.every.step - _STEP_SLACK_S)
        return place is not None and bool(np.linalg.norm(place - self.last) >= self.every.step)

    def record(self, time_s: float, place: FloatArray | None) -> None:
        self.last = place if self.every is not None and self.every.unit == "m" else np.array([time_s])


class _BlurDetector:
    """Judges sharpness against the frames looked at before, taken or not: a dull scene is not blurred for ever."""

    def __init__(self) -> None:
        self._recent: deque[float] = deque(maxlen=_NEIGHBOURS)

    def blurred(self, data: bytes) -> bool:
        current = sharpness(data)
        usual = float(np.median(self._recent)) if len(self._recent) >= _LEAST_NEIGHBOURS else 0.0
        self._recent.append(current)
        return current < _BLURRED * usual


def write_photos(
    bag: Bag,
    topic: str,
    clock: SampleTimes,
    place: FloatArray,
    *,
    options: IngestOptions,
    folder: Path,
    notes: Notes,
    progress: Progress = SILENT,
) -> tuple[list[Photo], list[int]]:
    """Write the chosen frames of `topic` into `folder` as `frame_nnnnnn.jpg` or `.png`, numbered as in the bag.

    Args:
        bag: open.
        topic: of the photographs.
        clock: times of the topic's messages.
        place: (N, 3) Cartesian positions at those times, NaN where unknown.
        options: which frames to take.
        folder: to write into.
        notes: frames that were left out.
        progress: a step a message.

    Returns:
        The photographs, and the number of each one's message.
    """
    folder.mkdir(parents=True, exist_ok=True)
    writer, chooser, blur = ImageWriter(), _FrameChooser(options.every), _BlurDetector()
    photos: list[Photo] = []
    numbers: list[int] = []
    failed: list[str] = []
    blurred, hashes, copies = 0, set(), 0
    with progress.task("photographs", len(clock.time_s)) as task:
        for number, message in enumerate(bag.messages([topic])):
            task.advance()
            if number >= len(clock.time_s) or not clock.usable[number]:
                continue
            time_s = float(clock.time_s[number])
            position = place[number] if np.isfinite(place[number]).all() else None
            if not chooser.due(time_s, position):
                continue
            try:
                data, suffix = writer.encoded(message.type, bag.decode(message))
                name = f"frame_{number:06d}{suffix}"
                file = inspect_image(data, Path(name))
            except (UndecodableError, BadImageError, InputError) as error:
                failed.append(f"message {number} ({str(error)[:120]})")
                continue
            if options.skip_blurred and blur.blurred(data):
                blurred += 1
                continue
            if file.sha256 in hashes:
                copies += 1
                continue
            hashes.add(file.sha256)
            (folder / name).write_bytes(data)
            photos.append(Photo(name, file, PhotoTags(timestamp_s=time_s)))
            numbers.append(number)
            chooser.record(time_s, position)
    notes.warn_counted(failed, f"image of {topic} was left out", f"images of {topic} were left out")
    if blurred:
        notes.warn(f"{blurred} frames are blurred and were passed over")
    if copies:
        notes.warn(f"{copies} frames are copies of earlier ones and were left out")
    if writer.bits is not None:
        notes.assume(f"16-bit images of {topic} have {writer.bits} bits in use, as the first one has")
    return photos, numbers
