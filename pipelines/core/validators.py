"""Checks of products that users may write by hand, beyond the types of the fields.

A validator returns its argument, or raises a ValueError that names the fault; `load_json` adds file and field.
"""

import unicodedata
from pathlib import Path, PurePosixPath

import numpy as np

from pipelines.core.errors import InputError
from pipelines.core.types import Vector3

_UNIT_TOLERANCE = 1e-3
_LEAST_EIGENVALUE_RATIO = 1e-12


def stays_inside(path: str) -> bool:
    """Return whether a relative path stays inside its folder; symbolic links are not followed.

    Paths with control characters or undecodable bytes do not count as inside: lists of names are split at them.
    """
    pure = PurePosixPath(path)
    is_text = not any(unicodedata.category(character) in ("Cc", "Cs") for character in path)
    return bool(pure.parts) and not pure.is_absolute() and ".." not in pure.parts and is_text


def require_text(path: Path, field: str | None = None) -> None:
    """Refuse a path that is not UTF-8 text: it could not be recorded."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(
            "name-not-utf8", "has a name that is not UTF-8 text.", path=path, field=field, remedy="Rename it."
        ) from error


def image_name(name: str) -> str:
    """Return an image name that is relative to the folder of photographs and stays inside."""
    if not stays_inside(name):
        raise ValueError(f"{name!r} leaves the folder of photographs. Names are relative to it")
    return name


def image_dir(path: str) -> str:
    """Return the path of a folder of photographs: absolute, or relative and inside the workspace."""
    pure = PurePosixPath(path)
    if not pure.is_absolute() and pure.parts and not stays_inside(path):
        raise ValueError(f"{path!r} leaves the workspace. Give an absolute path")
    return path


def unit_quaternion(quat: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return a quaternion of length 1 ± 1e-3, in either order."""
    length = float(np.linalg.norm(quat))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise ValueError(f"the quaternion has the length {length:g}. Rotations have the length 1")
    return quat


def covariance(rows: tuple[Vector3, Vector3, Vector3]) -> tuple[Vector3, Vector3, Vector3]:
    """Return a covariance (3, 3) that is symmetric and positive definite: its least eigenvalue is above 1e-12 of
    its greatest, and it can be inverted."""
    matrix = np.array(rows)
    values = np.linalg.eigvalsh(matrix)
    if not np.allclose(matrix, matrix.T, rtol=1e-6) or values[0] <= _LEAST_EIGENVALUE_RATIO * values[-1]:
        raise ValueError("the covariance is not symmetric and positive definite")
    return rows
