"""Depth maps of the training photographs by multi-view stereo, cached on disk: depths on which views agree.

1. A plane sweep gives each view's depths on coarse pixels: its time grows with the cube of the photographs' side.
2. The refinements on middle and fine pixels start from the depths on which views agree, elsewhere from the view's
   own.
3. The depth map keeps the refined depths on which views agree.
"""

import hashlib
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from pipelines.core.machine import thread_count
from pipelines.core.progress import SILENT, Progress, ProgressTask
from pipelines.core.types import ByteArray, Float32Array
from pipelines.geometry.cameras import Pinhole, ViewPose
from pipelines.surface.agreement import THRESHOLDS, agreed_depth, refine, surface_prior, without_rims
from pipelines.surface.matching import UNSEEN, MatchSettings, StereoView
from pipelines.surface.sweep import NormalMap, SweepPlanes, SweepResult, best_neighbours, plane_sweep, planes_for
from pipelines.survey.photographs import ImageCache, mapped_array, save_array
from pipelines.survey.scene import SparseScene

# Layout of the cached arrays, a part of their key: files of another layout lie in another folder.
_LAYOUT = b"levels: direction, offset, score, step, sharpness, by kernels"
_NEIGHBOURS = 10  # views that each view is compared with
_VIEWS_KEPT = 64  # of the last ones, shrunken: they are the neighbours of the next
_KEY_DECIMALS = 6  # of metres and of direction cosines, in the key of the cache


@dataclass(frozen=True)
class PyramidLevel:
    """Pixels on which depths are looked for: first by a plane sweep, then by refinement of the level before."""

    name: str
    longest_px: int  # longest side of the photographs
    settings: MatchSettings
    steps: float = 1.0  # of a refinement, for one step of the level before


# On middle pixels a wide window finds the surface where there is little texture. Where the surface is nearly known,
# a small window does not extend it across the foot of a wall.
MIDDLE = PyramidLevel("middle", 320, MatchSettings(), steps=1.5)
FINE = PyramidLevel("fine", 640, MatchSettings(window_px=3, reach_px=2), steps=3.0)
LEVELS = (PyramidLevel("coarse", 200, MatchSettings(window_px=3, reach_px=3)), MIDDLE, FINE)


class DepthMaps:
    """Depth maps of the training photographs, computed once and cached on disk.

    Memory holds no more than a few views and their neighbours.

    Args:
        folder: cache, in which each scene has a folder of its own.
    """

    def __init__(self, folder: Path, scene: SparseScene, images: ImageCache) -> None:
        self.scene, self.images = scene, images
        # Each neighbour of a view needs the view's planes and neighbours, too.
        self._neighbours = cache(lambda index: best_neighbours(scene.network, index, scene.train, _NEIGHBOURS))
        self._planes = cache(self._find_planes)
        self._view = lru_cache(_VIEWS_KEPT)(self._load_view)
        self.folder = folder / self._key()

    def build(self, progress: Progress = SILENT) -> None:
        """Compute the depth maps that the cache lacks, several at once; an InputError: a photograph is unusable.

        A view needs the previous step of its neighbours. Each step therefore finishes all views before the next
        step begins.
        """
        train = [int(index) for index in self.scene.train]
        steps: list[tuple[str, Callable[[int], Float32Array]]] = [(LEVELS[0].name, self._sweep)]
        for before, level in itertools.pairwise(LEVELS):
            steps.append((level.name, partial(self._refine, before, level)))
        steps.append(("depth", self._agree))
        if not all(self._path(index, "depth").exists() for index in train):
            for index in train:  # Photographs share masks, which two threads must not write at once.
                self.images.mask(index)
            with progress.task("surface", len(steps) * len(train)) as task:
                task.advance(0, "compiling kernels (a minute, once)")
                for kind, make in steps:
                    self._make_all(kind, make, train, task)
        for kind, _ in steps[:-1]:  # and the files that an interrupted run has left
            for index in train:
                self._path(index, kind).unlink(missing_ok=True)

    def _make_all(
        self, kind: str, make: Callable[[int], Float32Array], views: list[int], task: ProgressTask
    ) -> None:
        """Write the missing arrays of one step in threads, since the kernels release the interpreter's lock."""

        def write(index: int) -> None:
            if not self._path(index, kind).exists():
                save_array(self._path(index, kind), make(index))

        with ThreadPoolExecutor(thread_count()) as pool:
            jobs = [pool.submit(write, index) for index in views]
            try:
                for job in jobs:
                    job.result()
                    task.advance(1, " ")
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def camera(self, index: int, level: PyramidLevel = FINE) -> Pinhole:
        """Return the camera of a level, or of a depth map."""
        return self.images.pinhole(index).limited(level.longest_px)

    def depth(self, index: int) -> Float32Array:
        """Return the depth (H, W) in metres along a training view's optical axis, mapped from disk; 0: unknown."""
        array: Float32Array = mapped_array(self._path(index, "depth"))
        return array

    def rgb(self, index: int, level: PyramidLevel = FINE) -> ByteArray:
        """Return the photograph (H, W, 3) at the pixels of `camera`."""
        whole, pinhole = self.images.pinhole(index), self.camera(index, level)
        # All neighbours read a view: large photographs are shrunken once, by a factor that divides both sides.
        most = max(max(whole.width, whole.height) // (2 * FINE.longest_px), 1)
        shrink = max(s for s in range(1, most + 1) if whole.width % s == 0 == whole.height % s)
        image = np.array(self.images.image(index, shrink))
        small = cv2.resize(image, (pinhole.width, pinhole.height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.uint8)

    def _sweep(self, index: int) -> Float32Array:
        sweeps, others, level = self._planes(index), self._neighbours(index), LEVELS[0]
        if not sweeps:
            return _empty_maps(self.camera(index, level))
        reference, *views = (self._view(j, level) for j in (index, *others))
        return _packed(plane_sweep(reference, views, sweeps, level.settings))

    def _refine(self, before: PyramidLevel, level: PyramidLevel, index: int) -> Float32Array:
        own = self._surface(index, before)
        if own is None:
            return _empty_maps(self.camera(index, level))
        reference, *views = (self._view(j, level) for j in (index, *self._neighbours(index)))
        prior = surface_prior(own, self._agreed(own, index, before), reference.camera, level.steps)
        return _packed(refine(reference, views, prior, level.settings))

    def _agree(self, index: int) -> Float32Array:
        own = self._surface(index, FINE)
        if own is None:
            return np.zeros((self.camera(index).height, self.camera(index).width), dtype=np.float32)
        return self._agreed(own, index, FINE)

    def _agreed(self, own: SweepResult, index: int, level: PyramidLevel) -> Float32Array:
        """Return the depths (H, W) on which views agree; 0 elsewhere."""
        others = [self._surface(j, level) for j in self._neighbours(index)]
        depth = agreed_depth(own, [other for other in others if other is not None])
        # Fine depths started from those of the middle level: its window sets the width of a rim on all pixels.
        window_px = MIDDLE.settings.window_px * own.camera.pinhole.width / self.camera(index, MIDDLE).width
        return without_rims(depth, int(window_px / 2))

    def _surface(self, index: int, level: PyramidLevel) -> SweepResult | None:
        sweeps = self._planes(index)
        if not sweeps:
            return None
        normal_index, *rest = mapped_array(self._path(index, level.name))
        normals = NormalMap(np.stack([planes.normal_in_model for planes in sweeps]), normal_index.astype(np.uint8))
        return SweepResult(self._pose(index, level), normals, *rest)

    def _find_planes(self, index: int) -> list[SweepPlanes]:
        others = self._neighbours(index)
        if not others:
            return []
        sparse = self.scene.sparse
        points = self.scene.point_in_model[np.unique(sparse.obs_point[sparse.obs_image == index])]
        pose, *around = (self._pose(j, LEVELS[0]) for j in (index, *others))
        return planes_for(pose, around, points)

    def _pose(self, index: int, level: PyramidLevel) -> ViewPose:
        poses = self.scene.poses
        return ViewPose(self.camera(index, level), poses.cam_from_model[index], poses.cam_center_in_model[index])

    def _load_view(self, index: int, level: PyramidLevel) -> StereoView:
        grey = np.maximum(cv2.cvtColor(self.rgb(index, level), cv2.COLOR_RGB2GRAY), 1)
        mask = np.array(self.images.mask(index), dtype=np.uint8)
        grey[cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST) == 0] = 0
        return StereoView(self._pose(index, level), grey)

    def _path(self, index: int, kind: str) -> Path:
        return self.folder / f"{index:06d}.{kind}.npy"

    def _key(self) -> str:
        """Return a hash of all inputs of the depth maps."""
        digest = hashlib.sha256(_LAYOUT)
        poses, sparse = self.scene.poses, self.scene.sparse
        arrays = (
            poses.cam_from_model, poses.cam_center_in_model, self.scene.point_in_model, self.scene.train,
            sparse.obs_point, sparse.obs_image,
        )  # fmt: skip
        for array in arrays:
            # The last bits of a pose depend on the processor and on numpy's version: a micrometre does not matter.
            rounded = array.round(_KEY_DECIMALS) + 0.0 if array.dtype.kind == "f" else array
            digest.update(np.ascontiguousarray(rounded).tobytes())
        for index in range(len(sparse.image_name)):
            digest.update(self.images.key(index).encode())
            if self.images.is_masked(index):
                digest.update(self.images.mask_key(index).encode())
        digest.update(repr((LEVELS, _NEIGHBOURS, THRESHOLDS)).encode())
        return digest.hexdigest()[:32]


def _packed(sweep: SweepResult) -> Float32Array:
    """Return direction, offset, score, step and sharpness of each pixel as one array (5, H, W)."""
    normal_index = sweep.normals.index.astype(np.float32)
    return np.stack([normal_index, sweep.offset_m, sweep.score, sweep.step_m, sweep.sharpness])


def _empty_maps(pinhole: Pinhole) -> Float32Array:
    """Return the array (5, H, W) of `_packed` for a view without planes: no pixel has a depth."""
    empty = np.zeros((5, pinhole.height, pinhole.width), dtype=np.float32)
    empty[1], empty[2] = np.nan, UNSEEN
    return empty
