"""Colours of the orthophoto's cells from the photographs themselves, at their own resolution; also values of bands.

1. A photograph sees a cell if its depth map shows the surface there, and nothing before it.
2. The detail of a cell is that of one photograph, the one that sees it best: steeply, closely, near the middle of
   its picture, and sharp.
3. The broad colours are those of all photographs that see the place, weighted smoothly. So the photographs meet
   without a seam (two bands of Burt & Adelson, doi 10.1145/245.247). Their exposures and lenses are undone before.
4. Where three photographs or more see a place, one whose broad colour departs from their median shows something
   that has moved, and does not count.

Broad colours are means over blocks of cells that lie on whole multiples of a block in the raster: neighbouring
windows have the same.

A view's colours are those of `Pictures`: three of one photograph, or one of each lens of a rig (`bands.py`).
"""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from pipelines.core.types import BoolArray, Float32Array, FloatArray, IntArray
from pipelines.deliver.raster_window import RasterSource, places_in_geo
from pipelines.formats.geotiff import RasterFrame
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.sparse_model import SparseModel
from pipelines.splat.exposure import falloff, squared_radius_at
from pipelines.surface.surface_views import SurfaceView
from pipelines.survey.photographs import ImageCache
from pipelines.survey.solution import TrainedModel

BLOCK = 8  # cells along a side of a block, of which broad colours are means
MARGIN = 4 * BLOCK  # cells around a window that its broad colours depend on
_EVERY = 2  # cells between two samples of a broad colour
_MOST_VIEWS = 32  # of a window: the best
_SAME_SURFACE = 0.006  # of the depth: largest distance of what a photograph sees from the surface in its depth map
_FEATHER = 0.12  # of the shorter side: width of the rim over which a photograph's weight falls to nothing
_MOVED = 30.0  # grey levels from the median: another thing, and not another light
_LEAST_VIEWS = 3  # for a median
_UNKNOWN = 0.05  # of the weight, where the depth map does not tell what a photograph shows
_DISCOUNT = 1e-3  # of the weight of what has moved: it counts where nothing else is seen
_CACHE_BYTES = 1 << 30  # of decoded photographs
_ROWS = 256  # whose places are computed at once
_SHARPNESS = 64  # power of the weights by which views share the detail
_TINY = np.float32(1e-30)
_DARKEST = 0.1  # vignetting that is undone at most
_SPECK = 5  # cells along the side of the smallest place that something hides
_BEST = 0.5  # of a block's best weight: photographs below it are not asked for detail there


Picture = TypeVar("Picture", bound=NDArray[Any])


@dataclass(frozen=True)
class CellColours:
    """Colours (C, H, W) of a window, and the camera (H, W) whose detail each cell has; −1: none sees it.

    Colours of a cell that none sees are NaN.
    """

    colours: Float32Array
    camera: IntArray


class Recent(Generic[Picture]):
    """Pictures used last, by a key, of up to a gibibyte."""

    def __init__(self, read: Callable[[int], Picture]) -> None:
        self._read, self._held_bytes = read, 0
        self._held: OrderedDict[int, Picture] = OrderedDict()

    def get(self, key: int) -> Picture:
        """Return a picture, read if it is not held."""
        if key in self._held:
            self._held.move_to_end(key)
            return self._held[key]
        picture = self._held[key] = self._read(key)
        self._held_bytes += picture.nbytes
        while self._held_bytes > _CACHE_BYTES and len(self._held) > 1:
            self._held_bytes -= self._held.popitem(last=False)[1].nbytes
        return picture


class Pictures(Protocol):
    """Colours that the views show, in C channels."""

    @property
    def moved(self) -> Float32Array:
        """Differences (C,) from the median of the views beyond which a view shows another thing."""

    def has(self, camera: int) -> bool:
        """Return whether a camera has a picture."""

    def at(
        self, camera: int, pinhole: Pinhole, u: Float32Array, v: Float32Array, z: Float32Array
    ) -> tuple[Float32Array, Float32Array | None]:
        """Return colours (H, W, C) of a view, and factors (H, W) of its weight; None: all 1.

        Args:
            camera: of the view.
            pinhole: of its photograph at full size, under the present lens.
            u, v: (H, W) places in the undistorted photograph of that size.
            z: (H, W) depths of what lies there, in metres; 0: none.
        """


def rim_weight(u: Float32Array, v: Float32Array, pinhole: Pinhole) -> Float32Array:
    """Return 1 inside a picture, falling smoothly to 0 at its rim and outside."""
    rim = np.minimum(np.minimum(u, pinhole.width - u), np.minimum(v, pinhole.height - v))
    return np.asarray(np.clip(rim / (_FEATHER * min(pinhole.width, pinhole.height)), 0.0, 1.0), dtype=np.float32)


@dataclass(frozen=True)
class _View:
    """Photograph of a view at full size."""

    seen: SurfaceView
    pinhole: Pinhole
    sharpness: float
    unknown: float  # what counts of a pixel without a depth

    def weight(self, u: Float32Array, v: Float32Array, z: Float32Array, cosine: Float32Array) -> Float32Array:
        """Return how well cells are seen at pixels (…,): 0 outside the picture, and smooth up to its rim."""
        resolution = self.pinhole.fx / np.maximum(z, 1e-3)
        inside = rim_weight(u, v, self.pinhole)
        return np.asarray(inside * self.sharpness * (resolution * cosine**2) ** 2, dtype=np.float32)

    def shows(self, u: Float32Array, v: Float32Array, z: Float32Array) -> Float32Array:
        """Return whether nothing hides the surface at pixels (…,) of the photograph, at their depths: 1, 0 if not.

        Where the depth map has nothing, such as where the splat misses the photograph's detail, it is not known.
        """
        small, depth = self.seen.pinhole, self.seen.depth_m
        column = np.clip(u * (small.width / self.pinhole.width), 0, small.width - 1).astype(np.int32)
        row = np.clip(v * (small.height / self.pinhole.height), 0, small.height - 1).astype(np.int32)
        there = depth[row, column]
        open_to = np.where(there > 0, z <= there * (1 + _SAME_SURFACE), np.float32(self.unknown))
        return np.where(z > 0, open_to, np.float32(0.0)).astype(np.float32)


@dataclass(frozen=True)
class _Light:
    """Correction of a photograph's light.

    `colour_of` (3, 4) applies to homogeneous colours of 0 … 255; the vignetting divides what it gives.
    """

    colour_of: FloatArray
    vignetting: tuple[float, ...]


class ColourPictures:
    """Colours of the training photographs: red, green and blue of 0 … 255, without exposure and vignetting."""

    moved = np.full(3, _MOVED, dtype=np.float32)

    def __init__(self, model: TrainedModel, sfm: SparseModel, source: RasterSource, images: ImageCache) -> None:
        self._images, self._decoded = images, Recent(images.decoded)
        self._light: dict[int, _Light] = {}
        for number, camera in enumerate(source.views.cameras):
            camera_id = int(sfm.image_camera_id[camera])
            lens = [each for each in model.vignetting if each.camera_id == camera_id]
            self._light[camera] = _Light(source.views.light(number), tuple(lens[0].coefficients) if lens else ())

    def has(self, camera: int) -> bool:
        return camera in self._light

    def at(
        self, camera: int, pinhole: Pinhole, u: Float32Array, v: Float32Array, z: Float32Array
    ) -> tuple[Float32Array, None]:
        """Return colours (H, W, 3) as `Pictures.at` says."""
        light = self._light[camera]
        raw = self._images.sampled(camera, self._decoded.get(camera), np.stack([u, v], axis=-1))
        linear, offset = light.colour_of[:, :3].astype(np.float32), light.colour_of[:, 3].astype(np.float32)
        colour = raw.astype(np.float32) @ linear.T + offset
        if light.vignetting:
            radius2 = squared_radius_at(u, v, pinhole, pinhole)
            colour /= np.maximum(falloff(radius2, light.vignetting), _DARKEST)[..., None]
        return np.asarray(colour, dtype=np.float32), None


class PhotoColours:
    """Training views with what they show, for the colours of one raster's cells.

    `images` are the photographs at full size. Memory holds decoded ones of up to a gibibyte, and the places of one
    window.
    """

    def __init__(
        self,
        source: RasterSource,
        images: ImageCache,
        pictures: Pictures,
    ) -> None:
        self._source, self._images, self._pictures = source, images, pictures
        self._views: dict[int, _View] = {}

    def window(self, frame: RasterFrame, first: tuple[int, int], height: FloatArray) -> CellColours:
        """Return the colours of a window whose first cell in the raster is at a row and column.

        Args:
            height: (H, W) of the cells in the CRS's unit; NaN: no surface.

        Raises:
            InputError: a photograph cannot be read, or is not that of the survey.
        """
        # Blocks begin on whole multiples: rows and columns are added around.
        before = tuple(start % BLOCK for start in first)
        after = tuple(-(start + size) % BLOCK for start, size in zip(before, height.shape, strict=True))
        point_in_model = np.pad(
            self._places(frame, height), [*zip(before, after, strict=True), (0, 0)], constant_values=np.nan
        )
        views = self._candidates(point_in_model)
        low, share, wanted = self._broad(point_in_model, views)
        base = _between_blocks(low, share, point_in_model.shape[:2])
        detail, camera = self._detail(point_in_model, views, wanted)
        known = camera >= 0
        colours = np.where(known[..., None], base + detail, np.float32(np.nan)).astype(np.float32)
        core = tuple(slice(start, start + size) for start, size in zip(before, height.shape, strict=True))
        return CellColours(np.moveaxis(colours[core], 2, 0), camera[core])

    def _places(self, frame: RasterFrame, height: FloatArray) -> Float32Array:
        """Return the places (H, W, 3) of cells in `model`; NaN: no surface."""
        point_in_model = np.full((*height.shape, 3), np.nan, dtype=np.float32)
        known = np.isfinite(height)
        model_from_geo = self._source.geo_from_model.inverse()
        for top in range(0, len(height), _ROWS) if known.any() else ():
            rows = slice(top, min(top + _ROWS, len(height)))
            row, column = np.nonzero(known[rows])
            if len(row):
                cell = np.column_stack([column, row + top]) + 0.5
                in_geo = places_in_geo(self._source, frame, cell.astype(np.float64), height[rows][row, column])
                point_in_model[rows][row, column] = model_from_geo.apply(in_geo)
        return point_in_model

    def _candidates(self, point_in_model: Float32Array) -> list[_View]:
        """Return the views that see most of a window, the best first."""
        coarse = point_in_model[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK].reshape(-1, 3)
        coarse = coarse[np.isfinite(coarse[:, 0])]
        weights = []
        usable = [number for number, camera in enumerate(self._source.views.cameras) if self._pictures.has(camera)]
        for number in usable if len(coarse) else ():
            view = self._view(number)
            u, v, z, cosine = self._seen_at(view, coarse)
            weight = np.where(z > 0, view.weight(u, v, z, cosine), 0.0)
            if (weight > 0).any():
                weights.append((float(weight.sum()), number))
        return [self._view(number) for _, number in sorted(weights, reverse=True)[:_MOST_VIEWS]]

    def _broad(
        self, point_in_model: Float32Array, views: list[_View]
    ) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Return the blended colours (h, w, C) of blocks times their weight, that weight as 0 or 1, and weights.

        The weights (V, h, w) are those of each view in each block, without what has moved.
        """
        sparse = point_in_model[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY]
        shape = (point_in_model.shape[0] // BLOCK, point_in_model.shape[1] // BLOCK)
        colours = np.full((len(views), *shape, len(self._pictures.moved)), np.nan, dtype=np.float32)
        weights = np.zeros((len(views), *shape), dtype=np.float32)
        for number, view in enumerate(views):
            rows, columns = _box(self._reach(view, sparse, BLOCK // _EVERY), BLOCK // _EVERY)
            part = sparse[rows, columns]
            if not part.size:
                continue
            colour, visible, weight = self._colours(view, part)
            weight *= visible
            side = BLOCK // _EVERY
            above, across = (slice(cells.start // side, cells.stop // side) for cells in (rows, columns))
            total = _block_sums(weight > 0, side)
            mean = _block_sums(np.where(weight[..., None] > 0, colour, 0.0), side)
            colours[number, above, across] = mean / np.where(total > 0, total, np.nan)[..., None]
            weights[number, above, across] = _block_sums(weight, side) / side**2
        if len(views) >= _LEAST_VIEWS:
            weights *= self._unmoved(colours, weights)
        blended = np.einsum("vhw,vhwc->hwc", weights, np.nan_to_num(colours))
        total = weights.sum(axis=0)
        share = (total > 0).astype(np.float32)
        low = np.where(total[..., None] > 0, blended / np.where(total > 0, total, 1.0)[..., None], 0.0)
        return low.astype(np.float32), share, weights

    def _unmoved(self, colours: Float32Array, weights: Float32Array) -> Float32Array:
        """Return factors (V, h, w) of the weights: small where a view differs from the median of three or more."""
        counted = np.where(weights[..., None] > 0, colours, np.nan)
        several = (weights > 0).sum(axis=0) >= _LEAST_VIEWS
        factor = np.ones_like(weights)
        if several.any():
            chosen = counted[:, several]
            away = (np.abs(chosen - np.nanmedian(chosen, axis=0)) / self._pictures.moved).max(axis=2)
            factor[:, several] = np.where(away > 1.0, np.float32(_DISCOUNT), np.float32(1.0))
        return factor

    def _detail(
        self, point_in_model: Float32Array, views: list[_View], wanted: Float32Array
    ) -> tuple[Float32Array, IntArray]:
        """Return what the best view of each cell shows beyond its broad colour (H, W, C), and its camera (H, W)."""
        shape = (*point_in_model.shape[:2], len(self._pictures.moved))
        detail, total = np.zeros(shape, dtype=np.float32), np.zeros(point_in_model.shape[:2], np.float32)
        camera = np.full(point_in_model.shape[:2], -1, dtype=np.int64)
        best = np.zeros(point_in_model.shape[:2], dtype=np.float32)
        highest = wanted.max(axis=0, initial=0.0)
        for view, weight in zip(views, wanted, strict=True):
            near_best = binary_dilation((weight > 0) & (weight >= _BEST * highest), np.ones((3, 3)))
            rows, columns = _box(near_best, BLOCK)
            part = point_in_model[rows, columns]
            if not part.size:
                continue
            colour, visible, _ = self._colours(view, part)
            # Hidden specks are noise of the surface: without them, photographs change at fewer places.
            square = np.ones((_SPECK, _SPECK), dtype=np.uint8)
            visible = np.asarray(cv2.morphologyEx(visible, cv2.MORPH_CLOSE, square), dtype=np.float32)
            blocks = tuple(slice(cells.start // BLOCK, cells.stop // BLOCK) for cells in (rows, columns))
            score = visible * cv2.resize(weight[blocks], visible.shape[::-1], interpolation=cv2.INTER_LINEAR)
            before = best[rows, columns]
            better = score > before
            now = np.maximum(score, before)
            if not (score > 0).any():
                continue
            # Weights by a high power: the best view alone, but for the few cells where two are equally good.
            kept, added = ((values / np.maximum(now, _TINY)) ** _SHARPNESS for values in (before, score))
            fine = colour - _block_means(colour, visible > 0)
            detail[rows, columns] = kept[..., None] * detail[rows, columns] + added[..., None] * fine
            total[rows, columns] = kept * total[rows, columns] + added
            camera[rows, columns][better] = view.seen.camera
            best[rows, columns] = now
        return (detail / np.maximum(total, _TINY)[..., None]).astype(np.float32), camera

    def _colours(
        self, view: _View, point_in_model: Float32Array
    ) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Return colours (H, W, C) of a view at places (H, W, 3), whether it shows them, and weights."""
        u, v, z, cosine = self._seen_at(view, point_in_model.reshape(-1, 3))
        u, v, z, cosine = (values.reshape(point_in_model.shape[:2]) for values in (u, v, z, cosine))
        visible, weight = view.shows(u, v, z), view.weight(u, v, z, cosine)
        colour, factor = self._pictures.at(view.seen.camera, view.pinhole, u, v, z)
        if factor is not None:
            weight = weight * factor
        return colour, np.where(weight > 0, visible, np.float32(0.0)), weight

    def _reach(self, view: _View, point_in_model: Float32Array, size: int) -> BoolArray:
        """Return the blocks (h, w) of places (H, W, 3) of which a view may show a part."""
        middle = point_in_model[size // 2 :: size, size // 2 :: size]
        u, v, z, _ = self._seen_at(view, middle.reshape(-1, 3))
        slack = 0.05 * max(view.pinhole.width, view.pinhole.height)
        inside = (z > 0) & (u > -slack) & (u < view.pinhole.width + slack)
        inside &= (v > -slack) & (v < view.pinhole.height + slack)
        return np.asarray(inside.reshape(middle.shape[:2]))

    def _seen_at(
        self, view: _View, point_in_model: Float32Array
    ) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
        """Return pixels u and v (K,), depths (K,) and the cosine to the vertical of places (K, 3).

        Of places without a surface, or behind the camera, the depth is 0 and the pixel −1, −1.
        """
        rotation = view.seen.cam_from_model.astype(np.float32)
        arm = point_in_model - view.seen.cam_center_in_model.astype(np.float32)
        in_cam = arm @ rotation.T
        z = in_cam[:, 2]
        ahead = z > 1e-3  # not of NaN
        inverse = 1.0 / np.where(ahead, z, 1.0)
        u = np.where(ahead, view.pinhole.fx * in_cam[:, 0] * inverse + view.pinhole.cx, -1.0)
        v = np.where(ahead, view.pinhole.fy * in_cam[:, 1] * inverse + view.pinhole.cy, -1.0)
        up = (self._source.geo_from_model.rotation.T @ [0.0, 0.0, 1.0]).astype(np.float32)
        cosine = np.abs(arm @ up) / np.maximum(np.linalg.norm(arm, axis=1), 1e-6)
        most = 4.0 * max(view.pinhole.width, view.pinhole.height)  # far outside, for OpenCV's 16-bit places
        return (
            np.clip(u, -most, most).astype(np.float32),
            np.clip(v, -most, most).astype(np.float32),
            np.where(ahead, z, 0.0).astype(np.float32),
            np.nan_to_num(cosine).astype(np.float32),
        )

    def _view(self, number: int) -> _View:
        if number not in self._views:
            seen = self._source.views.view(number)
            self._views[number] = _View(
                seen,
                self._images.pinhole(seen.camera),
                self._sharpness(number),
                0.0 if self._images.is_masked(seen.camera) else _UNKNOWN,  # what is masked has no depth either
            )
        return self._views[number]

    def _sharpness(self, number: int) -> float:
        """Return how sharp a photograph is, about 1: blur of motion halves it."""
        image, _ = self._source.views.photograph(number)
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY).astype(np.float32)
        fine = float(np.abs(cv2.Laplacian(grey, cv2.CV_32F)).mean())
        broad = float(np.abs(grey - cv2.GaussianBlur(grey, (0, 0), 4.0)).mean())
        return float(np.clip(fine / max(broad, 1e-3), 0.1, 10.0))


def _box(blocks: BoolArray, size: int) -> tuple[slice, slice]:
    """Return the rows and columns of the cells, `size` along a side of a block, around the chosen blocks (h, w)."""
    rows, columns = np.flatnonzero(blocks.any(axis=1)), np.flatnonzero(blocks.any(axis=0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return (
        slice(int(rows[0]) * size, (int(rows[-1]) + 1) * size),
        slice(int(columns[0]) * size, (int(columns[-1]) + 1) * size),
    )


def _block_sums(values: NDArray[np.generic], size: int) -> Float32Array:
    """Return the sums of values (H, W, …) over blocks."""
    rows, columns = values.shape[0] // size, values.shape[1] // size
    blocks = values.reshape(rows, size, columns, size, *values.shape[2:])
    return np.asarray(blocks.sum(axis=(1, 3), dtype=np.float32))


def _block_means(colour: Float32Array, seen: BoolArray) -> Float32Array:
    """Return the broad colours (H, W, C) of a view: means of seen cells over blocks, linearly between these."""
    total = _block_sums(seen, BLOCK)
    mean = _block_sums(np.where(seen[..., None], colour, 0.0), BLOCK)
    share = (total > 0).astype(np.float32)
    return _between_blocks((mean / np.maximum(total, 1.0)[..., None]).astype(np.float32), share, colour.shape[:2])


def _between_blocks(colour: Float32Array, share: Float32Array, shape: tuple[int, ...]) -> Float32Array:
    """Return colours (H, W, C) of cells, linearly between those of the blocks (h, w, C) whose share (h, w) is 1."""
    size = (shape[1], shape[0])
    weight = np.maximum(cv2.resize(share, size, interpolation=cv2.INTER_LINEAR), 1e-6)
    wide = cv2.resize(colour, size, interpolation=cv2.INTER_LINEAR).reshape(*shape, colour.shape[2])
    return np.asarray(wide / weight[..., None], dtype=np.float32)
