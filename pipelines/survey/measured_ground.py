"""Ground that the photographs measure, as cells of the plan, and its outline: what every product ends at."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import contourpy
import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import label

from pipelines.core.products import ArrayProduct, save_npz
from pipelines.core.types import BoolArray, FloatArray

_SPIKE_M, _SPIKE_CELLS = 1.0, 3.0  # width of tongues that are cut off: the larger counts
_LEAST_ISLAND = 0.01  # of the largest part: smaller ones are agreements by chance
# Width of the holes that are filled unless the user says otherwise, and their largest share of the outline.
_FILLED_M, _FILLED_PX, MOST_FILLED = 2.0, 10, 0.1


@dataclass(frozen=True)
class MeasuredGround(ArrayProduct):
    """Cells (R, C) of the plan of `geo` where enough photographs show the surface at one height.

    Rows run from the south, columns from the west. `corner` is the south-western one of the first cell; `size_m`
    has the side of a cell, and the width of the photographs' pixels on the ground.
    """

    measured: BoolArray
    corner: FloatArray
    size_m: FloatArray

    FORMS: ClassVar = {"measured": ("b", "rows", "columns"), "corner": ("f", 2), "size_m": ("f", 2)}

    @property
    def cell_m(self) -> float:
        return float(self.size_m[0])

    def save(self, path: Path) -> None:
        save_npz(path, vars(self))

    def outline(self, within: shapely.Geometry, fill: float | None, *, wider: float = 1.0) -> Any | None:
        """Return the polygon of what is measured within another: holes up to a width filled, no spikes, no islands.

        `fill` is the width in metres. None: two metres and ten pixels, times `wider`, halved until no more than a
        tenth of the outline is filled. The result is None where nothing is measured.
        """
        inside = self._inside(within)
        measured = _without_islands(self.measured & inside)
        if not measured.any():
            return None
        width_m = wider * max(_FILLED_M, _FILLED_PX * self.size_m[1]) if fill is None else fill
        spike = max(_SPIKE_M / self.cell_m, _SPIKE_CELLS) / 2
        while True:
            cells = _without_islands(
                _without_spikes(_closed(measured, (width_m / self.cell_m + 1) / 2), spike) & inside
            )
            filled = (cells & ~measured).sum() / max(cells.sum(), 1)
            if fill is not None or filled <= MOST_FILLED or width_m < self.cell_m:
                break
            width_m /= 2
        if not cells.any():  # narrower than a spike: all that there is
            cells = measured
        return shapely.make_valid(self._polygon(cells).intersection(within))

    def share(self, polygon: shapely.Geometry) -> float:
        """Return the measured share of the cells in a polygon."""
        inside = self._inside(polygon)
        shapely.prepare(polygon)
        # Cells of a wide polygon beyond those that are known are not measured.
        known = max(float(inside.sum()), float(polygon.area) / self.cell_m**2)
        return float((self.measured & inside).sum()) / max(known, 1.0)

    def _inside(self, polygon: shapely.Geometry) -> BoolArray:
        rows, columns = (np.arange(size) + 0.5 for size in self.measured.shape)
        east, north = np.meshgrid(self.corner[0] + self.cell_m * columns, self.corner[1] + self.cell_m * rows)
        shapely.prepare(polygon)
        return np.asarray(shapely.contains_xy(polygon, east.ravel(), north.ravel())).reshape(east.shape)

    def _polygon(self, cells: BoolArray) -> Any:
        padded = np.pad(cells, 1).astype(np.float64)
        x, y = (
            low + self.cell_m * (np.arange(size) - 0.5)
            for low, size in zip(self.corner, padded.shape[::-1], strict=True)
        )
        rings = contourpy.contour_generator(x, y, padded).lines(0.5)
        return shapely.build_area(shapely.MultiLineString(rings)).simplify(self.cell_m / 4)


def _without_islands(cells: BoolArray) -> BoolArray:
    """Return cells without parts that are small beside the largest one."""
    number, _ = label(cells, structure=np.ones((3, 3)))
    sizes = np.bincount(number.ravel())
    sizes[0] = 0
    kept = sizes >= max(_LEAST_ISLAND * sizes.max(), 1)
    return np.asarray(kept[number])


def _closed(cells: BoolArray, radius: float) -> BoolArray:
    """Return cells with their holes and bays whose cells are no farther from others than a radius."""
    radius = min(radius, float(sum(cells.shape)))
    margin = math.ceil(radius) + 1
    padded = np.pad(cells, margin)
    dilated = distance_to_others(~padded) <= radius
    closed = distance_to_others(dilated) > radius
    return np.asarray(cells | closed[margin:-margin, margin:-margin])


def _without_spikes(cells: BoolArray, radius: float) -> BoolArray:
    """Return cells without tongues that are narrower than twice a radius in cells."""
    padded = np.pad(cells, 1)
    eroded = distance_to_others(padded) > radius
    opened = distance_to_others(~eroded) <= radius
    return np.asarray(cells & opened[1:-1, 1:-1])


def distance_to_others(cells: BoolArray) -> NDArray[Any]:
    """Return the distance of each chosen cell to the nearest other one, in cells; 0 of the others."""
    return cv2.distanceTransform(cells.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
