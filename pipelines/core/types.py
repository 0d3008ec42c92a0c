"""Array and tuple types that all rooms share.

Arrays are numpy's. Their shapes, units and frames are stated in the docstrings of the functions and classes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ByteArray = NDArray[np.uint8]

Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]
Quaternion = Vector4
Matrix3 = tuple[Vector3, Vector3, Vector3]
Matrix34 = tuple[Vector4, Vector4, Vector4]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]
Row7 = tuple[float, float, float, float, float, float, float]
