"""Photographs on the device: shrunken as the schedule demands, cut into crops if large, and read ahead on a GPU.

Crops bound the memory and time of an iteration.
"""

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product
from math import inf, prod

import numpy as np
import torch
from torch import Tensor

from pipelines.core.types import BoolArray
from pipelines.geometry.cameras import Pinhole
from pipelines.splat.rasterizer.api import Window
from pipelines.survey.photographs import ImageCache, Pinholes
from pipelines.train.region import RegionMasks

_SHIFT = 1 / 8  # of a crop's side: cuts move to either side by up to this, so that no pixel is always beside one


@dataclass(frozen=True)
class Crops:
    """Crops of photographs, as a grid of equal cells whose inner cuts are shifted by chance in each round.

    Each round of visits to a photograph shows all of its crops once, in an order by chance: each pixel is seen
    equally often.
    """

    size_px: int  # a photograph with more pixels than a square of this side is seen in crops of so many pixels
    seed: int = 0

    def grid(self, width: int, height: int) -> tuple[int, int]:
        """Return the columns and rows of cells that are small enough, with the shortest cuts."""
        most_px, grids = self.size_px**2, []
        for columns in range(1, -(-width * height // most_px) + 1):
            cell_height = most_px // -(-width // columns)
            if cell_height > 0:
                grids.append((columns, -(-height // min(cell_height, height))))
        return min(grids, key=lambda grid: (grid[0] - 1) * height + (grid[1] - 1) * width)

    def count(self, width: int, height: int) -> int:
        """Return the number of crops in which an image is seen."""
        return prod(self.grid(width, height))

    def largest_of(self, camera: Pinhole) -> Pinhole:
        """Return a camera of the size of the largest crop of an image."""
        sides = zip((camera.width, camera.height), self.grid(camera.width, camera.height), strict=True)
        width, height = (
            side if cells == 1 else min(side, int(np.ceil((1 + _SHIFT) * side / cells)) + 1)
            for side, cells in sides
        )
        return Window(0, 0, width, height).of(camera)

    def shrink(self, width: int, height: int) -> int:
        """Return the least factor by which an image is to be shrunken, to be seen as a whole."""
        shrink = 1
        while (width // shrink) * (height // shrink) > self.size_px**2:
            shrink += 1
        return shrink

    def of(self, index: int, whole: Window, turn: int) -> list[Window]:
        """Return the crops of round `turn`, from 0, which cover `whole` of a photograph without overlap."""
        random = np.random.default_rng([self.seed, index, turn])
        columns, rows = self.grid(whole.width, whole.height)
        across, down = _cuts(whole.width, columns, random), _cuts(whole.height, rows, random)
        cells = [
            Window(whole.left + left, whole.top + top, right - left, bottom - top)
            for (top, bottom), (left, right) in product(pairwise(down), pairwise(across))
        ]
        return [cells[place] for place in random.permutation(len(cells))]


def _cuts(side: int, cells: int, random: np.random.Generator) -> list[int]:
    shift = random.uniform(-_SHIFT, _SHIFT)
    return [0, *(round((cell + shift) * side / cells) for cell in range(1, cells)), side]


_MASKS = 64  # limit on the device; all photographs of a camera share one
_PARTS = 256  # crops kept: density control samples others between an iteration and the next


@dataclass(frozen=True)
class ImageLook:
    """Look at a photograph."""

    index: int
    shrink: int = 1  # every pixel is the mean of shrink × shrink pixels
    visit: int | None = None  # from 0, chooses the crop of a large photograph; None: all of it


@dataclass(frozen=True)
class ImagePart:
    """Part of a photograph to train on."""

    window: Window | None = None  # of the whole photograph, in its pixels; None: all of it
    crops: int = 1  # number in which all that is trained is seen, one at a visit
    # of a mean over the pixels that count in this crop: the mean of weighted means over all crops is the mean over
    # all pixels that count
    weight: float = 1.0
    share: float = 1.0  # of the whole photograph's counting pixels, if a region is trained; else 1
    # Corners (x, y) of the crop in px: the centre of each Gaussian lies between those of one crop.
    low: tuple[float, float] = (-inf, -inf)
    high: tuple[float, float] = (inf, inf)  # infinite where no other crop follows


@dataclass(frozen=True)
class TargetImage:
    """Photograph to compare a render with."""

    colour: Tensor  # (H, W, 3) float32, 0 … 1
    mask: Tensor | None  # (H, W) bool, the pixels that count; None: all
    camera: Pinhole  # of H × W pixels, with the lens in use
    whole: Pinhole  # camera of the whole photograph at this size
    part: ImagePart = ImagePart()  # of the whole that these pixels are


class TargetImages:
    """Training photographs on a device.

    On a GPU a thread reads the next photograph from disk into pinned memory during an iteration, so that no
    iteration waits for disk or transfer. On a CPU reading ahead would only take a core from the kernels.

    Args:
        pinholes: cameras of the undistorted photographs, with the lens in use.
        region: pixels of each photograph to train on; None: all.
        crops: of large photographs; None: all are seen as wholes.
    """

    def __init__(
        self,
        images: ImageCache,
        pinholes: Pinholes,
        device: torch.device,
        region: RegionMasks | None = None,
        crops: Crops | None = None,
    ) -> None:
        self._images, self._pinholes, self._device = images, pinholes, device
        self._region, self._crops = region, crops
        self._masks: OrderedDict[tuple[str, int], Tensor | None] = OrderedDict()
        self._complete: dict[str, bool] = {}
        self._part = lru_cache(_PARTS)(self._find_part)
        self._reader = ThreadPoolExecutor(1, "photographs") if device.type == "cuda" else None
        self._next: tuple[ImageLook, Future[Tensor]] | None = None

    def get(self, look: ImageLook, upcoming: ImageLook | None = None) -> TargetImage:
        """Return a photograph, or a crop of it; `upcoming` is the next look, to read ahead, None if unknown."""
        ahead, part = self._next, self._part(look)
        pixels = ahead[1].result() if ahead is not None and ahead[0] == look else self._read(look)
        if self._reader is not None and upcoming is not None:
            self._next = (upcoming, self._reader.submit(self._read, upcoming))
        colour = pixels.to(self._device, non_blocking=True).float() / 255.0
        whole = shrunken(self._pinholes.of(look.index), look.shrink)
        if part.window is not None:
            return TargetImage(colour, self._mask(look, part.window), part.window.of(whole), whole, part)
        key = (self._images.mask_key(look.index), look.shrink)
        if key not in self._masks:
            self._masks[key] = self._mask(look, Window(0, 0, whole.width, whole.height))
            if len(self._masks) > _MASKS:
                self._masks.popitem(last=False)
        self._masks.move_to_end(key)
        return TargetImage(colour, self._masks[key], whole, whole, part)

    def _find_part(self, look: ImageLook) -> ImagePart:
        camera = shrunken(self._images.pinhole(look.index), look.shrink)
        image = Window(0, 0, camera.width, camera.height)
        part_of_region = None if self._region is None else self._region.view(look.index, look.shrink)
        trained = image if part_of_region is None else part_of_region.window
        count = 0 if part_of_region is None else int(part_of_region.mask.sum())
        share = 1.0 if part_of_region is None else count / (camera.width * camera.height)
        if self._crops is None or look.visit is None or self._crops.count(trained.width, trained.height) == 1:
            return ImagePart(None if part_of_region is None else trained, share=share)
        turn, place = divmod(look.visit, self._crops.count(trained.width, trained.height))
        crops = self._crops.of(look.index, trained, turn)
        counts = [self._count(look, window) for window in crops]
        seen = [place for place, count in enumerate(counts) if count]
        window = crops[seen[place % len(seen)]] if seen else crops[0]
        weight = len(seen) * counts[crops.index(window)] / max(sum(counts), 1)
        right, bottom = window.left + window.width, window.top + window.height
        low = (
            -inf if window.left == trained.left else float(window.left),
            -inf if window.top == trained.top else float(window.top),
        )
        high = (
            inf if right == trained.left + trained.width else float(right),
            inf if bottom == trained.top + trained.height else float(bottom),
        )
        return ImagePart(window, len(seen) or 1, weight, share, low, high)

    def _count(self, look: ImageLook, window: Window) -> int:
        """Return the number of pixels that count in a crop."""
        key = self._images.mask_key(look.index)
        if key not in self._complete:
            self._complete[key] = bool(self._images.mask(look.index).all())
        if self._region is None and self._complete[key]:
            return window.width * window.height
        return int(self._counting(look, window).sum())

    def _counting(self, look: ImageLook, window: Window) -> BoolArray:
        """Return the pixels (H, W) of a crop that count: of the photograph, and of the region if there is one."""
        s = look.shrink
        covered = self._images.mask(look.index)[
            window.top * s : (window.top + window.height) * s, window.left * s : (window.left + window.width) * s
        ]
        blocks = np.array(covered).reshape(window.height, s, window.width, s)
        mask = np.asarray(blocks.all(axis=(1, 3)), dtype=bool)
        if self._region is None:
            return mask
        region = self._region.view(look.index, s)
        top, left = window.top - region.window.top, window.left - region.window.left
        return np.asarray(mask & region.mask[top : top + window.height, left : left + window.width])

    def _read(self, look: ImageLook) -> Tensor:
        image, window = self._images.image(look.index, look.shrink), self._part(look).window
        pixels = torch.from_numpy(np.array(image if window is None else image[window.slices]))
        return pixels.pin_memory() if self._reader is not None else pixels

    def _mask(self, look: ImageLook, window: Window) -> Tensor | None:
        """Return the pixels that count on the device; None: all."""
        mask = self._counting(look, window)
        return None if mask.all() else torch.from_numpy(mask).to(self._device)


def shrunken(camera: Pinhole, shrink: int) -> Pinhole:
    """Return the camera of an image of shrink × shrink blocks; incomplete ones at the edges are cut off."""
    inner = (value / shrink for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    return Pinhole(camera.width // shrink, camera.height // shrink, *inner)
