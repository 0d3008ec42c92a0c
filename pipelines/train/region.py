"""Region that a training is confined to: a block of a survey, with a frozen model that stands in for the rest.

Losses count at the pixels that show the region. The depth that decides comes from stereo where views agree, and
elsewhere from the stand-in.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from pipelines.geometry.cameras import Pinhole, pose_matrix
from pipelines.splat.gaussians import Gaussians
from pipelines.splat.rasterizer.api import Rasterizer, RasterSettings, Window
from pipelines.surface.depth_maps import DepthMaps
from pipelines.survey.block_plan import BlockCell
from pipelines.survey.photographs import ImageCache
from pipelines.survey.solution import Solution

_STAND_IN_PX = 160  # longest side of the stand-in's renders
_LEAST_ALPHA = 0.5  # of a surface: rays that meet less end in the sky
_SKY_M = 1e6
_KEPT = 16  # masks in memory unpacked
_BAND_PX = 1_000_000  # pixels whose points are computed at once, in some hundred bytes each
_STRAY = 0.002  # of the points at either end of an axis
_ROOM = 0.2  # of the longest side of their box


@dataclass(frozen=True)
class RegionView:
    """Smallest part of an image that holds all that shows the region, and its pixels that do."""

    window: Window
    mask: BoolArray


class RegionMasks:
    """Pixels (H, W) of each view, by index, that show a region; a byte for eight of them."""

    def __init__(self, masks: dict[int, BoolArray]) -> None:
        self._shape = {index: mask.shape for index, mask in masks.items()}
        self._packed: dict[int, ByteArray] = {index: np.packbits(mask) for index, mask in masks.items()}
        # Indices of the views that show the region, ascending.
        self.seeing = np.array(sorted(index for index, mask in masks.items() if mask.any()), dtype=np.int64)
        self.view = lru_cache(_KEPT)(self._view)

    def _view(self, index: int, shrink: int = 1) -> RegionView:
        """Return the part of a view, at 1/`shrink` of its size, that shows the region; at least one pixel."""
        height, width = self._shape[index]
        whole = np.unpackbits(self._packed[index], count=height * width).reshape(height, width).astype(bool)
        height, width = height // shrink, width // shrink
        cells = whole[: height * shrink, : width * shrink].reshape(height, shrink, width, shrink)
        mask = whole if shrink == 1 else cells.mean(axis=(1, 3)) >= 0.5
        if not mask.any():
            return RegionView(Window(0, 0, 1, 1), np.zeros((1, 1), dtype=bool))
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        window = Window(left, top, int(columns[-1]) - left + 1, int(rows[-1]) - top + 1)
        cut = mask[top : top + window.height, left : left + window.width]
        return RegionView(window, np.ascontiguousarray(cut))


@dataclass(frozen=True)
class SceneBox:
    """Box (3,) … (3,) in `model` around the survey's points, with room for what none of them shows."""

    low: FloatArray
    high: FloatArray

    @staticmethod
    def around(points: FloatArray) -> SceneBox:
        """Return the box of points (N, 3), which a few wrong ones do not extend."""
        low, high = np.quantile(points, [_STRAY, 1 - _STRAY], axis=0)
        room = _ROOM * (high - low).max()
        return SceneBox(low - room, high + room)

    def contains(self, points: FloatArray) -> BoolArray:
        """Return which of points (N, 3) lie inside, as a mask (N,)."""
        return np.asarray(((points >= self.low) & (points <= self.high)).all(axis=1))


@dataclass(frozen=True)
class TrainingRegion:
    """Region of a training."""

    cell: BlockCell  # where the Gaussians are trained, in `model`
    box: SceneBox  # of the survey; far beyond it lie sky and horizon
    surroundings: Gaussians  # frozen Gaussians outside the cell, on the device of the training
    sky: Gaussians  # Gaussians of the cell beyond the box, to start from
    masks: RegionMasks


def region_masks(
    solution: Solution,
    views: IntArray,
    images: ImageCache,
    rasterizer: Rasterizer,
    *,
    cell: BlockCell,
    stand_in: Gaussians,
    maps: DepthMaps | None = None,
    progress: Progress = SILENT,
) -> RegionMasks:
    """Return the pixels of the views (T,) of cameras whose surface lies in a region, the cell.

    The images were undistorted with the lenses of the solution. Where the maps, if any, know no depth, that of the
    stand-in counts.
    """
    poses = solution.poses
    masks: dict[int, BoolArray] = {}
    with progress.task("masks", len(views)) as task:
        for index in views.tolist():
            pinhole = images.pinhole(index)
            pose = pose_matrix(poses.cam_from_model[index], poses.cam_center_in_model[index])
            depth = stand_in_depth(stand_in, pose, pinhole, rasterizer)
            masks[index] = region_mask(pose, pinhole, cell, None if maps is None else maps.depth(index), depth)
            task.advance()
    return RegionMasks(masks)


def region_mask(
    pose: FloatArray, pinhole: Pinhole, cell: BlockCell, known: Float32Array | None, stand_in: Float32Array
) -> BoolArray:
    """Return the pixels (H, W) of a view, cam ← model (4, 4), whose surface lies in a region, the cell.

    Depths along z, in metres, are at any resolution; the stand-in's count where none is known: 0, or None for all.
    """
    size = pinhole.width, pinhole.height
    depth = cv2.resize(np.array(stand_in), size, interpolation=cv2.INTER_NEAREST)
    if known is not None:
        known_depth = cv2.resize(np.array(known), size, interpolation=cv2.INTER_NEAREST)
        depth = np.where(known_depth > 0, known_depth, depth)
    mask, rows = np.empty(depth.shape, dtype=bool), max(1, _BAND_PX // pinhole.width)
    for top in range(0, pinhole.height, rows):
        band = Window(0, top, pinhole.width, min(rows, pinhole.height - top))
        points = (band.of(pinhole).points_at(depth[band.slices]) - pose[:3, 3]) @ pose[:3, :3]
        mask[band.slices] = cell.contains(points).reshape(band.height, band.width)
    return mask


def stand_in_depth(
    gaussians: Gaussians, pose: FloatArray, pinhole: Pinhole, rasterizer: Rasterizer
) -> Float32Array:
    """Return the depth (h, w) in metres of a frozen model in a small image of a view; the sky is very far."""
    small = pinhole.limited(_STAND_IN_PX)
    cam_from_model = torch.as_tensor(pose, dtype=torch.float32, device=gaussians.means.device)
    with torch.no_grad():
        view = rasterizer.render(gaussians, cam_from_model, small, RasterSettings(sh_degree=0, depth=True))
    assert view.median_depth is not None and view.expected_depth is not None
    depth = torch.where(view.median_depth > 0, view.median_depth, view.expected_depth)
    seen = view.alpha >= _LEAST_ALPHA
    return np.asarray(torch.where(seen, depth, torch.full_like(depth, _SKY_M)).cpu().numpy())
