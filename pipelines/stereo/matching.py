"""Photometric matching of a photograph with its neighbours, hypothesis by hypothesis; the best hypothesis wins.

1. Normalised cross-correlation compares photographs: exposure does not change it.
2. The neighbours that agree best count (Kang, Szeliski & Chai, doi 10.1109/CVPR.2001.990462): an obstacle hides a
   place from some sides only.
3. A guided filter averages the correlations of each hypothesis, but not across edges of the photograph (Rhemann et
   al., doi 10.1109/CVPR.2011.5995372). Ground without texture needs a wide window; beside the edge of a roof a wide
   window sees the roof.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.core.types import BoolArray, Float32Array, FloatArray
from pipelines.stereo import match_kernels as kernels
from pipelines.stereo.views import StereoView, opencv_camera_matrix

UNSEEN = float(kernels.UNSEEN)
_LEAST_CURVATURE = 1e-6
_FURTHEST_M = 1e7  # hypotheses beyond are as good as infinite, and kernels need finite numbers


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the comparison.

    Attributes:
        window_px: side of the correlation window, odd.
        reach_px: radius of the guided filter that averages correlations.
        edge_grey: step in grey levels across which the filter does not average.
        views: number of neighbours that count, the best of all.
    """

    window_px: int = 5
    reach_px: int = 6
    edge_grey: float = 10.0
    views: int = 3

    @property
    def support_px(self) -> int:
        """Distance from a pixel up to which its score depends on the image: the guided filter averages averages."""
        return self.window_px // 2 + 2 * self.reach_px


class Matcher:
    """Compares a photograph (H, W) with its neighbours under hypotheses of depth.

    Args:
        reference: view whose surface is wanted.
        neighbours: one or more views of the same place from elsewhere.
        settings: of the comparison.
    """

    def __init__(self, reference: StereoView, neighbours: list[StereoView], settings: MatchSettings) -> None:
        grey, side = reference.grey, (settings.window_px, settings.window_px)
        self._settings, self._grey = settings, grey
        self._mean, square = (
            np.asarray(cv2.boxFilter(image, -1, side, borderType=cv2.BORDER_REFLECT), np.float32)
            for image in (grey, grey * grey)
        )
        variance = square - self._mean * self._mean
        self._inverse_sigma = (1 / np.sqrt(np.maximum(variance, kernels.NOISE_VARIANCE))).astype(np.float32)
        half = settings.window_px // 2
        self._mirrored = np.pad(grey, ((0, 0), (half, half)), mode="symmetric")
        self._greys, self._sizes = _stacked([view.grey for view in neighbours])
        self._per_depth, self._starts = _projections(reference, neighbours)
        height, width = grey.shape
        self._largest = np.empty((height, min(settings.views, len(neighbours)), width), np.float32)
        self._guided: tuple[slice, cv2.ximgproc.GuidedFilter] | None = None

    def __call__(self, depth: Float32Array, rows: slice | None = None) -> Float32Array:
        """Return the score (h, W) of a hypothesis in some rows of the view.

        Args:
            depth: (H, W) along the optical axis; not positive: no hypothesis, UNSEEN.
            rows: first row and the row after the last; None: all. Rows within the settings' `support_px` of either
                end are less exact.
        """
        part = rows or slice(0, len(self._grey))
        seen = (depth > 0) & (depth < _FURTHEST_M)
        kernels.match_rows(
            *(np.where(seen, depth, np.float32(0)), np.array([part.start, part.stop]), self._mirrored),
            *(self._mean, self._inverse_sigma, self._greys, self._sizes, self._per_depth, self._starts),
            self._largest,
        )
        score = self._filter(part).filter(self._largest[part].mean(axis=1))
        return np.where(seen[part], score, np.float32(UNSEEN))

    def _filter(self, part: slice) -> cv2.ximgproc.GuidedFilter:
        """Return the guided filter of some rows; the rows of a hypothesis are mostly those of the one before."""
        if self._guided is None or self._guided[0] != part:
            settings = self._settings
            guide = np.ascontiguousarray(self._grey[part])
            self._guided = (
                part,
                cv2.ximgproc.createGuidedFilter(guide, settings.reach_px, settings.edge_grey**2),
            )
        return self._guided[1]


def _stacked(images: list[Float32Array]) -> tuple[Float32Array, Float32Array]:
    """Return images in one array (n, h + 1, w + 1), and the largest column and row (n, 2) of each."""
    height, width = (max(image.shape[axis] for image in images) for axis in (0, 1))
    greys = np.zeros((len(images), height + 1, width + 1), np.float32)
    for grey, image in zip(greys, images, strict=True):
        grey[: image.shape[0], : image.shape[1]] = image
    return greys, np.array([[image.shape[1] - 1, image.shape[0] - 1] for image in images], np.float32)


def _projections(reference: StereoView, neighbours: list[StereoView]) -> tuple[Float32Array, Float32Array]:
    """Return matrices (n, 3, 3) and vectors (n, 3) that project pixels with depths into neighbours."""
    camera = reference.camera
    world_from_pixel = camera.cam_from_world.T @ np.linalg.inv(opencv_camera_matrix(camera.pinhole))
    per_depth, starts = [], []
    for view in neighbours:
        pixel_from_world = opencv_camera_matrix(view.camera.pinhole) @ view.camera.cam_from_world
        per_depth.append(pixel_from_world @ world_from_pixel)
        starts.append(pixel_from_world @ (camera.center_in_world - view.camera.center_in_world))
    return np.array(per_depth, np.float32), np.array(starts, np.float32)


@dataclass(frozen=True)
class Winner:
    """Best of a sequence of hypotheses at each pixel.

    Attributes:
        hypothesis: (H, W) its number, with a fraction.
        score: (H, W) correlation, −1 … 1.
        curvature: (H, W) minus the second derivative of the score by the number.
        inner: (H, W) whether scores of the hypotheses before and after exist.
    """

    hypothesis: FloatArray
    score: Float32Array
    curvature: Float32Array
    inner: BoolArray


class WinnerTakesAll:
    """Search for the largest of a sequence of score images at each pixel, with the scores before and after it."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._count = 0
        self._hypothesis = np.full(shape, -2, dtype=np.int32)
        self._best, self._before, self._after, self._last = (np.full(shape, -2.0, np.float32) for _ in range(4))

    def add(self, score: Float32Array) -> None:
        """Take the scores (H, W) of the next hypothesis."""
        images = (score, self._last, self._best, self._before, self._after, self._hypothesis)
        kernels.keep_winner(self._count, *(image.reshape(-1) for image in images))
        self._count += 1

    def winner(self) -> Winner:
        """Return the best hypotheses, refined by the parabola through the scores before and after if both exist."""
        inner = (self._before > UNSEEN) & (self._after > UNSEEN)
        curvature = np.maximum(2 * self._best - self._before - self._after, _LEAST_CURVATURE)
        shift = np.where(inner, 0.5 * (self._after - self._before) / curvature, 0.0).clip(-0.5, 0.5)
        return Winner(self._hypothesis + shift, self._best, np.where(inner, curvature, _LEAST_CURVATURE), inner)
