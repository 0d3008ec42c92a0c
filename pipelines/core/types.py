"""Array and tuple types that all rooms share, and rows of records of arrays.

Arrays are numpy's. Their shapes, units and frames are stated in docstrings, and beside the fields of classes.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]
AnyArray = NDArray[Any]  # of any type

# `FunctionCtx` of torch, whose class declares neither `saved_tensors` nor what a forward pass keeps.
AutogradContext = Any

# Arrays of kernels, named by their shapes: N rows, K columns, an image of H × W pixels with C channels. Numba
# compiles a kernel for the precision that it is given, `float32/64` beside an argument.
ArrayN = NDArray[Any]
ArrayN3 = NDArray[Any]
ArrayN4 = NDArray[Any]
ArrayNK = NDArray[Any]
ArrayNK3 = NDArray[Any]
Array33 = NDArray[Any]
Array34 = NDArray[Any]
ArrayHW = NDArray[Any]
ArrayHWC = NDArray[Any]
ArrayNHW = NDArray[Any]

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Quaternion = Vector4
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix34 = tuple[Vector4, Vector4, Vector4]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]
Matrix9 = tuple[float, float, float, float, float, float, float, float, float]  # (3, 3), row by row
Row7 = tuple[float, float, float, float, float, float, float]


def vector3(values: FloatArray) -> Vector3:
    """Return an array (3,) as numbers, for a file."""
    x, y, z = values.tolist()
    return x, y, z


RecordT = TypeVar("RecordT")


class Rows:
    """Base of dataclasses of arrays, and as long as the first of these."""

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))


def rows_of(record: RecordT, rows: IntArray | BoolArray) -> RecordT:
    """Return the same dataclass of arrays (P, …), with some of their rows; what is no array stays."""
    arrays = {name: value[rows] for name, value in vars(record).items() if isinstance(value, np.ndarray)}
    return type(record)(**(vars(record) | arrays))


def joined_rows(records: Sequence[RecordT]) -> RecordT:
    """Return the rows of all dataclasses of arrays (P, …), at least one; what is no array is that of the first."""
    arrays = {
        name: np.concatenate([vars(record)[name] for record in records])
        for name, value in vars(records[0]).items()
        if isinstance(value, np.ndarray)
    }
    return type(records[0])(**(vars(records[0]) | arrays))
