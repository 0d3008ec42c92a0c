"""Values in COLMAP's files that are nonsense: rotations of no length, lenses without a focal length.

Exporters leave fields at zero, and write focal lengths in millimetres or by the width. COLMAP makes a unit
quaternion of any, also of zeros, and says nothing.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from pipelines.core.errors import InputError
from pipelines.geometry.cameras import Reconstruction

# Programs write quaternions with four decimals and more.
_MOST_OFF_UNIT = 0.05
# Of the longer side of the picture: fisheyes of 200° have 0.3, telephoto lenses for birds 40.
_SHORTEST, _LONGEST = 0.03, 300.0


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
