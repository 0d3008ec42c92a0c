"""Exposures of the photographs from the colours that they show at SfM points."""

import cv2
import numpy as np

from pipelines.core.progress import SILENT, Progress
from pipelines.core.types import BoolArray, ByteArray, FloatArray, IntArray
from pipelines.geometry.cameras import undistort
from pipelines.splat.exposure import PointColours, adjusted_exposures
from pipelines.survey.photographs import ImageCache
from pipelines.survey.scene import SparseScene

_TRACKS = 300  # of a photograph, the longest: three gains need no more
_PHOTOGRAPHS = 16  # of a track
_AROUND_PX = 5  # side of the square whose mean colour counts: a pixel at a corner is not repeatable
_DARKEST, _BRIGHTEST = 4 / 255, 250 / 255  # a clipped channel does not show its exposure


def exposures_from_tracks(scene: SparseScene, images: ImageCache, progress: Progress = SILENT) -> FloatArray:
    """Return the exposures (n, 3, 4) of all photographs, (A | b) of `splat.exposure`.

    Their mean over the training photographs is the identity. Each photograph is read once, and memory holds the
    colours of at most 300 tracks of each. An InputError: a photograph cannot be read.
    """
    sparse, rows = scene.sparse, _observations_in_use(scene)
    colour = np.full((len(rows), 3), np.nan, dtype=np.float32)
    by_image = np.argsort(sparse.obs_image[rows], kind="stable")
    first = np.searchsorted(sparse.obs_image[rows][by_image], np.arange(len(images) + 1))
    with progress.task("colours of tracks", len(images)) as task:
        for index in range(len(images)):
            mine = by_image[first[index] : first[index + 1]]
            pinhole, ray = images.pinhole(index), undistort(sparse.camera_of(index), sparse.obs_xy_px[rows[mine]])
            xy_px = np.asarray(ray * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy])
            colour[mine] = _colours_at(images.image(index), images.mask(index), xy_px)
            task.advance()
    good = np.isfinite(colour).all(axis=1) & (colour > _DARKEST).all(axis=1) & (colour < _BRIGHTEST).all(axis=1)
    kept = rows[good]
    observed = PointColours(sparse.obs_point[kept], sparse.obs_image[kept], colour[good])
    return adjusted_exposures(observed, len(images), scene.train)


def _observations_in_use(scene: SparseScene) -> IntArray:
    """Return the rows of the observations of the points that count, ascending.

    These are the longest tracks, each taken as long as one of its photographs has too few. The pairs of photographs
    that a track couples grow with the square of its length: of a track, those photographs count that need it most.
    """
    sparse = scene.sparse
    point, image = sparse.obs_point, sparse.obs_image
    first = np.searchsorted(point, np.arange(len(sparse.point_id) + 1))
    length = np.diff(first)
    taken = np.zeros(len(sparse.image_name), dtype=np.int64)
    chosen = np.zeros(len(point), dtype=bool)
    for index in np.argsort(-length, kind="stable")[: np.count_nonzero(length >= 2)].tolist():
        seen_in = image[first[index] : first[index + 1]]
        neediest = np.argsort(taken[seen_in], kind="stable")[:_PHOTOGRAPHS]
        if taken[seen_in[neediest[0]]] < _TRACKS:
            chosen[first[index] + neediest] = True
            taken[seen_in[neediest]] += 1
    return np.flatnonzero(chosen)


def _colours_at(photograph: ByteArray, mask: BoolArray, xy_px: FloatArray) -> FloatArray:
    """Return the mean colours (M, 3) from 0 to 1 around pixels; NaN outside the mask."""
    mean = cv2.blur(np.asarray(photograph), (_AROUND_PX, _AROUND_PX)).astype(np.float32) / 255
    height, width = mask.shape
    place = np.nan_to_num(xy_px - 0.5, nan=-1.0)  # arrays count from the centre of the first pixel
    inside = np.asarray(((place >= 0) & (place < [width - 1, height - 1])).all(axis=1))
    column, row = np.where(inside[:, None], place, 0.0).astype(np.int64).T
    inside &= np.asarray(mask[row, column], dtype=bool)
    right, down = (place - np.column_stack([column, row])).T[:, :, None]
    upper = (1 - right) * mean[row, column] + right * mean[row, column + 1]
    lower = (1 - right) * mean[row + 1, column] + right * mean[row + 1, column + 1]
    return np.where(inside[:, None], (1 - down) * upper + down * lower, np.nan)
