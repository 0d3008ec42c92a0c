"""Structure of COLMAP's images.txt: two lines an image, of which programs forget the second.

COLMAP reads the line after that of an image as its observations, whatever it holds, and ends later without file and
line (`reconstruction_io_text.cc`, COLMAP 4).
"""

from pathlib import Path

from pipelines.core.errors import InputError

_IMAGE_CELLS = 10  # number, four of the quaternion, three of the translation, camera, name
_FORM = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"


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
