"""Product of `geolocate`: SfM points on Earth, each with its covariance."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.core.errors import InputError
from pipelines.core.products import load_npz, save_npz
from pipelines.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class GeolocatedPoints:
    """Product of `geolocate`: N SfM points intersected in the geo frame.

    Attributes:
        point_id: (N,) int64, ids in the COLMAP model.
        position_in_geo: (N, 3) float64, metres; NaN where rays did not intersect.
        cov_in_geo: (N, 3, 3) float64, m².
        ray_count: (N,) int32, rays in use.
        max_angle_deg: (N,) float64, largest angle between two of its rays.
        condition: (N,) float64, condition number of the normal matrix.
        inlier: (N,) bool.
        rotation_source: source of the rays' rotations: "recorded" attitudes or "sfm".
    """

    point_id: IntArray
    position_in_geo: FloatArray
    cov_in_geo: FloatArray
    ray_count: NDArray[np.int32]
    max_angle_deg: FloatArray
    condition: FloatArray
    inlier: BoolArray
    rotation_source: str

    def save(self, path: Path) -> None:
        """Write the points as NPZ."""
        save_npz(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> GeolocatedPoints:
        """Read points from NPZ.

        Raises:
            InputError: the file is no NPZ file with these arrays.
        """
        arrays = load_npz(path, tuple(field.name for field in fields(cls)))
        for name, (kind, shape) in _POINT_ARRAYS.items():
            array = arrays[name]
            if array.dtype.kind not in kind or array.shape != (len(arrays["point_id"].ravel()), *shape):
                raise InputError(f"has the form {array.shape} {array.dtype}", path=path, field=name)
        source = str(arrays.pop("rotation_source"))
        return cls(**arrays, rotation_source=source)


# Kind of number, and shape of one point's entry.
_POINT_ARRAYS: dict[str, tuple[str, tuple[int, ...]]] = {
    "point_id": ("i", ()),
    "position_in_geo": ("f", (3,)),
    "cov_in_geo": ("f", (3, 3)),
    "ray_count": ("i", ()),
    "max_angle_deg": ("f", ()),
    "condition": ("f", ()),
    "inlier": ("b", ()),
}
