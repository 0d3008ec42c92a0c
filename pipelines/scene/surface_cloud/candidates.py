"""Candidates of the point cloud: the pixels of the depth maps with their normals, where a surface is smooth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray
from pipelines.geometry.similarity import Similarity
from pipelines.scene.surface_views import SurfaceView

_REACH_PX = 2  # of the differences that give a normal
_BEND = 0.01  # limit of |z/z₁ + z/z₂ − 2| for a depth z between opposite neighbours z₁, z₂ on a smooth surface
_LOOK_PX = 8  # between the pixels that tell which part of a view shows a square
_GRAZING = 0.17  # least cosine between ray and normal (80°): blurred edges bridge two surfaces along the rays


@dataclass(frozen=True)
class Candidates:
    """P points of the surface in `geo`.

    Attributes:
        position: (P, 3) metres.
        normal: (P, 3) unit vectors towards the camera.
        rgb: (P, 3) uint8.
        pixel_m: (P,) width of a pixel at the point.
    """

    position: FloatArray
    normal: FloatArray
    rgb: ByteArray
    pixel_m: FloatArray

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.position)

    @staticmethod
    def concatenate(parts: list[Candidates]) -> Candidates:
        """Return the points of all parts; at least one part."""
        return Candidates(*(np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])))

    def part(self, rows: IntArray | BoolArray) -> Candidates:
        """Return the points of the given rows."""
        return Candidates(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class Square:
    """Square of the plan, east and north in `geo`, half open towards north and east."""

    corner_m: tuple[float, float]
    side_m: float

    def holds(self, position: FloatArray, margin_m: float = 0.0) -> BoolArray:
        """Return whether points (…, 3) lie in the square, or closer to it than a margin: (…)."""
        offset = position[..., :2] - self.corner_m
        return np.asarray(((offset >= -margin_m) & (offset < self.side_m + margin_m)).all(axis=-1))


@dataclass(frozen=True)
class Look:
    """Pixels that are looked at.

    Attributes:
        square: in `geo`.
        margin_m: around the square.
        coarsest_m: pixels that are wider on the surface are left out.
        step: every `step`-th row and column counts.
    """

    square: Square
    margin_m: float
    coarsest_m: float
    step: int


def candidates_in(view: SurfaceView, geo_from_model: Similarity, look: Look) -> Candidates | None:
    """Return the candidates of a view with colours in a square and its margin; None: it shows none of it."""
    window = _window(view, geo_from_model, look)
    if window is None or view.rgb is None:
        return None
    rows, columns = window
    depth = view.depth_m[rows, columns].astype(np.float64)
    row, column = np.mgrid[window]
    ray = view.pinhole.rays(np.stack([column, row], axis=-1) + 0.5)
    point = geo_from_model.apply((depth[..., None] * ray) @ view.cam_from_model + view.cam_center_in_model)
    normal, known = _normals(point, depth)
    towards = geo_from_model.apply(view.cam_center_in_model) - point
    # Without a surface, a pixel has the place of the camera.
    distance = np.maximum(np.linalg.norm(towards, axis=-1), np.finfo(np.float64).tiny)
    cosine = np.einsum("hwi,hwi->hw", normal, towards) / distance
    pixel_m = geo_from_model.scale * depth / view.pinhole.fx
    chosen = known & (np.abs(cosine) > _GRAZING) & (pixel_m < look.coarsest_m)
    chosen &= look.square.holds(point, look.margin_m)
    chosen &= (row % look.step == look.step // 2) & (column % look.step == look.step // 2)
    towards_camera = normal[chosen] * np.sign(cosine[chosen])[:, None]
    return Candidates(point[chosen], towards_camera, view.rgb[rows, columns][chosen], pixel_m[chosen])


def _window(view: SurfaceView, geo_from_model: Similarity, look: Look) -> tuple[slice, slice] | None:
    """Return rows and columns that hold the pixels of a view in a square, but for slivers of a few pixels."""
    height, width = view.depth_m.shape
    rows, columns = np.nonzero(view.depth_m[::_LOOK_PX, ::_LOOK_PX])
    rows, columns = _LOOK_PX * rows, _LOOK_PX * columns
    inside = look.square.holds(geo_from_model.apply(view.points(rows, columns)), look.margin_m)
    if not inside.any():
        return None
    spare = _LOOK_PX + _REACH_PX
    top, left = max(int(rows[inside].min()) - spare, 0), max(int(columns[inside].min()) - spare, 0)
    bottom = min(int(rows[inside].max()) + spare + 1, height)
    right = min(int(columns[inside].max()) + spare + 1, width)
    return slice(top, bottom), slice(left, right)


def _normals(point: FloatArray, depth: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return unit normals (H, W, 3) with an arbitrary sign, and where they are known (H, W)."""
    normal, known = np.zeros_like(point), np.zeros(depth.shape, dtype=np.bool_)
    reach = _REACH_PX
    if min(depth.shape) <= 2 * reach:
        return normal, known
    middle = slice(reach, -reach)
    before, after = slice(None, -2 * reach), slice(2 * reach, None)
    right = point[middle, after] - point[middle, before]
    down = point[after, middle] - point[before, middle]
    cross = np.cross(right, down)
    length = np.linalg.norm(cross, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        own = depth[middle, middle]
        # The inverse depth of a plane is linear on the image, at any angle of view.
        bend = np.maximum(
            np.abs(own / depth[middle, before] + own / depth[middle, after] - 2),
            np.abs(own / depth[before, middle] + own / depth[after, middle] - 2),
        )
        normal[middle, middle] = cross / length[..., None]
    known[middle, middle] = (own > 0) & (length > 0) & (bend < _BEND)
    return normal, known
