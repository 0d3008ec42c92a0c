"""What a product written by hand is checked for, beyond the types of its fields.

Each function returns its argument, or raises ValueError with what is wrong; pydantic adds file and field.
"""

from __future__ import annotations

import unicodedata
from pathlib import PurePosixPath

import numpy as np

from pipelines.core.types import Vector3

_UNIT_TOLERANCE = 1e-3
_LEAST_EIGENVALUE_RATIO = 1e-12


def stays_inside(path: str) -> bool:
    """Whether a relative path cannot lead out of the folder that it is relative to (but for links in it).

    Control characters and bytes that are no text have no place in it either: lists of names are split at them.
    """
    pure = PurePosixPath(path)
    is_text = not any(unicodedata.category(character) in ("Cc", "Cs") for character in path)
    return bool(pure.parts) and not pure.is_absolute() and ".." not in pure.parts and is_text


def image_name(name: str) -> str:
    """A name relative to the folder of photographs."""
    if not stays_inside(name):
        raise ValueError(f"{name!r} leaves the folder of photographs: names are relative to it")
    return name


def image_dir(path: str) -> str:
    """A folder of photographs: anywhere by its absolute path, or inside the workspace."""
    pure = PurePosixPath(path)
    if not pure.is_absolute() and pure.parts and not stays_inside(path):
        raise ValueError(f"{path!r} leaves the workspace: give an absolute path")
    return path


def unit_quaternion(quat: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """A rotation."""
    length = float(np.linalg.norm(quat))
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise ValueError(f"a rotation is a quaternion of length 1, this has {length:g}")
    return quat


def covariance(rows: tuple[Vector3, Vector3, Vector3]) -> tuple[Vector3, Vector3, Vector3]:
    """A covariance that can be divided by."""
    matrix = np.array(rows)
    values = np.linalg.eigvalsh(matrix)
    if not np.allclose(matrix, matrix.T, rtol=1e-6) or values[0] <= _LEAST_EIGENVALUE_RATIO * values[-1]:
        raise ValueError("a covariance is symmetric and positive definite")
    return rows
