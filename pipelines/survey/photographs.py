"""Undistorted photographs at training size, cached as plain arrays on disk and mapped into memory.

Also their pinholes under a lens that has changed since; photographs undistorted at full size, for other programs;
and the files of the test views: photograph, render and their difference side by side in one PNG.
"""

import hashlib
import logging
import math
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.files import replacing
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import AnyArray, BoolArray, ByteArray, Float32Array, FloatArray
from pipelines.formats.image_file import read_bytes, require_unchanged
from pipelines.geometry.cameras import Camera, Lenses, Pinhole, distort, focal_and_center, refit_pinhole, undistort

log = logging.getLogger(__name__)

# Width of the edge that the mask leaves out: interpolation there needs pixels from beyond the photograph.
_EDGE_PX = 0.5
_WHOLLY = 0.999  # of an interpolated mask: no part of the pixel is left out
_SAME_RAY = 1e-6  # of normalised coordinates
_ZOOM_STEP, _MOST_ZOOM, _BISECTIONS = 1.1, 4.0, 20
_JPEG_QUALITY = 95
_BAND_PX = 1_000_000  # pixels whose distortion is computed at once, in two hundred bytes each


@dataclass(frozen=True)
class Photograph:
    """Photograph to undistort: its name, its file, its camera at full size, and the survey's hash of the file.

    `shift` (h, w, 2) is a grid over a photograph of a rolling shutter: how far in pixels of the full size from its
    place under a global shutter each of its pixels lies. None: a global shutter.
    `mask` is a picture of the photograph's size, black where it does not count. None: all of it counts.
    """

    name: str
    file: Path
    camera: Camera
    sha256: str = ""
    shift: Float32Array | None = None
    mask: Path | None = None
    mask_sha256: str = ""

    @property
    def margin(self) -> float:
        """Largest shift, as a share of the photograph's height."""
        return 0.0 if self.shift is None else float(np.abs(self.shift).max()) / self.camera.height


def pinhole_of(camera: Camera, max_size_px: int) -> Pinhole:
    """Return the pinhole camera of the same view, its longer side limited to `max_size_px`.

    The focal length is scaled with the size. Distortion parameters are dropped.
    """
    fx, fy, cx, cy = focal_and_center(camera).tolist()
    return Pinhole(camera.width, camera.height, fx, fy, cx, cy).limited(max_size_px)


class ImageCache:
    """Undistorted images on disk: uint8 RGB arrays, made once and mapped into memory on access.

    Memory does not grow with their number. Only the last distortion map stays in memory, until all images are
    built. Masks, one for each camera or masked photograph, and shrunken images are stored beside the images.
    """

    def __init__(self, folder: Path, photographs: list[Photograph], max_size_px: int) -> None:
        self._folder = folder
        self._photographs = photographs
        self.max_size_px = max_size_px
        self._last_map: tuple[str, Float32Array, BoolArray] | None = None

    def __len__(self) -> int:
        return len(self._photographs)

    def pinhole(self, index: int) -> Pinhole:
        return pinhole_of(self._photographs[index].camera, self.max_size_px)

    def largest(self) -> Pinhole:
        cameras = (self.pinhole(index) for index in range(len(self)))
        return max(cameras, key=lambda camera: camera.width * camera.height)

    def build(self, progress: Progress = SILENT) -> None:
        """Make all images that are not yet in the cache.

        Raises:
            InputError: a photograph cannot be read, is not that of the survey, or has another size than its camera.
        """
        with progress.task("undistorting", len(self)) as task:
            for index in range(len(self)):
                if not self._path(index).exists():
                    self._write(index)
                task.advance()
        self._last_map = None

    def image(self, index: int, shrink: int = 1) -> ByteArray:
        """Return the RGB values (H // s, W // s, 3) of an image, mapped from disk.

        Each pixel is the mean of s × s pixels, s being `shrink`. A missing or damaged file is made again.

        Raises:
            InputError: the photograph cannot be read, or has another size than its camera.
        """
        path = self._path(index) if shrink == 1 else self._folder / f"{self.key(index)}.{shrink}.npy"

        def write() -> None:
            if shrink == 1:
                self._write(index)
                return
            image = self.image(index)
            height, width = (side // shrink for side in image.shape[:2])
            blocks = image[: height * shrink, : width * shrink]
            save_array(path, cv2.resize(blocks, (width, height), interpolation=cv2.INTER_AREA))

        if not path.exists():
            write()
        try:
            return mapped_array(path)
        except (ValueError, EOFError):  # truncated by a full disk or a power failure
            log.warning("%s is damaged and made again", path)
            write()
            return mapped_array(path)

    def decoded(self, index: int) -> ByteArray:
        """Return a photograph (H, W, 3) as it was taken, RGB at its full size, from its file.

        Raises:
            InputError: it cannot be read, is not that of the survey, or has another size than its camera.
        """
        return np.ascontiguousarray(_decoded(self._photographs[index])[..., ::-1])

    def sampled(self, index: int, decoded: AnyArray, place: Float32Array) -> NDArray[Any]:
        """Return the colours (…) or (…, 3) of a decoded photograph at places (…, 2) in pixels of its pinhole.

        The photograph is interpolated once, where reading its undistorted image would be the second time. The cache
        must be one of photographs at full size.
        """
        photograph, flat = self._photographs[index], (place - 0.5).astype(np.float32)
        lens = self._map(index)[0]
        source: Float32Array = np.asarray(
            cv2.remap(lens, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.float32,
        )
        if photograph.shift is not None:
            source = source + _shift_at(photograph, source)
        colours = cv2.remap(decoded, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(colours, dtype=decoded.dtype)

    def mask(self, index: int) -> BoolArray:
        """Return the mask (H, W) of the pixels that the photograph covers and that count, mapped from disk.

        Raises:
            InputError: the photograph's own mask does not exist, or is not that of the survey.
        """
        path = self._folder / f"{self.mask_key(index)}.mask.npy"
        if not path.exists():
            mask, edge = self._map(index)[1], self._moved_edge_px(index)
            if edge:  # pixels from beyond the photograph come in at its edges
                square = np.ones((2 * edge + 1, 2 * edge + 1), np.uint8)
                shrunken = cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
                mask = np.asarray(shrunken, dtype=bool)
            save_array(path, mask & self._own_mask(index))
        return mapped_array(path)

    def is_masked(self, index: int) -> bool:
        """Return whether a photograph has a mask of its own."""
        return self._photographs[index].mask is not None

    def _own_mask(self, index: int) -> BoolArray:
        """Return the undistorted mask (H, W) of a photograph: pixels that no black pixel of it touches."""
        photograph, pinhole = self._photographs[index], self.pinhole(index)
        if photograph.mask is None:
            return np.ones((pinhole.height, pinhole.width), dtype=bool)
        data = read_bytes(photograph.mask)
        require_unchanged(data, photograph.mask_sha256, photograph.mask)
        full = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        if full is None or full.shape != (photograph.camera.height, photograph.camera.width):
            message = "The mask is not that of the photograph."
            remedy = "Run `georef ingest` again."
            raise InputError("mask-damaged", message, path=photograph.mask, remedy=remedy)
        counts = np.where(full > 0, np.float32(1), np.float32(0))
        small = cv2.resize(counts, (pinhole.width, pinhole.height), interpolation=cv2.INTER_AREA)
        source = self._map(index)[0]
        if photograph.shift is not None:
            source = source + _shift_at(photograph, source)
        flat = cv2.remap(small, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return np.asarray(flat > _WHOLLY)

    def _moved_edge_px(self, index: int) -> int:
        return math.ceil(self._photographs[index].margin * self.pinhole(index).height)

    def mask_key(self, index: int) -> str:
        """Return the key of a mask. Photographs of a camera share it but for rolling shutters and own masks."""
        photograph = self._photographs[index]
        camera, edge = photograph.camera, self._moved_edge_px(index)
        key = f"{camera.model}|{camera.width}x{camera.height}|{camera.params.tobytes().hex()}|{self.max_size_px}"
        key += f"|{edge}" if edge else ""
        if photograph.mask is not None:
            key += f"|{photograph.mask_sha256}"
            key += "" if photograph.shift is None else f"|{photograph.shift.tobytes().hex()}"
        return hashlib.sha256(key.encode()).hexdigest()[:32]

    def _path(self, index: int) -> Path:
        return self._folder / f"{self.key(index)}.npy"

    def key(self, index: int) -> str:
        """Return the key of an undistorted image: a hash of file name, size, time and content, camera and limit.

        Raises:
            InputError: the photograph does not exist.
        """
        photograph = self._photographs[index]
        try:
            stat = photograph.file.stat()
        except OSError as error:
            message = f"The photograph cannot be read ({error.strerror})."
            remedy = "Restore it, or run `georef ingest` again."
            raise InputError("photograph-missing", message, path=photograph.file, remedy=remedy) from error
        camera = photograph.camera
        key = (
            f"{photograph.name}|{stat.st_size}|{stat.st_mtime_ns}|{camera.model}|{camera.width}x{camera.height}|"
            f"{camera.params.tobytes().hex()}|{self.max_size_px}|{photograph.sha256}"
        )
        if photograph.shift is not None:
            key += f"|{photograph.shift.tobytes().hex()}"
        return hashlib.sha256(key.encode()).hexdigest()[:32]

    def _write(self, index: int) -> None:
        flat = _undistorted(self._photographs[index], self.pinhole(index), self._map(index)[0])
        save_array(self._path(index), np.ascontiguousarray(flat[..., ::-1]))

    def _map(self, index: int) -> tuple[Float32Array, BoolArray]:
        """Return the place (H, W, 2) of each undistorted pixel in the shrunken photograph, and the mask (H, W)."""
        camera = self._photographs[index].camera
        key = f"{camera.model}|{camera.width}x{camera.height}|{camera.params.tobytes().hex()}"
        if self._last_map is None or self._last_map[0] != key:
            self._last_map = (key, *_distortion_map(camera, self.pinhole(index)))
        return self._last_map[1:]


def decoded_photograph(file: Path, sha256: str) -> ByteArray | None:
    """Return a photograph (H, W, 3) BGR, its EXIF orientation ignored as by COLMAP; None: it does not decode.

    Raises:
        InputError: it cannot be read, or is not that of the survey.
    """
    data = read_bytes(file)
    require_unchanged(data, sha256, file)
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    return None if pixels is None else np.asarray(pixels, dtype=np.uint8)


def _undistorted(
    photograph: Photograph, pinhole: Pinhole, source: Float32Array, interpolation: int = cv2.INTER_CUBIC
) -> ByteArray:
    """Return a photograph (H, W, 3) BGR of a pinhole, each pixel from its place `source` (H, W, 2).

    Raises:
        InputError: the photograph cannot be read, is not that of the survey, or has another size than its camera.
    """
    small = cv2.resize(_decoded(photograph), (pinhole.width, pinhole.height), interpolation=cv2.INTER_AREA)
    if photograph.shift is not None:
        source = source + _shift_at(photograph, source)
    flat = cv2.remap(small, source[..., 0], source[..., 1], interpolation, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(flat, dtype=np.uint8)


def _decoded(photograph: Photograph) -> ByteArray:
    """Return a photograph (H, W, 3) BGR at full size; an InputError: it is not that of the survey."""
    full = decoded_photograph(photograph.file, photograph.sha256)
    if full is None:
        raise InputError("photograph-damaged", "The photograph cannot be read.", path=photograph.file)
    if (full.shape[1], full.shape[0]) != (photograph.camera.width, photograph.camera.height):
        raise InputError(
            "photograph-size",
            f"The photograph has {full.shape[1]}×{full.shape[0]} pixels, its camera "
            f"{photograph.camera.width}×{photograph.camera.height}",
            path=photograph.file,
        )
    return full


def _shift_at(photograph: Photograph, source: Float32Array) -> Float32Array:
    """Return the shift (H, W, 2) of a rolling shutter at places (H, W, 2) in the shrunken photograph."""
    assert photograph.shift is not None
    height, width = source.shape[:2]
    cells = np.array(photograph.shift.shape[1::-1]) / (width, height)
    place = ((source + 0.5) * cells - 0.5).astype(np.float32)
    shift = cv2.remap(
        photograph.shift, place[..., 0], place[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(shift * (width / photograph.camera.width), dtype=np.float32)


def covered_pinhole(camera: Camera) -> Pinhole:
    """Return the pinhole of a camera's size and principal point that shows nothing from beyond its photograph.

    The focal length is that of the camera, or the least larger one.

    Raises:
        InputError: none is small enough to be of use.
    """
    whole = pinhole_of(camera, max(camera.width, camera.height))
    x, y = np.arange(whole.width) + 0.5, np.arange(whole.height) + 0.5
    u = np.concatenate([x, x, np.full_like(y, x[0]), np.full_like(y, x[-1])])
    v = np.concatenate([np.full_like(x, y[0]), np.full_like(x, y[-1]), y, y])

    def zoomed(zoom: float) -> Pinhole:
        return replace(whole, fx=zoom * whole.fx, fy=zoom * whole.fy)

    low = high = 1.0
    while not _sources(camera, zoomed(high), u, v)[1].all():
        low, high = high, high * _ZOOM_STEP
        if high > _MOST_ZOOM:
            message = (
                f"The lens {camera.model} cannot be undistorted: its picture would be enlarged {high:.1f} times."
            )
            raise InputError("lens-not-undistorted", f"{message} Leave out --undistorted.")
    for _ in range(_BISECTIONS if low < high else 0):
        middle = (low + high) / 2
        low, high = (low, middle) if _sources(camera, zoomed(middle), u, v)[1].all() else (middle, high)
    return zoomed(high)


def undistorted_name(name: str) -> str:
    """Return the name of an undistorted photograph, which is a JPEG."""
    return name if Path(name).suffix.lower() in (".jpg", ".jpeg") else f"{name}.jpg"


def write_undistorted(folder: Path, photographs: list[Photograph], progress: Progress = SILENT) -> list[Pinhole]:
    """Write photographs at full size without distortion as JPEG of quality 95, and return the pinhole of each.

    Raises:
        InputError: a photograph cannot be read, is not that of the survey, has another size than its camera, or a
            lens that cannot be undistorted.
    """
    of_lens: dict[str, list[int]] = {}
    for index, photograph in enumerate(photographs):
        camera = photograph.camera
        key = f"{camera.model} {camera.width} {camera.height} {camera.params.tobytes().hex()}"
        of_lens.setdefault(key, []).append(index)
    pinholes: dict[int, Pinhole] = {}
    with progress.task("undistorting", len(photographs)) as task:
        for indices in of_lens.values():  # one map is in memory, because they are large
            camera = photographs[indices[0]].camera
            pinhole = covered_pinhole(camera)
            source, _ = _distortion_map(camera, pinhole)
            for index in indices:
                # OpenCV's cubic kernel moves details by up to 0.045 px, Lanczos by half of that.
                flat = _undistorted(photographs[index], pinhole, source, cv2.INTER_LANCZOS4)
                _, jpeg = cv2.imencode(".jpg", flat, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
                path = folder / undistorted_name(photographs[index].name)
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(jpeg.tobytes())
                pinholes[index] = pinhole
                task.advance()
    return [pinholes[index] for index in range(len(photographs))]


def save_array(path: Path, array: AnyArray) -> None:
    """Write an array to a temporary file, and rename that: the file at `path` is always complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.stem}.{uuid4().hex}.tmp")  # Several processes may make the same file at once.
    with replacing(path, draft), draft.open("wb") as handle:
        np.save(handle, array, allow_pickle=False)


# numpy reads a header by Python's parser, which some versions refuse with a SystemError in two threads at once.
_HEADERS = threading.Lock()


def mapped_array(path: Path) -> NDArray[Any]:
    """Return an array that `save_array` wrote, mapped from disk."""
    with _HEADERS:
        array: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    return array


def _distortion_map(camera: Camera, pinhole: Pinhole) -> tuple[Float32Array, BoolArray]:
    source = np.empty((pinhole.height, pinhole.width, 2), dtype=np.float32)
    inside = np.empty((pinhole.height, pinhole.width), dtype=bool)
    rows = max(1, _BAND_PX // pinhole.width)
    for top in range(0, pinhole.height, rows):
        band = slice(top, min(top + rows, pinhole.height))
        source[band], inside[band] = _distortion_of_rows(camera, pinhole, band)
    return source, inside


def _distortion_of_rows(camera: Camera, pinhole: Pinhole, rows: slice) -> tuple[FloatArray, BoolArray]:
    u, v = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    return _sources(camera, pinhole, u, v)


def _sources(camera: Camera, pinhole: Pinhole, u: FloatArray, v: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the place (…, 2) of pixels of a pinhole in the photograph of its size, and whether it covers them."""
    ray = np.stack([(u - pinhole.cx) / pinhole.fx, (v - pinhole.cy) / pinhole.fy], axis=-1)
    full = distort(camera, ray)
    # Beyond its fold a lens polynomial leads back into the picture, to the pixel of another ray.
    with np.errstate(invalid="ignore"):
        is_same_ray = (np.abs(undistort(camera, full) - ray) < _SAME_RAY).all(axis=-1)
    size = np.array([pinhole.width / camera.width, pinhole.height / camera.height])
    small = full * size
    limit = np.array([pinhole.width, pinhole.height]) - _EDGE_PX
    inside = is_same_ray & ((small >= _EDGE_PX) & (small <= limit)).all(axis=-1)
    # cv2 counts from the centre of the first pixel, and is slow to reflect pixels far outside.
    return np.clip(np.nan_to_num(small - 0.5), -limit, 2 * limit), inside


class Pinholes:
    """Pinhole of each image, which maps the rays of the present lens to pixels of the undistorted photograph.

    Photographs are undistorted once, with the lenses `first`. A later change of the lens is expressed as another
    pinhole (`geometry.cameras`); without `first`, the lenses never change.
    """

    def __init__(self, images: ImageCache, first: Lenses | None = None) -> None:
        self._images, self._first, self._now = images, first, first
        self._fitted: dict[int, Pinhole] = {}

    def renew(self, now: Lenses) -> None:
        self._now = now
        self._fitted.clear()

    def of(self, index: int) -> Pinhole:
        """Return the camera of an image, at the size of the undistorted photographs."""
        if self._first is None or self._now is None:
            return self._images.pinhole(index)
        key = int(self._first.camera_id[index])  # Photographs of one camera share a pinhole.
        if key not in self._fitted:
            before, after = self._first.of(index), self._now.of(index)
            self._fitted[key] = refit_pinhole(self._images.pinhole(index), before, after)
        return self._fitted[key]


DIFFERENCE_GAIN = 3
_LONGEST_NAME_BYTES = 255


def write_render(folder: Path, image: str, strip: ByteArray) -> None:
    """Write a strip (H, W, 3) RGB as PNG: photograph of that name, render and difference, with labels above."""
    _, png = cv2.imencode(".png", np.ascontiguousarray(strip[..., ::-1]))  # `imwrite` reports no full disk
    (folder / render_name(image)).write_bytes(png.tobytes())


def render_name(image: str) -> str:
    """Return the file name of an image's render: its folders and name, or their hash beyond 255 bytes."""
    name = Path(image).with_suffix(".png").as_posix().replace("/", "_")
    if len(name.encode()) <= _LONGEST_NAME_BYTES:
        return name
    return f"{hashlib.sha256(name.encode()).hexdigest()[:32]}.png"
