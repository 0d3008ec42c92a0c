"""Checks of COLMAP's files before or after COLMAP reads them: it takes nonsense, or ends without file and line.

1. `images.txt` has two lines an image, of which programs forget the second. COLMAP reads the line after that of an
   image as its observations, whatever it holds (`reconstruction_io_text.cc`, COLMAP 4).
2. Exporters leave rotations at zero. COLMAP makes a unit quaternion of any, also of zeros, and says nothing.
3. Exporters write focal lengths in millimetres or by the width, and leave them at zero.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Reconstruction

_IMAGE_CELLS = 10  # number, four of the quaternion, three of the translation, camera, name
_FORM = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
# Programs write quaternions with four decimals and more.
_MOST_OFF_UNIT = 0.05
# Of the longer side of the picture: fisheyes of 200° have 0.3, telephoto lenses for birds 40.
_SHORTEST, _LONGEST = 0.03, 300.0


def check_images_text(file: Path) -> None:
    """Refuse an images.txt whose lines are not, by turns, an image and its observations; or with a name not UTF-8.

    Raises:
        InputError: names file and line.
    """
    with file.open("rb") as stream:
        of_image = True
        for number, data in enumerate(stream, start=1):
            try:
                line = data.decode("utf-8").strip()
            except UnicodeDecodeError as error:
                message = "The image has a name that is not UTF-8"
                raise InputError("name-not-utf8", message, path=file, line=number) from error
            if of_image and (not line or line.startswith("#")):
                continue
            fault = _image_fault(line) if of_image else _observations_fault(line)
            if fault is not None:
                code = "images-line" if of_image else "observations-line-missing"
                raise InputError(code, fault, path=file, line=number)
            of_image = not of_image


def _image_fault(line: str) -> str | None:
    if _is_image(line):
        return None
    return (
        f"The line is not that of an image ({_FORM}): {line[:60]!r}. Lines of images and of observations must "
        "stand by turns, without a blank line between images."
    )


def _observations_fault(line: str) -> str | None:
    """Return what is wrong with a line of observations, of which an image may have none."""
    cells = line.split()
    if len(cells) % 3 == 0 and all(map(_is_whole, cells[2::3])):
        return None
    if _is_image(line):
        return (
            "Observations (X Y POINT3D_ID …) of the image above are expected here, and this is the next image: an "
            "image without observations needs an empty line after it. Insert one after each image."
        )
    return f"Observations are three cells each (X Y POINT3D_ID); the line has {len(cells)}: {line[:60]!r}."


def _is_image(line: str) -> bool:
    cells = line.split(None, _IMAGE_CELLS - 1)
    if len(cells) < _IMAGE_CELLS or not (_is_whole(cells[0]) and _is_whole(cells[8])):
        return False
    try:
        [float(cell) for cell in cells[1:8]]
    except ValueError:
        return False
    return True


def _is_whole(cell: str) -> bool:
    return cell.removeprefix("-").isascii() and cell.removeprefix("-").isdigit()


def quaternion_fault(values: Sequence[float]) -> str | None:
    """Return what is wrong with a quaternion (4,), which should be one of length 1; values not finite pass."""
    norm = math.sqrt(sum(value * value for value in values)) if all(map(math.isfinite, values)) else 1.0
    if abs(norm - 1.0) <= _MOST_OFF_UNIT:
        return None
    return f"has a quaternion of norm {norm:.3g}, which is no rotation: that of a unit quaternion is 1"


def check_quaternions_text(file: Path) -> None:
    """Refuse an images.txt with a quaternion that is no rotation; an InputError names file, line and image."""
    with file.open("rb") as stream:
        of_image = True
        for number, data in enumerate(stream, start=1):
            line = data.decode("utf-8", "replace").strip()
            if of_image and (not line or line.startswith("#")):
                continue
            fault = _fault_in(line) if of_image else None
            if fault is not None:
                raise InputError("quaternion-norm", fault, path=file, line=number, field="QW QX QY QZ")
            of_image = not of_image


def _fault_in(line: str) -> str | None:
    cells = line.split(None, 9)
    if len(cells) < 10:  # COLMAP says what is wrong with it
        return None
    try:
        fault = quaternion_fault([float(cell) for cell in cells[1:5]])
    except ValueError:
        return None
    return None if fault is None else f"The image {cells[9]!r} {fault}. Write its pose again."


def check_lenses(reconstruction: Reconstruction, file: Path) -> None:
    """Refuse a model with an image whose camera has no possible focal length; an InputError names the camera."""
    for camera_id in sorted({image.camera_id for image in reconstruction.images.values()}):
        camera = reconstruction.cameras[camera_id]
        side_px = max(int(camera.width), int(camera.height))
        for index in camera.focal_length_idxs():
            focal_px = float(camera.params[index])
            if math.isfinite(focal_px) and not _SHORTEST * side_px <= focal_px <= _LONGEST * side_px:
                message = (
                    f"Camera {camera_id} ({camera.model_name}, {camera.width}×{camera.height} pixels) has a focal "
                    f"length of {focal_px:g} px, which no lens has. COLMAP counts it in pixels, not in millimetres "
                    "or picture widths."
                )
                raise InputError("focal-length-impossible", message, path=file, field=f"camera {camera_id}")
