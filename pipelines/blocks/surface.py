"""The scene's surface from multi-view stereo: a depth for each pixel of the training photographs where views agree.

Training starts from it and holds the Gaussians to it. On ground with little texture they would otherwise float
metres above where they belong, with the photographs none the worse for it.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.blocks.scene import Scene
from pipelines.formats.image_cache import ImageCache, save_array
from pipelines.geometry.cameras import Pinhole
from pipelines.geometry.thinning import one_a_cube
from pipelines.products import FloatArray
from pipelines.progress import SILENT, Progress
from pipelines.stereo.agreement import AgreementSettings, Surface, agreed_depth, without_rims
from pipelines.stereo.neighbours import Sightings, best_neighbours, planes_for
from pipelines.stereo.sweep import FloatImage, Planes, StereoCamera, StereoView, SweepSettings, Swept, plane_sweep

log = logging.getLogger(__name__)

_NORMAL_REACH_PX = 2
_EDGE_STEP = 0.05  # of the depth
_FORM = b"offset, score, step, sharpness"  # of what is kept: other forms have other folders
_CANDIDATES = 8  # drawn for each point wanted: enough to cover what few views see


@dataclass(frozen=True)
class SurfaceOptions:
    """How to look for the surface.

    Attributes:
        max_size_px: longest side of the photographs that are compared.
        neighbours: views that each is compared with.
        sweep: how they are compared.
        agreement: when views agree.
    """

    max_size_px: int = 400
    neighbours: int = 10
    sweep: SweepSettings = field(default_factory=SweepSettings)
    agreement: AgreementSettings = field(default_factory=AgreementSettings)


@dataclass(frozen=True)
class SurfacePoints:
    """P points of the surface.

    Attributes:
        point_in_model: (P, 3) metres.
        rgb: (P, 3) uint8.
        normal_in_model: (P, 3) unit vectors, of either sign; NaN where unknown.
    """

    point_in_model: FloatArray
    rgb: NDArray[np.uint8]
    normal_in_model: FloatArray

    @staticmethod
    def concatenate(parts: list[SurfacePoints]) -> SurfacePoints:
        """All of some, one after the other; at least one."""
        return SurfacePoints(
            np.concatenate([part.point_in_model for part in parts]),
            np.concatenate([part.rgb for part in parts]),
            np.concatenate([part.normal_in_model for part in parts]),
        )

    def part(self, rows: NDArray[np.int64]) -> SurfacePoints:
        """Some of them."""
        return SurfacePoints(self.point_in_model[rows], self.rgb[rows], self.normal_in_model[rows])


class SceneSurface:
    """Depth maps of the training photographs, made once and kept on disk.

    Memory holds no more than a view and its neighbours.

    Args:
        folder: where the maps are kept.
        scene: cameras and points.
        images: the photographs.
        options: how.
    """

    def __init__(
        self, folder: Path, scene: Scene, images: ImageCache, options: SurfaceOptions | None = None
    ) -> None:
        self._scene, self._images = scene, images
        self._options = options or SurfaceOptions()
        sparse = scene.sparse
        self._sightings = Sightings(
            scene.point_in_model, scene.poses.cam_center_in_model, sparse.obs_point, sparse.obs_image
        )
        # Asked for again by each of a view's neighbours, and the same each time.
        self._neighbours = cache(self._find_neighbours)
        self._planes = cache(self._find_planes)
        self.folder = folder / self._key()

    def build(self, progress: Progress = SILENT) -> None:
        """Make the maps that are not there yet: first each view's own, then what they agree on."""
        train = [int(index) for index in self._scene.train]
        with progress.task("surface", 2 * len(train)) as task:
            for index in train:
                if not self._path(index, "swept").exists() and not self._path(index, "depth").exists():
                    self._sweep(index)
                task.advance()
            for index in train:
                if not self._path(index, "depth").exists():
                    save_array(self._path(index, "depth"), self._agreed(index))
                task.advance()

    def camera(self, index: int) -> Pinhole:
        """Camera of a depth map."""
        return self._images.pinhole(index).limited(self._options.max_size_px)

    def depth(self, index: int) -> FloatImage:
        """Depth (H, W) in metres along the optical axis of a training view, 0 where unknown; mapped from disk."""
        array: FloatImage = np.load(self._path(index, "depth"), mmap_mode="r", allow_pickle=False)
        return array

    def points(self, index: int, stride: int = 1) -> FloatArray:
        """Surface points (P, 3) in `model` that a training view sees, of every `stride`-th row and column."""
        rows, columns = np.nonzero(self.depth(index)[::stride, ::stride])
        return self._points(index, stride * rows, stride * columns)

    def sample(self, count: int, seed: int) -> SurfacePoints:
        """At most `count` points of the whole surface, as dense as the photographs show it."""
        rng = np.random.default_rng(seed)
        share = -(-_CANDIDATES * count // max(len(self._scene.train), 1))
        views, sizes = [], []
        for index in map(int, self._scene.train):
            rows, columns = np.nonzero(self.depth(index))
            chosen = rng.permutation(len(rows))[:share]
            rows, columns = rows[chosen], columns[chosen]
            normals = self._normals(index, rows, columns)
            rgb = self._rgb(index)[rows, columns]
            views.append(SurfacePoints(self._points(index, rows, columns), rgb, normals))
            sizes.append(self.depth(index)[rows, columns].astype(np.float64) / self.camera(index).fx)
        found = SurfacePoints.concatenate(views)
        return found.part(spread_evenly(found.point_in_model, np.concatenate(sizes), count))

    def _normals(self, index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> FloatArray:
        """Unit vectors (P, 3) across the surface at pixels of a view; NaN at its edges."""
        depth = self.depth(index)
        inside = (rows >= _NORMAL_REACH_PX) & (rows < depth.shape[0] - _NORMAL_REACH_PX)
        inside &= (columns >= _NORMAL_REACH_PX) & (columns < depth.shape[1] - _NORMAL_REACH_PX)
        found = np.full((len(rows), 3), np.nan)
        kept = np.flatnonzero(inside)
        places = [
            (rows[kept] + _NORMAL_REACH_PX * down, columns[kept] + _NORMAL_REACH_PX * right)
            for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0))
        ]
        around = np.stack([depth[place] for place in places])
        smooth = around.min(axis=0) * (1 + _EDGE_STEP) > around.max(axis=0)
        right, left, below, above = (self._points(index, *place) for place in places)
        normal = np.cross(right - left, below - above)[smooth]
        found[kept[smooth]] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return found

    def _points(self, index: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> FloatArray:
        depth, poses = self.depth(index)[rows, columns].astype(np.float64), self._scene.poses
        ray = self.camera(index).rays(np.stack([columns, rows], axis=1) + 0.5)
        turned = (depth[:, None] * ray) @ poses.cam_from_model[index]
        return np.asarray(poses.cam_center_in_model[index] + turned)

    def _sweep(self, index: int) -> None:
        """Write (4, H, W): offset, score, step and sharpness of each pixel."""
        camera = self.camera(index)
        swept = np.zeros((4, camera.height, camera.width), dtype=np.float32)
        swept[0], swept[1] = np.nan, -1.0
        planes, others = self._planes(index), self._neighbours(index)
        if planes is not None:
            found = plane_sweep(self._view(index), [self._view(j) for j in others], planes, self._options.sweep)
            swept[:] = found.offset_m, found.score, found.step_m, found.sharpness
        save_array(self._path(index, "swept"), swept)

    def _agreed(self, index: int) -> FloatImage:
        own = self._surface(index)
        if own is None:
            camera = self.camera(index)
            return np.zeros((camera.height, camera.width), dtype=np.float32)
        others, options = [self._surface(j) for j in self._neighbours(index)], self._options
        depth = agreed_depth(own, [other for other in others if other is not None], options.agreement)
        return without_rims(depth, options.sweep.window_px // 2, options.agreement.rim)

    def _surface(self, index: int) -> Surface | None:
        planes = self._planes(index)
        if planes is None:
            return None
        offset, score, step, sharpness = np.load(self._path(index, "swept"), mmap_mode="r", allow_pickle=False)
        return Surface(self._camera(index), planes, Swept(offset, score, step, sharpness))

    def _find_planes(self, index: int) -> Planes | None:
        others = self._neighbours(index)
        if not others:
            return None
        points = self._scene.point_in_model[self._sightings.seen_by(index)]
        return planes_for(self._camera(index), [self._camera(j) for j in others], points)

    def _find_neighbours(self, index: int) -> list[int]:
        return best_neighbours(self._sightings, index, self._scene.train, self._options.neighbours)

    def _camera(self, index: int) -> StereoCamera:
        poses = self._scene.poses
        return StereoCamera(self.camera(index), poses.cam_from_model[index], poses.cam_center_in_model[index])

    def _view(self, index: int) -> StereoView:
        grey = cv2.cvtColor(self._rgb(index), cv2.COLOR_RGB2GRAY).astype(np.float32) + 1
        mask = np.array(self._images.mask(index), dtype=np.uint8)
        grey[cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0] = 0
        return StereoView(self._camera(index), grey)

    def _rgb(self, index: int) -> NDArray[np.uint8]:
        camera = self.camera(index)
        image = np.array(self._images.image(index))
        return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.uint8)

    def _path(self, index: int, kind: str) -> Path:
        return self.folder / f"{index:06d}.{kind}.npy"

    def _key(self) -> str:
        """Changes with all that the maps depend on."""
        digest = hashlib.sha256(_FORM)
        poses, sparse = self._scene.poses, self._scene.sparse
        arrays = (
            poses.cam_from_model, poses.cam_center_in_model, self._scene.point_in_model, self._scene.train,
            sparse.obs_point, sparse.obs_image,
        )  # fmt: skip
        for array in arrays:
            digest.update(np.ascontiguousarray(array).tobytes())
        for index in range(len(sparse.image_name)):
            digest.update(self._images.key(index).encode())
        digest.update(repr(self._options).encode())
        return digest.hexdigest()[:32]


def spread_evenly(points: FloatArray, size_m: FloatArray, count: int) -> NDArray[np.int64]:
    """Indices of points (P, 3), at most `count`, one in each cube whose side is proportional to their size (P,)."""
    if len(points) <= count:
        return np.arange(len(points))
    fine, coarse = 2.0**-4, 2.0**12
    low, kept = points.min(axis=0), np.arange(1)
    for _ in range(16):
        middle = float(np.sqrt(fine * coarse))
        first = one_a_cube(points - low, middle * size_m)
        if len(first) > count:
            fine = middle
        else:
            coarse, kept = middle, first
    return kept
