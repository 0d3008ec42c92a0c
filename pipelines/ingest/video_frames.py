"""Photographs out of a video: the sharpest frame of each interval, with positions from subtitles or telemetry."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import ByteArray, FloatArray
from pipelines.formats.gnss_logs import VideoPositions, read_subtitles
from pipelines.formats.gopro_telemetry import read_telemetry
from pipelines.formats.image_file import MAX_PIXELS
from pipelines.formats.trajectory_csv import PoseTable
from pipelines.ingest.options import Every, IngestOptions
from pipelines.ingest.remarks import Remarks

_EVERY = Every(1.0, "s")
# What the files of video containers have, and where. FFmpeg chooses by content: playlists and scripts, which are
# text, would let it read other files.
_ATOMS = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
_CONTAINERS: tuple[tuple[int, tuple[bytes, ...]], ...] = (
    (4, _ATOMS),  # MP4, MOV, 3GP
    (8, (b"AVI ", b"AVIX")),
    (
        0,
        (
            b"\x1a\x45\xdf\xa3",
            b"\x30\x26\xb2\x75\x8e\x66\xcf\x11",
            b"OggS\0",
            b"FLV\x01",
            b"\0\0\x01\xba",
            b"\0\0\x01\xb3",
        ),
    ),
)
_TS_SYNC = 0x47
_TS_PACKETS = ((0, 188), (4, 192))  # MPEG transport streams: first sync byte, and the distance of the next
_MOST_FRAMES = 20_000  # to be written
_JPEG_QUALITY = 95
_SMALL_PX = 960  # longer side at which sharpness is judged
_LONGEST_GAP_S = 1.0  # between a frame and its subtitle


def write_frames(
    video: Path, options: IngestOptions, folder: Path, remarks: Remarks, progress: Progress = SILENT
) -> tuple[list[str], FloatArray]:
    """Write the sharpest frame of each interval as `NAME_nnnnn.jpg`; return names and times (N,) in seconds.

    Raises:
        InputError: no such file, not a video that OpenCV's FFmpeg reads, too large frames, or too many of them.
    """
    step_s = seconds_apart(options)
    folder.mkdir(parents=True, exist_ok=True)
    names: list[str] = []
    times: list[float] = []
    for number, (time_s, pixels) in enumerate(_sharpest(video, step_s, progress)):
        names.append(f"{video.stem}_{number:05d}.jpg")
        times.append(time_s)
        jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        (folder / names[-1]).write_bytes(jpeg.tobytes())
    if options.every is None:
        remarks.assume(
            "video-every",
            f"The sharpest frame of every {_EVERY} of {video.name} is a photograph.",
            "--every sets another interval.",
        )
    return names, np.array(times)


def seconds_apart(options: IngestOptions) -> float:
    """Return the length of an interval in seconds; an InputError: it is stated in metres."""
    every = options.every or _EVERY
    if every.unit != "s":
        raise InputError(
            "video-every-in-metres",
            f"--every {every} counts metres, and a video has times alone.",
            field="--every",
            remedy="Give seconds, such as 1s.",
        )
    return every.step


def video_length(video: Path) -> float:
    """Return the length of a video in seconds by its header; errors as of `write_frames`."""
    capture, count, rate = _opened(video)
    capture.release()
    return count / rate


def _opened(video: Path) -> tuple[cv2.VideoCapture, int, float]:
    """Return a video with the number of its frames, as its header has it, and how many there are a second."""
    if not video.is_file():
        raise InputError("no-video", "The video does not exist.", path=video, field="--video")
    if not _is_container(video):
        message = (
            "The file is no video: it has none of the containers MP4, MOV, AVI, MKV, WebM, WMV, FLV, Ogg and MPEG."
        )
        raise InputError("not-a-video", message, path=video, field="--video")
    # A name with a colon means a protocol to FFmpeg, unless it follows a folder.
    capture = cv2.VideoCapture(str(video.absolute()), cv2.CAP_FFMPEG)
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not capture.isOpened() or not width * height:
        capture.release()
        raise InputError("not-a-video", "The file is no video that can be read.", path=video, field="--video")
    if width * height > MAX_PIXELS:
        capture.release()
        raise InputError(
            "image-too-large",
            f"Frames have {width:.0f}×{height:.0f} pixels, too many.",
            path=video,
            field="--video",
        )
    count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    return capture, count, max(float(capture.get(cv2.CAP_PROP_FPS)), 1e-3)


def _is_container(video: Path) -> bool:
    """Return whether a file begins as a container of video does."""
    with video.open("rb") as file:
        head = file.read(1024)
    if any(head[at : at + len(mark)] == mark for at, marks in _CONTAINERS for mark in marks):
        return head[:4] == b"RIFF" or head[8:11] != b"AVI"
    return any(
        len(head) > first + 2 * step and all(head[first + k * step] == _TS_SYNC for k in range(3))
        for first, step in _TS_PACKETS
    )


def _sharpest(video: Path, step_s: float, progress: Progress) -> Iterator[tuple[float, ByteArray]]:
    """Yield time and pixels (H, W, 3) BGR of the sharpest frame of each interval, in order."""
    capture, count, rate = _opened(video)
    if count / rate / step_s > _MOST_FRAMES:
        capture.release()
        raise InputError(
            "too-many-frames",
            f"{count / rate / step_s:.0f} frames are due, {_MOST_FRAMES} at the most.",
            path=video,
            field="--every",
            remedy="Give a longer --every.",
        )
    best: tuple[float, float, ByteArray] | None = None
    interval, read = 0, 0
    try:
        with progress.task("video", count) as task:
            while True:
                known, frame = capture.read()
                if not known:
                    break
                time_s = read / rate  # of a constant rate, as drones record
                read += 1
                task.advance()
                if int(time_s / step_s + 1e-9) != interval:
                    if best is not None:
                        yield best[1], best[2]
                    best, interval = None, int(time_s / step_s + 1e-9)
                pixels = np.asarray(frame, dtype=np.uint8)
                shrink = max(1, math.ceil(max(pixels.shape) / _SMALL_PX))
                size = (pixels.shape[1] // shrink, pixels.shape[0] // shrink)
                grey = cv2.cvtColor(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2GRAY)
                score = float(cv2.Laplacian(grey, cv2.CV_64F).var())
                if best is None or score > best[0]:
                    best = score, time_s, pixels
            if best is not None:
                yield best[1], best[2]
    finally:
        capture.release()
    if not read:
        raise InputError("not-a-video", "No frame of the video can be decoded.", path=video, field="--video")


def recorded_positions(video: Path, remarks: Remarks) -> VideoPositions | None:
    """Return the positions that a video was recorded with: DJI's subtitles beside it, or a GoPro's telemetry in it.

    Raises:
        InputError: as of `read_subtitles` and `read_telemetry`.
    """
    for subtitles in (video.with_suffix(".SRT"), video.with_suffix(".srt")):
        if subtitles.is_file():
            return read_subtitles(subtitles)
    telemetry = read_telemetry(video)
    if telemetry is not None:
        lost = int(np.isnan(telemetry.lon_lat_height[:, 0]).sum())
        if lost:
            remarks.warn(
                "telemetry-without-fix",
                f"{lost} of {len(telemetry.time_s)} positions in {video.name} are left out: without a fix in three "
                "dimensions, or with a DOP over 10.",
            )
    return telemetry


def frame_positions(log: VideoPositions, names: list[str], time_s: FloatArray) -> PoseTable:
    """Return the positions of frames at times (N,) in the video, between those that were recorded."""
    at = np.clip(np.searchsorted(log.time_s, time_s), 1, max(len(log.time_s) - 1, 1)) - 1
    xyz = np.column_stack([np.interp(time_s, log.time_s, log.lon_lat_height[:, axis]) for axis in range(3)])
    apart = np.min([np.abs(log.time_s[np.clip(at + k, 0, len(log.time_s) - 1)] - time_s) for k in (0, 1)], axis=0)
    xyz[apart > _LONGEST_GAP_S] = np.nan
    return PoseTable(
        path=log.path,
        source=log.source,
        lines=log.lines[np.clip(at, 0, len(log.lines) - 1)],
        names=tuple(names),
        time_s=None if log.utc_from_video_s is None else time_s + log.utc_from_video_s,
        xyz=xyz,
        geographic=True,
        receiver=np.full(len(names), log.receiver),
        heights_above_geoid=log.heights_above_geoid,
    )
