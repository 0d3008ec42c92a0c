"""Masks of photographs: pixels that show nothing of the scene, such as water, the drone's own legs, or the sky.

Masks come from files, black where a photograph is left out, and from the sky that a photograph shows above the
horizon. `ingest` combines them into one PNG a photograph, in the naming of COLMAP.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray
from pipelines.formats.image_file import inspect_image, read_bytes, read_head
from pipelines.geometry.rotations import matrix_from_quat_xyzw
from pipelines.ingest.options import IngestOptions
from pipelines.ingest.remarks import Remarks
from pipelines.survey.image_names import ImageNames
from pipelines.survey.photographs import decoded_photograph
from pipelines.survey.survey import CameraPrior, Survey, SurveyImage

_LEAVES_LITTLE = 0.2  # of a photograph: below, its mask may be inverted
_SKY_PX = 640  # longer side of the picture in which the sky is looked for
_SKY_SMOOTH = 8.0  # grey values between neighbours of a blurred picture: clouds have less, leaves more
_SKY_LEAST_VALUE, _SKY_LEAST_BLUE = 110, 12  # of 255: brightness, and red or green minus blue
_SKY_LEAST_SHARE = 0.002  # of the picture: smaller smooth places are windows or paint
_SKY_RIM_PX = 2
_HORIZON_DEG = 1.0  # below it, haze and hills


def mask_files(options: IngestOptions, names: Sequence[str], remarks: Remarks) -> dict[str, tuple[Path, ...]]:
    """Return the mask files of each photograph that has any; the sky is no file.

    A file of `--masks` is named as its photograph with `.png` added (`a.jpg.png`) or in place of the suffix
    (`a.png`), in the same folders.

    Raises:
        InputError: no folder, no mask of a photograph in it, or a file that is no image.
    """
    files_of: dict[str, list[Path]] = {name: [] for name in names}
    if options.masks is not None:
        root, known = options.masks, ImageNames(names)
        if not root.is_dir():
            raise InputError("no-mask-folder", "The folder of masks does not exist.", path=root, field="--masks")
        foreign = []
        for path in sorted(root.rglob("*.png")):
            if not path.resolve().is_relative_to(root.resolve()):
                continue
            written = path.relative_to(root).as_posix()
            name = known.find(written.removesuffix(".png"), path=path, line=1)
            if name is None:
                foreign.append(written)
            else:
                files_of[name].append(path)
        if not any(files_of.values()):
            raise InputError(
                "no-mask-matches",
                "No mask has the name of a photograph.",
                path=root,
                field="--masks",
                remedy="Name each as its photograph with .png added.",
            )
        remarks.warn_counted("mask-without-photograph", foreign, "Masks without a photograph are not used")
    if options.mask is not None:
        for files in files_of.values():
            files.append(options.mask)
    for path in {path for files in files_of.values() for path in files}:
        inspect_image(read_head(path), path, decode=False)
    return {name: tuple(files) for name, files in files_of.items() if files}


def write_masks(
    survey: Survey, options: IngestOptions, images: Path, folder: Path, progress: Progress = SILENT
) -> Survey:
    """Write the combined masks of a survey's photographs into `folder`, and return the survey with their hashes.

    `images` is the folder of the photographs. A photograph of which nothing is left out has no file.

    Raises:
        InputError: a mask does not decode, has another size than its photograph, or leaves nothing of it.
    """
    if options.masks is None and options.mask is None and not options.mask_sky:
        return survey
    remarks = Remarks(warnings=list(survey.warnings))
    files = mask_files(options, [image.name for image in survey.images], remarks)
    cameras = {camera.camera_id: camera for camera in survey.cameras}
    masked, little, unseen = [], [], []
    with progress.task("masks", len(survey.images)) as task:
        for photograph in survey.images:
            image = photograph
            camera = cameras[image.camera_id]
            scene = np.ones((camera.height, camera.width), dtype=bool)
            for path in files.get(image.name, ()):
                scene &= _read_mask(path, image.name, camera)
            if options.mask_sky:
                sky = _sky_of(image, camera, images)
                if sky is None:
                    unseen.append(image.name)
                else:
                    scene &= ~sky
            if not scene.any():
                raise InputError(
                    "mask-leaves-nothing",
                    f"Its masks leave no pixel of {image.name}. White pixels are used, black are not.",
                    path=files.get(image.name, (images / image.name,))[0],
                    field="--masks",
                )
            if scene.mean() < _LEAVES_LITTLE:
                little.append(image.name)
            if not scene.all():
                path = folder / f"{image.name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                png = cv2.imencode(".png", np.where(scene, np.uint8(255), np.uint8(0)))[1].tobytes()
                path.write_bytes(png)
                image = image.model_copy(update={"mask_sha256": hashlib.sha256(png).hexdigest()})
            masked.append(image)
            task.advance()
    remarks.warn_counted(
        "mask-leaves-little",
        little,
        "Masks leave less than a fifth of their photographs: white pixels are used, black are not",
    )
    remarks.warn_counted("sky-without-attitude", unseen, "Photographs without attitude have no mask of the sky")
    return survey.model_copy(update={"images": tuple(masked), "warnings": tuple(remarks.warnings)})


def _read_mask(path: Path, name: str, camera: CameraPrior) -> BoolArray:
    data = read_bytes(path)
    size = inspect_image(data, path)
    if (size.width, size.height) != (camera.width, camera.height):
        raise InputError(
            "mask-size",
            (f"The mask has {size.width}×{size.height} pixels, and {name} {camera.width}×{camera.height}."),
            path=path,
            field="--masks",
            remedy="Make it of the size of the photograph as stored.",
        )
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(pixels) > 0


def _sky_of(image: SurveyImage, camera: CameraPrior, images: Path) -> BoolArray | None:
    """Return the pixels (H, W) of the sky; None: the photograph has no attitude."""
    if image.attitude is None:
        return None
    shrink = max(1, -(-max(camera.width, camera.height) // _SKY_PX))
    width, height = camera.width // shrink, camera.height // shrink
    focal_px = camera.params[0] / shrink
    v, u = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(u - width / 2) / focal_px, (v - height / 2) / focal_px, np.ones_like(u)], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    up = matrix_from_quat_xyzw(image.attitude.quat_xyzw)[2] @ np.moveaxis(rays, -1, 0).reshape(3, -1)
    lowest_deg = -_HORIZON_DEG - image.attitude.sigma_deg
    above = (up > np.sin(np.radians(lowest_deg))).reshape(height, width)
    if not above.any():
        return np.zeros((camera.height, camera.width), dtype=bool)
    pixels = decoded_photograph(images / image.name, image.sha256)
    assert pixels is not None  # `ingest` has decoded it
    small = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    sky = sky_pixels(small, above).astype(np.uint8)
    whole = cv2.resize(sky, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(whole, dtype=bool)


def sky_pixels(bgr: ByteArray, above: BoolArray) -> BoolArray:
    """Return the pixels (H, W) `above` the horizon that are smooth, bright, and blue or white.

    Trees and roofs before the sky do not belong to it.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY), (5, 5), 0).astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 4
    beyond_blue = bgr[..., 1:].max(axis=-1).astype(np.int16) - bgr[..., 0]
    coloured = (bgr.max(axis=-1) > _SKY_LEAST_VALUE) & (beyond_blue < _SKY_LEAST_BLUE)
    likely = above & (slope < _SKY_SMOOTH) & coloured
    _, label, stats, _ = cv2.connectedComponentsWithStats(likely.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _SKY_LEAST_SHARE * likely.size
    large[0] = False
    square = np.ones((2 * _SKY_RIM_PX + 1,) * 2, np.uint8)
    return np.asarray(cv2.dilate(large[label].astype(np.uint8), square), dtype=bool)
