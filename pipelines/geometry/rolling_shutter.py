"""Rolling shutter: rows of a photograph are read one after another while the camera moves.

Row r of H is read at centre + (r/H − ½) · travel; `travel` is the camera's motion from the first row to the last,
in the axes of the camera and the unit of its depths. The rotation during the readout is taken as zero: a gimbal
holds the camera. A pixel is moved to where a global shutter, at the moment of the middle row, would have shown its
point. That needs the point's depth: of tie points it is known, and the nearest of them stand for other pixels.
"""

import numpy as np
from scipy.spatial import cKDTree

from pipelines.core.types import FloatArray
from pipelines.geometry.cameras import Camera, distort, undistort
from pipelines.geometry.sparse_model import SparseModel

_NEIGHBOURS = 6  # tie points whose depths stand for that of a pixel
_STEPS = 3  # of the row that sees a point: each leaves a hundredth of the error


def in_global_shutter(camera: Camera, xy_px: FloatArray, depth: FloatArray, travel: FloatArray) -> FloatArray:
    """Return pixels (K, 2) as a global shutter would have shown them; depths (K,) are those at the middle row."""
    share = xy_px[:, 1] / camera.height - 0.5
    ray = undistort(camera, xy_px)
    along = (depth - share * travel[2])[:, None]  # the depth from where the row was read
    moved = along * ray + share[:, None] * travel[:2]
    return distort(camera, moved / depth[:, None])


def in_rolling_shutter(camera: Camera, xy_px: FloatArray, depth: FloatArray, travel: FloatArray) -> FloatArray:
    """Return pixels (K, 2) of a global shutter as the rolling shutter shows them; the inverse of the above."""
    point = depth[:, None] * np.column_stack([undistort(camera, xy_px), np.ones(len(xy_px))])
    seen = xy_px
    for _ in range(_STEPS):
        moved = point - (seen[:, 1:] / camera.height - 0.5) * travel
        seen = distort(camera, moved[:, :2] / moved[:, 2:])
    return seen


def depths_at(sparse: SparseModel, image: int, xy_px: FloatArray) -> FloatArray:
    """Return depths (K,) at pixels of an image: harmonic means over the nearest tie points, weighted by closeness.

    An image without tie points has the median depth of all points.
    """
    rows = np.flatnonzero(sparse.obs_image == image)
    rotation, shift = sparse.rotation_cam_from_local[image], sparse.translation_cam_from_local[image]
    depth = sparse.point_in_local[sparse.obs_point[rows]] @ rotation[2] + shift[2]
    rows, depth = rows[depth > 0], depth[depth > 0]
    if not len(rows):
        return np.full(len(xy_px), np.median(sparse.point_in_local @ rotation[2] + shift[2]))
    count = min(_NEIGHBOURS, len(rows))
    apart, near = cKDTree(sparse.obs_xy_px[rows]).query(xy_px, k=np.arange(1, count + 1))
    weight = 1 / (apart + 1.0)
    return np.asarray(weight.sum(axis=1) / (weight / depth[near]).sum(axis=1))
