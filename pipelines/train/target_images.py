"""Photographs on the device: shrunken as the schedule demands, and read ahead on a GPU."""

from __future__ import annotations

from collections import OrderedDict
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from pipelines.geometry.cameras import Pinhole
from pipelines.scene.photographs import ImageCache
from pipelines.scene.pinholes import Pinholes
from pipelines.splat.rasterizer.api import Window
from pipelines.train.region import RegionMasks, RegionView

_MASKS = 64  # limit on the device; all photographs of a camera share one


@dataclass(frozen=True)
class TargetImage:
    """Photograph to compare a render with.

    Attributes:
        colour: (H, W, 3) float32, 0 … 1.
        mask: (H, W) bool, the pixels that count; None: all.
        camera: of H × W pixels, with the lens in use.
        whole: camera of the whole photograph at this size.
        window: part of the whole that these pixels are; None: all of it.
        share: of the whole photograph's pixels that count, if it is trained on in part; else 1.
    """

    colour: Tensor
    mask: Tensor | None
    camera: Pinhole
    whole: Pinhole
    window: Window | None = None
    share: float = 1.0


class TargetImages:
    """Training photographs on a device.

    On a GPU a thread reads the next photograph from disk into pinned memory during an iteration, so that no
    iteration waits for disk or transfer. On a CPU reading ahead would only take a core from the kernels.

    Args:
        images: undistorted photographs.
        pinholes: their cameras, with the lens in use.
        device: holds the photographs of `get`.
        region: pixels of each photograph to train on; None: all.
    """

    def __init__(
        self, images: ImageCache, pinholes: Pinholes, device: torch.device, region: RegionMasks | None = None
    ) -> None:
        self._images, self._pinholes, self._device, self._region = images, pinholes, device, region
        self._masks: OrderedDict[tuple[str, int], Tensor | None] = OrderedDict()
        self._reader = ThreadPoolExecutor(1, "photographs") if device.type == "cuda" else None
        self._next: tuple[int, Future[Tensor]] | None = None

    def get(self, index: int, shrink: int = 1, upcoming: int | None = None) -> TargetImage:
        """Return a photograph at 1/`shrink` of its size.

        Args:
            index: of the photograph.
            shrink: every pixel is the mean of shrink × shrink pixels.
            upcoming: index of the next photograph, to read ahead; None: unknown.
        """
        pixels = self._pixels(index)
        if self._reader is not None and upcoming is not None:
            self._next = (upcoming, self._reader.submit(self._read, upcoming))
        colour = pixels.to(self._device, non_blocking=True).float() / 255.0
        camera = self._pinholes.of(index)
        if shrink > 1:
            colour = functional.avg_pool2d(colour.permute(2, 0, 1), shrink).permute(1, 2, 0).contiguous()
            camera = shrunken(camera, shrink)
        mask = self._mask(index, shrink)
        return (
            TargetImage(colour, mask, camera, camera)
            if self._region is None
            else self._part(TargetImage(colour, mask, camera, camera), self._region.view(index, shrink))
        )

    def _part(self, image: TargetImage, shown: RegionView) -> TargetImage:
        """Return the part of a photograph that shows the region."""
        window = shown.window
        rows, columns = window.slices
        mask = torch.from_numpy(shown.mask).to(self._device)
        mask = mask if image.mask is None else mask & image.mask[rows, columns]
        return TargetImage(
            image.colour[rows, columns].contiguous(),
            mask,
            window.of(image.whole),
            image.whole,
            window,
            float(shown.mask.sum()) / (image.whole.width * image.whole.height),
        )

    def _pixels(self, index: int) -> Tensor:
        if self._next is not None and self._next[0] == index:
            return self._next[1].result()
        return self._read(index)

    def _read(self, index: int) -> Tensor:
        pixels = torch.from_numpy(np.array(self._images.image(index)))
        return pixels.pin_memory() if self._reader is not None else pixels

    def _mask(self, index: int, shrink: int) -> Tensor | None:
        key = (self._images.mask_key(index), shrink)
        if key not in self._masks:
            self._masks[key] = self._load_mask(index, shrink)
            if len(self._masks) > _MASKS:
                self._masks.popitem(last=False)
        self._masks.move_to_end(key)
        return self._masks[key]

    def _load_mask(self, index: int, shrink: int) -> Tensor | None:
        covered = np.array(self._images.mask(index))
        height, width = (side // shrink for side in covered.shape)
        blocks = covered[: height * shrink, : width * shrink].reshape(height, shrink, width, shrink)
        whole = blocks.all(axis=(1, 3))
        return None if whole.all() else torch.from_numpy(np.ascontiguousarray(whole)).to(self._device)


def shrunken(camera: Pinhole, shrink: int) -> Pinhole:
    """Return the camera of an image whose pixels are blocks of shrink × shrink pixels.

    Incomplete blocks at the right and lower edges are cut off.
    """
    return Pinhole(
        camera.width // shrink,
        camera.height // shrink,
        *(value / shrink for value in (camera.fx, camera.fy, camera.cx, camera.cy)),
    )
